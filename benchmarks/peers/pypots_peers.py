"""Imputation models of PyPOTS, trained on masks like those of the tasks.

PyPOTS knows no time stamps (rows count as equal steps) and takes windows of one length.
"""

from __future__ import annotations

import signal
from collections.abc import Sequence
from typing import Any

import numpy as np

from .problem import Answer, Answerer, Array, Problem, Series
from .registry import Options

ROWS = 100
"""Of a window, or fewer where the series are shorter."""

COMMON = {"batch_size": 16, "epochs": 1000, "patience": 20, "device": "cpu", "verbose": False}
"""Options of every model; the limit on the time of a training comes before that on epochs."""

WINDOWS = 320
"""Of an epoch at least: fewer ones are repeated, each time with another mask."""


def saits(problem: Problem, options: Options) -> Answerer:
    """SAITS (Du, Cote and Liu 2023).

    Args:
        problem: to answer.
        options: budget and seed.
    """
    from pypots.imputation import SAITS

    sizes = {"n_layers": 2, "d_model": 64, "n_heads": 4, "d_k": 16, "d_v": 16, "d_ffn": 128}
    return imputer(SAITS, sizes, problem, options)


def brits(problem: Problem, options: Options) -> Answerer:
    """BRITS (Cao et al. 2018).

    Args:
        problem: to answer.
        options: budget and seed.
    """
    from pypots.imputation import BRITS

    return imputer(BRITS, {"rnn_hidden_size": 64}, problem, options, own_masks=False)


def grud(problem: Problem, options: Options) -> Answerer:
    """GRU-D (Che et al. 2018).

    Args:
        problem: to answer.
        options: budget and seed.
    """
    from pypots.imputation import GRUD

    return imputer(GRUD, {"rnn_hidden_size": 64}, problem, options, own_masks=False)


def imputeformer(problem: Problem, options: Options) -> Answerer:
    """ImputeFormer (Nie et al. 2024).

    Args:
        problem: to answer.
        options: budget and seed.
    """
    from pypots.imputation import ImputeFormer

    sizes = {"n_layers": 2, "d_input_embed": 16, "d_learnable_embed": 16, "d_proj": 8}
    sizes |= {"d_ffn": 64, "n_temporal_heads": 4}
    return imputer(ImputeFormer, sizes, problem, options)


def imputer(
    kind: Any, sizes: dict[str, int], problem: Problem, options: Options, *, own_masks: bool = True
) -> Answerer:
    """Trains a model of PyPOTS.

    Args:
        kind: its class.
        sizes: its options.
        problem: to answer.
        options: budget and seed.
        own_masks: whether the model hides values of its training windows itself; else it gets
            windows that are masked already.
    """
    import pypots.imputation.saits.data as masks
    from pypots.utils.random import set_random_seed

    set_random_seed(options.seed)
    fills = [s for task in problem.asked if task.startswith("fill") for s in problem.asked[task]]
    rows = min(ROWS, *(len(s.times) for s in (*problem.fit, *problem.held_out, *fills)))
    model = kind(rows, len(problem.channels), **sizes, **COMMON)
    rng = np.random.default_rng(options.seed)
    if problem.hidden == "dropouts":
        # Its own training masks are single values, which is worse on every log.
        length = max(round(0.5 / problem.step_s), 1)
        masks.mcar = lambda x, p: _dropouts(x, problem.sensors, length, rng)
    train = _windows(problem, problem.fit, rows, truth=own_masks)
    train = np.tile(train, (-(-WINDOWS // len(train)), 1, 1))
    validation = {
        "X": _windows(problem, problem.held_out, rows),
        "X_ori": _windows(problem, problem.held_out, rows, truth=True),
    }

    def stop(*_: object) -> None:
        raise KeyboardInterrupt  # PyPOTS then takes the best epoch so far

    signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, options.budget_s)
    model.fit({"X": train}, validation)
    signal.setitimer(signal.ITIMER_PROF, 0)

    def one(series: Series) -> Answer:
        starts = _starts(len(series.times), rows)
        cut = _windows(problem, [series], rows)
        found = model.predict({"X": cut})["imputation"]
        # Where windows overlap, the one whose middle is nearer.
        middle = np.abs(np.arange(len(series.times))[:, None] - np.array(starts) - rows / 2)
        nearest = np.argmin(middle, axis=1)
        at = np.arange(len(series.times)) - np.array(starts)[nearest]
        return Answer(found[nearest, at] * problem.scale + problem.mean)

    return lambda task, asked: [one(series) for series in asked]


def _starts(rows: int, length: int) -> list[int]:
    """First rows of windows that overlap by half and cover all rows."""
    return [*range(0, rows - length, max(length // 2, 1)), rows - length]


def _windows(
    problem: Problem, part: Sequence[Series], length: int, *, truth: bool = False
) -> Array:
    """(windows, length, channels) scaled."""
    found = []
    for series in part:
        values = series.truth if truth else series.values
        assert values is not None
        scaled = problem.scaled(values)
        found += [scaled[i : i + length] for i in _starts(len(scaled), length)]
    return np.stack(found).astype(np.float32)


def _dropouts(x: Any, sensors: Sequence[Sequence[int]], length: int, rng: Any) -> Any:
    """A window with about 30 % of each sensor hidden, in dropouts of this many rows."""
    hidden = x.clone()
    for sensor in sensors:
        for start in rng.permutation(len(x))[: max(round(0.36 * len(x) / length), 1)]:
            hidden[start : start + length, list(sensor)] = float("nan")
    return hidden
