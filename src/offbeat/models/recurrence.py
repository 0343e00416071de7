"""The one model: a choice of parts around one scan.

    decay -> flow over the gap -> cell at an observation -> readout

`models.zoo` names the choices. Training, prediction and streaming all run `RecurrentModel.forward`:
a stream is the same call with one row and the `Carry` of the rows before.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import linear

from offbeat.config import ModelConfig
from offbeat.data.batch import Batch
from offbeat.data.prepare import Scaler
from offbeat.data.trajectory import Dataset
from offbeat.errors import InputError
from offbeat.kernels import ScanRows, ScanSpec, ScanWeights, scan
from offbeat.models.ages import Ages, Carry, ages
from offbeat.models.decay import ExponentialDecay, InputDecay, TrainableDecay, decay_rows
from offbeat.models.parts import Cell, Perceptron, initialise
from offbeat.models.statistics import Statistics


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
    carry: Carry


class RecurrentModel(nn.Module):
    """A recurrent model of unevenly sampled motion, composed of parts.

    Args:
        config: every field set; `zoo.make` fills in what a user leaves open.
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
        channels, hidden = statistics.channels, int(config.hidden_size or 1)
        self.channels, self.hidden_size = channels, hidden
        self.mean: Tensor
        self.std: Tensor
        self.register_buffer("mean", torch.tensor(statistics.mean), persistent=False)
        self.register_buffer("std", torch.tensor(statistics.std), persistent=False)

        has_field = config.vector_field == "mlp"
        anchored = channels if config.anchored else 0
        starts_only = config.cell == "none"
        self.spec = ScanSpec(
            hidden_size=hidden,
            anchored=anchored,
            cell="set" if starts_only else config.cell,  # type: ignore[arg-type]
            reset_after=bool(config.reset_after) and config.cell == "gru",
            has_field=has_field,
            activation=config.activation or "tanh",
            solver=config.solver or "euler",
            steps_per_gap=config.steps_per_gap or 1,
            max_step=config.max_step,
            rtol=config.rtol or 1e-4,
            atol=config.atol or 1e-6,
            adjoint=config.gradient == "adjoint",
        )
        self.decay = _decay(config, channels, hidden)
        self.input_decay = InputDecay(channels) if config.input_decay else None
        age = {"none": 0, "elapsed": 1, "gap": 1, "delta": channels}[config.age_input or "none"]
        self.cell = Cell(
            self.spec.gates,
            2 * channels + age,
            hidden_size=0 if starts_only else hidden,
            innovation=anchored,
            reset_after=self.spec.reset_after,
        )
        self.field = None
        if has_field:
            driven = anchored + hidden
            sizes = (driven, *(config.field_units or ()), driven)
            self.field = Perceptron(sizes, self.spec.activation)
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

    def empty_carry(self, batch: int, *, coins: torch.Generator | None = None) -> Carry:
        """Nothing seen yet, for so many trajectories.

        Args:
            batch: number of trajectories.
            coins: generator of the coins of self-feeding; by default one seeded with 0.
        """
        state = self.cell.bias.new_zeros(self.spec.state_size - self.spec.anchored)
        if self.start is not None:
            state = torch.cat([self.start, state])
        if coins is None and self.config.self_feeding:
            coins = torch.Generator().manual_seed(0)
        return Carry.empty(state.expand(batch, -1), self.mean, coins=coins)

    def forward(
        self, batch: Batch, *, carry: Carry | None = None, coins: torch.Generator | None = None
    ) -> Output:
        """Predicts every row of a batch from what was observed before it.

        Args:
            batch: scaled; rows to come, in order.
            carry: what was seen before; by default nothing.
            coins: generator of the coins of self-feeding; used where `carry` is not given.

        Raises:
            InputError: the batch has other channels than the model.
        """
        if batch.channels != self.channels:
            raise InputError(
                f"the batch has {batch.channels} channels, the model has {self.channels}"
            )
        if carry is None:
            carry = self.empty_carry(len(batch), coins=coins)
        at_rows, carried = ages(
            batch,
            carry,
            elapsed_limit=self.statistics.longest_elapsed * float(self.config.gap_limit or 1),
            from_first_row=self.config.clock == "first_row",
        )
        rows = self._rows(batch, at_rows, carry)
        before, after = scan(self.spec, self._weights(), rows, carry.state)
        read = before
        if self.config.readout == "last_row":
            read = torch.cat([carry.state[None], after[:-1]])
        carried = replace(carried, state=after[-1], updated=rows.update[-1, :, 0] > 0)
        return Output(
            self.read(read).transpose(0, 1), before.transpose(0, 1), after.transpose(0, 1), carried
        )

    def read(self, state: Tensor) -> Tensor:
        """(..., state_size) states to (..., channels) predictions in scaled units."""
        if self.decoder is None:
            return state[..., : self.channels] * self.std + self.mean
        decoded: Tensor = self.decoder(state[..., : self.hidden_size])
        return decoded

    def _weights(self) -> ScanWeights:
        feeding = bool(self.config.self_feeding)
        return ScanWeights(
            recurrent=self.cell.recurrent,
            recurrent_bias=self.cell.recurrent_bias,
            innovation=self.cell.innovation,
            field=self.field.layers if self.field is not None else (),
            feed=self.cell.inputs[:, : self.channels] if feeding else None,
            decoder=self.decoder.layers if feeding and self.decoder is not None else (),
        )

    def _rows(self, batch: Batch, at_rows: Ages, carry: Carry) -> ScanRows:
        """Everything of a row that does not depend on the state, for all rows at once."""
        config, dtype, unit = self.config, self.dtype, self.time_unit
        mask = batch.mask & batch.valid[..., None]
        values = torch.where(mask, batch.values, 0.0)
        if self.input_decay is not None:
            shown = self.input_decay(values, mask, at_rows, self.mean, unit)
        elif self.spec.anchored:
            values = torch.where(mask, (batch.values - self.mean) / self.std, 0.0)
            shown = values
        else:
            shown = values
        context = [mask.to(dtype)]
        if config.age_input == "delta":
            longest = self.statistics.longest_delta * float(config.gap_limit or 1)
            age = at_rows.delta.clamp_max(longest)
            context.append((age / self.statistics.median_gap).to(dtype))
        elif config.age_input in ("elapsed", "gap"):
            age = at_rows.elapsed if config.age_input == "elapsed" else at_rows.step
            context.append((age / self.statistics.median_gap).to(dtype)[..., None])
        update = at_rows.observed
        if config.cell == "none":
            update = at_rows.first
        elif config.update_rows == "every":
            update = batch.valid
        updated = torch.cat([carry.updated[:, None], update[:, :-1]], dim=1)
        gates = linear(torch.cat([shown, *context], dim=2), self.cell.inputs, self.cell.bias)
        rows = ScanRows(
            gap=(at_rows.gap / unit).to(dtype)[..., None],
            update=update.to(dtype)[..., None],
            gates=gates,
            values=values if self.spec.anchored else None,
            mask=mask.to(dtype) if self.spec.anchored else None,
        )
        if config.self_feeding:
            weight = self.cell.inputs[:, self.channels :]
            fed = linear(torch.cat(context, dim=2), weight, self.cell.bias)
            rows = replace(rows, fed_gates=fed)
        rows = _time_first(rows)
        if config.self_feeding:
            rows = replace(rows, fed=_coins(carry, batch.rows, float(config.self_feeding)))
        if self.decay is not None:
            decay = decay_rows(
                self.decay,
                at_rows,
                unit,
                rows=config.decay_rows or "",
                update=update,
                updated=updated,
            )
            rows = replace(rows, decay=decay)
        return rows


def _time_first(rows: ScanRows) -> ScanRows:
    moved: dict[str, Any] = {f.name: getattr(rows, f.name) for f in fields(rows)}
    for name, value in moved.items():
        if isinstance(value, Tensor):
            moved[name] = value.transpose(0, 1).contiguous()
    return ScanRows(**moved)


def _coins(carry: Carry, rows: int, share: float) -> tuple[bool, ...]:
    """One coin per row, drawn row by row so that a stream draws the same; never at row 0."""
    if carry.coins is None:
        raise InputError("self-feeding draws coins: the carry needs a generator (empty_carry)")
    drawn = [float(torch.rand((), generator=carry.coins)) < share for _ in range(rows)]
    return tuple(fed and carry.rows + i > 0 for i, fed in enumerate(drawn))


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
            f"model options left open: {', '.join(open_fields)}; offbeat.make fills them in"
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
