"""Atomic files: written under a temporary name, then renamed."""

from __future__ import annotations

import json
import os
import re
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from offbeat.errors import InputError


def writable(path: str | Path, *, folder: bool = False) -> Path:
    """Returns `path` if a file (or folder) can be written there; creates nothing.

    Raises:
        InputError: a parent is not a folder or is not writable, or there is a folder
            in place of a file, or the other way round.
    """
    path = Path(path)
    if path.exists() and path.is_dir() != folder:
        found, wanted = ("file", "folder") if folder else ("folder", "file")
        raise InputError(f"{path} is a {found}; give the name of a {wanted}")
    nearest = next(parent for parent in path.absolute().parents if parent.exists())
    if not nearest.is_dir() or not os.access(nearest, os.W_OK):
        why = "may not be written to" if nearest.is_dir() else "is a file"
        raise InputError(f"{path} can't be written: {nearest} {why}; choose another place")
    return path


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Yields a temporary name in the folder of `path`; renames it to `path` if the block succeeds.

    If the block raises or the process is killed, `path` does not change. What a killed process
    left is removed by the next one that writes `path`.
    """
    path = writable(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_left(path)
    with _named(path):
        handle, name = tempfile.mkstemp(
            dir=path.parent, prefix=f".{path.name}.", suffix=path.suffix
        )
        temporary = Path(name)
        try:
            _lock(handle)
            yield temporary
            umask = os.umask(0)
            os.umask(umask)
            temporary.chmod(0o666 & ~umask)
            _settle(temporary)
            os.replace(temporary, path)
        finally:
            os.close(handle)
            temporary.unlink(missing_ok=True)


@contextmanager
def atomic_folder(path: str | Path) -> Iterator[Path]:
    """Yields a temporary folder next to `path`; renames it to `path` if the block succeeds.

    A folder at `path` is replaced after the new one is complete. What a killed process left is
    removed, or put back, by the next one that writes `path`.
    """
    path = writable(path, folder=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    _remove_left(path)
    with _named(path):
        temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
        handle = os.open(temporary, os.O_RDONLY)
        try:
            _lock(handle)
            yield temporary
            for file in temporary.rglob("*"):
                if file.is_file():
                    _settle(file)
            umask = os.umask(0)
            os.umask(umask)
            temporary.chmod(0o777 & ~umask)
            if path.exists():
                old = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}.old."))
                os.replace(path, old)
                os.replace(temporary, path)
                shutil.rmtree(old)
            else:
                os.replace(temporary, path)
        finally:
            os.close(handle)
            shutil.rmtree(temporary, ignore_errors=True)


_LEFT_S = 2.0
"""Age from which a temporary file that no process holds is one that a killed process left."""


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Adds the path to errors such as a full disk, which name no file."""
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno is not None:
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def _lock(handle: int) -> bool:
    """Locks an open file for this process; False if another one has it."""
    try:
        import fcntl
    except ImportError:  # not on this system: nothing is ever removed there
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


_TEMPORARY = re.compile(r"\.(.+?)\.(?:old\.)?[a-z0-9_]{8}(?:\.\w+)?")
"""Names of temporary files and folders, with that of the file that was written."""


def clean(folder: Path) -> None:
    """Removes what killed processes left below a folder, which must be one that Offbeat writes.

    Args:
        folder: of a run or a sweep.
    """
    for left in list(folder.rglob(".*")):
        found = _TEMPORARY.fullmatch(left.name)
        if found:
            _remove_left(left.with_name(found[1]))


def _remove_left(path: Path) -> None:
    """Removes temporary files and folders for `path` that killed processes left.

    A folder that was moved away and not replaced is put back.
    """
    pattern = re.compile(
        rf"\.{re.escape(path.name)}\.(old\.)?[a-z0-9_]{{8}}({re.escape(path.suffix)})?"
    )
    try:
        with os.scandir(path.parent) as entries:
            names = [entry.name for entry in entries if pattern.fullmatch(entry.name)]
    except FileNotFoundError:  # it was inside of one that was removed
        return
    for name in names:
        left = path.parent / name
        try:
            if time.time() - left.stat().st_mtime < _LEFT_S:
                continue
            handle = os.open(left, os.O_RDONLY)
        except OSError:
            continue
        try:
            if not _lock(handle):
                continue
            if left.is_dir() and ".old." in name and not path.exists():
                os.replace(left, path)
            elif left.is_dir():
                shutil.rmtree(left, ignore_errors=True)
            else:
                left.unlink(missing_ok=True)
        finally:
            os.close(handle)


def _settle(path: Path) -> None:
    """Flushes a file to the disk, so that a power failure leaves no empty file."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def write_text(path: str | Path, text: str) -> None:
    """Writes a text file atomically, in UTF-8."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: str | Path, value: Any) -> None:
    """Writes a JSON file atomically, keys in the given order, floats exactly."""
    write_text(path, json.dumps(value, indent=2, allow_nan=False) + "\n")
