"""Kalman filter and smoother that know which channels are derivatives of others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from offbeat.baselines.base import BASELINES, Array, Baseline
from offbeat.baselines.groups import Group, find_groups
from offbeat.baselines.kalman import Chains
from offbeat.baselines.kalman_channels import (
    ChainBaseline,
    ChainFilter,
    ChainSmoother,
    Wiring,
    fit_chains,
    singles,
)
from offbeat.baselines.kalman_search import Sample
from offbeat.data.trajectory import Dataset


class MotionBaseline(ChainBaseline):
    """Chains of the groups that `find_groups` finds, and of single channels for all others.

    A group of two has a white or damped acceleration, or a white or damped jerk, a group of three
    the latter; what has the lower loss on the tasks is taken, or single channels where these have.

    Attributes:
        groups: that are used.
    """

    groups: tuple[Group, ...]

    def estimate(self, tasks: Dataset) -> None:
        """See `Baseline`."""
        single, alone = singles(self, tasks, "all")
        found = find_groups(tasks)
        orders = [n for n in (2, 3) if any(len(group.channels) <= n for group in found)]
        tried = {n: self._chains(tasks, found, n) for n in orders}
        parts: dict[int, list[tuple[Chains, int]]] = {2: [], 3: []}
        used: list[Group] = []
        for group in found:
            losses = {order: loss[group] for order, (_, loss) in tried.items() if group in loss}
            order = min(losses, key=losses.__getitem__)
            if losses[order] < alone[list(group.channels)].mean():
                used.append(group)
                chains, loss = tried[order]
                parts[order].append((chains, list(loss).index(group)))
        self.groups = tuple(used)
        grouped = {c for group in used for c in group.channels}
        rest = [c for c in range(tasks.channels) if c not in grouped]
        parts[2] = [(single, c) for c in rest] + parts[2]
        self.banks = tuple(Chains.joined(part) for part in parts.values() if part)

    def _chains(
        self, tasks: Dataset, groups: Sequence[Group], order: int
    ) -> tuple[Chains, dict[Group, float]]:
        """Chains of the first channels of all groups, and the loss of each that is whole."""
        fitting = [g for g in groups if len(g.channels) <= order]
        channels = [[*g.channels, *[-1] * (order - len(g.channels))] for g in fitting]
        factors = [[*g.factors, *[1.0] * (order - len(g.factors))] for g in fitting]
        sample = Sample.of(tasks, np.array(channels), two_sided=not self.causal)
        weights = sample.weights()
        longest = sample.longest(weights)[:, 0]
        wiring = Wiring.of(tasks, channels, factors, self.mean, self.scale, longest)
        chains, losses = fit_chains(wiring, sample, self.scale, weights)
        measured = sample.index >= 0
        means = losses.mean(axis=1, where=measured).tolist()
        return chains, dict(zip(fitting, means, strict=True))

    @property
    def has_groups(self) -> bool:
        """Whether there is a group; without one, all chains are single channels."""
        return bool(self.groups)

    def describe(self, names: Sequence[str]) -> str:
        """The groups, a line each, for messages.

        Args:
            names: of all channels.
        """
        lines = []
        for group in self.groups:
            bank = next(b for b in self.banks if group.channels[0] in b.channels[:, 0])
            which = "second" if bank.order == 2 else "third"
            lines.append(f"{group.text(names)}, random {which} derivative")
        return "\n".join(lines) or "no channel is the derivative of another one"

    def arrays(self) -> dict[str, Array]:
        """See `Baseline`."""
        groups = np.array([g.numbers() for g in self.groups]).reshape(-1, Group.NUMBERS)
        return {**super().arrays(), "groups": groups}

    def restore(self, arrays: Mapping[str, Array]) -> Baseline:
        """See `Baseline`."""
        super().restore({n: a for n, a in arrays.items() if n != "groups"})
        self.groups = tuple(Group.of(numbers) for numbers in arrays["groups"])
        return self


class MotionFilter(MotionBaseline, ChainFilter):
    """A Kalman filter of positions with their velocities and accelerations."""


class MotionSmoother(MotionBaseline, ChainSmoother):
    """The Rauch-Tung-Striebel smoother of the same models, with parameters of its own."""


BASELINES.register("motion_filter", MotionFilter)
BASELINES.register("motion_smoother", MotionSmoother)
