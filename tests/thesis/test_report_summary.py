"""The answers in short: the page's verdicts and numbers, and nothing that is not there yet."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import record_helpers as made

from offbeat.errors import InputError
from thesis.__main__ import main as thesis_main
from thesis.protocol import Protocol
from thesis.report import circumstances, convergence, findings
from thesis.report import thesis_numbers as thesis
from thesis.report.circumstances import Circumstances
from thesis.report.contents import Contents
from thesis.report.reproduction import write_report
from thesis.report.summary import summary

PERCENT = "\N{THIN SPACE}%"


def contents_of(record, repeats=4, **known):
    return Contents(record, None, Circumstances(**known), repeats=repeats)


@pytest.fixture(scope="module")
def contents():
    return contents_of(made.synthetic(repeats=4, epochs=60))


@pytest.fixture(scope="module")
def text(contents):
    return summary(contents)


def rows(text, label):
    return [
        [cell.strip().strip("*") for cell in line.split("|")[2:-1]]
        for line in text.splitlines()
        if line.startswith(f"| {label} |")
    ]


# --- a whole record -------------------------------------------------------------------------------


def test_the_document_has_the_verdict_of_every_finding_of_the_page(contents, text):
    for finding in contents.findings:
        (line,) = [one for one in text.splitlines() if one.startswith(f"| {finding.claim} |")]
        for verdict in finding.verdicts.values():
            said = f"{verdict.word} ({verdict.count})" if verdict.count else verdict.word
            assert said in line
    assert "160 of 160 runs" in text
    assert "left open" not in text


def test_its_differences_are_those_of_the_paired_tests(contents, text):
    pairs = contents.families["against_fair", "honest"]
    (cells,) = rows(text, "ODE-RNN minus Fair GRU")
    for cell, fraction in zip(cells, thesis.FRACTIONS, strict=True):
        (pair,) = [p for p in pairs if (p.a, p.b, p.fraction) == ("ode_rnn", "gru_fair", fraction)]
        assert cell.startswith(f"{pair.result.difference.value:+.5f}".replace("-", "−"))
        assert f"({findings.p_text(pair.t_holm).removeprefix('p ').removeprefix('= ')})" in cell


def test_what_is_left_of_an_advantage_is_one_difference_over_another(contents, text):
    label = "ODE-RNN minus Fair GRU, of that minus GRU"
    _, honest = rows(text, label)

    def mean(model):
        at = contents.record.where(experiment=2, model=model, fraction=0.3)
        return contents.record.rmse("honest", at).mean()

    left = (mean("ode_rnn") - mean("gru_fair")) / (mean("ode_rnn") - mean("gru"))
    assert honest[3].endswith(f"({100 * left:.0f}{PERCENT})")


def test_the_constant_is_that_of_the_record(contents, text):
    record = contents.record
    at = record.where(experiment=2, model="ode_gru_d", fraction=0.3)
    own = made.CONSTANT * record.values("hidden_rows_0_share", at) / 100
    mse = record.values("published_mse", at)
    (cells,) = rows(text, "Its fraction of the published MSE of ODE-GRU-D, ours")
    assert cells[3] == f"{100 * np.mean(own / mse):.0f}{PERCENT}"
    (spread,) = rows(text, "The same, if nothing but the constant varied")
    rest = (mse - own).mean()
    assert spread[3] == f"{np.sqrt(own + rest).std(ddof=1):.4f}"
    (inferred,) = rows(
        text, "Its fraction of the squared RMSE of ODE-GRU-D in the thesis (inferred)"
    )
    assert inferred[0] == f"{100 * made.CONSTANT * 0.1 / 100 / 0.0369**2:.0f}{PERCENT}"


def test_the_spread_that_the_constant_makes_is_held_against_the_inference(contents, text):
    inferred = text.split("## What is inferred about the thesis")[1].split("\n## ")[0]
    record, more = contents.record, []
    for fraction, (_, printed) in zip(thesis.FRACTIONS, thesis.TEST_RMSE["ode_gru_d"], strict=True):
        runs = record.where(experiment=2, model="ode_gru_d", fraction=fraction)
        mse, constant, hidden = (
            record.values(name, runs).astype(float)
            for name in ("published_mse", "row_0_constant", "hidden_rows_0_share")
        )
        varying = constant * hidden / 100
        spread = np.std(np.sqrt((mse - varying).mean() + varying), ddof=1)
        if spread > printed:
            more.append(f"{100 * fraction:.0f}")
    told = inferred.split("the thesis prints for ODE-GRU-D at ")
    assert bool(more) == (len(told) == 2)
    if more:
        assert re.findall(r"\d+", told[1].split(".")[0]) == more


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("results/thesis", "results/thesis"),
        ("/home/someone/runs", "runs/thesis"),
        ("../elsewhere", "runs/thesis"),
        ("the record", "runs/thesis"),
    ],
)
def test_the_command_names_the_folder_of_the_record_and_no_path_of_a_machine(source, said):
    record = made.synthetic(repeats=1, epochs=2, fractions=(0.9,), experiments=(2,))
    text = summary(contents_of(made.Record(record.runs, record.curves, source), repeats=10))
    assert f"python -m thesis report {said} --out runs/report --summary" in text
    assert "someone" not in text


# --- a part of one --------------------------------------------------------------------------------


def test_a_part_of_a_record_says_how_much_and_tells_nothing():
    record = made.synthetic(repeats=1, epochs=60, fractions=(0.9,), experiments=(2,))
    two = made.without(record, ~np.isin(record.runs["model"], ("gru", "gru_d")))
    text = summary(contents_of(two, repeats=10))
    assert "**2 of 376 runs.**" in text
    assert "Experiment 1, of 1 each: GRU, GRU-D, ODE-RNN, ODE-GRU-D: none." in text
    assert "GRU, GRU-D: 1, 0, 0, 0; ODE-RNN, ODE-GRU-D, Fair GRU" in text
    table = text.split("## Conclusions of the thesis")[1].split("\n## ")[0]
    for line in table.splitlines():
        if line.startswith("| ") and not line.startswith("| Claim"):
            assert findings.MISSING in line
            assert findings.HOLDS not in line.split("|", 3)[3]
    assert "0 of 132 comparisons can be made yet" in text
    assert "Still to run (estimate)" in text


def test_columns_with_a_hole_have_no_best_cell():
    record = made.synthetic(repeats=1, epochs=60, fractions=(0.9,), experiments=(2,))
    two = made.without(record, ~np.isin(record.runs["model"], ("gru", "gru_d")))
    table = contents_of(two, repeats=10).tables["3.6"]
    ours = [block for block in table.blocks if block.heading.startswith("Ours")]
    assert not any(cell.bold for block in ours for _, cells in block.rows for cell in cells)


def test_too_few_repeats_are_counted():
    record = made.synthetic(repeats=2, epochs=2, fractions=(0.9,), experiments=(2,))
    contents = contents_of(record, repeats=10)
    pairs = contents.families["ode_models", "honest"]
    assert [p.missing for p in pairs[:2]] == [
        "2 repeats have both, a test needs at least 3",
        "no repeats have both, a test needs at least 3",
    ]
    assert contents.rules["ode_rnn", "honest"][0].missing == pairs[0].missing
    assert contents.spreads["honest"][0].missing == pairs[0].missing


# --- convergence ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def falling():
    """Curves without noise: what is left to learn halves in a known number of epochs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(made.np.random, "default_rng", lambda seed: _Still())
        return made.synthetic(repeats=3, epochs=300, fractions=(0.9,))


