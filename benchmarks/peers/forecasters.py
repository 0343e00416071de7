"""Forecasters of darts and neuralforecast, which count rows as equal steps."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Sequence
from typing import Any

import numpy as np

from .problem import Answer, Answerer, Array, Problem, Series
from .registry import Options

LAGS = 10
"""Rows that darts looks at."""


def darts(problem: Problem, options: Options) -> Answerer:
    """Ridge regression on lags of all channels, one model per step and channel.

    Args:
        problem: to answer.
        options: not used.
    """
    from darts import TimeSeries
    from darts.models import SKLearnModel
    from sklearn.linear_model import Ridge

    def series(values: Array) -> Any:
        padding = max(LAGS - len(values), 0)
        padded = np.concatenate([np.repeat(values[:1], padding, axis=0), values])
        return TimeSeries.from_values(padded.astype(np.float32))

    model = SKLearnModel(lags=LAGS, output_chunk_length=_longest(problem), model=Ridge())
    model.fit([series(problem.filled(s.values)) for s in problem.train])

    def answer(task: str, asked: Sequence[Series]) -> list[Answer]:
        steps = [_steps(problem, s) for s in asked]
        pasts = [series(problem.filled(s.values[:-1])[-3 * LAGS :]) for s in asked]
        found = model.predict(n=max(steps), series=pasts, show_warnings=False)
        rows = [f.values()[n - 1] for f, n in zip(found, steps, strict=True)]
        return [Answer(_last(problem, s, row)) for s, row in zip(asked, rows, strict=True)]

    return answer


def nhits(problem: Problem, options: Options) -> Answerer:
    """NHITS (Challu et al. 2023) of neuralforecast, each channel a series; median and interval.

    Args:
        problem: to answer.
        options: budget and seed.
    """
    import pandas as pd
    from neuralforecast import NeuralForecast
    from neuralforecast.losses.pytorch import MQLoss
    from neuralforecast.models import NHITS

    logging.getLogger("pytorch_lightning").setLevel(logging.ERROR)
    steps, channels = _longest(problem), len(problem.channels)

    def frame(all_values: Sequence[Array]) -> Any:
        parts = []
        for number, values in enumerate(all_values):
            for channel in range(channels):
                table = {"unique_id": number * channels + channel, "ds": np.arange(len(values))}
                parts.append(pd.DataFrame(table | {"y": values[:, channel]}))
        return pd.concat(parts, ignore_index=True)

    model = NHITS(
        h=steps,
        input_size=2 * steps,
        loss=MQLoss(level=[90]),
        max_steps=1000,
        val_check_steps=50,
        early_stop_patience_steps=5,
        start_padding_enabled=True,
        random_seed=options.seed,
        accelerator="cpu",
        enable_progress_bar=False,
        logger=False,
        max_time={"seconds": 4 * options.budget_s},  # wall time; the limit on steps comes first
        default_root_dir=tempfile.mkdtemp(),
    )
    trained = NeuralForecast([model], freq=1)
    long = [s for s in problem.train if len(s.times) > 2 * steps]
    trained.fit(frame([problem.filled(s.values) for s in long]), val_size=steps)

    def answer(task: str, asked: Sequence[Series]) -> list[Answer]:
        pasts = [problem.filled(s.values[:-1])[-2 * steps :] for s in asked]
        table = trained.predict(df=frame(pasts)).sort_values(["unique_id", "ds"])
        answers = []
        shaped = [
            table[f"NHITS{name}"].to_numpy().reshape(len(asked), channels, steps)
            for name in ("-median", "-lo-90", "-hi-90")
        ]
        for number, series in enumerate(asked):
            step = min(_steps(problem, series), steps) - 1
            rows = (_last(problem, series, each[number, :, step]) for each in shaped)
            answers.append(Answer(*rows))
        return answers

    return answer


def _longest(problem: Problem) -> int:
    """Steps of the longest forecast, in the log with the shortest steps."""
    steps = min(float(np.median(np.diff(s.times))) for s in problem.train)
    return round(max(problem.horizons_s) / steps) + 1


def _steps(problem: Problem, series: Series) -> int:
    """Steps from the last row that is known to the one that is asked."""
    past = np.diff(series.times[:-1])
    step = float(np.median(past)) if len(past) else problem.step_s
    return max(round((series.times[-1] - series.times[-2]) / step), 1)


def _last(problem: Problem, series: Series, row: Array) -> Array:
    """(rows, channels) in units, this row everywhere: only the last one counts."""
    return np.tile(row * problem.scale + problem.mean, (len(series.times), 1))
