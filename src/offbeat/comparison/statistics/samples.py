"""Checked samples, and records of outcomes and estimates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offbeat.errors import InputError

Sample: TypeAlias = NDArray[np.float64]

FEWEST = 3
"""Minimum number of runs per model, which Shapiro-Wilk needs."""


@dataclass(frozen=True)
class Outcome:
    """The outcome of a test.

    Attributes:
        name: of the test: `shapiro_wilk`, `welch_t`, ...
        statistic: W, t, F or chi-squared, depending on the test.
        p: two-sided p-value.
        df: degrees of freedom; empty where the test has none.
    """

    name: str
    statistic: float
    p: float
    df: tuple[float, ...] = ()


@dataclass(frozen=True)
class Estimate:
    """A number with an interval.

    Attributes:
        value: estimated.
        low: lower end of the interval; None where there are too few values.
        high: upper end; None where `low` is.
        confidence: level of the interval, from 0 to 1.
        method: how the interval was made: `bca_bootstrap`, `student_t` or `f`.
    """

    value: float
    low: float | None
    high: float | None
    confidence: float
    method: str


def sample(values: ArrayLike, name: str, *, at_least: int = FEWEST, vary: bool = True) -> Sample:
    """Checks one sample.

    Args:
        values: (runs,) one score per run.
        name: of the sample, for messages.
        at_least: minimum number of runs.
        vary: refuse values that are all equal.

    Returns:
        (runs,) float64.

    Raises:
        InputError: not a list of numbers, too few, not finite, or all equal.
    """
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name!r} must be a list of numbers: {error}") from None
    if array.ndim != 1:
        raise InputError(
            f"{name!r} must have one score per run, shape (runs,), got shape {array.shape}"
        )
    if len(array) < at_least:
        raise InputError(
            f"{name!r} has {len(array)} {'run' if len(array) == 1 else 'runs'}, a comparison needs "
            f"at least {at_least}; train more repeats, each with its own seed"
        )
    bad = ~np.isfinite(array)
    if bad.any():
        at = int(bad.argmax())
        raise InputError(
            f"{name!r} holds {array[at]} at place {at}; leave that run out of every model, or "
            "train it again"
        )
    if vary and equal(array):
        raise InputError(
            f"all {len(array)} values of {name!r} are equal ({array[0]:g}): there is no spread to "
            "test against; check that they are not copies of one run"
        )
    return array


def pairs(
    a: ArrayLike, b: ArrayLike, names: tuple[str, str], *, at_least: int = FEWEST
) -> tuple[Sample, Sample]:
    """Checks two samples whose runs are paired by position.

    Raises:
        InputError: as for `sample`, lengths that differ, or the same difference in every pair.
    """
    first = sample(a, names[0], at_least=at_least, vary=False)
    second = sample(b, names[1], at_least=at_least, vary=False)
    if len(first) != len(second):
        raise InputError(
            f"{names[0]!r} has {len(first)} runs and {names[1]!r} {len(second)}: a paired test "
            "needs both models in every repeat; give the repeats that both have"
        )
    differences = first - second
    if equal(differences, scale=max(np.abs(first).max(), np.abs(second).max())):
        raise InputError(
            f"{names[0]!r} and {names[1]!r} differ by the same {differences[0]:g} in all "
            f"{len(first)} pairs: there is no spread; check that they are different runs"
        )
    return first, second


def equal(array: Sample, *, scale: float | None = None) -> bool:
    """Whether values are equal up to rounding in float64."""
    scale = float(np.abs(array).max()) if scale is None else scale
    return bool(np.ptp(array) <= 8 * np.finfo(np.float64).eps * scale)


def check_level(name: str, value: float) -> float:
    """Returns a level such as alpha or a confidence.

    Raises:
        InputError: it is not strictly between 0 and 1.
    """
    if isinstance(value, bool) or not (isinstance(value, int | float) and 0 < value < 1):
        raise InputError(f"{name} must be between 0 and 1, got {value!r}; 0.05 means 5 %")
    return float(value)
