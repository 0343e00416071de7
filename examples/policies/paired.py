"""Is one policy better than its rivals? Paired tests of the returns of two policies.

Trainings of one seed are pairs: they have the same demonstrations, windows and losses, and are
tested on the same episodes. A training is one value, the interquartile mean of its episodes, so
that the number of pairs is that of the trainings.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import trim_mean

from offbeat.comparison.statistics import PairedComparison, holm, paired_comparison

from .scores import by_seed, resampled

FEWEST = 3
"""Pairs that a test needs."""


@dataclass(frozen=True)
class Difference:
    """A policy against a rival.

    Attributes:
        rival: its name.
        pairs: number of trainings of both.
        difference: of the interquartile means over all trainings and episodes, in percent of the
            expert; above 0 the policy is better.
        interval: 95 %, of the stratified bootstrap over trainings; pairs are drawn together.
        ahead: number of trainings in which the policy is better.
        test: the paired comparison of the trainings; None with fewer than 3, or where all pairs
            differ by the same.
    """

    rival: str
    pairs: int
    difference: float
    interval: tuple[float, float]
    ahead: int
    test: PairedComparison | None


def differences(
    folder: Path, training: str, condition: str, *, policy: str = "anchored"
) -> list[Difference]:
    """A policy against every other one that was trained with some of the same seeds.

    Args:
        folder: of the results of a robot.
        training: name of what training loses.
        condition: name of what the test loses.
        policy: its name.
    """
    scores = by_seed(folder, training, condition)
    own = scores.pop(policy, {})
    found = []
    for rival, other in scores.items():
        seeds = sorted(own.keys() & other.keys())
        if seeds:
            first, second = (np.array([each[seed] for seed in seeds]) for each in (own, other))
            found.append(_difference(rival, first, second))
    return found


def _difference(rival: str, a: NDArray[np.float64], b: NDArray[np.float64]) -> Difference:
    """From the scores of two policies, (trainings, episodes) each."""
    drawn = resampled(a) - resampled(b)  # of one seed, so that pairs are drawn together
    low, high = np.quantile(drawn, [0.025, 0.975])
    means = [trim_mean(each, 0.25, axis=1) for each in (a, b)]
    change = means[0] - means[1]
    test = None
    if len(a) >= FEWEST and np.ptp(change) > 0:
        test = paired_comparison(*means, names=("policy", rival))
    total = float(trim_mean(a.ravel(), 0.25) - trim_mean(b.ravel(), 0.25))
    return Difference(
        rival, len(a), total, (float(low), float(high)), int((change > 0).sum()), test
    )


def table(folder: Path, training: str, condition: str) -> str:
    """A Markdown table of `differences`.

    Args:
        folder: of the results of a robot.
        training: name of what training loses.
        condition: name of what the test loses.
    """
    found = differences(folder, training, condition)
    p_values = [each.test.paired_t.p for each in found if each.test is not None]
    corrected = iter(holm(p_values) if p_values else ())
    lines = [
        f"| anchored, {condition} lost, minus | difference | 95 %, bootstrap | 95 %, Student "
        "| p, paired t | p, Holm | p, Wilcoxon | ahead |",
        "|---" * 8 + "|",
    ]
    for each in found:
        low, high = each.interval
        drawn = _interval(low, high) if each.pairs > 1 else ""
        start = f"| {each.rival} | {_number(each.difference)} | {drawn} | "
        end = f" | {each.ahead} of {each.pairs} |"
        if each.test is None:
            lines.append(f"{start}| | |{end}")
            continue
        t, p = each.test.difference_t, each.test.paired_t.p
        lines.append(
            f"{start}{_interval(t.low, t.high)} | {p:.2g} | {next(corrected):.2g} | "
            f"{each.test.wilcoxon.p:.2g}{end}"
        )
    return "\n".join(lines)


def _interval(low: float | None, high: float | None) -> str:
    assert low is not None
    assert high is not None
    return f"{_number(low)} to {_number(high)}"


def _number(value: float) -> str:
    """To one decimal, 0 without a sign."""
    return f"{round(value, 1) + 0.0:.1f}"
