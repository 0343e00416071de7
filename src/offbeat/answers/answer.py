"""`Answer`: a predicted trajectory with intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from offbeat.answers.intervals import HalfWidths, crps, half_width
from offbeat.baselines.tables import Place
from offbeat.data.trajectory import Trajectory
from offbeat.errors import InputError

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, repr=False)
class Answer(Trajectory):
    """A trajectory of predictions, with their intervals where they were fitted.

    Args:
        widths: half widths of intervals in units of an error, or None without intervals.
        place: (rows, channels) where each value is between the kinds of `widths`.
        unit: (rows, channels) unit of its error, in original units; 0 where it was observed.
        beyond: (rows, channels) bool, True where a prediction is for a longer time since
            observation than was trained and validated, or at the limit of the range of training.
    """

    widths: HalfWidths | None = None
    place: Place | None = None
    unit: Array | None = None
    beyond: NDArray[np.bool_] | None = None

    def __repr__(self) -> str:
        intervals = "without" if self.widths is None else "with"
        return f"{super().__repr__()[:-1]}, {intervals} intervals)"

    def half_width(self, level: float = 0.9) -> Array:
        """Half the width of the interval that holds the true value with a probability.

        Args:
            level: the probability, at most 0.98.

        Returns:
            (rows, channels) in original units; 0 where the value was observed.

        Raises:
            InputError: the level is out of range, or the answer has no intervals.
        """
        return half_width(self.half_widths(), level)

    def interval(self, level: float = 0.9) -> tuple[Array, Array]:
        """Lower and upper end of the interval that holds the true value with a probability.

        Args:
            level: the probability, at most 0.98.

        Returns:
            (rows, channels) each, in original units.

        Raises:
            InputError: the level is out of range, or the answer has no intervals.
        """
        half = self.half_width(level)
        return self.values - half, self.values + half

    def crps(self, truth: Array) -> Array:
        """(rows, channels) continuous ranked probability score, in original units.

        Args:
            truth: (rows, channels).
        """
        return crps(self.half_widths(), truth - self.values)

    def half_widths(self) -> Array:
        """(rows, channels, levels) half widths at every level of `intervals.LEVELS`.

        Raises:
            InputError: the answer has no intervals.
        """
        if self.widths is None or self.place is None or self.unit is None:
            raise InputError(
                "these predictions have no intervals: they are of a model alone; fit a blend "
                "(offbeat train, offbeat.fit_blend), whose answers have them"
            )
        return np.asarray(self.widths.at(self.place, self.unit))

    def slice(self, start: int, stop: int) -> Answer:
        """The rows from `start` up to, not including, `stop`."""
        return self.rows_at(np.arange(self.rows)[start:stop])

    def rows_at(self, rows: NDArray[np.int64]) -> Answer:
        """These rows, in increasing order."""
        return replace(
            self,
            times=self.times[rows],
            values=self.values[rows],
            observed=None if self.observed is None else self.observed[rows],
            place=None if self.place is None else self.place[rows],
            unit=None if self.unit is None else self.unit[rows],
            beyond=None if self.beyond is None else self.beyond[rows],
        )

    def given_back(self, constants: Mapping[int, float], copies: Mapping[int, int]) -> Answer:
        """As `Trajectory.given_back`: intervals of constants have no width, copies those of theirs.

        Args:
            constants: position of a channel, and its value.
            copies: position of a channel, and of the one that it is a copy of.
        """
        answer = super().given_back(constants, copies)
        assert isinstance(answer, Answer)
        source = np.arange(self.channels)
        for channel, of in copies.items():
            source[channel] = of
        still = np.isin(source, list(constants))
        widths = self.widths
        return replace(
            answer,
            widths=None if widths is None else replace(widths, table=widths.table[:, source]),
            place=None if self.place is None else self.place[:, source],
            unit=None if self.unit is None else np.where(still, 0.0, self.unit[:, source]),
            beyond=None if self.beyond is None else self.beyond[:, source] & ~still,
        )

    def select(self, index: Sequence[int]) -> Answer:
        """The channels at these positions, in this order."""
        order = list(index)
        widths = self.widths
        return replace(
            self,
            values=self.values[:, order],
            observed=None if self.observed is None else self.observed[:, order],
            names=tuple(self.names[i] for i in order),
            units=tuple(self.units[i] for i in order),
            roles=tuple(self.roles[i] for i in order),
            widths=None if widths is None else replace(widths, table=widths.table[:, order]),
            place=None if self.place is None else self.place[:, order],
            unit=None if self.unit is None else self.unit[:, order],
            beyond=None if self.beyond is None else self.beyond[:, order],
        )
