"""Any runs compared: pairs of runs, results, and output."""

import csv
import json
import math
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import offbeat as ob
from offbeat.cli.app import main
from offbeat.comparison import Run, compare, read_runs
from offbeat.comparison.run_files import LAST_VALUE, METRICS
from offbeat.comparison.runs import parse_only
from offbeat.comparison.statistics import friedman, holm, paired_comparison, thesis_test
from offbeat.errors import FileFormatError, InputError
from offbeat.metrics import SCORINGS
from offbeat.plots.ranks import ranks_figure
from offbeat.plots.style import STYLES, style_of
from offbeat.tables import escape_latex

LEVELS = {"gru": 0.030, "ode_rnn": 0.0275, "ode_gru_d": 0.027, "anchored_ode_gru_d": 0.019}


def rows(models=LEVELS, repeats=6, fractions=(0.3,), experiment=2, seed=0):
    """Rows of a record: models share a part of the error in each repeat."""
    random = np.random.default_rng(seed)
    found = []
    for fraction in fractions:
        for repeat in range(repeats):
            shared = random.normal(0, 0.001)
            for model, level in dict(models).items():
                honest = (level + shared + random.normal(0, 0.0002)) ** 2
                found.append({
                    "run_id": f"{experiment}-{model}-{fraction}-{repeat}",
                    "experiment": experiment,
                    "model": model,
                    "observed_fraction": fraction,
                    "repeat": repeat,
                    "after_first_observation_mse": honest,
                    "published_mse": 0.01 + honest,
                    "last_value_after_first_observation_mse": (0.0345 + shared) ** 2,
                    "last_value_published_mse": 0.011 + shared**2,
                    "commit": "1234567",
                    "cpu": "one",
                })  # fmt: skip
    return found


def write(path, table):
    if path.suffix == ".parquet":
        pq.write_table(pa.Table.from_pylist(table), path)
    else:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, table[0])
            writer.writeheader()
            writer.writerows(table)
    return path


@pytest.fixture
def record(tmp_path):
    return write(tmp_path / "record.parquet", rows(fractions=(0.9, 0.3)))


def values(table, model, fraction=0.3, metric="after_first_observation"):
    chosen = [r for r in table if (r["model"], r["observed_fraction"]) == (model, fraction)]
    return [r[f"{metric}_mse"] ** 0.5 for r in sorted(chosen, key=lambda r: r["repeat"])]


# --- what is found --------------------------------------------------------------------------------


def test_every_number_is_that_of_the_statistics(record):
    table = rows(fractions=(0.9, 0.3))
    found = compare(record, models=["ode_rnn", "ode_gru_d"], resamples=500, seed=4)
    assert [c.condition for c in found.conditions] == [
        "experiment 2, observed_fraction 0.9",
        "experiment 2, observed_fraction 0.3",
    ]
    p = []
    for condition, fraction in zip(found.conditions, (0.9, 0.3), strict=True):
        a, b = (values(table, m, fraction) for m in ("ode_rnn", "ode_gru_d"))
        names = ("ode_rnn", "ode_gru_d")
        (pair,) = condition.pairs
        assert pair.paired == paired_comparison(a, b, resamples=500, seed=4, names=names)
        assert pair.thesis == thesis_test(a, b)
        assert condition.friedman is None
        p.append(pair.paired.paired_t.p)
    assert found.family == 2
    assert tuple(c.pairs[0].paired_t_holm for c in found.conditions) == holm(p)


def test_all_pairs_are_compared_without_a_baseline_and_only_those_with_it_else(record):
    every = compare(record, resamples=200)
    assert every.family == 2 * 6
    one = compare(record, baseline="gru", resamples=200)
    assert [(p.first, p.second) for p in one.conditions[0].pairs] == [
        ("ode_rnn", "gru"),
        ("ode_gru_d", "gru"),
        ("anchored_ode_gru_d", "gru"),
    ]
    assert {p.better for p in one.conditions[1].pairs} == {
        "ode_rnn",
        "ode_gru_d",
        "anchored_ode_gru_d",
    }
    scores = {m: values(rows(fractions=(0.9, 0.3)), m) for m in LEVELS}
    assert every.conditions[1].friedman == friedman(scores)


