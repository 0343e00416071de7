"""The options that say what the columns of a table mean, and usual names of columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from offbeat.data.cleaning.clocks import split_unit
from offbeat.data.cleaning.options import is_number
from offbeat.data.readers.options import names as names_of
from offbeat.errors import InputError, one_of

LABEL_NAMES = (
    *("trajectory", "episode", "episode_index", "demo", "trajectory_id", "episode_id", "demo_id"),
    *("traj", "traj_id", "trial", "trial_id", "rollout"),
)
"""Names of trajectory columns, in any case."""

KEY_NAMES = (
    *("channel", "variable", "signal", "sensor", "name", "key", "topic", "field", "device"),
    *("joint", "joint_name", "sensor_name", "motor", "link", "marker", "node", "metric"),
)
VALUE_NAMES = ("value", "val", "data", "reading")
"""Names of the two columns of long tables besides the time, in any case."""

UNIT_NAMES = ("unit", "units", "uom")
"""Names of the column with the unit of each value in a long table, in any case."""

INSTANCE_NAMES = ("i", "instance", "multi_id", "imu", "id", "index", "motor", "joint", "sensor")
"""Names of columns with the number of the sensor of a row, in any case."""


class Sample(Protocol):
    """The first values of the columns of a table, from which their meaning is found."""

    def is_text(self, name: str) -> bool:
        """Whether a column holds texts, and not numbers or booleans."""

    def numbers(self, name: str) -> NDArray[np.float64]:
        """The first numbers of a column, NaN where there is none; empty for texts."""

    def texts(self, name: str) -> list[str]:
        """The first values of a column, as texts."""


@dataclass(frozen=True)
class TableOptions:
    """The options that say what the columns of a table mean; see `read_csv`."""

    time_column: str | Sequence[str] | None = None
    trajectory_column: str | None = None
    channels: Sequence[str] | None = None
    without: Sequence[str] = ()
    units: Mapping[str, str] | None = None
    channel_column: str | None = None
    value_column: str | None = None
    instance_column: str | None = None
    rate_hz: float | None = None
    day_first: bool | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "channels", names_of("channels", self.channels))
        object.__setattr__(self, "without", names_of("without", self.without or None) or ())
        for name in ("trajectory_column", "channel_column", "value_column", "instance_column"):
            given = getattr(self, name)
            if not (given is None or isinstance(given, str)):
                raise InputError(f"{name} must be the name of a column, got {given!r}")
        units = self.units or {}
        if not isinstance(units, Mapping) or not all(
            isinstance(text, str) for pair in units.items() for text in pair
        ):
            raise InputError(f"units must map names of channels to units, got {units!r}")
        rate = self.rate_hz
        if rate is not None and not (is_number(rate) and 0 < rate <= 1e9):
            raise InputError(f"rate_hz must be rows per second, above 0, got {rate!r}")


def column_named(name: str, columns: list[str], what: str) -> str:
    """A column by its name, with or without its unit."""
    if name in columns:
        return name
    short = {split_unit(column)[0]: column for column in reversed(columns)}
    return short[name] if name in short else one_of(f"{what}_column", name, columns)


def first_known(texts: Sequence[str]) -> str:
    """The first text that is not empty; empty if there is none."""
    return next((text for text in texts if text), "")
