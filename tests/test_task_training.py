"""Training on tasks: errors in units of the best baseline, tasks of every epoch, corrections."""

import json
import math
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch
from task_helpers import SMALL, TASKS, TRAIN, VALIDATION, same, weights

import offbeat as ob
from offbeat.answers.backward import fit_backward
from offbeat.answers.both_sides import reversed_in_time
from offbeat.baselines import AgeBins, LastValue, fit_baseline
from offbeat.baselines.errors import ErrorTable, cells
from offbeat.baselines.stack import fit_stack
from offbeat.config import TaskConfig
from offbeat.data.tasks import TWO_SIDED, draw_tasks
from offbeat.examples import (
    Reference,
    TrainingSet,
    ValidationSet,
    fitted_baselines,
    number_of_tasks,
    reference_tasks,
    relative_loss,
)
from offbeat.models.checkpoint import CONFIG, _digest
from offbeat.models.corrected import CorrectedModel
from offbeat.models.zoo import recipe_of

# --- errors -----------------------------------------------------------------------------------


def test_errors_are_counted_in_the_bin_of_the_time_since_the_last_observation():
    tasks = draw_tasks(TRAIN, TASKS, 20, seed=3)
    bins = AgeBins.of(tasks)
    predicted = fit_baseline("last_value", tasks).predict(tasks)
    batch = ob.Batch.of(tasks, dtype=torch.float64)
    padded = torch.zeros_like(batch.values)
    for row, values in zip(padded, predicted, strict=True):
        row[: len(values)] = torch.from_numpy(values)
    table = ErrorTable.of(padded, batch, bins)
    expected = [[[] for _ in range(3)] for _ in range(len(bins) + 1)]
    for task, values in zip(tasks, predicted, strict=True):
        for c in range(3):
            last = None
            for i, time in enumerate(task.times):
                if i and task.known[i, c]:
                    at = len(bins)
                    if last is not None:
                        at = min(int(np.searchsorted(bins.edges, time - last)), len(bins) - 1)
                    expected[at][c].append((values[i, c] - task.values[i, c]) ** 2)
                if task.observed[i, c]:
                    last = time
    assert table.count.tolist() == [[len(cell) for cell in row] for row in expected]
    for row, errors in zip(table.mse.tolist(), expected, strict=True):
        for mse, cell in zip(row, errors, strict=True):
            assert mse == pytest.approx(np.mean(cell), rel=1e-9) if cell else math.isnan(mse)


def test_each_bin_of_each_channel_has_the_same_weight_in_the_loss():
    bins = AgeBins(np.array([0.1, 0.2]))
    count = torch.tensor([[1000.0, 500.0], [400.0, 500.0], [70.0, 0.0]])
    table = ErrorTable(bins, torch.ones_like(count), count)
    total = table.weights() * count
    assert total[:2].allclose(total[0, 0])
    assert float(total[2, 0]) == pytest.approx(0.25 * float(total[0, 0]) * 70 / 125)
    assert float(total.sum()) == pytest.approx(float(count.sum()))


def test_a_cell_without_errors_takes_the_typical_error_of_its_neighbour():
    bins = AgeBins(np.array([0.1, 0.2, 0.4]))
    nan = math.nan
    mse = torch.tensor([[0.04, nan], [nan, nan], [nan, 0.09], [nan, 0.0]], dtype=torch.float64)
    found = ErrorTable(bins, mse, (~mse.isnan()).double()).typical(torch.tensor([1.0, 2.0]))
    expected = torch.tensor([[0.2, 0.3], [0.2, 0.3], [0.2, 0.3], [1.0, 0.002]])
    assert found.allclose(expected.double())


def test_wild_values_do_not_change_the_typical_error_of_a_channel():
    wild = []
    for t in TRAIN:
        values = t.values.copy()
        values[7, 0] = -999.0
        wild.append(replace(t, values=values, observed=t.observed & (values > -999)))
    model = ob.make_model("gru", TRAIN, **SMALL)
    typical = []
    for data in (TRAIN, ob.Dataset(tuple(wild))):
        tasks = draw_tasks(data, replace(TASKS, shares={"logged": 1.0}), 300, seed=0)
        baselines = [fit_baseline("last_value", tasks)]
        typical.append(Reference.of(baselines, model, tasks).typical[0])
    assert typical[1][1:].allclose(typical[0][1:])
    assert float(typical[1][0]) < 60 * float(typical[0][0])  # the MSE itself grows by 10^6