def test_a_difference_that_is_not_there_is_not_found(tmp_path):
    table = rows({"gru": 0.03, "lstm": 0.03, "rnn": 0.03}, repeats=10)
    found = compare(write(tmp_path / "a.csv", table), resamples=200)
    assert [p.better for p in found.conditions[0].pairs] == [None, None, None]
    assert "no significant difference" in found.text()


def test_the_summary_holds_the_last_value_and_names_the_best_first(record):
    summaries = compare(record, resamples=200).conditions[1].summaries
    assert [s.model for s in summaries] == [
        "anchored_ode_gru_d", "ode_gru_d", "ode_rnn", "gru", "last_value",
    ]  # fmt: skip
    gru, mine = summaries[3], values(rows(fractions=(0.9, 0.3)), "gru")
    assert gru.values == tuple(mine)
    assert gru.std == pytest.approx(np.std(mine, ddof=1))
    assert (gru.minimum, gru.median, gru.maximum) == (min(mine), np.median(mine), max(mine))


def test_the_trivial_predictor_can_be_the_baseline(record):
    found = compare(record, baseline=LAST_VALUE, models=["gru"], resamples=200)
    (pair,) = found.conditions[1].pairs
    assert (pair.first, pair.second, pair.better) == ("gru", LAST_VALUE, "gru")


def test_metric_and_error_choose_what_is_compared(record):
    rmse = compare(record, metric="published", resamples=200).conditions[1].summaries
    mse = compare(record, metric="published", error="mse", resamples=200).conditions[1].summaries
    by_name = {s.model: s.values for s in rmse}
    for summary in mse:
        assert summary.values == pytest.approx([v**2 for v in by_name[summary.model]])
    assert min(v for s in rmse for v in s.values) > 0.1


def test_a_table_may_be_shuffled_and_read_from_csv_or_parquet(tmp_path, record):
    table = rows(fractions=(0.9, 0.3))
    expected = compare(record, resamples=200)
    shuffled = [table[i] for i in np.random.default_rng(1).permutation(len(table))]
    order = list(LEVELS)
    for suffix in (".csv", ".parquet"):
        again = compare(write(tmp_path / f"b{suffix}", shuffled), models=order, resamples=200)
        told = {c.condition: c for c in again.conditions}
        assert [told[c.condition] for c in expected.conditions] == list(expected.conditions)


def test_repeats_are_ordered_as_numbers_and_words_pair_too(tmp_path):
    table = rows(repeats=12)
    found = compare(write(tmp_path / "a.csv", table), resamples=200).conditions[0]
    assert found.repeats == tuple(f"repeat {i}" for i in range(12))
    for row in table:
        row["repeat"] = f"lab {'abcdefghijkl'[row['repeat']]}"
    found = compare(write(tmp_path / "b.csv", table), resamples=200).conditions[0]
    assert found.repeats[:2] == ("repeat lab a", "repeat lab b")


# --- what must be told ----------------------------------------------------------------------------


def test_conditions_with_single_runs_are_left_out_and_named(tmp_path):
    table = rows() + rows(experiment=1, repeats=1, fractions=(0.3, 0.9))
    found = compare(write(tmp_path / "a.csv", table), resamples=200)
    assert [c.condition for c in found.conditions] == ["experiment 2, observed_fraction 0.3"]
    left = [note for note in found.notes if note.startswith("Left out: experiment 1")]
    assert len(left) == 2
    assert "the models share 1 repeats, at least 3 are needed" in left[0]


def test_runs_of_other_commits_and_processors_are_told_if_they_are_compared(tmp_path):
    table = rows(repeats=10)
    for row in table[-4:]:
        row["cpu"] = "two"
    stray = rows(experiment=1, repeats=1)
    for row in stray:
        row["commit"] = "89abcde"
    notes = compare(write(tmp_path / "a.csv", table + stray), resamples=200).notes
    assert "The runs differ in cpu: one (36), two (4)" in notes
    assert not [note for note in notes if "commit" in note]


