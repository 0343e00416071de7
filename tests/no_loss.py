"""Blends of baselines on synthetic logs, against each simple baseline: python tests/no_loss.py.

Each log of `odd_logs` is planned, prepared and split as `offbeat train` does it, a blend of
baselines is fitted to its training and validation parts, and its test part is asked: one step,
fills of silences from the past and from both sides, and forecasts. A loss is an error that is more
than 5 % above that of the best simple baseline, which is chosen in hindsight.

With `--short`, the same for the short logs of `short_logs`, each scored on the minute and a half
that follows it, and without fills from both sides.

Whether a loss is one of the method or of chance is decided by blocks of the test part as long as
the time asked for: with fewer than `FEWEST` of them nothing is said, and with more, the squared
errors of the blend must be larger by two standard errors of their mean over blocks.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from odd_logs import ODD_LOGS
from short_logs import SHORT_LOGS

import offbeat as ob
from offbeat.answers.blend import TASKS, Blend, fit_blend
from offbeat.answers.scoring import forecast_tasks
from offbeat.baselines import Baseline
from offbeat.config import TaskConfig
from offbeat.data.masking import masked_values
from offbeat.data.plan import plan, prepare
from offbeat.data.tasks import draw_tasks

PAST = ("last_value", "mean", "running_mean", "constant_velocity", "damped_slope")
BOTH = ("linear", "pchip")

LOSS = 1.05
"""Ratio of errors above which the blend loses."""

FEWEST = 20
"""Blocks of the test part below which a comparison says nothing."""

TARGETS = 17
"""Forecasts of each horizon in each of the pieces that follow a short log."""

EXACT = 1e-3
"""Errors below this part of a channel's spread are no losses."""


@dataclass(frozen=True)
class Compared:
    """A task and a channel of a log.

    Attributes:
        log: its name.
        task: what was asked.
        channel: its name.
        best: the simple baseline with the lowest error.
        ratio: of the blend's error to it.
        scaled: the blend's error, in units of the channel's spread.
        blocks: independent ones.
        sure: mean difference of the squared errors over blocks, in standard errors.
    """

    log: str
    task: str
    channel: str
    best: str
    ratio: float
    scaled: float
    blocks: int
    sure: float

    @property
    def loses(self) -> bool:
        """Whether the blend's error is larger by more than 5 % and more than exact."""
        return self.ratio > LOSS and self.scaled > EXACT

    @property
    def judged(self) -> bool:
        """Whether there are enough blocks to say so."""
        return self.blocks >= FEWEST

    @property
    def counts(self) -> bool:
        """Whether it is a loss that is not by chance."""
        return self.loses and self.judged and self.sure > 2


@dataclass(frozen=True, eq=False)
class Asked:
    """What is shown, of which pieces of the test part, what is scored, how long a block is."""

    name: str
    dataset: ob.Dataset
    pieces: Sequence[int]
    scored: Sequence[NDArray[np.bool_]]
    block_s: float
    both: bool = False


def compared(name: str, *, count: int = TASKS) -> list[Compared]:
    """Fits a blend of baselines to a log, and compares it on the test part.

    Args:
        name: of `ODD_LOGS`.
        count: tasks that it is fitted to, at most.
    """
    return compared_on(name, ODD_LOGS[name](), None, count=count)


def compared_on(
    name: str, dataset: ob.Dataset, test: ob.Dataset | None, *, count: int = TASKS
) -> list[Compared]:
    """The same of any log.

    Args:
        name: of the log.
        dataset: it.
        test: to score, without fills from both sides; by default the test part of the log.
        count: as of `compared`.
    """
    chosen = plan(dataset)
    train, validation, rest = ob.apply_split(prepare(dataset, chosen), chosen.whole)
    both = None if test is None else ("linear",)
    blend = fit_blend(train, validation, tasks=chosen.tasks, two_sided=both, count=count)
    test = blend.transforms.apply(rest if test is None else test.select(blend.names))
    found: list[Compared] = []
    targets = 100 if both is None else TARGETS
    for asked in _asked(test, chosen.tasks, chosen.horizons_s, targets):
        if both is None or not asked.both:
            found += _compared(name, blend, asked)
    return found


