"""Readers of file formats, chosen by a file's suffix and content.

A new format is a function `(path, *, options) -> Iterable[Recording]` and one call of
`register_reader`, or an entry point of the group `offbeat.readers`, whose name is the format's.
"""

from __future__ import annotations

import inspect
import logging
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

from offbeat.data import store
from offbeat.data.readers import (
    ardupilot,
    hdf5,
    json_lines,
    lerobot,
    mat,
    npz,
    parquet,
    pose,
    ros,
    ros_echo,
    table,
    text,
    ulog,
)
from offbeat.data.readers.folders import FILES, check_paths, files_in, together
from offbeat.data.readers.options import check_types
from offbeat.data.recording import ReaderOptions, Recording, assemble
from offbeat.data.shards import ShardedDataset
from offbeat.data.source import require_source
from offbeat.data.trajectory import Dataset
from offbeat.errors import (
    FileFormatError,
    InputError,
    NoLogError,
    OffbeatError,
    listed,
    one_of,
    printable,
)
from offbeat.registry import Registry

PACKED = {
    ".gz": "gunzip",
    ".bz2": "bunzip2",
    ".xz": "unxz",
    ".zst": "zstd -d",
    ".zstd": "zstd -d",
    ".lz4": "unlz4",
    ".zip": "unzip",
    ".7z": "7z x",
    ".tar": "tar xf",
    ".tgz": "tar xf",
}
"""Suffixes of compressed files and archives, each with the command that unpacks it."""

CONVERTED = {
    ".bin": "not read; a log of ArduPilot is written as text with: mavlogdump.py LOG.bin > LOG.log",
    ".tlog": "not read; write it as CSV with: mavlogdump.py --format csv --types ATTITUDE LOG.tlog",
    ".xlsx": "a workbook of Excel; save its sheet as CSV",
    ".xls": "a workbook of Excel; save its sheet as CSV",
    ".ods": "a workbook; save its sheet as CSV",
    ".mf4": "an MDF file; write it as Parquet with: MDF(path).to_dataframe().to_parquet(out)",
    ".tdms": "a TDMS file; write it as Parquet with npTDMS: TdmsFile.read(path).as_dataframe()",
    ".orc": "an ORC file; write it as Parquet",
    ".avro": "an Avro file; write it as Parquet",
    ".tfrecord": "a TFRecord file; write its numbers as NPZ or Parquet",
    ".zarr": "a Zarr store; write its arrays as NPZ",
}
"""What is not read, by suffix, and how to convert it."""

_OF_TEXT = ("ardupilot", "ros_echo", "json", "csv")
"""Formats whose files may be compressed."""

FOLDER = "/"
"""The suffix for readers of folders, which must have `recognises`."""

OPTIONS = tuple(field.name for field in fields(ReaderOptions))
"""Options of every format whose reader returns recordings."""


@dataclass(frozen=True)
class Reader:
    """A file format that can be read.

    Args:
        name: of the format.
        suffixes: file name suffixes, in lower case, each with its dot; `FOLDER` for folders.
        function: reads a file; its positional argument is the path, its keyword arguments
            are the options of the format. It returns recordings, which are cleaned by
            `ReaderOptions`, or a finished data set. It calls `require_file` on each file that it
            opens (`read` does so for the file itself).
        recognises: inspects a file (or a folder, if `FOLDER` is among the suffixes) and returns
            whether it has this format, for formats with a common suffix; it never raises. None
            if the suffix is enough; such a reader gets files that no other one recognises.
        cleaning: whether `function` returns recordings.

    Raises:
        InputError: a suffix is not lower case with a dot, or a reader of folders has no
            `recognises`.
    """

    name: str
    suffixes: tuple[str, ...]
    function: Callable[..., Iterable[Recording] | Dataset]
    recognises: Callable[[Path], bool] | None = None
    cleaning: bool = True

    def __post_init__(self) -> None:
        for suffix in self.suffixes:
            if suffix != FOLDER and (suffix != suffix.lower() or not suffix.startswith(".")):
                raise InputError(
                    f"suffixes of reader {self.name!r} must be lower case with a dot, such as "
                    f"'.csv', or {FOLDER!r} for folders, got {suffix!r}"
                )
        if FOLDER in self.suffixes and self.recognises is None:
            raise InputError(f"reader {self.name!r} reads folders, so it needs recognises")

    @property
    def own_options(self) -> list[str]:
        """Names of the options of the format itself."""
        parameters = inspect.signature(self.function).parameters.values()
        return [p.name for p in parameters if p.kind is inspect.Parameter.KEYWORD_ONLY]

    @property
    def options(self) -> list[str]:
        """Names of all options: those of the format, and `ReaderOptions` where they apply."""
        return list(dict.fromkeys([*self.own_options, *(OPTIONS if self.cleaning else ())]))


