"""What gets lost on the way from a robot's sensors to its controller: frames, sensors, bursts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offbeat.errors import InputError


@dataclass(frozen=True)
class Drops:
    """How much is lost of the demonstrations that a policy is trained on, at most.

    Each window of each epoch has fractions of its own, uniform from 0 to these, so that a policy
    learns to act with any of them. The first frame of a window always arrives.

    Attributes:
        frames: fraction of the frames that are lost.
        sensors: fraction of the values of each sensor that are missing in the frames that are left.
        bursts: fraction of the time in outages, in which every frame is lost.
        burst_s: s, shortest and longest outage.
    """

    frames: float = 0.9
    sensors: float = 0.0
    bursts: float = 0.0
    burst_s: tuple[float, float] = (0.1, 0.5)

    def __post_init__(self) -> None:
        for name in ("frames", "sensors", "bursts"):
            check_fraction(name, getattr(self, name))
        object.__setattr__(self, "burst_s", check_seconds("burst_s", self.burst_s))

    @property
    def nothing(self) -> bool:
        """Whether nothing is lost."""
        return not (self.frames or self.sensors or self.bursts)

    def draw(
        self,
        times: NDArray[np.float64],
        random: np.random.Generator,
        *,
        channels: int,
        sensors: Sequence[Sequence[int]] | None = None,
    ) -> NDArray[np.bool_]:
        """Draws what arrives.

        Args:
            times: (windows, rows) s.
            random: that it is drawn from.
            channels: of an observation.
            sensors: positions of the channels of each sensor; by default each is one.

        Returns:
            (windows, rows, channels) True where the value arrives.
        """
        windows, rows = times.shape
        most = np.array([self.frames, self.sensors, self.bursts])
        frames, missing, bursts = (most * random.random((windows, 3))).T
        arrives = np.repeat(
            (random.random((windows, rows)) >= frames[:, None])[..., None], channels, axis=2
        )
        groups = [[i] for i in range(channels)] if sensors is None else sensors
        for group in groups if self.sensors else ():
            here = random.random((windows, rows)) >= missing[:, None]
            arrives[..., list(group)] &= here[..., None]
        for i, fraction in enumerate(bursts if self.bursts else ()):
            outages = Outages(float(fraction), self.burst_s)
            arrives[i, outages.within(times[i] - times[i, 0], random)] = False
        arrives[:, 0] = True
        return arrives


class Outages:
    """Outages of random lengths, with pauses whose lengths are exponential.

    Args:
        fraction: of the time in outages, 0 or more and less than 1.
        length_s: s, shortest and longest outage.

    Raises:
        InputError: an argument is out of its range.
    """

    def __init__(self, fraction: float, length_s: tuple[float, float]) -> None:
        self.fraction = check_fraction("bursts", fraction)
        self.low, self.high = check_seconds("burst_s", length_s)
        if self.fraction and not self.high > 0:
            raise InputError(f"burst_s must be longer than 0 s, got {length_s!r}")
        self.reset()

    def reset(self) -> None:
        """Begins at 0 s, without an outage."""
        self._begin = self._end = 0.0

    def at(self, time: float, random: np.random.Generator) -> bool:
        """Whether a time is in an outage.

        Args:
            time: s, not before the time of the last call.
            random: that outages are drawn from.
        """
        if not self.fraction:
            return False
        pause = (self.low + self.high) / 2 * (1 - self.fraction) / self.fraction
        while time >= self._end:
            self._begin = self._end + random.exponential(pause)
            self._end = self._begin + random.uniform(self.low, self.high)
        return bool(time >= self._begin)

    def within(self, times: NDArray[np.float64], random: np.random.Generator) -> NDArray[np.bool_]:
        """Which times are in an outage; draws what `at` draws for one after another.

        Args:
            times: (rows,) s, in order, not before the time of the last call.
            random: that outages are drawn from.

        Returns:
            (rows,) True in an outage.
        """
        begins, ends, last = [self._begin], [self._end], times.max(initial=-np.inf)
        while self.fraction and last >= self._end:
            self.at(self._end, random)
            begins.append(self._begin)
            ends.append(self._end)
        place = np.searchsorted(ends, times, side="right")
        return (place < len(ends)) & (times >= np.append(begins, np.inf)[place])


def check_fraction(name: str, value: float) -> float:
    """A fraction that is lost, checked.

    Args:
        name: of the argument.
        value: given.

    Raises:
        InputError: it is negative, 1 or more.
    """
    if not 0 <= value < 1:
        raise InputError(f"{name} must be a fraction of at least 0 and less than 1, got {value!r}")
    return float(value)


def check_seconds(name: str, value: float | Sequence[float]) -> tuple[float, float]:
    """A duration, or the shortest and the longest one, checked.

    Args:
        name: of the argument.
        value: given.

    Raises:
        InputError: one is negative or infinite, or the shortest is longer than the longest.
    """
    given = tuple(value) if isinstance(value, tuple | list) else (value, value)
    if len(given) != 2 or not 0 <= given[0] <= given[1] < math.inf:
        raise InputError(f"{name} must be seconds of at least 0, low before high, got {value!r}")
    return float(given[0]), float(given[1])
