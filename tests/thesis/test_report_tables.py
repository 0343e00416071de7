"""Tables: what they hold, what they mark, and what they become."""

import csv
import io
import os
import re
from pathlib import Path

import numpy as np
import pytest
import record_helpers as made
from scipy import stats

from offbeat.errors import InputError
from thesis.report import (
    convergence,
    findings,
    pairing,
    stability,
    tables,
    tables_beyond,
    tables_tests,
)
from thesis.report import thesis_numbers as thesis
from thesis.report.table import MIXED, Block, Cell, Table, bold_lowest


@pytest.fixture(scope="module")
def record():
    return made.synthetic(repeats=6, epochs=300)


def rows_of(table, heading):
    (block,) = [b for b in table.blocks if b.heading == heading]
    return dict(block.rows)


# --- the thesis' numbers --------------------------------------------------------------------------


def thesis_text():
    data = os.environ.get("OFFBEAT_DATA")
    shared = Path(data).parent if data else Path(__file__).parents[2] / "shared"
    path = shared / "reference" / "thesis.txt"
    if not path.is_file():
        pytest.skip("the text of the thesis is not here")
    return path.read_text(encoding="utf-8")


def printed(text, number):
    """The rows above the caption of a table: name and cells."""
    lines = text[: text.index(f"\nTable {number}: ")].rstrip().splitlines()
    rows = []
    while "\t" in lines[-1]:
        name, *cells = lines.pop().split("\t")
        rows.insert(0, (name, cells))
    return dict(rows[1:])


def test_every_number_is_the_one_that_the_thesis_prints():
    text = thesis_text()
    names = {"gru": "GRU", "gru_d": "GRU-D", "ode_rnn": "ODE-RNN", "ode_gru_d": "ODE-GRU-D"}
    for fraction, number in thesis.CURVE_TABLES.items():
        for model, cells in printed(text, number).items():
            key = {v: k for k, v in names.items()}[model]
            assert tuple(map(float, cells)) == thesis.VALIDATION_MSE[fraction][key]
    for key, name in names.items():
        assert tuple(map(float, printed(text, "3.5")[name])) == thesis.TEST_MSE[key]
        pairs = [tuple(map(float, c.split("±"))) for c in printed(text, "3.6")[name]]
        assert tuple(pairs) == thesis.TEST_RMSE[key]
    for key in ("ode_rnn", "ode_gru_d"):
        assert tuple(map(float, printed(text, "3.7")[names[key]])) == thesis.SHAPIRO_P[key]
    tests = printed(text, "3.8")
    for key, name in (("bartlett", "Bartlett"), ("two_sample_t", "Two"), ("welch", "Welch")):
        (cells,) = [cells for row, cells in tests.items() if row.startswith(name)]
        assert tuple(None if c == "-" else float(c) for c in cells) == thesis.TEST_P[key]


def test_the_slips_that_are_noted_are_there():
    at_50 = {model: values[0] for model, values in thesis.VALIDATION_MSE[0.3].items()}
    assert at_50["ode_rnn"] < at_50["ode_gru_d"]
    assert set(thesis.SLIPS) == {"3.4", "3.8"}
    assert thesis.TEST_P["bartlett"][0] == 0.9576
    assert thesis.TEST_P["two_sample_t"][0] == 0.4557


# --- what a table becomes -------------------------------------------------------------------------

SMALL = Table(
    "A.1",
    "Errors, 90 % & more.",
    "Model",
    ("90 %", "x_1"),
    (
        Block("First", (("GRU", (Cell("0.1 ± 0.2", 0.1, 0.2, 3, bold=True), Cell())),)),
        Block(
            "Second",
            (
                (
                    "A < B",
                    (Cell("−1", -1.0, mark=MIXED), Cell("2", 2.0)),
                ),
            ),
        ),
    ),
    ("A note.",),
)


