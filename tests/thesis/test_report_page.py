"""The report as a whole: its files, its page, and its rendering in a browser."""

import csv
import json
import re
import subprocess
import sys
from html.parser import HTMLParser

import browser
import numpy as np
import pytest
import record_helpers as made
from PIL import Image

from offbeat.errors import FileFormatError, InputError
from offbeat.plots.style import STYLES
from thesis.__main__ import main as thesis_main
from thesis.illustrations import Illustrations, StateMap, Trace
from thesis.report import svg
from thesis.report.circumstances import Circumstances
from thesis.report.contents import Contents
from thesis.report.figure_boxes import boxes_figure
from thesis.report.figure_curves import curves_figure
from thesis.report.figure_robot import channels_figure
from thesis.report.figure_states import map_figure, states_figure
from thesis.report.reproduction import write_report

pytestmark = pytest.mark.slow

FRACTIONS = (0.9, 0.3)


@pytest.fixture(scope="module")
def record():
    """Two of four shares, four of ten repeats, runs of two processors."""
    part = made.synthetic(repeats=4, epochs=60, fractions=FRACTIONS)
    at = np.flatnonzero(part.runs["run_id"] == "e2-gru-90-r01")
    return made.changed(part, at, cpu="<Another> & one")


def drawn():
    """Illustrations without any simulation."""
    random = np.random.default_rng(0)
    times = np.arange(40) * 0.005
    walk = random.standard_normal((3, 40, 3)).cumsum(axis=1)
    names = ("rootz_qpos", "knee_qpos", "knee_qvel")
    state = random.standard_normal((20, 4))
    models = ("gru", "ode_rnn", "ode_gru_d")
    trace = Trace(
        times[:20],
        times[:20] % 0.015 < 0.004,
        dict.fromkeys(models, state),
        dict.fromkeys(models, state + 0.1),
    )
    places = {m: random.standard_normal((30, 2)) for m in models}
    state_map = StateMap(places, random.standard_normal(30), "rootz_qpos", "m")
    units = ("m", "rad", "rad/s")
    return Illustrations("hopper", names, units, times, walk, 0.3, {}, trace, state_map)


