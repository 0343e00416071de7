"""The record of a reproduction: one row per run, and the curves of each run's training."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat import FileFormatError, InputError
from thesis.record import CURVE_COLUMNS, GROUP, RUN_COLUMNS
from thesis.record import Record as RowRecord

PROVENANCE = ("commit", *GROUP)
"""Properties that the runs of one record should share; the page marks differences."""

_MAY_BE_NAN = ("honest_hidden_mse", "last_value_honest_hidden_mse", "validation_published_mse")
"""A run without masked rows, or without a validation part, has none."""

Columns = Mapping[str, NDArray[Any]]


@dataclass(frozen=True, eq=False)
class Record:
    """Finished runs of a reproduction; as many as there are, in no particular order.

    Args:
        runs: `RUN_COLUMNS` of `experiment.record`, each (runs,). Errors are mean squares
            in the thesis' units.
        curves: `CURVE_COLUMNS`, each (lines,); may be empty.
        source: where it was read from, for messages.

    Raises:
        InputError: a column is missing or of another length, a run occurs twice, or a number is
            out of its range; the message says in which run.
    """

    runs: Columns
    curves: Columns
    source: str = "the record"

    def __post_init__(self) -> None:
        _check_columns(self.runs, RUN_COLUMNS, self.source)
        _check_columns(self.curves, CURVE_COLUMNS, f"the curves of {self.source}")
        if not len(self):
            raise InputError(f"{self.source} holds no finished run; let a run finish first")
        shares = np.round(self.runs["observed_fraction"].astype(float), 6)
        object.__setattr__(self, "runs", {**self.runs, "observed_fraction": shares})
        self._check_runs()

    def __len__(self) -> int:
        return len(self.runs["run_id"])

    def _check_runs(self) -> None:
        names = self.runs["run_id"]
        _no_twins(names.tolist(), "run_id", self.source)
        keys = ("experiment", "model", "observed_fraction", "repeat")
        _no_twins(
            list(zip(*(self.runs[key].tolist() for key in keys), strict=True)), keys, self.source
        )
        numbers = [name for name, kind in RUN_COLUMNS.items() if kind is float]
        limits: dict[str, tuple[float, float]] = {
            **dict.fromkeys(numbers, (0.0, np.inf)),
            "observed_fraction": (1e-6, 1.0),
            "hidden_rows_0_share": (0.0, 1.0),
        }
        for column, (low, high) in limits.items():
            values = self.runs[column].astype(float)
            good = np.isfinite(values) & (values >= low) & (values <= high)
            good |= np.isnan(values) & (column in _MAY_BE_NAN)
            if not good.all():
                at = int((~good).argmax())
                wanted = (
                    "a finite number of at least 0" if high == np.inf else f"from 0 to {high:g}"
                )
                raise InputError(
                    f"{self.source}: {column} of run {names[at]!r} is {values[at]}, expected "
                    f"{wanted}; remove the run from the record and let it run again"
                )
        strange = set(self.curves["run_id"].tolist()) - set(names.tolist())
        # A run that has not finished has a curve already; it is not shown before it is recorded.
        if strange:
            kept = ~np.isin(self.curves["run_id"], sorted(strange))
            object.__setattr__(self, "curves", {k: v[kept] for k, v in self.curves.items()})

    @property
    def folder(self) -> str:
        """The folder it was read from as a command can name it; empty where that is elsewhere."""
        path = Path(self.source)
        inside = len(path.parts) > 1 and not path.is_absolute() and ".." not in path.parts
        return path.as_posix() if inside else ""

    # --- queries ----------------------------------------------------------------------------------

    def where(
        self,
        *,
        experiment: int | None = None,
        model: str | None = None,
        fraction: float | None = None,
    ) -> NDArray[np.int64]:
        """Rows of the selected runs, by repeat.

        Args:
            experiment: 1 or 2.
            model: label of the model.
            fraction: observed fraction of the rows.
        """
        chosen = np.ones(len(self), dtype=bool)
        for column, wanted in (
            ("experiment", experiment),
            ("model", model),
            ("observed_fraction", None if fraction is None else round(fraction, 6)),
        ):
            if wanted is not None:
                chosen &= self.runs[column] == wanted
        rows = np.flatnonzero(chosen)
        return rows[np.argsort(self.runs["repeat"][rows], kind="stable")]

    def values(self, column: str, rows: NDArray[np.int64]) -> NDArray[Any]:
        """A column at these rows."""
        return self.runs[column][rows]

    def rmse(self, scoring: str, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Root of a run's mean squared error; `scoring` may start with `last_value_`."""
        mse: NDArray[np.float64] = self.runs[f"{scoring}_mse"][rows].astype(float)
        return np.sqrt(mse)

    def shared(
        self, models: Iterable[str], *, fraction: float, experiment: int = 2
    ) -> dict[str, NDArray[np.int64]]:
        """Rows of several models, those repeats only that all of them have, in the same order."""
        rows = {
            m: self.where(experiment=experiment, model=m, fraction=fraction)
            for m in dict.fromkeys(models)
        }
        repeats = [set(self.values("repeat", r).tolist()) for r in rows.values()]
        common = sorted(set.intersection(*repeats)) if repeats else []
        return {m: r[np.isin(self.values("repeat", r), common)] for m, r in rows.items()}

    def curve(self, run_id: str) -> dict[str, NDArray[np.float64]]:
        """The training of one run, by epoch; empty arrays where it was not kept."""
        rows = np.flatnonzero(self.curves["run_id"] == run_id)
        rows = rows[np.argsort(self.curves["epoch"][rows], kind="stable")]
        return {name: self.curves[name][rows] for name in CURVE_COLUMNS if name != "run_id"}

    def mixed(self, rows: NDArray[np.int64]) -> tuple[str, ...]:
        """What differs between these runs of all that numbers depend on (`GROUP`)."""
        return tuple(c for c in GROUP if len(set(self.runs[c][rows].tolist())) > 1)

    def counts(self, column: str) -> dict[str, int]:
        """How many runs have each value of a column, the most frequent first."""
        values, numbers = np.unique(self.runs[column].astype(str), return_counts=True)
        order = np.argsort(-numbers, kind="stable")
        return {str(values[i]): int(numbers[i]) for i in order}