def test_a_table_as_csv_has_a_line_per_cell_and_numbers_to_the_last_bit():
    table = Table("1", "c", "m", ("a",), (Block("b", (("r", (Cell("0.3", 0.1 + 0.2, n=2),)),)),))
    assert table.to_csv() == (
        "block,row,column,value,std,n,bold,mark,text\nb,r,a,0.30000000000000004,,2,false,,0.3\n"
    )
    assert float(next(csv.DictReader(io.StringIO(table.to_csv())))["value"]) == 0.1 + 0.2


def test_a_table_as_markdown():
    assert SMALL.to_markdown() == (
        "**Table A.1.** Errors, 90 % & more.\n\n"
        "| Model | 90 % | x_1 |\n|---|---|---|\n"
        "| *First* | | |\n| GRU | **0.1 ± 0.2** | – |\n"
        "| *Second* | | |\n| A < B | −1† | 2 |\n"
        "\nA note.\n"
    )


def test_a_table_as_latex_escapes_what_latex_would_read():
    assert SMALL.to_latex() == (
        "\\begin{table}\n  \\centering\n  \\caption{Errors, 90 \\% \\& more.}\n  \\label{tab:a-1}\n"
        "  \\small\n"
        "  \\begin{tabular}{lrr}\n    \\toprule\n    Model & 90 \\% & x\\_1 \\\\\n    \\midrule\n"
        "    \\multicolumn{3}{l}{\\emph{First}} \\\\\n"
        "    GRU & \\textbf{0.1 $\\pm$ 0.2} & -- \\\\\n    \\midrule\n"
        "    \\multicolumn{3}{l}{\\emph{Second}} \\\\\n"
        "    A $<$ B & $-$1$^{\\dagger}$ & 2 \\\\\n    \\bottomrule\n  \\end{tabular}\n"
        "  \\par\\smallskip\\footnotesize A note.\n\\end{table}\n"
    )


def test_a_table_as_html_has_a_caption_header_cells_and_nothing_unescaped():
    html = SMALL.to_html()
    assert "<caption><span><b>Table A.1.</b> Errors, 90 % &amp; more.</span></caption>" in html
    assert '<th scope="col">90 %</th>' in html
    assert '<th scope="row">A &lt; B</th>' in html
    assert "<td><b>0.1 ± 0.2</b></td>" in html
    assert "<td>−1<sup>†</sup></td>" in html


def test_a_row_of_the_wrong_length_is_refused():
    with pytest.raises(InputError, match="row 'r' has 1 cells for 2 columns"):
        Table("1", "c", "m", ("a", "b"), (Block("b", (("r", (Cell(),)),)),))


def test_the_lowest_of_a_column_is_bold_and_so_is_what_prints_alike():
    rows = bold_lowest(
        [
            ("a", [Cell("0.0100 ± 0.0010", 0.01001), Cell("5", 5.0), Cell()]),
            ("b", [Cell("0.0100 ± 0.0020", 0.01004), Cell("3", 3.0), Cell("3", 3.0)]),
            ("c", [Cell("0.0101 ± 0.0001", 0.01006), Cell("4", 4.0), Cell("4", 4.0)]),
        ]
    )
    assert [[cell.bold for cell in cells] for _, cells in rows] == [
        [True, False, False],
        [True, True, False],  # the last column lacks a number, and has no best one yet
        [False, False, False],
    ]


# --- tables 3.1 to 3.6 ----------------------------------------------------------------------------


def test_the_thesis_block_has_its_best_cells_bold():
    record = made.synthetic(repeats=1, epochs=2, fractions=(0.3,))
    block = rows_of(tables.curve_table(record, 0.3), "Thesis")
    bold = {model: [cell.bold for cell in cells] for model, cells in block.items()}
    assert bold["ODE-RNN"] == [True, False, False, False, True, False]
    assert bold["ODE-GRU-D"] == [False, True, True, True, True, True]  # a tie at epoch 250
    assert not any(bold["GRU"] + bold["GRU-D"])


def test_a_curve_table_reads_the_curves_at_the_epochs_of_the_thesis(record):
    table = tables.curve_table(record, 0.5)
    curve = record.curve("e1-ode_rnn-50-r00")
    for scoring, heading in (("published", "Ours, published scoring"), ("honest", None)):
        cells = rows_of(table, heading or "Ours, scoring after the first observation")["ODE-RNN"]
        expected = [curve[f"validation_{scoring}_mse"][epoch - 1] for epoch in thesis.EPOCHS]
        assert [cell.value for cell in cells] == expected


