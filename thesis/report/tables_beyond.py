"""Tables that the thesis does not have: all models, distances, the first row, spread, cost."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from offbeat.tables import MINUS, TIMES
from thesis.report import thesis_numbers as thesis
from thesis.report.pairing import MODELS
from thesis.report.records import Record
from thesis.report.table import MIXED, Block, Cell, Table, bold_lowest
from thesis.report.tables import (
    HEADINGS,
    PERCENTS,
    by_fraction,
    label,
    missing_runs,
    rmse_of,
    rmse_rows,
)

Values = NDArray[np.float64]
_WITHIN = 2.0
"""Standard deviations of the thesis within which a cell of table 3.6 counts as reproduced."""


def all_models_table(record: Record, *, repeats: int, number: str) -> Table:
    """Test RMSE of every model of experiment 2 and of the last value, under three scorings."""
    headings = {**HEADINGS, "honest_hidden": "Ours, masked rows only"}
    blocks = [
        Block(headings[scoring], bold_lowest(rmse_rows(record, MODELS, scoring, repeats=repeats)))
        for scoring in ("published", "honest", "honest_hidden")
    ]
    return by_fraction(
        record,
        number,
        "Test RMSE of all models over the repeats, mean ± standard deviation.",
        blocks,
        "Bold: the lowest of its column within a block, where all are there. Not self-fed: "
        "the thesis' rows without self-feeding. Fair: not self-fed either, updated at every "
        "row, GRU with the time since each channel's last observation as input.",
        missing_runs(record, 2, MODELS, repeats),
    )


def distance_table(record: Record, *, number: str) -> Table:
    """How far each cell of table 3.6 is from ours, in the thesis' standard deviations.

    Below is the constant of row 0 in our draw: the published scoring contains it, and it
    depends on the draw, not on a model. The last row is the constant at which our mean would be the
    thesis' own, nothing else changed.
    """
    rows, needed = [], []
    for model in thesis.MODELS:
        cells = []
        for fraction, (mean, spread) in zip(thesis.FRACTIONS, thesis.TEST_RMSE[model], strict=True):
            runs, values = rmse_of(record, model, fraction, "published")
            if not len(values):
                cells.append(Cell(n=0))
                continue
            distance = (float(values.mean()) - mean) / spread
            text = f"{distance:+.1f}".replace("-", MINUS)
            mark = MIXED if record.mixed(runs) else ""
            within = abs(distance) <= _WITHIN
            cells.append(Cell(text, distance, n=len(values), bold=within, mark=mark))
        rows.append((label(model), tuple(cells)))
        needed.append((label(model), _constants_needed(record, model)))
    ours = [constant_of(record, fraction) for fraction in thesis.FRACTIONS]
    lines = {
        "Mean square of row 0, c": [c[0] for c in ours],
        "Fraction of masked rows 0": [c[1] for c in ours],
        f"Part of the published MSE, c {TIMES} fraction / 100": [c[2] for c in ours],
    }
    digits = {"Mean square of row 0, c": 3, "Fraction of masked rows 0": 3}
    blocks = (
        Block(f"(ours {MINUS} thesis) / standard deviation of the thesis", tuple(rows)),
        Block(
            "The constant of row 0 in our draws",
            tuple(
                (
                    name,
                    tuple(
                        Cell(f"{v.mean():.{digits.get(name, 5)}f}", float(v.mean()), n=len(v))
                        if len(v)
                        else Cell(n=0)
                        for v in values
                    ),
                )
                for name, values in lines.items()
            ),
        ),
        Block("c at which our mean would be the thesis' (inferred)", tuple(needed)),
    )
    return by_fraction(
        record,
        number,
        "Distance of our test RMSE from table 3.6, published scoring.",
        blocks,
        f"Bold: within {_WITHIN:g} of the thesis' standard deviations. Nothing is tuned to "
        "match. c is a property of the draw of initial states: normalisation divides by the "
        "largest of single frames, so another draw has another c, and other units.",
    )


def _constants_needed(record: Record, model: str) -> tuple[Cell, ...]:
    """The c of which `0.99 rows_1_99 + c fraction / 100` would have the thesis' mean RMSE.

    A dash where there is none: the rest is above it, or no row 0 is masked in some run.
    """
    from scipy.optimize import brentq

    cells = []
    for fraction, (mean, _) in zip(thesis.FRACTIONS, thesis.TEST_RMSE[model], strict=True):
        runs = record.where(experiment=2, model=model, fraction=fraction)
        c = record.values("row_0_constant", runs).astype(float)
        share = record.values("hidden_rows_0_share", runs).astype(float) / 100
        rest = record.values("published_mse", runs).astype(float) - c * share
        if not len(runs) or share.min() == 0 or _above(0.0, rest, share, mean) > 0:
            cells.append(Cell(n=len(runs)))
            continue
        found = float(brentq(_above, 0.0, mean**2 / share.min(), args=(rest, share, mean)))
        cells.append(Cell(f"{found:.3f}", found, n=len(runs)))
    return tuple(cells)


def _above(c: float, rest: Values, share: Values, mean: float) -> float:
    """By how much the mean RMSE is above the thesis' mean, if the constant were c."""
    return float(np.sqrt(rest + c * share).mean()) - mean


