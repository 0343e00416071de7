"""The files that commands write answers to: tables, or any format that data sets are written in."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from offbeat.cli.common import answer_columns
from offbeat.data.trajectory import Dataset
from offbeat.errors import InputError

TABLES = (".csv", ".parquet", ".pq")
"""Suffixes of tables, which have columns for masks and intervals."""


def is_table(out: Path, format: str | None) -> bool:
    """Whether answers are written as a table.

    Args:
        out: the file.
        format: as given.
    """
    return format in ("csv", "table") or (format is None and out.suffix.lower() in TABLES)


def check_answers(out: Path, data: Path, format: str | None) -> None:
    """Checks what is to be written before anything is computed.

    Raises:
        InputError: the format or the suffix is unknown, `out` is the data itself or inside it, or
            it can't be written.
    """
    from offbeat.data.writers import writer_of
    from offbeat.errors import one_of
    from offbeat.files import writable

    if out.exists() and data.exists() and out.samefile(data):
        raise InputError(f"{out} is the data set itself; give another file")
    if is_table(out, format):
        one_of("suffix of out", out.suffix.lower(), TABLES)
        writable(out)
    else:
        writable(out, folder=writer_of(out, format).is_folder)


def write_answers(
    out: Path,
    dataset: Dataset,
    answers: Dataset,
    *,
    format: str | None = None,
    data: Path | None = None,
    rate_hz: float | None = None,
) -> str:
    """Writes answers; returns the name of the format.

    Args:
        out: the file or folder.
        dataset: as it was read; its labels and its clock are restored.
        answers: one trajectory per trajectory of the data set.
        format: of `offbeat.data.writers`; by default found by the suffix. `.csv` and `.parquet` are
            tables.
        data: the log, whose messages MCAP repeats.
        rate_hz: rows per second, for formats that state one.
    """
    from offbeat.data.writers import save, writer_of
    from offbeat.data.writers.tables import write_table

    if is_table(out, format):
        write_table(out, answer_columns(dataset, answers))
        return format or ("csv" if out.suffix.lower() == ".csv" else "parquet")
    writer = writer_of(out, format)
    given: dict[str, Any] = {"log": data, "rate_hz": rate_hz}
    options = {k: v for k, v in given.items() if k in writer.options and v is not None}
    save(answers, out, format=writer.name, **options)
    return writer.name
