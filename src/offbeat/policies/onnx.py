"""One step of a policy as an ONNX file, and its runner without torch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from offbeat.data.trajectory import ACTION
from offbeat.errors import InputError
from offbeat.export.exporter import StreamStep, exportable, write_step
from offbeat.export.runner import BEGINS, open_step
from offbeat.policies.policy import Policy

FORMAT = "offbeat-policy"
VERSION = 1


class _PolicyStep(StreamStep):
    """A row of observations to the actions of that row, in original units."""

    answers = ("action",)
    place: Tensor
    acts: Tensor

    def __init__(self, policy: Policy) -> None:
        super().__init__(policy.model)  # type: ignore[arg-type]  # exportable() has checked it
        chosen = torch.tensor([role == ACTION for role in policy.model.roles])
        self.channels = len(policy.observations)
        self.register_buffer("place", _places(~chosen))
        self.register_buffer("acts", torch.nonzero(chosen)[:, 0])

    def forward(self, t: Tensor, values: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        """Actions and next state.

        Args:
            t: (1,) float64, s.
            values: (1, observations) float64, original units, NaN where not measured.
            *state: as of `StreamStep`.
        """
        unseen = torch.full_like(values[:, :1], torch.nan)
        whole = torch.cat([values, unseen], dim=1).index_select(1, self.place)
        prediction, *after = super().forward(t, whole, *state)
        return prediction.index_select(1, self.acts), *after


def _places(seen: Tensor) -> Tensor:
    """Per channel the position of its observation; that of the NaN behind them for an action."""
    return torch.where(seen, torch.cumsum(seen, dim=0) - 1, seen.sum())


def export_policy(policy: Policy, path: str | Path) -> None:
    """Writes one step of a policy as an ONNX file, for `OnnxPolicy` or any ONNX runtime.

    Inputs: `t` (1,) float64, s; `values` (1, observations) float64 in original units, NaN where not
    measured; and the state. Outputs: `action` (1, actions) float64, at `t` after these values, and
    the state after the row, each part named as its input with `_next`. Names, bounds and the
    initial state are JSON in the metadata under `offbeat`.

    Args:
        policy: cloned.
        path: .onnx file, written atomically.

    Raises:
        InputError: the model has no recurrent state, an adaptive solver, or input transforms.
        MissingExtraError: onnx or onnxscript is not installed.
    """
    if not policy.model.transforms.is_identity:
        raise InputError(
            "an ONNX file of a policy takes no input transforms, and "
            f"{min(policy.model.transforms.named)!r} has one; read the demonstrations with "
            "unwrap=False, and give angles as sine and cosine"
        )
    model = exportable(policy.model)
    step = _PolicyStep(policy)
    initial = step.initial()
    record = {
        "format": FORMAT,
        "version": VERSION,
        "model": model.name,
        "observations": list(policy.observations),
        "actions": list(policy.actions),
        "low": policy.low.tolist(),
        "high": policy.high.tolist(),
        "initial": {
            name: [str(value.dtype).removeprefix("torch."), list(value.shape),
                   None if name in BEGINS else value.flatten().tolist()]
            for name, value in initial.items()
        },
    }  # fmt: skip
    write_step(step, model, record, path)


class OnnxPolicy:
    """Runs a policy that `export_policy` wrote, without torch, on one thread.

    Args:
        path: the .onnx file.

    Raises:
        FileFormatError: the file is missing, damaged, or not written by `export_policy`.
        MissingExtraError: onnxruntime is not installed.
    """

    def __init__(self, path: str | Path) -> None:
        opened = open_step(path, "policy that export_policy", _read)
        self._session, self._digest = opened.session, opened.digest
        self.observations, self.actions, self.low, self.high, self._initial = opened.record
        self._parts = list(self._initial)
        self._outputs = ["action", *(f"{name}_next" for name in self._parts)]
        self.reset()

    def reset(self) -> None:
        """Begins an episode."""
        self._state = dict(self._initial)

    def act(
        self, t: float, observation: ArrayLike | None = None, mask: ArrayLike | None = None
    ) -> NDArray[np.float64]:
        """The actions at a time, as of `Policy.act`.

        Args:
            t: s, not before the last one.
            observation: (observations,), NaN where not measured; by default nothing was.
            mask: (observations,) true where measured.

        Raises:
            InputError: a shape is wrong, or the time is not finite or before the last one.
        """
        if not np.isfinite(t):
            raise InputError(f"t must be a finite time in seconds, got {t!r}")
        last = float(self._state["time"][0])  # NaN before the first
        if t < last:
            raise InputError(
                f"times must not decrease, got {t!r} s after {last!r} s; reset() begins an episode"
            )
        shape = (len(self.observations),)
        values = np.full(shape, np.nan) if observation is None else np.asarray(observation, float)
        seen = np.ones(shape, bool) if mask is None else np.asarray(mask, bool)
        if values.shape != shape or seen.shape != shape:
            raise InputError(
                f"an observation and its mask must have the shape {shape}, got {values.shape} and "
                f"{seen.shape}"
            )
        row = np.where(seen, values, np.nan)[None]
        feed = {"t": np.array([float(t)]), "values": row, **self._state}
        action, *after = self._session.run(self._outputs, feed)
        self._state = dict(zip(self._parts, after, strict=True))
        return np.asarray(np.clip(action[0], self.low, self.high))

    def state(self) -> dict[str, NDArray[Any]]:
        """The state of the episode, for `restore`."""
        return {name: array.copy() for name, array in self._state.items()}

    def restore(self, state: dict[str, NDArray[Any]]) -> None:
        """Goes on from a state.

        Args:
            state: from `state`.

        Raises:
            InputError: it is of another policy. This one has not changed then.
        """
        shapes = {name: array.shape for name, array in self._initial.items()}
        if {name: array.shape for name, array in state.items()} != shapes:
            raise InputError(
                f"the state is of another policy, expected arrays of the shapes {shapes}; give "
                "what state() of this policy returned"
            )
        self._state = {name: state[name].copy() for name in self._parts}


def _read(record: Any) -> tuple[Any, ...]:
    """Names of observations and actions, bounds, and the initial state of the metadata."""
    if record["format"] != FORMAT or record["version"] != VERSION:
        raise ValueError(f"it is a {record['format']!r} of version {record['version']!r}")
    initial = {
        name: np.full(shape, BEGINS[name], dtype)
        if value is None
        else np.array(value, dtype=dtype).reshape(shape)
        for name, (dtype, shape, value) in record["initial"].items()
    }
    low, high = np.array(record["low"]), np.array(record["high"])
    return tuple(record["observations"]), tuple(record["actions"]), low, high, initial
