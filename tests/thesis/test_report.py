import os
import subprocess
import sys
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
from PIL import Image

from offbeat.data.robots import load_model
from offbeat.data.trajectory import Trajectory
from offbeat.errors import InputError, MissingExtraError
from offbeat.models.zoo import ZOO
from offbeat.plots import animation, figures
from offbeat.plots.style import STYLES, style_of

WHITE, BLUE = (255, 255, 255), (0, 114, 178)


def log(*rmse):
    return [
        SimpleNamespace(epoch=i + 1, steps=10 * (i + 1), validation_mse=value**2)
        for i, value in enumerate(rmse)
    ]


def swing(rows=20, hide=()):
    times = np.arange(rows) * 0.005
    values = np.stack([np.sin(times), 2 * np.cos(times), times], axis=1)
    observed = np.ones(values.shape, dtype=bool)
    observed[list(hide)] = False
    names, units = ("hip_qpos", "hip_qvel", "mode"), ("rad", "rad/s", "")
    return Trajectory(times, values, observed=observed, names=names, units=units)


def lines(axes):
    return {line.get_label(): line for line in axes.get_lines()}


# --- style ----------------------------------------------------------------------------------------


def test_every_model_of_the_zoo_has_a_style_of_its_own():
    assert set(ZOO) <= set(STYLES)
    for field in ("label", "colour"):
        assert len({getattr(style, field) for style in STYLES.values()}) == len(STYLES)


def test_a_name_without_a_style_gets_the_same_one_in_every_process():
    assert style_of("my_run") == style_of("my_run")
    assert (style_of("my_run").label, style_of("my_run").colour) == ("my_run", "#117733")


# --- figures --------------------------------------------------------------------------------------


@pytest.mark.parametrize(("x", "first"), [("epochs", 1), ("steps", 10)])
def test_learning_curves_draw_the_root_of_each_logged_error(x, first):
    histories = {"gru": log(0.5, 0.4), "anchored_ode_gru_d": log(0.1, 0.03, 0.02)}
    axes = figures.learning_curves(histories, last_value_rmse=0.035, x=x).axes[0]
    drawn = lines(axes)
    for name, rmse in (("gru", [0.5, 0.4]), ("anchored_ode_gru_d", [0.1, 0.03, 0.02])):
        line = drawn[STYLES[name].label]
        np.testing.assert_allclose(line.get_ydata(), rmse)
        np.testing.assert_array_equal(line.get_xdata(), first * np.arange(1, len(rmse) + 1))
        assert line.get_color() == STYLES[name].colour
    assert list(drawn["Last value"].get_ydata()) == [0.035, 0.035]
    assert drawn["Last value"].get_linestyle() == "--"
    assert axes.get_yscale() == "log"


def test_the_axes_of_learning_curves_say_what_they_count_and_in_which_units():
    axes = figures.learning_curves({"gru": log(0.5)}, x="steps", units="deviations").axes[0]
    assert axes.get_xlabel() == "Optimizer steps"
    assert axes.get_ylabel() == "Validation RMSE (deviations)"
    assert figures.learning_curves({"gru": log(0.5)}).axes[0].get_xlabel() == "Epoch"


def test_an_error_within_one_decade_still_has_labelled_ticks():
    figure = figures.learning_curves({"gru": log(0.034, 0.022)})
    figure.draw_without_rendering()
    low, high = figure.axes[0].get_ylim()
    shown = [
        text.get_text()
        for tick, text in zip(
            figure.axes[0].get_yticks(), figure.axes[0].get_yticklabels(), strict=True
        )
        if low <= tick <= high
    ]
    assert "0.03" in shown


@pytest.mark.parametrize(
    ("histories", "said"), [({}, "got no training logs"), ({"gru": []}, "log of 'gru' is empty")]
)
def test_learning_curves_of_nothing_are_refused(histories, said):
    with pytest.raises(InputError, match=said):
        figures.learning_curves(histories)


