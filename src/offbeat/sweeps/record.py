"""The record of a sweep: one table of runs and one of curves, as Parquet and as CSV."""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

from offbeat.comparison.run_files import read_rows
from offbeat.errors import FileFormatError
from offbeat.files import atomic_path, write_text

Row = Mapping[str, Any]
Group = tuple[str, ...]

SESSIONS = ("sessions", "sittings")
"""Names of the list of sessions in the folder of a record, now and in version 0.1.0."""

_SCORINGS = ("after_first_observation", "masked", "after_first_row", "published")


@dataclass(frozen=True)
class Record:
    """Finished runs, each once, and their curves.

    A plan with other columns has a subclass that names them.

    Attributes:
        runs: `RUN_COLUMNS` of each run, by run_id.
        curves: `CURVE_COLUMNS` of each epoch, by run_id.
    """

    SCORINGS: ClassVar[Mapping[str, str]] = {name: name for name in _SCORINGS}
    """Scorings by their name in the columns, each with its name in `offbeat.metrics.SCORINGS`."""

    RUN_COLUMNS: ClassVar[Mapping[str, type]] = {
        "run_id": str,
        "model": str,
        "condition": str,
        "repeat": int,
        "epochs": int,
        "steps": int,
        **{f"{name}_mse": float for name in _SCORINGS},
        **{f"last_value_{name}_mse": float for name in _SCORINGS},
        "validation_mse": float,
        "seconds": float,
        "seed_draw": int,
        "seed_weights": int,
        "commit": str,
        "bits": str,
        "cpu": str,
        "device": str,
        "scan_backend": str,
        "threads": int,
        "torch": str,
        "data": str,
        "finished_at": str,
    }
    """Columns of the table of runs. Errors are mean squares on the test part, in scaled units;
    `last_value_*` are those of the predictor that repeats the last observed value; `seconds` is
    wall time; `data` is a hash of the trajectories."""

    CURVE_COLUMNS: ClassVar[Mapping[str, type]] = {
        "run_id": str,
        "epoch": int,
        "train_mse": float,
        "validation_mse": float,
        "validation_after_first_row_mse": float,
        "validation_published_mse": float,
        "seconds": float,
    }
    """Columns of the table of curves, a line per epoch; `seconds` is the time of the epoch."""

    LOG_COLUMNS: ClassVar[Mapping[str, str]] = {
        name: name for name in CURVE_COLUMNS if name != "run_id"
    }
    """Columns of the table of curves, each with its name in the `log.csv` of a training."""

    GROUP: ClassVar[tuple[str, ...]] = ("bits", "cpu", "device", "scan_backend", "torch", "data")
    """Runs that agree in these are comparable; others are never mixed without a message."""

    runs: Mapping[str, Row]
    curves: Mapping[str, tuple[Row, ...]]

    @classmethod
    def empty(cls) -> Self:
        """Returns a record without runs."""
        return cls({}, {})

    @classmethod
    def read(cls, folder: str | Path) -> Self:
        """Reads the record in a folder; returns an empty one if there is none.

        Args:
            folder: with `record.parquet` and `curves.parquet`, or the same as `.csv`.

        Raises:
            FileFormatError: a file is damaged or has other columns, or a run occurs twice.
        """
        folder = Path(folder)
        runs: dict[str, Row] = {}
        for row in _read_table(folder / "record", cls.RUN_COLUMNS):
            if row["run_id"] in runs:
                raise FileFormatError(f"{folder}: run {row['run_id']!r} occurs twice in the record")
            runs[row["run_id"]] = row
        curves: dict[str, list[Row]] = {}
        for row in _read_table(folder / "curves", cls.CURVE_COLUMNS):
            if row["run_id"] in runs:
                curves.setdefault(row["run_id"], []).append(row)
        return cls(runs, {name: tuple(rows) for name, rows in curves.items()})

    @classmethod
    def curve(cls, run_id: str, log: Path) -> tuple[Row, ...]:
        """The curve of a run so far, from its `log.csv`; empty if there is no such file."""
        if not log.is_file():
            return ()
        columns = {there: cls.CURVE_COLUMNS[name] for name, there in cls.LOG_COLUMNS.items()}
        return tuple(
            {"run_id": run_id} | {name: line[there] for name, there in cls.LOG_COLUMNS.items()}
            for line in _typed_rows(log, columns)
        )

    def write(self, folder: str | Path) -> None:
        """Writes both tables as Parquet and CSV, each atomically.

        The curves are written first, so that each run in the record has its curve.
        """
        folder = Path(folder)
        lines = [row for rows in self.curves.values() for row in rows]
        _write_table(folder / "curves", self.CURVE_COLUMNS, lines)
        _write_table(folder / "record", self.RUN_COLUMNS, self.runs.values())

    def with_run(self, row: Row, curve: Iterable[Row]) -> Self:
        """The record with one more run; one of the same name is replaced."""
        name = row["run_id"]
        return type(self)({**self.runs, name: row}, {**self.curves, name: tuple(curve)})

    def merged(self, other: Record) -> Self:
        """The record with the runs of another one that it does not have."""
        return type(self)({**other.runs, **self.runs}, {**other.curves, **self.curves})

    def without(self, names: Iterable[str]) -> Self:
        """The record without these runs."""
        gone = set(names)
        return type(self)(
            {k: v for k, v in self.runs.items() if k not in gone},
            {k: v for k, v in self.curves.items() if k not in gone},
        )

    def in_order(self, names: Iterable[str]) -> Self:
        """The record in the order of these names, others last."""
        place = {name: i for i, name in enumerate(names)}
        ordered = sorted(self.runs, key=lambda name: place.get(name, len(place)))
        return type(self)(
            {name: self.runs[name] for name in ordered},
            {name: self.curves[name] for name in ordered if name in self.curves},
        )

    def groups(self) -> Counter[Group]:
        """Number of runs by the values of `GROUP`."""
        return Counter(self.group_of(row) for row in self.runs.values())

    @classmethod
    def group_of(cls, row: Row) -> Group:
        """The values of `GROUP` of a run."""
        return tuple(str(row[name]) for name in cls.GROUP)

    @classmethod
    def group_text(cls, group: Group, beside: Group | None = None) -> str:
        """A group as text; given another group, only the values that differ from it."""
        pairs = zip(cls.GROUP, group, beside or ("",) * len(cls.GROUP), strict=True)
        return ", ".join(f"{name} {value}" for name, value, other in pairs if value != other)


