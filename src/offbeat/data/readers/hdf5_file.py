"""HDF5 files, opened safely: sizes that no file holds, links to other files, filters, objects."""

from __future__ import annotations

import importlib
import math
import mmap
import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from offbeat.data.memory import require_memory
from offbeat.errors import FileFormatError, OffbeatError

MAGIC = b"\x89HDF\r\n\x1a\n"
_PLACES = (0, 512, 1024, 2048, 4096)  # of the magic bytes; MATLAB has text before them
_DEEPEST = 30  # groups in groups
_SMALL, _RATIO = 1 << 26, 2000  # bytes of an array that need no check; the most of compression
_HEAP = b"GCOL\1\0\0\0"
"""Begin of a global heap, which holds texts of any length; lengths and objects follow."""


def superblock_at(path: Path) -> int | None:
    """Where the first block of an HDF5 file is, or None if it has none or can't be read."""
    try:
        if not path.is_file():  # a pipe or a device may never end
            return None
        with path.open("rb") as file:
            start = file.read(_PLACES[-1] + len(MAGIC))
    except (OSError, ValueError):
        return None
    return next((at for at in _PLACES if start.startswith(MAGIC, at)), None)


def check_superblock(path: Path) -> None:
    """Refuses a first block that names a driver: HDF5 would allocate what it says, up to 4 GB.

    Only files in several parts have one; see "Disk Format: Level 0A" of the HDF5 specification.

    Raises:
        FileFormatError: the file has one.
    """
    at = superblock_at(path)
    if at is None:
        return
    with path.open("rb") as file:
        file.seek(at)
        block = file.read(128)
    if len(block) < 16 or block[8] > 1:  # later versions store it in a header that is checked
        return
    size, first = block[13], 24 if block[8] == 0 else 28
    driver = block[first + 3 * size : first + 4 * size]
    if driver != b"\xff" * size:
        raise FileFormatError(
            f"{path} is damaged, or one of several parts of an HDF5 file, expected a whole one; "
            "copy it again, or join the parts with h5repart"
        )


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """Opens the file; converts errors of HDF5 to one line."""
    import h5py

    with suppress(ImportError):
        importlib.import_module("hdf5plugin")  # registers filters, where it is installed
    check_superblock(path)
    _check_heaps(path)
    try:
        with h5py.File(path, "r") as file:
            yield file
    except OffbeatError:
        raise
    except Exception as error:  # of h5py about damaged files: of any kind
        what = " ".join(str(error).split())[:120]
        raise FileFormatError(
            f"{path} can't be read as HDF5, it is truncated, damaged or of another format "
            f"({what}); copy it again"
        ) from None


def _check_heaps(path: Path) -> None:
    """Refuses a global heap with a free space of 0 bytes, in which HDF5 would loop for ever.

    Raises:
        FileFormatError: the file has one.
    """
    with path.open("rb") as file:
        if not file.read(1):
            return
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            start = data.find(_HEAP)
            while start >= 0 and start + 16 <= len(data):
                end = min(start + struct.unpack_from("<Q", data, start + 8)[0], len(data))
                at, size = start + 16, 1
                while at + 16 <= end and size:
                    index, _, size = struct.unpack_from("<HH4xQ", data, at)
                    if index:
                        size = 16 + -(-size // 8) * 8
                    at += size
                if not size:
                    raise FileFormatError(
                        f"{path} is damaged: a heap of its texts has a free space of 0 bytes, at "
                        f"byte {at}; copy it again"
                    )
                start = data.find(_HEAP, start + 8)


def leaves_of(node: Any, path: str, file: Path, depth: int = 0) -> Iterator[tuple[str, Any]]:
    """The arrays below a group, or the array itself, by path. Tuple elements are numbered.

    Raises:
        FileFormatError: groups are nested too deeply, or a link leaves the file.
    """
    import h5py

    if isinstance(node, h5py.Dataset):
        yield path, node
        return
    if depth > _DEEPEST:
        raise FileFormatError(f"{file} nests groups more than {_DEEPEST} deep, at {node.name[:60]}")
    for name in node:
        here = name.removeprefix("_index_")
        inner = member(node, name, file)
        yield from leaves_of(inner, f"{path}/{here}" if path else here, file, depth + 1)


def member(group: Any, name: str, file: Path) -> Any:
    """A member of a group, unless its link leads to another file."""
    import h5py

    if isinstance(group.get(name, getlink=True), h5py.ExternalLink):
        raise FileFormatError(
            f"{file}: {group.name}/{name} is a link to another file, expected data inside; copy "
            "them into one file"
        )
    return group[name]


def check_storage(dataset: Any, path: Path) -> None:
    """Checks that an array is stored in the file, in a form that can be read, and fits memory.

    Raises:
        FileFormatError: it is in another file, compressed with a filter that is not installed, or
            far larger than what is stored.
    """
    import h5py

    if dataset.external or dataset.is_virtual:
        raise FileFormatError(
            f"{path}: {dataset.name} is stored in another file, expected data inside; copy them "
            "into one file"
        )
    created = dataset.id.get_create_plist()
    for i in range(created.get_nfilters()):
        code, _, _, name = created.get_filter(i)
        if not h5py.h5z.filter_avail(code):
            called = name.decode(errors="replace") or code
            raise FileFormatError(
                f"{path}: {dataset.name} is compressed with the filter {called!r}, which is not "
                "installed; install it with: pip install hdf5plugin"
            )
    need = math.prod(dataset.shape) * max(dataset.dtype.itemsize, 8)
    if need > _SMALL and need > _RATIO * path.stat().st_size:
        raise FileFormatError(
            f"{path}: {dataset.name} has shape {dataset.shape}, far more than the file of "
            f"{path.stat().st_size} bytes holds; copy it again"
        )
    require_memory(path, need, f"an array of shape {dataset.shape} in {dataset.name}")


def refuse_objects(dataset: Any, path: Path) -> None:
    """Raises an error for pickled data: opaque bytes, and objects of PyTables."""
    kind = dataset.dtype
    if (kind.kind == "V" and kind.names is None) or "PSEUDOATOM" in dataset.attrs:
        raise FileFormatError(
            f"{path}: {dataset.name} holds objects ({kind}), which would have to be unpickled, and "
            "that can run any code; Offbeat never does; write numbers, or choose others with keys="
        )


def what_is(dataset: Any) -> str:
    """The kind of a non-numeric array, for messages."""
    import h5py

    if dataset.dtype.kind in "SU" or h5py.check_string_dtype(dataset.dtype) is not None:
        return "text"
    if dataset.dtype.names is not None:
        return "records"
    if h5py.check_vlen_dtype(dataset.dtype) is not None:
        return "lists"
    return str(dataset.dtype) if dataset.ndim else "one number"


def texts_in(array: Any, name: str, width: int) -> list[str] | None:
    """A text per column in an attribute, or None."""
    try:
        found = np.asarray(array.attrs[name]).reshape(-1)
    except (KeyError, OSError, TypeError, ValueError):
        return None
    texts = [text.decode(errors="replace") if isinstance(text, bytes) else text for text in found]
    return texts if len(texts) == width and all(isinstance(t, str) for t in texts) else None