def read_record(path: str | Path) -> Record:
    """Reads the record of a reproduction.

    Args:
        path: folder with `record.parquet` or `record.csv`, and `curves.parquet` or `curves.csv`.
            Parquet is preferred to CSV. Curves may be missing.

    Raises:
        FileFormatError: there is no record, or a file cannot be read.
        InputError: a column is missing, or its values are not what they must be.
    """
    path = Path(path)
    if not path.is_dir():
        what = "a file" if path.exists() else "not there"
        raise FileFormatError(f"{path} is {what}; give the folder that holds record.parquet")
    if not any((path / f"record{suffix}").is_file() for suffix in (".parquet", ".csv")):
        raise FileFormatError(
            f"{path} holds neither record.parquet nor record.csv; give the folder that "
            "'python -m thesis run --out' wrote, or let it finish a run first"
        )
    read = RowRecord.read(path)
    curves = [line for lines in read.curves.values() for line in lines]
    return Record(
        _columns(read.runs.values(), RUN_COLUMNS), _columns(curves, CURVE_COLUMNS), str(path)
    )


def _columns(rows: Iterable[Mapping[str, Any]], wanted: Mapping[str, type]) -> dict[str, Any]:
    rows = list(rows)
    return {
        name: np.array([row[name] for row in rows], dtype=object if kind is str else kind)
        for name, kind in wanted.items()
    }


def _check_columns(columns: Columns, wanted: Mapping[str, type], source: str) -> None:
    missing = [name for name in wanted if name not in columns]
    if missing:
        raise InputError(f"{source} lacks the columns {', '.join(missing)}")
    lengths = {len(columns[name]) for name in wanted}
    if len(lengths) > 1:
        raise InputError(f"columns of {source} have different lengths: {sorted(lengths)}")


def _no_twins(values: list[Any], what: Any, source: str) -> None:
    seen = set()
    for value in values:
        if value in seen:
            named = what if isinstance(what, str) else ", ".join(what)
            raise InputError(
                f"{source} holds two runs with the same {named}: {value}; a run counts once, "
                "remove one of them"
            )
        seen.add(value)
