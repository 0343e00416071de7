"""The protocol: its runs are those of the thesis and ours, paired, and every number is used."""

import json
from collections import Counter, defaultdict
from dataclasses import asdict, fields, replace

import numpy as np
import pytest

import offbeat as ob
from offbeat.models.zoo import resolve
from thesis.protocol import CONTROLS, MODELS, THESIS_ROWS, Protocol, select

FULL = Protocol()


def test_the_protocol_has_the_176_runs_of_the_thesis_120_of_ours_and_then_80_controls():
    runs = FULL.runs()
    thesis = [run for run in runs if run.model in THESIS_ROWS]
    assert Counter(run.experiment for run in thesis) == {1: 16, 2: 160}
    assert Counter(run.model for run in runs if run.model not in THESIS_ROWS) == {
        "gru_fair": 40,
        "gru_d_fair": 40,
        "anchored_ode_gru_d": 40,
        "gru_unfed": 40,
        "gru_d_unfed": 40,
    }
    assert len({run.run_id for run in runs}) == len(runs) == 376
    assert len({run.seed_weights for run in runs}) == 376
    assert all(run.model in CONTROLS for run in runs[296:])


def test_the_thesis_is_1_9_million_training_steps():
    # 16 runs of 300 epochs and 40 of 75 + 3 x 50, of 7,000 / 50 = 140 steps each.
    steps = sum(FULL.steps(run) for run in FULL.runs() if run.model in THESIS_ROWS)
    assert steps == 140 * (16 * 300 + 40 * (75 + 150)) == 1_932_000


def test_epochs_are_300_then_75_at_90_percent_and_50_elsewhere():
    epochs = {(run.experiment, run.observed_fraction): run.epochs for run in FULL.runs()}
    assert {epochs[1, p] for p in (0.9, 0.7, 0.5, 0.3)} == {300}
    assert [epochs[2, p] for p in (0.9, 0.7, 0.5, 0.3)] == [75, 50, 50, 50]


def test_the_models_of_a_repeat_share_the_seed_of_all_draws_and_nothing_else_does():
    draws = defaultdict(set)
    for run in FULL.runs():
        draws[run.seed_draw].add((run.experiment, run.observed_fraction, run.repeat))
    assert len(draws) == 4 + 40
    assert all(len(of) == 1 for of in draws.values())


def test_any_beginning_of_the_runs_has_done_all_models_and_fractions_equally_often():
    done: Counter[tuple[str, float]] = Counter()
    cells = [
        (model, p) for model in MODELS if model not in CONTROLS for p in FULL.observed_fractions
    ]
    for run in FULL.runs()[:296]:
        if run.experiment == 2:
            done[run.model, run.observed_fraction] += 1
            counts = [done[cell] for cell in cells]
            assert max(counts) - min(counts) <= 1
    first = [run.experiment for run in FULL.runs()[: 4 * (28 + 4)]]
    assert first.count(1) == 16  # all of experiment 1 lies within the first four repeats


@pytest.mark.parametrize("label", THESIS_ROWS)
def test_a_row_of_the_thesis_is_the_zoo_s_model_under_the_thesis_protocol(label):
    feeding = {"self_feeding": 0.5} if label in ("gru", "gru_d") else {}
    assert resolve(FULL.model_config(label)) == resolve(ob.thesis_config(label, **feeding))


def test_the_fair_models_see_what_the_ode_models_see():
    gru, gru_d = (resolve(FULL.model_config(label)) for label in ("gru_fair", "gru_d_fair"))
    fair = {"self_feeding": 0.0, "update_rows": "every", "decay_rows": "every_row"}
    expected = resolve(
        ob.thesis_config("gru", time_input="delta", time_input_unit="longest", **fair)
    )
    assert gru == expected
    assert gru_d == resolve(ob.thesis_config("gru_d", **fair))


@pytest.mark.parametrize("label", CONTROLS)
def test_a_control_differs_from_the_row_of_the_thesis_in_self_feeding_alone(label):
    row = asdict(resolve(FULL.model_config(label.removesuffix("_unfed"))))
    control = asdict(resolve(FULL.model_config(label)))
    assert {n: (row[n], control[n]) for n in row if row[n] != control[n]} == {
        "self_feeding": (0.5, 0.0)
    }


def test_the_anchored_model_is_the_zoo_s_with_steps_per_row_and_its_own_training():
    label = "anchored_ode_gru_d"
    config = ob.ModelConfig(name=label, nodes="rows", bounded=False)
    assert resolve(FULL.model_config(label)) == resolve(config)
    run = next(run for run in FULL.runs() if run.model == label)
    expected = ob.train_config(label, epochs=75, seed=run.seed_draw, keep="last")
    assert FULL.train_config(run) == expected