def test_what_few_runs_can_not_show_is_told(tmp_path):
    found = compare(write(tmp_path / "a.csv", rows(repeats=4)), resamples=200)
    assert any("Wilcoxon's adjusted p is at least 0.75" in note for note in found.notes)
    assert any("With 4 pairs there are no bootstrap intervals; 5" in note for note in found.notes)
    assert found.conditions[0].pairs[0].paired.difference.low is None
    assert "[" not in found.text().split("Paired tests")[1].split("rule")[0]


def test_runs_that_share_one_draw_are_told(tmp_path):
    table = [{**row, "seed_draw": 7} for row in rows()]
    notes = compare(write(tmp_path / "a.csv", table), resamples=200).notes
    assert any("all runs share one draw of windows and masks" in note for note in notes)
    assert not any("one draw" in n for n in compare(write(tmp_path / "b.csv", rows())).notes)


# --- what is refused ------------------------------------------------------------------------------


def test_repeats_that_a_model_lacks_are_refused_or_left_out_when_asked(tmp_path):
    path = write(tmp_path / "a.csv", rows()[:-1])
    with pytest.raises(InputError, match="do not pair, 'anchored_ode_gru_d' lacks repeat 5; train"):
        compare(path)
    found = compare(path, shared_repeats=True, resamples=200)
    assert found.conditions[0].repeats == tuple(f"repeat {i}" for i in range(5))
    assert any("1 repeats left out that a model lacks" in note for note in found.notes)


def test_runs_that_do_not_share_their_test_part_are_refused(tmp_path):
    table = rows()
    table[5]["last_value_after_first_observation_mse"] *= 1.01
    with pytest.raises(InputError, match="repeat 1 do not share their test part: the last-value"):
        compare(write(tmp_path / "a.csv", table))


@pytest.mark.parametrize("value", [math.nan, -1.0])
def test_a_missing_score_is_refused_and_its_run_named(tmp_path, value):
    table = rows()
    table[7]["after_first_observation_mse"] = value
    path = write(tmp_path / "a.csv", table)
    with pytest.raises(
        InputError, match=r"2-anchored_ode_gru_d-0\.3-1 has no after_first_observation score"
    ):
        compare(path)
    assert compare(path, metric="published", resamples=200).family == 6


def test_models_whose_scores_are_equal_are_refused_under_their_condition(tmp_path):
    table = rows({"gru": 0.03, "lstm": 0.03})
    for first, second in zip(table[::2], table[1::2], strict=True):
        second["after_first_observation_mse"] = first["after_first_observation_mse"]
    said = "experiment 2, observed_fraction 0.3: 'gru' and 'lstm' differ by the same 0 in all 6"
    with pytest.raises(InputError, match=said):
        compare(write(tmp_path / "a.csv", table))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"metric": "publised"}, "unknown metric 'publised'.*did you mean .published."),
        ({"error": "mae"}, "unknown error 'mae', expected one of: mse, rmse"),
        ({"baseline": "ode_rn"}, "unknown model 'ode_rn'.*did you mean 'ode_rnn'"),
        ({"models": ["gru"]}, "at least two different models, got: gru"),
        ({"models": ["gru", "gru"]}, "at least two different models"),
        ({"alpha": 5}, "alpha must be between 0 and 1"),
        ({"confidence": 95}, "confidence must be between 0 and 1"),
        ({"metric": "after_first_row"}, "has no after_first_row score"),
    ],
)
def test_what_is_asked_for_and_not_there_is_refused(record, options, said):
    with pytest.raises(InputError, match=said):
        compare(record, **options)


