"""Scores of a comparison: returns in percent of the expert, and their interquartile means."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.stats import trim_mean

from .rivals import RIVALS

RESAMPLED = 2000


def resampled(scores: NDArray[np.float64], seed: int = 0) -> NDArray[np.float64]:
    """Interquartile means of a stratified bootstrap, as Agarwal et al. 2021 (arXiv:2108.13264).

    Trainings are drawn anew for each episode, which is a stratum: all trainings meet the same ones.

    Args:
        scores: (trainings, episodes).
        seed: of the bootstrap.

    Returns:
        (2000,).
    """
    random = np.random.default_rng(seed)
    drawn = random.integers(0, len(scores), (RESAMPLED, *scores.shape))
    some = scores[drawn, np.arange(scores.shape[1])].reshape(RESAMPLED, -1)
    return np.asarray(trim_mean(some, 0.25, axis=1))


def interquartile(scores: NDArray[np.float64]) -> tuple[float, float, float]:
    """Interquartile mean and its 95 % interval.

    Args:
        scores: (trainings, episodes).
    """
    low, high = np.quantile(resampled(scores), [0.025, 0.975])
    return float(trim_mean(scores.ravel(), 0.25)), float(low), float(high)


def records(folder: Path) -> list[dict[str, Any]]:
    """What was found of every training of every rival.

    Args:
        folder: of the results of a robot.
    """
    return [read(path) for path in sorted(folder.glob("*-*.json"))]


def percent(folder: Path, returns: ArrayLike) -> NDArray[np.float64]:
    """Returns of which 100 is the mean of the expert that sees everything, and 0 random actions.

    Args:
        folder: of the results of a robot.
        returns: of any shape.
    """
    zero, one = (
        np.mean(read(folder / f"{name}.json")["returns"]["0 %"]) for name in ("random", "expert")
    )
    return np.asarray(100 * (np.asarray(returns) - zero) / (one - zero))


def by_seed(folder: Path, training: str, condition: str) -> dict[str, dict[int, Any]]:
    """(episodes,) scores in percent by the name of the rival and the seed of the training.

    Args:
        folder: of the results of a robot.
        training: name of what training loses.
        condition: name of what the test loses.
    """
    found: dict[str, dict[int, Any]] = {name: {} for name in RIVALS}
    for record in records(folder):
        if record["training"] == training:
            scores = percent(folder, record["returns"][condition])
            found[record["rival"]][record["seed"]] = scores
    return {name: each for name, each in found.items() if each}


def read(path: Path) -> dict[str, Any]:
    """A file of the results."""
    record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return record