@pytest.mark.parametrize("label", [label for label in MODELS if label != "anchored_ode_gru_d"])
def test_all_other_models_train_as_the_thesis_does(label):
    run = next(run for run in FULL.runs() if run.model == label and run.repeat == 4)
    assert FULL.train_config(run) == ob.TrainConfig(
        epochs=75,
        batch_size=50,
        optimizer="adamax",
        learning_rate=0.001,
        schedule="constant",
        loss_scale=1.0,
        seed=run.seed_draw,
        keep="last",  # not the best, as the library would
    )


def test_windows_masks_and_split_of_a_repeat_are_equal_for_all_its_models():
    small = replace(FULL, n_trajectories=40, recorded_rows=60, window=20)
    recorded = small.simulate(progress=False)
    cuts = defaultdict(list)
    for run in small.runs():
        if run.repeat < 2 and run.experiment == 2 and run.observed_fraction == 0.3:
            cuts[run.repeat].append([part.fingerprint() for part in small.cut(recorded, run)])
    assert [len(of) for of in cuts.values()] == [len(MODELS)] * 2
    assert all(of == [of[0]] * len(MODELS) for of in cuts.values())
    assert not set(cuts[0][0]) & set(cuts[1][0])


@pytest.mark.parametrize("fraction", FULL.observed_fractions)
def test_parts_are_70_15_15_and_exactly_the_asked_fraction_of_rows_stays(fraction):
    small = replace(FULL, n_trajectories=40, recorded_rows=210)
    run = select(small.runs(), f"experiment=2,fraction={fraction},repeat=3,model=gru")[0]
    parts = small.cut(small.simulate(progress=False), run)
    assert [len(part) for part in parts] == [28, 6, 6]
    for trajectory in (t for part in parts for t in part):
        assert trajectory.rows == 100
        assert trajectory.observed.all(axis=1).sum() == round(100 * fraction)
        assert (trajectory.observed.all(axis=1) == trajectory.observed.any(axis=1)).all()
        assert np.isfinite(trajectory.values).all()


def test_the_tiny_protocol_has_every_kind_of_run_and_enough_repeats_for_the_tests():
    def kinds(protocol):
        runs = protocol.runs()
        return {(run.experiment, run.model, run.observed_fraction) for run in runs}

    tiny = Protocol.tiny()
    assert kinds(tiny) == kinds(FULL)
    assert tiny.repeats >= 3  # Shapiro-Wilk needs three values
    changed = {f.name for f in fields(tiny) if getattr(tiny, f.name) != getattr(FULL, f.name)}
    assert changed == {"n_trajectories", "epochs_of_curves", "repeats", "epochs_of_repeats"}


def test_every_number_of_the_protocol_is_described():
    for field in fields(Protocol):
        assert f"        {field.name}: " in (Protocol.__doc__ or "")


def test_a_protocol_survives_json():
    assert Protocol(**json.loads(json.dumps(asdict(FULL)))) == FULL


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"epochs_of_repeats": (50,)}, "one number for each of the 4"),
        ({"observed_fractions": (0.9, 0.901, 0.5, 0.3)}, "differ by a percent"),
        ({"observed_fractions": (0.9, 0.7, 0.5, 0.0)}, "above 0 and at most 1"),
        ({"repeats": 0}, "repeats must be from 1"),
        ({"epochs_of_curves": 0}, "at least 1"),
    ],
)
def test_a_protocol_that_can_not_be_run_is_refused(changes, said):
    with pytest.raises(ob.InputError, match=said):
        replace(FULL, **changes)


def test_a_filter_joins_values_of_a_key_by_or_and_keys_by_and():
    chosen = select(FULL.runs(), "experiment=1,model=ode_rnn,model=gru, fraction=0.3")
    assert [run.run_id for run in chosen] == ["e1-gru-30-r00", "e1-ode_rnn-30-r00"]
    assert select(FULL.runs(), None) == FULL.runs()
    assert len(select(FULL.runs(), "repeat=9")) == 36


@pytest.mark.parametrize(
    ("only", "said"),
    [
        ("modle=gru", "did you mean 'model'"),
        ("model=gru_faire", "did you mean 'gru_fair'"),
        ("experiment", "expected key=value"),
        ("experiment=one", "must be a number"),
        ("experiment=1,model=gru_fair", "leaves none of the 376 runs"),
    ],
)
def test_a_filter_that_is_not_understood_says_what_is(only, said):
    with pytest.raises(ob.InputError, match=said):
        select(FULL.runs(), only)
