"""Reads run folders and tables of runs."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from offbeat import safe_yaml
from offbeat.errors import FileFormatError, one_of

METRICS = ("after_first_observation", "masked", "after_first_row", "published")
"""The scorings of a run, `offbeat.metrics.SCORINGS`; repeated here to avoid importing torch."""

LAST_VALUE = "last_value"
"""Name of the trivial predictor that is scored with every run."""

_OLD = {
    "after_first_observation": "honest",
    "masked": "honest_hidden",
    "after_first_row": "rows_1_99",
    "scan_backend": "kernel_body",
    "split": "parts",
}
"""Names of version 0.1.0, which the record of the thesis keeps."""

PROVENANCE = ("commit", "bits", "cpu", "scan_backend", "torch")
"""What compared runs should have in common; differences are noted."""

_NEW = {
    **{f"{old}_mse": f"{name}_mse" for name, old in _OLD.items()},
    **{f"last_value_{old}_mse": f"last_value_{name}_mse" for name, old in _OLD.items()},
    "kernel_body": "scan_backend",
}

_CONDITION = ("condition", "data", "experiment", "observed_fraction")
_TEXT = ("run_id", "model", "condition", "data", "repeat", *PROVENANCE, "kernel_body")
_NOT_SETTINGS = ("seed", "checkpoint_every")


@dataclass(frozen=True)
class RawRun:
    """A run before labels are assigned.

    Attributes:
        name: its folder, or its id in a table.
        model: name of the model.
        condition: settings of the condition, by name.
        shown: those of them that are part of every label.
        settings: of model and training, without seeds.
        seeds: that differ between repeats; only the first where that is enough.
        choices: values that runs can be selected by.
        mse: by metric, NaN where nothing counted.
        last_value_mse: by metric.
        draw: of windows and masks.
        origin: known values of `PROVENANCE`.
    """

    name: str
    model: str
    condition: Mapping[str, Any]
    shown: tuple[str, ...]
    settings: Mapping[str, Any]
    seeds: tuple[str, ...]
    choices: Mapping[str, Any]
    mse: Mapping[str, float]
    last_value_mse: Mapping[str, float]
    draw: str
    origin: Mapping[str, str]


def read_raw(path: Path) -> list[RawRun]:
    """Reads the runs at a path.

    Args:
        path: folder of a run, folder of such folders or of a record, or a table.

    Raises:
        FileFormatError: it is missing, damaged, or holds no run.
    """
    if path.is_dir():
        if (path / "results.json").is_file():
            return [_read_folder(path)]
        for name in ("record.parquet", "record.csv"):
            if (path / name).is_file():
                return _read_table(path / name)
        inside = sorted(file.parent for file in path.glob("*/results.json"))
        if inside:
            return [_read_folder(folder) for folder in inside]
        raise FileFormatError(
            f"{path} is not a finished run: it has neither results.json nor a record of runs; "
            "'offbeat train' writes results.json when it is done"
        )
    if not path.exists():
        raise FileFormatError(f"{path} does not exist; give a folder or table of runs")
    one_of(f"suffix of {path.name}", path.suffix.lower(), (".csv", ".parquet"))
    return _read_table(path)


def _read_folder(folder: Path) -> RawRun:
    config = _load(folder / "config.yaml", safe_yaml.load)
    results = _load(folder / "results.json", json.loads)
    try:
        model, training = config["model"], config["training"]
        split = dict(_named(config, "split"))
        scores, name = results["predictors"], str(model["name"])
        draw = str(split.pop("seed"))
        for option in ("blocks", "gap_s"):  # runs from before they existed lack them
            if split.get(option) is None:
                split.pop(option, None)
        condition = {"data": Path(config["data"]).name, **split, "scaler": config["scaler"]}
        for path in (folder / "split.json", folder / "parts.json"):  # the second is of 0.1.0
            if path.is_file():
                condition["fingerprint"] = str(_load(path, json.loads)["data"])[:12]
        settings = {
            f"{part}.{key}": value
            for part, values in (("model", model), ("training", training))
            for key, value in values.items()
            if key not in _NOT_SETTINGS
        }
        choices = {**training, **model, **condition, "model": name, "seed": config["seed"]}
        return RawRun(
            str(folder),
            name,
            condition,
            tuple(
                k for k in ("data", "window", "observed_fraction") if condition.get(k) is not None
            ),
            settings,
            (f"split.seed {draw}", f"seed {config['seed']}"),
            choices,
            {metric: _mse(_named(scores[name], metric)) for metric in METRICS},
            {metric: _mse(_named(scores[LAST_VALUE], metric)) for metric in METRICS},
            draw,
            {},
        )
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise FileFormatError(
            f"{folder} is not a run of 'offbeat train' ({type(error).__name__}: {error}); "
            "train again"
        ) from None


def _named(values: Mapping[str, Any], name: str) -> Any:
    """A value by its name, or by its name in version 0.1.0."""
    return values[name] if name in values else values[_OLD.get(name, name)]


def _load(path: Path, parse: Callable[[str], Any]) -> Any:
    try:
        return parse(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise FileFormatError(f"{path} is missing; is {path.parent} a finished run?") from None
    except Exception as error:  # of JSON or of YAML
        line = " ".join(str(error).split())
        raise FileFormatError(f"{path} is damaged ({line}); train again") from None


def _mse(score: Mapping[str, Any]) -> float:
    return math.nan if score["mse"] is None else float(score["mse"])


# --- tables ---------------------------------------------------------------------------------------


def _read_table(path: Path) -> list[RawRun]:
    rows = [
        {_NEW.get(name, name): value for name, value in row.items()}
        for row in read_rows(path, _TEXT)
    ]
    columns = set(rows[0]) if rows else set()
    metrics = [metric for metric in METRICS if f"{metric}_mse" in columns]
    missing = [name for name in ("model", "repeat") if name not in columns]
    if not rows or missing or not metrics:
        what = "has no rows" if not rows else f"lacks the columns {', '.join(missing)}"
        if rows and not missing:
            what = "has no column of scores"
        raise FileFormatError(
            f"{path} {what}; expected a row per run with model, repeat and one or more of "
            f"{', '.join(f'{metric}_mse' for metric in METRICS)}"
        )
    found = []
    for number, row in enumerate(rows, start=1):
        where = f"row {number} of {path}"
        trivial = {
            metric: _number(row[f"{LAST_VALUE}_{metric}_mse"], where)
            for metric in metrics
            if row.get(f"{LAST_VALUE}_{metric}_mse") is not None
        }
        found.append(
            RawRun(
                str(row.get("run_id") or where),
                str(row["model"]),
                {key: row[key] for key in _CONDITION if key in columns},
                tuple(key for key in _CONDITION if key in columns and key != "data"),
                {},
                (f"repeat {row['repeat']}",),
                row,
                {metric: _number(row[f"{metric}_mse"], where) for metric in metrics},
                trivial,
                str(row.get("seed_draw", row["repeat"])),
                {key: str(row[key]) for key in PROVENANCE if row.get(key) is not None},
            )
        )
    return found


def read_rows(path: Path, text: Iterable[str]) -> list[dict[str, Any]]:
    """Reads the rows of a table.

    Args:
        path: .parquet or .csv.
        text: columns that hold texts; the types of the others are found in a CSV file.

    Raises:
        FileFormatError: the file is damaged.
    """
    import pyarrow as pa
    import pyarrow.csv
    import pyarrow.parquet

    try:
        if path.suffix.lower() == ".parquet":
            table = pyarrow.parquet.read_table(
                path, page_checksum_verification=True, memory_map=False
            )
        else:
            options = pyarrow.csv.ConvertOptions(
                column_types={name: pa.string() for name in text}, strings_can_be_null=True
            )
            table = pyarrow.csv.read_csv(path, convert_options=options)
        rows: list[dict[str, Any]] = table.to_pylist()
    except (pa.ArrowException, OSError, ValueError) as error:
        line = " ".join(str(error).split())[:200]
        raise FileFormatError(f"{path} cannot be read as a table of runs: {line}") from None
    return rows


def _number(value: Any, where: str) -> float:
    try:
        return math.nan if value is None else float(value)
    except (TypeError, ValueError):
        raise FileFormatError(f"{where}: {value!r} is not a number, expected an error") from None