def test_the_relative_loss_is_the_squared_relative_error_and_linear_beyond_three():
    targets = torch.zeros(1, 3, 1)
    typical = torch.tensor([0.5, 0.1, 2.0]).view(1, 3, 1)
    mean = torch.tensor([0.5, -0.2, 20.0]).view(1, 3, 1)  # 1, 2 and 10 typical errors
    weights = torch.tensor([1.0, 3.0, 2.0]).view(1, 3, 1)
    expected = (1 * 1 + 3 * 4 + 2 * (2 * 3 * 10 - 9)) / 6
    assert float(relative_loss(mean, targets, typical, weights)) == pytest.approx(expected)


def test_the_relative_score_is_the_log_of_a_geometric_mean_of_ratios():
    bins, few = AgeBins(np.array([0.1, 0.2])), torch.ones(3, 2, dtype=torch.float64)
    table = ErrorTable(bins, few, 1e9 * few)
    better = ErrorTable(bins, torch.tensor([[0.25, 1], [1, 4], [9, 9]]).double(), 1e9 * few)
    assert table.relative(table, few) == 0
    assert better.relative(table, few) == pytest.approx(0, abs=1e-6)
    half = ErrorTable(bins, 0.25 * few, 1e9 * few)
    assert half.relative(table, few) == pytest.approx(math.log(0.25), rel=1e-6)
    rare = ErrorTable(bins, 100 * few, few)  # one error per cell says little
    assert 0 < rare.relative(ErrorTable(bins, few, few), few) < math.log(11)


# --- tasks of every epoch ---------------------------------------------------------------------


def test_every_epoch_has_tasks_of_its_own_and_the_same_whenever_it_is_asked_for():
    model = ob.make_model("gru", TRAIN, **SMALL)
    recipe = recipe_of("gru", ob.TrainConfig(tasks=TASKS, tasks_per_epoch=12), validated=True)
    drawn = TrainingSet(model, TRAIN, recipe)
    again = TrainingSet(model, TRAIN, recipe)
    first, second = drawn.epoch(0), drawn.epoch(1)
    assert len(first) == len(drawn) == 12
    assert torch.equal(again.epoch(1).prepared.table, second.prepared.table)
    assert not torch.equal(first.targets[:, :10], second.targets[:, :10])
    drawn.close(), again.close()


def test_long_windows_of_many_channels_have_fewer_tasks_in_an_epoch():
    times = 0.001 * np.arange(20_000)
    one = ob.Dataset((ob.Trajectory(times, np.zeros((20_000, 40))),))
    config = TaskConfig(horizon_s=2.0, gap_s=0.001)  # windows of 8,000 rows
    assert number_of_tasks(one, config, 1024) == 64
    assert number_of_tasks(one, replace(config, window_s=1.0), 1024) == 2**24 // (1000 * 40)
    assert number_of_tasks(TRAIN, TASKS, 1024) == 1024


@pytest.mark.parametrize("name", ["gru", "anchored_ode_gru_d"])
def test_a_training_on_tasks_that_was_killed_ends_as_if_it_had_not_been(name, tmp_path):
    config = ob.TrainConfig(
        tasks=TASKS, epochs=3, tasks_per_epoch=40, batch_size=8, checkpoint_every=2
    )
    options = {"hidden_size": 4, "field_units": (8,)}
    whole = ob.make_model(name, TRAIN, **options)
    expected = ob.fit(whole, TRAIN, VALIDATION, config, progress=False)

    class Killed(BaseException):
        pass

    steps = 0
    import offbeat.training as training

    step = training.train_step

    def killed(*args, **kwargs):
        nonlocal steps
        steps += 1
        if steps == 8:  # in the middle of the second epoch
            raise Killed
        return step(*args, **kwargs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "train_step", killed)
        with pytest.raises(Killed):
            ob.fit(ob.make_model(name, TRAIN, **options), TRAIN, VALIDATION, config, out=tmp_path,
                   progress=False)  # fmt: skip
    resumed = ob.make_model(name, TRAIN, **options)
    result = ob.fit(resumed, TRAIN, VALIDATION, config, out=tmp_path, progress=False)
    assert same(weights(resumed), weights(whole))
    strip = [[replace(r, seconds=0.0) for r in found.history] for found in (result, expected)]
    assert strip[0] == strip[1]
    loaded = ob.load_model(tmp_path)
    task = draw_tasks(VALIDATION, TASKS, 3, seed=5)
    for a, b in zip(ob.predict(resumed, task), ob.predict(loaded, task), strict=True):
        assert np.array_equal(a.values, b.values)