def test_the_last_value_stands_in_every_block_of_ours(record):
    run = int(np.flatnonzero(record.runs["run_id"] == "e1-gru-70-r00")[0])
    table = tables.final_table(record)
    for scoring in ("published", "honest"):
        cells = rows_of(table, tables.HEADINGS[scoring])["Last value"]
        assert cells[1].value == record.runs[f"last_value_{scoring}_mse"][run]


def test_the_repeats_are_averaged_with_n_minus_1(record):
    rows = record.where(experiment=2, model="gru_d", fraction=0.7)
    rmse = np.sqrt(record.values("published_mse", rows))
    table = tables.repeats_table(record, repeats=6)
    cell = rows_of(table, "Ours, published scoring")["GRU-D"][1]
    mean, std = rmse.sum() / 6, np.sqrt(((rmse - rmse.mean()) ** 2).sum() / 5)
    assert (cell.value, cell.spread, cell.n) == pytest.approx((mean, std, 6))
    assert cell.text == f"{mean:.4f} ± {std:.4f}"


def test_missing_repeats_are_counted_in_the_cell_and_named_below(record):
    gone = (record.runs["model"] == "gru") & (record.runs["repeat"] >= 4)
    gone |= (record.runs["model"] == "gru_d") & (record.runs["experiment"] == 2)
    table = tables.repeats_table(made.without(record, gone), repeats=6)
    block = rows_of(table, "Ours, scoring after the first observation")
    assert block["GRU"][0].text.endswith(" (4 of 6)")
    assert [cell.text for cell in block["GRU-D"]] == ["–"] * 4
    (note,) = [n for n in table.notes if "runs of experiment 2 are there" in n]
    assert note.startswith("64 of 96 runs of experiment 2")  # 4 models, 4 shares, 6 repeats
    runs = tables_beyond.runs_table(made.without(record, gone), repeats=6, number="A.14")
    counts = rows_of(runs, "Experiment 2")
    assert [cell.text for cell in counts["GRU"]] == ["4 of 6"] * 4
    assert [cell.text for cell in counts["GRU-D"]] == ["0 of 6"] * 4
    assert [cell.bold for cell in counts["ODE-RNN"]] == [False] * 4
    assert [cell.text for cell in rows_of(runs, "Experiment 1")["GRU-D"]] == ["1 of 1"] * 4


def test_a_number_whose_runs_were_not_made_alike_is_marked_and_no_other(record):
    at = np.flatnonzero(record.runs["run_id"] == "e2-gru_d-90-r00")
    table = tables.repeats_table(made.changed(record, at, kernel_body="other"), repeats=6)
    marked = [
        (block.heading, label, i)
        for block in table.blocks
        for label, cells in block.rows
        for i, cell in enumerate(cells)
        if cell.mark
    ]
    assert marked == [
        ("Ours, published scoring", "GRU-D", 0),
        ("Ours, scoring after the first observation", "GRU-D", 0),
    ]
    assert any(note.startswith(MIXED) for note in table.notes)
    assert not any(n.startswith(MIXED) for n in tables.repeats_table(record, repeats=6).notes)


# --- tables of tests ------------------------------------------------------------------------------


def test_table_3_7_is_shapiro_wilk_on_the_rmse(record):
    table = tables_tests.normality_table(record)
    rows = record.where(experiment=2, model="ode_rnn", fraction=0.5)
    expected = stats.shapiro(np.sqrt(record.values("honest_mse", rows))).pvalue
    cell = rows_of(table, "Ours, scoring after the first observation")["ODE-RNN"][2]
    assert cell.value == pytest.approx(expected)
    assert [c.value for c in rows_of(table, "Thesis")["ODE-GRU-D"]] == [
        0.0638,
        0.9261,
        0.8953,
        0.1214,
    ]


def rmse(record, model, fraction, scoring="published"):
    rows = record.where(experiment=2, model=model, fraction=fraction)
    return np.sqrt(record.values(f"{scoring}_mse", rows).astype(float))


