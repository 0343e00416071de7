"""Several models of one spec that are trained together: one launch of the scan for all.

A small model leaves most of a GPU idle: a batch of 50 trajectories is four blocks of the triton
backend, and a GPU runs more than a hundred at a time. Runs of equal shape that differ in their
seeds and data fill it. Each has its own weights, batches and optimizer, and ends where it would
end alone, up to rounding.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from offbeat.config import Recipe
from offbeat.errors import InputError
from offbeat.examples import Examples
from offbeat.kernels import scan
from offbeat.kernels.backends import choose
from offbeat.kernels.triton import backend as triton_backend
from offbeat.models.model import Model
from offbeat.run import RunState


class StackedModels:
    """Training steps of several models at once.

    Args:
        models: of one spec, on one device.
        examples: of each model.
        states: of each model; its optimizer changes the model's weights.
        recipe: of all of them.

    Raises:
        InputError: the models differ in shape, or draw random numbers.
    """

    def __init__(
        self,
        models: Sequence[Model],
        examples: Sequence[Examples],
        states: Sequence[RunState],
        recipe: Recipe,
    ) -> None:
        if not models or len({len(models), len(examples), len(states)}) != 1:
            raise InputError(
                f"got {len(models)} models, {len(examples)} examples and {len(states)} states; "
                "give as many of each, at least one"
            )
        for model in models:
            if model.spec != models[0].spec or model.device != models[0].device:
                raise InputError("models that are trained together must have one spec and device")
            if model.needs_generator:
                raise InputError("models that draw random numbers cannot be trained together")
        self.models, self.examples, self.states = list(models), list(examples), list(states)
        self.recipe = recipe

    def step(self, indices: Sequence[Tensor]) -> Tensor:
        """Takes a step of every optimizer.

        Args:
            indices: per model (batch,) positions of its trajectories, as many for each; they must
                have equal numbers of rows.

        Returns:
            (runs,) the losses before the step.

        Raises:
            InputError: the batches differ in trajectories or rows.
        """
        if len(indices) != len(self.models):
            raise InputError(f"got {len(indices)} batches for {len(self.models)} models")
        taken = [e.prepared.take(i).gathered() for e, i in zip(self.examples, indices, strict=True)]
        sizes = [f"{len(one)} x {one.rows}" for one in taken]
        if len(set(sizes)) > 1:
            raise InputError(
                f"the batches have {', '.join(sizes)} trajectories x rows; give each model as many"
            )
        first = [m.first_state(len(t)) for m, t in zip(self.models, taken, strict=True)]
        spec, parts = self.models[0].spec, [model.scan_parts() for model in self.models]
        choice = choose(spec, first[0].dtype, first[0].device)
        triton = choice.backend.name == "triton"
        if triton and not triton_backend.refused(spec, parts[0], taken[0], first[0]):
            found = triton_backend.scan_stacked(spec, parts, taken, torch.stack(first))
            each = list(zip(*found, strict=True))
        else:
            each = [scan(spec, *one) for one in zip(parts, taken, first, strict=True)]
        losses = []
        for i, (model, examples) in enumerate(zip(self.models, self.examples, strict=True)):
            predicted = model.decoded(taken[i], first[i], *each[i])
            losses.append(examples.loss_of(model, predicted, indices[i]))
        for state in self.states:
            state.parameters.zero_gradient()
        (torch.stack(losses).sum() * self.recipe.loss_scale).backward()  # type: ignore[no-untyped-call]
        for state in self.states:
            if self.recipe.clip_norm is not None:
                torch.nn.utils.clip_grad_norm_([state.parameters.flat], self.recipe.clip_norm)
            state.optimizer.step()
        return torch.stack([loss.detach() for loss in losses])
