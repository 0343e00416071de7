"""Heads: map a state to a prediction, and define the loss of the prediction."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn.functional import mse_loss, softplus

from offbeat.kernels import perceptron
from offbeat.parts.fields import Perceptron
from offbeat.registry import Registry


@dataclass(frozen=True, eq=False)
class Prediction:
    """A prediction of a model for each row, in scaled units.

    Attributes:
        mean: (batch, rows, channels).
        scale: (batch, rows, channels) standard deviation, of heads that have one; else None.
    """

    mean: Tensor
    scale: Tensor | None = None


@dataclass(frozen=True, eq=False)
class HeadShape:
    """Sizes and statistics that a head is built from.

    Attributes:
        channels: width of the prediction.
        hidden_size: units of h.
        anchored: the state begins with the channels, in units of `std` around `mean`.
        trend: the slopes of the channels follow.
        units: hidden layers of the head's perceptron.
        mean: (channels,) training mean, scaled units.
        std: (channels,) training standard deviation, scaled units.
        actions: positions of the channels with the role `action`.
    """

    channels: int
    hidden_size: int
    anchored: bool
    units: tuple[int, ...]
    mean: Tensor
    std: Tensor
    actions: tuple[int, ...] = ()
    trend: bool = False

    @property
    def anchors(self) -> int:
        """Units of the state before h."""
        return (2 if self.trend else 1) * self.channels if self.anchored else 0


class Head(nn.Module):
    """Base class of heads. A subclass overrides `decode`, and `loss` where it differs.

    Args:
        shape: sizes and statistics.
    """

    mean: Tensor
    std: Tensor
    _acts: Tensor

    def __init__(self, shape: HeadShape) -> None:
        super().__init__()
        self.channels, self.hidden_size = shape.channels, shape.hidden_size
        self.anchored, self.anchors = shape.anchored, shape.anchors
        self.register_buffer("mean", shape.mean, persistent=False)
        self.register_buffer("std", shape.std, persistent=False)
        # An observation sets its channels of x, and only h is updated with weights: actions
        # are decoded from x and h together.
        self.actions, self.policy = list(shape.actions), None
        self.register_buffer(
            "_acts", torch.tensor(self.actions, dtype=torch.int64), persistent=False
        )
        if shape.anchored and shape.actions:
            width = shape.anchors + shape.hidden_size
            self.policy = Perceptron((width, *shape.units, len(shape.actions)), "tanh")

    def decode(self, state: Tensor) -> Prediction:
        """(..., state_size) states to a prediction of (..., channels) in scaled units."""
        raise NotImplementedError(f"{type(self).__name__} must define decode")

    def decode_observations(self, state: Tensor) -> Prediction:
        """As `decode`, where actions are not read, so that a head need not compute them."""
        return self.decode(state)

    def loss(self, prediction: Prediction, target: Tensor, mask: Tensor | None) -> Tensor:
        """Mean squared error over the entries that count.

        Args:
            prediction: of (batch, rows, channels).
            target: (batch, rows, channels) scaled units; any finite number where it is unknown.
            mask: (batch, rows, channels) 1.0 where the target counts, else 0.0; None: all count.
        """
        if mask is None:
            return mse_loss(prediction.mean, target)
        squared = (prediction.mean - target).square()
        return (squared * mask).sum() / mask.sum().clamp_min(1)

    @property
    def layers(self) -> tuple[tuple[Tensor, Tensor], ...]:
        """Weight and bias of each layer of the decoder; empty if the state is the prediction."""
        return ()

    def hidden(self, state: Tensor) -> Tensor:
        """(..., hidden) h of a state."""
        return state[..., self.anchors : self.anchors + self.hidden_size]

    def anchored_values(self, state: Tensor) -> Tensor:
        """(..., channels) the channels of an anchored state, in scaled units.

        Actions, where there are any, are decoded from the whole state.
        """
        x = state[..., : self.channels]
        if self.policy is not None:
            driven = state[..., : self.anchors + self.hidden_size]
            chosen = perceptron(self.policy.layers, driven, "tanh")
            x = x.index_copy(-1, self._acts, chosen)
        return x * self.std + self.mean


class Point(Head):
    """The expected value alone, trained on the mean squared error.

    An anchored state holds the prediction itself. Otherwise a perceptron of h gives it.
    """

    def __init__(self, shape: HeadShape) -> None:
        super().__init__(shape)
        self.decoder = None
        if not shape.anchored:
            self.decoder = Perceptron((shape.hidden_size, *shape.units, shape.channels), "tanh")

    @property
    def layers(self) -> tuple[tuple[Tensor, Tensor], ...]:
        """Weight and bias of each layer of the decoder; empty for an anchored state."""
        return () if self.decoder is None else self.decoder.layers

    def decode(self, state: Tensor) -> Prediction:
        """(..., state_size) to a prediction of (..., channels)."""
        if self.decoder is None:
            return Prediction(self.anchored_values(state))
        return Prediction(perceptron(self.decoder.layers, self.hidden(state), "tanh"))


class Gaussian(Head):
    """A mean and a standard deviation per channel, trained on the negative log-likelihood.

    The loss is that of a normal distribution, without its constant: log s + (x - m)^2 / (2 s^2).
    """

    SMALLEST = 1e-4
    """Minimum standard deviation, scaled units; bounds the likelihood of constant channels."""

    def __init__(self, shape: HeadShape) -> None:
        super().__init__(shape)
        width = shape.channels if shape.anchored else 2 * shape.channels
        self.decoder = Perceptron((shape.hidden_size, *shape.units, width), "tanh")

    def decode(self, state: Tensor) -> Prediction:
        """(..., state_size) to means and standard deviations of (..., channels)."""
        decoded = perceptron(self.decoder.layers, self.hidden(state), "tanh")
        if self.anchored:
            mean, raw = self.anchored_values(state), decoded
        else:
            mean, raw = decoded[..., : self.channels], decoded[..., self.channels :]
        return Prediction(mean, softplus(raw) * self.std + self.SMALLEST)

    def loss(self, prediction: Prediction, target: Tensor, mask: Tensor | None) -> Tensor:
        """Mean negative log-likelihood over the entries that count, without its constant."""
        assert prediction.scale is not None
        each = torch.log(prediction.scale)
        each = each + 0.5 * ((target - prediction.mean) / prediction.scale).square()
        if mask is None:
            return each.mean()
        return (each * mask).sum() / mask.sum().clamp_min(1)


HEADS: Registry[type[Head]] = Registry("head", group="offbeat.heads")
"""Heads by the name that `ModelConfig.head` takes."""

HEADS.register("point", Point)
HEADS.register("gaussian", Gaussian)


class Actions(Point):
    """As `Point`, with actions bounded by tanh: scaled, they lie in -1 to 1."""

    def decode(self, state: Tensor) -> Prediction:
        """(..., state_size) to a prediction of (..., channels)."""
        return _bounded(super().decode(state), self._acts)

    def decode_observations(self, state: Tensor) -> Prediction:
        """(..., state_size) to a prediction whose actions are not those of the policy."""
        if not self.anchored:
            return self.decode(state)
        return Prediction(state[..., : self.channels] * self.std + self.mean)


class GaussianActions(Gaussian):
    """As `Gaussian`, with means of actions bounded by tanh: scaled, they lie in -1 to 1."""

    def decode(self, state: Tensor) -> Prediction:
        """(..., state_size) to means and standard deviations of (..., channels)."""
        return _bounded(super().decode(state), self._acts)


def _bounded(prediction: Prediction, actions: Tensor) -> Prediction:
    """The prediction with tanh of the means of some channels."""
    mean = prediction.mean
    chosen = torch.tanh(mean.index_select(-1, actions))
    return Prediction(mean.index_copy(-1, actions, chosen), prediction.scale)


HEADS.register("actions", Actions)
HEADS.register("gaussian_actions", GaussianActions)