def test_a_panel_shows_truth_observed_points_and_each_prediction():
    truth = swing(hide=[0, 3, 4])
    guess = Trajectory(truth.times, truth.values + 1, names=truth.names, units=truth.units)
    figure = figures.predictions(
        truth, {"ode_rnn": guess, "gru": truth}, ("hip_qvel", "mode"), title="One step ahead"
    )
    assert [axes.get_ylabel() for axes in figure.axes] == ["hip_qvel (rad/s)", "mode"]
    assert figure.axes[-1].get_xlabel() == "Time (s)"
    assert figure.get_suptitle() == "One step ahead"
    drawn = lines(figure.axes[0])
    assert list(drawn) == ["Truth", "ODE-RNN", "GRU", "Observed"]
    np.testing.assert_array_equal(drawn["Truth"].get_ydata(), truth.values[:, 1])
    np.testing.assert_array_equal(drawn["ODE-RNN"].get_xdata(), truth.times)
    np.testing.assert_array_equal(drawn["ODE-RNN"].get_ydata(), truth.values[:, 1] + 1)
    seen = np.setdiff1d(np.arange(20), [0, 3, 4])
    np.testing.assert_array_equal(drawn["Observed"].get_xdata(), truth.times[seen])
    np.testing.assert_array_equal(drawn["Observed"].get_ydata(), truth.values[seen, 1])
    assert drawn["Observed"].get_linestyle() == "None"


def test_what_a_model_says_before_it_has_seen_anything_does_not_set_the_height_of_a_panel():
    truth = swing(hide=[0, 1])
    values = truth.values.copy()
    values[:3] = -100.0  # row 2 is the first observed one: its own prediction has seen nothing
    values[10] = 9.0
    guess = Trajectory(truth.times, values, names=truth.names, units=truth.units)
    axes = figures.predictions(truth, {"gru": guess}, ["mode"]).axes[0]
    low, high = axes.get_ylim()
    assert -2 < low < 0
    assert 9 < high < 11
    np.testing.assert_array_equal(lines(axes)["GRU"].get_ydata(), values[:, 2])


def test_a_model_has_one_colour_in_all_figures():
    curves = figures.learning_curves({"ode_rnn": log(0.5)})
    panels = figures.predictions(swing(), {"ode_rnn": swing()}, ["hip_qpos"])
    colours = {lines(f.axes[0])["ODE-RNN"].get_color() for f in (curves, panels)}
    assert colours == {STYLES["ode_rnn"].colour}


def test_an_unknown_channel_and_no_channel_are_refused():
    with pytest.raises(InputError, match="did you mean 'hip_qpos'"):
        figures.predictions(swing(), {}, ["hip_pos"])
    with pytest.raises(InputError, match="at least one channel to draw, of: hip_qpos"):
        figures.predictions(swing(), {}, [])


def test_figures_leave_the_settings_of_matplotlib_alone():
    before = dict(matplotlib.rcParams)
    figures.learning_curves({"gru": log(0.5)})
    figures.predictions(swing(), {}, ["mode"])
    assert dict(matplotlib.rcParams) == before


