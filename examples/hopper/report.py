"""The tables of `docs/robots.md`."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import offbeat as ob
from examples.documents import between
from offbeat.tables import markdown

from .data import CHANNELS, FRACTIONS, PROTOCOL
from .models import ABLATIONS, PLANS
from .scores import AGES, record

RECORDED = {
    "ode_rnn": "ODE-RNN",
    "ode_gru_d": "ODE-GRU-D",
    "gru_fair": "GRU, fair",
    "anchored_ode_gru_d": "anchored, as in the thesis' record",
}
"""Models of `results/thesis/record.csv`."""

TITLES = {
    "last_value": "last value",
    "constant_velocity": "constant velocity",
    "motion_filter": "Kalman filter, positions with velocities",
    "ridge": "ridge",
    "residual_gru": "residual GRU",
}


def read(out: Path, thesis: Path) -> dict[str, Any]:
    """The results on disk.

    Args:
        out: folder of the scores.
        thesis: folder of the record.

    Returns:
        `own`, a list of results per predictor, one per seed; `thesis`, by model and fraction.
    """
    own: dict[str, list[dict[str, Any]]] = {}
    for name in (*TITLES, *PLANS):
        files = sorted(out.glob(f"{name}.json")) + sorted(out.glob(f"{name}-seed*.json"))
        if files:
            own[name] = [json.loads(path.read_text(encoding="utf-8")) for path in files]
    with (thesis / "record.csv").open(encoding="utf-8") as file:
        rows: list[Any] = list(csv.DictReader(file))
    return {
        "own": own,
        "thesis": {name: {f: record(rows, name, f) for f in FRACTIONS} for name in RECORDED},
    }


def document(text: str, found: dict[str, Any]) -> str:
    """Writes the tables between their markers of a page.

    Args:
        text: the page.
        found: from `read`.
    """
    for name, table in (
        ("errors", errors(found)),
        ("ablation", ablation(found, 10)),
        ("ablation, 40 epochs", ablation(found, 40)),
        ("curves", curves(found)),
        ("since observation", ages(found)),
        ("contacts", contacts(found)),
        ("runs", runs(found)),
    ):
        text = between(text, name, table)
    return text


def errors(found: dict[str, Any]) -> str:
    """A row per predictor and a column per fraction: test RMSE after the first observation."""
    rows = []
    for name, each in _main(found):
        cells = [
            _over([run["scores"].get(str(f), {}).get("rmse") for run in each]) for f in FRACTIONS
        ]
        sizes = sorted({_size(run) for run in each} - {0})
        rows.append(
            [
                _title(name),
                *cells,
                _minutes(each),
                f"{sizes[-1]:,}" if sizes else "",
                str(len(each)),
            ]
        )
    for name, of in found["thesis"].items():
        cells = [f"{of[f]['rmse']:.4f} ({np.mean(of[f]['all']):.4f})" for f in FRACTIONS]
        minutes = np.mean([of[f]["minutes"] for f in FRACTIONS])
        rows.append([RECORDED[name], *cells, f"{minutes:.0f}", f"{_parameters(name):,}", "1 (10)"])
    head = ["", *(f"{100 * f:.0f} %" for f in FRACTIONS), "minutes", "numbers", "seeds"]
    return markdown(head, rows)


def ablation(found: dict[str, Any], epochs: int) -> str:
    """A row per plan of `ABLATIONS`: errors, size and minutes, and the first one's error beside."""
    rows, first = [], None
    for name in ABLATIONS[epochs]:
        if name not in found["own"]:
            rows.append([PLANS[name].title, *["not run"] * len(FRACTIONS), "", "", ""])
            continue
        each = found["own"][name]
        cells = [
            _over([run["scores"].get(str(f), {}).get("rmse") for run in each]) for f in FRACTIONS
        ]
        error = float(np.mean([run["scores"]["0.3"]["rmse"] for run in each]))
        first = error if first is None else first
        rows.append(
            [
                PLANS[name].title,
                *cells,
                f"{round(100 * (error / first - 1)):+d} %" if first is not error else "",
                _minutes(each),
                f"{_size(each[0]):,}",
            ]
        )
    head = ["", *(f"{100 * f:.0f} %" for f in FRACTIONS), "at 30 %", "minutes", "numbers"]
    return markdown(head, rows)


def curves(found: dict[str, Any]) -> str:
    """Validation RMSE at 30 % of the trained models, a column per part of the training."""
    parts = (1, 5, 10, 20, 40, 60, 80, 100, 120, 150)
    rows = [
        [
            _title(name) + (f", seed {run['seed']}" if run["seed"] else ""),
            *(f"{run['curve'][n - 1]:.4f}" if n <= len(run["curve"]) else "" for n in parts),
        ]
        for name, each in _main(found)
        for run in each
        if "curve" in run
    ]
    return markdown(["validation RMSE at 30 % after epoch", *map(str, parts)], rows) if rows else ""


