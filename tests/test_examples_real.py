import json
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.stats import norm

import offbeat as ob
from examples.documents import between
from examples.real_logs import logs, predictors, report, results, scores, tasks
from examples.real_logs.__main__ import main
from offbeat.answers.scoring import score_one_step
from offbeat.baselines import fit_baseline
from offbeat.data import arm_log

HORIZONS = ["forecast 0.1 s", "forecast 0.2 s", "forecast 0.5 s", "forecast 1 s"]


@pytest.fixture
def log_of():
    """A log by name; skips where it is not on this machine."""

    def read(name, quick=False):
        try:
            return logs.LOGS[name](quick)
        except logs.MissingLogError as error:
            pytest.skip(str(error))

    return read


def scored(log, test, task, predictor):
    (asked,) = [each for each in log.asked[test] if each.name == task]
    fitted = fit_baseline(predictor, log.training_windows)
    return scores.score(asked, fitted, log.scale)


# --- published numbers ----------------------------------------------------------------------------

# Scaled RMSE that versions before this harness printed, by code of their own.
PUBLISHED = {
    "lasa": {
        "last_value": {"one step": 0.0924, "fill 0.5 s": 0.529}
        | dict(zip(HORIZONS, [0.219, 0.379, 0.722, 1.188], strict=True)),
        "constant_velocity": {"one step": 0.0595}
        | dict(zip(HORIZONS, [0.214, 0.417, 0.892, 2.054], strict=True)),
        "linear": {"fill 0.5 s": 0.26},
        "pchip": {"fill 0.5 s": 0.268},
    },
    "g1": {
        "last_value": {"one step": 0.0541, "fill 0.5 s": 0.226}
        | dict(zip(HORIZONS, [0.0784, 0.15, 0.333, 0.569], strict=True)),
        "constant_velocity": {"one step": 0.0522}
        | dict(zip(HORIZONS, [0.0577, 0.144, 0.398, 0.676], strict=True)),
        "linear": {"fill 0.5 s": 0.0563},
        "pchip": {"fill 0.5 s": 0.046},
    },
    "px4": {
        "last_value": {"one step": 0.376, "fill 0.1 s": 1.7}
        | dict(zip(HORIZONS, [1.44, 1.62, 2.36, 2.24], strict=True)),
        "constant_velocity": dict(zip(HORIZONS, [14, 8.1, 41.7, 53.8], strict=True)),
        "linear": {"fill 0.1 s": 1},
        "pchip": {"fill 0.1 s": 0.898},
    },
    "hopper": {
        "linear": {"fill 70 % of the rows": 0.1438},
        "pchip": {"fill 70 % of the rows": 0.1326},
    },
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_baselines_have_the_published_errors(name, log_of):
    log = log_of(name)
    test = next(iter(log.tests))
    for predictor, expected in PUBLISHED[name].items():
        for task, value in expected.items():
            digits = len(f"{value:g}".split(".")[-1]) if value != int(value) else 0
            found = scored(log, test, task, predictor)["rmse_scaled"]
            assert round(found, digits) == value, (predictor, task)


@pytest.fixture(scope="module")
def quick_lasa():
    log = logs.lasa(True)
    return log, predictors.offbeat(log, 0, True)["offbeat"].blend


def test_scores_are_those_of_the_library(quick_lasa):
    log, blend = quick_lasa
    test = log.tests["test"]
    asked = {task.name: task for task in log.asked["test"]}
    causal = predictors.Blended(blend, causal=True)
    both = predictors.Blended(blend, causal=False)

    def same(task, predictor, expected, name):
        found = scores.score(asked[task], predictor, log.scale)
        # The library computes in float32 where a model is asked in batches.
        assert found["rmse"] == pytest.approx(expected.rmse[name], rel=1e-5)
        assert scores.counts(asked[task]) == list(expected.counts)

    last = fit_baseline("last_value", log.training_windows)
    one = score_one_step(blend, test)
    same("one step", causal, one, "blend")
    same("one step", last, one, "last_value")
    for predictor, mode in ((causal, "causal"), (both, "two_sided")):
        masked = asked["fill 0.5 s"].dataset
        filled = ob.score_imputation(blend, masked, mode=mode).scores
        same("fill 0.5 s", predictor, filled, "blend")
    for horizon, ahead in zip(
        HORIZONS, ob.score_forecast(blend, test, logs.HORIZONS_S, targets=12), strict=True
    ):
        same(horizon, causal, ahead, "blend")
        same(horizon, last, ahead, "last_value")


# --- tasks ----------------------------------------------------------------------------------------


def test_a_forecast_ends_the_horizon_before_its_row():
    times = np.array([0.0, 0.1, 0.25, 0.3, 0.5, 0.9])
    values = np.arange(12.0).reshape(6, 2)
    values[:4, 1] = np.nan  # the second channel starts at 0.5 s
    data = ob.Dataset((ob.Trajectory(times, values),))
    task = tasks.forecasts(data, 0.2, targets=10)
    # Rows at 0.25, 0.3, 0.5 and 0.9 s have a row at least 0.2 s before them.
    assert [t.times.tolist() for t in task.dataset] == [
        [0.0, 0.25],
        [0.0, 0.1, 0.3],
        [0.0, 0.1, 0.25, 0.3, 0.5],
        [0.0, 0.1, 0.25, 0.3, 0.5, 0.9],
    ]
    for t, mask in zip(task.dataset, task.scored, strict=True):
        assert not t.observed[-1].any()
        assert t.observed[:-1, 0].all()
        assert not mask[:-1].any()
    # The second channel counts where it was observed before.
    assert [mask[-1].tolist() for mask in task.scored] == [[True, False]] * 3 + [[True, True]]


def test_one_step_counts_what_is_known_after_the_first_observation():
    values = np.array([[1.0, np.nan], [2.0, 5.0], [np.nan, 6.0]])
    task = tasks.one_step(ob.Dataset((ob.Trajectory(np.arange(3.0), values),)))
    assert task.scored[0].tolist() == [[False, False], [True, False], [False, True]]


# --- scores ---------------------------------------------------------------------------------------


@dataclass
class Fixed:
    values: list
    causal = True

    def predict(self, dataset):
        return self.values


class Gaussian(Fixed):
    def quantiles(self, dataset, levels):
        return [v[..., None] + norm.ppf(levels) for v in self.values]


def noise(rows):
    values = np.random.default_rng(0).normal(size=(rows, 1))
    data = ob.Dataset((ob.Trajectory(np.arange(float(rows)), values),))
    return tasks.Task("noise", data, (np.ones((rows, 1), dtype=bool),))


def test_errors_are_root_mean_squares_over_scored_values():
    values = np.array([[1.0, 10.0], [2.0, 20.0]])
    data = ob.Dataset((ob.Trajectory([0.0, 1.0], values), ob.Trajectory([0.0, 1.0], values)))
    mask = np.array([[False, False], [True, True]])
    task = tasks.Task("by hand", data, (mask, mask & [True, False]))
    predicted = [np.array([[99.0, 99.0], [5.0, 12.0]]), np.array([[99.0, 99.0], [6.0, 99.0]])]
    found = scores.score(task, Fixed(predicted), np.array([1.0, 4.0]))
    # errors 3 and 4 in the first channel, -8 in the second, which are two scaled units
    assert found["rmse"] == pytest.approx([math.sqrt(12.5), 8.0])
    assert found["rmse_scaled"] == pytest.approx(math.sqrt((9 + 16 + 4) / 3))
    assert scores.counts(task) == [2, 1]


def test_a_prediction_that_is_missing_is_refused():
    task = noise(3)
    with pytest.raises(ob.InputError, match="1 of 3 predictions are not finite"):
        scores.score(task, Fixed([np.array([[0.0], [np.nan], [0.0]])]), np.ones(1))


def test_quantiles_of_the_right_distribution_cover_and_have_its_crps():
    task = noise(40_000)
    found = scores.score(task, Gaussian([np.zeros((40_000, 1))]), np.ones(1))
    for wide, coverage in found["coverage"].items():
        assert coverage == pytest.approx(float(wide), abs=0.01)
    alpha, half = 0.05, norm.ppf(0.975)
    score = 4 * norm.pdf(half) / alpha  # its expectation
    assert found["interval_score_scaled"]["0.95"] == pytest.approx(score, rel=0.02)
    assert found["widths_scaled"] == {
        "1.28": pytest.approx(2 * norm.ppf(0.95))
    }  # rows are 1 s apart
    # E CRPS of N(0, 1) for y ~ N(0, 1) is 1 / sqrt(pi); the steps of 2.5 % cost less than 1 %.
    assert found["crps_scaled"] == pytest.approx(1 / math.sqrt(math.pi), rel=0.015)


def test_crps_is_in_scaled_units_and_grows_with_the_error():
    quantiles = norm.ppf(scores.LEVELS)
    at = np.array([0.0, 1.0, 3.0])
    for y in at:
        # Gneiting and Raftery 2007, equation 21
        closed = y * (2 * norm.cdf(y) - 1) + 2 * norm.pdf(y) - 1 / math.sqrt(math.pi)
        found = scores.intervals(np.array([y]), quantiles[None], np.ones(1))["crps_scaled"]
        assert found == pytest.approx(closed, rel=0.02)


def test_wins_ties_and_losses_have_a_band_of_two_percent():
    found = scores.Against.of(np.array([0.97, 0.985, 1.0, 1.015, 1.03, 2.0]))
    assert (found.wins, found.ties, found.losses, found.worst) == (1, 3, 2, 2.0)
    assert found.geometric_mean == pytest.approx(
        (0.97 * 0.985 * 1.0 * 1.015 * 1.03 * 2.0) ** (1 / 6)
    )


def test_ratios_are_to_the_best_of_others_in_each_channel():
    errors = {"a": [1.0, 4.0, 0.0, np.nan], "b": [2.0, 2.0, 0.0, np.nan]}
    errors["model"] = [0.5, 3.0, 0.0, np.nan]
    # A channel that never moves has no error, one without values is left out.
    assert scores.ratios(errors, "model", ["a", "b"]).tolist() == [0.5, 1.5, 1.0]
    assert scores.ratios(errors, "a", ["a", "b"]).tolist() == [1.0, 2.0, 1.0]


# --- the command ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    out = tmp_path_factory.mktemp("real")
    page = out / "page.md"
    page.write_text("Before.\n<!-- lasa -->\nold\n<!-- end of lasa -->\nAfter.\n")
    asked = ["--quick", "--log", "lasa", "--seeds", "2", "--out", str(out)]
    main([*asked, "--document", str(page), "--figures", str(out)])
    return out, asked


def test_the_command_scores_every_predictor_on_every_task(ran):
    out, _ = ran
    first, second = (
        json.loads((out / "lasa" / f"quick_seed{seed}.json").read_text()) for seed in (0, 1)
    )
    known = {name for entry in predictors.PREDICTORS.values() for name in entry.names}
    assert set(first["predictors"]) == known
    assert set(second["predictors"]) == known - set(predictors.UNFITTED)
    for result in first["predictors"].values():
        found = result["scores"]["test"]
        fills = ["fill 0.1 s", "fill 0.5 s"]
        assert list(found) == (["one step", *fills, *HORIZONS] if result["causal"] else fills)
        assert all(0 < each["rmse_scaled"] < math.inf for each in found.values())
    assert first["machine"]["offbeat"]
    for figure in ("real_lasa.png", "calibration_lasa.png"):
        assert (out / figure).read_bytes().startswith(b"\x89PNG")


def test_lines_of_a_table_are_root_mean_squares_over_the_values_of_their_channels(ran):
    out, _ = ran
    summary = results.Summary([out / "lasa" / "quick_seed0.json"])
    n, each = summary.counts("test", "fill 0.5 s"), summary.rmse("test", "fill 0.5 s", "linear")
    at = [summary.head["channels"].index(name) for name in ("vx", "vy")]
    expected = math.sqrt(sum(n[at] * each[at] ** 2) / sum(n[at]))
    found = summary.grouped("test", "fill 0.5 s", "linear")
    assert found["velocity, mm/s"] == pytest.approx(expected, rel=1e-12)


def test_intervals_of_a_blend_are_scored(ran):
    out, _ = ran
    summary = results.Summary([out / "lasa" / "quick_seed0.json"])
    for task in summary.tasks("test"):
        found = summary.intervals("test", task, "offbeat_blend")
        coverage, crps = found.coverage, found.crps
        assert 0 <= coverage["0.5"] <= coverage["0.8"] <= coverage["0.95"] <= 1
        # The mean absolute error of the point forecast is the CRPS without a spread, and the RMSE
        # is not less than that.
        (rmse,) = summary.scaled("test", task, "offbeat_blend")
        assert 0 < crps < rmse
        assert set(found.score) == set(coverage)
        assert found.score["0.95"] > 0
        assert all(width > 0 for width in found.widths.values())
    assert summary.intervals("test", "one step", "last_value") is None
    assert "| Offbeat blend |" in report.intervals(summary, "test")


def test_quantiles_of_a_blend_are_the_ends_of_its_intervals():
    log = logs.lasa(True)
    blend = predictors.blend_of_baselines(log, 0, True)["offbeat_blend"]
    part = log.tests["test"]
    found = blend.quantiles(part, np.array([0.05, 0.5, 0.95]))
    for quantiles, answer in zip(found, blend.blend.causal(part), strict=True):
        low, high = answer.interval(0.9)
        assert np.allclose(quantiles, np.stack([low, answer.values, high], axis=2))


def test_the_document_shows_the_best_baselines_and_all_of_offbeat(ran):
    summary = results.Summary([ran[0] / "lasa" / "quick_seed0.json"])
    names = report.shown(summary, "test")
    assert [n for n in names if n.startswith("offbeat")] == [
        "offbeat_blend",
        "offbeat",
        "offbeat_model",
        "offbeat_blend_two_sided",
        "offbeat_two_sided",
        "offbeat_models_two_sided",
    ]
    best, _ = (n for n in names if not n.startswith("offbeat"))
    means = {
        name: report.against(summary, "test", name, simple=True)[1].geometric_mean
        for name in summary.predictors
        if summary.causal(name) and not name.startswith("offbeat")
    }
    assert means[best] == min(means.values())


def test_several_seeds_give_a_mean_and_a_spread(ran):
    out, _ = ran
    summary = results.Summary([out / "lasa" / f"quick_seed{seed}.json" for seed in (0, 1)])
    a, b = summary.scaled("test", "one step", "offbeat")
    assert f"{(a + b) / 2:.3g} ± {abs(a - b) / 2:.1g}" in report.errors(summary, "test")
    assert len(summary.scaled("test", "one step", "last_value")) == 1


def test_the_document_has_the_tables_between_its_markers(ran):
    text = (ran[0] / "page.md").read_text()
    assert text.startswith("Before.\n<!-- lasa -->")
    assert text.endswith("<!-- end of lasa -->\nAfter.\n")
    assert "| last value |" in text
    assert "old" not in text
    with pytest.raises(ob.InputError, match="<!-- g1 -->"):
        between(text, "g1", "body")


@pytest.fixture
def doctored(ran, tmp_path):
    """Results in which Offbeat has other errors and coverage than it had."""

    def made(errors, coverage):
        found = json.loads((ran[0] / "lasa" / "quick_seed0.json").read_text())
        for name, each in found["predictors"].items():
            for task, scored in each["scores"]["test"].items():
                scored["rmse_scaled"] = errors.get((name, task), errors.get(name, 2.0))
                if "coverage" in scored:
                    nominal = {level: float(level) for level in scored["coverage"]}
                    scored["coverage"] = nominal | coverage.get((name, task), {})
        path = tmp_path / "seed0.json"
        path.write_text(json.dumps(found))
        return results.Summary([path])

    return made


def test_every_loss_to_a_baseline_is_stated_with_its_size(doctored):
    summary = doctored(
        {
            "ridge": 1.0,
            "pchip": 0.5,
            "offbeat": 1.02,  # a tie
            ("offbeat", "forecast 1 s"): 1.3,
            "offbeat_two_sided": 0.4,
            ("offbeat_two_sided", "fill 0.5 s"): 0.6,
        },
        {},
    )
    said = report.losses(summary, "test").splitlines()
    assert "- Offbeat: forecast 1 s 1.3 (ridge)" in said
    assert "- Offbeat (both sides): fill 0.5 s 1.2 (PCHIP)" in said
    assert said[0].startswith("Losses by more than 2 %")
    assert len(said) == 2 + 6, "a line per predictor of Offbeat"


def test_intervals_that_are_off_are_counted_with_the_worst(doctored):
    summary = doctored(
        {},
        {
            ("offbeat", "one step"): {"0.5": 0.45, "0.8": 0.772},
            ("offbeat", "forecast 1 s"): {"0.5": 0.65, "0.95": 0.9},
        },
    )
    said = report.misses(summary, "test").splitlines()
    assert (
        "- Offbeat, of 21: too narrow in 2, most by 5 (one step, 50 %); "
        "too wide in 1, most by 15 (forecast 1 s, 50 %)"
    ) in said
    assert "- Offbeat (both sides), of 6: none" in said


def test_the_front_page_marks_the_best_baseline_though_it_has_no_column(doctored):
    errors = {"mean": 0.7, "ridge": 0.9, "offbeat": 0.8, "offbeat_two_sided": 0.1}
    ahead, fill = report.front_page([doctored(errors, {})]).splitlines()[2:]
    assert ahead.endswith("| 2 | 2 | 2 | 0.9 | **0.7**, mean | 0.8 |")
    assert fill.endswith("| 0.7, mean | **0.1** |")


def test_the_tables_have_all_seeds_whatever_was_run_now(ran, capsys):
    out, asked = ran
    assert [p.stem for p in results.files_of(out, "lasa", True)] == ["quick_seed0", "quick_seed1"]
    main([*asked[:3], "--out", str(out)])
    assert "±" in capsys.readouterr().out


def test_what_is_there_is_not_run_again(ran, capsys):
    out, asked = ran
    path = out / "lasa" / "quick_seed0.json"
    before = path.read_bytes()
    main(asked)
    assert "fitted in" not in capsys.readouterr().out
    assert path.read_bytes() == before
    main([*asked, "--predictor", "pchip", "--again"])
    assert "seed 0: pchip, fitted in" in capsys.readouterr().out


def test_results_of_other_tasks_are_not_mixed(ran, tmp_path):
    log = logs.lasa(True)
    path = results.path_of(tmp_path, "lasa", 0, True)
    path.parent.mkdir()
    path.write_bytes((ran[0] / "lasa" / "quick_seed0.json").read_bytes())
    fewer = replace(log, targets=5)
    with pytest.raises(ob.InputError, match="other tasks"):
        results.run(fewer, tmp_path, 0, names=["mean"], quick=True)
    results.run(fewer, tmp_path, 0, names=["mean"], quick=True, again=True)
    assert list(json.loads(path.read_text())["predictors"]) == ["mean"]


@pytest.mark.parametrize("name", ["px4", "g1"])
def test_the_command_says_where_it_looked_for_a_log(name, tmp_path, monkeypatch):
    monkeypatch.setenv("OFFBEAT_DATA", str(tmp_path))
    with pytest.raises(SystemExit, match="set OFFBEAT_DATA") as stopped:
        main(["--log", name, "--out", str(tmp_path)])
    assert str(tmp_path) in str(stopped.value)


@pytest.mark.parametrize("name", ["px4", "g1", "wrist", "arm"])
def test_every_log_is_asked_all_tasks(name, log_of):
    log = log_of(name, quick=True)
    for test, asked in log.asked.items():
        assert [t.name for t in asked] == ["one step", "fill 0.1 s", "fill 0.5 s", *HORIZONS]
        for task in asked:
            assert min(sum(scores.counts(task)[i] for i in g) for g in groups_of(log)) > 0, test
    in_groups = sorted(name for names in log.groups.values() for name in names)
    assert in_groups == sorted(log.train.names)
    assert sorted(name for names in log.sensors for name in names) == in_groups


def groups_of(log):
    return [[log.train.names.index(n) for n in names] for names in log.groups.values()]


def test_no_person_of_the_wrist_log_is_in_two_parts(log_of):
    log = log_of("wrist")
    parts = [
        {t.origin.split(",")[0] for t in part}
        for part in (log.train, log.validation, log.tests["test"])
    ]
    assert [len(part) for part in parts] == [7, 1, 2]
    assert len(set.union(*parts)) == 10


# --- the simulated arm ----------------------------------------------------------------------------


def test_the_log_of_the_arm_reads_as_it_was_written(tmp_path):
    arm_log.write(tmp_path / "arm.csv", 30, seed=3)
    times, table = arm_log.recorded(30, seed=3)
    log = ob.read(tmp_path / "arm.csv")
    assert log.channels == 26
    assert log.units[:1] + log.units[-2:] == ("rad", "m", "N")
    first = int(np.argmax(np.diff(times))) + 1  # after the outage, a new trajectory begins
    assert [t.rows for t in log] == [first, len(times) - first]
    values = np.concatenate([t.values for t in log])
    assert np.allclose(
        values, np.concatenate(list(table.values()), axis=1), rtol=1e-6, equal_nan=True
    )


def test_sensors_of_the_arm_drop_out_and_all_are_silent_once():
    times, table = arm_log.recorded(120, seed=1)
    assert np.diff(times).max() == pytest.approx(4.0, abs=0.02)
    for sensor, rate in arm_log.RATES_HZ.items():
        reports = (~np.isnan(table[sensor][:, 0])).sum()
        assert 0.93 < reports / ((120 - 4) * rate) < 0.975
    again = arm_log.recorded(120, seed=1)[1]
    other = arm_log.recorded(120, seed=2)[1]
    for sensor, values in table.items():
        assert np.array_equal(values, again[sensor], equal_nan=True)
        assert values.shape != other[sensor].shape


def test_movements_of_the_arm_are_those_of_minimum_jerk():
    start, end = np.array([0.0, 1.0]), np.array([1.0, -1.0])
    position, velocity, acceleration = arm_log.minimum_jerk(start, end, 1000)
    assert position[500] == pytest.approx([0.5, 0.0])
    assert velocity[500] == pytest.approx([1.875, -3.75])  # 15 / 8 of the mean velocity
    assert np.abs(np.gradient(position, 1e-3, axis=0) - velocity)[1:-1].max() < 1e-4
    assert np.abs(np.gradient(velocity, 1e-3, axis=0) - acceleration)[1:-1].max() < 1e-3


def test_the_inertial_unit_of_the_arm_feels_gravity_and_turning():
    still = arm_log.motion(5, 0)
    n = len(still.times)
    posture = np.tile(still.position[:1], (n, 1))
    zero = np.zeros((n, 6))
    at_rest = arm_log.sensed(replace(still, position=posture, velocity=zero, acceleration=zero))
    felt = at_rest[arm_log.IMU]
    assert np.linalg.norm(felt[:, 3:], axis=1) == pytest.approx(np.full(n, arm_log.GRAVITY))
    assert np.abs(felt[:, :3]).max() < 1e-9
    # Only the base turns, at 0.5 rad/s: so does the wrist.
    posture[:, 0] = 0.5 * still.times
    turned = arm_log.sensed(replace(still, position=posture, velocity=zero, acceleration=zero))
    rates = np.linalg.norm(turned[arm_log.IMU][5:-5, :3], axis=1)
    assert rates == pytest.approx(np.full(n - 10, 0.5), rel=1e-5)