def _asked(
    test: ob.Dataset, config: TaskConfig, horizons: Sequence[float], targets: int = 100
) -> Iterator[Asked]:
    """One step, fills of silences, and forecasts, so many of each trajectory."""
    seen = []
    for t in test:
        before = np.zeros_like(t.observed)
        before[1:] = np.logical_or.accumulate(t.observed, axis=0)[:-1]
        seen.append(t.known & before)
    yield Asked("one step", test, range(len(test)), seen, config.gap_s)
    silent = draw_tasks(test, config, 200, shares={"silence": 1.0}, seed=7)
    inside = []
    for t in silent:
        before = np.logical_or.accumulate(t.observed, axis=0)
        after = np.logical_or.accumulate(t.observed[::-1], axis=0)[::-1]
        inside.append(masked_values(t) & before & after)
    pieces = [source for _, source, _ in silent.meta["tasks"]]
    yield Asked("fill, from the past", silent, pieces, inside, config.horizon_s)
    yield Asked("fill, both sides", silent, pieces, inside, config.horizon_s, both=True)
    for horizon in horizons:
        cut: list[ob.Trajectory] = []
        pieces, scored = [], []
        for piece in range(len(test)):
            tasks, counted = forecast_tasks(test[piece : piece + 1], horizon, targets)
            cut += tasks or ()
            pieces += [piece] * len(counted)
            scored += counted
        if cut:
            yield Asked(
                f"forecast {horizon:.2g} s", ob.Dataset(tuple(cut)), pieces, scored, horizon
            )


def _compared(log: str, blend: Blend, asked: Asked) -> Iterator[Compared]:
    answers = blend.fill(asked.dataset) if asked.both else blend.causal(asked.dataset)
    simple: dict[str, Baseline] = {n: m for n, m in blend.stack.members.items() if n in PAST}
    if asked.both:
        simple |= {n: m for n, m in blend.both.members.items() if n in BOTH}
    every = {n: m.predict(asked.dataset) for n, m in simple.items()}
    block: list[tuple[int, int]] = []
    channel, missed = [], []
    for i, (t, scored) in enumerate(zip(asked.dataset, asked.scored, strict=True)):
        row, at = np.nonzero(scored)
        block += [(asked.pieces[i], int(time // asked.block_s)) for time in t.times[row]]
        channel.append(at)
        each = [answers[i].values, *(p[i] for p in every.values())]
        missed.append(np.stack([(e - t.values)[row, at] for e in each], axis=1))
    channels, squares = np.concatenate(channel), np.concatenate(missed) ** 2
    _, number = np.unique(np.array(block), axis=0, return_inverse=True)
    for c in np.flatnonzero(blend.predicted):
        own = channels == c
        if not own.any():
            continue
        mean = squares[own].mean(axis=0)
        best = 1 + int(np.argmin(mean[1:]))
        worse = np.bincount(number[own], squares[own, 0] - squares[own, best])
        worse = worse[np.bincount(number[own]) > 0]
        spread = float(worse.std(ddof=1)) if len(worse) > 1 else np.inf
        yield Compared(
            log,
            asked.name,
            blend.names[c],
            list(every)[best - 1],
            float(np.sqrt(mean[0] / max(mean[best], 1e-300))),
            float(np.sqrt(mean[0]) / blend.stack.scale[c]),
            len(worse),
            float(worse.mean() / max(spread / np.sqrt(len(worse)), 1e-300)),
        )


def table(found: Sequence[Compared]) -> str:
    """A Markdown table with a line per log."""
    lines = [
        "| log | compared | geometric mean | below 1 | above 1.05 | not by chance | worst |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for log in dict.fromkeys(each.log for each in found):
        own = [each for each in found if each.log == log]
        ratios = np.maximum([each.ratio for each in own if each.scaled > EXACT], 1e-3)
        lost = [each for each in own if each.loses]
        sure = [each for each in lost if each.counts]
        worst = max(lost, key=lambda each: each.ratio, default=None)
        said = "" if worst is None else f"{worst.ratio:.2f}, {worst.task}, {worst.channel}"
        mean = float(np.exp(np.log(ratios).mean()))
        below = int((np.array([each.ratio for each in own]) < 1).sum())
        lines.append(
            f"| {log} | {len(own)} | {mean:.3f} | {below} | {len(lost)} | {len(sure)} | {said} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Prints the table, and each loss that is not by chance."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--log", action="append", choices=[*ODD_LOGS, *SHORT_LOGS])
    parser.add_argument("--short", action="store_true", help="the short logs")
    parser.add_argument("--seeds", type=int, default=1, help="of the short logs")
    given = parser.parse_args()
    found: list[Compared] = []
    for name in given.log or (SHORT_LOGS if given.short else ODD_LOGS):
        if name in SHORT_LOGS:
            for seed in range(given.seeds):
                found += compared_on(name, *SHORT_LOGS[name](seed))
        else:
            found += compared(name)
        print(table([each for each in found if each.log == name]).splitlines()[-1], flush=True)
    print("\n" + table(found) + "\n")
    for each in found:
        if each.loses and each.judged:
            print(
                f"{each.log}: {each.task}, {each.channel}: {each.ratio:.2f} times {each.best}, "
                f"{each.blocks} blocks, {each.sure:.1f} standard errors"
            )


if __name__ == "__main__":
    main()
