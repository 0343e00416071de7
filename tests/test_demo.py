import json
import shutil

import numpy as np
import pytest
from PIL import Image

import offbeat as ob
from offbeat import examples
from offbeat.answers.blend import fit_blend
from offbeat.data import arm_log
from offbeat.demo import hopper, run_demo
from offbeat.errors import InputError, MissingExtraError
from offbeat.plots import animation
from offbeat.plots.errors import by_elapsed, by_task

TINY = {
    "log_s": 8.0,
    "arm_epochs": 1,
    "arm_tasks": 16,
    "n_trajectories": 40,
    "hopper_epochs": 2,
    "n_new": 12,
    "progress": False,
}


def grey(backend, request, answer):
    """Stands in for rendering, which `test_report` tests and which takes longest."""
    width, height = animation._PANEL
    with np.load(request) as asked:
        np.save(answer, np.full((len(asked["truth"]), 2, height, width, 3), 128, dtype=np.uint8))


@pytest.fixture(autouse=True)
def no_rendering(monkeypatch):
    monkeypatch.setattr(animation, "_render_with", grey)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(animation, "_render_with", grey)
        # The numbers of tasks of a real log take most of the time.
        patch.setattr(examples, "VALIDATION_TASKS", 12)
        patch.setattr(examples, "REFERENCE_TASKS", 24)
        patch.setitem(fit_blend.__kwdefaults__, "count", 24)
        return run_demo(tmp_path_factory.mktemp("demo") / "out", **TINY)


@pytest.fixture
def copy(made, tmp_path):
    shutil.copytree(made.folder, tmp_path / "out")
    return tmp_path / "out"


def test_the_report_names_every_predictor_and_every_file(made):
    text = str(made)
    assert set(made.written) == {path.name for path in made.folder.iterdir()}
    assert all(name in text for name in made.written)
    shown = [*made.hopper.overall, "Blend", "Anchored trend alone", "PCHIP"]
    assert all(name in text for name in shown)
    assert "hopper-anchored-large" in shown
    for path in made.folder.glob("*.png"):
        with Image.open(path) as picture:
            assert picture.width == 1400


def test_a_machine_can_read_the_result(made):
    result = json.loads(json.dumps(made.to_dict(), allow_nan=False))
    written = json.loads((made.folder / "results.json").read_text(encoding="utf-8"))
    assert result["hopper"] == written["hopper"]
    assert [task["task"] for task in written["arm"]["tasks"]] == [
        "fill dropouts",
        "forecast, 0.1 s",
        "forecast, 0.5 s",
    ]


def test_errors_of_the_hopper_are_those_that_evaluate_gives(made):
    name = "hopper-30-ode_rnn"
    model = ob.load_model(f"offbeat/{name}")
    recorded = ob.simulate("hopper", TINY["n_new"], rows=200, seed=hopper.NEW_SEED)
    new = ob.mask_out(ob.windows(recorded, 100, seed=hopper.NEW_SEED), 0.3, seed=hopper.NEW_SEED)
    scores = ob.evaluate(model, new).scores
    for ours, theirs in ((name, model.name), ("last_value", "last_value")):
        expected = scores[theirs].after_first_observation.rmse
        assert made.hopper.overall[ours] == pytest.approx(expected, rel=1e-5)


def test_hidden_values_are_those_that_a_log_without_dropouts_would_have():
    options = {"seed": 1, "outage_s": 0.0}
    whole = arm_log.with_hidden_values(10, **options)
    times, table = arm_log.recorded(10, **options)
    values = np.concatenate(list(table.values()), axis=1)
    rows = np.searchsorted(whole.times, times)
    np.testing.assert_array_equal(whole.times[rows], times)
    seen = np.where(whole.observed, whole.values, np.nan)
    np.testing.assert_array_equal(seen[rows], values)
    hidden = np.isfinite(whole.values) & ~whole.observed
    assert 0.03 < hidden.sum() / np.isfinite(whole.values).sum() < 0.07
    clean = np.concatenate(list(arm_log.sensed(arm_log.motion(10, 1)).values()), axis=1)
    position = np.interp(whole.times, arm_log.motion(10, 1).times, clean[:, 0])
    error = whole.values[hidden[:, 0], 0] - position[hidden[:, 0]]
    assert len(error) > 20
    assert np.std(error) == pytest.approx(arm_log.NOISE["joints"][0], rel=0.5)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"seconds": 0.5}, "seconds must be a length of at least 1 s, got 0.5"),
        ({"dropout_fraction": 1.0}, "dropout_fraction must be a fraction"),
        ({"outage_s": -1.0}, "outage_s must be seconds of at least 0"),
    ],
)
def test_a_log_of_the_arm_that_cannot_be_made_is_refused(wrong, message):
    with pytest.raises(InputError, match=message):
        arm_log.recorded(**wrong)