# --- tables on disk -------------------------------------------------------------------------------


def _write_table(path: Path, columns: Mapping[str, type], rows: Iterable[Row]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows = [{key: row[key] for key in columns} for row in rows]
    kinds = {str: pa.string(), int: pa.int64(), float: pa.float64()}
    schema = pa.schema([(key, kinds[kind]) for key, kind in columns.items()])
    with atomic_path(path.with_suffix(".parquet")) as temporary:
        table = pa.Table.from_pylist(rows, schema=schema)
        pq.write_table(table, temporary, compression="zstd", write_page_checksum=True)
    text = io.StringIO()
    lines = csv.writer(text, lineterminator="\n")
    lines.writerow(columns)
    for row in rows:  # floats to the last bit; an empty field is a NaN
        lines.writerow("" if row[key] != row[key] else row[key] for key in columns)
    write_text(path.with_suffix(".csv"), text.getvalue())


def _read_table(path: Path, columns: Mapping[str, type]) -> list[dict[str, Any]]:
    for suffix, other in ((".parquet", ".csv"), (".csv", ".parquet")):
        file = path.with_suffix(suffix)
        if file.is_file():
            try:
                return _typed_rows(file, columns)
            except FileFormatError as error:
                raise FileFormatError(
                    f"{error}; remove it: {path.name}{other} beside it, if there is one, holds the "
                    "same"
                ) from None
    return []


def _typed_rows(path: Path, columns: Mapping[str, type]) -> list[dict[str, Any]]:
    rows = read_rows(path, [name for name, kind in columns.items() if kind is str])
    missing = columns.keys() - set(rows[0]) if rows else set()
    if missing:
        raise FileFormatError(f"{path} lacks the columns {', '.join(sorted(missing))}")
    empty: dict[type, Any] = {float: math.nan, str: ""}
    try:
        return [
            {
                name: kind(empty[kind] if row[name] is None else row[name])
                for name, kind in columns.items()
            }
            for row in rows
        ]
    except (KeyError, OverflowError, TypeError, ValueError) as error:
        raise FileFormatError(f"{path} is damaged: {str(error)[:150]!r}") from None
