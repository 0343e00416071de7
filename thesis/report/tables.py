"""Tables 3.1 to 3.6 of the thesis: its numbers, ours under both scorings, and the last value."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from offbeat.plots.style import style_of
from offbeat.tables import DASH
from thesis.report import thesis_numbers as thesis
from thesis.report.records import Record
from thesis.report.table import MIXED, Block, Cell, Table, bold_lowest

HEADINGS = {
    "thesis": "Thesis",
    "published": "Ours, published scoring",
    "honest": "Ours, scoring after the first observation",
}
LAST_VALUE = "last_value"

_SELF_FEEDING = (
    "GRU and GRU-D of ours are trained and tested with self-feeding at half of the rows. That the "
    "thesis' rows contain it is inferred, not known."
)
_MIXED_NOTE = (
    f"{MIXED} The runs behind the number were not made alike (code, processor, scan backend, torch "
    "or data); machine and versions are listed below."
)
_BOLD_NOTE = "Bold: the lowest of its column within a block, where all are there."

_MSE_DIGITS = {"published": 5, "honest": 6}
_RMSE_DIGITS = {"published": 4, "honest": 5, "honest_hidden": 5}
"""As the thesis prints them, and one more where errors are smaller."""


def percent(fraction: float) -> str:
    """An observed fraction as tables name it."""
    return f"{100 * fraction:g}\N{THIN SPACE}%"


PERCENTS = tuple(map(percent, thesis.FRACTIONS))
"""Columns of tables with one per observed fraction."""

COUNTED = "Table A.14 counts the runs behind a cell."


def label(name: str) -> str:
    """The name of a model as tables have it."""
    return style_of(name).label


def mean_cell(
    record: Record,
    values: NDArray[np.float64],
    rows: NDArray[np.int64],
    *,
    digits: int,
    expected: int = 1,
) -> Cell:
    """Mean and standard deviation of some runs; notes missing runs.

    Args:
        record: of the runs.
        values: (runs,) numbers to average.
        rows: (runs,) rows of the record, for their provenance.
        digits: after the decimal point.
        expected: number of runs of the full protocol; the deviation is shown above 1.
    """
    if not len(values):
        return Cell(n=0)
    mean = float(values.mean())
    spread = float(values.std(ddof=1)) if len(values) > 1 else None
    text = f"{mean:.{digits}f}"
    if expected > 1:
        text += f" ± {DASH}" if spread is None else f" ± {spread:.{digits}f}"
    if len(values) < expected:
        text += f" ({len(values)} of {expected})"
    return Cell(text, mean, spread, len(values), mark=MIXED if record.mixed(rows) else "")


def notes(record: Record, tables: Sequence[Block], *others: str) -> tuple[str, ...]:
    """The notes that every table has, where they apply."""
    marked = any(
        cell.mark == MIXED for block in tables for _, cells in block.rows for cell in cells
    )
    return (*filter(None, others), *([_MIXED_NOTE] if marked else []))


def by_fraction(
    record: Record,
    number: str,
    caption: str,
    blocks: Sequence[Block],
    *said: str,
    head: str = "Model",
) -> Table:
    """A table with a column per observed fraction; of its notes those that are not empty.

    Args:
        record: what the numbers are of.
        number: of the table.
        caption: a sentence, without the number.
        blocks: rows with a cell per fraction, in the order of `PERCENTS`.
        said: notes, followed by those of every table.
        head: of the first column.
    """
    return Table(number, caption, head, PERCENTS, tuple(blocks), notes(record, blocks, *said))


# --- tables 3.1 to 3.4 ----------------------------------------------------------------------------


def curve_table(record: Record, fraction: float) -> Table:
    """Validation MSE every 50 epochs at one observed fraction: tables 3.1 to 3.4.

    Args:
        record: its runs of experiment 1.
        fraction: one of `thesis_numbers.FRACTIONS`.
    """
    number = thesis.CURVE_TABLES[fraction]
    printed = thesis.VALIDATION_MSE[fraction]
    blocks = [
        Block(
            HEADINGS["thesis"],
            bold_lowest(
                [(label(m), [Cell(f"{v:.5f}", v) for v in printed[m]]) for m in thesis.MODELS]
            ),
        )
    ]
    for scoring in ("published", "honest"):
        digits = _MSE_DIGITS[scoring]
        rows = [(label(m), _epochs(record, m, fraction, scoring)) for m in thesis.MODELS]
        runs = _distinct_draws(record, fraction)
        last = record.values(f"last_value_{scoring}_mse", runs).astype(float)
        cell = mean_cell(record, last, runs, digits=digits)
        rows.append((f"{label(LAST_VALUE)} (test part)", [cell] * len(thesis.EPOCHS)))
        blocks.append(Block(HEADINGS[scoring], bold_lowest(rows)))
    ends = dict[str, list[str]]()
    for model in thesis.MODELS:
        runs = record.where(experiment=1, model=model, fraction=fraction)
        if not len(runs):
            ends.setdefault("no run of experiment 1 yet", []).append(label(model))
            continue
        curve = record.curve(str(record.values("run_id", runs)[0]))
        last_epoch = int(curve["epoch"][-1]) if len(curve["epoch"]) else 0
        if last_epoch < thesis.EPOCHS[-1]:
            ends.setdefault(f"the curve has {last_epoch} epochs", []).append(label(model))
    remarks = [f"{', '.join(models)}: {said}." for said, models in ends.items()]
    return Table(
        number,
        f"Validation MSE while training, {percent(fraction)} of the rows observed.",
        "Model, after epoch",
        tuple(str(e) for e in thesis.EPOCHS),
        tuple(blocks),
        notes(
            record,
            blocks,
            _BOLD_NOTE,
            "The last value is scored on the test part; it does not depend on the epoch.",
            _SELF_FEEDING,
            *remarks,
            thesis.SLIPS.get(number, ""),
        ),
    )


def _epochs(record: Record, model: str, fraction: float, scoring: str) -> list[Cell]:
    runs = record.where(experiment=1, model=model, fraction=fraction)
    curves = [record.curve(str(name)) for name in record.values("run_id", runs)]
    column = f"validation_{scoring}_mse"
    cells = []
    for epoch in thesis.EPOCHS:
        found = [curve[column][curve["epoch"] == epoch] for curve in curves]
        cells.append(
            mean_cell(record, np.concatenate([*found, []]), runs, digits=_MSE_DIGITS[scoring])
        )
    return cells


def _distinct_draws(record: Record, fraction: float) -> NDArray[np.int64]:
    """One run per draw of windows and masks: models of a draw have the same last value."""
    runs = record.where(experiment=1, fraction=fraction)
    runs = runs[np.isin(record.values("model", runs), thesis.MODELS)]
    _, first = np.unique(record.values("seed_draw", runs), return_index=True)
    return runs[np.sort(first)]


# --- tables 3.5 and 3.6 ---------------------------------------------------------------------------


def final_table(record: Record) -> Table:
    """Test MSE after experiment 1: table 3.5."""
    blocks = [
        Block(
            HEADINGS["thesis"],
            bold_lowest(
                [
                    (label(m), [Cell(f"{v:.5f}", v) for v in thesis.TEST_MSE[m]])
                    for m in thesis.MODELS
                ]
            ),
        )
    ]
    for scoring in ("published", "honest"):
        digits = _MSE_DIGITS[scoring]
        rows = []
        for model in thesis.MODELS:
            cells = []
            for fraction in thesis.FRACTIONS:
                runs = record.where(experiment=1, model=model, fraction=fraction)
                values = record.values(f"{scoring}_mse", runs).astype(float)
                cells.append(mean_cell(record, values, runs, digits=digits))
            rows.append((label(model), cells))
        cells = []
        for fraction in thesis.FRACTIONS:
            runs = _distinct_draws(record, fraction)
            values = record.values(f"last_value_{scoring}_mse", runs).astype(float)
            cells.append(mean_cell(record, values, runs, digits=digits))
        rows.append((label(LAST_VALUE), cells))
        blocks.append(Block(HEADINGS[scoring], bold_lowest(rows)))
    return by_fraction(
        record,
        "3.5",
        f"Test MSE after {_epochs_of(record)} epochs, by the fraction of observed rows.",
        blocks,
        _BOLD_NOTE,
        _SELF_FEEDING,
        missing_runs(record, 1, thesis.MODELS, 1),
    )


def _epochs_of(record: Record) -> str:
    epochs = sorted(set(record.values("epochs", record.where(experiment=1)).tolist()))
    return " or ".join(map(str, epochs)) if epochs else str(thesis.EPOCHS[-1])


def repeats_table(record: Record, *, repeats: int = thesis.REPEATS) -> Table:
    """Test RMSE over the repeats of experiment 2, mean and standard deviation: table 3.6.

    Args:
        record: its runs of experiment 2.
        repeats: of the full protocol; fewer are marked.
    """
    printed = [
        (label(m), [Cell(f"{v:.4f} ± {s:.4f}", v, s, 10) for v, s in thesis.TEST_RMSE[m]])
        for m in thesis.MODELS
    ]
    blocks = [Block(HEADINGS["thesis"], bold_lowest(printed))]
    for scoring in ("published", "honest"):
        rows = rmse_rows(record, thesis.MODELS, scoring, repeats=repeats)
        blocks.append(Block(HEADINGS[scoring], bold_lowest(rows)))
    return by_fraction(
        record,
        "3.6",
        "Test RMSE over the repeats, mean ± standard deviation, by the fraction of observed rows.",
        blocks,
        _BOLD_NOTE,
        _SELF_FEEDING,
        missing_runs(record, 2, thesis.MODELS, repeats),
    )


def rmse_rows(
    record: Record, models: Sequence[str], scoring: str, *, repeats: int
) -> list[tuple[str, list[Cell]]]:
    """Mean and deviation of the test RMSE of experiment 2, the last value in the last row."""
    rows = []
    for model in (*models, LAST_VALUE):
        cells = []
        for fraction in thesis.FRACTIONS:
            runs, values = rmse_of(record, model, fraction, scoring)
            cells.append(
                mean_cell(record, values, runs, digits=_RMSE_DIGITS[scoring], expected=repeats)
            )
        rows.append((label(model), cells))
    return rows


def rmse_of(
    record: Record, model: str, fraction: float, scoring: str
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Rows and test RMSE of the repeats of a model, or of the last value: one per draw."""
    if model != LAST_VALUE:
        runs = record.where(experiment=2, model=model, fraction=fraction)
        return runs, record.rmse(scoring, runs)
    runs = record.where(experiment=2, fraction=fraction)
    _, first = np.unique(record.values("repeat", runs), return_index=True)
    return runs[first], record.rmse(f"last_value_{scoring}", runs[first])


def missing_runs(record: Record, experiment: int, models: Sequence[str], repeats: int) -> str:
    """A sentence on the runs that the record lacks; empty where it lacks none."""
    counted = 0
    for model in models:
        for fraction in thesis.FRACTIONS:
            there = len(record.where(experiment=experiment, model=model, fraction=fraction))
            counted += min(there, repeats)
    asked = len(models) * len(thesis.FRACTIONS) * repeats
    if counted == asked:
        return ""
    how = "a cell says how many it has; a dash: none" if repeats > 1 else "a dash: not there yet"
    return f"{counted} of {asked} runs of experiment {experiment} are there: {how}."
