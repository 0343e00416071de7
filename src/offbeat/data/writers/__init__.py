"""Writers of file formats, chosen by a file's suffix.

A new format is a function `(dataset, path)` and one call of `register_writer`, or an entry point of
the group `offbeat.writers`, whose name is the format's.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from offbeat.data import store
from offbeat.data.trajectory import Dataset
from offbeat.data.writers import tables
from offbeat.errors import InputError
from offbeat.registry import Registry


@dataclass(frozen=True)
class Writer:
    """A file format that can be written.

    Args:
        name: of the format.
        suffixes: file name suffixes, in lower case, each with its dot.
        function: writes a data set to a path, atomically.
    """

    name: str
    suffixes: tuple[str, ...]
    function: Callable[[Dataset, Path], None]


WRITERS: Registry[Writer] = Registry("format to write", group="offbeat.writers")
"""The formats that can be written; the first one that has a suffix is its default."""


def register_writer(
    name: str,
    function: Callable[[Dataset, Path], None],
    *,
    suffixes: Iterable[str],
    replace: bool = False,
) -> Writer:
    """Registers a format for `save`.

    Args:
        name: of the format.
        function: writes a data set to a path, atomically.
        suffixes: file name suffixes, in lower case, each with its dot.
        replace: allow a name that is taken.

    Raises:
        InputError: the name is taken.
    """
    return WRITERS.register(name, Writer(name, tuple(suffixes), function), replace=replace)


def save(dataset: Dataset, path: str | Path, *, format: str | None = None) -> None:
    """Writes a data set to a file, atomically.

    `.parquet` is Offbeat's own format: `load` and `read` restore the data set exactly.
    `.csv` and the format `table` (`.pq`, plain Parquet) are tables for other programs: a row per
    time, and the columns `trajectory`, `time` and one per channel, called `name [unit]`. They have
    no masks, roles and meta; values that are not observed are written all the same.

    Args:
        dataset: the data set; its `meta` must be JSON-like for Offbeat's own format.
        path: the file; an existing one is replaced.
        format: name of the format; by default found by the suffix.

    Raises:
        InputError: the format or suffix is unknown, or the data set does not fit the format.
        OSError: the file cannot be written.
    """
    path = Path(path)
    if format is not None:
        WRITERS[format].function(dataset, path)
        return
    suffix = path.suffix.lower()
    for writer in WRITERS.values():
        if suffix in writer.suffixes:
            writer.function(dataset, path)
            return
    known = ", ".join(f"{w.name} ({', '.join(w.suffixes)})" for w in WRITERS.values())
    raise InputError(
        f"{path} has the unknown suffix {suffix!r}, expected one of: {known}; rename it, or name "
        "its format with format="
    )


register_writer("offbeat", store.save, suffixes=(".parquet",))
register_writer("csv", tables.write_dataset, suffixes=(".csv",))
register_writer("table", tables.write_dataset, suffixes=(".pq",))
