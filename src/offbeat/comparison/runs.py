"""`read_runs`: reads finished runs from their folders or from a table, for `compare`."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from offbeat.comparison.run_files import RawRun, read_raw
from offbeat.errors import InputError, one_of


@dataclass(frozen=True)
class Run:
    """One finished run.

    Attributes:
        name: its folder, or its id in a table.
        model: label of the model; runs with the same label are repeats of each other.
        condition: data, observed fraction, experiment. Only runs under the same
            condition are compared.
        repeat: pairs the runs of different models; runs of one repeat share windows and masks.
        mse: mean squared error on the test part by metric, in scaled units; NaN where nothing
            counted.
        last_value_mse: that of the last-value predictor; empty where it is not known.
        draw: of windows and masks; runs with different weights may share one.
        origin: known values of `PROVENANCE`.
    """

    name: str
    model: str
    condition: str
    repeat: str
    mse: Mapping[str, float]
    last_value_mse: Mapping[str, float] = field(default_factory=dict)
    draw: str = ""
    origin: Mapping[str, str] = field(default_factory=dict)


def read_runs(
    paths: str | Path | Iterable[str | Path], *, only: Mapping[str, Any] | None = None
) -> tuple[Run, ...]:
    """Reads finished runs.

    A folder of `offbeat train` is a run: its model is the name in config.yaml, its condition the
    data and its split, its repeat the seed of the split. Where several runs of a model share
    that seed, the seed of the weights pairs them. Runs of one name under one condition whose
    settings differ have the settings in their label: `gru[hidden_size=32]`.

    A table has a row per run, with columns `model`, `repeat` and `<metric>_mse` (such as
    `masked_mse`), and optionally `run_id`, `condition`, `data`, `experiment`,
    `observed_fraction`, `seed_draw`, `last_value_<metric>_mse`, `commit`, `bits`, `cpu`,
    `scan_backend`, `torch`. Names of version 0.1.0 are read as well.

    Args:
        paths: of folders of runs, of folders that hold such folders or a `record.parquet` or
            `record.csv`, and of tables (.parquet or .csv).
        only: keep runs with these values: `{"experiment": 2}`; names are columns of the table, or
            `model` and the fields of the configs.

    Raises:
        InputError: no run is found or kept, or two are the same.
        FileFormatError: a file is missing, damaged, or lacks a column.
    """
    given = [paths] if isinstance(paths, str | Path) else list(paths)
    raws = [raw for path in given for raw in read_raw(Path(path))]
    for key, wanted in (only or {}).items():
        one_of("name to select runs by", key, {name for raw in raws for name in raw.choices})
        raws = [raw for raw in raws if key in raw.choices and _same(raw.choices[key], wanted)]
    if not raws:
        chosen = ", ".join(f"{k}={v}" for k, v in (only or {}).items())
        raise InputError(
            f"none of the runs has {chosen}; leave it out to list the runs"
            if chosen
            else "no runs; give folders of runs, or a table (.parquet or .csv)"
        )
    return _label(raws)


def parse_only(text: str | None) -> dict[str, str]:
    """Reads `experiment=2,model=ode_rnn`.

    Raises:
        InputError: a part is not `name=value`.
    """
    chosen: dict[str, str] = {}
    for part in filter(None, (text or "").split(",")):
        name, equals, value = part.partition("=")
        if not (name.strip() and equals):
            raise InputError(
                f"got {part!r} to select runs by, expected name=value, as experiment=2"
            )
        chosen[name.strip()] = value.strip()
    return chosen


# --- labels ---------------------------------------------------------------------------------------


def _label(raws: Sequence[RawRun]) -> tuple[Run, ...]:
    conditions = [_freeze(raw.condition) for raw in raws]
    names = _condition_names(raws)
    groups: dict[Any, list[RawRun]] = {}
    for raw, condition in zip(raws, conditions, strict=True):
        groups.setdefault((condition, raw.model), []).append(raw)
    models: dict[int, str] = {}
    for (_, model), group in groups.items():
        differ = _differing([raw.settings for raw in group])
        for raw in group:
            named = ", ".join(f"{key.split('.')[-1]}={raw.settings.get(key)}" for key in differ)
            models[id(raw)] = f"{model}[{named}]" if named else model
    # One seed is enough to pair by where it differs in all repeats of each model.
    for depth in range(1, max(len(raw.seeds) for raw in raws) + 1):
        keys = [
            (c, models[id(raw)], raw.seeds[:depth]) for c, raw in zip(conditions, raws, strict=True)
        ]
        if len(set(keys)) == len(keys):
            break
    else:
        twin = next(i for i, key in enumerate(keys) if key in keys[:i])
        other = raws[keys.index(keys[twin])].name
        raise InputError(
            f"{raws[twin].name} and {other} are the same model, condition and repeat "
            f"({keys[twin][1]}, {' and '.join(keys[twin][2])}); leave one of them out"
        )
    return tuple(
        Run(
            raw.name,
            models[id(raw)],
            names[condition],
            " / ".join(raw.seeds[:depth]),
            raw.mse,
            raw.last_value_mse,
            raw.draw,
            raw.origin,
        )
        for raw, condition in zip(raws, conditions, strict=True)
    )


def _condition_names(raws: Sequence[RawRun]) -> dict[Any, str]:
    differ = _differing([raw.condition for raw in raws])
    names: dict[Any, str] = {}
    for raw in raws:
        parts = [str(raw.condition["data"])] if "data" in raw.shown else []
        shown = [key for key in raw.condition if key in raw.shown or key in differ]
        parts += [
            str(raw.condition[key]) if key == "condition" else f"{key} {raw.condition[key]}"
            for key in shown
            if raw.condition[key] is not None and not (key == "data" and "data" in raw.shown)
        ]
        names[_freeze(raw.condition)] = ", ".join(parts) or "all runs"
    return names


def _differing(settings: Sequence[Mapping[str, Any]]) -> list[str]:
    keys = dict.fromkeys(key for one in settings for key in one)
    return [k for k in keys if len({json.dumps(one.get(k), default=str) for one in settings}) > 1]


def _freeze(values: Mapping[str, Any]) -> str:
    return json.dumps(values, sort_keys=True, default=str)


def _same(value: Any, wanted: Any) -> bool:
    if str(value) == str(wanted):
        return True
    try:
        return math.isclose(float(value), float(wanted), rel_tol=1e-9)
    except (TypeError, ValueError):
        return False