def test_both_animations_show_every_row_and_the_second_hides_its_latter_half(made):
    blue = []
    for name in ("hopper.gif", "hopper_extrapolation.gif"):
        with Image.open(made.folder / name) as gif:
            assert gif.n_frames == 100
            line = np.asarray(gif.convert("RGB"), dtype=int)[
                -20, 384:
            ]  # the row before the middle is at 381
            blue.append((line[:, 2] - line[:, 0] > 100).sum())
    assert blue[0] > 10
    assert blue[1] == 0, "no row after the middle is observed"


def test_a_demo_that_was_stopped_goes_on_where_it_was_and_finds_the_same(made, tmp_path):
    shutil.copytree(made.folder / "models", tmp_path / "models")
    log = (tmp_path / "models/hopper/log.csv").read_bytes()
    options = {k: TINY[k] for k in ("n_trajectories", "progress")}
    trained, fitted = hopper.train_hopper(tmp_path, epochs=TINY["hopper_epochs"], seed=0, **options)
    again = hopper.compare_hopper(tmp_path, trained, fitted, n_new=TINY["n_new"], progress=False)
    assert again.overall == made.hopper.overall
    assert (tmp_path / "models/hopper/log.csv").read_bytes() == log


def test_other_settings_in_the_same_folder_change_nothing(copy):
    before = {path: path.read_bytes() for path in copy.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match=r"seed \(0 then, 1 now\)"):
        run_demo(copy, seed=1, **TINY)
    assert {path: path.read_bytes() for path in copy.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"hopper_epochs": 0}, "epochs must be an integer of at least 1, got 0"),
        ({"n_trajectories": 2}, "2 trajectories are too few"),
    ],
)
def test_arguments_out_of_bounds_are_refused_before_anything_is_written(tmp_path, options, said):
    with pytest.raises(InputError, match=said):
        run_demo(tmp_path / "out", **{**TINY, **options})
    assert not list(tmp_path.iterdir())


def test_a_file_in_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "out").write_text("mine", encoding="utf-8")
    with pytest.raises(InputError, match="out is a file"):
        run_demo(tmp_path / "out", **TINY)
    assert (tmp_path / "out").read_text(encoding="utf-8") == "mine"


def test_where_nothing_renders_the_demo_says_so(made, tmp_path, monkeypatch):
    def fail(*_, **__):
        raise MissingExtraError("MuJoCo cannot render here (egl: broken); install it")

    monkeypatch.setattr(hopper, "side_by_side", fail)
    model = ob.load_model(made.folder / "models/hopper/model")
    log = ob.simulate("hopper", 1, rows=100, seed=0)[0]
    (said,) = hopper._animate(tmp_path, model, log)
    assert "egl: broken" in said
    assert not list(tmp_path.iterdir())


def test_a_figure_of_errors_has_a_line_per_task_and_refuses_what_it_cannot_draw():
    figure = by_task({"fill": {"blend": 0.1, "pchip": 0.2}, "forecast": {"blend": 0.3}})
    (axes,) = figure.axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["fill", "forecast"]
    drawn = {line.get_label(): line.get_xydata().tolist() for line in axes.lines}
    assert drawn == {"Blend": [[0.1, 0], [0.3, 1]], "PCHIP": [[0.2, 0]]}
    with pytest.raises(InputError, match="above 0"):
        by_task({"fill": {"blend": 0.0}})


def test_labels_of_lines_that_end_together_do_not_cover_each_other():
    ends = {"gru": [2.0, 1.0], "gru_d": [3.0, 1.001], "ode_rnn": [4.0, 10.0]}
    (axes,) = by_elapsed([5, 10], ends).axes
    heights = sorted(np.log(text.xy[1]) for text in axes.texts)
    low, high = np.log(axes.get_ylim())
    assert min(np.diff(heights)) > 0.05 * (high - low)
    with pytest.raises(InputError, match="give 2 errors"):
        by_elapsed([5, 10], {"gru": [1.0]})
    with pytest.raises(InputError, match=r"an error of 0\.0, expected errors above 0"):
        by_elapsed([5, 10], {"gru": [1.0, 0.0]})
