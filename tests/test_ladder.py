"""A ladder of models: the best on validation is trained in full; a resumed one ends the same."""

import json
import math

import pytest
import torch
from task_helpers import TASKS, TRAIN, VALIDATION, same, weights

import offbeat as ob
from offbeat.ladder import Candidate, Trial, fit_ladder
from offbeat.models.corrected import CorrectedModel

SMALL = {"hidden_size": 4, "decoder_units": (4,), "field_units": (4,)}
GRU = ob.ModelConfig("gru", hidden_size=6, decoder_units=(6,))
CANDIDATES = (
    Candidate(GRU, 1e-9),  # learns nothing
    Candidate(GRU, 0.01, "damped_slope"),
    Candidate(ob.ModelConfig("anchored_ode_gru_d", **SMALL), 0.003),
)
CONFIG = ob.TrainConfig(tasks=TASKS, tasks_per_epoch=48, epochs=3)


def test_the_best_candidate_on_validation_is_trained_in_full(tmp_path):
    result = fit_ladder(
        TRAIN, VALIDATION, CONFIG, candidates=CANDIDATES, budget_s=1.0, out=tmp_path, progress=False
    )
    scores = [trial.score for trial in result.trials]
    assert 2 <= result.trial_epochs <= 8
    assert result.chosen == scores.index(min(scores))
    assert result.trials[result.chosen].candidate.learning_rate > 1e-9
    assert result.fit.recipe.epochs == result.config.epochs == 3
    assert result.config.learning_rate == result.trials[result.chosen].candidate.learning_rate
    assert result.score <= min(scores)
    loaded = ob.load_model(tmp_path)
    assert same(weights(loaded), weights(result.model))
    assert isinstance(loaded, CorrectedModel) == bool(CANDIDATES[result.chosen].corrects)


def test_a_ladder_that_was_stopped_ends_as_if_it_had_not_been(tmp_path, monkeypatch):
    options = {"candidates": CANDIDATES[1:], "budget_s": 1.0, "progress": False}
    import offbeat.training as training

    class Killed(BaseException):
        pass

    step, steps = training.train_step, 0

    def killed(*args, **kwargs):
        nonlocal steps
        steps += 1
        if steps == 2 * 3 * 16 + 8:  # three epochs each of timing, then within the trials
            raise Killed
        return step(*args, **kwargs)

    monkeypatch.setattr(training, "train_step", killed)
    with pytest.raises(Killed):
        fit_ladder(TRAIN, VALIDATION, CONFIG, out=tmp_path, **options)
    monkeypatch.undo()
    plan = json.loads((tmp_path / "ladder" / "plan.json").read_text())
    resumed = fit_ladder(TRAIN, VALIDATION, CONFIG, out=tmp_path, **options)
    assert [t.seconds_per_step for t in resumed.trials] == [
        t["seconds_per_step"] for t in plan["trials"]
    ]
    whole = fit_ladder(TRAIN, VALIDATION, CONFIG, out=tmp_path / "whole", **options)
    assert [t.score for t in resumed.trials] == [t.score for t in whole.trials]
    assert same(weights(resumed.model), weights(whole.model))


def test_a_budget_leaves_out_the_last_candidates_and_bounds_the_epochs(tmp_path, monkeypatch):
    from offbeat.ladder import _Ladder

    monkeypatch.setattr(_Ladder, "_seconds_per_step", lambda self, candidate: 1.0)
    ladder = _Ladder(TRAIN, VALIDATION, CONFIG, "standardise", None, 0, None, False)
    # An epoch is three steps, of 1.2 s with what is around them.
    trials, epochs = ladder.plan(CANDIDATES, 2 * 3.6 * 5.5, None)
    assert (len(trials), epochs, trials[0].epochs) == (2, 2, 6)
    trials, epochs = ladder.plan(CANDIDATES, 2 * 3.6 * 12.5, None)
    assert (len(trials), epochs, trials[0].epochs) == (3, 4, 12)
    trials, epochs = ladder.plan(CANDIDATES, 1e-3, None)
    assert (len(trials), epochs, trials[0].epochs) == (1, 2, 6)
    trials, epochs = ladder.plan(CANDIDATES, None, None)
    assert (len(trials), epochs, trials[0].epochs) == (3, 8, 40)


def test_a_candidate_that_diverges_is_not_chosen(monkeypatch):
    import offbeat.training as training

    step = training.train_step

    def poisoned(model, *args, **kwargs):
        loss = step(model, *args, **kwargs)
        if model.name == "gru":
            with torch.no_grad():
                next(model.parameters()).fill_(math.nan)
        return loss

    monkeypatch.setattr(training, "train_step", poisoned)
    options = {"budget_s": None, "progress": False}
    monkeypatch.setattr("offbeat.ladder.TRIAL_EPOCHS", (1, 1))
    result = fit_ladder(TRAIN, VALIDATION, CONFIG, candidates=CANDIDATES[::2], **options)
    assert result.trials[0].score == math.inf
    assert result.chosen == 1
    with pytest.raises(ob.DivergenceError, match="every candidate diverged"):
        fit_ladder(TRAIN, VALIDATION, CONFIG, candidates=CANDIDATES[:1], **options)


def test_a_plan_of_other_candidates_is_refused_and_a_damaged_one_is_named(tmp_path):
    options = {"budget_s": 1e-3, "out": tmp_path, "progress": False}
    fit_ladder(TRAIN, VALIDATION, CONFIG, candidates=CANDIDATES[1:2], **options)
    with pytest.raises(ob.InputError, match="other candidates"):
        fit_ladder(TRAIN, VALIDATION, CONFIG, candidates=CANDIDATES[:1], **options)
    (tmp_path / "ladder" / "plan.json").write_text('{"trials": [{}]}')
    with pytest.raises(ob.FileFormatError, match="is damaged"):
        fit_ladder(TRAIN, VALIDATION, CONFIG, candidates=CANDIDATES[1:2], **options)


def test_a_ladder_without_tasks_is_refused():
    with pytest.raises(ob.InputError, match="needs tasks"):
        fit_ladder(TRAIN, VALIDATION, ob.TrainConfig(), progress=False)
    with pytest.raises(ob.InputError, match="budget_s must be a positive"):
        fit_ladder(TRAIN, VALIDATION, CONFIG, budget_s=0, progress=False)


def test_a_label_names_the_model_its_size_its_rate_and_what_it_corrects():
    assert CANDIDATES[1].label == "gru-on-damped_slope-6-0.01"
    assert Trial(CANDIDATES[2], 0.1, 6).candidate.label == "anchored_ode_gru_d-4-0.003"
