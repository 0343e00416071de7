"""Several files as one data set: each an episode, or each a sensor of one recording."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from offbeat.data.readers.text import COMPRESSED
from offbeat.data.signals import Recording
from offbeat.errors import FileFormatError, InputError

FILES = ("auto", "episodes", "merge")
"""Ways of reading several files together; see `together`."""

_MOST_FILES = 100_000
_ABOUT = re.compile(r"(readme|licen[cs]e|changelog|citation|copying)\b", re.IGNORECASE)
"""Names of files about a data set, which are not read with its folder."""

_NUMBER = re.compile(r"\d+")
_SINCE_1970 = 10 * 365 * 86_400 * 10**9
"""ns; stamps beyond it count from 1970 or before, and not from the start of a recording."""


def files_in(folder: Path, suffixes: Iterable[str]) -> list[Path]:
    """The files in a folder with one of these suffixes, `ep2` before `ep10`, without a README.

    Raises:
        FileFormatError: there are too many.
    """
    known = set(suffixes)
    found: list[Path] = []
    for path in folder.iterdir():
        inner = Path(path.stem).suffix.lower() if path.suffix.lower() in COMPRESSED else ""
        if (
            {path.suffix.lower(), inner} & known
            and not path.name.startswith(".")
            and not _ABOUT.match(path.stem)
            and path.is_file()
        ):
            found.append(path)
            if len(found) > _MOST_FILES:
                raise FileFormatError(f"{folder} holds more than {_MOST_FILES} files")
    return sorted(found, key=_in_order)


def _in_order(path: Path) -> list[tuple[int, str]]:
    return [(int(part) if part.isdecimal() else -1, part) for part in re.split(r"(\d+)", path.name)]


def together(
    read: Sequence[tuple[Path, list[Recording]]], files: str, origin: str
) -> list[Recording]:
    """The recordings of several files as those of one data set.

    Args:
        read: each file with its recordings.
        files: `episodes`, each file holds one or several; `merge`, each file holds a sensor of
            one recording, on one clock; `auto`, the latter where no two files have a channel in
            common, or where they were logged at the same time.
        origin: where they are from, for messages.

    Raises:
        FileFormatError: files to be merged hold several episodes each, or count from different
            zeros.
    """
    channels = [
        {(s.name, c) for recording in made for s in recording.signals for c in s.channels}
        for _, made in read
    ]
    distinct = sum(map(len, channels)) == len(set().union(*channels))
    if files == "auto":
        sensors = distinct or _at_once(read)
        files = "merge" if sensors and len(read) > 1 else "episodes"
    if files == "merge":
        return [_merged(read, origin)]
    several = f"{len(read)} files are read as episodes (files=merge merges them by their times)"
    told = (several,) if len(read) > 1 else ()
    made: list[Recording] = []
    for path, recordings in read:
        for recording in recordings:
            label = f"{path.stem}/{recording.label}" if recording.label else path.stem
            made.append(replace(recording, label=label, notes=(*told, *recording.notes)))
    return made


def _at_once(read: Sequence[tuple[Path, list[Recording]]]) -> bool:
    """Whether files are of one time, as the sensors of a phone are, each with axes x, y and z.

    Their stamps count from 1970 or before, have a time in common, and their names differ by more
    than a number, as those of episodes or of robots do not.
    """
    if len({_NUMBER.sub("", path.stem) for path, _ in read}) < len(read):
        return False
    starts, ends = [], []
    for _, recordings in read:
        stamps = [s.stamps for recording in recordings for s in recording.signals if len(s.stamps)]
        if len(recordings) != 1 or recordings[0].clock_zero or not stamps:
            return False
        starts.append(min(int(s.min()) for s in stamps))
        ends.append(max(int(s.max()) for s in stamps))
    return min(starts) > _SINCE_1970 and max(starts) < min(ends)


def _merged(read: Sequence[tuple[Path, list[Recording]]], origin: str) -> Recording:
    for path, recordings in read:
        if len(recordings) != 1:
            raise FileFormatError(
                f"{path} holds {len(recordings)} episodes, expected one that can be merged with "
                "the other files; files=episodes reads each file as an episode"
            )
    stems = [path.stem for path, _ in read]
    names = stems if len(set(stems)) == len(stems) else [path.name for path, _ in read]
    ones = [recordings[0] for _, recordings in read]
    if len({one.clock_zero for one in ones}) > 1:
        raise FileFormatError(
            f"the files of {origin} count from different zeros, expected one clock; read them "
            "one by one"
        )
    units = {one.time_unit for one in ones}
    return Recording(
        tuple(
            replace(signal, name=f"{name}.{signal.name}" if signal.name else name)
            for name, one in zip(names, ones, strict=True)
            for signal in one.signals
        ),
        origin=origin,
        time_unit=ones[0].time_unit if len(units) == 1 else "ns",
        notes=(
            f"{len(ones)} files are merged by their times (files=episodes reads them as episodes)",
            *dict.fromkeys(note for one in ones for note in one.notes),
        ),
        clock_zero=ones[0].clock_zero,
        unit_found=any(one.unit_found for one in ones),
        left_out=tuple(name for one in ones for name in one.left_out),
    )


def check_paths(paths: Sequence[object]) -> list[Path]:
    """The paths of several files.

    Raises:
        InputError: there are none, or they are no paths.
    """
    if not paths or not all(isinstance(path, str | Path) for path in paths):
        raise InputError(f"path must be a file, a folder, or a list of files, got {paths!r:.100}")
    return [Path(str(path)) for path in paths]
