"""Writers of file formats, chosen by a file's suffix; a path without one is a folder.

A new format is a function `(dataset, path, *, options)` and one call of `register_writer`, or an
entry point of the group `offbeat.writers`, whose name is the format's.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from offbeat.data import store
from offbeat.data.trajectory import Dataset
from offbeat.data.writers import lerobot, mcap, minari, npz, robomimic, tables
from offbeat.errors import InputError, one_of
from offbeat.registry import Registry

FOLDER = "/"
"""The suffix of writers of folders."""


@dataclass(frozen=True)
class Writer:
    """A file format that can be written.

    Args:
        name: of the format.
        suffixes: file name suffixes, in lower case, each with its dot; `FOLDER` for folders.
        function: writes a data set to a path, atomically; its keyword arguments are the options
            of the format.
    """

    name: str
    suffixes: tuple[str, ...]
    function: Callable[..., None]

    @property
    def options(self) -> list[str]:
        """Names of the options of the format."""
        parameters = inspect.signature(self.function).parameters.values()
        return [p.name for p in parameters if p.kind is inspect.Parameter.KEYWORD_ONLY]

    @property
    def is_folder(self) -> bool:
        """Whether the format is a folder of files."""
        return FOLDER in self.suffixes


WRITERS: Registry[Writer] = Registry("format to write", group="offbeat.writers")
"""The formats that can be written; the first one that has a suffix is its default."""


def register_writer(
    name: str,
    function: Callable[..., None],
    *,
    suffixes: Iterable[str],
    replace: bool = False,
) -> Writer:
    """Registers a format for `save`.

    Args:
        name: of the format.
        function: writes a data set to a path, atomically; its keyword arguments are options.
        suffixes: file name suffixes, in lower case, each with its dot; `FOLDER` for folders.
        replace: allow a name that is taken.

    Raises:
        InputError: the name is taken.
    """
    return WRITERS.register(name, Writer(name, tuple(suffixes), function), replace=replace)


def writer_of(path: str | Path, format: str | None = None) -> Writer:
    """The writer of a format, or of a path's suffix.

    Args:
        path: a file; a path without a suffix, or a folder that is there, is a folder to write.
        format: name of the format; by default found by the suffix.

    Raises:
        InputError: the format or suffix is unknown.
    """
    if format is not None:
        return WRITERS[format]
    path = Path(path)
    suffix = FOLDER if path.is_dir() else path.suffix.lower() or FOLDER
    for writer in WRITERS.values():
        if suffix in writer.suffixes:
            return writer
    known = ", ".join(f"{w.name} ({', '.join(w.suffixes)})" for w in WRITERS.values())
    raise InputError(
        f"{path} has the unknown suffix {suffix!r}, expected one of: {known}; rename it, or name "
        "its format with format="
    )


def save(dataset: Dataset, path: str | Path, *, format: str | None = None, **options: Any) -> None:
    """Writes a data set to a file or folder, atomically.

    `.parquet` is Offbeat's own format: `load` and `read` restore the data set exactly. The others
    are for other programs; `docs/writers.md` says what each one keeps.

    | format | suffix | options |
    |---|---|---|
    | `offbeat` | `.parquet` | |
    | `csv`, `table` | `.csv`, `.pq` | |
    | `npz` | `.npz` | `level` |
    | `robomimic` | `.hdf5`, `.h5` | `rate_hz`, `level` |
    | `mcap` | `.mcap` | `log`, `level` |
    | `lerobot` | a folder | `rate_hz`, `task`, `level` |
    | `minari` | a folder, by name | `level` |

    `.csv` and `table` (plain Parquet) are tables: a row per time, and the columns `trajectory`,
    `time [s]` and one per channel, called `name [unit]`. They have no masks, roles and meta; values
    that are not observed are written all the same.

    Args:
        dataset: the data set; its `meta` must be JSON-like for Offbeat's own format.
        path: the file or folder; what is there in this format is replaced.
        format: name of the format; by default found by the suffix.
        **options: of the format: `rate_hz`, rows per second; `level`, probability of the intervals
            of answers; `task`, what the robot does; `log`, the bag
            whose messages are repeated.

    Raises:
        InputError: the format, suffix or an option is unknown, or the data set does not fit the
            format.
        MissingExtraError: the format needs a package that is not installed.
        OSError: the file cannot be written.

    Example:
        >>> offbeat.save(offbeat.impute(blend, log), "walk", format="lerobot")  # doctest: +SKIP
    """
    path = Path(path)
    writer = writer_of(path, format)
    for name in options:
        if not writer.options:
            raise InputError(f"the format {writer.name} takes no options, got {name!r}")
        one_of(f"option of the format {writer.name}", name, writer.options)
    writer.function(Dataset.of(dataset), path, **options)


register_writer("offbeat", store.save, suffixes=(".parquet",))
register_writer("csv", tables.write_dataset, suffixes=(".csv",))
register_writer("table", tables.write_dataset, suffixes=(".pq",))
register_writer("npz", npz.write_npz, suffixes=(".npz",))
register_writer("robomimic", robomimic.write_robomimic, suffixes=(".hdf5", ".h5"))
register_writer("mcap", mcap.write_mcap, suffixes=(".mcap",))
register_writer("lerobot", lerobot.write_lerobot, suffixes=(FOLDER,))
register_writer("minari", minari.write_minari, suffixes=(FOLDER,))
