"""Training steps on the CPU without autograd around the compiled calls.

A step of a small model is a few calls of compiled code between many small operations of torch,
which record a graph. For the models that most trainings use, the backward pass is known: this
module calls the same compiled code in buffers that stay, with the same bits. Autograd is left for
losses other than the mean squared error of all values.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from offbeat.config import Recipe
from offbeat.examples import Examples
from offbeat.kernels import StepTable, choose, cpu
from offbeat.kernels.backends import BACKENDS, selected
from offbeat.kernels.buffered import BufferedPerceptron, BufferedScan, PackedWeights
from offbeat.kernels.optimizer import CompiledAdamax
from offbeat.models.base import BaseModel
from offbeat.models.model import Model
from offbeat.parts import Point
from offbeat.parts.heads import Prediction
from offbeat.run import RunState


def unsupported(model: BaseModel, examples: object, recipe: Recipe) -> str | None:
    """The reason why steps need autograd; None if they do not.

    Args:
        model: that is trained.
        examples: of the epoch.
        recipe: of the training.
    """
    if type(model) is not Model or type(model.head) is not Point or model.acts:
        return "only models of parts with a point head have steps that are known"
    if type(examples) is not Examples or not isinstance(examples.prepared, StepTable):
        return "its step inputs are not in a table"
    if model.needs_generator or model.config.self_feeding:
        return "self-feeding draws the steps"
    choice = choose(model.spec, model.dtype, model.device)
    if choice.backend.name != "cpu":
        return f"its scan runs in {choice.backend.name}"
    if recipe.precision != ("bf16" if choice.variant in cpu.bf16_sets() else "float32"):
        return f"its precision is {recipe.precision}, and {choice.variant} is selected"
    if not hasattr(cpu.compiled, "move_weights"):
        return "the compiled module is of an earlier version; build it again"
    parts, one = model.scan_parts(), examples.prepared.take(torch.zeros(1, dtype=torch.int64))
    if reason := cpu.unsupported(model.spec, parts, one, model.first_state(1)):
        return reason
    start = () if model.start is None else (model.start,)
    trained = [*parts.tensors(), *(t for layer in model.head.layers for t in layer), *start]
    own = list(model.parameters())
    if sorted(map(id, trained)) != sorted(map(id, own)) or not all(p.requires_grad for p in own):
        return "its scan computes weights from parameters"
    return None


class DirectStep:
    """Losses and gradients of batches, in buffers that stay.

    Where the loss is the mean squared error of all rows but the first, its gradient follows from
    the prediction: one call decodes some states, and is back at their gradients while what it
    needs is in the cache.

    Args:
        model: for which `unsupported` is None.
        examples: of the epoch.
        state: its parameters and their gradients.
        scale: of the loss whose gradient is wanted.
    """

    def __init__(self, model: Model, examples: Examples, state: RunState, scale: float) -> None:
        self.model, self.examples, self.parameters = model, examples, state.parameters
        self._scale = scale
        self.asked = _asked(model)
        choice = choose(model.spec, model.dtype, model.device)
        self._optimizer = CompiledAdamax(state.optimizer, state.parameters.flat, choice.variant)
        self._scan = BufferedScan(model.spec, choice.variant)
        flat, gradient = state.parameters.flat, state.parameters.gradient
        scanned = list(model.scan_parts().tensors())
        self._weights = PackedWeights(scanned, flat, gradient)
        layers = model.head.layers
        self._decoder = None
        if layers:
            sizes = (layers[0][0].shape[1], *(weight.shape[0] for weight, _ in layers))
            self._decoder = BufferedPerceptron(sizes, choice.variant)
            decoding = [tensor for layer in layers for tensor in layer]
            self._decoder_weights = PackedWeights(decoding, flat, gradient)
        self._shifted = model.config.readout == "last_row"
        self._first = self._to_states = torch.empty(0)
        self._squares: tuple[Tensor, Tensor] | None = None

    def loss(self, index: Tensor) -> float:
        """The loss of some trajectories; `backward` continues from it.

        Args:
            index: (batch,) positions of the trajectories.
        """
        rows = self.examples.prepared.take(index)
        shape = (len(rows), rows.rows, self.model.spec.state_size)
        if self._to_states.shape != shape:
            self._first = self.model.first_state(len(rows)).detach().contiguous()
            # Zeros but where the prediction is read from.
            self._to_states = self._first.new_zeros(shape)
        if self.model.start is not None:
            self._first[:, : self.model.channels] = self.model.start.detach()
        before, after = self._scan.forward(self._weights.gather(), rows, self._first)
        examples = self.examples
        self._squares = None
        all_count = examples.counted is None and examples.typical is None and rows.rows > 1
        if all_count and _has_squares() and (self._decoder is not None or not self._shifted):
            self._squares = self._squared(before, after, index)
            return float(self._squares[0].mean())
        read = before
        if self._shifted:
            read = torch.cat([self._first[:, None], after[:, :-1]], 1)
        return self._loss_of(self._decode(read), index)

    def _squared(self, before: Tensor, after: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
        """Squared errors, and the gradient of the decoder's weights; sets that of the states."""
        head, targets = self.model.head, self.examples.targets
        batch, rows, outputs = len(index), before.shape[1], targets.shape[2]
        squares = before.new_empty((batch, rows - 1, outputs))
        wanted = (targets.numpy(), index.numpy(), 2.0 / squares.numel(), self._scale)
        to_states = self._to_states.numpy()
        if self._decoder is None:
            cpu.compiled.state_squares(
                before.numpy(),
                head.std.numpy(),
                head.mean.numpy(),
                *wanted,
                squares.numpy(),
                to_states,
            )
            return squares, self._first  # there are no weights
        packed = self._decoder_weights.gather()
        states, first = (after, self._first) if self._shifted else (before, None)
        to_packed = self._decoder.squares(
            packed, states, first, head.anchors, wanted, squares, to_states
        )
        return squares, to_packed

    def _decode(self, read: Tensor) -> Tensor:
        head = self.model.head
        if self._decoder is None:
            return head.anchored_values(read)
        hidden = head.hidden(read).reshape(-1, head.hidden_size)
        mean = self._decoder.forward(self._decoder_weights.gather(), hidden)
        return mean.view(*read.shape[:2], -1)

    def _loss_of(self, mean: Tensor, index: Tensor) -> float:
        self._mean = mean.requires_grad_()
        with torch.enable_grad():
            self._graph = self.examples.loss_of(self.model, Prediction(mean), index)
        return float(self._graph.detach())

    def _gradient(self) -> Tensor:
        """(batch, rows, channels) of the loss with respect to the prediction."""
        (self._graph * self._scale).backward()  # type: ignore[no-untyped-call]
        assert self._mean.grad is not None
        return self._mean.grad

    def backward(self) -> None:
        """Sets the gradients of the parameters to those of the newest loss."""
        self.parameters.zero_gradient()
        if self._squares is None:
            to_states = self._through_head(self._gradient())
        else:
            if self._decoder is not None:
                self._decoder_weights.add(self._squares[1])
            to_states = self._to_states
        to_packed, to_first = self._scan.backward(
            *((None, to_states) if self._shifted else (to_states, None))
        )
        self._weights.add(to_packed)
        if self.model.start is not None:
            assert self.model.start.grad is not None
            self.model.start.grad.add_(to_first.sum(0)[: self.model.channels])

    def _through_head(self, to_mean: Tensor) -> Tensor:
        """(batch, rows, state_size) gradient of the states from that of the prediction."""
        head = self.model.head
        if self._decoder is None:
            to_x, at = to_mean * head.std, slice(0, self.model.channels)
        else:
            to_packed, to_x = self._decoder.backward(to_mean.view(-1, self.model.channels))
            self._decoder_weights.add(to_packed)
            at = slice(head.anchors, head.anchors + head.hidden_size)
        to_read = to_x.view(*to_mean.shape[:2], -1)
        if self._shifted:
            self._to_states[:, :-1, at] = to_read[:, 1:]
        elif to_read.shape[2] == self._to_states.shape[2]:
            return to_read
        else:
            self._to_states[..., at] = to_read
        return self._to_states

    def descend(self) -> None:
        """Takes the step of the optimizer."""
        self._optimizer.step()


def _asked(model: Model) -> tuple[Any, ...]:
    """What the choice of a backend for a model depends on."""
    return (*selected(), *BACKENDS, model.dtype, model.device)


def _has_squares() -> bool:
    """Whether the compiled module is not of an earlier version."""
    return hasattr(cpu.compiled, "state_squares")


def direct_step(
    model: BaseModel, examples: object, state: RunState, recipe: Recipe
) -> DirectStep | None:
    """The step of a training without autograd, or None where it needs that.

    Args:
        model: that is trained.
        examples: of the epoch.
        state: of the training; keeps the step.
        recipe: of the training.
    """
    known = state.direct
    if known is None or known[0] is not model or known[1] is not examples:
        made = None
        if unsupported(model, examples, recipe) is None:
            assert isinstance(model, Model)
            assert isinstance(examples, Examples)
            made = DirectStep(model, examples, state, recipe.loss_scale)
        known = state.direct = (model, examples, made)
    step: DirectStep | None = known[2]
    return step if step is not None and _asked(step.model) == step.asked else None
