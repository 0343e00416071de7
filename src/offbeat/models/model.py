"""The one model: a choice of parts around one scan.

    decay -> flow over the gap -> cell at an observation -> readout

`models.zoo` names the choices. Training, prediction and streaming all run `Model.forward`:
a stream is the same call with one row and the `RecurrentState` of the rows before.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor, nn

from offbeat.config import ModelConfig
from offbeat.data.batch import Batch
from offbeat.data.scaler import Scaler
from offbeat.data.trajectory import Dataset
from offbeat.errors import InputError
from offbeat.kernels import ScanSpec, ScanWeights, StepInputs, TableSteps, backend, cpu, scan
from offbeat.models.elapsed import ElapsedTimes, RecurrentState, ages
from offbeat.models.statistics import Statistics
from offbeat.parts.decay import ExponentialDecay, InputDecay, TrainableDecay
from offbeat.parts.perceptron import Cell, Perceptron, initialise


@dataclass(frozen=True, eq=False)
class Output:
    """What a model says of a batch.

    Attributes:
        predictions: (batch, rows, channels) scaled units; the value expected at each row, from
            what was observed before it.
        before: (batch, rows, state_size) state on arrival at each row.
        after: (batch, rows, state_size) state after each row.
        carry: what goes on to the rows that follow.
    """

    predictions: Tensor
    before: Tensor
    after: Tensor
    carry: RecurrentState


class Model(nn.Module):
    """A recurrent model of unevenly sampled motion, composed of parts.

    Args:
        config: every field set; `zoo.make_model` fills in what a user leaves open.
        statistics: measured on the training part.
        scaler: maps original units to the scaled ones that the model works in.
        names: channel names, which data must match.
        units: channel units.
        seed: of the initial weights.

    Raises:
        InputError: a field of the config is open, or parts do not fit together.
    """

    def __init__(
        self,
        config: ModelConfig,
        statistics: Statistics,
        *,
        scaler: Scaler,
        names: tuple[str, ...],
        units: tuple[str, ...],
        seed: int = 0,
    ) -> None:
        super().__init__()
        _check(config)
        self.config, self.statistics, self.scaler = config, statistics, scaler
        self.names, self.units = names, units
        self.time_unit = statistics.median_gap / float(config.typical_gap or 1)
        longest = config.time_input_unit == "longest"
        self.time_input_unit = statistics.longest_delta if longest else statistics.median_gap
        channels, hidden = statistics.channels, int(config.hidden_size or 1)
        self.channels, self.hidden_size = channels, hidden
        self.mean: Tensor
        self.std: Tensor
        self.register_buffer("mean", torch.tensor(statistics.mean), persistent=False)
        self.register_buffer("std", torch.tensor(statistics.std), persistent=False)

        self.decay = _decay(config, channels, hidden)
        self.input_decay = InputDecay(channels) if config.input_decay else None
        self.spec = _spec(config, channels, self.decay)
        anchored = self.spec.anchors
        self.cell = Cell(
            self.spec.gates,
            2 * channels + self.spec.ages,
            hidden_size=0 if config.cell == "none" else hidden,
            innovation=anchored,
            reset_after=self.spec.reset_after,
        )
        self.field = None
        if self.spec.field:
            self.field = Perceptron(self.spec.field, self.spec.activation)
        self.decoder = None
        self.start = None
        if anchored:
            self.start = nn.Parameter(torch.zeros(channels))
        else:
            self.decoder = Perceptron((hidden, *(config.decoder_units or ()), channels), "tanh")
        self._initialise(seed)

    def _initialise(self, seed: int) -> None:
        generator = torch.Generator().manual_seed(seed)
        initialise(self, init=self.config.init or "normal", generator=generator)
        with torch.no_grad():
            for part in (self.decay, self.input_decay):
                if isinstance(part, TrainableDecay | InputDecay):
                    part.weight.abs_()  # a negative weight of equation 26 gets no gradient
            if self.config.init == "fan_in" and self.field is not None:
                self.field.weights[-1].mul_(0.1)
            if self.start is not None:
                self.start.zero_()

    @property
    def dtype(self) -> torch.dtype:
        """Of the weights."""
        return self.cell.inputs.dtype

    def batch(self, dataset: Dataset) -> Batch:
        """Scales and pads a data set of this model's channels, in any order.

        Raises:
            InputError: channels differ from the model's, or their units where the data has any.
        """
        own = dict(zip(self.names, self.units, strict=True))
        given = dict(zip(dataset.names, dataset.units, strict=True))
        agree = own.keys() == given.keys() and all(
            unit in ("", own[name]) or not own[name] for name, unit in given.items()
        )
        if not agree:
            raise InputError(f"the model was made for other channels: {_difference(own, given)}")
        if dataset.names != self.names:
            dataset = dataset.select(self.names)
        return Batch.of(dataset, scaler=self.scaler, dtype=self.dtype)

    def empty_state(
        self, batch: int, *, generator: torch.Generator | None = None
    ) -> RecurrentState:
        """Nothing seen yet, for so many trajectories.

        Args:
            batch: number of trajectories.
            generator: generator of the generator of self-feeding; by default one seeded with 0.
        """
        if generator is None and self.config.self_feeding:
            generator = torch.Generator().manual_seed(0)
        return RecurrentState.empty(self.first_state(batch), self.mean, generator=generator)

    def runs_compiled(self) -> bool:
        """Whether the scan of this model runs in compiled code here."""
        if backend()[0] == "reference":
            return False
        nothing = torch.zeros(1, 1, dtype=self.dtype)
        cells = torch.zeros(1, 1, self.channels, dtype=self.dtype)
        rows = StepInputs(gap=nothing, update=nothing, values=cells, mask=cells)
        return not cpu.unsupported(self.spec, self.scan_weights(), rows, self.first_state(1))

    def first_state(self, batch: int) -> Tensor:
        """(batch, state_size) before anything is observed.

        Args:
            batch: number of trajectories.
        """
        state = self.cell.bias.new_zeros(self.spec.state_size - self.spec.anchors)
        if self.start is not None:
            state = torch.cat([self.start, state])
        return state.expand(batch, -1)

    def forward(
        self,
        batch: Batch,
        *,
        carry: RecurrentState | None = None,
        generator: torch.Generator | None = None,
    ) -> Output:
        """Predicts every row of a batch from what was observed before it.

        Args:
            batch: scaled; rows to come, in order.
            carry: what was seen before; by default nothing.
            generator: generator of the generator of self-feeding; used where `carry` is not given.

        Raises:
            InputError: the batch has other channels than the model.
        """
        if carry is None:
            carry = self.empty_state(len(batch), generator=generator)
        rows, carried = self.step_inputs(batch, carry)
        predictions, before, after = self.run(
            rows, carry.state, generator=carry.generator, seen=carry.rows
        )
        carried = replace(carried, state=after[:, -1], updated=rows.update[:, -1] > 0)
        return Output(predictions, before, after, carried)

    def run(
        self,
        rows: StepInputs | TableSteps,
        state: Tensor | None = None,
        *,
        generator: torch.Generator | None = None,
        seen: int = 0,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Predicts rows whose facts are known: all of `forward` that a weight touches.

        Args:
            rows: from `step_inputs`.
            state: (batch, state_size) before them; by default as nothing has been seen.
            generator: generator of the generator of self-feeding.
            seen: number of rows before them.

        Returns:
            Predictions (batch, rows, channels), states before and after each row
            (batch, rows, state_size).
        """
        if state is None:
            state = self.first_state(len(rows))
        if self.config.self_feeding:
            rows = replace(
                rows, fed=_coins(generator, seen, rows.rows, float(self.config.self_feeding))
            )
        before, after = scan(self.spec, self.scan_weights(), rows, state)
        read = before
        if self.config.readout == "last_row":
            shifted = torch.cat([state, after.flatten(1)[:, : -self.spec.state_size]], dim=1)
            read = shifted.view_as(after)
        return self.read(read), before, after

    def read(self, state: Tensor) -> Tensor:
        """(..., state_size) states to (..., channels) predictions in scaled units."""
        if self.decoder is None:
            return state[..., : self.channels] * self.std + self.mean
        decoded: Tensor = self.decoder(state[..., : self.hidden_size])
        return decoded

    def scan_weights(self) -> ScanWeights:
        """All that is trained within the scan."""
        return ScanWeights(
            inputs=self.cell.inputs,
            bias=self.cell.bias,
            recurrent=self.cell.recurrent,
            recurrent_bias=self.cell.recurrent_bias,
            innovation=self.cell.innovation,
            decay=self.decay.weights() if self.decay is not None else None,
            input_decay=self.input_decay.weights() if self.input_decay is not None else None,
            field=self.field.layers if self.field is not None else (),
            decoder=self.decoder.layers if self.spec.decoder and self.decoder is not None else (),
        )

    def step_inputs(
        self, batch: Batch, carry: RecurrentState | None = None
    ) -> tuple[StepInputs, RecurrentState]:
        """What is known of each row; no weight has touched it, so it holds for all of a training.

        Args:
            batch: scaled; rows to come, in order.
            carry: what was seen before; by default nothing.

        Returns:
            The facts, and the carry of the last row but for its state.

        Raises:
            InputError: the batch has other channels than the model.
        """
        if batch.channels != self.channels:
            raise InputError(
                f"the batch has {batch.channels} channels, the model has {self.channels}"
            )
        config, dtype, unit, spec = self.config, self.dtype, self.time_unit, self.spec
        if carry is None:
            carry = self.empty_state(len(batch))
        at_rows, carried = ages(
            batch,
            carry,
            elapsed_limit=self.statistics.longest_elapsed * float(config.gap_limit or 1),
            from_first_row=config.clock == "first_row",
        )
        mask = batch.mask & batch.valid[..., None]
        values = torch.where(mask, batch.values, 0.0)
        if spec.anchored:
            values = torch.where(mask, (batch.values - self.mean) / self.std, 0.0)
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
            age=self._age(at_rows),
            length=batch.valid.sum(dim=1),
        )
        delta = (at_rows.delta / unit).to(dtype) if spec.decay or spec.input_decay else None
        if spec.input_decay:
            rows = replace(rows, delta=delta, last=at_rows.last, mean=self.mean)
        if spec.decay:
            updated = torch.cat([carry.updated[:, None], update[:, :-1]], dim=1)
            start, end = at_rows.delta_before, at_rows.delta
            if not isinstance(self.decay, TrainableDecay):
                start, end = at_rows.elapsed_before[..., None], at_rows.elapsed[..., None]
                delta = (end / unit).to(dtype)
            rows = replace(
                rows,
                updated=updated.to(dtype),
                decay_start=(start / unit).to(dtype),
                decay_end=delta,
            )
        return rows, carried

    def _age(self, at_rows: ElapsedTimes) -> Tensor | None:
        """(batch, rows, ages) what tells a plain cell how old its knowledge is."""
        name, unit = self.config.time_input, self.time_input_unit
        if name == "delta":
            longest = self.statistics.longest_delta * float(self.config.gap_limit or 1)
            return (at_rows.delta.clamp_max(longest) / unit).to(self.dtype)
        if name in ("elapsed", "gap"):
            age = at_rows.elapsed if name == "elapsed" else at_rows.step
            return (age / unit).to(self.dtype)[..., None]
        return None


