"""CSV, read as a data set: a header, then one row per time."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.source import require_file
from offbeat.data.trajectory import SECONDS_PER, Dataset, Trajectory
from offbeat.errors import FileFormatError, InputError, one_of

TIME_COLUMNS = ("time", "t", "timestamp", "time_s", "time_ms", "time_us", "time_ns")
"""Names that make a column the time, in any case; the first of them that the file has. The last
four say their unit, too."""

TRAJECTORY_COLUMNS = ("trajectory", "episode")
"""Names, in any case, that make a column the label of the trajectory that a row belongs to."""

MISSING = ("", "NaN", "nan", "NA", "null")
"""What a cell holds where its value is not known."""


def read_csv(
    path: str | Path,
    *,
    time_column: str | None = None,
    trajectory_column: str | None = None,
    channels: Sequence[str] | None = None,
    time_unit: str | None = None,
    units: Mapping[str, str] | None = None,
    delimiter: str = ",",
) -> Dataset:
    """Reads a data set from CSV: a header, then one row per time.

    The rows of a trajectory stand in the order of time; trajectories may take turns. An integer
    clock loses no bits: its times count from the first row of each trajectory, and
    `meta["clock_start"]` keeps what that row said.

    Args:
        path: the file, in UTF-8.
        time_column: the column of times; by default found by its name, see `TIME_COLUMNS`.
        trajectory_column: the column that says to which trajectory a row belongs, by a number or
            any text; by default found by its name, see `TRAJECTORY_COLUMNS`. Without one, the file
            is one trajectory.
        channels: the columns to read as channels; by default all others.
        time_unit: `s`, `ms`, `us` or `ns`; by default what the column's name says, else `s`.
        units: unit of a channel by its name; CSV itself has none.
        delimiter: the character between two cells.

    Returns:
        Trajectories in the order of their first rows; a cell that is empty, or another of
        `MISSING`, is NaN.

    Raises:
        FileFormatError: the file is missing or empty, its header or a row is not as it must be, a
            cell is not a number, or times do not increase.
        InputError: an option names a column or a unit that there is not.
    """
    if len(delimiter) != 1 or not delimiter.isascii() or delimiter in '"\r\n':
        raise InputError(
            f"delimiter must be one ASCII character, no quote or line end, got {delimiter!r}"
        )
    file = _CsvFile(require_file(path), delimiter)
    header = file.header()
    time = _column("time_column", time_column, TIME_COLUMNS, header)
    if time is None:
        raise FileFormatError(
            f"{file.path} has no column of times: its first line must name one of "
            f"{', '.join(TIME_COLUMNS)}, got {_listed(header)}; say which one with time_column="
        )
    others = [name for name in header if name != time]
    label = _column("trajectory_column", trajectory_column, TRAJECTORY_COLUMNS, others)
    names = [name for name in others if name != label]
    if not names:
        raise FileFormatError(
            f"{file.path} has no channels, only the columns {_listed(header)}; "
            "it needs one column per channel beside the time"
        )
    if channels is not None:
        names = [one_of("channel", name, names) for name in dict.fromkeys(channels)]
    units = dict(units or {})
    for name in units:
        one_of("channel in units", name, names)
    unit_said = time.casefold().removeprefix("time_")
    unit = time_unit or (unit_said if unit_said in SECONDS_PER else "s")
    one_of("time unit", unit, SECONDS_PER)
    if unit_said in SECONDS_PER and unit != unit_said:
        raise InputError(
            f"{file.path}: the column {time!r} says that times are in {unit_said}, time_unit says "
            f"{unit}; leave time_unit out, or rename the column"
        )

    clock, labels, values = file.columns(header, time, label, names)
    groups = _groups(labels, file, label)
    trajectories = []
    for text, rows in groups.items():
        origin = f"{file.path.name}, {label} {text}" if label else file.path.name
        _check_increasing(clock, rows, file, origin)
        try:
            trajectory = Trajectory.from_arrays(
                clock[rows],
                values[rows],
                time_unit=unit,
                names=tuple(names),
                units=tuple(units.get(name, "") for name in names),
                origin=origin,
            )
        except InputError as error:
            raise FileFormatError(f"{file.path}: {error}") from None
        trajectories.append(trajectory)
    meta: dict[str, Any] = {"source": file.path.name, "time_unit": unit}
    if label:
        meta["labels"] = list(groups)
    if clock.dtype.kind == "i":
        meta["clock_start"] = [int(clock[rows[0]]) for rows in groups.values()]
    return Dataset(tuple(trajectories), meta)


def _column(option: str, given: str | None, usual: Sequence[str], header: list[str]) -> str | None:
    if given is not None:
        return one_of(option, given, header)
    folded = {name.casefold(): name for name in reversed(header)}
    return next((folded[name] for name in usual if name in folded), None)


def _groups(labels: Any, file: _CsvFile, label: str | None) -> dict[str, NDArray[np.int64]]:
    """Positions of the rows of every trajectory, in order, by label in order of appearance."""
    coded = labels.combine_chunks().dictionary_encode()
    codes, texts = coded.indices.to_numpy(), coded.dictionary.to_pylist()
    if label and "" in texts:
        line = file.line_of(int(np.argmax(codes == texts.index(""))))
        raise FileFormatError(
            f"{file.path} has an empty cell in line {line}, column {label!r}; "
            "every row must say which trajectory it belongs to"
        )
    order = np.argsort(codes, kind="stable")
    starts = np.flatnonzero(np.diff(codes[order]))
    return dict(zip(texts, np.split(order, starts + 1), strict=True))


def _check_increasing(
    clock: NDArray[Any], rows: NDArray[np.int64], file: _CsvFile, origin: str
) -> None:
    late = np.flatnonzero(np.diff(clock[rows]) <= 0)
    if late.size:
        row = int(late[0]) + 1
        before, after = rows[row - 1], rows[row]
        raise FileFormatError(
            f"{file.path}: times (of {origin}) must increase strictly, got {clock[before]} at row "
            f"{row - 1} (line {file.line_of(before)}) and {clock[after]} at row {row} (line "
            f"{file.line_of(after)}); sort the rows and drop repeated times"
        )


@dataclass(frozen=True)
class _CsvFile:
    """A CSV file: read fast by pyarrow, and line by line where an error needs its place."""

    path: Path
    delimiter: str

    def header(self) -> list[str]:
        """The column names, stripped; unique, none of them empty."""
        line, cells = next(self._lines(), (0, []))
        names = [cell.strip() for cell in cells]
        if line != 1:
            got = f"a header that ends in line {line}" if line else "empty lines alone"
            raise FileFormatError(
                f"{self.path} must name its columns in line 1, got {got}; mend its first line"
            )
        for i, name in enumerate(names):
            if not name or name in names[:i]:
                fault = f"the column name {name!r} twice" if name else f"no name for column {i}"
                raise FileFormatError(
                    f"{self.path} has {fault} in its first line, got {_listed(names)}; "
                    "give every column a name of its own"
                )
        return names

    def columns(
        self, header: list[str], time: str, label: str | None, names: list[str]
    ) -> tuple[NDArray[Any], Any, NDArray[np.float64]]:
        """The clock, (rows,) int64 or float64; the labels, as Arrow strings; the values."""
        import pyarrow as pa
        import pyarrow.csv as pv

        types = dict.fromkeys(names, pa.float64()) | ({label: pa.string()} if label else {})
        try:
            table = pv.read_csv(
                self.path,
                read_options=pv.ReadOptions(column_names=header, skip_rows=1),
                parse_options=pv.ParseOptions(delimiter=self.delimiter, newlines_in_values=True),
                convert_options=pv.ConvertOptions(
                    column_types=types, include_columns=[time, *types], null_values=MISSING
                ),
            )
        except pa.ArrowException as error:
            self._explain(header, [time, *names])
            raise FileFormatError(f"{self.path}: {' '.join(str(error).split())}") from None
        clock = table.column(time)
        if not len(clock):
            raise FileFormatError(f"{self.path} has a header and no rows, expected one per time")
        if clock.null_count:
            line = self.line_of(int(np.argmax(clock.is_null().to_numpy())))
            raise FileFormatError(
                f"{self.path} has no time in line {line}, column {time!r}; drop that row"
            )
        if not (pa.types.is_integer(clock.type) or pa.types.is_floating(clock.type)):
            self._explain(header, [time])
            raise FileFormatError(f"{self.path} has {clock.type} in column {time!r}, not numbers")
        values = np.empty((len(clock), len(names)))
        for c, name in enumerate(names):
            values[:, c] = table.column(name).to_numpy()
        labels = table.column(label) if label else pa.chunked_array([pa.repeat("", len(clock))])
        return clock.to_numpy(), labels, values

    def line_of(self, row: int) -> int:
        """The line in which a row of data ends, counted from 1; the header is line 1."""
        return next(line for i, (line, _) in enumerate(self._lines()) if i == row + 1)

    def _explain(self, header: list[str], numeric: list[str]) -> None:
        """Raises an error that names the line and column at fault, if one can be found."""
        for line, cells in self._lines():
            if len(cells) != len(header):
                raise FileFormatError(
                    f"{self.path} has {len(cells)} cells in line {line}, expected {len(header)}, "
                    f"one per column: {_listed(header)}"
                )
            for name, cell in zip(header, cells, strict=True):
                if line > 1 and name in numeric and cell not in MISSING and not _is_number(cell):
                    raise FileFormatError(
                        f"{self.path} has {cell!r} in line {line}, column {name!r}, expected a "
                        "number; choose the columns that are channels with channels="
                    )

    def _lines(self) -> Iterator[tuple[int, list[str]]]:
        """Line numbers and cells, header included; empty lines are skipped, as pyarrow does."""
        try:
            with self.path.open(encoding="utf-8-sig", newline="") as file:
                reader = csv.reader(file, delimiter=self.delimiter)
                for cells in reader:
                    if cells:
                        yield reader.line_num, cells
        except (UnicodeDecodeError, csv.Error) as error:
            raise FileFormatError(
                f"{self.path} can't be read as CSV ({error}); it must be text in UTF-8"
            ) from None


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return "_" not in cell  # which Python allows between digits, and nobody else


def _listed(names: Sequence[str]) -> str:
    return ", ".join(map(repr, names))