def ages(found: dict[str, Any]) -> str:
    """RMSE at 30 % by time since observation, in rows of 5 ms."""
    low = [1, *(a + 1 for a in AGES[:-1])]
    spans = [str(b) if a == b else f"{a} to {b}" for a, b in zip(low, AGES, strict=True)]
    spans[-1] = f"over {AGES[-2]}"
    rows, counted = [], None
    for name, each in _main(found):
        runs = [run["scores"]["0.3"] for run in each if "0.3" in run["scores"]]
        if not runs:
            continue
        counted = runs[0]["rows_by_age"]
        rows.append(
            [_title(name), *(_over([run["by_age"][i] for run in runs]) for i in range(len(AGES)))]
        )
        last = runs
    if counted is None:
        return ""
    total = sum(counted)
    rows.insert(0, ["fraction of the rows", *(f"{n / total:.0%}" for n in counted)])
    share = np.mean([run["error_by_age"] for run in last], axis=0)
    rows.append([f"fraction of the squared error, {_title(name)}", *(f"{s:.0%}" for s in share)])
    return markdown(["rows since observation", *spans], rows)


def contacts(found: dict[str, Any]) -> str:
    """Where the squared error is, at the largest and the smallest fraction."""
    rows = []
    for name, each in _main(found):
        for fraction in (0.9, 0.3):
            scored = [run["scores"].get(str(fraction), {}) for run in each]
            runs = [found for found in scored if "near_switch_rows" in found]
            if runs:
                mean = {
                    key: np.mean([run[key] for run in runs])
                    for key in (
                        "near_switch_rows",
                        "near_switch_error",
                        "rmse_elsewhere",
                        "worst_hundredth",
                    )
                }
                rows.append(
                    [
                        _title(name),
                        f"{100 * fraction:.0f} %",
                        f"{mean['near_switch_rows']:.0%}",
                        f"{mean['near_switch_error']:.0%}",
                        f"{mean['rmse_elsewhere']:.4f}",
                        f"{mean['worst_hundredth']:.0%}",
                    ]
                )
    head = ["", "observed", "rows with a switch", "their squared error", "RMSE of the others"]
    return markdown([*head, "squared error in the worst 1 % of the rows"], rows)


def runs(found: dict[str, Any]) -> str:
    """How each result was made: command, processor, time."""
    rows = []
    for name, each in found["own"].items():
        for run in each:
            machine = run["machine"]
            epochs = f"{run['epochs']} (best {run['best_epoch']})" if "epochs" in run else ""
            rows.append(
                [
                    _title(name),
                    str(run["seed"]),
                    epochs,
                    f"{machine['cpu']}, {machine['scan_backend']}, 1 thread",
                    f"`{run['command']}`",
                ]
            )
    return markdown(["", "seed", "epochs", "processor", "command"], rows)


def _main(found: dict[str, Any]) -> list[tuple[str, list[dict[str, Any]]]]:
    """Names and results of all predictors but those of the ablations."""
    without = {*ABLATIONS[10], *ABLATIONS[40][1:]}
    return [(name, each) for name, each in found["own"].items() if name not in without]


def _parameters(label: str) -> int:
    """Parameters of a model of the record."""
    one = ob.Dataset((ob.Trajectory(np.arange(2.0), np.zeros((2, CHANNELS))),))
    model = ob.make_model(PROTOCOL.model_config(label), one)
    return sum(parameter.numel() for parameter in model.parameters())


def _title(name: str) -> str:
    return PLANS[name].title if name in PLANS else TITLES[name]


def _size(run: dict[str, Any]) -> int:
    return int(run.get("size") or max(s.get("size", 0) for s in run["scores"].values()))


def _minutes(each: Sequence[dict[str, Any]]) -> str:
    """Of the fastest run: the others waited longer for other processes."""
    seconds = [
        run.get("train_s") or max(s.get("fit_s", 0.0) for s in run["scores"].values())
        for run in each
    ]
    minutes = min(seconds) / 60
    return f"{minutes:.0f}" if minutes >= 10 else f"{minutes:.1f}"


def _over(values: Sequence[float | None]) -> str:
    """The mean over seeds, and half of their range where there are several."""
    known = [v for v in values if v is not None]
    if not known:
        return "not run"
    spread = f" ± {(max(known) - min(known)) / 2:.4f}" if len(known) > 1 else ""
    return f"{np.mean(known):.4f}{spread}"