READERS: Registry[Reader] = Registry("format", group="offbeat.readers")
"""The formats that can be read."""


def register_reader(
    name: str,
    function: Callable[..., Iterable[Recording] | Dataset],
    *,
    suffixes: Iterable[str],
    recognises: Callable[[Path], bool] | None = None,
    cleaning: bool = True,
    replace: bool = False,
) -> Reader:
    """Registers a format for `read`.

    Args:
        name: of the format.
        function: as of `Reader`.
        suffixes: as of `Reader`.
        recognises: as of `Reader`.
        cleaning: as of `Reader`.
        replace: allow a name that is taken.

    Raises:
        InputError: the name is taken, or as of `Reader`.
    """
    reader = Reader(name, tuple(suffixes), function, recognises, cleaning)
    return READERS.register(name, reader, replace=replace)


def read(
    path: str | Path | Sequence[str | Path],
    *,
    format: str | None = None,
    files: Literal["auto", "episodes", "merge"] = "auto",
    **options: Any,
) -> Dataset:
    """Reads a data set from a file, or a folder of files, of any known format.

    Args:
        path: the file or folder; or several files of one format, as a list or in a folder.
        format: name of the reader; by default found by the file's suffix and content.
        files: of several files, each holds one or several `episodes`; or a sensor of one recording,
            and they are merged (`merge`) by their times. `auto` merges files no two of which have a
            channel in common, and files with names of their own that were logged at the same time.
            A table in a folder without rows, or without times, is left out, which is noted.
        **options: options of the format, such as `time_unit` of CSV, and the fields of
            `ReaderOptions`, for every format but Offbeat's own.

    Returns:
        The data set. Its `meta["cleaning"]` records what was found and changed, `meta["source"]`
        its source. Assumptions of a reader, such as a detected unit of time, are in
        `meta["cleaning"]["notes"]`, and is logged as a warning of the logger `offbeat`.

    Raises:
        FileFormatError: the file is missing, of an unknown format, or invalid.
        InputError: the format or an option is unknown.
    """
    one_of("files", files, FILES)
    if not isinstance(path, str | Path):
        stated = [require_source(one) for one in check_paths(path)]
        return _read_several(stated, stated[0].parent, format, files, options)
    path = require_source(path)
    if path.is_dir():
        inside = files_of(path, format)
        if inside:
            return _read_several(inside, path, format, files, options, stated=False)
    reader = reader_of(path) if format is None else READERS[format]
    own, cleaning = _split(options, reader)
    made = _made(reader, path, own)
    if isinstance(made, Dataset):
        if cleaning:
            raise InputError(
                f"the {reader.name} reader gives a finished data set, which is not cleaned again, "
                f"got the options {', '.join(cleaning)}"
            )
        return made
    return _assembled(made, path, reader, cleaning)


def _read_several(
    paths: list[Path],
    folder: Path,
    format: str | None,
    files: str,
    options: dict[str, Any],
    *,
    stated: bool = True,
) -> Dataset:
    """Several files as one data set; all of them, if they were stated."""
    readers = {path: reader_of(path) if format is None else READERS[format] for path in paths}
    names = sorted({reader.name for reader in readers.values()})
    if len(names) > 1:
        raise FileFormatError(
            f"{folder} holds files of several formats, {', '.join(names)}; name one with format="
        )
    reader = readers[paths[0]]
    own, cleaning = _split(options, reader)
    if reader.function is READERS["offbeat"].function:  # each file is finished
        return ShardedDataset.of_files(paths).whole()
    read_files: list[tuple[Path, list[Recording]]] = []
    refused: list[NoLogError] = []
    for path in paths:
        try:
            made = _made(reader, path, own)
        except NoLogError as error:
            if stated:
                raise
            refused.append(error)
            continue
        if isinstance(made, Dataset):
            raise FileFormatError(
                f"{path} is a finished data set, which is read alone; load each, and make one "
                "Dataset of their trajectories"
            )
        read_files.append((path, made))
    if not read_files:
        raise refused[0]
    recordings = together(read_files, files, folder.name)
    if refused:
        read_paths = {path for path, _ in read_files}
        left = listed([path.name for path in paths if path not in read_paths], 6)
        note = f"files without rows or times are left out: {left}"
        recordings[0] = replace(recordings[0], notes=(*recordings[0].notes, note))
    return _assembled(recordings, folder, reader, cleaning)


