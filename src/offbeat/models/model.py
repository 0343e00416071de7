"""The recurrent model: a choice of parts around one scan.

    decay -> dynamics over the gap -> (read here: prediction from the past) -> cell -> (read here)

`models.zoo` has the choices. Training, prediction and streaming all run `Model.forward`: a stream
is the same call with one row and the `RecurrentState` of the rows before.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor, nn

from offbeat.config import ModelConfig
from offbeat.data.batch import Batch
from offbeat.data.trajectory import ACTION
from offbeat.errors import InputError
from offbeat.kernels import (
    ScanParts,
    ScanSpec,
    StepInputs,
    StepTable,
    TableSteps,
    choose,
    scan,
)
from offbeat.kernels.spec import MOST_NODES, nodes_before
from offbeat.models.base import BaseModel, DataInfo
from offbeat.models.elapsed import ElapsedTimes, RecurrentState, at_last, elapsed_times
from offbeat.models.gains import Filters
from offbeat.ode import tableau
from offbeat.parts import CELLS, FIELDS, HEADS, Cell, HeadShape, Perceptron, Prediction
from offbeat.parts.decay import ExponentialDecay, InputDecay, TrainableDecay
from offbeat.parts.trend import Trend


@dataclass(frozen=True, eq=False)
class Output(Prediction):
    """A prediction, and the states it was decoded from.

    Attributes:
        mean: (batch, rows, channels) scaled units; the value expected at each row.
        scale: (batch, rows, channels) of heads that have one; else None.
        before: (batch, rows, state_size) state before the observation of each row.
        after: (batch, rows, state_size) state after each row; with solver nodes at observations, of
            the last node before a row in which nothing is observed.
        past: recurrent state for later rows; None from `run`.
    """

    before: Tensor | None = None
    after: Tensor | None = None
    past: RecurrentState | None = None


WIDENING = 0.5
"""Fraction of the range of training by which the range of a bounded model is wider on each side."""

LARGEST_VALUE = 1e15
"""Bound of the values of a bounded model, in units of their spread; keeps sums finite."""


class Model(BaseModel):
    """A recurrent model of unevenly sampled motion, composed of parts.

    Args:
        config: with every field set; `zoo.make_model` fills in the others.
        data: properties of the data that it is made for.
        seed: of the initial weights.

    Raises:
        InputError: a field of the config is None, or parts are incompatible.
    """

    is_action: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, config: ModelConfig, data: DataInfo, *, seed: int = 0) -> None:
        super().__init__(config.name, data)
        _check(config)
        self.config = config
        statistics = data.statistics
        self.time_unit = statistics.median_gap / float(config.typical_gap or 1)
        channels, hidden = self.channels, int(config.hidden_size or 1)
        self.hidden_size = hidden

        self.decay = _decay(config, channels, hidden)
        self.input_decay = InputDecay(channels) if config.input_decay else None
        kind = CELLS["start" if config.cell == "none" else config.cell or "gru"]
        self.spec = _spec(
            config, channels, self.decay, kind, longest=self.elapsed_limit / self.time_unit
        )
        anchored = channels if self.spec.anchored else 0
        self.trend = Trend(channels) if self.spec.trend else None
        self.filters = Filters.of(statistics.filters)
        if self.trend is not None and len(statistics.filters) != channels:
            raise InputError(
                f"a model with a trend needs a filter for each of its {channels} channels in the "
                f"statistics, got {len(statistics.filters)}; offbeat.make_model tunes them"
            )
        self.cell = kind(
            2 * channels + self.spec.time_inputs,
            hidden,
            innovation=anchored if config.cell != "none" else 0,
            reset_after=self.spec.reset_after,
        )
        self.field = None
        if self.spec.field:
            field = FIELDS[self.spec.field_kind]
            sizes = (self.spec.field[0], *(config.field_units or ()), self.spec.field[-1])
            self.field = field(sizes=sizes, activation=self.spec.activation)
        if self.trend is not None and isinstance(self.field, Perceptron):
            # Optimizers take steps of one size, whatever a channel's errors are.
            error = self.filters.error.to(self.mean.dtype)
            self.field.unit = torch.cat([error, error, torch.ones(hidden)])
        self.start = nn.Parameter(torch.zeros(channels)) if anchored else None
        shape = HeadShape(
            channels=channels,
            hidden_size=hidden,
            anchored=bool(anchored),
            units=tuple(config.decoder_units or ()),
            mean=self.mean.clone(),
            std=self.std.clone(),
            actions=tuple(i for i, role in enumerate(self.roles) if role == ACTION),
            trend=self.spec.trend,
        )
        self.head = HEADS[config.head or "point"](shape)
        low, high = self._range()
        acts = torch.tensor([role == ACTION for role in self.roles])
        self.register_buffer("is_action", acts, persistent=False)
        self.register_buffer("low", low, persistent=False)
        self.register_buffer("high", high, persistent=False)
        self._initialise(seed)

    def _range(self) -> tuple[Tensor, Tensor]:
        """(channels,) bounds of the values, in the units that the cell is given them in.

        With a trend, (2 channels,): a slope is within its bounds if it crosses the range of its
        channel in no less than a typical gap.
        """
        infinite = torch.full((self.channels,), torch.inf)
        if not self.spec.bounded:
            return -infinite, infinite
        low, high = (
            torch.tensor(bound, dtype=torch.float64)
            for bound in (self.statistics.low, self.statistics.high)
        )
        wider = WIDENING * (high - low)
        low, high = low - wider, high + wider
        if self.spec.anchored:
            mean, std = (
                torch.tensor(v, dtype=torch.float64)
                for v in (self.statistics.mean, self.statistics.std)
            )
            low, high = (low - mean) / std, (high - mean) / std
        if self.spec.trend:
            slope = (high - low) / float(self.config.typical_gap or 1)
            low, high = torch.cat([low, -slope]), torch.cat([high, slope])
        return low.to(self.mean.dtype), high.to(self.mean.dtype)

    def _initialise(self, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        init = self.config.init or "normal"
        with torch.no_grad():
            for name, parameter in self.named_parameters():
                if "bias" in name:
                    continue
                fan_in = init == "fan_in" and parameter.ndim >= 2
                std = parameter.shape[1] ** -0.5 if fan_in else 0.1
                parameter.normal_(0.0, std, generator=generator)
            for part in (self.decay, self.input_decay):
                if isinstance(part, TrainableDecay | InputDecay):
                    part.weight.abs_()  # a negative weight of equation 26 gets no gradient
            if init == "fan_in" and isinstance(self.field, Perceptron):
                self.field.weights[-1].mul_(0.1)
            if self.start is not None:
                self.start.zero_()
            if self.trend is not None:
                self.trend.begin(self.filters.damping(self.time_unit))
                if isinstance(self.field, Perceptron):
                    self.field.weights[-1][: self.spec.anchors].zero_()

    @property
    def dtype(self) -> torch.dtype:
        """Dtype of the weights."""
        return self.cell.bias.dtype

    @property
    def elapsed_limit(self) -> float:
        """s, at which the time since the last observed row saturates."""
        return self.statistics.longest_elapsed * float(self.config.gap_limit or 1)

    def expect_silences(self, seconds: float) -> None:
        """See `BaseModel`."""
        super().expect_silences(seconds)
        if self.spec.nodes:
            self.spec = replace(self.spec, decay_span=self.elapsed_limit / self.time_unit)

    @property
    def time_input_unit(self) -> float:
        """s, unit of the time input of a cell."""
        if self.config.time_input_unit == "longest":
            return self.statistics.longest_delta
        return self.statistics.median_gap

    @property
    def needs_generator(self) -> bool:
        """Whether predictions draw random numbers: self-feeding does."""
        return bool(self.config.self_feeding)

    def threads(self) -> AbstractContextManager[None]:
        """A context manager that assigns the threads for training this model."""
        return choose(self.spec, self.dtype, self.device).backend.training()

    @property
    def acts(self) -> bool:
        """Whether a channel is an action."""
        return ACTION in self.roles

    def empty_state(
        self, batch: int, *, generator: torch.Generator | None = None
    ) -> RecurrentState:
        """The recurrent state before the first row.

        Args:
            batch: number of trajectories.
            generator: generator of self-feeding; by default one seeded with 0.
        """
        if generator is None and self.config.self_feeding:
            generator = torch.Generator().manual_seed(0)
        empty = RecurrentState.empty(self.first_state(batch), self.mean, generator=generator)
        if self.trend is not None:
            prior = self._filters_here().prior()
            empty = replace(empty, covariance=prior.expand(batch, -1, -1))
        return empty

    def _filters_here(self) -> Filters:
        """The filters on the device of the model."""
        if self.filters.table.device != self.device:
            self.filters = self.filters.to(self.device)
        return self.filters

    def backend(self) -> tuple[str, str]:
        """The variant of the scan's backend that runs this model, and the reason."""
        choice = choose(self.spec, self.dtype, self.device)
        return choice.variant, choice.reason

    def first_state(self, batch: int) -> Tensor:
        """(batch, state_size) before the first observation.

        Args:
            batch: number of trajectories.
        """
        known = 0 if self.start is None else len(self.start)
        state = self.cell.bias.new_zeros(self.spec.state_size - known)
        if self.start is not None:
            state = torch.cat([self.start, state])
        return state.expand(batch, -1)

    def forward(
        self,
        batch: Batch,
        *,
        past: RecurrentState | None = None,
        generator: torch.Generator | None = None,
    ) -> Output:
        """Predicts every row of a batch from earlier observations.

        Args:
            batch: scaled; rows to come, in order.
            past: state after the earlier rows; by default there are none.
            generator: of self-feeding; used if `past` is None.

        Raises:
            InputError: the batch has other channels than the model.
        """
        if past is None:
            past = self.empty_state(len(batch), generator=generator)
        inputs, ended = self.step_inputs(batch, past)
        output = self.run(inputs, past.state, generator=past.generator, seen=past.rows)
        assert output.after is not None
        return replace(output, past=replace(ended, state=output.after[:, -1]))

    def prepare(self, batch: Batch) -> StepTable:
        """The step inputs of a batch in one table.

        Args:
            batch: scaled.
        """
        return StepTable.of(self.step_inputs(batch, ends=False)[0])

    def run(
        self,
        prepared: StepInputs | TableSteps,
        state: Tensor | None = None,
        *,
        generator: torch.Generator | None = None,
        seen: int = 0,
    ) -> Output:
        """Predicts rows from their step inputs: the part of `forward` with parameters.

        Args:
            prepared: from `step_inputs`, or some trajectories of `prepare`.
            state: (batch, state_size) before them; by default the first state.
            generator: of self-feeding.
            seen: number of earlier rows.
        """
        if state is None:
            state = self.first_state(len(prepared))
        if self.config.self_feeding:
            fraction = float(self.config.self_feeding)
            prepared = replace(prepared, fed=_fed(generator, seen, prepared.rows, fraction))
        before, after = scan(self.spec, self.scan_parts(), prepared, state)
        return self.decoded(prepared, state, before, after)

    def decoded(
        self, prepared: StepInputs | TableSteps, state: Tensor, before: Tensor, after: Tensor
    ) -> Output:
        """The prediction from the states of a scan.

        Args:
            prepared: step inputs of the scan.
            state: (batch, state_size) before it.
            before: (batch, rows, state_size) before the observation of each row.
            after: (batch, rows, state_size) after each row.
        """
        read = before
        if self.config.readout == "last_row":
            shifted = torch.cat([state, after.flatten(1)[:, : -self.spec.state_size]], dim=1)
            read = shifted.view_as(after)
        found = self.head.decode_observations(read) if self.acts else self.head.decode(read)
        if self.acts:
            # An action is chosen at its row, so it is decoded after the observation there.
            now = after
            if self.spec.nodes:
                commit = prepared.gathered().commit
                assert commit is not None
                now = torch.where(commit[..., None] > 0, after, before)
            then = self.head.decode(now)
            acts = self.is_action
            scale = found.scale
            if scale is not None and then.scale is not None:
                scale = torch.where(acts, then.scale, scale)
            found = Prediction(torch.where(acts, then.mean, found.mean), scale)
        return Output(found.mean, found.scale, before, after)

    def loss(self, prediction: Prediction, target: Tensor, mask: Tensor | None) -> Tensor:
        """The loss of the head."""
        return self.head.loss(prediction, target, mask)

    def scan_parts(self) -> ScanParts:
        """The trained parts of the scan."""
        field: Any = self.field
        if isinstance(field, Perceptron):
            field = field.of_scan()
        return ScanParts(
            cell=self.cell,
            decay=self.decay.weights() if self.decay is not None else None,
            input_decay=self.input_decay.weights() if self.input_decay is not None else None,
            trend=self.trend.weights() if self.trend is not None else None,
            field=field,
            decoder=self.head.layers if self.spec.decoder else (),
        )

    def step_inputs(
        self, batch: Batch, past: RecurrentState | None = None, *, ends: bool = True
    ) -> tuple[StepInputs, RecurrentState]:
        """The inputs of each step, which do not depend on trained parameters.

        Args:
            batch: scaled; rows to come, in order.
            past: state after the earlier rows; by default there are none.
            ends: whether the past after the last row is needed.

        Returns:
            The inputs, and the past after the last row without its state.

        Raises:
            InputError: the batch has other channels than the model.
        """
        if batch.channels != self.channels:
            raise InputError(
                f"the batch has {batch.channels} channels, the model has {self.channels}"
            )
        config, dtype, unit, spec = self.config, self.dtype, self.time_unit, self.spec
        if past is None:
            past = self.empty_state(len(batch))
        ended_actions = None
        if self.acts:
            batch, ended_actions = self._with_actions(batch, past)
        at_rows, ended = elapsed_times(
            batch,
            past,
            elapsed_limit=self.elapsed_limit,
            from_first_row=config.clock == "first_row",
            ends=ends,
        )
        mask = at_rows.rows.mask
        last = at_rows.last if spec.input_decay else None
        values = (batch.values - self.mean) / self.std if spec.anchored else batch.values
        values = torch.where(mask, values, 0.0)
        if spec.bounded and spec.anchored:
            values = values.clamp(-LARGEST_VALUE, LARGEST_VALUE)
        elif spec.bounded:
            values = torch.where(mask, values.clamp(self.low, self.high), 0.0)
            last = None if last is None else last.clamp(self.low, self.high)
        update = at_rows.observed
        if config.cell == "none":
            update = at_rows.first
        elif config.update_rows == "every":
            update = batch.valid
        rows = StepInputs(
            gap=(at_rows.gap / unit).to(dtype),
            update=update.to(dtype),
            values=values,
            mask=mask.to(dtype),
            time_input=self._time_input(at_rows),
            # A single row has no padding, and gives a simpler graph.
            length=batch.valid.sum(dim=1) if batch.rows > 1 else None,
        )
        if spec.bounded and spec.anchored:
            rows = replace(rows, low=self.low, high=self.high)
        if spec.nodes:
            gap, first, node = self._nodes(at_rows)
            commit = at_rows.observed.to(dtype)
            rows = replace(rows, gap=gap, first_node=first, node=node, commit=commit)
        if spec.trend:
            assert past.covariance is not None
            level, slope, covariance = self._filters_here().gains(
                at_rows.delta,
                mask,
                past.channel_at > -torch.inf,
                past.covariance,
                unit=unit,
                dtype=dtype,
            )
            rows = replace(rows, level_gain=level, slope_gain=slope)
            ended = replace(ended, covariance=covariance)
        delta = (at_rows.delta / unit).to(dtype) if spec.decay or spec.input_decay else None
        if spec.input_decay:
            rows = replace(rows, delta=delta, last=last, mean=self.mean)
        if ended_actions is not None:
            ended = replace(ended, actions=ended_actions)
        if not (spec.decay or ends):
            return rows, ended
        kept = at_rows.observed if spec.nodes else torch.ones_like(update)
        updated = at_last(rows.update, kept, past.updated.to(dtype))
        if spec.decay:
            start, end = self._decay_inputs(at_rows)
            rows = replace(
                rows,
                updated=updated,
                decay_start=(start / unit).to(dtype),
                decay_end=(end / unit).to(dtype),
            )
        return rows, replace(ended, updated=torch.where(kept, rows.update, updated)[:, -1] > 0)

    def _nodes(self, at_rows: ElapsedTimes) -> tuple[Tensor, Tensor, Tensor]:
        """`gap`, `first_node` and `node` of `StepInputs`."""
        spec, step = self.spec, self.time_unit * float(self.spec.max_step or 1)
        if spec.max_step is None:  # the whole time since the last observed row in one piece
            first = node = torch.zeros_like(at_rows.elapsed)
            gap = at_rows.elapsed / self.time_unit
        else:
            first, _ = nodes_before(at_rows.elapsed_before / step)
            node, rest = nodes_before(at_rows.elapsed / step)
            gap = rest * spec.max_step
        return gap.to(self.dtype), first.to(self.dtype), node.to(self.dtype)

    def _decay_inputs(self, at_rows: ElapsedTimes) -> tuple[Tensor, Tensor]:
        """(batch, rows, decay) times, s, that the decay of h starts and ends at."""
        whole = isinstance(self.decay, TrainableDecay)
        if self.spec.nodes:
            start = at_rows.delta_observed
            start = start if whole else torch.zeros_like(at_rows.elapsed)[..., None]
            return start, start + self.elapsed_limit
        if whole:
            return at_rows.delta_before, at_rows.delta
        return at_rows.elapsed_before[..., None], at_rows.elapsed[..., None]

    def _with_actions(self, batch: Batch, past: RecurrentState) -> tuple[Batch, Tensor]:
        """The batch with each action moved to the row after it, and the actions of the last row."""
        last = past.actions
        if last is None:
            last = torch.full_like(batch.values[:, 0], torch.nan)
        at = (batch.valid.sum(dim=1) - 1)[:, None, None].expand(-1, 1, batch.channels)
        acts = self.is_action
        ended = torch.where(batch.mask & acts, batch.values, torch.nan).gather(1, at)[:, 0]
        seen = ~last.isnan()
        return batch.inputs(torch.where(seen, last, 0.0), seen), ended

    def _time_input(self, at_rows: ElapsedTimes) -> Tensor | None:
        """(batch, rows, time_inputs) times since observation for the cell."""
        name, unit = self.config.time_input, self.time_input_unit
        if name == "delta":
            longest = self.statistics.longest_delta * float(self.config.gap_limit or 1)
            return (at_rows.delta.clamp_max(longest) / unit).to(self.dtype)
        if name in ("elapsed", "gap"):
            time = at_rows.elapsed if name == "elapsed" else at_rows.step
            return (time / unit).to(self.dtype)[..., None]
        return None


