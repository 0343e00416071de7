"""Rows that Offbeat wrote as JSON in MCAP: a recording per topic."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from offbeat.data.readers.ros_files import Bag
from offbeat.data.signals import Recording, Signal
from offbeat.errors import FileFormatError

KIND = "offbeat.Row"
"""The schema of such rows; see `offbeat.data.writers.mcap`."""


def recordings(bag: Bag, path: Path) -> Iterator[Recording]:
    """Yields the rows of each topic; masks and intervals are left out.

    Args:
        bag: open, with topics of rows alone.
        path: for messages.

    Raises:
        FileFormatError: a row or its schema is damaged.
    """
    for connection in bag.connections:
        stamps, rows = [], []
        try:
            schema = json.loads(connection.definition)
            names = [str(name) for name in schema["x-names"]]
            units = tuple(str(unit) for unit in schema["x-units"])
            roles = tuple(str(role) for role in schema["x-roles"])
            for _, stamp, message in bag.messages({connection.id}):
                values = json.loads(message)["values"]
                rows.append([float("nan" if values[n] is None else values[n]) for n in names])
                stamps.append(stamp)
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            raise FileFormatError(
                f"{path}: a row of topic {connection.topic} is damaged "
                f"({type(error).__name__}: {str(error)[:100]}); write it again"
            ) from None
        signal = Signal(
            "",
            np.array(stamps, dtype=np.int64),
            np.array(rows, dtype=np.float64).reshape(len(rows), len(names)),
            tuple(names),
            units,
            roles=roles,
        )
        yield Recording(
            (signal,),
            label=connection.topic.rpartition("/")[2] if len(bag.connections) > 1 else "",
            origin=f"{path.name}, {connection.topic}",
            time_unit="ns",
            notes=("masks and intervals are left out",),
        )