def files_of(folder: Path, format: str | None) -> list[Path]:
    """The files in a folder that no reader knows as a whole; empty if one does.

    Args:
        folder: the folder.
        format: name of the reader; by default any.
    """
    of_folders = [reader for reader in READERS.values() if FOLDER in reader.suffixes]
    if format is not None:
        reader = READERS[format]
        suffixes = set(reader.suffixes) - {FOLDER}
        whole = reader in of_folders and reader.recognises and reader.recognises(folder)
        return [] if whole else files_in(folder, suffixes)
    if any(reader.recognises and reader.recognises(folder) for reader in of_folders):
        return []
    suffixes = {suffix for reader in READERS.values() for suffix in reader.suffixes} - {FOLDER}
    return [path for path in files_in(folder, suffixes) if _may_be_data(path)]


def _may_be_data(path: Path) -> bool:
    """Whether a reader takes a file by its suffix alone, or recognises it; metadata it does not."""
    fitting = [r for r in READERS.values() if path.suffix.lower() in r.suffixes]
    return not fitting or any(r.recognises is None or r.recognises(path) for r in fitting)


def _split(options: dict[str, Any], reader: Reader) -> tuple[dict[str, Any], dict[str, Any]]:
    """The options of a format, and those of the cleaning.

    Raises:
        InputError: an option is unknown.
    """
    options = _renamed(options, reader)
    for option in options:
        if not reader.options:
            raise InputError(f"the {reader.name} reader takes no options, got {option!r}")
        one_of(f"option of the {reader.name} reader", option, reader.options, whole=True)
    own = {name: options[name] for name in reader.own_options if name in options}
    check_types(own, reader.function, f" of the {reader.name} reader")
    if reader.cleaning:
        rest = {name: value for name, value in options.items() if name not in own}
        check_types(rest, ReaderOptions, "")
    # Columns are left out by name, and texts of missing values are replaced, before the cleaning.
    if "missing" in own:
        options["missing"] = [m for m in _several(own["missing"]) if _is_number(m)]
        own["missing"] = [m for m in _several(own["missing"]) if not _is_number(m)]
    return own, {n: v for n, v in options.items() if n not in own or n in ("without", "missing")}


def _assembled(
    made: list[Recording], path: Path, reader: Reader, options: dict[str, Any]
) -> Dataset:
    dataset = assemble(_handed_over(made), ReaderOptions(**options))
    for note in dataset.meta["cleaning"]["notes"]:
        logging.getLogger("offbeat").warning("%s: %s", printable(str(path)), printable(note))
    return replace(dataset, meta={"source": path.name, "format": reader.name, **dataset.meta})


def _made(reader: Reader, path: Path, own: dict[str, Any]) -> list[Recording] | Dataset:
    """What a reader gives; the errors of libraries about a damaged file in one line."""
    try:
        made = reader.function(path, **own)
        return made if isinstance(made, Dataset) else list(made)
    except OffbeatError:
        raise
    except Exception as error:
        what = " ".join(str(error).split())[:120]
        raise FileFormatError(
            f"{path} can't be read as {reader.name}, it is truncated, damaged or of another format "
            f"({type(error).__name__}: {what}); copy it again"
        ) from error


def _handed_over(made: list[Recording]) -> Iterable[Recording]:
    """Yields recordings and keeps none, so that each is freed once it is merged."""
    made.reverse()
    while made:
        yield made.pop()


def _several(given: Any) -> list[Any]:
    if isinstance(given, str | int | float):
        return [given]
    if isinstance(given, Iterable):
        return list(given)
    raise InputError(f"missing must be numbers or texts, got {given!r}")


def _is_number(given: Any) -> bool:
    try:
        return not isinstance(given, bool) and math.isfinite(float(given))
    except (OverflowError, TypeError, ValueError):
        return False


