"""Trajectories of poses as text: TUM, and EuRoC files and folders."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from offbeat.data.memory import require_memory
from offbeat.data.readers.batches import NullValueError, gather
from offbeat.data.readers.columns import Columns, recordings
from offbeat.data.readers.table import read_csv
from offbeat.data.recording import Recording, Signal
from offbeat.data.source import require_file
from offbeat.errors import FileFormatError, InputError, one_of

TUM_COLUMNS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
"""The eight numbers of a line of TUM: seconds, metres, and a scalar-last quaternion."""

_COPIES = 3  # copies of a text in memory while it is read

_TUM = Columns("timestamp", None, TUM_COLUMNS[1:], TUM_COLUMNS[1:], ("m",) * 3 + ("",) * 4)


def read_tum(path: str | Path) -> list[Recording]:
    """Reads a trajectory of poses in the format of the TUM RGB-D benchmark.

    Text without a header: per line `timestamp tx ty tz qx qy qz qw`, in seconds and metres, with
    spaces between; lines that begin with # are comments. Stamps keep every digit to the nanosecond.

    Source: https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats

    Args:
        path: the file, in UTF-8.

    Raises:
        FileFormatError: the file is missing or empty, or a line does not have eight numbers.
    """
    import io

    import pyarrow as pa
    import pyarrow.csv as pv

    path = require_file(path)
    size = path.stat().st_size
    require_memory(path, _COPIES * size, f"{size} bytes of text")
    text = path.read_bytes().removeprefix(b"\xef\xbb\xbf")
    text = text.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    text = re.sub(rb"(?m)^[ \t]*(?:#.*)?\n?", b"", text)
    text = re.sub(rb"[ \t]+", b" ", re.sub(rb"(?m)[ \t]+$", b"", text))
    if not text:
        raise FileFormatError(f"{path} has no line of numbers, expected {' '.join(TUM_COLUMNS)}")
    for clock in (pa.decimal128(38, 9), pa.float64()):
        try:
            batches = pv.read_csv(
                io.BytesIO(text),
                read_options=pv.ReadOptions(column_names=TUM_COLUMNS),
                parse_options=pv.ParseOptions(delimiter=" ", quote_char=False),
                convert_options=pv.ConvertOptions(
                    column_types=dict.fromkeys(TUM_COLUMNS, pa.float64()) | {"timestamp": clock},
                    null_values=["nan", "NaN"],
                ),
            ).to_batches()
            table = gather(batches, _TUM, text.count(b"\n") + 1)
            break
        except (pa.ArrowException, OverflowError, NullValueError):
            _explain(path)
    else:
        raise FileFormatError(f"{path} can't be read as TUM text; expected {' '.join(TUM_COLUMNS)}")
    unit = "ns" if clock != pa.float64() else "s"
    made = recordings(path, _TUM, unit, (), table, shown="s")
    kinds = ("",) * 3 + ("quaternion",) * 4
    return [replace(one, signals=(replace(one.signals[0], kinds=kinds),)) for one in made]


def is_tum(path: Path) -> bool:
    """Whether the first line of numbers of a text has eight of them, separated by spaces."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            for _ in range(1000):
                line = file.readline(2000)
                if not line:
                    return False
                if line.strip() and not line.lstrip().startswith("#"):
                    return _numbers(line) == len(TUM_COLUMNS)
    except (OSError, UnicodeDecodeError):
        return False
    return False


def read_euroc(path: str | Path, *, sensors: Sequence[str] | None = None) -> list[Recording]:
    """Reads a EuRoC MAV sequence, or one of its files.

    A file is CSV whose header starts with `#timestamp`, in nanoseconds, and has units in brackets.
    A folder holds one sensor per folder, each with its `data.csv`, here or in `mav0`; the sensors
    are merged on the union of their stamps. Those with data that are not numbers (images of a
    camera) are left out, which is noted.

    Source: Burri et al., The EuRoC micro aerial vehicle datasets, IJRR 35(10), 2016.

    Args:
        path: the file, or the folder.
        sensors: the folders to read, such as `imu0`; by default all with numeric data.

    Raises:
        FileFormatError: a file is missing, empty or damaged, or no sensor has numeric data.
        InputError: an unknown sensor is selected.
    """
    path = Path(path)
    if not path.is_dir():
        if sensors is not None:
            raise InputError(f"{path} is the file of one sensor; leave sensors out")
        [recording] = read_csv(path, time_unit="ns")
        signal = recording.signals[0]
        return [replace(recording, signals=(replace(signal, kinds=_kinds(signal.channels)),))]
    files = {file.parent.name: file for file in _data_files(path)}
    chosen = list(files) if sensors is None else [one_of("sensor", s, files) for s in sensors]
    signals: list[Signal] = []
    left: list[str] = []
    for sensor in chosen:
        require_file(files[sensor])
        if sensors is None and not _holds_numbers(files[sensor]):
            left.append(sensor)
            continue
        [recording] = read_euroc(files[sensor])
        signals.append(replace(recording.signals[0], name=sensor))
    if not signals:
        raise FileFormatError(f"{path} has no sensor whose data.csv holds numbers, got {left}")
    notes = (f"sensors without numbers are left out: {', '.join(left)}",) if left else ()
    return [Recording(tuple(signals), origin=path.name, time_unit="ns", notes=notes)]


def is_euroc(path: Path) -> bool:
    """Whether a folder holds sensors of EuRoC, or a CSV has its header."""
    if path.is_dir():
        return any(is_euroc(file) for file in _data_files(path))
    try:
        with path.open(encoding="utf-8-sig") as file:
            return file.readline(2000).startswith(("#timestamp", "# timestamp"))
    except (OSError, UnicodeDecodeError):
        return False


def _data_files(folder: Path) -> list[Path]:
    return sorted([*folder.glob("*/data.csv"), *folder.glob("mav0/*/data.csv")])


def _holds_numbers(path: Path) -> bool:
    """Whether the first row of a CSV has only numbers."""
    with path.open(encoding="utf-8-sig") as file:
        file.readline()
        row = file.readline(100_000)
    return not row or _numbers(row.replace(",", " ")) == len(row.split(","))


def _kinds(channels: Sequence[str]) -> tuple[str, ...]:
    turned = [re.fullmatch(r"q\w*_[wxyz]", channel) is not None for channel in channels]
    return tuple("quaternion" if yes and sum(turned) == 4 else "" for yes in turned)


def _numbers(line: str) -> int:
    """Number of numbers in a line; -1 if it contains anything else."""
    try:
        return len([float(word) for word in line.split()])
    except ValueError:
        return -1


def _explain(path: Path) -> None:
    """Raises an error that names the invalid line, if there is one."""
    try:
        with path.open(encoding="utf-8-sig") as file:
            for number, line in enumerate(file, 1):
                text = line.strip()
                if text and not text.startswith("#") and _numbers(text) != len(TUM_COLUMNS):
                    raise FileFormatError(
                        f"{path} has {text[:60]!r} in line {number}, expected eight numbers: "
                        f"{' '.join(TUM_COLUMNS)}"
                    )
                if text.casefold().startswith("nan"):
                    raise FileFormatError(f"{path} has no time in line {number}; drop that row")
    except UnicodeDecodeError as error:
        raise FileFormatError(
            f"{path} can't be read as text ({error}); it must be in UTF-8"
        ) from None
