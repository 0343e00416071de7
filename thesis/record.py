"""The record of runs: one table of runs and one of curves, as Parquet and as CSV."""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from offbeat.errors import FileFormatError
from offbeat.files import atomic_path, write_text

Row = Mapping[str, Any]

RUN_COLUMNS: dict[str, type] = {
    "run_id": str,
    "experiment": int,
    "model": str,
    "observed_fraction": float,
    "repeat": int,
    "epochs": int,
    "steps": int,
    "published_mse": float,
    "rows_1_99_mse": float,
    "honest_mse": float,
    "honest_hidden_mse": float,
    "last_value_published_mse": float,
    "last_value_rows_1_99_mse": float,
    "last_value_honest_mse": float,
    "last_value_honest_hidden_mse": float,
    "row_0_constant": float,
    "hidden_rows_0_share": float,
    "validation_published_mse": float,
    "seconds": float,
    "seed_draw": int,
    "seed_weights": int,
    "commit": str,
    "bits": str,
    "cpu": str,
    "kernel_body": str,
    "threads": int,
    "torch": str,
    "mujoco": str,
    "data": str,
    "finished_at": str,
}
"""Columns of the table of runs. Errors are mean squares on the test part, in scaled units;
`seconds` is wall time; `data` is a hash of the recorded trajectories."""

CURVE_COLUMNS: dict[str, type] = {
    "run_id": str,
    "epoch": int,
    "train_mse": float,
    "validation_honest_mse": float,
    "validation_rows_1_99_mse": float,
    "validation_published_mse": float,
    "seconds": float,
}
"""Columns of the table of curves, a line per epoch; `seconds` is the training time of the epoch."""

SCORINGS: dict[str, str] = {
    "honest": "after_first_observation",
    "honest_hidden": "masked",
    "rows_1_99": "after_first_row",
    "published": "published",
}
"""Names of the scorings in the record, each with its name in `offbeat.metrics.SCORINGS`. The record
was begun under these names; "honest" is the score after the first observation."""

LOG_COLUMNS: dict[str, str] = {
    **{name: name for name in CURVE_COLUMNS if name != "run_id"},
    "validation_honest_mse": "validation_mse",
    "validation_rows_1_99_mse": "validation_after_first_row_mse",
}
"""Columns of the table of curves, each with its name in the `log.csv` of a training."""

GROUP = ("bits", "cpu", "kernel_body", "torch", "data")
"""Runs that agree in these were made alike; those that do not are never mixed in silence."""

SESSIONS = ("sessions", "sittings")
"""Name of the list of sessions, here and in version 0.1.0."""

_TABLES = {"record": RUN_COLUMNS, "curves": CURVE_COLUMNS}


@dataclass(frozen=True)
class Record:
    """Finished runs, each once, and their curves.

    Attributes:
        runs: `RUN_COLUMNS` of each run, by run_id.
        curves: `CURVE_COLUMNS` of each epoch, by run_id.
    """

    runs: Mapping[str, Row]
    curves: Mapping[str, tuple[Row, ...]]

    @classmethod
    def empty(cls) -> Record:
        """No run yet."""
        return cls({}, {})

    @classmethod
    def read(cls, folder: str | Path) -> Record:
        """Reads the record that a folder holds; an empty one if it holds none.

        Args:
            folder: with `record.parquet` and `curves.parquet`, or the same as `.csv`.

        Raises:
            FileFormatError: a file is damaged or has other columns, or a run stands twice.
        """
        folder = Path(folder)
        runs: dict[str, Row] = {}
        for row in _read_table(folder, "record"):
            if row["run_id"] in runs:
                raise FileFormatError(f"{folder}: run {row['run_id']!r} stands twice in the record")
            runs[row["run_id"]] = row
        curves: dict[str, list[Row]] = {}
        for row in _read_table(folder, "curves"):
            if row["run_id"] in runs:
                curves.setdefault(row["run_id"], []).append(row)
        return cls(runs, {name: tuple(rows) for name, rows in curves.items()})

    def write(self, folder: str | Path) -> None:
        """Writes both tables as Parquet and CSV, each whole or not at all.

        The curves come first, so that a run in the record has its curve.
        """
        folder = Path(folder)
        _write_table(folder, "curves", [row for rows in self.curves.values() for row in rows])
        _write_table(folder, "record", self.runs.values())

    def with_run(self, row: Row, curve: Iterable[Row]) -> Record:
        """The record with one more run; one of the same name is replaced."""
        name = row["run_id"]
        return Record({**self.runs, name: row}, {**self.curves, name: tuple(curve)})

    def merged(self, other: Record) -> Record:
        """The record with the runs of another one that it does not have."""
        return Record({**other.runs, **self.runs}, {**other.curves, **self.curves})

    def without(self, names: Iterable[str]) -> Record:
        """The record without these runs."""
        gone = set(names)
        return Record(
            {k: v for k, v in self.runs.items() if k not in gone},
            {k: v for k, v in self.curves.items() if k not in gone},
        )

    def in_order(self, names: Iterable[str]) -> Record:
        """The record in the order of these names, others last."""
        place = {name: i for i, name in enumerate(names)}
        ordered = sorted(self.runs, key=lambda name: place.get(name, len(place)))
        return Record(
            {name: self.runs[name] for name in ordered},
            {name: self.curves[name] for name in ordered if name in self.curves},
        )

    def groups(self) -> Counter[tuple[str, ...]]:
        """How many runs were made alike, by the values of `GROUP`."""
        return Counter(group_of(row) for row in self.runs.values())


