"""`Policy`: a model that chooses actions from observations as they arrive."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from offbeat.data.batch import Batch
from offbeat.data.trajectory import ACTION
from offbeat.errors import InputError
from offbeat.models.base import BaseModel
from offbeat.models.checkpoint import load_model
from offbeat.models.elapsed import RecurrentState
from offbeat.models.model import Model, depends_on_rows
from offbeat.policies.past import Past, arrays_of, joined, kept, past_of
from offbeat.stream.transformed import LiveTransforms, TransformState

State = dict[str, NDArray[Any]]
"""The state of a policy, by the names of its parts."""


class Policy:
    """Chooses actions from observations at uneven times, with frames and sensors missing.

    A policy sees no actions, not even its own: clones that do tend to repeat their last one. Asking
    for an action without an observation leaves no trace, except in a model that updates at every
    row (`update_rows="every"`), which takes one row per call, at the time of the action.

    Args:
        model: from `fit_policy`, or any model with channels of the role `action`. One without a
            recurrent state is run on its newest `window` rows.
        window: rows that are kept of a model without a recurrent state.

    Raises:
        InputError: no channel of the model is an action, or an action has an input transform.

    Example:
        >>> policy.reset()  # doctest: +SKIP
        >>> policy.act(0.00, {"angle": 0.3, "speed": 0.0})  # doctest: +SKIP
        >>> policy.act(0.05)  # nothing was observed  # doctest: +SKIP
    """

    def __init__(self, model: BaseModel, *, window: int = 64) -> None:
        acts = np.array([role == ACTION for role in model.roles])
        if not acts.any() or acts.all():
            raise InputError(
                "a policy needs a model with observations and actions, got the roles "
                f"{', '.join(model.roles)}; give channels the role 'action'"
            )
        self.model, self.window = model, window
        self.observations = tuple(np.array(model.names)[~acts].tolist())
        """Names of the observed channels, in order."""
        self.actions = tuple(np.array(model.names)[acts].tolist())
        """Names of the actions, in order."""
        changed = model.transforms.named & set(self.actions)
        if changed:
            raise InputError(
                f"the action {min(changed)!r} has an input transform; observations alone may have "
                "some: read the demonstrations with unwrap=False, and leave out constant actions"
            )
        self._transforms = LiveTransforms(model.transforms, self.observations)
        shift, scale = model.scaler.shift[acts], np.abs(model.scaler.scale[acts])
        self.low, self.high = shift - scale, shift + scale
        """(actions,) bounds of the actions, in their units."""
        self.log: tuple[Any, ...] = ()
        """A record per epoch of its cloning; empty for a policy that was loaded."""
        self._seen, self._acts = np.flatnonzero(~acts), torch.from_numpy(np.flatnonzero(acts))
        self._every_row = isinstance(model, Model) and (
            depends_on_rows(model.config) or model.config.nodes == "rows"
        )
        self.reset()

    def reset(self, n: int | None = None) -> None:
        """Begins an episode.

        Args:
            n: number of robots that are driven together, each an episode; by default one, whose
                observations and actions have no first axis.
        """
        if n is not None and (isinstance(n, bool) or not isinstance(n, int) or n < 1):
            raise InputError(f"n must be a number of robots, got {n!r}")
        self.n = n
        self._newest = np.full(n or 1, -np.inf)  # s, of the newest observation
        self._asked = np.full(n or 1, -np.inf)  # s, of the newest action
        self._sent = [self._transforms.start()] * (n or 1)
        self._past: Past | None = None
        if isinstance(self.model, Model):
            self._past = self.model.empty_state(n or 1)

    def act(
        self,
        t: ArrayLike,
        observation: ArrayLike | Mapping[str, float] | None = None,
        mask: ArrayLike | None = None,
        *,
        now: ArrayLike | None = None,
    ) -> NDArray[np.float64]:
        """The actions at a time, from everything observed by then.

        Args:
            t: s since any fixed origin, of the observation; (n,) where robots differ.
            observation: (observations,) in the units of the demonstrations, or by name; NaN where
                not measured. With `n` robots (n, observations). By default nothing was observed.
            mask: as the observation, true where measured.
            now: s, at which the robot acts, where the observation is older; (n,) where they differ.

        Returns:
            (actions,) in the units of the demonstrations, within their bounds; with `n` robots
            (n, actions).

        Raises:
            InputError: a shape or a name is wrong, or a time is before the one of the last call.
        """
        count = self.n or 1
        values, seen, sent = self._transformed(*self._row(observation, mask))
        stamp = _times("t", t, count)
        arrived: NDArray[np.bool_] = np.asarray(seen.any(axis=1))
        asked = stamp if now is None else _times("now", now, count)
        stamp = np.where(arrived, stamp, asked)
        if self._every_row:
            arrived, stamp = np.ones_like(arrived), asked
        if (stamp < self._newest).any() or (asked < stamp).any():
            raise InputError(
                f"times must not decrease, got an observation of {stamp.tolist()} s and an action "
                f"at {asked.tolist()} s after an observation of {self._newest.tolist()} s; "
                "reset() begins an episode"
            )
        chosen, past = self._forward(stamp, values, seen)
        if arrived.any():  # a row in which nothing is observed leaves no trace
            self._past = kept(arrived, past, self._past)
        later = asked > stamp
        if later.any():
            then, _ = self._forward(asked, np.zeros_like(values), np.zeros_like(seen))
            chosen = np.where(later[:, None], then, chosen)
        self._newest = np.where(arrived, stamp, self._newest)
        self._asked, self._sent = asked, sent
        return chosen if self.n is not None else chosen[0]

    def select_action(self, batch: Mapping[str, Any]) -> Tensor:
        """The actions of a batch in LeRobot's form.

        Args:
            batch: `observation.state` (n, observations) or (observations,), NaN where not measured;
                `timestamp`, s, (n,) or a number, by default one typical step after the last call;
                and `observation.mask`, true where measured, by default everything that is finite.

        Returns:
            (n, actions) float32.

        Raises:
            InputError: there is no `observation.state`, or as `act`.
        """
        if "observation.state" not in batch:
            raise InputError(
                f"the batch has {', '.join(sorted(batch)) or 'nothing'}, expected observation.state"
            )
        state = np.atleast_2d(_array("observation.state", batch["observation.state"]))
        if self.n != len(state):
            self.reset(len(state))
        t = batch.get("timestamp")
        if t is None:
            gap = self.model.statistics.median_gap
            t = np.where(np.isfinite(self._asked), self._asked + gap, 0.0)
        mask = batch.get("observation.mask")
        if mask is not None:
            mask = np.broadcast_to(np.asarray(mask), state.shape)
        chosen = self.act(_array("timestamp", t).reshape(-1), state, mask)
        return torch.from_numpy(chosen.astype(np.float32))

    def state(self) -> State:
        """The state of the episode as plain arrays; `restore` goes on from it bit for bit."""
        arrays = {"newest": self._newest.copy(), "asked": self._asked.copy()}
        arrays |= arrays_of(self._past)
        for field in fields(TransformState) if not self.model.transforms.is_identity else ():
            arrays[_SENT + field.name] = np.stack([getattr(one, field.name) for one in self._sent])
        return arrays

    def restore(self, state: State) -> None:
        """Goes on from the state of an episode of the same model.

        Args:
            state: from `state`.

        Raises:
            InputError: it is of another model. The policy has not changed then.
        """
        newest, asked = state.get("newest"), state.get("asked")
        if newest is None or asked is None or newest.ndim != 1:
            raise InputError("this is no state of a policy (it has no array 'newest')")
        fresh = Policy(self.model, window=self.window)
        fresh.reset(len(newest) if self.n is not None or len(newest) > 1 else None)
        sent = fresh._restored({k: v for k, v in state.items() if k.startswith(_SENT)})
        others = {"newest", "asked", *(k for k in state if k.startswith(_SENT))}
        parts = {k: v for k, v in state.items() if k not in others}
        self._past = past_of(parts, self.model, fresh._past)
        self.n, self._newest, self._asked = fresh.n, newest.copy(), asked.copy()
        self._sent = sent

    def save(self, path: str | Path) -> None:
        """Writes the policy to a folder, atomically, as a checkpoint of its model.

        Args:
            path: the folder; an existing one is replaced.
        """
        self.model.save(path)

    @classmethod
    def load(cls, path: str | Path) -> Policy:
        """Reads a policy; nothing is unpickled.

        Args:
            path: folder of `save`, or of any model with actions.

        Raises:
            FileFormatError: as `load_model`.
            InputError: the model has no actions.
        """
        return cls(load_model(path))

    def __repr__(self) -> str:
        return (
            f"Policy({self.model.name}: {len(self.observations)} observations to "
            f"{len(self.actions)} actions)"
        )

    def _row(self, observation: Any, mask: Any) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """(n, observations) values and masks, 0 and False where not measured."""
        shape = (self.n or 1, len(self.observations))
        if observation is None:
            return np.zeros(shape), np.zeros(shape, dtype=bool)
        if isinstance(observation, Mapping):
            unknown = sorted(set(observation) - set(self.observations))
            if unknown:
                raise InputError(
                    f"unknown observation {unknown[0]!r}, expected: {', '.join(self.observations)}"
                )
            observation = [observation.get(name, np.nan) for name in self.observations]
        values = _array("observation", observation)
        expected = shape if self.n is not None else shape[1:]
        if values.shape != expected:
            raise InputError(f"an observation must have the shape {expected}, got {values.shape}")
        seen = np.isfinite(values)
        if mask is not None:
            given = np.asarray(mask)
            if given.shape != expected:
                raise InputError(f"a mask must have the shape {expected}, got {given.shape}")
            seen &= given.astype(bool)
        return np.where(seen, values, 0.0).reshape(shape), seen.reshape(shape)

    def _transformed(
        self, values: NDArray[np.float64], seen: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], NDArray[np.bool_], list[TransformState]]:
        """(n, observations) as the model takes them, and what the transforms keep of each robot."""
        if self.model.transforms.is_identity:
            return values, seen, self._sent
        rows = zip(values, seen, self._sent, strict=True)
        found = [self._transforms.apply(row, mask, sent) for row, mask, sent in rows]
        mask = np.stack([each[1] for each in found])
        return (
            np.where(mask, np.stack([each[0] for each in found]), 0.0),
            mask,
            [each[2] for each in found],
        )

    def _restored(self, arrays: State) -> list[TransformState]:
        """What the transforms keep of each robot, from `state`."""
        if self.model.transforms.is_identity and not arrays:
            return self._sent
        found = {}
        for field in fields(TransformState):
            value, like = arrays.get(_SENT + field.name), getattr(self._sent[0], field.name)
            if value is None or value.shape != (len(self._sent), *like.shape):
                raise InputError(f"the state is of another model: it differs in {field.name!r}")
            found[field.name] = value.astype(like.dtype)
        return [
            TransformState(**{name: value[i].copy() for name, value in found.items()})
            for i in range(len(self._sent))
        ]

    def _forward(
        self, times: NDArray[np.float64], values: NDArray[np.float64], seen: NDArray[np.bool_]
    ) -> tuple[NDArray[np.float64], Past]:
        """(n, actions) at a row, and the past after it."""
        model, shape = self.model, (len(times), self.model.channels)
        scaler, acts = model.scaler, self._acts.numpy()
        scaled, mask = np.zeros(shape), np.zeros(shape, dtype=bool)
        scaled[:, self._seen] = (values - scaler.shift[self._seen]) / scaler.scale[self._seen]
        mask[:, self._seen] = seen
        given = torch.from_numpy(np.where(mask, scaled, 0.0))[:, None].to(model.device, model.dtype)
        observed = torch.from_numpy(mask)[:, None].to(model.device)
        clock = torch.from_numpy(times)[:, None].to(model.device)
        valid = torch.ones_like(clock, dtype=torch.bool)
        row = Batch(clock, given, observed, observed, valid, model.roles)
        past: Past
        with torch.inference_mode():
            if isinstance(model, Model):
                assert isinstance(self._past, RecurrentState)
                output = model(row, past=self._past)
                past = replace(output.past, actions=None)  # it sees no actions, so none are kept
            else:
                assert not isinstance(self._past, RecurrentState)
                past = joined(self._past, row, self.window)
                output = model(past)
            chosen = output.mean[:, -1].double().cpu().index_select(1, self._acts).numpy()
        chosen = chosen * scaler.scale[acts] + scaler.shift[acts]
        return np.asarray(np.clip(chosen, self.low, self.high)), past


_SENT = "transforms."


def _times(name: str, value: ArrayLike, count: int) -> NDArray[np.float64]:
    times = _array(name, value).reshape(-1)
    if len(times) not in (1, count) or not np.isfinite(times).all():
        raise InputError(f"{name} must be a finite time in seconds, or {count} of them: {value!r}")
    return np.array(np.broadcast_to(times, (count,)))


def _array(name: str, value: Any) -> NDArray[np.float64]:
    try:
        return np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be numbers: {error}") from None