def _spec(
    config: ModelConfig, channels: int, decay: TrainableDecay | ExponentialDecay | None
) -> ScanSpec:
    hidden = int(config.hidden_size or 1)
    driven = hidden + (channels if config.anchored else 0)
    decay_rows = config.decay_rows or "continuous"
    if decay_rows == "every_row" and not isinstance(decay, TrainableDecay):
        decay_rows = "continuous"  # of elapsed time the two are the same
    return ScanSpec(
        channels=channels,
        hidden_size=hidden,
        anchored=bool(config.anchored),
        cell="set" if config.cell == "none" else config.cell or "gru",
        reset_after=bool(config.reset_after) and config.cell == "gru",
        ages={"none": 0, "elapsed": 1, "gap": 1, "delta": channels}[config.time_input or "none"],
        field=(driven, *(config.field_units or ()), driven) if config.vector_field == "mlp" else (),
        activation=config.activation or "tanh",
        solver=config.solver or "euler",
        steps_per_gap=config.steps_per_gap or 1,
        max_step=config.max_step,
        rtol=config.rtol or 1e-4,
        atol=config.atol or 1e-6,
        adjoint=config.gradient == "adjoint",
        decay=0 if decay is None else channels if isinstance(decay, TrainableDecay) else 1,
        decay_rows=decay_rows,
        input_decay=bool(config.input_decay),
        decoder=(hidden, *(config.decoder_units or ()), channels) if config.self_feeding else (),
    )