def test_table_3_8_takes_the_t_test_that_bartlett_chooses(record):
    wide = record.runs["published_mse"].astype(float)
    chosen = (record.runs["model"] == "ode_rnn") & (record.runs["observed_fraction"] == 0.7)
    spread = np.where(record.runs["repeat"] % 2, 1.3, 0.7)
    strange = made.changed(record, chosen, published_mse=(wide * spread)[chosen])
    rules = {("ode_rnn", "published"): pairing.thesis_rule(strange, "published")}
    heading = "Ours, published scoring: ODE-RNN and ODE-GRU-D"
    block = rows_of(tables_tests.rule_table(strange, rules), heading)
    for i, fraction in enumerate(thesis.FRACTIONS):
        a, b = rmse(strange, "ode_rnn", fraction), rmse(strange, "ode_gru_d", fraction)
        equal = stats.bartlett(a, b).pvalue > 0.05
        assert equal == (fraction != 0.7)
        assert block["Bartlett"][i].value == pytest.approx(stats.bartlett(a, b).pvalue)
        t = stats.ttest_ind(a, b, equal_var=equal).pvalue
        assert block["Two-sample t" if equal else "Welch's t"][i].value == pytest.approx(t)
        assert block["Welch's t" if equal else "Two-sample t"][i].text == "–"


def test_paired_tests_are_corrected_over_the_shares(record):
    pairs = pairing.family(record, "ode_models", "honest")
    raw = [
        stats.ttest_rel(
            rmse(record, "ode_gru_d", f, "honest"), rmse(record, "ode_rnn", f, "honest")
        ).pvalue
        for f in thesis.FRACTIONS
    ]
    order = np.argsort(raw)
    stepped = np.maximum.accumulate([(4 - i) * raw[j] for i, j in enumerate(order)])
    assert [pairs[j].t_holm for j in order] == pytest.approx(np.minimum(1, stepped))
    table = tables_tests.paired_table(record, pairs, number="A.3", scoring="honest")
    cells = dict(table.blocks[0].rows)["Mean difference"]
    difference = rmse(record, "ode_gru_d", 0.3, "honest") - rmse(record, "ode_rnn", 0.3, "honest")
    assert cells[3].value == pytest.approx(difference.mean())
    assert cells[3].text.startswith("−0.00")


def test_a_table_of_pairs_says_how_many_lack_runs(record):
    part = made.without(record, record.runs["model"] == "gru_fair")
    pairs = pairing.family(part, "against_fair", "honest")
    table = tables_tests.family_table(part, {"x": pairs}, number="A.5", caption="c")
    rows = dict(table.blocks[0].rows)
    assert [cell.text for cell in rows["ODE-RNN − Fair GRU"]] == ["–"] * 4
    assert all(cell.value is not None for cell in rows["ODE-RNN − Fair GRU-D"])
    assert "(8)" in table.notes[-1]


def test_the_last_value_is_compared_in_the_same_repeats(record):
    ours, trivial = pairing.paired_rmse(record, "gru", "last_value", 0.5, "honest")
    rows = record.where(experiment=2, model="gru", fraction=0.5)
    np.testing.assert_allclose(ours**2, record.values("honest_mse", rows))
    np.testing.assert_allclose(trivial**2, record.values("last_value_honest_mse", rows))


# --- beyond ---------------------------------------------------------------------------------------


def test_the_distance_from_the_thesis_is_in_its_standard_deviations(record):
    table = tables_beyond.distance_table(record, number="A.9")
    block = dict(table.blocks[0].rows)
    cell = block["ODE-RNN"][3]
    assert cell.value == pytest.approx((rmse(record, "ode_rnn", 0.3).mean() - 0.1019) / 0.0006)
    assert cell.bold == (abs(cell.value) <= 2)
    found = dict(table.blocks[1].rows)
    assert [c.value for c in found["Mean square of row 0, c"]] == pytest.approx([made.CONSTANT] * 4)