def group_of(row: Row) -> tuple[str, ...]:
    """The values of `GROUP` of a run."""
    return tuple(str(row[name]) for name in GROUP)


def group_text(group: tuple[str, ...], beside: tuple[str, ...] | None = None) -> str:
    """A group in words; with another one beside it, only what differs from that."""
    pairs = zip(GROUP, group, beside or ("",) * len(GROUP), strict=True)
    return ", ".join(f"{name} {value}" for name, value, other in pairs if value != other)


# --- tables on disk -------------------------------------------------------------------------------


def read_log(path: str | Path) -> tuple[Row, ...]:
    """The lines of a training's `log.csv`, as far as it has come; none if there is no such file."""
    path = Path(path)
    if not path.is_file():
        return ()
    lines = _typed_lines(path, {log: CURVE_COLUMNS[name] for name, log in LOG_COLUMNS.items()})
    return tuple({name: line[log] for name, log in LOG_COLUMNS.items()} for line in lines)


def _write_table(folder: Path, name: str, rows: Iterable[Row]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns = _TABLES[name]
    rows = [{key: row[key] for key in columns} for row in rows]
    kinds = {str: pa.string(), int: pa.int64(), float: pa.float64()}
    schema = pa.schema([(key, kinds[kind]) for key, kind in columns.items()])
    with atomic_path(folder / f"{name}.parquet") as temporary:
        table = pa.Table.from_pylist(rows, schema=schema)
        pq.write_table(table, temporary, compression="zstd", write_page_checksum=True)
    text = io.StringIO()
    lines = csv.writer(text, lineterminator="\n")
    lines.writerow(columns)
    for row in rows:  # floats to the last bit; an empty cell is a NaN
        lines.writerow("" if row[key] != row[key] else row[key] for key in columns)
    write_text(folder / f"{name}.csv", text.getvalue())


def _read_table(folder: Path, name: str) -> list[dict[str, Any]]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = folder / f"{name}.parquet"
    if not path.is_file():
        path = folder / f"{name}.csv"
        return _typed_lines(path, _TABLES[name]) if path.is_file() else []
    try:
        table = pq.read_table(path, page_checksum_verification=True, memory_map=False)
    except (pa.ArrowException, OSError) as error:
        raise FileFormatError(
            f"{path} is damaged ({' '.join(str(error).split())}); remove it: the CSV beside it "
            "holds the same"
        ) from None
    _check_columns(path, table.column_names, _TABLES[name])
    rows: list[dict[str, Any]] = table.select(list(_TABLES[name])).to_pylist()
    return rows


def _typed_lines(path: Path, columns: Mapping[str, type]) -> list[dict[str, Any]]:
    with path.open(newline="", encoding="utf-8") as file:
        reader = csv.DictReader(file)
        _check_columns(path, reader.fieldnames or (), columns)
        try:
            return [
                {
                    key: math.nan if kind is float and not line[key] else kind(line[key])
                    for key, kind in columns.items()
                }
                for line in reader
            ]
        except (TypeError, ValueError) as error:
            raise FileFormatError(
                f"{path} is damaged at line {reader.line_num} ({error}); take it from where it "
                "was committed, or remove it"
            ) from None


def _check_columns(path: Path, got: Iterable[str], columns: Mapping[str, type]) -> None:
    missing = columns.keys() - set(got)
    if missing:
        raise FileFormatError(
            f"{path} lacks the columns {', '.join(sorted(missing))}; give a record that "
            "`python -m thesis run` of this version wrote"
        )
