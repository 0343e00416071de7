"""Windows and masks that are drawn anew in each epoch."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from task_helpers import SMALL, TRAIN, VALIDATION, same, weights

import offbeat as ob
from offbeat.config import RedrawConfig
from offbeat.data.redraw import redraw
from offbeat.examples import AHEAD, Examples, RedrawnExamples, TrainingSet, longest_silence
from offbeat.models.zoo import recipe_of


def grid(n: int, rows: int, channels: int = 3, *, observed: float = 1.0) -> ob.Dataset:
    """Trajectories whose values say where they stand; of different lengths unless complete."""
    random, made = np.random.default_rng(0), []
    for i in range(n):
        length = rows - (i % 4 if observed < 1 else 0)
        values = i + np.arange(length)[:, None] / 256 + np.arange(channels) / 4096
        shown = random.random((length, channels)) < observed
        made.append(ob.Trajectory(np.arange(length) / 4, values, shown))
    return ob.Dataset(tuple(made))


@pytest.mark.parametrize("mask", ["rows", "values"])
def test_exactly_the_fraction_of_what_was_observed_stays_in_each_window(mask):
    data = grid(40, 30, observed=0.8)
    config = RedrawConfig((0.3, 0.9), window=20, mask=mask)
    drawn = redraw(ob.Batch.of(data, dtype=torch.float64), config, seed=1)
    used = set()
    for i, window in enumerate(drawn.dataset(data)):
        start = int(drawn.start[i])
        source = data[i].slice(start, start + 20)
        assert window.rows == 20
        assert np.array_equal(window.values, source.values)
        assert not (window.observed & ~source.observed).any()
        if mask == "rows":
            before, after = source.observed.any(axis=1).sum(), window.observed.any(axis=1).sum()
            kept = window.observed.any(axis=1)
            assert np.array_equal(window.observed[kept], source.observed[kept])
        else:
            before, after = source.observed.sum(axis=0), window.observed.sum(axis=0)
        fits = [f for f in (0.3, 0.9) if np.array_equal(after, (before * f).astype(int))]
        assert len(fits) == 1
        used |= set(fits)
    assert used == {0.3, 0.9}


def test_every_start_and_every_row_is_as_likely_as_the_others():
    data = ob.Dataset((ob.Trajectory(np.arange(8.0), np.zeros((8, 1))),) * 4000)
    drawn = redraw(ob.Batch.of(data), RedrawConfig((0.5,), window=6), seed=3)
    starts = np.bincount(drawn.start.numpy(), minlength=3)
    assert len(starts) == 3
    assert abs(starts - 4000 / 3).max() < 5 * np.sqrt(4000 * 2 / 9)
    kept = drawn.mask[..., 0].sum(dim=0).numpy()
    assert abs(kept - 2000).max() < 5 * np.sqrt(1000)
    # All 20 choices of three rows out of six, not runs alone.
    codes = (drawn.mask[..., 0].numpy() * 2 ** np.arange(6)).sum(axis=1)
    _, counts = np.unique(codes, return_counts=True)
    assert len(counts) == 20
    assert abs(counts - 200).max() < 5 * np.sqrt(200)


def test_a_batch_of_windows_is_that_of_the_same_windows_as_trajectories():
    data = grid(12, 30, observed=0.8)
    model = ob.make_model("gru", data, **SMALL)
    drawn = redraw(model.batch(data), RedrawConfig((0.5,), window=28), seed=5)
    index = torch.tensor([3, 0, 7])  # of 27, 28 and 27 rows
    got, expected = drawn.take(index), model.batch(drawn.dataset(data).take(index.tolist()))
    assert got.rows == 28
    for name in ("times", "mask", "known", "valid"):
        assert torch.equal(getattr(got, name), getattr(expected, name)), name
    shown = expected.valid[..., None]
    assert torch.equal(got.values * shown, expected.values)


@pytest.mark.parametrize("name", ["gru", "gru_d", "ode_gru_d", "anchored_ode_gru_d"])
@pytest.mark.parametrize("observed", [0.8, 1.0])
def test_the_loss_is_that_of_the_same_windows_in_memory(name, observed):
    data = grid(12, 30, observed=observed)
    model = ob.make_model(name, data, **SMALL)
    drawn = redraw(model.batch(data), RedrawConfig((0.5,), window=28), seed=5)
    whole = Examples(model, model.batch(drawn.dataset(data)))
    order = torch.randperm(12, generator=torch.Generator().manual_seed(0))
    examples = RedrawnExamples(drawn, order)
    # In turn, again from the first one, from within (a training that is resumed), out of turn.
    for index in (order[:3], order[3:5], order[5:], order[:1], order[7:8], order[[2, 9]]):
        expected = whole.loss(model, index, None)
        assert torch.equal(examples.loss(model, index, None), expected)


def test_inputs_of_a_few_batches_are_computed_together(monkeypatch):
    data = grid(40, 30)
    model = ob.make_model("gru", data, **SMALL)
    drawn, order = redraw(model.batch(data), RedrawConfig((0.5,))), torch.arange(40)
    asked: list[int] = []
    prepare = model.prepare
    monkeypatch.setattr(model, "prepare", lambda batch: asked.append(len(batch)) or prepare(batch))
    examples = RedrawnExamples(drawn, order)
    for first in range(0, 40, 4):
        examples.loss(model, order[first : first + 4], None)
    assert asked == [4 * AHEAD, 40 - 4 * AHEAD]


def test_every_epoch_has_masks_of_its_own_and_the_same_whenever_it_is_asked_for():
    model = ob.make_model("gru", TRAIN, **SMALL)
    config = ob.TrainConfig(redraw=RedrawConfig((0.5,), window=50), seed=4)
    recipe = recipe_of("gru", config, validated=True)
    drawn, again = TrainingSet(model, TRAIN, recipe), TrainingSet(model, TRAIN, recipe)
    index = torch.arange(len(TRAIN))
    losses = [drawn.epoch(i).loss(model, index, None).detach() for i in range(3)]
    assert len(drawn) == len(TRAIN)
    assert len({float(loss) for loss in losses}) == 3
    assert torch.equal(again.epoch(2).loss(model, index, None).detach(), losses[2])
    drawn.close(), again.close()


def test_whole_trajectories_with_everything_observed_train_as_without_redrawing():
    results = []
    for option in (None, RedrawConfig((1.0,))):
        model = ob.make_model("anchored_ode_gru_d", TRAIN, **SMALL)
        config = ob.TrainConfig(epochs=2, batch_size=4, redraw=option)
        ob.fit(model, TRAIN, VALIDATION, config, progress=False)
        results.append(weights(model))
    assert same(*results)


def test_a_training_on_fresh_masks_that_was_killed_ends_as_if_it_had_not_been(tmp_path):
    config = ob.TrainConfig(
        redraw=RedrawConfig((0.3, 0.7), window=60), epochs=3, batch_size=2, checkpoint_every=2
    )
    expected = ob.make_model("anchored_ode_gru_d", TRAIN, **SMALL)
    ob.fit(expected, TRAIN, VALIDATION, config, progress=False)

    class Killed(BaseException):
        pass

    calls = 0

    def killed(*_):
        nonlocal calls
        calls += 1
        if calls in (5, 7):
            raise Killed
        return step(*_)

    for _ in range(3):
        model = ob.make_model("anchored_ode_gru_d", TRAIN, **SMALL)
        step = model.loss
        model.loss = killed
        try:
            ob.fit(model, TRAIN, VALIDATION, config, out=tmp_path / "run", progress=False)
        except Killed:
            continue
    assert calls > 9
    assert same(weights(model), weights(expected))
    other = replace(config, redraw=RedrawConfig((0.3,), window=60))
    with pytest.raises(ob.InputError, match="the options of the training differ"):
        ob.fit(
            ob.make_model("anchored_ode_gru_d", TRAIN, **SMALL),
            TRAIN,
            VALIDATION,
            other,
            out=tmp_path / "run",
            progress=False,
        )


def test_a_model_of_whole_trajectories_learns_of_the_silences_that_it_will_meet():
    data = grid(20, 30)
    config = ob.TrainConfig(epochs=1, redraw=RedrawConfig((0.1,)))
    silence = longest_silence(data, config.redraw, seed=0)
    assert 0.25 * 10 < silence < 0.25 * 30  # 27 of 30 rows are masked
    model = ob.make_model("anchored_ode_gru_d", data, **SMALL)
    assert model.statistics.longest_elapsed == 0.25
    ob.fit(model, data, config=config, progress=False)
    assert model.statistics.longest_elapsed == silence


def test_the_relative_loss_is_in_units_of_baselines_on_masked_windows():
    config = ob.TrainConfig(epochs=6, redraw=RedrawConfig((0.5,), window=60), loss="relative")
    config = replace(config, batch_size=2, learning_rate=0.01)
    model = ob.make_model("anchored_ode_gru_d", TRAIN, **SMALL)
    masked = ob.mask_out(VALIDATION, 0.5)
    history = ob.fit(model, TRAIN, masked, config, progress=False).history
    assert history[-1].validation_score < history[0].validation_score


def test_actions_are_never_masked():
    data = grid(5, 20)
    roles = ("state", "action", "exogenous")
    data = ob.Dataset(tuple(replace(t, roles=roles) for t in data))
    for mask in ("rows", "values"):
        drawn = redraw(ob.Batch.of(data), RedrawConfig((0.5,), window=10, mask=mask))
        for window in drawn.dataset(data):
            assert window.observed.sum(axis=0).tolist() == [5, 10, 10]
    none = ob.Dataset(tuple(replace(t, roles=("action",) * 3) for t in data))
    with pytest.raises(ob.InputError, match="no channel has the role 'state'"):
        redraw(ob.Batch.of(none), RedrawConfig((0.5,)))


def test_a_config_survives_json_and_bad_ones_are_refused():
    config = ob.TrainConfig(redraw=RedrawConfig((0.3, 0.9), window=100))
    assert ob.TrainConfig(**json.loads(json.dumps(asdict(config)))) == config
    tasks = ob.TaskConfig(horizon_s=1.0, gap_s=0.1)
    with pytest.raises(ob.InputError, match="give one of the two"):
        ob.TrainConfig(tasks=tasks, redraw=config.redraw)
    for bad in ((), (0.0,), (1.1,), 0.3, ("a",)):
        with pytest.raises(ob.InputError, match="observed_fractions must be a list of fractions"):
            RedrawConfig(bad)
    with pytest.raises(ob.InputError, match="window must be an integer of at least 2"):
        RedrawConfig((0.5,), window=1)
    with pytest.raises(ob.InputError, match="rows"):
        RedrawConfig((0.5,), mask="row")
