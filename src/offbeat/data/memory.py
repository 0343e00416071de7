"""Checks that a file fits into memory before it is read."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from offbeat.errors import FileFormatError

_PROC = Path("/proc")
_GROUPS = Path("/sys/fs/cgroup")
_PER_VALUE, _PER_ROW = 9, 32  # bytes: a value and its mask; stamps, times and steps


def require_rows(
    path: Path, rows: int, channels: int, instead: str = "choose channels=", *, copies: int = 1
) -> None:
    """Checks that a data set fits into memory.

    Args:
        path: the file, for messages.
        rows: of all trajectories.
        channels: that are read.
        instead: advice on reading less, for messages.
        copies: number of copies of the values in memory while the file is read.

    Raises:
        FileFormatError: it does not fit.
    """
    need = copies * rows * row_bytes(channels)
    require_memory(path, need, f"{rows} rows x {channels} channels", instead)


def row_bytes(channels: int) -> int:
    """Memory of a row of a data set, about, in bytes.

    Args:
        channels: that it has.
    """
    return channels * _PER_VALUE + _PER_ROW


def require_memory(path: Path, need: int, what: str, instead: str = "") -> None:
    """Checks that enough memory is available.

    Args:
        path: the file, for messages.
        need: bytes.
        what: contents of the file, for messages.
        instead: advice on reading less, for messages.

    Raises:
        FileFormatError: not enough memory is available.
    """
    free = available_memory()
    if free is not None and need > free:
        fix = f"{instead}, or split the file" if instead else "split the file"
        raise FileFormatError(
            f"{path} holds {what}, which need {gigabytes(need)} of memory, and "
            f"{gigabytes(free)} are available; {fix}"
        )


def available_memory() -> int | None:
    """Bytes that this process can still allocate; None if unknown.

    The minimum of the system's available memory (on Linux) and the remaining limits of the control
    groups of the process, versions 1 and 2.
    """
    return min((*_of_system(), *_of_groups()), default=None)


def _of_system() -> Iterator[int]:
    fields = _fields(_PROC / "meminfo")
    if "MemAvailable" in fields:
        yield 1024 * (fields["MemAvailable"] + fields.get("SwapFree", 0))


def _of_groups() -> Iterator[int]:
    """The remainder of each limit, from the group of this process to the root."""
    for line in _lines(_PROC / "self" / "cgroup"):
        number, controllers, place = [*line.split(":", 2), "", ""][:3]
        if number == "0" and not controllers:
            root, limit, usage = _GROUPS, "memory.max", "memory.current"
        elif "memory" in controllers.split(","):
            root, limit, usage = (
                _GROUPS / "memory",
                "memory.limit_in_bytes",
                "memory.usage_in_bytes",
            )
        else:
            continue
        group = root / place.lstrip("/")
        for folder in (group, *group.parents):
            most, used = _number(folder / limit), _number(folder / usage)
            if most is not None and used is not None:
                # The system frees the file cache before it kills a process.
                statistics = _fields(folder / "memory.stat")
                kinds = ("active_file", "inactive_file")
                files = sum(
                    statistics.get(f"total_{kind}", statistics.get(kind, 0)) for kind in kinds
                )
                yield max(0, most - used + files)
            if folder == root:
                break


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return []


def _fields(path: Path) -> dict[str, int]:
    """Names and numbers, one of each per line."""
    words = [line.replace(":", " ").split() for line in _lines(path)]
    return {found[0]: int(found[1]) for found in words if len(found) > 1 and found[1].isdecimal()}


def _number(path: Path) -> int | None:
    """The number in a file; None if it is not a number, such as `max`, or the file is missing."""
    lines = _lines(path)
    return int(lines[0]) if lines and lines[0].strip().isdecimal() else None


def gigabytes(count: int) -> str:
    """A number of bytes as text, such as `4.2 GB`."""
    return f"{count / 1e9:.3g} GB"