def test_a_condition_without_its_baseline_is_left_out_and_nothing_at_all_is_refused(tmp_path):
    table = rows(fractions=(0.9, 0.3))
    table = [r for r in table if (r["model"], r["observed_fraction"]) != ("gru", 0.9)]
    path = write(tmp_path / "a.csv", table)
    found = compare(path, baseline="gru", resamples=200)
    assert [c.condition for c in found.conditions] == ["experiment 2, observed_fraction 0.3"]
    assert any("0.9: the baseline 'gru' has no run" in note for note in found.notes)
    with pytest.raises(InputError, match=r"nothing to compare: experiment 2.*the models share 2"):
        compare(write(tmp_path / "b.csv", rows(repeats=2)))


def test_the_same_run_twice_is_refused(tmp_path, record):
    with pytest.raises(InputError, match=r"the same model, condition and repeat .*leave one"):
        read_runs([record, record])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a,b\n1,2\n", "lacks the columns model, repeat; expected a row per run"),
        ("model,repeat\ngru,1\n", "has no column of scores"),
        ("model,repeat,after_first_observation_mse\n", "has no rows"),
        (
            "model,repeat,after_first_observation_mse\ngru,1,many\n",
            "row 1 of .*'many' is not a number",
        ),
        ("model,repeat,after_first_observation_mse\ngru,1\n", "cannot be read as a table of runs"),
    ],
)
def test_a_table_that_is_none_of_runs_is_refused_in_one_line(tmp_path, text, said):
    path = tmp_path / "a.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(FileFormatError, match=said) as error:
        read_runs(path)
    assert "\n" not in str(error.value)


def test_what_is_no_run_is_refused(tmp_path):
    for path, said in (
        (tmp_path / "nothing", "does not exist"),
        (tmp_path, "neither results.json nor a record"),
    ):
        with pytest.raises(FileFormatError, match=said):
            read_runs(path)
    (tmp_path / "a.parquet").write_bytes(b"PAR1 and no more")
    with pytest.raises(FileFormatError, match=r"a\.parquet cannot be read"):
        read_runs(tmp_path / "a.parquet")
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(InputError, match=r"unknown suffix of a\.txt '\.txt'"):
        read_runs(tmp_path / "a.txt")
    with pytest.raises(InputError, match="no runs; give folders"):
        read_runs([])


# --- choosing -------------------------------------------------------------------------------------


def test_runs_are_chosen_by_the_values_of_columns(record):
    assert len(read_runs(record, only={"observed_fraction": "0.30", "model": "gru"})) == 6
    assert len(read_runs(record.parent, only={"repeat": 0})) == 8, "a folder that holds a record"
    with pytest.raises(InputError, match="none of the runs has model=lstm"):
        read_runs(record, only={"model": "lstm"})
    with pytest.raises(InputError, match="did you mean 'experiment'"):
        read_runs(record, only={"experimnt": 2})


def test_the_choice_on_the_command_line_is_read():
    assert parse_only("experiment=2, model=gru") == {"experiment": "2", "model": "gru"}
    assert parse_only(None) == {}
    with pytest.raises(InputError, match="got 'gru' to select runs by, expected name=value"):
        parse_only("experiment=2,gru")


# --- its output -----------------------------------------------------------------------------------


def test_the_json_holds_every_number_and_is_strict(record):
    found = compare(record, resamples=200)
    told = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert told["family"] == 12
    pair, original = told["conditions"][1]["pairs"][0], found.conditions[1].pairs[0]
    assert pair["paired"]["hedges_g"]["low"] == original.paired.hedges_g.low
    assert pair["paired"]["wilcoxon"]["p"] == original.paired.wilcoxon.p
    assert pair["thesis"]["chosen"]["statistic"] == original.thesis.t
    assert pair["thesis"]["test"] == original.thesis.test
    assert pair["thesis"]["significant"] is original.thesis.significant
    ranked = told["conditions"][1]["friedman"]
    assert ranked["critical_difference"] == found.conditions[1].friedman.critical_difference
    assert len(ranked["nemenyi_p"]) == 4


