"""A folder of logs, read file by file into a data set that need not fit in memory."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from offbeat.data.readers import files_of, read
from offbeat.data.shards import ShardedDataset
from offbeat.data.store import save
from offbeat.errors import FileFormatError, printable
from offbeat.files import write_json

MANIFEST = "converted.json"
"""What each file of the folder was converted from, and with which options."""


def convert(folder: str | Path, out: str | Path, **options: Any) -> ShardedDataset:
    """Reads each log of a folder alone, writes it as a data set, and opens what was written.

    Each file holds whole episodes: sensors in files of their own are not merged. What was converted
    already, by the same options and from a file that did not change since, is kept.

    Args:
        folder: with logs of one format.
        out: folder for the data sets, in the format of Offbeat; made if it is missing.
        **options: of `offbeat.read`.

    Raises:
        FileFormatError: there is no log in the folder, a file can't be read, or channels differ
            between files.
        InputError: as of `read`.
    """
    folder, out = Path(folder), Path(out)
    paths = files_of(folder, options.get("format"))
    if not paths:
        raise FileFormatError(f"{folder} holds no files that are read one by one, as tables are")
    out.mkdir(parents=True, exist_ok=True)
    try:
        known = json.loads((out / MANIFEST).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        known = {}
    made: dict[str, Any] = {}
    copies: list[Path] = []
    for i, path in enumerate(paths):
        copy, status = out / f"{i:06d}.parquet", path.stat()
        stamp = [path.name, status.st_size, status.st_mtime_ns, json.dumps(options, default=str)]
        if not copy.exists() or known.get(copy.name) != stamp:
            save(read(path, **options), copy)
        made[copy.name] = stamp
        write_json(out / MANIFEST, {**known, **made})
        copies.append(copy)
    try:
        return ShardedDataset.of_files(copies)
    except FileFormatError as error:
        said = str(error)
        for copy, path in zip(copies, paths, strict=True):
            said = said.replace(str(copy), printable(str(path)))
        raise FileFormatError(said) from None