class _Still:
    """A generator that always draws the middle."""

    def standard_normal(self):
        return 0.0

    def binomial(self, n, p):
        return n * p


def test_epochs_of_a_known_curve_are_those_of_its_closed_form(falling):
    by = {one.model: one for one in convergence.choices(falling, "honest") if one.fraction == 0.9}
    for model, half in made.HALVING.items():
        left = 4 * 0.5 ** (300 / half)
        settled = int(np.ceil(half * np.log2(4 / (0.05 * (1 + left) + left))))
        one = by[model]
        assert (one.reached, one.settled, one.epochs) == (settled, settled, 300)
        assert one.ratio == pytest.approx((1 + 4 * 0.5 ** (75 / half)) / (1 + left))
        assert one.follows == (settled <= 75)
    table = convergence.choice_table(falling, number="A.13")
    cells = dict(table.blocks[1].rows)["ODE-GRU-D"]
    assert cells[0].text == f"{by['ode_gru_d'].ratio:.2f} (76, 76)"  # one epoch after the choice
    assert not cells[0].bold
    assert cells[1].text == "–"


def test_a_curve_that_still_falls_is_said_to(falling):
    said = " ".join(
        convergence.speed_verdicts(falling)["Scoring after the first observation"].evidence
    )

    def trend(half):
        epochs = np.arange(66, 76)
        curve = np.log(1 + 4 * 0.5 ** (epochs / half))
        return f"{100 * np.expm1(np.polyfit(epochs, curve, 1)[0]):+.2f}".replace("-", "−")

    assert f"ODE-GRU-D {trend(12)} and ODE-RNN {trend(30)}" in said
    assert "not when the model had converged" in said


def test_when_one_model_is_as_good_as_the_other_becomes_is_told(falling):
    # 0.00066 (1 + 4 / 2^(e / 12)) falls below 0.00073 (1 + 4 / 2^(75 / 30)).
    end = 0.00073 * (1 + 4 * 0.5 ** (75 / 30))
    epoch = int(np.ceil(12 * np.log2(4 / (end / 0.00066 - 1))))
    said = " ".join(
        convergence.speed_verdicts(falling)["Scoring after the first observation"].evidence
    )
    assert f"90{PERCENT}: in 3 of 3 repeats, median epoch {epoch}" in said


def test_the_margin_that_the_constant_leaves_is_told(falling):
    note = convergence.speed_table(falling, number="A.12").notes[-2]
    at = falling.where(experiment=2, model="ode_gru_d", fraction=0.9)
    share = made.CONSTANT * 0.1 / 100 / falling.values("published_mse", at).mean()
    assert f"{100 * share:.0f}{PERCENT} at 90{PERCENT}" in note