def test_text_markdown_and_latex_tell_the_same_numbers(record):
    found = compare(record, baseline="gru", resamples=200)
    text, markdown, latex = found.text(), found.markdown(), found.latex()
    for condition in found.conditions:
        for pair in condition.pairs:
            for shown in (
                f"{pair.paired.difference.value:.4g}",
                f"{pair.paired.hedges_g.high:.3g}",
            ):
                assert shown in text
                assert shown in markdown
                assert shown in latex
        assert (
            f"critical difference of mean ranks {condition.friedman.critical_difference:.2f}"
            in text
        )
    for told in (text, markdown, latex):
        assert "so the paired tests decide" in told


def test_a_markdown_table_has_as_many_cells_in_each_row(record):
    markdown = compare(record, resamples=200).markdown()
    blocks = [b for b in markdown.split("\n\n") if b.startswith("|")]
    assert len(blocks) == 2 * 3
    for block in blocks:
        assert len({line.count("|") for line in block.splitlines()}) == 1
    assert len(blocks[1].splitlines()) == 2 + 6


def test_latex_is_balanced_and_escaped(record):
    latex = compare(record, resamples=200).latex()
    assert latex.count(r"\begin{tabular}") == latex.count(r"\end{tabular}") == 6
    assert r"anchored\_ode\_gru\_d" in latex
    assert "gru_d" not in latex.replace(r"\_", "")
    assert latex.count("{") == latex.count("}")
    assert escape_latex("50 % of a_b & <c> \\ {d} ^~#$") == (
        r"50 \% of a\_b \& $<$c$>$ \textbackslash{} \{d\} \textasciicircum{}\textasciitilde{}\#\$"
    )


def test_text_lines_up(record):
    block = compare(record, resamples=200).text().split("\n\n")[2].splitlines()
    assert block[0] == "RMSE over 6 repeats:"
    assert block[1].split()[0] == "model"
    assert len({len(line) for line in block[1:]}) == 1


# --- the diagram ----------------------------------------------------------------------------------


def test_the_diagram_has_each_model_at_its_rank_in_its_colour():
    scores = {m: values(rows(repeats=8), m) for m in LEVELS}
    found = friedman(scores)
    figure = ranks_figure(found)
    lines = {line.get_label(): line for line in figure.axes[0].get_lines()}
    places = {name: float(lines[name].get_xdata()[0]) for name in LEVELS}
    for name in LEVELS:
        assert lines[name].get_color() == STYLES[name].colour
        assert lines[name].get_marker() == style_of(name).marker
    ranks, unit = found.ranks, None
    low, high = min(ranks, key=ranks.get), max(ranks, key=ranks.get)
    unit = (places[high] - places[low]) / (ranks[high] - ranks[low])
    for name in LEVELS:
        assert places[name] - places[low] == pytest.approx(unit * (ranks[name] - ranks[low]))
    bar = lines["_difference"].get_xdata()
    assert bar[1] - bar[0] == pytest.approx(min(found.critical_difference, 3) * unit)
    texts = [text.get_text() for text in figure.axes[0].texts]
    assert f"CD = {found.critical_difference:.2f}" in texts
    assert f"Anchored ODE-GRU-D  {ranks['anchored_ode_gru_d']:.2f}" in texts
    assert "Mean rank over 8 repeats (1 is best)" in texts
    groups = [line for line in figure.axes[0].get_lines() if line.get_label() == "_group"]
    assert len(groups) == len(found.groups)


def test_a_diagram_has_a_panel_per_condition_and_none_is_refused():
    found = friedman({m: values(rows(repeats=8), m) for m in LEVELS})
    figure = ranks_figure({"90 %": found, "30 %": found})
    assert [axes.texts[-1] is not None for axes in figure.axes] == [True, True]
    tops = [axes.get_position().y1 for axes in figure.axes]
    assert tops[0] == pytest.approx(1.0)
    assert tops[1] == pytest.approx(figure.axes[0].get_position().y0)
    with pytest.raises(InputError, match="got none"):
        ranks_figure({})