def _spec(
    config: ModelConfig,
    channels: int,
    decay: TrainableDecay | ExponentialDecay | None,
    cell: type[Cell],
    *,
    longest: float,
) -> ScanSpec:
    hidden = int(config.hidden_size or 1)
    driven = hidden + (channels if config.anchored else 0) * (2 if config.trend else 1)
    decay_rows = config.decay_rows or "continuous"
    if decay_rows == "every_row" and not isinstance(decay, TrainableDecay):
        decay_rows = "continuous"  # for elapsed time both are the same
    kind = config.vector_field or "none"
    adaptive = tableau(config.solver or "euler").adaptive  # raises an error for an unknown one
    moves = kind != "none" or decay is not None or bool(config.trend)
    nodes = config.nodes == "observations" and moves
    max_step = config.max_step
    if nodes:
        default = float(config.typical_gap or 1) / (config.steps_per_gap or 1)
        max_step = (max_step or default) if kind != "none" and not adaptive else None
        if max_step is not None and max_step * MOST_NODES < float(config.typical_gap or 1):
            raise InputError(
                f"max_step={max_step:.3g} reaches {max_step * MOST_NODES:.3g} with its "
                f"{MOST_NODES} nodes, less than the typical gap of {config.typical_gap:g}; use a "
                "longer max_step"
            )
    units = tuple(config.field_units or ()) if kind == "mlp" else ()
    return ScanSpec(
        channels=channels,
        hidden_size=hidden,
        cell="start" if config.cell == "none" else config.cell or "gru",
        gates=cell.gates_per_unit * hidden,
        memory=cell.memory_per_unit * hidden,
        anchored=bool(config.anchored),
        trend=bool(config.trend),
        reset_after=bool(config.reset_after) and cell.takes_reset_after,
        time_inputs={"none": 0, "elapsed": 1, "gap": 1, "delta": channels}[
            config.time_input or "none"
        ],
        field=() if kind == "none" else (driven, *units, driven),
        field_kind="mlp" if kind == "none" else kind,
        activation=config.activation or "tanh",
        solver=config.solver or "euler",
        steps_per_gap=1 if nodes else config.steps_per_gap or 1,
        max_step=max_step,
        nodes=nodes,
        decay_span=longest if nodes else 1.0,
        bounded=bool(config.bounded) and kind != "none",
        rtol=config.rtol or 1e-4,
        atol=config.atol or 1e-6,
        adjoint=config.gradient == "adjoint",
        decay=0 if decay is None else channels if isinstance(decay, TrainableDecay) else 1,
        decay_rows=decay_rows,
        input_decay=bool(config.input_decay),
        decoder=(hidden, *(config.decoder_units or ()), channels) if config.self_feeding else (),
    )


