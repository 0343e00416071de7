"""Readers: one function for every file format, chosen by the file's suffix and content.

A new format is one small module with a function `(path, **options) -> Dataset` and one `register`.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from offbeat.data import store
from offbeat.data.readers import table
from offbeat.data.trajectory import Dataset
from offbeat.errors import FileFormatError, InputError, one_of


@dataclass(frozen=True)
class Reader:
    """A file format that can be read.

    Args:
        name: the name users give, when they name the format at all.
        suffixes: file name suffixes, in lower case, each with its dot.
        function: reads a file; its keyword arguments are the options of the format.
        recognises: looks into a file and says whether it is of this format, for formats that share
            a suffix with another one. None where the suffix is enough; such a reader gets what no
            other one recognises.
    """

    name: str
    suffixes: tuple[str, ...]
    function: Callable[..., Dataset]
    recognises: Callable[[Path], bool] | None = None

    @property
    def options(self) -> list[str]:
        """Names of the options that the format has."""
        parameters = inspect.signature(self.function).parameters.values()
        return [p.name for p in parameters if p.kind is inspect.Parameter.KEYWORD_ONLY]


READERS: dict[str, Reader] = {}
"""The formats that can be read, by name; added to with `register`."""


def register(reader: Reader) -> Reader:
    """Adds a format; `read` then finds it by its suffixes.

    Raises:
        InputError: the name is taken, or a suffix is not lower case with a dot.
    """
    if reader.name in READERS:
        raise InputError(f"there is a reader {reader.name!r} already; choose another name")
    for suffix in reader.suffixes:
        if suffix != suffix.lower() or not suffix.startswith("."):
            raise InputError(
                f"suffixes of reader {reader.name!r} must be lower case with a dot, such as "
                f"'.csv', got {suffix!r}"
            )
    READERS[reader.name] = reader
    return reader


def read(path: str | Path, *, format: str | None = None, **options: Any) -> Dataset:
    """Reads a data set from a file of any known format.

    Args:
        path: the file.
        format: name of the reader; by default found by the file's suffix and content.
        **options: options of the format, such as `time_unit` of CSV.

    Raises:
        FileFormatError: the file is missing, of no known format, or not what its format asks for.
        InputError: the format or an option is unknown.
    """
    path = store.require_file(path)
    reader = _reader_of(path) if format is None else READERS[one_of("format", format, READERS)]
    for option in options:
        if not reader.options:
            raise InputError(f"the {reader.name} reader takes no options, got {option!r}")
        one_of(f"option of the {reader.name} reader", option, reader.options)
    return reader.function(path, **options)


def _reader_of(path: Path) -> Reader:
    suffix = path.suffix.lower()
    fitting = [reader for reader in READERS.values() if suffix in reader.suffixes]
    if not fitting:
        known = (
            f"{reader.name} ({', '.join(sorted(reader.suffixes))})" for reader in READERS.values()
        )
        raise FileFormatError(
            f"{path} has the unknown suffix {suffix!r}, expected one of: {', '.join(known)}; "
            "rename it, or name its format with format="
        )
    for reader in fitting:
        if reader.recognises is not None and reader.recognises(path):
            return reader
    # Nobody's file: a reader of that suffix says best what is wrong with it.
    return next((reader for reader in fitting if reader.recognises is None), fitting[0])


register(Reader("offbeat", (".parquet",), store.load, store.holds_data_set))
register(Reader("csv", (".csv",), table.read_csv))