@pytest.mark.parametrize("name", ["anchored_ode_gru_d", "gru_d", "ode_gru_d", "gru"])
def test_a_model_keeps_moving_through_the_longest_silence_of_its_tasks(name, tmp_path):
    """Its clock saturates at a multiple of the longest silence that it knows of."""
    whole = ob.Dataset(tuple(replace(t, observed=None) for t in TRAIN))
    model = ob.make_model(name, whole, **SMALL)
    assert model.statistics.longest_elapsed == pytest.approx(0.05)
    config = ob.TrainConfig(tasks=replace(TASKS, horizon_s=1.0), epochs=1, tasks_per_epoch=8)
    ob.fit(model, whole, config=config, out=tmp_path, progress=False)
    assert model.statistics.longest_elapsed == 1.0
    loaded = ob.load_model(tmp_path)
    cut = draw_tasks(whole, TaskConfig(horizon_s=1.0, gap_s=0.05), 5, shares={"cut": 1.0})
    with torch.no_grad():
        for one in (model, loaded):
            for k, parameter in enumerate(one.parameters()):
                generator = torch.Generator().manual_seed(k)
                parameter.normal_(0, 0.3, generator=generator)
    assert loaded.spec == model.spec
    for a, b, t in zip(ob.predict(model, cut), ob.predict(loaded, cut), cut, strict=True):
        assert np.array_equal(a.values, b.values)
        silent = t.times - t.times[t.observed.any(axis=1)][-1]
        if silent[-1] > 0.5:  # four times the gap of the data would be 0.2 s
            assert not np.allclose(a.values[-1], a.values[np.argmax(silent > 0.3)])


def test_without_options_tasks_bring_a_recipe_with_a_relative_loss():
    recipe = recipe_of("anchored_ode_gru_d", ob.TrainConfig(tasks=TASKS), validated=True)
    assert (recipe.loss, recipe.schedule, recipe.loss_scale) == ("relative", "cosine", 1.0)
    assert recipe.epochs * recipe.tasks_per_epoch / recipe.batch_size > 1000
    plain = recipe_of("anchored_ode_gru_d", ob.TrainConfig(), validated=True)
    assert (plain.loss, plain.tasks) == ("head", None)


def test_a_config_of_tasks_survives_json():
    config = ob.TrainConfig(tasks=replace(TASKS, sensors=(("a",), ("b", "c")), shares=TWO_SIDED))
    assert ob.TrainConfig(**asdict(config)) == config
    with pytest.raises(ob.InputError, match="sum to 1"):
        TaskConfig(horizon_s=1, gap_s=0.1, shares={"cut": 0.5})
    with pytest.raises(ob.InputError, match="unknown key of TaskConfig"):
        ob.TrainConfig(tasks={"horizon": 1.0})