def _coins(
    generator: torch.Generator | None, seen: int, rows: int, share: float
) -> tuple[bool, ...]:
    """One coin per row, drawn row by row so that a stream draws the same; never at row 0."""
    if generator is None:
        raise InputError("self-feeding draws generator: the carry needs a generator (empty_state)")
    drawn = torch.rand(rows, generator=generator).tolist()  # the same draws as one by one
    return tuple(coin < share and seen + i > 0 for i, coin in enumerate(drawn))


def _decay(
    config: ModelConfig, channels: int, hidden: int
) -> TrainableDecay | ExponentialDecay | None:
    if config.decay == "none":
        return None
    if config.decay == "trainable":
        return TrainableDecay(channels, hidden)
    return ExponentialDecay(hidden, scalar=config.decay == "scalar")


def _check(config: ModelConfig) -> None:
    open_fields = [
        f.name for f in fields(config) if f.name != "max_step" and getattr(config, f.name) is None
    ]
    if open_fields:
        raise InputError(
            f"model options left open: {', '.join(open_fields)}; offbeat.make_model fills them in"
        )
    if config.cell == "none" and config.vector_field == "none":
        raise InputError("a model needs a cell or a vector field; got neither")
    if config.cell == "none" and (config.anchored or config.input_decay or config.self_feeding):
        raise InputError("anchored, input_decay and self_feeding need a cell")
    if config.decay_rows == "observed_rows" and config.readout == "target":
        raise InputError(
            "decay_rows='observed_rows' with readout='target' would tell a prediction whether its "
            "own row is observed; use readout='last_row', or another decay_rows"
        )
    if config.anchored and config.input_decay:
        raise InputError("an anchored state holds the channels: leave input_decay off")


def _difference(own: dict[str, str], given: dict[str, str]) -> str:
    """What to change in the data for it to have the channels of the model."""
    units = (
        f"{name} is in {given[name]}, not {unit}"
        for name, unit in own.items()
        if given.get(name, "") not in ("", unit)
    )
    named = {
        "the data lacks": own.keys() - given.keys(),
        "the model does not know": given.keys() - own.keys(),
    }
    parts = [f"{what} {', '.join(sorted(names))}" for what, names in named.items() if names]
    return "; ".join([*parts, *units]) + "; give it the channels it was made for"