@pytest.mark.parametrize(
    ("numbers", "count"),
    [
        ((4, 4, 4, 0), "4 of 4 parts"),
        ((4, 4, 2, 1), "2 of 4 parts, 1 against, 1 not decided"),
        ((4, 3, 3, 0), "3 of 4 parts can be tested yet"),
        ((1, 1, 1, 0), ""),
    ],
)
def test_a_verdict_says_how_many_parts_hold(numbers, count):
    assert findings.judged(*numbers, ()).count == count


# --- time -----------------------------------------------------------------------------------------


def test_what_is_left_is_judged_by_what_an_epoch_has_taken():
    record = made.synthetic(repeats=1, epochs=300, fractions=(0.9,), experiments=(2,))
    two = made.without(record, ~np.isin(record.runs["model"], ("gru", "ode_rnn")))
    seconds = np.where(two.runs["model"] == "gru", 75 * 2.0, 75 * 10.0)
    ends = ("2026-01-01T10:00:00+00:00", "2026-01-01T10:10:00+00:00")
    timed = made.changed(two, slice(None), seconds=seconds, finished_at=ends)
    left = circumstances.time_left(timed, Circumstances(engines=("2 processes of 1 thread",)))
    # 10 repeats of 75 + 3 x 50 epochs and 4 x 300 epochs; what has no run costs the mean, 6 s.
    epochs = {"gru": 225 * 10 + 1200, "gru_d": 225 * 10 + 1200, "fair": 225 * 10}
    known = (epochs["gru"] - 75) * (2.0 + 10.0)
    guessed = (2 * epochs["gru_d"] + 5 * epochs["fair"]) * 6.0
    assert left.runs == 374
    assert left.run_s == pytest.approx(known + guessed)
    assert left.at_a_time == 2
    others = ("gru_fair", "gru_d_fair", "anchored_ode_gru_d", "gru_unfed", "gru_d_unfed")
    assert left.guessed == ("gru_d", "ode_gru_d", *others)
    # Without a word of the engine: 900 s of runs in the 15 minutes before the last end.
    alone = circumstances.time_left(timed, Circumstances())
    assert alone.at_a_time == pytest.approx(900 / circumstances.wall_hours(timed) / 3600)
    found = dict(circumstances.time_rows(timed, Circumstances(engines=("2 processes of x",))))
    assert found["Still to run (estimate)"].startswith("374 runs, about ")
    assert "at 2 runs at a time" in found["Still to run (estimate)"]
    assert "no run yet of GRU-D" in found["Basis of the estimate"]


def test_a_whole_record_has_nothing_left_to_estimate(contents):
    known = Circumstances(protocol={"repeats": 4, "of another version": 1})
    assert circumstances.time_left(contents.record, known) is None
    strange = Circumstances(protocol={"repeats": "many"})
    assert circumstances.time_left(contents.record, strange) is None


def test_several_sessions_of_several_processes_are_added_up(tmp_path):
    sessions = [
        {"seconds": 3600.0, "engine": "2 processes of 1 thread"},
        {"seconds": 1800.0, "engine": "1 process of 1 thread"},
        {"seconds": 600.0, "engine": "2 processes of 1 thread"},
    ]
    (tmp_path / "sessions.json").write_text(json.dumps(sessions))
    known = Circumstances.of(tmp_path)
    assert (known.sessions, known.sessions_s, known.processes) == (3, 6000.0, 2)
    found = dict(circumstances.time_rows(made.synthetic(repeats=1, epochs=2), known))
    assert found["Wall time of all sessions"] == "100 min, 3 sessions"


# --- files ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_command_writes_the_document_where_it_is_told(tmp_path, capsys):
    record = made.synthetic(repeats=1, epochs=2, fractions=(0.9,), experiments=(2,))
    two = made.without(record, np.arange(len(record)) > 1)
    made.write(two, tmp_path / "runs")
    where = tmp_path / "docs" / "reproduction.md"
    options = ["--illustrate", "false", "--summary", str(where), "--json"]
    code = thesis_main(["report", str(tmp_path / "runs"), "--out", str(tmp_path / "out"), *options])
    assert code == 0
    assert json.loads(capsys.readouterr().out)["summary"] == str(where)
    assert where.read_text(encoding="utf-8").startswith("# The thesis, reproduced")
    assert not (tmp_path / "out" / "summary.md").exists()
    with pytest.raises(InputError, match="give the name of a file"):
        write_report(two, tmp_path / "out", summary=tmp_path)


def test_what_is_published_names_no_folder_of_a_machine():
    root = Path(__file__).parents[2]
    about = json.loads((root / "results/thesis/about.json").read_text(encoding="utf-8"))
    assert not [word for line in about["commands"] for word in line if word.startswith("/")]
    assert about["runs_done"] == about["runs_total"] == len(Protocol().runs())
    document = (root / "docs/reproduction.md").read_text(encoding="utf-8")
    assert "**376 of 376 runs.**" in document
    assert not re.search(r"--?\w+[ =]/", document)
