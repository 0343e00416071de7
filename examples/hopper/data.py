"""The data of the thesis: its draw, its windows and masks, and rows near contacts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import mujoco  # type: ignore[import-untyped]
import numpy as np
from numpy.typing import NDArray

import offbeat as ob
from offbeat.data.robots import load_model, robot_of
from thesis.protocol import Protocol, Run

PROTOCOL = Protocol()
FRACTIONS = PROTOCOL.observed_fractions
CHANNELS = 14
"""7 positions and 7 velocities."""


def run_of(fraction: float, repeat: int = 0) -> Run:
    """The run of the thesis' repeats (section 3.3) whose windows, masks and split are used.

    Args:
        fraction: observed part of the rows.
        repeat: counted from 0.
    """
    for run in PROTOCOL.runs():
        if (run.experiment, run.observed_fraction, run.repeat) == (2, fraction, repeat):
            return run
    raise ob.InputError(f"the thesis has no repeat {repeat} at {fraction}; it has {FRACTIONS}")


@dataclass(frozen=True)
class Hopper:
    """The simulated trajectories, and what follows from them.

    Attributes:
        recorded: 10,000 trajectories of 200 rows.
    """

    recorded: ob.Dataset

    @classmethod
    def simulated(cls, trajectories: int | None = None) -> Hopper:
        """Simulates it.

        Args:
            trajectories: fewer than the thesis has, for a trial.
        """
        count = trajectories or PROTOCOL.n_trajectories
        return cls(
            ob.simulate(
                PROTOCOL.robot,
                count,
                PROTOCOL.recorded_rows,
                seed=PROTOCOL.state_seed,
                progress=False,
            )
        )

    @cached_property
    def scaler(self) -> ob.Scaler:
        """The thesis' units: (x - min) / max over all rows."""
        return ob.Scaler.fit(PROTOCOL.scaler, self.recorded)

    def parts(
        self, fraction: float, *, drawn_for: float | None = None
    ) -> tuple[ob.Dataset, ob.Dataset, ob.Dataset]:
        """Training, validation and test windows with the masks of the thesis' repeat 0.

        Args:
            fraction: observed part of the rows.
            drawn_for: fraction whose windows and split are used, where a model is scored at others
                than it was trained for: each has a split of its own, and trajectories that the
                model was trained on must not be in its test part. Masks are then drawn anew.
        """
        run = run_of(drawn_for or fraction)
        return PROTOCOL.cut(self.recorded, replace(run, observed_fraction=fraction))

    def whole(self, fraction: float) -> tuple[ob.Dataset, ob.Dataset, ob.Dataset]:
        """The trajectories that the windows of `parts` are cut from, nothing masked."""
        train, validation, test = ob.split(
            self.recorded, PROTOCOL.parts, seed=run_of(fraction).seed_draw
        )
        return train, validation, test


def switches(windows: ob.Dataset) -> NDArray[np.bool_]:
    """(trajectories, rows) True where a contact or a joint limit becomes active or inactive.

    It is measured on the constraints of MuJoCo at the true positions of a row and of the row
    before it.

    Args:
        windows: of equal length, every value known.
    """
    model = load_model(robot_of(PROTOCOL.robot))
    data = mujoco.MjData(model)
    found = np.zeros((len(windows), windows[0].rows), dtype=bool)
    for i, window in enumerate(windows):
        before = None
        for row, values in enumerate(window.values):
            data.qpos[:] = values[: model.nq]
            mujoco.mj_fwdPosition(model, data)
            active = _active(model, data)
            found[i, row] = before is not None and active != before
            before = active
    return found


def _active(model: mujoco.MjModel, data: mujoco.MjData) -> frozenset[tuple[int, ...]]:
    """The contacts, as pairs of shapes, and the joints at their limits."""
    contacts = {tuple(sorted(map(int, data.contact.geom[k]))) for k in range(data.ncon)}
    limits = {
        (int(data.efc_id[k]),)
        for k in range(data.nefc)
        if data.efc_type[k] == mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT
    }
    return frozenset(contacts | limits)