def _fed(
    generator: torch.Generator | None, seen: int, rows: int, fraction: float
) -> tuple[bool, ...]:
    """Draws the rows that are fed the decoded state, row by row as in a stream; never row 0."""
    if generator is None:
        raise InputError("self-feeding draws random numbers: give a generator (empty_state)")
    drawn = torch.rand(rows, generator=generator).tolist()  # the same draws as one by one
    return tuple(number < fraction and seen + i > 0 for i, number in enumerate(drawn))


def _decay(
    config: ModelConfig, channels: int, hidden: int
) -> TrainableDecay | ExponentialDecay | None:
    if config.decay == "none":
        return None
    if config.decay == "trainable":
        return TrainableDecay(channels, hidden)
    return ExponentialDecay(hidden, scalar=config.decay == "scalar")


def depends_on_rows(config: ModelConfig) -> bool:
    """Whether predictions depend on all rows by an option, observed or not.

    Args:
        config: with these fields set.
    """
    return bool(
        config.update_rows == "every"
        or config.readout == "last_row"
        or config.decay_rows != "continuous"
        or config.self_feeding
    )


def _check(config: ModelConfig) -> None:
    open_fields = [
        f.name for f in fields(config) if f.name != "max_step" and getattr(config, f.name) is None
    ]
    if open_fields:
        raise InputError(
            f"model options not set: {', '.join(open_fields)}; offbeat.make_model fills them in"
        )
    if config.nodes == "observations" and depends_on_rows(config):
        raise InputError(
            "nodes='observations' needs update_rows='observed', readout='target', "
            "decay_rows='continuous' and no self_feeding; use nodes='rows', or leave nodes out"
        )
    if config.nodes == "observations" and config.max_step and config.steps_per_gap != 1:
        raise InputError("give max_step or steps_per_gap, not both, with nodes='observations'")
    if config.cell == "none" and config.vector_field == "none":
        raise InputError("a model needs a cell or a vector field; got neither")
    if config.cell == "none" and (config.anchored or config.input_decay or config.self_feeding):
        raise InputError("anchored, input_decay and self_feeding need a cell")
    if config.decay_rows == "observed_rows" and config.readout == "target":
        raise InputError(
            "decay_rows='observed_rows' with readout='target' would make a prediction depend on "
            "whether its own row is observed; use readout='last_row', or another decay_rows"
        )
    if config.self_feeding and config.head != "point":
        raise InputError(f"self_feeding needs the head 'point', got {config.head!r}")
    if config.trend and not config.anchored:
        raise InputError("trend is an option of anchored models; set anchored=True, too")
    if config.anchored and config.input_decay:
        raise InputError("an anchored state holds the channels: leave input_decay off")
