"""Models for irregular series of PyOmniTS, from a checkout that the user names.

A model is `models/NAME.py: Model(configs)`, called with values, times and masks of what was seen
(`x`, `x_mark`, `x_mask`) and of what is asked (`y`, `y_mark`, `y_mask`); it returns `pred`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from importlib import import_module
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch

from .problem import Answer, Answerer, Array, Problem, Series
from .registry import Options

ROWS = 24
"""Rows that a model looks at."""

BATCH = 16


def grafiti(problem: Problem, options: Options) -> Answerer:
    """GraFITi (Yalavarthi et al. 2024).

    Args:
        problem: to answer.
        options: budget, seed and checkout.
    """
    return forecaster("GraFITi", problem, options)


def hyperimts(problem: Problem, options: Options) -> Answerer:
    """HyperIMTS (Li et al. 2025).

    Args:
        problem: to answer.
        options: budget, seed and checkout.
    """
    return forecaster("HyperIMTS", problem, options)


def forecaster(name: str, problem: Problem, options: Options) -> Answerer:
    """Trains a model to forecast all horizons at once, as a change from the last values.

    Args:
        name: of the module in `models/` of the checkout.
        problem: to answer.
        options: budget, seed and checkout.

    Raises:
        ValueError: no checkout is named.
    """
    if options.checkout is None:
        raise ValueError(f"{name} needs --pyomnits FOLDER, a checkout of PyOmniTS")
    if str(options.checkout) not in sys.path:
        sys.path.insert(0, str(options.checkout))
    torch.manual_seed(options.seed)
    horizons = np.array(problem.horizons_s)
    configs = SimpleNamespace(
        enc_in=len(problem.channels),
        seq_len=ROWS,
        pred_len=len(horizons),
        seq_len_max_irr=ROWS,
        pred_len_max_irr=len(horizons),
        d_model=32,
        n_heads=4,
        n_layers=2,
        dropout=0.0,
        features="M",
        task_name="short_term_forecast",
        n_classes=0,
    )
    model = import_module(f"models.{name}").Model(configs)
    train = _examples(problem, problem.train, every=4)
    validation = _examples(problem, problem.validation, every=8)
    # Each horizon counts the same: errors in units of the change that is usual there.
    change = torch.sqrt((train["change"] ** 2 * train["y_mask"]).sum((0, 2)))
    weight = 1 / (change / train["y_mask"].sum((0, 2)).sqrt()).clamp(min=1e-6)

    def loss(batch: dict[str, torch.Tensor]) -> torch.Tensor:
        error = (ask(model, batch) - batch["change"]) * weight[:, None] * batch["y_mask"]
        return (error**2).sum() / batch["y_mask"].sum().clamp(min=1)

    optimizer = torch.optim.Adam(model.parameters(), lr=1e-3)
    best, kept, waited, end = np.inf, None, 0, time.process_time() + options.budget_s
    while waited < 10 and time.process_time() < end:
        model.train()
        for at in torch.randperm(len(train["x"])).split(BATCH):
            optimizer.zero_grad()
            loss({key: value[at] for key, value in train.items()}).backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
            optimizer.step()
            if time.process_time() > end:
                break
        model.eval()
        with torch.no_grad():
            parts = torch.arange(len(validation["x"])).split(64)
            cut = [{key: value[at] for key, value in validation.items()} for at in parts]
            score = float(np.mean([float(loss(batch)) for batch in cut]))
        waited += 1
        if score < best:
            best, waited = score, 0
            kept = {key: value.clone() for key, value in model.state_dict().items()}
    if kept is not None:
        model.load_state_dict(kept)

    def answer(task: str, asked: Sequence[Series]) -> list[Answer]:
        answers = []
        for series in asked:
            past = Series(series.times[:-1], series.values[:-1])
            gap = series.times[-1] - series.times[-2]
            at = int(np.argmin(np.abs(horizons - gap)))
            ahead = np.where(np.arange(len(horizons)) == at, gap, horizons)
            with torch.no_grad():
                found = ask(model, _stack([_example(problem, past, ahead)]))[0, at].numpy()
            last = problem.filled(past.values)[-1] + found
            row = last * problem.scale + problem.mean
            answers.append(Answer(np.tile(row, (len(series.times), 1))))
        return answers

    return answer


def ask(model: Any, batch: dict[str, torch.Tensor]) -> torch.Tensor:
    """(batch, horizons, channels) changes from the last values.

    Args:
        model: of the checkout; it is not shown what it is asked.
        batch: of `_stack`.
    """
    asked = torch.ones_like(batch["change"])
    found: torch.Tensor = model(
        x=batch["x"],
        x_mark=batch["x_mark"],
        x_mask=batch["x_mask"],
        y=torch.zeros_like(asked),
        y_mark=batch["y_mark"],
        y_mask=asked,
        exp_stage="test",
    )["pred"]
    return found


def _example(problem: Problem, past: Series, ahead: Array) -> dict[str, Array]:
    """The last rows of a series as a model takes them, and times ahead of the last row, s."""
    scaled = (problem.scaled(past.values))[-ROWS:]
    seen = np.isfinite(scaled)
    # Times are fractions of the time from the first row to the longest horizon, 0 where padded.
    first, last = past.times[-ROWS:][0], past.times[-1] + max(*problem.horizons_s, *ahead)
    mark = (past.times[-ROWS:] - first) / (last - first)
    missing = ((ROWS - len(scaled), 0), (0, 0))
    return {
        "x": np.pad(np.where(seen, scaled, 0), missing),
        "x_mask": np.pad(seen.astype(float), missing),
        "x_mark": np.pad(mark[:, None], missing),
        "y_mark": (past.times[-1] + ahead[:, None] - first) / (last - first),
        "change": np.zeros((len(ahead), scaled.shape[1])),
        "y_mask": np.zeros((len(ahead), scaled.shape[1])),
    }


def _examples(problem: Problem, part: Sequence[Series], *, every: int) -> dict[str, torch.Tensor]:
    """Pasts of a part with what follows; what is not known, or beyond the end, has mask 0."""
    found = []
    for series in part:
        filled = problem.filled(series.values)
        scaled = problem.scaled(series.values)
        for row in range(1, len(series.times) - 1, every):
            past = Series(series.times[: row + 1], series.values[: row + 1])
            wanted = past.times[-1] + np.array(problem.horizons_s) * (1 - 1e-9)
            at = np.searchsorted(series.times, wanted)
            inside = at < len(series.times)
            at = np.minimum(at, len(series.times) - 1)
            ahead = np.where(inside, series.times[at] - past.times[-1], problem.horizons_s)
            example = _example(problem, past, ahead)
            known = np.isfinite(scaled[at]) & inside[:, None]
            example["change"] = np.where(known, scaled[at] - filled[row], 0)
            example["y_mask"] = known.astype(float)
            found.append(example)
    return _stack(found)


def _stack(examples: Sequence[dict[str, Array]]) -> dict[str, torch.Tensor]:
    return {
        key: torch.tensor(np.stack([example[key] for example in examples]), dtype=torch.float32)
        for key in examples[0]
    }