# --- runs of offbeat train ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two models on three cuts of one data set, one of the models in two sizes."""
    folder = tmp_path_factory.mktemp("runs")
    data = folder / "hopper.parquet"
    ob.save(ob.simulate("hopper", 24, 30, seed=1, progress=False), data)
    for name, size in (("gru", 4), ("gru", 3), ("rnn", 4)):
        for repeat in range(3):
            arguments = [
                "train", data, folder / f"{name}-{size}-{repeat}", f"--model.name={name}",
                f"--model.hidden_size={size}", "--training.epochs=1", "--training.batch_size=8",
                "--split.window=20", "--split.observed_fraction=0.5", f"--split.seed={repeat}",
                f"--seed={10 * repeat + size}",
            ]  # fmt: skip
            assert main([str(a) for a in arguments]) == 0
    return folder


def test_runs_and_tables_of_the_version_before_are_read_under_the_names_of_now(runs, tmp_path):
    old = {"after_first_observation": "honest", "masked": "honest_hidden"}
    old["after_first_row"] = "rows_1_99"
    for name in ("rnn-4-0", "gru-4-0"):
        folder = shutil.copytree(runs / name, tmp_path / name)
        config = (folder / "config.yaml").read_text().replace("\nsplit:\n", "\nparts:\n")
        (folder / "config.yaml").write_text(config)
        results = json.loads((folder / "results.json").read_text())
        results["predictors"] = {
            who: {old.get(key, key): value for key, value in scores.items()}
            for who, scores in results["predictors"].items()
        }
        (folder / "results.json").write_text(json.dumps(results))
        (before,), (now,) = read_runs(folder), read_runs(runs / name)
        assert replace(before, name="") == replace(now, name="")
    table = tmp_path / "record.csv"
    table.write_text(
        "model,repeat,kernel_body,honest_mse,rows_1_99_mse,last_value_honest_mse\n"
        "gru,0,avx2,0.25,0.5,4.0\n"
    )
    (run,) = read_runs(table)
    assert run.mse == {"after_first_observation": 0.25, "after_first_row": 0.5}
    assert run.last_value_mse == {"after_first_observation": 4.0}
    assert run.origin == {"scan_backend": "avx2"}


def test_folders_are_paired_by_the_cut_of_the_data_and_sizes_have_labels(runs, capsys):
    capsys.readouterr()
    found = compare(runs, resamples=200)
    (condition,) = found.conditions
    assert condition.condition == "hopper.parquet, window 20, observed_fraction 0.5"
    assert condition.repeats == ("split.seed 0", "split.seed 1", "split.seed 2")
    assert {s.model for s in condition.summaries} == {
        "gru[hidden_size=3]", "gru[hidden_size=4]", "rnn", "last_value",
    }  # fmt: skip
    scores = json.loads((runs / "rnn-4-1" / "results.json").read_text())["predictors"]
    by_name = {s.model: s.values for s in condition.summaries}
    assert by_name["rnn"][1] == scores["rnn"]["after_first_observation"]["mse"] ** 0.5
    assert by_name["last_value"][1] == pytest.approx(
        scores["last_value"]["after_first_observation"]["rmse"]
    )


def test_runs_on_one_cut_are_paired_by_their_seeds_and_it_is_told(runs, tmp_path):
    one = read_runs([runs / "gru-4-0", runs / "rnn-4-0"])
    assert {run.repeat for run in one} == {"split.seed 0"}
    copies = []
    for name in ("gru", "rnn"):
        for seed in range(3):
            folder = tmp_path / f"{name}{seed}"
            folder.mkdir()
            for file in ("results.json", "split.json", "config.yaml"):
                text = (runs / f"{name}-4-0" / file).read_text()
                if file == "config.yaml":
                    text = text.replace("seed: 4\nthreads", f"seed: {seed}\nthreads")
                (folder / file).write_text(text)
            results = json.loads((folder / "results.json").read_text())
            results["predictors"][name]["after_first_observation"]["mse"] *= (
                1 + 0.01 * seed + 0.002 * len(name) * seed
            )
            (folder / "results.json").write_text(json.dumps(results))
            copies.append(folder)
    found = compare([*copies[:2], copies[2], *copies[3:]], resamples=200)
    assert found.conditions[0].repeats == tuple(f"split.seed 0 / seed {i}" for i in range(3))
    assert any("share one draw of windows and masks" in note for note in found.notes)


