"""One streaming step of a model as an ONNX graph, its state as inputs and outputs.

The step is written out for one row of one trajectory, from the model's weights: times in float64,
values in original units, everything else in the type of the weights. It must say what `Stream`
says; the tests hold that for every model.
"""

from __future__ import annotations

import json
import logging
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import linear, softplus

from offbeat.errors import InputError, one_of, require
from offbeat.files import atomic_path
from offbeat.inference.onnx_runner import FORMAT, METADATA, STATE, VERSION
from offbeat.kernels import LARGEST_EXPONENT, perceptron
from offbeat.models.decay import ExponentialDecay, TrainableDecay
from offbeat.models.recurrence import RecurrentModel
from offbeat.solvers import tableau

MOST_STEPS = 256
"""Solver steps over one gap that are written out; more make a graph that nobody wants to load."""


def export_onnx(model: RecurrentModel, path: str | Path) -> None:
    """Writes one streaming step of a model as an ONNX file, for `OnnxStream` or any ONNX runtime.

    Inputs: `t` (1,) float64, s, on any clock that keeps its origin; `values` (1, channels) float64
    in original units, NaN where not measured; and the state. Outputs: `prediction` (1, channels)
    float64 in original units, of a row at `t`, before its values are looked at; and the state
    after the row, each part named as the input with `_next`. A prediction alone is the same step
    with all values NaN, its state thrown away. The state before anything was seen, channel names
    and units stand as JSON in the metadata under `offbeat`.

    Args:
        model: trained.
        path: .onnx file to write, whole or not at all.

    Raises:
        InputError: an adaptive solver, whose number of steps no fixed graph can have; more than
            256 steps over a gap; self-feeding, which draws coins; or another suffix.
        MissingExtraError: onnx or onnxscript is not installed.
    """
    path = Path(path)
    one_of("suffix of an ONNX file", path.suffix, (".onnx",))
    _check_exportable(model)
    onnx = require("onnx", "export")
    require("onnxscript", "export")
    step = StreamStep(model).eval()
    carry = model.empty_carry(1)
    initial = {name: getattr(carry, name).detach().clone() for name in STATE}
    inputs = (
        torch.zeros(1, dtype=torch.float64),
        torch.zeros((1, model.channels), dtype=torch.float64),
        *initial.values(),
    )
    with torch.no_grad(), _quiet():
        program: Any = torch.onnx.export(
            step,
            inputs,
            input_names=["t", "values", *STATE],
            output_names=["prediction", *(f"{name}_next" for name in STATE)],
            dynamo=True,
            verbose=False,
        )
    proto = program.model_proto
    entry = proto.metadata_props.add()
    entry.key, entry.value = METADATA, json.dumps(_facts(model, initial), allow_nan=False)
    onnx.checker.check_model(proto)
    with atomic_path(path) as temporary:
        temporary.write_bytes(proto.SerializeToString())


@contextmanager
def _quiet() -> Iterator[None]:
    """Keeps to itself what the exporter says of its own insides."""
    log = logging.getLogger("torch.onnx")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.setLevel(level)


def _facts(model: RecurrentModel, initial: dict[str, Tensor]) -> dict[str, Any]:
    """What a stream must know that the graph does not say."""
    limit = float(model.config.gap_limit or 1)
    finite = {  # JSON has no infinities: these begin as the runner knows
        name: initial[name].tolist() for name in ("state", "last")
    }
    return {
        "format": FORMAT,
        "version": VERSION,
        "model": model.config.name,
        "names": list(model.names),
        "units": list(model.units),
        "median_gap_s": model.statistics.median_gap,
        "elapsed_limit_s": model.statistics.longest_elapsed * limit,
        "dtype": str(model.dtype).removeprefix("torch."),
        "initial": finite,
    }


def _check_exportable(model: RecurrentModel) -> None:
    if model.config.self_feeding:
        raise InputError(
            "a model with self_feeding draws a coin at every row, which no graph can; train one "
            "without self_feeding to export it"
        )
    if not model.spec.has_field:
        return
    if tableau(model.spec.solver).adaptive:
        raise InputError(
            f"the solver {model.spec.solver!r} takes as many steps as a gap needs, and an ONNX "
            "graph has a fixed number of them; train or load the model with a solver of fixed "
            "steps (euler, midpoint, heun, rk4), or stream it with offbeat.Stream"
        )
    steps = _most_steps(model)
    if steps > MOST_STEPS:
        raise InputError(
            f"max_step={model.spec.max_step} makes up to {steps} steps over a gap, more than the "
            f"{MOST_STEPS} that are written out; use a longer max_step, or offbeat.Stream"
        )


def _most_steps(model: RecurrentModel) -> int:
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
    median_gap: Tensor
    elapsed_limit: Tensor
    delta_limit: Tensor

    def __init__(self, model: RecurrentModel) -> None:
        super().__init__()
        self.model = model
        self.most_steps = _most_steps(model) if model.spec.has_field else 1
        self.register_buffer("shift", torch.tensor(model.scaler.shift)[None])
        self.register_buffer("scale", torch.tensor(model.scaler.scale)[None])
        # Tensors, not numbers: the exporter writes a number down in float32.
        statistics, limit = model.statistics, float(model.config.gap_limit or 1)
        for name, number in (
            ("unit", model.time_unit),
            ("median_gap", statistics.median_gap),
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
        """Prediction and next state; shapes as in `Carry`, of one trajectory."""
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
        prediction = model.read(read).double() * self.scale + self.shift

        shown = scaled
        if model.input_decay is not None:  # equation 27
            age = (delta / unit).to(dtype)
            weight, bias = model.input_decay.weight, model.input_decay.bias
            gamma = torch.exp(-(weight * age + bias).clamp_min(0.0))
            shown = torch.where(mask, scaled, gamma * last + (1 - gamma) * model.mean)
        elif model.spec.anchored:
            shown = torch.where(mask, (scaled - model.mean) / model.std, zero)
        context = [shown, mask.to(dtype)]
        if config.age_input == "delta":
            age = torch.minimum(delta, self.delta_limit)
            context.append((age / self.median_gap).to(dtype))
        elif config.age_input in ("elapsed", "gap"):
            age = elapsed if config.age_input == "elapsed" else t - before
            context.append((age / self.median_gap).to(dtype)[:, None])
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
        decay = model.decay
        if decay is None:
            return None
        if isinstance(decay, TrainableDecay):
            start, end = (
                linear((age / unit).to(dtype), decay.weight, decay.bias)
                for age in (delta_before, delta)
            )
        else:
            assert isinstance(decay, ExponentialDecay)
            tau = softplus(decay.raw_tau).expand(decay.hidden_size)
            start, end = (
                (age / unit).to(dtype)[:, None] * tau for age in (elapsed_before, elapsed)
            )
        rows = model.config.decay_rows
        if rows == "every_row" and isinstance(decay, TrainableDecay):
            return end, end, torch.zeros_like(end)
        if rows == "observed_rows":
            end = torch.where(update[:, None], end, torch.zeros_like(end))
            return end, end, torch.zeros_like(end)
        carries = start.clamp(0.0, LARGEST_EXPONENT)
        return start, end, torch.where(updated[:, None], torch.zeros_like(carries), carries)

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
        assert self.model.field is not None
        return perceptron(self.model.field.layers, y, self.model.spec.activation)

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
        first = self.model.spec.anchored
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
