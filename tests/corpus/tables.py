"""Tables as programs write them, one generator per kind, with the times and values they mean.

A kind is written in every format that can express it: CSV, Parquet, NPZ.
"""

from __future__ import annotations

import gzip
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

ROWS = 40
STEP_NS = 20_000_000
NS = 1_764_000_000_000_000_007 + STEP_NS * np.arange(ROWS)
TIMES = STEP_NS * np.arange(ROWS) / 1e9
X = np.round(np.sin(0.3 * np.arange(ROWS)), 6)
Y = np.round(10 * np.cos(0.2 * np.arange(ROWS)), 6)

Columns = Mapping[str, Sequence[Any]]


def write_csv(path: Path, columns: Columns, *, delimiter: str = ",") -> Path:
    """A header and rows; None and NaN are empty fields."""
    lines = [delimiter.join(_field(name, delimiter) for name in columns)]
    lines += [
        delimiter.join(_field(v, delimiter) for v in row)
        for row in zip(*columns.values(), strict=True)
    ]
    path = path.with_suffix(".csv")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def _field(value: Any, delimiter: str) -> str:
    text = "" if value is None or value != value else str(value)
    return f'"{text}"' if delimiter in text else text


def write_parquet(path: Path, columns: Columns) -> Path:
    """A column of its type each."""
    path = path.with_suffix(".parquet")
    pq.write_table(pa.table({name: pa.array(values) for name, values in columns.items()}), path)
    return path


def write_npz(path: Path, columns: Columns) -> Path:
    """An array each."""
    path = path.with_suffix(".npz")
    np.savez(path, **{name: np.array(values) for name, values in columns.items()})
    return path


FORMATS: dict[str, Callable[[Path, Columns], Path]] = {
    "csv": write_csv,
    "parquet": write_parquet,
    "npz": write_npz,
}


@dataclass(frozen=True)
class Kind:
    """A kind of table.

    Attributes:
        columns: by name.
        values: expected ones, by channel; the names are in the order of the data set.
        times: expected ones, s.
        options: of `read`.
        formats: that can express it.
        note: part of a note that is expected, or empty.
        units: expected ones, by channel; others are empty.
    """

    columns: Columns
    values: Mapping[str, Any]
    times: Any = field(default_factory=lambda: TIMES)
    options: Mapping[str, Any] = field(default_factory=dict)
    formats: tuple[str, ...] = ("csv", "parquet", "npz")
    note: str = ""
    units: Mapping[str, str] = field(default_factory=dict)


def texts(stamps: Any, form: str, *, fraction: bool = True) -> list[str]:
    """Nanoseconds as texts of a date and time."""
    return [_text(int(t), form, fraction=fraction) for t in stamps]