def test_the_relative_loss_learns_a_quiet_channel_that_the_mse_does_not_see():
    """A slow wave of a thousandth of the amplitude of the others, which are noise."""
    random = np.random.default_rng(0)
    times = 0.05 * np.arange(200)
    trajectories = []
    for _ in range(8):
        ramp = 0.001 * np.sin(times + random.uniform(0, 6))
        noise = random.normal(size=(200, 2))
        values = np.column_stack([ramp, noise])
        trajectories.append(ob.Trajectory(times, values, names=("slow", "n1", "n2")))
    data = ob.Dataset(tuple(trajectories))
    scores = {}
    for loss in ("head", "relative"):
        model = ob.make_model("gru", data, scaler="identity", seed=0, hidden_size=8)
        tasks = replace(TASKS, shares={"logged": 1.0})
        config = ob.TrainConfig(
            tasks=tasks, loss=loss, epochs=8, tasks_per_epoch=320, learning_rate=0.01
        )
        ob.fit(model, data, data, config, progress=False)
        scores[loss] = ob.evaluate(model, data).scores["gru"]
    slow = {k: s.after_first_observation.per_channel[0] for k, s in scores.items()}
    assert slow["relative"] < 0.5 * slow["head"]


# --- the score --------------------------------------------------------------------------------


def test_the_score_of_a_validation_set_is_0_for_the_best_baseline_itself():
    recipe = recipe_of("gru", ob.TrainConfig(tasks=TASKS), validated=True)
    model = ob.make_model("gru", TRAIN, **SMALL)
    fitted, measured = reference_tasks(TRAIN, recipe)
    last = fit_baseline("last_value", fitted)
    reference = Reference.of([last], model, measured)

    class Repeats(ob.BaseModel):
        def forward(self, batch):
            before = torch.from_numpy(model.scaler.scaled(last.mean)).float()
            return ob.Prediction(ob.last_values(batch.values, batch.mask, before=before))

    repeats = Repeats("repeats", model.data)
    found = ValidationSet.of(repeats, VALIDATION, recipe, reference=reference).judge(repeats)
    assert found.relative == pytest.approx(0, abs=1e-5)
    every = Reference.of(fitted_baselines(fitted), model, measured)
    found = ValidationSet.of(repeats, VALIDATION, recipe, reference=every).judge(repeats)
    assert found.relative > 0.1


def test_the_log_has_the_score_and_the_best_epoch_is_the_one_that_is_kept(tmp_path):
    model = ob.make_model("gru", TRAIN, **SMALL)
    config = ob.TrainConfig(tasks=TASKS, epochs=3, tasks_per_epoch=32)
    result = ob.fit(model, TRAIN, VALIDATION, config, out=tmp_path, progress=False)
    scores = [record.validation_score for record in result.history]
    assert all(math.isfinite(score) for score in scores)
    assert result.validation_score == min(scores)
    assert scores.index(min(scores)) == result.best_epoch - 1
    assert "validation_score" in (tmp_path / "log.csv").read_text().splitlines()[0]


def test_a_backward_model_is_trained_on_tasks_of_fills_from_both_sides():
    model = ob.make_model("anchored_ode_gru_d", TRAIN, **SMALL)
    config = ob.TrainConfig(tasks=TASKS, epochs=2, tasks_per_epoch=24)
    back, result = fit_backward(model, TRAIN, VALIDATION, config, progress=False)
    assert result.recipe.tasks == replace(TASKS, shares=TWO_SIDED)
    alone = ob.make_model(model.config, reversed_in_time(TRAIN), scaler=model.scaler)
    given = replace(config, tasks=replace(TASKS, shares=TWO_SIDED))
    parts = reversed_in_time(TRAIN), reversed_in_time(VALIDATION)
    ob.fit(alone, *parts, given, progress=False)
    assert same(weights(alone), weights(back))


# --- corrections ------------------------------------------------------------------------------


def corrected(base: str, data: ob.Dataset = TRAIN, **options) -> CorrectedModel:
    inner = ob.make_model(options.pop("name", "gru"), data, **{**SMALL, **options})
    tasks = draw_tasks(data, TASKS, 100, seed=9)
    return CorrectedModel.of(inner, fit_baseline(base, tasks), tasks)


@pytest.mark.parametrize("name", ["gru", "ode_gru_d"])
@pytest.mark.parametrize("base", ["last_value", "damped_slope", "kalman_short"])
def test_a_model_that_corrects_a_baseline_starts_as_the_baseline(base, name):
    model = corrected(base, name=name)
    tasks = draw_tasks(VALIDATION, TASKS, 12, seed=7)
    expected = model.base.predict(tasks)
    for ours, theirs in zip(ob.predict(model, tasks), expected, strict=True):
        np.testing.assert_allclose(ours.values, theirs, atol=1e-5)


