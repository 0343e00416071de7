"""Checks of files before they are read."""

from __future__ import annotations

from pathlib import Path

from offbeat.errors import FileFormatError

PICKLE_SUFFIXES = (".pkl", ".pickle", ".p", ".pt", ".pth", ".joblib", ".dill")
"""Suffixes of files that hold pickled Python objects, which can run any code when loaded."""

_PICKLE_STARTS = tuple(bytes([0x80, protocol]) for protocol in range(2, 6))


def starts_with(path: Path, starts: bytes | tuple[bytes, ...]) -> bool:
    """Whether a file starts with certain bytes; False if it cannot be read."""
    try:
        with path.open("rb") as file:
            return file.read(64).startswith(starts)
    except OSError:
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
        with path.open("rb") as file:
            start = file.read(64)
    except OSError as error:
        raise FileFormatError(
            f"{path} can't be read ({error.strerror}); check the path, working directory is "
            f"{Path.cwd()}"
        ) from None
    if not start:
        raise FileFormatError(f"{path} is empty, expected a data set; write it again")
    if start.startswith(b"version https://git-lfs"):
        raise FileFormatError(
            f"{path} is a Git LFS pointer, not the data; fetch the data with: git lfs pull"
        )
    if start.startswith(_PICKLE_STARTS) or path.suffix.lower() in PICKLE_SUFFIXES:
        raise FileFormatError(
            f"{path} holds pickled Python objects, which can run any code when they are loaded; "
            "Offbeat never does; write the data as Parquet, CSV or NPZ"
        )
    return path


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
