"""A folder of logs, read file by file into a data set that need not fit in memory."""

from __future__ import annotations

import json
import logging
import re
import time
from pathlib import Path
from typing import Any

from offbeat.data.readers import files_of, read
from offbeat.data.shards import ShardedDataset
from offbeat.data.store import save
from offbeat.errors import FileFormatError, InputError, NoLogError, listed, printable
from offbeat.files import write_json

MANIFEST = "converted.json"
"""What each file of the folder was converted from, and with which options."""

SAVE_EVERY_S = 5.0
"""Seconds from one writing of that to the next: many files make it long."""


def convert(folder: str | Path, out: str | Path, **options: Any) -> ShardedDataset:
    """Reads each log of a folder alone, writes it as a data set, and opens what was written.

    Each file holds whole episodes: sensors in files of their own are not merged. What was converted
    already, by the same options and from a file that did not change since, is kept; what was
    converted from a file that is gone is deleted. Files without rows or times are left out, which
    is printed.

    Args:
        folder: with logs of one format.
        out: folder for the data sets, in the format of Offbeat; made if it is missing.
        **options: of `offbeat.read`.

    Raises:
        FileFormatError: there is no log in the folder, a file can't be read, or channels differ
            between files.
        InputError: as of `read`, or `out` is the folder of the logs.
    """
    folder, out = Path(folder), Path(out)
    if folder.resolve() == out.resolve():
        raise InputError(f"{folder} holds the logs; give another folder for the data sets")
    paths = files_of(folder, options.get("format"))
    if not paths:
        raise FileFormatError(f"{folder} holds no files that are read one by one, as tables are")
    out.mkdir(parents=True, exist_ok=True)
    copies = [out / f"{i:06d}.parquet" for i in range(len(paths))]
    wanted = {c.name: _stamp(path, options) for c, path in zip(copies, paths, strict=True)}
    known = _known(out)
    for name in known.keys() - wanted.keys():
        (out / name).unlink(missing_ok=True)
    made = {n: s for n, s in wanted.items() if known.get(n) == s and (out / n).exists()}
    write_json(out / MANIFEST, made)  # without those that are about to change
    written = time.monotonic()
    refused: dict[str, NoLogError] = {}
    try:
        for copy, path in zip(copies, paths, strict=True):
            if copy.name in made:
                continue
            try:
                dataset = read(path, **options)
            except NoLogError as error:
                copy.unlink(missing_ok=True)
                refused[path.name] = error
                continue
            save(dataset, copy)
            made[copy.name] = wanted[copy.name]
            if time.monotonic() > written + SAVE_EVERY_S:
                write_json(out / MANIFEST, made)
                written = time.monotonic()
    finally:
        write_json(out / MANIFEST, made)
    if not made:
        raise next(iter(refused.values()))
    if refused:
        note = f"{folder}: files without rows or times are left out: {listed([*refused], 6)}"
        logging.getLogger("offbeat").warning("%s", printable(note))
    try:
        return ShardedDataset.of_files([copy for copy in copies if copy.name in made])
    except FileFormatError as error:
        said = str(error)
        for copy, path in zip(copies, paths, strict=True):
            said = said.replace(str(copy), printable(str(path)))
        raise FileFormatError(said) from None


def _stamp(path: Path, options: dict[str, Any]) -> list[Any]:
    status, asked = path.stat(), json.dumps(options, default=str, sort_keys=True)
    return [path.name, status.st_size, status.st_mtime_ns, asked]


def _known(out: Path) -> dict[str, Any]:
    """What was converted into the folder before, by the name of each file."""
    try:
        known = json.loads((out / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    if not isinstance(known, dict):
        return {}
    return {name: each for name, each in known.items() if re.fullmatch(r"\d{6,}\.parquet", name)}