def test_a_corrected_baseline_gets_better_is_saved_and_resumed(tmp_path):
    tasks = draw_tasks(VALIDATION, TASKS, 30, seed=7)
    config = ob.TrainConfig(tasks=TASKS, epochs=8, tasks_per_epoch=256, learning_rate=0.01)
    options = {"hidden_size": 16, "decoder_units": (16,)}
    model = corrected("last_value", **options)

    def error() -> float:
        """Of the two channels that are not noise."""
        found = ob.evaluate({"model": model}, tasks).scores["model"].after_first_observation
        return sum(found.per_channel[:2])

    start = error()
    ob.fit(model, TRAIN, VALIDATION, config, out=tmp_path, progress=False)
    assert error() < 0.5 * start
    loaded = ob.load_model(tmp_path)
    assert isinstance(loaded, CorrectedModel)
    assert loaded.options == model.options
    for a, b in zip(ob.predict(model, tasks), ob.predict(loaded, tasks), strict=True):
        assert np.array_equal(a.values, b.values)
    again = corrected("last_value", **options)
    ob.fit(again, TRAIN, VALIDATION, config, out=tmp_path, progress=False)
    assert same(weights(again), weights(model))
    other = corrected("damped_slope", **options)
    with pytest.raises(ob.InputError, match="holds another run"):
        ob.fit(other, TRAIN, VALIDATION, config, out=tmp_path, progress=False)


def test_a_stack_of_baselines_can_be_corrected_and_saved(tmp_path):
    parts = [draw_tasks(data, TASKS, 60, seed=3) for data in (TRAIN, VALIDATION)]
    stack, *_ = fit_stack(("last_value", "damped_slope"), *parts, span_s=50.0, gap_s=0.05)
    model = CorrectedModel.of(ob.make_model("gru", TRAIN, **SMALL), stack, parts[0])
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.normal_(generator=torch.Generator().manual_seed(1))
    model.save(tmp_path / "model")
    loaded = ob.load_model(tmp_path / "model")
    for a, b in zip(ob.predict(model, parts[1]), ob.predict(loaded, parts[1]), strict=True):
        assert np.array_equal(a.values, b.values)


def test_a_requested_time_changes_no_other_prediction_of_a_corrected_baseline():
    model = corrected("damped_slope", name="gru")
    with torch.no_grad():
        for parameter in model.inner.parameters():
            parameter.add_(0.1)
    data = ob.Dataset((VALIDATION[0],))
    end = float(data[0].times[-1])
    few = ob.predict(model, data, times=[end + 0.5])[0].values
    many = ob.predict(model, data, times=[end + 0.2, end + 0.5])[0].values
    np.testing.assert_allclose(few[0], many[1], atol=1e-6)
    assert not np.allclose(many[0], many[1])


@pytest.mark.parametrize("name", ["gru", "ode_gru_d", "anchored_ode_gru_d", "anchored_trend"])
@pytest.mark.parametrize("base", ["damped_slope", "kalman_short"])
def test_a_stream_predicts_what_the_batch_does(base, name):
    model = corrected(base, name=name)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator))
    task = draw_tasks(VALIDATION, TASKS, 4, seed=6, shares={"silence": 1.0})[0]
    expected = ob.predict(model, ob.Dataset((task,)))[0].values
    stream = ob.Stream(model)
    for i, time in enumerate(task.times):
        if i:
            np.testing.assert_allclose(stream.predict(time), expected[i], atol=2e-6)
        stream.observe(time, np.where(task.observed[i], task.values[i], np.nan))
        if i == 20:
            again = ob.Stream(model)
            again.restore(stream.state())
            after = time + 0.03
            assert np.array_equal(again.predict(after), stream.predict(after))


def test_a_backward_model_corrects_the_same_baseline_fitted_to_reversed_tasks():
    model = corrected("damped_slope")
    config = ob.TrainConfig(tasks=TASKS, epochs=1, tasks_per_epoch=16)
    back, _ = fit_backward(model, TRAIN, VALIDATION, config, progress=False)
    assert isinstance(back, CorrectedModel)
    assert back.inner.config == model.inner.config
    assert not np.array_equal(back.base.factor, model.base.factor)


