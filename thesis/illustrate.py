"""Makes `Illustrations`: recordings of the robot, and hidden states of trained models."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from offbeat import (
    Dataset,
    InputError,
    MissingExtraError,
    Model,
    load_model,
    mask_out,
    simulate,
    windows,
)
from offbeat.errors import require
from offbeat.models.checkpoint import CONFIG
from thesis.illustrations import Illustrations, StateMap, Trace

LABELS = (
    "gru",
    "gru_d",
    "gru_fair",
    "gru_d_fair",
    "ode_rnn",
    "ode_gru_d",
    "anchored_ode_gru_d",
)
"""Models of a reproduction, in the order of the figures."""

COLOUR = "rootz_qpos"
"""Channel that colours the map of hidden states: the height of the torso."""


def illustrate(
    checkpoints: Mapping[str, str | Path],
    *,
    observed_fraction: float = 0.3,
    robot: str = "hopper",
    recordings: int = 10,
    recorded_rows: int = 200,
    window: int = 100,
    state_seed: int = 123,
    fresh_seed: int = 1,
    trajectories: int = 100,
    every: int = 5,
    progress: bool = False,
) -> Illustrations:
    """Simulates what the figures show, and runs trained models over it.

    Hidden states are those on fresh trajectories, which no model was trained on.

    Args:
        checkpoints: by model label, a folder that `load_model` reads; may be empty.
        observed_fraction: fraction of the rows that models are shown.
        robot: one of `offbeat.data.robots.ROBOTS`.
        recordings: trajectories to keep as they are, the first of the protocol's data.
        recorded_rows: rows per simulated trajectory.
        window: rows that models see.
        state_seed: of the recordings' initial states, the protocol's.
        fresh_seed: of the trajectories that models see, of windows and of masked rows.
        trajectories: in the map of hidden states.
        every: rows between two points of the map along a trajectory.
        progress: show a progress bar of the simulation.

    Raises:
        InputError: an argument is out of bounds, or a model has other channels.
        MissingExtraError: mujoco is not installed. Without umap-learn there is no
            map, and `missing` says so.
    """
    if every < 1 or trajectories < 1:
        raise InputError(f"every and trajectories must be at least 1, got {every}, {trajectories}")
    recorded = simulate(robot, recordings, recorded_rows, seed=state_seed, progress=progress)
    kept = Illustrations(
        robot,
        recorded.names,
        recorded.units,
        recorded[0].times,
        np.stack([trajectory.values for trajectory in recorded]),
    )
    if not checkpoints:
        said = (
            "Hidden states (figures 2.5 and A.2) need trained models: there is no checkpoint of a "
            f"first repeat at {100 * observed_fraction:g}\N{THIN SPACE}%."
        )
        return replace(kept, missing=(said,))
    fresh = simulate(robot, trajectories, recorded_rows, seed=fresh_seed, progress=progress)
    shown = mask_out(windows(fresh, window, seed=fresh_seed), observed_fraction, seed=fresh_seed)
    models = {label: load_model(path) for label, path in checkpoints.items()}
    states = {label: hidden_states(model, shown) for label, model in models.items()}
    at = _typical(shown)
    first = shown[at]
    kept = replace(
        kept,
        fraction=observed_fraction,
        runs=runs_of(checkpoints),
        trace=Trace(
            first.times - first.times[0],
            np.asarray(first.observed.any(axis=1)),
            {label: before[at] for label, (before, _) in states.items()},
            {label: after[at] for label, (_, after) in states.items()},
        ),
    )
    seen = np.stack([np.maximum.accumulate(t.observed.any(axis=1)) for t in shown])
    chosen = seen & (np.arange(window) % every == every - 1)
    channel = shown.names.index(COLOUR) if COLOUR in shown.names else 0
    colour = np.stack([t.values[:, channel] for t in shown])[chosen]
    try:
        places = {label: lay_out(after[chosen]) for label, (_, after) in states.items()}
    except MissingExtraError as error:
        return replace(kept, missing=(f"The map of hidden states is not there: {error}.",))
    return replace(kept, map=StateMap(places, colour, shown.names[channel], shown.units[channel]))


def checkpoints_of(runs: str | Path, observed_fraction: float) -> dict[str, Path]:
    """One trained model per label, of the first repeat at an observed fraction.

    Args:
        runs: folder of a reproduction, whose runs lie in `runs/e1-ode_rnn-30-r00/training` and the
            like. Where experiment 1 has no checkpoint of a label, that of experiment 2 is taken.
        observed_fraction: fraction of the rows.

    Returns:
        Folders that `load_model` reads, by label; empty where nothing was kept.
    """
    found: dict[str, Path] = {}
    for label in LABELS:
        for experiment in (1, 2):
            name = f"e{experiment}-{label}-{round(100 * observed_fraction)}-r00"
            for folder in (Path(runs) / "runs" / name / "training", Path(runs) / "models" / name):
                if (folder / "model" / CONFIG).is_file() or (folder / CONFIG).is_file():
                    found.setdefault(label, folder)
    return found


def runs_of(checkpoints: Mapping[str, str | Path]) -> dict[str, str]:
    """Names of the runs whose checkpoints these are, by label."""
    folders = {label: Path(path) for label, path in checkpoints.items()}
    return {
        label: folder.parent.name if folder.name == "training" else folder.name
        for label, folder in folders.items()
    }


def hidden_states(
    model: Model, dataset: Dataset, *, seed: int = 0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Hidden states h of a model along trajectories of one length.

    Args:
        model: trained.
        dataset: what it is shown.
        seed: of the generator of self-feeding.

    Returns:
        (trajectories, rows, hidden_size) on arrival at each row, and after it. The part of an
        anchored state of the channels is left out.
    """
    generator = torch.Generator().manual_seed(seed) if model.config.self_feeding else None
    with torch.inference_mode():
        output = model(model.batch(dataset), generator=generator)
    first = model.spec.anchors
    part = slice(first, first + model.hidden_size)
    before, after = (s[..., part].double().numpy() for s in (output.before, output.after))
    return before, after


def lay_out(states: NDArray[np.float64], *, seed: int = 0) -> NDArray[np.float64]:
    """Lays states out in two dimensions by UMAP, so that near states lie near each other.

    McInnes, Healy and Melville, arXiv:1802.03426; 15 neighbours, one thread, seeded.

    Args:
        states: (points, hidden_size), at least 20 points.
        seed: of the layout.

    Returns:
        (points, 2) without units.

    Raises:
        InputError: too few points.
        MissingExtraError: umap-learn is not installed.
    """
    if len(states) < 20:
        raise InputError(f"a map needs at least 20 states, got {len(states)}; use more rows")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it warns about its dependencies when imported
        umap: Any = require("umap", "umap")
        mapper = umap.UMAP(n_neighbors=15, random_state=seed, n_jobs=1)
        places: NDArray[np.float64] = mapper.fit_transform(states)
    return places


def _typical(dataset: Dataset) -> int:
    """The trajectory that moves as much as the median one, in standard deviations."""
    values = np.stack([t.values for t in dataset])
    spread = values.std(axis=(0, 1))
    travelled = np.abs(np.diff(values, axis=1)).sum(axis=1) / np.where(spread > 0, spread, 1.0)
    return int(np.argsort(travelled.sum(axis=1))[len(dataset) // 2])