def test_figures_import_neither_pyplot_nor_torch():
    code = (
        "import sys, types, offbeat.plots.animation\n"
        "from offbeat.plots.figures import learning_curves\n"
        "e = types.SimpleNamespace(epoch=1, steps=1, validation_mse=1.0)\n"
        "learning_curves({'gru': [e]})\n"
        "assert not {'matplotlib.pyplot', 'torch', 'mujoco'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(("suffix", "start"), [(".png", b"\x89PNG"), (".pdf", b"%PDF")])
def test_a_figure_is_saved_by_suffix_twice_with_the_same_bytes(tmp_path, suffix, start):
    files = [tmp_path / f"{i}{suffix}" for i in range(2)]
    for file in files:
        figure = figures.learning_curves({"gru": log(0.5, 0.4)}, last_value_rmse=0.3)
        assert figures.save(figure, file) == file
    first, second = (file.read_bytes() for file in files)
    assert first.startswith(start)
    assert first == second


def test_a_saved_picture_has_at_least_150_dots_per_inch(tmp_path):
    figures.save(figures.learning_curves({"gru": log(0.5)}), tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as picture:
        assert picture.width >= 150 * 7


def test_a_figure_that_cannot_be_saved_leaves_the_old_file(tmp_path, monkeypatch):
    figure = figures.learning_curves({"gru": log(0.5)})
    path = tmp_path / "a.png"
    path.write_bytes(b"old")

    def fail(file, **options):
        file.write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(figure, "savefig", fail)
    with pytest.raises(OSError, match="disk full"):
        figures.save(figure, path)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == {"a.png": b"old"}
    with pytest.raises(InputError, match=r"suffix of a figure '.gif', expected one of: .pdf, .png"):
        figures.save(figure, tmp_path / "a.gif")


# --- animation ------------------------------------------------------------------------------------


def show(path, rows=4, **options):
    qpos = np.zeros((rows, load_model("hopper").nq))
    options = {"times": np.arange(rows) * 0.005, **options}
    return animation.side_by_side("hopper", qpos, qpos + 0.1, path, **options)


@pytest.fixture
def rendered(monkeypatch):
    """Grey views in place of rendered ones; lists the backends that were tried."""
    tried = []

    def render(backend, request, answer):
        tried.append(backend)
        if backend == "egl":
            return "no EGL here"
        width, height = animation._PANEL
        with np.load(request) as asked:
            rows = len(asked["truth"])
        np.save(answer, np.full((rows, 2, height, width, 3), 128, dtype=np.uint8))
        return None

    monkeypatch.setattr(animation, "_render_with", render)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    return tried


def frames_of(path):
    with Image.open(path) as gif:
        for index in range(gif.n_frames):
            gif.seek(index)
            yield gif.info["duration"], gif.convert("RGB")


def test_a_gif_has_a_frame_per_row_and_lasts_as_long_as_the_rows_slowed_down(tmp_path, rendered):
    times = np.array([0.0, 0.005, 0.02, 0.0225])
    path = show(tmp_path / "a.gif", times=times, caption="A caption")
    durations, pages = zip(*frames_of(path), strict=True)
    assert durations == (40, 120, 20, 1000)
    assert {page.size for page in pages} == {(644, 350)}
    assert path.stat().st_size < 100_000


def test_a_gif_marks_the_rows_that_were_observed(tmp_path, rendered):
    path = show(tmp_path / "a.gif", observed=[True, False, False, True])
    dots = [page.getpixel((15, 350 - 40 + 18)) for _, page in frames_of(path)]
    for dot, colour in zip(dots, (BLUE, WHITE, WHITE, BLUE), strict=True):
        assert np.abs(np.subtract(dot, colour)).max() < 12, dots


def test_osmesa_is_tried_where_egl_fails(tmp_path, rendered):
    show(tmp_path / "a.gif")
    assert rendered == ["egl", "osmesa"]


def test_the_users_own_choice_of_backend_is_the_only_one_tried(tmp_path, rendered, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "egl")
    with pytest.raises(MissingExtraError, match=r"egl: no EGL here\); unset MUJOCO_GL") as error:
        show(tmp_path / "a.gif")
    assert rendered == ["egl"]
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


def test_where_nothing_renders_the_message_names_the_packages(tmp_path, rendered, monkeypatch):
    monkeypatch.setattr(animation, "_render_with", lambda backend, *_: "broken")
    with pytest.raises(MissingExtraError, match=r"egl: broken; osmesa: broken.*apt-get install"):
        show(tmp_path / "a.gif")


def test_a_backend_that_ends_its_process_gives_one_line(tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "nonsense")
    with pytest.raises(MissingExtraError, match=r"nonsense: .*MUJOCO_GL") as error:
        show(tmp_path / "a.gif")
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


def test_mujoco_renders_the_robot_and_its_prediction(tmp_path, monkeypatch):
    # This process may have imported MuJoCo under any choice: rendering does not happen here.
    path = tmp_path / "a.gif"
    try:
        show(path)
    except MissingExtraError as error:
        pytest.skip(str(error))
    pages = [np.asarray(page, dtype=float) for _, page in frames_of(path)]
    assert len(pages) == 4
    left, right = pages[0][46:310, :320], pages[0][46:310, 324:]
    warm = [(view[..., 0] - view[..., 2] > 60).mean() for view in (left, right)]
    blue = [(view[..., 2] - view[..., 0] > 80).mean() for view in (left, right)]
    assert min(warm) > 0.005, "both views show an orange robot"
    assert blue[0] < 1e-4 < blue[1], "the true one stands in blue behind the predicted one"
    assert os.listdir(tmp_path) == ["a.gif"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"times": np.arange(3) * 0.005}, "4, 4, 3 and 4 rows"),
        ({"observed": [True]}, "4, 4, 4 and 1 rows"),
        ({"speed": 1.0}, "use a speed of at most 0.25"),
        ({"speed": 0.0}, "speed must be positive, got 0.0"),
        ({"times": np.zeros(4)}, "increase strictly"),
    ],
)
def test_an_animation_of_what_does_not_fit_is_refused(tmp_path, options, said):
    with pytest.raises(InputError, match=said):
        show(tmp_path / "a.gif", **options)


def test_positions_of_another_robot_or_not_finite_are_refused(tmp_path):
    times, good = np.arange(2) * 0.005, np.zeros((2, 7))
    with pytest.raises(InputError, match=r"predicted_qpos must have shape \(rows, 7\)"):
        animation.side_by_side("hopper", good, np.zeros((2, 9)), tmp_path / "a.gif", times=times)
    bad = np.where(np.arange(2)[:, None] == 1, np.nan, good)
    with pytest.raises(InputError, match="truth_qpos is not finite at row 1"):
        animation.side_by_side("hopper", bad, good, tmp_path / "a.gif", times=times)
