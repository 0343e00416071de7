"""A histogram of durations, in fixed memory."""

from __future__ import annotations

import math
from typing import Any

BINS_PER_DECADE = 50
DECADES = 8  # from 0.1 us to 10 s
FIRST_US = 0.1


class Latency:
    """A histogram of durations with logarithmic bins of 4.7 % each."""

    def __init__(self) -> None:
        self.count = 0
        self.longest_us = 0.0
        self._bins = [0] * (BINS_PER_DECADE * DECADES + 2)

    def add(self, nanoseconds: int) -> None:
        """Counts one duration."""
        us = nanoseconds / 1000
        self.count += 1
        self.longest_us = max(self.longest_us, us)
        place = math.ceil(BINS_PER_DECADE * math.log10(us / FIRST_US)) if us > FIRST_US else 0
        self._bins[min(place, len(self._bins) - 1)] += 1

    def quantile_us(self, fraction: float) -> float | None:
        """An upper bound, at most 4.8 % above the duration that this fraction does not exceed.

        None if nothing was counted. Above 10 s, the longest duration.
        """
        if not self.count:
            return None
        wanted, below = max(1, math.ceil(fraction * self.count)), 0
        for place, count in enumerate(self._bins[:-1]):
            below += count
            if below >= wanted:
                return min(_edge_us(place), self.longest_us)
        return self.longest_us

    def to_dict(self) -> dict[str, Any]:
        """Count, quantiles and the bins that are not empty, in us."""
        return {
            "count": self.count,
            "median_us": self.quantile_us(0.5),
            "p99_us": self.quantile_us(0.99),
            "p999_us": self.quantile_us(0.999),
            "longest_us": self.longest_us,
            "histogram": [
                {"up_to_us": min(_edge_us(place), self.longest_us), "count": count}
                for place, count in enumerate(self._bins)
                if count
            ],
        }


def _edge_us(place: int) -> float:
    """Upper edge of a bin; the last one is unbounded."""
    if place > BINS_PER_DECADE * DECADES:
        return math.inf
    return float(FIRST_US * 10 ** (place / BINS_PER_DECADE))