def test_an_anchored_model_is_joined_with_the_baseline_by_a_gate_per_time_and_channel():
    model = corrected("damped_slope", name="anchored_ode_gru_d").double()
    bins = len(model.bins)
    task = draw_tasks(VALIDATION, TASKS, 5, seed=3)
    batch = model.batch(task)
    base, alone = model.predicted_by_base(batch), model.inner(batch).mean
    with torch.no_grad():
        model.gate.fill_(-50.0)
    assert torch.equal(model(batch).mean, base)
    with torch.no_grad():
        model.gate.fill_(50.0)
    torch.testing.assert_close(model(batch).mean, alone)
    with torch.no_grad():
        model.gate.fill_(-50.0)
        model.gate[bins - 1, 1] = 0.0  # the longest times of the second channel
    expected = base.clone()
    at = cells(batch, model.bins)[..., 1] == bins - 1
    expected[..., 1][at] = (0.5 * (base + alone))[..., 1][at]
    torch.testing.assert_close(model(batch).mean, expected)


def test_a_gate_closes_where_the_baseline_is_exact_and_opens_where_it_is_wrong():
    """Lines, which constant velocity continues exactly, and waves that it does not follow."""
    times = 0.05 * np.arange(120)
    random = np.random.default_rng(0)
    lines = ob.Dataset(
        tuple(
            ob.Trajectory(
                times,
                np.column_stack(
                    [random.uniform(-1, 1) * times, np.sin(6 * times + random.uniform(0, 6))]
                ),
            )
            for _ in range(6)
        )
    )
    model = corrected("constant_velocity", lines, name="anchored_ode_gru_d", hidden_size=8)
    config = ob.TrainConfig(tasks=TASKS, epochs=10, tasks_per_epoch=160, learning_rate=0.02)
    ob.fit(model, lines, lines, config, progress=False)
    line, wave = torch.sigmoid(model.gate.detach())[len(model.bins) - 1].tolist()
    start = 1 / (1 + math.exp(-1))
    assert line < start < wave


def test_a_gated_model_is_saved_and_read(tmp_path):
    model = corrected("damped_slope", name="anchored_ode_gru_d")
    with torch.no_grad():
        model.gate.uniform_(-2, 2, generator=torch.Generator().manual_seed(0))
    model.save(tmp_path / "model")
    loaded = ob.load_model(tmp_path / "model")
    for a, b in zip(ob.predict(model, VALIDATION), ob.predict(loaded, VALIDATION), strict=True):
        assert np.array_equal(a.values, b.values)


def test_a_file_of_before_an_option_was_added_is_read_as_what_it_did(tmp_path):
    model = corrected("damped_slope", nodes="rows", bounded=False)
    model.save(tmp_path)
    record = json.loads((tmp_path / CONFIG).read_text())
    for option in ("nodes", "bounded", "trend"):
        del record["model"]["inner"][option]
    del record["config_sha256"]
    record["config_sha256"] = _digest(record)
    (tmp_path / CONFIG).write_text(json.dumps(record))
    loaded = ob.load_model(tmp_path)
    assert loaded.options == model.options
    batch = model.batch(TRAIN)
    assert torch.equal(loaded(batch).mean, model(batch).mean)


def test_cells_are_the_bins_that_baselines_use():
    tasks = draw_tasks(TRAIN, TASKS, 5, seed=1)
    batch, bins = ob.Batch.of(tasks), AgeBins.of(tasks)
    found = cells(batch, bins)
    assert int(found[:, 0].min()) == len(bins)
    last = LastValue().fit(tasks)
    state = last.start(torch.zeros(5, 3, dtype=torch.float64))
    for i in range(batch.rows):
        time = batch.times[:, i, None]
        age = last.history.age(state, time)
        expected = torch.where(age.isinf(), len(bins), bins.of_age(age))
        inside = batch.valid[:, i]
        assert torch.equal(found[inside, i], expected[inside])
        state = last.observe(state, time, batch.values[:, i].double(), batch.mask[:, i])
