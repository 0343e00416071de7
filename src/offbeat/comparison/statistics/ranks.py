"""Tests of more than two models: Friedman's test and Nemenyi's critical difference.

Demsar, Statistical Comparisons of Classifiers over Multiple Data Sets, JMLR 7 (2006) 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from offbeat.comparison.statistics.samples import Outcome, check_level, sample
from offbeat.errors import InputError


@dataclass(frozen=True)
class FriedmanResult:
    """Ranks of models over blocks, rank 1 to the lowest score of a block.

    Attributes:
        names: of the models, as given.
        blocks: repeats (or data sets) in which each model was scored.
        average_ranks: per model; ties share their mean rank.
        friedman: chi-squared, corrected for ties, with k - 1 degrees of freedom.
        iman_davenport: the F of Iman and Davenport, Commun. Stat. A 9 (1980) 571, less
            conservative; None where every block ranks the models equally, and F is infinite.
        critical_difference: Nemenyi's: average ranks that differ by at least this differ
            significantly.
        alpha: level of significance of the critical difference.
        nemenyi_p: (models, models) p-values of Nemenyi's test, 1 on the diagonal.
        groups: maximal sets of neighbouring models, best first, that do not
            differ significantly; sets of one model are left out.
    """

    names: tuple[str, ...]
    blocks: int
    average_ranks: tuple[float, ...]
    friedman: Outcome
    iman_davenport: Outcome | None
    critical_difference: float
    alpha: float
    nemenyi_p: tuple[tuple[float, ...], ...]
    groups: tuple[tuple[str, ...], ...]

    @property
    def statistic(self) -> float:
        """Friedman's chi-squared."""
        return self.friedman.statistic

    @property
    def p(self) -> float:
        """The p-value of Friedman's test."""
        return self.friedman.p

    @property
    def ranks(self) -> dict[str, float]:
        """Average rank by model, best first."""
        return dict(sorted(zip(self.names, self.average_ranks, strict=True), key=lambda r: r[1]))


def critical_difference(models: int, blocks: int, *, alpha: float = 0.05) -> float:
    """Nemenyi's critical difference of average ranks.

    q sqrt(k (k + 1) / (6 N)), with q the quantile of the studentized range of k means and infinite
    degrees of freedom, divided by the root of 2 (Demsar 2006, section 3.2.2).

    Args:
        models: k, at least 2.
        blocks: N, at least 2.
        alpha: level of significance.

    Raises:
        InputError: a number out of range.
    """
    from scipy import stats

    check_level("alpha", alpha)
    if models < 2 or blocks < 2:
        raise InputError(f"got {models} models and {blocks} blocks, expected at least 2 of each")
    q = stats.studentized_range.ppf(1 - alpha, models, np.inf) / np.sqrt(2)
    return float(q * _rank_unit(models, blocks))


def friedman(scores: Mapping[str, ArrayLike], *, alpha: float = 0.05) -> FriedmanResult:
    """Tests whether models rank equally, and which ones differ by Nemenyi's test.

    Friedman, J. Am. Stat. Assoc. 32 (1937) 675. The blocks must be independent of each other;
    within a block, scores need only be comparable by rank.

    Args:
        scores: by model, (blocks,) in the same order of blocks; lower is better.
        alpha: level of significance of the critical difference.

    Raises:
        InputError: fewer than 3 models or blocks, unequal lengths, values that are not finite, or
            all models equal in every block.
    """
    from scipy import stats

    check_level("alpha", alpha)
    names = tuple(scores)
    if len(names) < 3:
        raise InputError(
            f"Friedman's test takes at least 3 models, got {len(names)}; compare two with "
            "paired_comparison"
        )
    rows = [sample(values, name, vary=False) for name, values in scores.items()]
    lengths = {name: len(row) for name, row in zip(names, rows, strict=True)}
    if len(set(lengths.values())) > 1:
        raise InputError(
            f"Friedman's test needs every model in every repeat, got runs per model: {lengths}"
        )
    table = np.stack(rows, axis=1)
    blocks, k = table.shape
    if (np.ptp(table, axis=1) == 0).all():
        raise InputError(
            f"all {k} models score equally in each of {blocks} repeats: there is nothing to rank"
        )
    chi_squared, p = stats.friedmanchisquare(*rows)
    ranks = stats.rankdata(table, axis=1).mean(axis=0)
    room = blocks * (k - 1) - chi_squared
    iman_davenport = None
    if room > 1e-9 * blocks * k:
        f, df = (blocks - 1) * chi_squared / room, (k - 1.0, (k - 1.0) * (blocks - 1.0))
        iman_davenport = Outcome("iman_davenport", float(f), float(stats.f.sf(f, *df)), df)
    apart = np.abs(ranks[:, None] - ranks[None]) / _rank_unit(k, blocks) * np.sqrt(2)
    nemenyi = stats.studentized_range.sf(apart, k, np.inf)
    np.fill_diagonal(nemenyi, 1.0)
    difference = critical_difference(k, blocks, alpha=alpha)
    return FriedmanResult(
        names,
        blocks,
        tuple(ranks.tolist()),
        Outcome("friedman", float(chi_squared), float(p), (k - 1.0,)),
        iman_davenport,
        difference,
        alpha,
        tuple(tuple(row) for row in np.clip(nemenyi, 0.0, 1.0).tolist()),
        _groups(names, ranks.tolist(), difference),
    )


def _rank_unit(models: int, blocks: int) -> float:
    return float(np.sqrt(models * (models + 1) / (6 * blocks)))


def _groups(
    names: tuple[str, ...], ranks: list[float], difference: float
) -> tuple[tuple[str, ...], ...]:
    order = sorted(range(len(names)), key=lambda i: ranks[i])
    found: list[tuple[str, ...]] = []
    reached = 0
    for start in range(len(order)):
        end = start
        while end + 1 < len(order) and ranks[order[end + 1]] - ranks[order[start]] < difference:
            end += 1
        if end > start and end > reached:
            found.append(tuple(names[i] for i in order[start : end + 1]))
            reached = end
    return tuple(found)
