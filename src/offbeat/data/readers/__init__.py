"""Readers: one function for every file format, chosen by the file's suffix and content.

A new format is one small module with a function `(path, **options) -> Iterable[Recording]` and one
`register`, or, in a package of its own, an entry point of the group `offbeat.readers`.
"""

from __future__ import annotations

import functools
import importlib.metadata
import inspect
import logging
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from offbeat.data import store
from offbeat.data.readers import hdf5, lerobot, npz, parquet, pose, ros, table, ulog
from offbeat.data.recording import ReaderOptions, Recording, assemble
from offbeat.data.source import require_source
from offbeat.data.trajectory import Dataset
from offbeat.errors import FileFormatError, InputError, one_of

ENTRY_POINTS = "offbeat.readers"
"""The group in which other packages name a `Reader` of theirs, or a function that makes one."""

FOLDER = "/"
"""Stands among the suffixes of a reader that reads folders; it must have `recognises`."""

POLICIES = tuple(field.name for field in fields(ReaderOptions))
"""The options that every format has."""


@dataclass(frozen=True)
class Reader:
    """A file format that can be read.

    Args:
        name: the name users give, when they name the format at all.
        suffixes: file name suffixes, in lower case, each with its dot; `FOLDER` for folders.
        function: reads a file, whose path is its one positional argument; its keyword arguments
            are the options of the format. It gives recordings, to which `read` applies the
            policies, or a data set, to which it applies none. It opens no file that
            `require_file` has not passed (`read` calls that for the file itself).
        recognises: looks into a file (or a folder, where `FOLDER` is among the suffixes) and says
            whether it is of this format, for formats that share a suffix with another one; it
            never raises. None where the suffix is enough; such a reader gets what no other one
            recognises.
        policies: whether `function` gives recordings.
    """

    name: str
    suffixes: tuple[str, ...]
    function: Callable[..., Iterable[Recording] | Dataset]
    recognises: Callable[[Path], bool] | None = None
    policies: bool = True

    @property
    def options(self) -> list[str]:
        """Names of the options that the format has, beside the policies."""
        parameters = inspect.signature(self.function).parameters.values()
        return [p.name for p in parameters if p.kind is inspect.Parameter.KEYWORD_ONLY]


READERS: dict[str, Reader] = {}
"""The formats that can be read, by name; added to with `register`."""


def register(reader: Reader) -> Reader:
    """Adds a format; `read` then finds it by its suffixes.

    Raises:
        InputError: the name is taken, a suffix is not lower case with a dot, or a reader of
            folders has no `recognises`.
    """
    if reader.name in READERS:
        raise InputError(f"there is a reader {reader.name!r} already; choose another name")
    for suffix in reader.suffixes:
        if suffix != FOLDER and (suffix != suffix.lower() or not suffix.startswith(".")):
            raise InputError(
                f"suffixes of reader {reader.name!r} must be lower case with a dot, such as "
                f"'.csv', or {FOLDER!r} for folders, got {suffix!r}"
            )
    if FOLDER in reader.suffixes and reader.recognises is None:
        raise InputError(f"reader {reader.name!r} reads folders, and needs recognises to know them")
    READERS[reader.name] = reader
    return reader


