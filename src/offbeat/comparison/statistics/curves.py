"""How fast training converges, measured on validation curves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offbeat.comparison.statistics.bootstrap import bca
from offbeat.comparison.statistics.samples import Estimate, check_level
from offbeat.errors import InputError

_TREND_OVER = 10


@dataclass(frozen=True)
class Settling:
    """When a validation curve comes near its final value. Epochs count from 1.

    Attributes:
        epochs: length of the curve.
        final: value at the end.
        lowest: lowest value of the curve.
        lowest_epoch: its epoch.
        reached: first epoch at most `tolerance` above the final value.
        settled: epoch from which on it stays within `tolerance`.
        trend: relative change per epoch over the last 10 epochs, by a line through the logarithms:
            -0.015 says that the error still falls by 1.5 % per epoch, so that the final value is
            not where training would end. NaN for curves of fewer than 3 epochs.
        roughness: standard deviation of the logarithm from one epoch to the next, over the second
            half: how much the curve jumps. NaN for curves of fewer than 6 epochs.
        tolerance: relative, above the final value.
    """

    epochs: int
    final: float
    lowest: float
    lowest_epoch: int
    reached: int
    settled: int
    trend: float
    roughness: float
    tolerance: float


def settling(mse: ArrayLike, *, tolerance: float = 0.05, final_over: int = 1) -> Settling:
    """Measures when a validation curve comes near its final value.

    Args:
        mse: (epochs,) validation error after each epoch, every epoch from the first.
        tolerance: relative distance above the final value that counts as near.
        final_over: number of last epochs whose mean is the final value. With more than 1 the last
            epochs may be above the tolerance; the curve then settles at its end.

    Raises:
        InputError: an empty curve, values that are not positive and finite, or options out of
            range.
    """
    check_level("tolerance", tolerance)
    curve = _curve(mse, "the curve")
    count = len(curve)
    if not isinstance(final_over, int) or not 1 <= final_over <= count:
        raise InputError(
            f"final_over must be an integer from 1 to the {count} epochs of the curve, "
            f"got {final_over!r}"
        )
    final = float(curve[-final_over:].mean())
    near = curve <= (1 + tolerance) * final
    reached = int(near.argmax()) + 1
    away = np.flatnonzero(~near)
    settled = min(int(away[-1]) + 2, count) if len(away) else 1
    logs = np.log(curve)
    last = logs[-_TREND_OVER:]
    steps = np.diff(logs[count // 2 :])
    return Settling(
        count,
        final,
        float(curve.min()),
        int(curve.argmin()) + 1,
        reached,
        settled,
        float(np.expm1(np.polyfit(np.arange(len(last)), last, 1)[0])) if len(last) > 2 else np.nan,
        float(steps.std(ddof=1)) if len(steps) > 1 and count > 5 else np.nan,
        tolerance,
    )


@dataclass(frozen=True)
class Convergence:
    """The settling of several runs of one model.

    Attributes:
        curves: of each run.
        settled: mean epoch at which a run has settled, with a BCa bootstrap interval over runs.
        reached: mean of the first epoch at which a run is near its final value, with interval.
        median: of `settled` over runs.
    """

    curves: tuple[Settling, ...]
    settled: Estimate
    reached: Estimate
    median: float


def convergence(
    curves: Sequence[ArrayLike],
    *,
    tolerance: float = 0.05,
    final_over: int = 1,
    confidence: float = 0.95,
    resamples: int = 9999,
    seed: int = 0,
) -> Convergence:
    """Measures when the validation curves of several runs come near their final values.

    To compare two models, pass the epochs of both to `paired_comparison`.

    Args:
        curves: one or more, each (epochs,); with fewer than 5 there are no intervals.
        tolerance: as for `settling`.
        final_over: as for `settling`.
        confidence: of the intervals.
        resamples: of the bootstrap over runs.
        seed: of the bootstrap.

    Raises:
        InputError: no curve, or one that cannot be measured.
    """
    if not len(curves):
        raise InputError("got no curves; give at least one validation curve")
    each = tuple(settling(c, tolerance=tolerance, final_over=final_over) for c in curves)

    def mean_of(epochs: list[int]) -> Estimate:
        return bca(
            lambda x: np.asarray(x.mean(axis=-1)),
            np.array(epochs, dtype=np.float64),
            confidence=confidence,
            resamples=resamples,
            seed=seed,
        )

    settled = [one.settled for one in each]
    return Convergence(
        each, mean_of(settled), mean_of([one.reached for one in each]), float(np.median(settled))
    )


@dataclass(frozen=True)
class Enough:
    """Whether a number of epochs is enough, by curves of longer trainings.

    Attributes:
        chosen: number of epochs that was chosen.
        tolerance: relative distance above the final value that counts as enough.
        ratios: per curve, error after the chosen epochs over the final error.
        settled: per curve, the epoch from which on it is within the tolerance.
        enough: per curve, whether it settles by the chosen epoch.
    """

    chosen: int
    tolerance: float
    ratios: tuple[float, ...]
    settled: tuple[int, ...]
    enough: tuple[bool, ...]

    @property
    def follows(self) -> bool:
        """Whether every curve settles by the chosen epoch."""
        return all(self.enough)

    @property
    def needed(self) -> int:
        """Number of epochs after which every curve has settled."""
        return max(self.settled)


def enough_epochs(
    curves: Sequence[ArrayLike], chosen: int, *, tolerance: float = 0.05, final_over: int = 1
) -> Enough:
    """Measures whether a number of epochs is enough, by longer trainings.

    Args:
        curves: one or more, each (epochs,) and longer than `chosen`.
        chosen: number of epochs to check.
        tolerance: as for `settling`.
        final_over: as for `settling`.

    Raises:
        InputError: no curve, or one that ends before the chosen epoch.
    """
    if not len(curves):
        raise InputError("got no curves; give at least one validation curve")
    checked = [_curve(curve, f"curve {i}") for i, curve in enumerate(curves)]
    shortest = min(len(curve) for curve in checked)
    if not isinstance(chosen, int) or not 1 <= chosen < shortest:
        raise InputError(
            f"the chosen number of epochs must be below the {shortest} of the shortest curve, got "
            f"{chosen!r}; a curve shows only beyond that epoch whether it was enough"
        )
    each = [settling(c, tolerance=tolerance, final_over=final_over) for c in checked]
    return Enough(
        chosen,
        tolerance,
        tuple(
            float(curve[chosen - 1]) / one.final for curve, one in zip(checked, each, strict=True)
        ),
        tuple(one.settled for one in each),
        tuple(one.settled <= chosen for one in each),
    )


def _curve(mse: ArrayLike, name: str) -> NDArray[np.float64]:
    curve = np.asarray(mse, dtype=np.float64)
    if curve.ndim != 1 or not len(curve):
        raise InputError(f"{name} must have one error per epoch, got shape {curve.shape}")
    bad = ~(np.isfinite(curve) & (curve > 0))
    if bad.any():
        at = int(bad.argmax())
        raise InputError(
            f"{name} holds {curve[at]} after epoch {at + 1}, expected positive errors; a run that "
            "diverged does not converge, leave it out"
        )
    return curve
