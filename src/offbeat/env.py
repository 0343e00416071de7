"""Robots of Gymnasium whose observations are late, incomplete or missing.

This module needs `offbeat[robots]`; nothing else of Offbeat does.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.drops import Outages, check_fraction, check_seconds
from offbeat.errors import InputError, require

gymnasium: Any = require("gymnasium", "robots")


@dataclass(frozen=True, eq=False)
class _Frame:
    """A measurement on its way.

    Attributes:
        arrives: s, when it reaches the controller.
        stamp: s, when it says that it was measured.
        values: (channels,).
        mask: (channels,) True where a sensor reported.
    """

    arrives: float
    stamp: float
    values: NDArray[np.float64]
    mask: NDArray[np.bool_]


class UnevenObservations(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):  # type: ignore[misc]
    """Drops frames, sensors and bursts of frames, delays what is left, and jitters its stamps.

    An observation is a dictionary:

    - `now` (1,) float64, s since the reset: the time at which an action is asked for.
    - `time` (1,) float64, s: the stamp of the values; `now` where there are none.
    - `values` (channels,): the newest frame that has arrived, each frame once; where a channel was
      not measured 0, or the bound of the space nearest to it.
    - `mask` (channels,) int8: 1 where measured. All are 0 where no new frame has arrived.

    The first frame of an episode arrives whole and at once. The true observation is
    `info["observation"]`. All that is random follows from the seed of `reset`.

    Args:
        env: with a `Box` of observations; an array of several dimensions is flattened.
        drop: probability that a frame is lost.
        sensor_drop: probability that a sensor is missing in a frame, each on its own.
        sensors: positions of the channels of each sensor; by default every channel is a sensor.
            Channels of no sensor are never missing.
        bursts: fraction of the time in outages, in which every frame is lost.
        burst_s: s, shortest and longest outage.
        delay_s: s from a measurement to its arrival, or the shortest and the longest such time. A
            frame that a newer one overtakes is lost.
        jitter_s: s, largest error of a stamp, less than half a step; no stamp is later than the
            arrival.
        dt: s per step; by default what the environment says (`dt` or `tau`).

    Raises:
        InputError: an argument is out of its range, the observations are no `Box`, or the time
            step is not known.

    Example:
        >>> env = UnevenObservations(gymnasium.make("Pendulum-v1"), drop=0.7)  # doctest: +SKIP
        >>> observation, info = env.reset(seed=0)  # doctest: +SKIP
    """

    def __init__(
        self,
        env: Any,
        *,
        drop: float = 0.0,
        sensor_drop: float = 0.0,
        sensors: Sequence[Sequence[int]] | None = None,
        bursts: float = 0.0,
        burst_s: tuple[float, float] = (0.1, 0.5),
        delay_s: float | tuple[float, float] = 0.0,
        jitter_s: float = 0.0,
        dt: float | None = None,
    ) -> None:
        gymnasium.utils.RecordConstructorArgs.__init__(
            self,
            drop=drop,
            sensor_drop=sensor_drop,
            sensors=sensors,
            bursts=bursts,
            burst_s=burst_s,
            delay_s=delay_s,
            jitter_s=jitter_s,
            dt=dt,
        )
        gymnasium.Wrapper.__init__(self, env)
        space = env.observation_space
        if not isinstance(space, gymnasium.spaces.Box):
            raise InputError(
                f"observations must be a Box, got {space}; wrap the environment with "
                "gymnasium.wrappers.FlattenObservation first"
            )
        self.dt = time_step(env) if dt is None else check_seconds("dt", dt)[0]
        if self.dt <= 0:
            raise InputError(f"dt must be positive, got {dt!r}")
        self._drop = check_fraction("drop", drop)
        self._sensor_drop = check_fraction("sensor_drop", sensor_drop)
        self._outages = Outages(bursts, burst_s)
        self._delay = check_seconds("delay_s", delay_s)
        self._jitter = check_seconds("jitter_s", jitter_s)[0]
        if not self._jitter < self.dt / 2:
            raise InputError(
                f"jitter_s must be less than half a step of {self.dt:g} s, so that stamps stay in "
                f"order, got {jitter_s!r}"
            )
        low, high = space.low.reshape(-1), space.high.reshape(-1)
        self._sensors = _groups(sensors, len(low))
        self._missing = np.clip(np.zeros_like(low), low, high)
        box = gymnasium.spaces.Box
        self.observation_space = gymnasium.spaces.Dict(
            {
                "now": box(0.0, np.inf, (1,), np.float64),
                "time": box(0.0, np.inf, (1,), np.float64),
                "values": box(low, high, dtype=space.dtype),
                "mask": gymnasium.spaces.MultiBinary(len(low)),
            }
        )
        self._random = np.random.default_rng()
        self._coming: deque[_Frame] = deque()
        self._steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Begins an episode.

        Args:
            seed: of the environment, and of all that is lost or late.
            options: of the environment.
        """
        if seed is not None:
            self._random = np.random.default_rng([seed, 0x0FFBEA7])
        observation, info = self.env.reset(seed=seed, options=options)
        self._coming.clear()
        self._steps = 0
        self._outages.reset()
        values = np.array(observation).reshape(-1)
        whole = _Frame(0.0, 0.0, values, np.ones(len(values), dtype=bool))
        return self._observed(whole), {**info, "observation": values.copy()}

    def step(self, action: Any) -> tuple[dict[str, NDArray[Any]], Any, bool, bool, dict[str, Any]]:
        """Acts for a step, and observes what has arrived by then.

        Args:
            action: as of the environment.
        """
        observation, reward, ended, cut, info = self.env.step(action)
        self._steps += 1
        now, values = self._steps * self.dt, np.array(observation).reshape(-1)
        frame = self._sent(now, values)
        if frame is not None:
            self._coming.append(frame)
        return (
            self._observed(self._arrived(now)),
            reward,
            ended,
            cut,
            {**info, "observation": values.copy()},
        )

    def _sent(self, now: float, values: NDArray[Any]) -> _Frame | None:
        """The frame that is measured now, None where it is lost.

        The same numbers are drawn for every frame, so that a seed means the same at any setting.
        """
        lost, delay, jitter = self._random.random(3)
        missing = self._random.random(len(self._sensors)) < self._sensor_drop
        out = self._outages.at(now, self._random)
        mask: NDArray[np.bool_] = ~(missing @ self._sensors)
        if out or lost < self._drop or not mask.any():
            return None
        low, high = self._delay
        arrives = now + low + (high - low) * delay
        stamp = min(now + self._jitter * (2 * jitter - 1), arrives)
        return _Frame(arrives, stamp, values, mask)

    def _arrived(self, now: float) -> _Frame | None:
        """The newest frame that has arrived; older ones are overtaken."""
        within = now + 1e-9 * self.dt
        newest = max((i for i, f in enumerate(self._coming) if f.arrives <= within), default=None)
        if newest is None:
            return None
        for _ in range(newest):
            self._coming.popleft()
        return self._coming.popleft()

    def _observed(self, frame: _Frame | None) -> dict[str, NDArray[Any]]:
        now = np.array([self._steps * self.dt])
        if frame is None:
            mask = np.zeros(len(self._missing), dtype=np.int8)
            return {"now": now, "time": now.copy(), "values": self._missing.copy(), "mask": mask}
        return {
            "now": now,
            "time": np.array([frame.stamp]),
            "values": np.where(frame.mask, frame.values, self._missing),
            "mask": frame.mask.astype(np.int8),
        }


def time_step(env: Any) -> float:
    """Length of a step of an environment, in s.

    Args:
        env: that has `dt`, as of MuJoCo and Pendulum, or `tau`, as of CartPole.

    Raises:
        InputError: it has neither.
    """
    for name in ("dt", "tau"):
        value = getattr(env.unwrapped, name, None)
        if isinstance(value, int | float) and 0 < value < math.inf:
            return float(value)
    raise InputError(f"{name_of(env)} does not say how long a step is; give dt, in seconds")


def name_of(env: Any) -> str:
    """An environment in a message: the name that it was made by, where it has one."""
    return str(env.unwrapped.spec.id if env.unwrapped.spec else env.unwrapped)


def _groups(sensors: Sequence[Sequence[int]] | None, channels: int) -> NDArray[np.bool_]:
    """(sensors, channels) which channels each sensor measures."""
    groups = [[i] for i in range(channels)] if sensors is None else [list(s) for s in sensors]
    measures = np.zeros((len(groups), channels), dtype=bool)
    for row, group in zip(measures, groups, strict=True):
        for channel in group:
            if not 0 <= channel < channels:
                raise InputError(
                    f"sensors must be positions of channels, 0 to {channels - 1}, got {channel!r}"
                )
            row[channel] = True
    return measures
