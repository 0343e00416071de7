"""One streaming step, written out for one row of one trajectory, without a loop over rows.

An ONNX graph has to be made of plain operations, so the step is written down once more, from the
weights of a model: times in float64, values in original units, everything else in the type of the
weights. It must say what `Stream` says; the tests hold that for every model.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from offbeat.kernels import LARGEST_EXPONENT, Layers
from offbeat.kernels.reference import perceptron
from offbeat.models.model import Model
from offbeat.ode import tableau
from offbeat.parts.decay import TrainableDecay


def most_steps(model: Model) -> int:
    """Solver steps over the longest gap there is."""
    if model.spec.max_step is None:
        return model.spec.steps_per_gap
    longest = model.statistics.longest_elapsed * float(model.config.gap_limit or 1)
    needed = math.ceil(longest / model.time_unit / model.spec.max_step - 1e-6)
    return max(model.spec.steps_per_gap, needed)


class StreamStep(nn.Module):
    """One row: ages, x-hat, decay, flow, prediction, cell; the equations of `models`, unrolled.

    Args:
        model: its parts are used as they are.
    """

    shift: Tensor
    scale: Tensor
    unit: Tensor
    time_input_unit: Tensor
    elapsed_limit: Tensor
    delta_limit: Tensor

    def __init__(self, model: Model) -> None:
        super().__init__()
        self.model = model
        self.most_steps = most_steps(model)
        self.register_buffer("shift", torch.tensor(model.scaler.shift)[None])
        self.register_buffer("scale", torch.tensor(model.scaler.scale)[None])
        # Tensors, not numbers: the exporter writes a number down in float32.
        statistics, limit = model.statistics, float(model.config.gap_limit or 1)
        for name, number in (
            ("unit", model.time_unit),
            ("time_input_unit", model.time_input_unit),
            ("elapsed_limit", statistics.longest_elapsed * limit),
            ("delta_limit", statistics.longest_delta * limit),
        ):
            self.register_buffer(name, torch.tensor(number, dtype=torch.float64))

    def forward(
        self,
        t: Tensor,
        values: Tensor,
        state: Tensor,
        time: Tensor,
        start: Tensor,
        observed_at: Tensor,
        channel_at: Tensor,
        last: Tensor,
        updated: Tensor,
    ) -> tuple[Tensor, ...]:
        """Prediction and next state; shapes as in `RecurrentState`, of one trajectory."""
        model, config, unit, dtype = self.model, self.model.config, self.unit, self.model.dtype
        scaled = ((values - self.shift) / self.scale).to(dtype)
        mask = scaled.abs() < math.inf  # False for NaN, too
        zero = torch.zeros_like(scaled)
        scaled = torch.where(mask, scaled, zero)
        observed = mask.any(dim=1)

        # ages (models/ages.py): before the first row there is no gap; nothing moves before `start`
        before = torch.where(time.isnan(), t, time)
        moving = torch.ones_like(observed) if config.clock == "first_row" else observed
        started = torch.where(moving, torch.minimum(start, t), start)
        clock = torch.maximum(observed_at, started)
        channel_clock = torch.maximum(channel_at, started[:, None])
        passed, passed_before = (t - clock).clamp_min(0.0), (before - clock).clamp_min(0.0)
        elapsed = torch.minimum(passed, self.elapsed_limit)
        elapsed_before = torch.minimum(passed_before, self.elapsed_limit)
        delta = ((t - (passed - elapsed))[:, None] - channel_clock).clamp_min(0.0)
        delta_before = (before - (passed_before - elapsed_before))[:, None] - channel_clock
        delta_before = delta_before.clamp_min(0.0)
        gap = ((elapsed - elapsed_before) / unit).to(dtype)[:, None]

        update = observed
        if config.cell == "none":
            update = observed & (observed_at == -math.inf)
        elif config.update_rows == "every":
            update = torch.ones_like(observed)

        read = state
        carried = self._carried(
            state,
            gap,
            self._decay(delta_before, delta, elapsed_before, elapsed, update, updated),
        )
        if config.readout != "last_row":
            read = carried
        prediction = self._read(read).double() * self.scale + self.shift

        shown = scaled
        if model.input_decay is not None:  # equation 27
            age = (delta / unit).to(dtype)
            weight, bias = model.input_decay.weights()
            gamma = torch.exp(-(weight * age + bias).clamp_min(0.0))
            shown = torch.where(mask, scaled, gamma * last + (1 - gamma) * model.mean)
        elif model.spec.anchored:
            shown = torch.where(mask, (scaled - model.mean) / model.std, zero)
        context = [shown, mask.to(dtype)]
        if config.time_input == "delta":
            age = torch.minimum(delta, self.delta_limit)
            context.append((age / self.time_input_unit).to(dtype))
        elif config.time_input in ("elapsed", "gap"):
            age = elapsed if config.time_input == "elapsed" else t - before
            context.append((age / self.time_input_unit).to(dtype)[:, None])
        gates = linear(torch.cat(context, dim=1), model.cell.inputs, model.cell.bias)
        after = self._updated(carried, gates, update.to(dtype)[:, None], shown, mask.to(dtype))
        return (
            prediction,
            after,
            t.clone(),
            started,
            torch.where(observed, t, observed_at),
            torch.where(mask, t[:, None], channel_at),
            torch.where(mask, scaled, last),
            update,
        )

    def _decay(
        self,
        delta_before: Tensor,
        delta: Tensor,
        elapsed_before: Tensor,
        elapsed: Tensor,
        update: Tensor,
        updated: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor] | None:
        """Exponents at the start and the end of the gap, and what the state carries already."""
        model, unit, dtype = self.model, self.unit, self.model.dtype
        if model.decay is None:
            return None
        ages = elapsed_before[:, None], elapsed[:, None]
        if isinstance(model.decay, TrainableDecay):
            ages = delta_before, delta
        start, end = (linear((age / unit).to(dtype), *model.decay.weights()) for age in ages)
        if model.spec.decay_rows == "continuous":
            carries = start.clamp(0.0, LARGEST_EXPONENT)
            return start, end, torch.where(updated[:, None], torch.zeros_like(carries), carries)
        if model.spec.decay_rows == "observed_rows":
            end = torch.where(update[:, None], end, torch.zeros_like(end))
        return end, end, torch.zeros_like(end)

    def _carried(
        self, state: Tensor, gap: Tensor, decay: tuple[Tensor, Tensor, Tensor] | None
    ) -> Tensor:
        """Decay and flow over the gap, in equal steps, the decay of each step before it."""
        model, spec = self.model, self.model.spec
        x, h, memory = self._split(state)
        if model.field is None:
            if decay is not None:
                _, end, applied = decay
                h = h * torch.exp(applied - end.clamp(0.0, LARGEST_EXPONENT))
            return torch.cat([x, h, memory], dim=1)
        least = spec.steps_per_gap
        count = None
        if spec.max_step is not None:
            count = torch.ceil(gap / spec.max_step - 1e-6).clamp_min(least)
        for k in range(1, self.most_steps + 1):
            length = gap / torch.tensor(float(least), dtype=gap.dtype)
            if count is not None:
                length = torch.where(count >= k, gap / count, torch.zeros_like(gap))
            if decay is not None:
                start, end, applied = decay
                share = torch.tensor(k / least, dtype=gap.dtype)
                if count is not None:
                    share = (k / count).clamp_max(1.0)
                reached = (start + share * (end - start)).clamp(0.0, LARGEST_EXPONENT)
                h = h * torch.exp(-(reached - applied).clamp_min(0.0))
                decay = start, end, torch.maximum(applied, reached)
            x, h = self._stepped(x, h, length)
        return torch.cat([x, h, memory], dim=1)

    def _stepped(self, x: Tensor, h: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
        """One Runge-Kutta step of (x, h)."""
        scheme = tableau(self.model.spec.solver)
        y = torch.cat([x, h], dim=1)
        slopes: list[Tensor] = []
        for weights in scheme.a:
            slopes.append(self._field(y + length * _weighted(slopes, weights) if weights else y))
        y = y + length * _weighted(slopes, scheme.b)
        return y[:, : x.shape[1]], y[:, x.shape[1] :]

    def _field(self, y: Tensor) -> Tensor:
        layers: Layers = getattr(self.model.field, "layers", ())
        return perceptron(layers, y, self.model.spec.activation)

    def _read(self, state: Tensor) -> Tensor:
        """The prediction in scaled units."""
        model = self.model
        x, h, _ = self._split(state)
        if not model.head.layers:
            return x * model.std + model.mean
        return perceptron(model.head.layers, h, "tanh")

    def _updated(
        self, state: Tensor, gates: Tensor, update: Tensor, values: Tensor, mask: Tensor
    ) -> Tensor:
        """The cell at an observation, equations 6, 14-19, 20-23 and 29-32, or the old state."""
        cell, spec, n = self.model.cell, self.model.spec, self.model.hidden_size
        x, h, memory = self._split(state)
        if cell.innovation is not None:
            gates = gates + linear(mask * (values - x), cell.innovation)
        x = torch.where(mask > 0, values, x) if spec.anchored else x
        if spec.cell == "set":
            new, new_memory = gates, memory
        elif spec.cell == "elman":
            assert cell.recurrent is not None
            new, new_memory = torch.tanh(gates + linear(h, cell.recurrent)), memory
        elif spec.cell == "lstm":
            assert cell.recurrent is not None
            forget, insert, node, output = (gates + linear(h, cell.recurrent)).chunk(4, dim=1)
            kept = torch.sigmoid(forget) * memory
            new_memory = kept + torch.sigmoid(insert) * torch.tanh(node)
            new = torch.sigmoid(output) * torch.tanh(new_memory)
        else:
            assert cell.recurrent is not None
            recurrent = cell.recurrent
            both = torch.sigmoid(gates[:, : 2 * n] + linear(h, recurrent[: 2 * n]))
            z, r = both[:, :n], both[:, n:]
            if spec.reset_after:
                product = r * linear(h, recurrent[2 * n :], cell.recurrent_bias)
            else:
                product = linear(r * h, recurrent[2 * n :])
            candidate = torch.tanh(gates[:, 2 * n :] + product)
            new, new_memory = h + z * (candidate - h), memory
        acts = update > 0
        return torch.cat(
            [x, torch.where(acts, new, h), torch.where(acts, new_memory, memory)], dim=1
        )

    def _split(self, state: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The anchored channels, h, and the memory of an LSTM; what there is none of is empty."""
        first = self.model.spec.anchors
        last = first + self.model.hidden_size
        return state[:, :first], state[:, first:last], state[:, last:]


def _weighted(slopes: list[Tensor], weights: tuple[float, ...]) -> Tensor:
    """The sum of `weights[i] * slopes[i]`, weights of 0 left out."""
    pairs = [(k, w) for k, w in zip(slopes, weights, strict=True) if w != 0]
    terms = [k if w == 1 else k * torch.tensor(w, dtype=k.dtype) for k, w in pairs]
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total