def test_a_damaged_run_is_refused_in_one_line(runs, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    for file in ("results.json", "config.yaml"):
        (folder / file).write_text((runs / "gru-4-0" / file).read_text())
    (folder / "config.yaml").unlink()
    with pytest.raises(FileFormatError, match=r"config\.yaml is missing; is .*run a finished run"):
        read_runs(folder)
    (folder / "config.yaml").write_text("model: [")
    with pytest.raises(FileFormatError, match=r"config\.yaml is damaged"):
        read_runs(folder)
    (folder / "config.yaml").write_text("model: {}")
    with pytest.raises(FileFormatError, match="is not a run of 'offbeat train'"):
        read_runs(folder)


def test_the_command_compares_folders_and_writes_every_form(runs, tmp_path, capsys):
    folders = [str(p) for p in sorted(runs.glob("*-4-*"))]
    assert main(["compare", "--metric", "published", *folders, "--baseline=gru"]) == 0
    text = capsys.readouterr().out
    assert text.startswith(
        "published RMSE on the test part, in scaled units, against gru; alpha 0.05"
    )
    assert "rnn - gru" in text
    for suffix, first in (
        (".txt", "after_first_observation"),
        (".md", "after_first_observation"),
        (".tex", "%"),
        (".json", "{"),
    ):
        out = tmp_path / f"a{suffix}"
        assert main(["compare", *folders, f"--out={out}", "--resamples=200"]) == 0
        assert out.read_text().startswith(first)
    capsys.readouterr()
    assert main(["compare", *folders, "--json", "--resamples", "200"]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads((tmp_path / "a.json").read_text())


def test_the_command_draws_the_diagram(record, tmp_path, capsys):
    figure = tmp_path / "ranks.png"
    assert main(["compare", str(record), "--figure", str(figure), "--form", "markdown"]) == 0
    assert figure.read_bytes().startswith(b"\x89PNG")
    assert capsys.readouterr().out.count("## experiment 2") == 2


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--metric", "x"], "unknown metric 'x'"),
        (["--form", "html"], "unknown form 'html', expected one of: latex, markdown, text"),
        (["--out", "a.pdf"], "unknown suffix of out '.pdf'"),
        (["--figure", "a.gif"], "unknown suffix of figure '.gif'"),
        (["--only", "experiment"], "expected name=value"),
        (
            ["--models", "[gru, ode_rnn]", "--figure", "a.png"],
            "three or more models; leave out --figure",
        ),
        (["nowhere"], "nowhere does not exist"),
    ],
)
def test_the_command_says_what_is_wrong_in_one_line(record, options, said, capsys):
    assert main(["compare", str(record), *options]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    (line,) = captured.err.strip().splitlines()
    assert said in line


def test_a_comparison_without_runs_is_refused(capsys):
    assert main(["compare"]) == 2
    assert "runs" in capsys.readouterr().err


def test_the_metrics_are_the_scorings_of_the_package():
    assert set(METRICS) == set(SCORINGS)


def test_runs_may_be_made_by_hand():
    made = [
        Run(
            f"{m}{i}",
            m,
            "mine",
            str(i),
            {"after_first_observation": (level + 0.001 * i + 0.0001 * i * j) ** 2},
        )
        for j, (m, level) in enumerate((("a", 0.1), ("b", 0.2)))
        for i in range(5)
    ]
    found = compare(made, resamples=200)
    assert found.conditions[0].pairs[0].better == "a"
    assert {s.model for s in found.conditions[0].summaries} == {"a", "b"}


def test_a_comparison_imports_no_torch(record):
    code = (
        f"import sys, offbeat\n"
        f"offbeat.compare({str(record)!r}, resamples=200).text()\n"
        "import offbeat.plots.ranks\n"
        "assert 'torch' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
