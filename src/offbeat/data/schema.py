"""The schema of a stored data set, kept in the metadata of its table."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from offbeat.data.cleaning.log import upgraded
from offbeat.data.trajectory import Dataset
from offbeat.errors import FileFormatError, InputError

SCHEMA_VERSION = 2
"""Increased when earlier versions would misread new files.

Version 1, of Offbeat 0.1.0, has no roles, and columns of actions (`action|0`, ...) besides those of
the channels; when it is read, they become channels with the role `action`.
"""

METADATA_KEY = b"offbeat"
"""The key of the schema, which is JSON, in the metadata of a Parquet file."""

CHECKSUM_KEY = b"offbeat_crc32"
"""The key of its checksum, in decimal: Parquet has checksums for data, and none for metadata."""


@dataclass(frozen=True)
class Schema:
    """The columns of a stored data set, its counts, and its metadata.

    Args:
        version: of the schema.
        rows: rows of all trajectories together.
        trajectories: their number.
        names: one per channel.
        units: one per channel.
        roles: one per channel.
        observed: the channels in which observed and known differ, which have a column of their own.
        origins: one per trajectory.
        meta: of the data set.
        stored_as: one column name per channel.
    """

    version: int
    rows: int
    trajectories: int
    names: list[str]
    units: list[str]
    roles: list[str]
    observed: list[str]
    origins: list[str]
    meta: dict[str, Any]
    stored_as: list[str]

    @classmethod
    def of(cls, dataset: Dataset) -> Schema:
        """The schema of a data set to write.

        Raises:
            InputError: a channel has the name of another column.
        """
        differs = np.zeros(dataset.channels, dtype=bool)
        for t in dataset:
            differs |= (t.observed != t.known).any(axis=0)
        schema = cls(
            version=SCHEMA_VERSION,
            rows=sum(t.rows for t in dataset),
            trajectories=len(dataset),
            names=list(dataset.names),
            units=list(dataset.units),
            roles=list(dataset.roles),
            observed=[name for name, yes in zip(dataset.names, differs, strict=True) if yes],
            origins=[t.origin for t in dataset],
            meta=dict(dataset.meta),
            stored_as=list(dataset.names),
        )
        columns = schema.columns
        if len(set(columns)) < len(columns):
            twice = next(name for name in columns if columns.count(name) > 1)
            raise InputError(
                f"a channel is called {twice!r}, which the file needs for a column of its own; "
                "rename the channel"
            )
        return schema

    @classmethod
    def from_metadata(cls, metadata: Mapping[bytes, bytes] | None, path: Path) -> Schema:
        """The schema of a file.

        Raises:
            FileFormatError: there is none, it is damaged, or of a later version.
        """
        metadata = metadata or {}
        text = metadata.get(METADATA_KEY)
        if text is None:
            raise FileFormatError(
                f"{path} is Parquet, but no data set of Offbeat (no key {METADATA_KEY.decode()!r} "
                "in its metadata); make one with Trajectory.from_arrays, Dataset and save"
            )
        try:
            if metadata.get(CHECKSUM_KEY, _checksum(text)) != _checksum(text):
                raise ValueError("its checksum does not match")
            fields = dict(json.loads(text))
            version = fields["version"]
            if version == 1:
                fields = _upgraded(fields)
            schema = None if version > SCHEMA_VERSION else cls(**fields)
        except (KeyError, TypeError, ValueError) as error:
            raise FileFormatError(
                f"{path} has a damaged schema in its metadata ({type(error).__name__}: {error}); "
                "copy it again, or write it with save"
            ) from None
        if schema is None:
            raise FileFormatError(
                f"{path} has version {version} of the schema, this Offbeat reads up to "
                f"{SCHEMA_VERSION}; install a later one with: pip install --upgrade offbeat"
            )
        return schema

    def to_metadata(self) -> dict[bytes, bytes]:
        """Metadata that `from_metadata` reads.

        Raises:
            InputError: `meta` cannot be restored exactly.
        """
        try:
            text = json.dumps(asdict(self), allow_nan=False)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"meta of a data set must be JSON-like to be saved ({error}); "
                "keep to strings, finite numbers, booleans, None, lists and dicts"
            ) from None
        if json.loads(text)["meta"] != self.meta:
            raise InputError(
                "meta of a data set cannot be restored exactly from a file; "
                "use lists, not tuples, and strings as keys"
            )
        return {METADATA_KEY: text.encode(), CHECKSUM_KEY: _checksum(text.encode())}

    @property
    def columns(self) -> list[str]:
        """Names of all columns."""
        return ["trajectory", "time", *self.stored_as, *self.observed_columns]

    @property
    def observed_columns(self) -> list[str]:
        """Names of the columns of observed values, in the order of `observed`."""
        return [f"{name}|observed" for name in self.observed]

    def to_arrow(self) -> Any:
        """The columns with their types, as a `pyarrow.Schema`."""
        import pyarrow as pa

        types = {"trajectory": pa.int32()} | dict.fromkeys(self.observed_columns, pa.bool_())
        return pa.schema([pa.field(name, types.get(name, pa.float64())) for name in self.columns])

    def check_columns(self, arrow: Any, path: Path) -> None:
        """Checks the columns of a file, a `pyarrow.Schema`.

        Raises:
            FileFormatError: names or types differ.
        """
        expected = [f"{field.name} ({field.type})" for field in self.to_arrow()]
        got = [f"{field.name} ({field.type})" for field in arrow]
        if sorted(got) != sorted(expected):
            missing = ", ".join(sorted(set(expected) - set(got))) or "none"
            unexpected = ", ".join(sorted(set(got) - set(expected))) or "none"
            raise FileFormatError(
                f"{path} has other columns than its schema says: missing {missing}, unexpected "
                f"{unexpected}; it was changed after it was written, write it with save"
            )


def _upgraded(fields: dict[str, Any]) -> dict[str, Any]:
    """Converts the schema of version 1 to version 2."""
    fields = dict(fields)
    names, meta = list(fields["names"]), dict(fields["meta"])
    count = fields.pop("actions") or 0
    columns = [f"action|{i}" for i in range(count)]
    called = meta.pop("actions", [])
    if isinstance(meta.get("report"), dict) and "held" in meta["report"]:
        meta["cleaning"] = upgraded(meta.pop("report"))
    if len(called) != count or set(called) & set(names):
        called = [f"action[{i}]" for i in range(count)]
    return fields | {
        "names": [*names, *called],
        "units": [*fields["units"], *[""] * count],
        "roles": ["state"] * len(names) + ["action"] * count,
        "meta": meta,
        "stored_as": [*names, *columns],
    }


def _checksum(text: bytes) -> bytes:
    return str(zlib.crc32(text)).encode()