def constant_of(
    record: Record, fraction: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Per repeat: c, the fraction of masked rows 0, and what they add to the published MSE.

    The last is `published - (1 - 1/rows) rows_1_99`, with the number of rows of the protocol, 100.
    """
    runs = record.where(experiment=2, fraction=fraction)
    _, first = np.unique(record.values("repeat", runs), return_index=True)
    runs = runs[first]
    c = record.values("row_0_constant", runs).astype(float)
    share = record.values("hidden_rows_0_share", runs).astype(float)
    return c, share, c * share / 100


def constant_residual(record: Record) -> float:
    """Largest relative error of `published = 0.99 rows_1_99 + c fraction / 100` over all runs."""
    runs = record.runs
    published = runs["published_mse"].astype(float)
    said = 0.99 * runs["rows_1_99_mse"] + runs["row_0_constant"] * runs["hidden_rows_0_share"] / 100
    return float(np.max(np.abs(said.astype(float) - published) / published))


# --- runs and cost --------------------------------------------------------------------------------


def runs_table(record: Record, *, repeats: int, number: str) -> Table:
    """How many runs of the full protocol are there."""
    blocks = []
    for experiment, models, asked in ((1, thesis.MODELS, 1), (2, MODELS, repeats)):
        rows = []
        for model in models:
            cells = []
            for fraction in thesis.FRACTIONS:
                there = len(record.where(experiment=experiment, model=model, fraction=fraction))
                whole = there >= asked
                cells.append(Cell(f"{there} of {asked}", float(there), n=there, bold=not whole))
            rows.append((label(model), tuple(cells)))
        blocks.append(Block(f"Experiment {experiment}", tuple(rows)))
    return by_fraction(
        record,
        number,
        "Runs that are there, of those of the full protocol.",
        blocks,
        "Bold: not all of them.",
    )


def cost_table(record: Record, *, number: str) -> Table:
    """Wall time of the runs, by experiment and model."""
    blocks, spent = [], float(record.runs["seconds"].sum() / 60)
    for experiment, name in ((1, "Experiment 1"), (2, "Experiment 2")):
        rows = []
        for model in MODELS:
            if not len(record.where(experiment=experiment, model=model)):
                continue
            cells = []
            for fraction in thesis.FRACTIONS:
                runs = record.where(experiment=experiment, model=model, fraction=fraction)
                seconds = record.values("seconds", runs).astype(float)
                cells.append(
                    Cell(f"{seconds.sum() / 60:.1f}", float(seconds.sum() / 60), n=len(runs))
                    if len(runs)
                    else Cell(n=0)
                )
            runs = record.where(experiment=experiment, model=model)
            total = float(record.values("seconds", runs).sum() / 60)
            steps = float(record.values("steps", runs).sum())
            cells.append(Cell(f"{total:.1f}", total, n=len(runs)))
            cells.append(Cell(f"{100 * total / spent:.1f}", 100 * total / spent, n=len(runs)))
            cells.append(Cell(f"{60e3 * total / steps:.1f}", 60e3 * total / steps, n=len(runs)))
            rows.append((label(model), tuple(cells)))
        if rows:
            blocks.append(Block(name, tuple(rows)))
    return Table(
        number,
        "Run time in minutes, summed over the runs of a cell; its part of all, and per step of "
        "the optimizer.",
        "Model",
        (*PERCENTS, "Sum (min)", "Share (%)", "Per step (ms)"),
        tuple(blocks),
        ("A run's time is its wall time, with as many threads as the record says.",),
    )
