"""A synthetic record of a reproduction: seeded, of any size, with effects that tests know."""

import numpy as np

from thesis.record import CURVE_COLUMNS, RUN_COLUMNS
from thesis.record import Record as RowRecord
from thesis.report.records import Record

LABELS = (
    "gru",
    "gru_d",
    "ode_rnn",
    "ode_gru_d",
    "gru_fair",
    "gru_d_fair",
    "anchored_ode_gru_d",
    "gru_unfed",
    "gru_d_unfed",
)
FRACTIONS = (0.9, 0.7, 0.5, 0.3)
HONEST = {
    "gru": 0.0046,
    "gru_d": 0.0045,
    "ode_rnn": 0.00073,
    "ode_gru_d": 0.00066,
    "gru_fair": 0.00090,
    "gru_d_fair": 0.00092,
    "anchored_ode_gru_d": 0.00036,
    "gru_unfed": 0.00094,
    "gru_d_unfed": 0.00088,
}
"""Honest MSE at 30 %; it falls in proportion to the masked fraction."""
HALVING = {"gru": 40, "gru_d": 36, "ode_rnn": 30, "ode_gru_d": 12}
"""Epochs in which what is left to learn halves."""
CONSTANT = 1.13


def synthetic(
    *,
    seed=0,
    repeats=10,
    epochs=300,
    models=LABELS,
    fractions=FRACTIONS,
    experiments=(1, 2),
    factors=None,
):
    """A record of all runs of these models; `factors` multiplies the honest MSE of a model."""
    rows, lines = [], []
    for experiment in experiments:
        for fraction in fractions:
            for repeat in range(repeats if experiment == 2 else 1):
                draw = draw_of(seed, experiment, fraction, repeat)
                for model in models if experiment == 2 else models[:4]:
                    run, curve = one_run(
                        seed, experiment, fraction, repeat, model, draw, epochs, factors or {}
                    )
                    rows.append(run)
                    lines += curve
    return Record(columns(rows, RUN_COLUMNS), columns(lines, CURVE_COLUMNS), "synthetic")


def draw_of(seed, experiment, fraction, repeat):
    """What all models of a repeat share: how hard the draw is, and its masked first rows."""
    random = np.random.default_rng([seed, experiment, round(100 * fraction), repeat])
    return {
        "hardness": np.exp(0.03 * random.standard_normal()),
        "share": random.binomial(1500, 1 - fraction) / 1500,
    }


def one_run(seed, experiment, fraction, repeat, model, draw, epochs, factors):
    key = [seed, experiment, round(100 * fraction), repeat, 1 + LABELS.index(model)]
    random = np.random.default_rng(key)
    scale = (1 - fraction) / 0.7 * draw["hardness"]
    noise = np.exp(0.02 * random.standard_normal())
    honest = HONEST[model] * factors.get(model, 1.0) * scale * noise
    unseen = 0.0014 * (1 - fraction) / 0.7
    count = epochs if experiment == 1 else 75 if fraction == 0.9 else 50
    run_id = f"e{experiment}-{model}-{round(100 * fraction)}-r{repeat:02d}"
    last = 0.00126 * scale
    scores = {"honest_hidden": 0.98 * honest, "honest": honest, "rows_1_99": honest + unseen}
    trivial = {"honest_hidden": 0.99 * last, "honest": last, "rows_1_99": last + unseen}
    curve = []
    for epoch in range(1, count + 1):
        left = 4 * 0.5 ** (epoch / HALVING.get(model, 20))
        now = honest * (1 + left) * np.exp(0.01 * random.standard_normal())
        curve.append(
            {
                "run_id": run_id,
                "epoch": epoch,
                "train_mse": now + unseen,
                "validation_honest_mse": now,
                "validation_rows_1_99_mse": now + unseen,
                "validation_published_mse": published(now + unseen, draw),
                "seconds": 1.5,
            }
        )
    run = {
        "run_id": run_id,
        "experiment": experiment,
        "model": model,
        "observed_fraction": fraction,
        "repeat": repeat,
        "epochs": count,
        "steps": 140 * count,
        **{f"{name}_mse": value for name, value in scores.items()},
        **{f"last_value_{name}_mse": value for name, value in trivial.items()},
        "published_mse": published(honest + unseen, draw),
        "last_value_published_mse": published(last + unseen, draw),
        "row_0_constant": CONSTANT,
        "hidden_rows_0_share": draw["share"],
        "validation_published_mse": curve[-1]["validation_published_mse"],
        "seconds": 1.5 * count,
        "seed_draw": 100_000 * experiment + 1000 * round(100 * fraction) + repeat,
        "seed_weights": LABELS.index(model) + 1,
        "commit": "1234567",  # all digits, as a commit can be
        "bits": "0e12345",
        "cpu": "A processor",
        "kernel_body": "fused",
        "threads": 1,
        "torch": "2.13.0",
        "mujoco": "3.17.0",
        "data": "abcdef",
        "finished_at": f"2026-01-{1 + repeat:02d}T12:00:00+00:00",
    }
    return run, curve


def published(rows_1_99, draw):
    return 0.99 * rows_1_99 + CONSTANT * draw["share"] / 100


def columns(rows, wanted):
    kinds = {str: object, int: int, float: float}
    return {
        name: np.array([row[name] for row in rows], dtype=kinds[kind])
        for name, kind in wanted.items()
    }


def write(record, folder, *, suffix=".parquet"):
    """Puts a record into a folder, as `reproduce` does, in one of its two forms."""
    runs = {row["run_id"]: row for row in lines(record.runs)}
    curves = {}
    for line in lines(record.curves):
        curves.setdefault(line["run_id"], []).append(line)
    RowRecord(runs, {name: tuple(curve) for name, curve in curves.items()}).write(folder)
    for path in folder.glob("*.csv" if suffix == ".parquet" else "*.parquet"):
        path.unlink()
    return folder


def lines(table):
    names = list(table)
    each = zip(*(table[name].tolist() for name in names), strict=True)
    return [dict(zip(names, values, strict=True)) for values in each]


def changed(record, where, **values):
    """The record with other values in some runs; `where` is a mask or indices."""
    runs = {name: column.copy() for name, column in record.runs.items()}
    for name, value in values.items():
        runs[name][where] = value
    return Record(runs, record.curves, record.source)


def without(record, gone):
    """The record without the runs that a mask names."""
    runs = {name: column[~gone] for name, column in record.runs.items()}
    return Record(runs, record.curves, record.source)