def test_the_constant_that_is_needed_gives_the_mean_of_the_thesis(record):
    table = tables_beyond.distance_table(record, number="A.1")
    needed = [cell.value for _, cells in table.blocks[2].rows for cell in cells]
    assert any(needed)
    for (_, cells), model in zip(table.blocks[2].rows, thesis.MODELS, strict=True):
        for cell, fraction, (mean, _) in zip(
            cells, thesis.FRACTIONS, thesis.TEST_RMSE[model], strict=True
        ):
            runs = record.where(experiment=2, model=model, fraction=fraction)
            rest = record.values("rows_1_99_mse", runs).astype(float) * 0.99
            share = record.values("hidden_rows_0_share", runs).astype(float) / 100
            reached = np.sqrt(rest + (cell.value or 0.0) * share).mean()
            assert reached == pytest.approx(mean) if cell.value else reached > mean


def test_the_first_row_explains_the_published_score_and_a_slip_shows(record):
    assert tables_beyond.constant_residual(record) < 1e-12
    score = 1.01 * record.runs["published_mse"][5]
    wrong = made.changed(record, 5, published_mse=score)
    assert tables_beyond.constant_residual(wrong) == pytest.approx(0.01 / 1.01, rel=1e-6)


def test_run_times_are_summed_in_minutes_and_per_step(record):
    table = tables_beyond.cost_table(record, number="A.13")
    row = rows_of(table, "Experiment 2")["GRU"]
    assert row[0].value == pytest.approx(6 * 75 * 1.5 / 60)
    assert row[4].value == pytest.approx(6 * (75 + 3 * 50) * 1.5 / 60)
    assert row[6].value == pytest.approx(1000 * 1.5 / 140)
    assert "Anchored ODE-GRU-D" not in rows_of(table, "Experiment 1")


def test_a_run_has_settled_when_it_stays_within_5_percent_of_its_end(record):
    table = convergence.speed_table(record, number="A.11")
    cell = rows_of(table, "Experiment 1, scoring after the first observation")["ODE-GRU-D"][3]
    curve = record.curve("e1-ode_gru_d-30-r00")["validation_honest_mse"]
    away = np.flatnonzero(curve > 1.05 * curve[-1])
    assert cell.value == away[-1] + 2
    many = rows_of(table, "Experiment 2, scoring after the first observation")["ODE-GRU-D"][3]
    assert (many.n, bool(re.fullmatch(r"\d+\.\d \[\d+\.\d, \d+\.\d\]", many.text))) == (6, True)


def test_the_spread_table_has_ours_over_the_others(record):
    found = {scoring: stability.spreads(record, scoring) for scoring in findings.SCORINGS}
    table = stability.spread_table(record, found, number="A.10")
    cell = rows_of(table, "Ours, scoring after the first observation")["ODE-RNN"][0]
    mine, other = (rmse(record, m, 0.9, "honest").std(ddof=1) for m in ("ode_gru_d", "ode_rnn"))
    assert cell.value == pytest.approx(other)
    assert cell.text == f"{other:.5f} ({mine / other:.2f})"


def test_ranks_follow_the_errors_of_each_repeat(record):
    results = pairing.ranks(record, "honest")
    table = tables_tests.ranks_table(results, number="A.12", scoring="honest")
    cells = rows_of(table, "Average rank")["Anchored ODE-GRU-D"]
    assert [cell.value for cell in cells] == [1.0] * 4  # half the error of the next, in each repeat
    assert all(cell.bold for cell in cells)


def test_too_few_repeats_leave_tables_of_tests_empty_with_a_reason():
    record = made.synthetic(repeats=2, epochs=2, fractions=(0.3,), experiments=(2,))
    rules = {("ode_rnn", "honest"): pairing.thesis_rule(record, "honest")}
    table = tables_tests.rule_table(record, rules)
    assert all(c.text == "–" for _, cells in table.blocks[1].rows for c in cells)
    assert "at least 3" in table.notes[-1]
    ranked = tables_tests.ranks_table(pairing.ranks(record, "honest"), number="A", scoring="honest")
    assert [block.heading for block in ranked.blocks] == ["Test"]
    assert "at least 3" in ranked.notes[-1]