def _renamed(options: dict[str, Any], reader: Reader) -> dict[str, Any]:
    """Options saved by runs of Offbeat 0.1.0, with the names of this version."""
    options = dict(options)
    if "held" in options and "repeated" in reader.options:
        options.setdefault("repeated", options["held"])
        del options["held"]
    if isinstance(options.get("actions"), bool) and "include_actions" in reader.options:
        options["include_actions"] = options.pop("actions")
    return options


def reader_of(path: Path) -> Reader:
    """The reader of a file or folder that exists, by its suffix and content.

    Of a folder of files that are read together, it is the reader of these files.

    Raises:
        FileFormatError: no reader supports it.
    """
    suffix = FOLDER if path.is_dir() else path.suffix.lower()
    if suffix in PACKED:
        inner = Path(path.stem).suffix.lower()
        texts = [READERS[name] for name in _OF_TEXT]
        fitting = [reader for reader in texts if inner in reader.suffixes]
        if suffix in text.COMPRESSED and fitting:
            met = (reader for reader in fitting if reader.recognises and reader.recognises(path))
            return next(met, fitting[-1])
        raise FileFormatError(
            f"{path} is compressed or an archive, which is read of text alone ("
            f"{', '.join(f'.csv{s}' for s in text.COMPRESSED)}); unpack it with: {PACKED[suffix]}"
        )
    fitting = [reader for reader in READERS.values() if suffix in reader.suffixes]
    for reader in fitting:
        if reader.recognises is not None and reader.recognises(path):
            return reader
    if suffix == FOLDER:
        inside = files_of(path, None)
        if inside:
            return reader_of(inside[0])
        known = ", ".join(reader.name for reader in fitting) or "none"
        raise FileFormatError(
            f"{path} is a folder of no known format, expected one of: {known}; name the file "
            "inside it, or its format with format="
        )
    if suffix in CONVERTED:
        raise FileFormatError(f"{path} is {CONVERTED[suffix]}")
    if not fitting:
        taken = {s: None for reader in READERS.values() for s in reader.suffixes if s != FOLDER}
        raise FileFormatError(
            f"{path} has the unknown suffix {suffix!r}, expected one of: {' '.join(taken)}; rename "
            "it, or name its format with format="
        )
    # No reader recognises it: one that needs only the suffix gives the best message.
    return next((reader for reader in fitting if reader.recognises is None), fitting[0])


register_reader(
    "offbeat",
    store.load,
    suffixes=(".parquet",),
    recognises=store.holds_data_set,
    cleaning=False,
)
register_reader("parquet", parquet.read_parquet, suffixes=(".parquet", ".pq"))
register_reader("euroc", pose.read_euroc, suffixes=(".csv", FOLDER), recognises=pose.is_euroc)
register_reader("tum", pose.read_tum, suffixes=(".tum", ".txt"), recognises=pose.is_tum)
register_reader(
    "ardupilot",
    ardupilot.recordings,
    suffixes=(".log", ".txt", ".csv"),
    recognises=ardupilot.recognises,
)
register_reader(
    "ros_echo", ros_echo.read_ros_echo, suffixes=ros_echo.SUFFIXES, recognises=ros_echo.recognises
)
register_reader("csv", table.read_csv, suffixes=(".csv", ".tsv", ".txt"))
register_reader("npz", npz.read_npz, suffixes=(".npz", ".npy"))
register_reader("mat", mat.read_mat, suffixes=(".mat",), recognises=mat.recognises)
register_reader("feather", parquet.read_feather, suffixes=(".feather", ".arrow", ".ipc", ".arrows"))
register_reader(
    "lerobot",
    lerobot.recordings,
    suffixes=(".parquet", ".json", FOLDER),
    recognises=lerobot.recognises,
)
register_reader(
    "json",
    json_lines.read_json_lines,
    suffixes=(".jsonl", ".ndjson", ".json"),
    recognises=json_lines.recognises,
)
register_reader("ros", ros.recordings, suffixes=(*ros.SUFFIXES, FOLDER), recognises=ros.recognises)
register_reader("ulog", ulog.recordings, suffixes=ulog.SUFFIXES)
register_reader(
    "hdf5", hdf5.recordings, suffixes=(*hdf5.SUFFIXES, FOLDER), recognises=hdf5.recognises
)