@pytest.fixture(scope="module")
def report(record, tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    made.write(record, folder / "runs")
    with pytest.MonkeyPatch.context() as patch:  # rendering has tests of its own
        grey = np.full((8, 20, 30, 3), 200, dtype=np.uint8)
        patch.setattr("thesis.report.figure_robot.stills", lambda robot, qpos: grey[: len(qpos)])
        return write_report(folder / "runs", folder / "out", illustrations=drawn())


class Reader(HTMLParser):
    """Collects what a page consists of."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.open, self.faults = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in ("meta", "link", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag):
        if not self.open or self.open.pop() != tag:
            self.faults.append(tag)

    def all(self, tag):
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture(scope="module")
def page(report):
    return Reader(report.page.read_text(encoding="utf-8"))


# --- files ----------------------------------------------------------------------------------------


def test_each_table_and_figure_is_a_file_in_every_form(report):
    names = {path.name for path in report.tables}
    for number in ("3-1", "3-2", "3-3", "3-4", "3-5", "3-6", "3-7", "3-8", "a-1", "a-15"):
        assert {f"table-{number}.{suffix}" for suffix in ("csv", "md", "tex")} <= names
    figures = {path.name for path in report.figures}
    # Of figures 3.3 to 3.10, those of the two shares that have runs.
    for number in ("2-5", "3-1", "3-2", "3-3", "3-6", "3-7", "3-10", "a-1", "a-2"):
        assert {f"figure-{number}.png", f"figure-{number}.pdf"} <= figures
    assert len(figures) == 2 * 9
    assert report.summary.read_text(encoding="utf-8").startswith("# The thesis, reproduced")
    for path in (*report.tables, *report.figures):
        assert path.stat().st_size > 0
    for path in report.figures:
        if path.suffix == ".png":
            with Image.open(path) as image:
                assert min(image.size) > 300
        else:
            assert path.read_bytes().startswith(b"%PDF")


def test_a_csv_holds_the_numbers_of_its_table(report, record):
    (path,) = [p for p in report.tables if p.name == "table-3-6.csv"]
    with path.open(newline="", encoding="utf-8") as file:
        lines = list(csv.DictReader(file))
    (line,) = [
        one
        for one in lines
        if one["block"] == "Ours, scoring after the first observation"
        and one["row"] == "ODE-RNN"
        and one["column"] == "30 %"
    ]
    rows = record.where(experiment=2, model="ode_rnn", fraction=0.3)
    rmse = np.sqrt(record.values("honest_mse", rows))
    assert float(line["value"]) == pytest.approx(rmse.mean(), rel=1e-15)
    assert float(line["std"]) == pytest.approx(rmse.std(ddof=1), rel=1e-14)
    assert line["n"] == "4"


def test_what_is_missing_and_what_is_mixed_is_told_on_the_page_and_by_the_result(report):
    said = " ".join(report.messages)
    for words in (
        "Another> & one: 1",
        "80 of 376 runs are there: 8 of 16 of experiment 1 and 72 of 360 of experiment 2",
        "Figures 3.4, 3.5 each need a run of experiment 1",
        "Figures 3.8, 3.9 each need a run of experiment 2",
    ):
        assert words in said
    text = report.page.read_text(encoding="utf-8")
    assert "&lt;Another&gt; &amp; one: 1" in text
    assert "4 of 10" in text
    assert "80 of 376 runs" in text  # 2 shares x (4 + 9 x 4)
    assert "<sup>†</sup>" in text
    assert report.to_dict()["messages"] == list(report.messages)


def test_other_files_in_the_folder_stay(record, tmp_path):
    kept = tmp_path / "out" / "tables" / "mine.txt"
    kept.parent.mkdir(parents=True)
    kept.write_text("mine")
    few = made.without(record, record.runs["experiment"] == 1)
    few = made.without(few, few.runs["repeat"] > 0)
    written = write_report(few, tmp_path / "out")
    assert kept.read_text() == "mine"
    assert any("Figures 3.1, 3.2, 2.5 and A.2 need" in message for message in written.messages)
    assert written.page.is_file()


def test_a_report_of_a_handful_of_runs_is_made_too(record, tmp_path):
    one = made.without(record, np.arange(len(record)) > 0)
    written = write_report(one, tmp_path / "out", repeats=1)
    text = written.page.read_text(encoding="utf-8")
    assert "cannot be decided yet" in text
    assert 'class="verdict yes"' not in text
    assert 'class="verdict no"' not in text


def test_bad_arguments_are_refused_before_anything_is_written(record, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file; give the name of a folder"):
        write_report(record, tmp_path / "file")
    with pytest.raises(InputError, match="repeats must be at least 1"):
        write_report(record, tmp_path / "out", repeats=0)
    with pytest.raises(FileFormatError, match="not there"):
        write_report(tmp_path / "nowhere", tmp_path / "out")
    assert not (tmp_path / "out").exists()


# --- the page -------------------------------------------------------------------------------------


def test_the_page_is_whole_html_with_one_title_and_unique_names(page):
    assert page.faults == []
    assert page.open == []
    assert len(page.all("h1")) == 1
    ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(ids) == len(set(ids))
    assert page.all("html")[0]["lang"] == "en"
    assert any(meta.get("name") == "viewport" for meta in page.all("meta"))


def test_nothing_on_the_page_comes_from_elsewhere(page, report):
    text = report.page.read_text(encoding="utf-8")
    assert not re.search(r'(src|href)="(https?:)?//', text)
    assert "@import" not in text
    assert "url(" not in text
    assert page.all("script") == []
    for image in page.all("img"):
        assert image["src"].startswith("data:image/svg+xml;base64,")
    for link in page.all("link"):
        assert link["href"] == "data:,"


def test_links_lead_to_what_is_there(page, report):
    ids = {attributes["id"] for _, attributes in page.tags if "id" in attributes}
    for link in page.all("a"):
        if link["href"].startswith("#"):
            assert link["href"][1:] in ids
        else:
            assert (report.page.parent / link["href"]).is_file()
    files = {
        (report.page.parent / a["href"]).resolve() for a in page.all("a") if a["href"][0] != "#"
    }
    assert files == {path.resolve() for path in (*report.tables, *report.figures)}


def test_figures_have_words_and_tables_have_headers_for_those_who_cannot_see(page):
    assert len(page.all("img")) == 9
    for image in page.all("img"):
        assert len(image["alt"]) > 40
    assert len(page.all("caption")) == len(page.all("table")) == 23
    assert {th.get("scope") for th in page.all("th")} == {"col", "row", "rowgroup"}
    for region in page.all("div"):
        if region.get("class") == "scroll":
            assert region["aria-label"]
            assert region["tabindex"] == "0"


def test_every_table_of_the_thesis_has_four_kinds_of_numbers(report):
    for number in ("3-1", "3-2", "3-3", "3-4", "3-5", "3-6", "3-7", "3-8"):
        (path,) = [p for p in report.tables if p.name == f"table-{number}.md"]
        text = path.read_text(encoding="utf-8")
        for words in (
            "*Thesis",
            "*Ours, published scoring",
            "*Ours, scoring after the first observation",
            "Last value",
        ):
            assert words in text, (number, words)


def test_the_last_value_that_is_a_best_cell_is_bold(report):
    (path,) = [p for p in report.tables if p.name == "table-3-5.csv"]
    with path.open(newline="", encoding="utf-8") as file:
        lines = [
            one
            for one in csv.DictReader(file)
            if one["block"] == "Ours, scoring after the first observation"
        ]
    for column in {line["column"] for line in lines if line["value"]}:
        mine = [line for line in lines if line["column"] == column and line["value"]]
        lowest = min(mine, key=lambda line: float(line["value"]))
        assert lowest["bold"] == "true"


# --- figures --------------------------------------------------------------------------------------


def test_learning_curves_show_the_record_and_the_thesis(record):
    axes = curves_figure(record, 0.3).axes
    lines = {line.get_label(): line for line in axes[0].get_lines()}
    curve = record.curve("e1-ode_rnn-30-r00")
    np.testing.assert_array_equal(lines["ODE-RNN"].get_ydata(), curve["validation_published_mse"])
    assert lines["ODE-RNN"].get_color() == STYLES["ode_rnn"].colour
    honest = {line.get_label(): line for line in axes[1].get_lines()}
    np.testing.assert_array_equal(honest["ODE-RNN"].get_ydata(), curve["validation_honest_mse"])
    row = record.where(experiment=1, fraction=0.3)[0]
    last = record.runs["last_value_honest_mse"][row]
    assert list(honest["Last value (test part)"].get_ydata()) == [last, last]
    hollow = [line for line in axes[0].get_lines() if line.get_markeredgecolor() == "#009E73"]
    points = [line for line in hollow if line.get_linestyle() == "None"]
    assert list(points[0].get_ydata()) == [0.01026, 0.01011, 0.01005, 0.01012, 0.00995, 0.01018]
    with pytest.raises(InputError, match="no curve of experiment 1"):
        curves_figure(record, 0.5)


def test_box_plots_show_every_run(record):
    axes = boxes_figure(record, 0.3).axes
    for panel, scoring in zip(axes, ("published", "honest"), strict=True):
        labels = [text.get_text() for text in panel.get_yticklabels()]
        at = labels.index("ODE-GRU-D")
        rows = record.where(experiment=2, model="ode_gru_d", fraction=0.3)
        dots = [line for line in panel.get_lines() if line.get_marker() == "o"]
        np.testing.assert_allclose(
            dots[at].get_xdata(), record.values(f"{scoring}_mse", rows), rtol=1e-12
        )
    assert labels[-1] == "Last value"
    with pytest.raises(InputError, match="no run of experiment 2"):
        boxes_figure(record, 0.5)


def test_hidden_states_step_where_the_model_updates():
    shown = drawn()
    figure = states_figure(shown.trace)
    line = figure.axes[0].get_lines()[-1]
    # On arrival at a row and after it: twice each time, 0.1 higher after.
    np.testing.assert_array_equal(line.get_xdata(), np.repeat(shown.trace.times, 2))
    steps = line.get_ydata().reshape(-1, 2)
    np.testing.assert_allclose(steps[:, 1] - steps[:, 0], 0.1)
    grey = [one for one in figure.axes[0].get_lines() if one.get_color() == "#B8B8B8"]
    assert [one.get_xdata()[0] for one in grey] == list(shown.trace.times[shown.trace.observed])
    with pytest.raises(InputError, match="at least one model"):
        states_figure(Trace(shown.trace.times, shown.trace.observed, {}, {}))


def test_the_map_has_a_panel_per_model_and_a_scale_with_a_unit():
    figure = map_figure(drawn().map)
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    assert titles[:3] == ["GRU", "ODE-RNN", "ODE-GRU-D"]
    assert figure.axes[-1].get_ylabel() == "Height of the torso (m)"


def test_two_channels_are_drawn_for_each_recording():
    shown = drawn()
    figure = channels_figure(shown)
    assert [axes.get_ylabel() for axes in figure.axes] == [
        "Height of the torso (m)",
        "Angle of the knee (rad)",
    ]
    assert len(figure.axes[0].get_lines()) == 3
    np.testing.assert_array_equal(
        figure.axes[1].get_lines()[2].get_ydata(), shown.recordings[2, :, 1]
    )
    with pytest.raises(InputError, match="shows 2 channels, got 1"):
        channels_figure(shown, ["knee_qpos"])


def test_a_figure_as_svg_is_the_same_bytes_and_knows_the_dark(record):
    first, second = (svg.to_svg(boxes_figure(record, 0.3), "boxes") for _ in range(2))
    assert first == second
    assert "prefers-color-scheme: dark" in first
    assert "#1a1a1a" in first.split("</style>", 1)[1]  # the ink that the style replaces is there
    assert "<text" not in first  # text is paths, alike everywhere


# --- a browser ------------------------------------------------------------------------------------

needs_chromium = pytest.mark.skipif(browser.chromium() is None, reason="no Chromium is installed")

_LUMINANCE = """(() => {
  const c = getComputedStyle(document.body).backgroundColor.match(/\\d+/g).map(Number);
  return (c[0] + c[1] + c[2]) / 3;
})()"""


@needs_chromium
@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_a_browser_shows_the_page_without_a_request_and_nothing_sticks_out(
    report, tmp_path, width, dark
):
    with browser.tab(tmp_path / "profile") as tab:
        tab.open(report.page, width=width, dark=dark)
        assert tab.requests() == [report.page.resolve().as_uri()]
        assert tab.complaints() == []
        assert tab.evaluate("document.documentElement.scrollWidth") == width
        assert tab.evaluate("innerWidth") == width
        broken = "[...document.images].filter(i => !i.complete || !i.naturalWidth).length"
        assert tab.evaluate(broken) == 0
        assert (tab.evaluate(_LUMINANCE) < 60) == dark
        tab.evaluate("document.querySelectorAll('details').forEach(d => { d.open = true })")
        assert tab.evaluate("document.documentElement.scrollWidth") == width


@needs_chromium
def test_figures_follow_the_reader_into_the_dark(report, tmp_path):
    shades = {}
    for dark in (False, True):
        with browser.tab(tmp_path / f"profile-{dark}") as tab:
            tab.open(report.page, width=1280, height=1200, dark=dark)
            tab.evaluate("document.getElementById('figure-3-3').scrollIntoView()")
            tab.screenshot(tmp_path / "shot.png")
            box = tab.evaluate(
                "(() => { const r = document.querySelector('#figure-3-3 img')"
                ".getBoundingClientRect(); return [r.left, r.top, r.right, r.bottom]; })()"
            )
        with Image.open(tmp_path / "shot.png") as image:
            shades[dark] = np.asarray(image.convert("L").crop([round(v) for v in box]))
    # Paper fills most of a figure: white by day, dark by night, and ink the other way round.
    assert np.median(shades[False]) == 255
    assert np.median(shades[True]) < 40
    assert shades[False].min() < 60
    assert shades[True].max() > 180


# --- the command ----------------------------------------------------------------------------------


def test_the_command_writes_the_page_and_tells_what_as_json(record, tmp_path, capsys):
    few = made.without(record, record.runs["repeat"] > 0)
    made.write(few, tmp_path / "runs", suffix=".csv")
    out = tmp_path / "out"
    arguments = ["report", str(tmp_path / "runs"), "--out", str(out), "--illustrate", "false"]
    assert thesis_main([*arguments, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["page"] == str(out / "report.html")
    assert (out / "report.html").is_file()
    assert thesis_main(["report", str(tmp_path / "nowhere"), "--out", str(out)]) == 2
    assert "give the folder that holds record.parquet" in capsys.readouterr().err


def test_the_report_imports_no_torch():
    code = (
        "import sys, thesis.report.reproduction, thesis.illustrations\n"
        "assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_contents_are_made_once(record):
    contents = Contents(record, None, Circumstances(), repeats=4)
    assert contents.tables is contents.tables
    assert contents.pictures is contents.pictures