def _text(nanoseconds: int, form: str, *, fraction: bool = True) -> str:
    moment = datetime.fromtimestamp(nanoseconds // 10**9, UTC)
    return moment.strftime(form) + (f".{nanoseconds % 10**9:09d}" if fraction else "")


XY = {"x": X, "y": Y}
SEC, REST = NS // 10**9, NS % 10**9
ONES = np.arange(ROWS, dtype=float)
SLOW = NS[0] + 10**9 * np.arange(ROWS)
EITHER = NS + 226 * 86_400 * 10**9  # 8 July
WEEK = 30_240_000 - 20 + np.arange(ROWS)  # steps of 20 ms, past the end of a week
TWO = {"GyrX": np.ravel(np.column_stack([X, Y])), "AccZ": np.tile([-9.8, -10.8], ROWS)}
NIGHT = 86_400 * 10**9 - STEP_NS * 10 + STEP_NS * np.arange(ROWS)  # passes midnight
NOON = (12 * 3600 + 59 * 60 + 59) * 10**9 + STEP_NS * np.arange(20, 20 + ROWS)  # passes 1 PM


def of_day(stamps: Any) -> list[str]:
    """Nanoseconds as times of day."""
    return [_text(int(t) % (86_400 * 10**9), "%H:%M:%S")[:-3] for t in stamps]


KINDS: dict[str, Kind] = {
    "a stamp in seconds and nanoseconds": Kind({"sec": SEC, "nanosec": REST, **XY}, XY),
    "a stamp named like a time in two columns": Kind(
        {"timestamp_sec": SEC, "timestamp_nanosec": REST, **XY}, XY
    ),
    "the stamp of a header of ROS 1": Kind(
        {"header.seq": np.arange(ROWS), "header.stamp.secs": SEC, "header.stamp.nsecs": REST, **XY},
        {"header.seq": np.arange(ROWS), **XY},
        note="joined from columns 'header.stamp.secs' and 'header.stamp.nsecs'",
    ),
    "a stamp in seconds and microseconds": Kind(
        {"stamp/sec": SEC, "stamp/usec": REST // 1000, **XY}, XY
    ),
    "a stamp in two columns beside the time": Kind(
        {"rosbagTimestamp": NS + 7, "secs": SEC, "nsecs": REST, **XY},
        XY,
        note="further stamps are left out: 'secs', 'nsecs'",
    ),
    "a stamp in two columns of floats": Kind(
        {"sec": SEC.astype(float), "nanosec": REST.astype(float), **XY}, XY
    ),
    "a stamp in two columns that are named": Kind(
        {"a": SEC, "b": REST, **XY}, XY, options={"time_column": ["a", "b"]}
    ),
    "a date and a time of day": Kind(
        {
            "Date": [t[:10] for t in texts(NS, "%Y-%m-%dT")],
            "Time": [t[11:23] for t in texts(NS, "%Y-%m-%dT%H:%M:%S")],
            **XY,
        },
        XY,
    ),
    "times of day": Kind({"time": of_day(NS), **XY}, XY),
    "times of day past midnight": Kind({"time": of_day(NIGHT), **XY}, XY),
    "times of day in halves": Kind(
        {"time": [f"{_text(int(t), '%I:%M:%S')} PM" for t in NOON], **XY}, XY
    ),
    "texts of ISO 8601": Kind({"time": texts(NS, "%Y-%m-%dT%H:%M:%S"), **XY}, XY),
    "texts with slashes": Kind({"time": texts(NS, "%Y/%m/%d %H:%M:%S"), **XY}, XY),
    "texts with the day first": Kind({"time": texts(NS, "%d.%m.%Y %H:%M:%S"), **XY}, XY),
    **{
        f"dates as {form}": Kind({"time": texts(NS, form), **XY}, XY)
        for form in (
            "%m/%d/%Y %H:%M:%S",
            "%d/%m/%Y %H:%M:%S",
            "%d-%m-%Y %H:%M:%S",
            "%d %b %Y %H:%M:%S",
            "%B %d, %Y %H:%M:%S",
            "%a, %d %b %Y %H:%M:%S",
            "%Y%m%dT%H%M%S",
            "%Y%m%d_%H%M%S",
            "%Y-%m-%d_%H-%M-%S",
            "%Y-%jT%H:%M:%S",
            "%Y.%m.%d %H:%M:%S",
            "%d-%b-%Y %H:%M:%S",
        )
    },
    "dates in halves of a day": Kind(
        {"time": [f"{t} PM" for t in texts(NS, "%m/%d/%Y %I:%M:%S")], **XY}, XY
    ),
    "dates with an offset": Kind(
        {"time": [f"{t}+02:00" for t in texts(NS, "%d %b %Y %H:%M:%S")], **XY}, XY
    ),
    "dates of C": Kind(
        {"time": texts(SLOW, "%a %b %d %H:%M:%S 2025", fraction=False), **XY}, XY, times=ONES
    ),
    "a date of the month first beside its time": Kind(
        {
            "Date": texts(SLOW, "%m/%d/%Y", fraction=False),
            "Time": texts(SLOW, "%I:%M:%S PM", fraction=False),
            **XY,
        },
        XY,
        times=ONES,
        note="joined from columns 'Date' and 'Time'",
    ),
    "dates whose day and month may be swapped": Kind(
        {"time": texts(EITHER, "%d/%m/%Y %H:%M:%S"), **XY}, XY, options={"day_first": True}
    ),
    "milliseconds behind a colon": Kind(
        {"time": [f"2025-11-24 16:00:{i // 50:02d}:{i % 50 * 20:03d}" for i in range(ROWS)], **XY},
        XY,
    ),
    "minutes and seconds that pass the hour": Kind(
        {"time": [f"{(59 + i // 20) % 60:02d}:{3 * (i % 20):02d}.0" for i in range(ROWS)], **XY},
        XY,
        times=3 * ONES,
    ),
    "a week of GPS and seconds": Kind(
        {"week": 2400 + (WEEK >= 30_240_000), "tow": WEEK % 30_240_000 / 50, **XY},
        XY,
        note="joined from columns 'week' and 'tow'",
    ),
    "a week of GPS and milliseconds": Kind(
        {"GWk": 2400 + (WEEK >= 30_240_000), "GMS": WEEK % 30_240_000 * 20, **XY}, XY
    ),
    "milliseconds of a week of u-blox": Kind(
        {"iTOW": 345_600_000 + 1000 * np.arange(ROWS), **XY}, XY, times=ONES
    ),
    "a name that ends like one of times": Kind(
        {"sim_time_s": TIMES, **XY}, XY, note="it alone is named like one, and increases"
    ),
    "a unit behind a comma": Kind({"time, ms": 20 * np.arange(ROWS), **XY}, XY),
    "numbers as texts": Kind(
        {"time": [f"{t:.2f}" for t in TIMES], "x": [str(x) for x in X], "y": Y},
        XY,
        formats=("csv", "parquet"),
    ),
    "a column per time": Kind(
        {"time": TIMES, "q": [X, Y]}, {"q.0": X, "q.1": Y}, formats=("npz",), note="are turned: 'q'"
    ),
    "a matrix per time": Kind(
        {"time": TIMES, "R": np.stack([X, Y, Y, X], axis=1).reshape(ROWS, 2, 2)},
        {"R.0.0": X, "R.0.1": Y, "R.1.0": Y, "R.1.1": X},
        formats=("npz",),
    ),
    "fields of records": Kind(
        {"log": np.rec.fromarrays([TIMES, X], names=["time", "x"]), "y": Y},
        {"log.x": X, "y": Y},
        formats=("npz",),
    ),
    "milliseconds in brackets without a blank": Kind(
        {"time(ms)": 20 * np.arange(ROWS), "angle(deg)": X, "x[0]": Y},
        {"angle": X, "x[0]": Y},
        units={"angle": "deg"},
    ),
    "minutes": Kind({"time_min": TIMES / 60, **XY}, XY),
    "hours": Kind({"Time (h)": TIMES / 3600, **XY}, XY),
    "days": Kind({"time [d]": TIMES / 86_400, **XY}, XY),
    "microseconds of ArduPilot": Kind({"TimeUS": (NS - NS[0]) // 1000, **XY}, XY),
    "a wrong unit in the header": Kind(
        {"time_ms": TIMES, **XY}, XY, options={"time_unit": "s"}, note="not as 'time_ms' does"
    ),
    "whole numbers without a unit": Kind(
        {"time": 10 * np.arange(ROWS), **XY},
        XY,
        times=10.0 * np.arange(ROWS),
        note="taken to be in s, a row every 10 s",
    ),
    "the clock of rostopic": Kind({"%time": NS, **XY}, XY),
    "the clock of PlotJuggler": Kind({"__time": NS / 1e9, **XY}, XY, times=None),
    "no times": Kind(
        {**XY}, XY, options={"rate_hz": 50}, note="row number / 50 Hz, as rate_hz says"
    ),
    "a column of text": Kind({"time": TIMES, "mode": ["AUTO"] * ROWS, **XY}, XY, note="'mode'"),
    "a column of text that is left out": Kind(
        {"time": TIMES, "mode": ["AUTO"] * ROWS, **XY},
        {"y": Y},
        options={"without": ["mode", "x"]},
    ),
    "instances of a sensor": Kind(
        {"timestamp": np.repeat(TIMES, 2), "I": np.tile([0, 1], ROWS), **TWO},
        {"GyrX[0]": X, "AccZ[0]": [-9.8] * ROWS, "GyrX[1]": Y, "AccZ[1]": [-10.8] * ROWS},
        note="rows are of the sensor in column 'I'",
    ),
    "sensors that take turns": Kind(
        {"time": np.repeat(TIMES, 2), "sensor": ["left", "right"] * ROWS, **TWO},
        {"left.GyrX": X, "left.AccZ": [-9.8] * ROWS, "right.GyrX": Y, "right.AccZ": [-10.8] * ROWS},
    ),
    "sensors in a column that is named": Kind(
        {"time": np.repeat(TIMES, 2), "unit": np.tile([3, 7], ROWS), **TWO},
        {"GyrX[3]": X, "AccZ[3]": [-9.8] * ROWS, "GyrX[7]": Y, "AccZ[7]": [-10.8] * ROWS},
        options={"instance_column": "unit"},
    ),
    "a column of modes": Kind(
        {"time": TIMES, "name": ["idle"] * 20 + ["run"] * 20, **XY}, XY, note="'name'"
    ),
    "a date with its time of day": Kind({"Date": texts(NS, "%Y-%m-%d %H:%M:%S"), **XY}, XY),
    "an empty stamp beside the time": Kind(
        {"rosbagTimestamp": NS, "stamp": [None] * ROWS, **XY},
        {"stamp": [np.nan] * ROWS, **XY},
        formats=("csv", "parquet"),
    ),
    "motors that take turns": Kind(
        {"time": np.repeat(TIMES, 2), "motor_id": np.tile([3, 4], ROWS), **TWO},
        {"GyrX[3]": X, "AccZ[3]": [-9.8] * ROWS, "GyrX[4]": Y, "AccZ[4]": [-10.8] * ROWS},
        note="rows are of the sensor in column 'motor_id'",
    ),
    "boards that take turns": Kind(
        {"time": np.repeat(TIMES, 2), "board": np.tile([0, 1], ROWS), "q": TWO["GyrX"]},
        {"q[0]": X, "q[1]": Y},
        note="rows are of the sensor in column 'board'",
    ),
    "numbers of channels": Kind(
        {"time": np.repeat(TIMES, 2), "channel": np.tile([1, 2], ROWS), "value": TWO["GyrX"]},
        {"1": X, "2": Y},
    ),
    "a long form of InfluxDB": Kind(
        {"_time": np.repeat(TIMES, 2), "_field": ["a", "b"] * ROWS, "_value": TWO["GyrX"]},
        {"a": X, "b": Y},
    ),
    "the answer to a query of InfluxDB": Kind(
        {
            "result": ["_result"] * 2 * ROWS,
            "table": np.repeat([0, 1], ROWS),
            "_time": np.tile(TIMES, 2),
            "_value": np.concatenate([X, Y]),
            "_field": np.repeat(["a", "b"], ROWS),
            "_measurement": ["imu"] * 2 * ROWS,
        },
        {"a": X, "b": Y},
    ),
    "texts that take turns without a common stamp": Kind(
        {"time": TIMES, "mac": ["a1", "b2"] * (ROWS // 2), **XY},
        XY,
        note="instance_column=mac gives every sensor its own channels",
    ),
    "a counter of microseconds after half an hour": Kind(
        {"timestamp": 1_900_000_000 + STEP_NS // 1000 * np.arange(ROWS), **XY},
        XY,
        note="taken to be in us",
    ),
    "milliseconds with a fraction": Kind(
        {"time": 8.125 * np.arange(ROWS), **XY},
        XY,
        times=8.125 * np.arange(ROWS),
        note="names no unit; if they count ms (123.1 Hz)",
    ),
    "Julian days": Kind(
        {"time": 2_461_004.5 + np.arange(ROWS) / 2**18, **XY},
        XY,
        times=np.arange(ROWS) * 86_400 / 2**18,
        note="days since 4713 BC",
    ),
    "a header of milliseconds over seconds": Kind(
        {"time_ms": TIMES / 2, **XY},
        XY,
        times=TIMES / 2000,
        note="a row every 1e-05 s; if they are not",
    ),
    "millis of a board": Kind({"millis": 20 * np.arange(ROWS), **XY}, XY),
    "milliseconds since 1970": Kind({"unix_ms": NS // 10**6, **XY}, XY),
    "a counter of microseconds of 32 bits that wraps": Kind(
        {"time_us": (2**32 - 300_000 + STEP_NS // 1000 * np.arange(ROWS)) % 2**32, **XY},
        XY,
        note="a counter of 32 bits that wraps once",
    ),
    "a counter of milliseconds of 16 bits that wraps": Kind(
        {"time_ms": (2**16 - 150 + 20 * np.arange(ROWS)) % 2**16, **XY},
        XY,
        note="a counter of 16 bits that wraps once",
    ),
    "a signed counter that wraps": Kind(
        {"time_us": (2**32 - 300_000 + STEP_NS // 1000 * np.arange(ROWS)) % 2**32 - 2**31, **XY},
        XY,
        note="a counter of 32 bits that wraps once",
    ),
    "rows in descending time": Kind(
        {"time": TIMES[::-1], "x": X[::-1]}, {"x": X}, note="39 of 40 rows are out of order"
    ),
    "channels called signal and value": Kind(
        {"time": TIMES, "signal": X, "value": Y}, {"signal": X, "value": Y}
    ),
    "a number that stands for a missing value": Kind(
        {"time": TIMES, "x": np.where(np.arange(ROWS) == 5, -999, X), "y": Y},
        {"x": np.where(np.arange(ROWS) == 5, np.nan, X), "y": Y},
        options={"missing": [-999]},
    ),
    "a text that stands for a missing value": Kind(
        {"time": TIMES, "x": [*X[:5].tolist(), "lost", *X[6:].tolist()], "y": Y},
        {"x": np.where(np.arange(ROWS) == 5, np.nan, X), "y": Y},
        options={"missing": ["lost"]},
        formats=("csv",),
    ),
    "an angle in degrees without a unit": Kind(
        {"time": TIMES, "yaw": 27 * np.arange(ROWS) % 360},
        {"yaw": 27 * np.arange(ROWS)},
        options={"angles": ["yaw"]},
        note="taken to be in deg: yaw",
        units={"yaw": "deg"},
    ),
    "a unit that is stated": Kind(
        {"time": TIMES, **XY}, XY, options={"units": {"x": "m"}}, units={"x": "m"}
    ),
}
BODY = "".join(f"{t:.2f},{x},{y}\n" for t, x, y in zip(TIMES, X, Y, strict=True))
"""Rows of CSV."""

TEXTS: dict[str, tuple[str | bytes, dict[str, Any], str]] = {
    "lines above the header": (
        "#Bench Recorder\n#Date Time: 2025-11-24 13:10:34\n\nTime (s),x,y\n" + BODY, {}, "",
    ),
    "text above the header": (
        "Bench Recorder\nRate,100\n\ntime,x,y\n" + BODY, {}, "the header is line 4",
    ),
    "a line of units": ("time,x,y\ns,m,deg\n" + BODY, {}, "line 2 is taken for the units"),
    "a line of units and one of types": (
        "time,x,y\ns,m,deg\nfloat,float,float\n" + BODY,
        {},
        "line 2 is taken for the units",
    ),
    "numbers above the header": (
        "Model,TDS\nRecord Length,1000\nSample Interval,0.02\n\nTIME,x,y\n" + BODY,
        {},
        "the header is line 5",
    ),
    "a group above the header": ("imu,imu,imu\ntime,x,y\n" + BODY, {}, "the header is line 2"),
    "a header in a comment": ("# time,x,y\n" + BODY, {}, ""),
    "a header behind %": ("%time,x,y\n" + BODY, {}, ""),
    "comments between rows": (
        "time,x,y\n" + BODY[:200] + BODY[200:].replace("\n", "\n# lost, two\n// or one\n", 1),
        {}, "",
    ),
    "a line that names the separator": ("sep=;\ntime;x;y\n" + BODY.replace(",", ";"), {}, ""),
    "bars": ("time|x|y\n" + BODY.replace(",", "|"), {}, ""),
    "blanks": ("  time   x  y\n" + BODY.replace(",", "   "), {}, ""),
    "blanks and comments": ("# time x y\n" + BODY.replace(",", " "), {}, ""),
    "decimal commas": (
        "time;x;y\n" + BODY.replace(",", ";").replace(".", ","), {}, "commas in numbers",
    ),
    "no header": (BODY, {"column_names": ["time", "x", "y"]}, ""),
    "rows that count from an unnamed column": (
        ",time,x,y\n" + "".join(f"{i},{row}\n" for i, row in enumerate(BODY.split())), {},
        "has no name and counts the rows",
    ),
    "an unnamed column of times": (",x,y\n" + BODY, {}, "is taken for the time"),
    "delimiters at the end of rows": ("time,x,y\n" + BODY.replace("\n", ",\n"), {}, ""),
    "several forms of line ends": (
        "time,x,y\n" + BODY.replace("\n", "\r\n", 9).replace("\n", "\n\r\n", 3)[:-1] + "\r", {}, "",
    ),
    "line ends of old and of new systems": (
        "time,x,y\r" + BODY.replace("\n", "\r", 20), {}, "",
    ),
    "rows of empty fields": (
        "time,x,y\n" + BODY.replace("\n", "\n,,\n", 5) + ",,\n  \n , ,\n", {}, "",
    ),
    "files with marks that are joined": (
        ("time,x,y\n" + BODY[: len(BODY) // 2]).rpartition("\n")[0] + "\n\ufefftime,x,y\n"
        + BODY[BODY.rindex("\n", 0, len(BODY) // 2) + 1 :], {}, "the header stands again",
    ),
    "bytes of 0 at the end": (("time,x,y\n" + BODY + "\0" * 999).encode(), {}, "bytes of 0 from"),
    "Windows-1252 after the first block": (
        ("# " + "-" * 70_000 + "\ntime,x,y\n" + BODY + "# 20 \xb0C\n").encode("cp1252"), {},
        "read as Windows-1252",
    ),
    "a last number without a line end": (
        "time,x,y\n" + BODY[:-2].rpartition("\n")[0] + f"\n0.78,{X[-1]},{Y[-1]}", {}, "",
    ),
    "plus signs": ("time,x,y\n" + BODY.replace(",0.", ",+0."), {}, ""),
    "numbers with their units": (
        "time,x,y\n" + "".join(
            f"{20 * i} ms,{x} m,{y} deg\n" for i, (x, y) in enumerate(zip(X, Y, strict=True))
        ), {}, "numbers have a unit in each field: 'time [ms]', 'x [m]', 'y [deg]'",
    ),
    "numbers with their units and decimal commas": (
        "time;x;y\n" + "".join(
            f"{t:.2f}s;{x}m;{y}deg\n" for t, x, y in zip(TIMES, X, Y, strict=True)
        ).replace(".", ","), {}, "numbers have a unit in each field",
    ),
    "UTF-16 without a mark": (("time,x,y\n" + BODY).encode("utf-16-le"), {}, "without a mark"),
    "UTF-16": (("time,x,y\n" + BODY).encode("utf-16"), {}, ""),
    "Windows-1252": ("time,x,y,d\xe9j\xe0\n".encode("cp1252")
                     + BODY.replace("\n", ",1\n").encode(), {"without": ["d\xe9j\xe0"]},
                     "read as Windows-1252"),
    "gzip": (gzip.compress(("time,x,y\n" + BODY).encode()), {}, ""),
    "a cut in the last row": (
        "time,x,y\n" + BODY + "0.80,0.5", {}, "ends in the middle of line 42",
    ),
}  # fmt: skip
"""Forms of one table as text: what is written, options, and a note that is expected."""

ROWS_OF_TEXT = BODY.split()
TEXTS |= {
    "a table of LabVIEW": (
        "LabVIEW Measurement\nSeparator,Comma\nDate,2025/11/24\nTime,13:10:34.02\n"
        "***End_of_Header***,,\nChannels,2,\nSamples,40,40\nX0,0.0,0.0\nDelta_X,0.02,0.02\n"
        "***End_of_Header***,,\nX_Value,x,y\n" + BODY, {}, "",
    ),
    "columns without a name or a field": (
        ",time,x,y\n" + "".join(f",{row}\n" for row in ROWS_OF_TEXT), {},
        "has no name and no field",
    ),
    "durations of pandas": (
        ",x,y\n" + "".join(
            f"-1 days +23:59:59.{i * 20:03d}000,{row.partition(',')[2]}\n"
            for i, row in enumerate(ROWS_OF_TEXT)
        ), {}, "is taken for the time",
    ),
    "dates of MATLAB": (
        "time,x,y\n" + "".join(
            f"24-Nov-2025 23:59:59.{i * 20:03d},{row.partition(',')[2]}\n"
            for i, row in enumerate(ROWS_OF_TEXT)
        ), {}, "",
    ),
    "exponents of Fortran": (
        "time,x,y\n" + "".join(
            f"{t:.2f},{f'{x:.6E}'.replace('E', 'D')},{f'{y:.6E}'.replace('E', 'd')}\n"
            for t, x, y in zip(TIMES, X, Y, strict=True)
        ), {}, "",
    ),
}  # fmt: skip

GROUPS: dict[str, tuple[str, dict[str, Any], tuple[str, ...], tuple[str, ...]]] = {
    "Motive": (
        "Format Version,1.23,Length Units,Meters\n\n,Type,Rigid Body,Rigid Body\n,Name,Foot,Hip\n"
        ",ID,1,2\n,,Position,Position\nFrame,Time (Seconds),X,X\n"
        + "".join(f"{i},{t:.2f},{x},{y}\n" for i, (t, x, y) in enumerate(
            zip(TIMES, X, Y, strict=True))),
        {}, ("Frame", "Foot.X", "Hip.X"), ("", "", ""),
    ),
    "Vicon": (
        "Trajectories\n50\n,,Robot:toe,,Robot:heel,\nFrame,Sub Frame,X,Y,X,Y\n,,mm,mm,mm,mm\n"
        + "".join(f"{i},0,{x},{y},{y},{x}\n" for i, (x, y) in enumerate(zip(X, Y, strict=True))),
        {"rate_hz": 50},
        ("Frame", "Sub Frame", "Robot:toe.X", "Robot:toe.Y", "Robot:heel.X", "Robot:heel.Y"),
        ("", "", "mm", "mm", "mm", "mm"),
    ),
    "a MultiIndex of pandas": (
        ",imu,imu,gps\n,x,y,x\ntime,,,\n"
        + "".join(f"{t:.2f},{x},{y},1\n" for t, x, y in zip(TIMES, X, Y, strict=True)),
        {}, ("imu.x", "imu.y", "gps.x"), ("", "", ""),
    ),
}  # fmt: skip
"""Texts whose header stands in several lines: content, options, names and units."""

MISSING_TEXTS = (
    *("", "-", "--", "?", "nan", "NaN", "-nan", "NA", "N/A", "null", "None", "NaN(ind)"),
    *("-nan(ind)", "1.#IND", "-1.#IND", "1.#QNAN", "#N/A", "#DIV/0!"),
)

REFUSED: dict[str, tuple[Columns, dict[str, Any], str]] = {
    "float32 epochs": (
        {"time": np.float32(NS / 1e9).astype(float), **XY}, {}, "rows have the time stamp of",
    ),
    "a stamp of a spreadsheet": ({"time": [1.764e18] * ROWS, **XY}, {}, "of another row"),
    "stamps of 0": ({"time": np.zeros(ROWS), **XY}, {}, "of another row and other values"),
    "dates of either order": (
        {"Date": ["11/12/2025"] * ROWS, "Time": of_day(NS), **XY},
        {},
        "dates such as '11/12/2025' may begin with the day or the month; .*day_first=true",
    ),
    "several stamps": (
        {"imu/stamp/sec": SEC, "imu/stamp/nanosec": REST, "odom/stamp/sec": SEC,
         "odom/stamp/nanosec": REST, "x": X}, {}, "has several stamps, each in two columns",
    ),
    "hours, minutes and seconds": (
        {"hours": [13] * ROWS, "minutes": [59] * ROWS, "seconds": TIMES, "x": X}, {},
        "has the time in several columns",
    ),
    "digits of a date": (
        {"time": 20251124131000 + np.arange(ROWS), "x": X}, {}, "whose digits are those of a date",
    ),
    "digits of hours, minutes and seconds": (
        {"time": 131040.0 + np.arange(ROWS) + 40 * (np.arange(ROWS) >= 20), "x": X}, {},
        "such as 131040 in 'time', whose digits",
    ),
    "rows counted in each second": (
        {"time": np.arange(ROWS) // 10, "index": np.arange(ROWS) % 10, "x": X}, {},
        "rows have the time stamp of",
    ),
    "an angle in counts": (
        {"time": TIMES, "joint": 300 * np.arange(ROWS) % 4096},
        {"angles": ["joint"], "units": {"joint": "count"}},
        "is in 'count', expected rad or deg",
    ),
    "an angle of rad or deg": (
        {"time": TIMES, "yaw": np.linspace(0, 50, ROWS)}, {"angles": ["yaw"]},
        "may be rad or deg; state it with units=",
    ),
}  # fmt: skip
"""Tables that can't be read without a choice, with the line that asks for it."""
