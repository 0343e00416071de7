"""Checks of files before they are read."""

from __future__ import annotations

import json
import stat
from pathlib import Path, PurePosixPath
from typing import Any

from offbeat.errors import FileFormatError

_LONGEST_JSON = 256 << 20

PICKLE_SUFFIXES = (".pkl", ".pickle", ".p", ".pt", ".pth", ".joblib", ".dill")
"""Suffixes of files that hold pickled Python objects, which can run any code when loaded."""

_PICKLE_STARTS = tuple(bytes([0x80, protocol]) for protocol in range(2, 6))


class NotRegularError(Exception):
    """A path is neither a file nor a folder."""


def starts_with(path: Path, starts: bytes | tuple[bytes, ...]) -> bool:
    """Whether a file starts with certain bytes; False if it cannot be read."""
    try:
        if not path.is_file():  # a pipe or a device may never end
            return False
        with path.open("rb") as file:
            return file.read(64).startswith(starts)
    except (OSError, ValueError):
        return False


def require_file(path: str | Path) -> Path:
    """Returns the path of a file that exists, is not empty, and contains data.

    Readers of folders call this for each file that they open.

    Raises:
        FileFormatError: it is missing, a folder, empty, a Git LFS pointer, or a pickle.
    """
    path = Path(path)
    if path.is_dir():
        raise FileFormatError(f"{path} is a folder, expected a file; name the file inside it")
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise NotRegularError
        with path.open("rb") as file:
            start = file.read(64)
    except NotRegularError:
        raise FileFormatError(
            f"{path} is a pipe or a device, expected a file; write what it gives to a file"
        ) from None
    except (OSError, ValueError) as error:  # such as a byte of 0 in the path
        why = error.strerror if isinstance(error, OSError) else error
        raise FileFormatError(
            f"{path} can't be read ({why}); check the path, working directory is {Path.cwd()}"
        ) from None
    if not start:
        raise FileFormatError(f"{path} is empty, expected a data set; write it again")
    if start.startswith(b"version https://git-lfs"):
        raise FileFormatError(
            f"{path} is a Git LFS pointer, not the data; fetch the data with: git lfs pull"
        )
    # A tensor file starts with the length of its header, which can be the bytes of a pickle.
    tensors = path.suffix.lower() == ".safetensors"
    if (start.startswith(_PICKLE_STARTS) and not tensors) or (
        path.suffix.lower() in PICKLE_SUFFIXES
    ):
        raise FileFormatError(
            f"{path} holds pickled Python objects, which can run any code when they are loaded; "
            "Offbeat never does; write the data as Parquet, CSV or NPZ"
        )
    return path


def inside(root: Path, name: str, where: Path) -> Path:
    """The path of a file of a data set that one of its other files names.

    Args:
        root: folder of the data set.
        name: path below it.
        where: the file that names it, for messages.

    Raises:
        FileFormatError: it is outside of the folder.
    """
    pure = PurePosixPath(name)
    if pure.is_absolute() or ".." in pure.parts or "\\" in name or not name.isprintable():
        raise FileFormatError(
            f"{where} names the file {name[:100]!r}, expected one inside of {root}; do not trust it"
        )
    return root / pure


def read_json(path: str | Path) -> Any:
    """The value in a file of JSON.

    Raises:
        FileFormatError: as `require_file`; it is too long, not UTF-8, not JSON or nested deeply.
    """
    path = require_file(path)
    size = path.stat().st_size
    if size > _LONGEST_JSON:
        raise FileFormatError(f"{path} has {size} bytes, expected at most {_LONGEST_JSON} of JSON")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        why = error if isinstance(error, ValueError) else "nested too deeply"
        raise FileFormatError(f"{path} is damaged: it is no JSON ({why})") from None


def require_source(path: str | Path) -> Path:
    """As `require_file`, but also accepts a folder that is not empty.

    Raises:
        FileFormatError: as `require_file`, or the folder is empty or can't be read.
    """
    path = Path(path)
    if not path.is_dir():
        return require_file(path)
    try:
        empty = next(path.iterdir(), None) is None
    except OSError as error:
        raise FileFormatError(
            f"{path} can't be read ({error.strerror}); check its rights"
        ) from None
    if empty:
        raise FileFormatError(f"{path} is an empty folder, expected a data set inside")
    return path