def read(path: str | Path, *, format: str | None = None, **options: Any) -> Dataset:
    """Reads a data set from a file, or a folder of files, of any known format.

    Args:
        path: the file or folder.
        format: name of the reader; by default found by the file's suffix and content.
        **options: options of the format, such as `time_unit` of CSV, and the fields of
            `ReaderOptions`, which every format has but our own.

    Returns:
        The data set. Its `meta["report"]` says what the policies did, `meta["source"]` where it
        came from. What a reader had to assume (a unit of time found by the numbers, say) stands in
        `meta["report"]["notes"]`, and is logged as a warning of the logger `offbeat`.

    Raises:
        FileFormatError: the file is missing, of no known format, or not what its format asks for.
        InputError: the format or an option is unknown.
    """
    path = require_source(path)
    load_entry_points()
    reader = reader_of(path) if format is None else READERS[one_of("format", format, READERS)]
    own, known = reader.options, options_of(reader)
    if isinstance(options.get("actions"), bool) and "include_actions" in own:
        options["include_actions"] = options.pop("actions")  # as Offbeat 0.1.0 called it
    for option in options:
        if not known:
            raise InputError(f"the {reader.name} reader takes no options, got {option!r}")
        one_of(f"option of the {reader.name} reader", option, known)
    policies = {name: options.pop(name) for name in list(options) if name not in own}
    made = reader.function(path, **options)
    if isinstance(made, Dataset):
        if policies:
            raise InputError(
                f"the {reader.name} reader gives a finished data set, to which policies no longer "
                f"apply, got {', '.join(policies)}"
            )
        return made
    dataset = assemble(made, ReaderOptions(**policies))
    for note in dataset.meta["report"]["notes"]:
        logging.getLogger("offbeat").warning("%s: %s", path, note)
    return replace(dataset, meta={"source": path.name, "format": reader.name, **dataset.meta})


def options_of(reader: Reader) -> list[str]:
    """All options of a format: its own, and the policies where they apply."""
    return list(dict.fromkeys([*reader.options, *(POLICIES if reader.policies else ())]))


def reader_of(path: Path) -> Reader:
    """The reader of a file or folder that is there, by its suffix and content.

    Raises:
        FileFormatError: no reader is for it.
    """
    suffix = FOLDER if path.is_dir() else path.suffix.lower()
    fitting = [reader for reader in READERS.values() if suffix in reader.suffixes]
    for reader in fitting:
        if reader.recognises is not None and reader.recognises(path):
            return reader
    if suffix == FOLDER:
        known = ", ".join(reader.name for reader in fitting) or "none"
        raise FileFormatError(
            f"{path} is a folder of no known format, expected one of: {known}; name the file "
            "inside it, or its format with format="
        )
    if not fitting:
        named = (
            f"{reader.name} ({', '.join(sorted(reader.suffixes))})" for reader in READERS.values()
        )
        raise FileFormatError(
            f"{path} has the unknown suffix {suffix!r}, expected one of: {', '.join(named)}; "
            "rename it, or name its format with format="
        )
    # Nobody's file: a reader of that suffix says best what is wrong with it.
    return next((reader for reader in fitting if reader.recognises is None), fitting[0])


@functools.cache
def load_entry_points() -> None:
    """Registers the readers of other packages, once.

    One that can't be loaded costs a warning: it must not keep the others from reading.
    """
    for entry in importlib.metadata.entry_points(group=ENTRY_POINTS):
        try:
            loaded = entry.load()
            register(loaded if isinstance(loaded, Reader) else loaded())
        except Exception as error:
            warnings.warn(
                f"the reader {entry.name!r} ({entry.value}) of another package can't be used: "
                f"{type(error).__name__}: {error}",
                stacklevel=2,
            )


register(Reader("offbeat", (".parquet",), store.load, store.holds_data_set, policies=False))
register(Reader("parquet", (".parquet", ".pq"), parquet.read_parquet))
register(Reader("euroc", (".csv", FOLDER), pose.read_euroc, pose.is_euroc))
register(Reader("tum", (".tum", ".txt"), pose.read_tum, pose.is_tum))
register(Reader("csv", (".csv", ".tsv", ".txt"), table.read_csv))
register(Reader("npz", (".npz",), npz.read_npz))
register(Reader("lerobot", (".parquet", ".json", FOLDER), lerobot.recordings, lerobot.recognises))
register(Reader("ros", (*ros.SUFFIXES, FOLDER), ros.recordings, ros.recognises))
register(Reader("ulog", ulog.SUFFIXES, ulog.recordings))
register(Reader("hdf5", (*hdf5.SUFFIXES, FOLDER), hdf5.recordings, hdf5.recognises))
