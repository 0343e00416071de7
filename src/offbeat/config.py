"""Configs: frozen dataclasses without torch, which define the command line."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any, Literal

from offbeat.errors import InputError, one_of

Activation = Literal["tanh", "silu"]


@dataclass(frozen=True)
class ModelConfig:
    """Parts and options of a model. A field that is None takes the value of the named model.

    Attributes:
        name: name of the model: `rnn`, `lstm`, `gru`, `rnn_decay`, `gru_d`, `neural_ode`,
            `ode_rnn`, `ode_gru_d`, `anchored_ode_gru_d`, `anchored_trend`,
            `anchored_trend_large`, or a registered one. Where no option of the model is given,
            `offbeat train` tries a few on a log.
        hidden_size: units of the hidden state h.
        head: the map from a state to a prediction, and its loss: `point`, the expected value and
            the mean squared error; `gaussian`, a mean and a standard deviation and the negative
            log-likelihood; or a registered head.
        decoder_units: hidden layers of the head's decoder.
        cell: update at an observation. `gru` is equations 20-23 of the thesis, `elman` 6, `lstm`
            14-19; `none` for a vector field without a cell; or a registered cell.
        reset_after: GRU whose reset gate acts after the recurrent product, as in `torch.nn.GRU`,
            instead of before it, as in equation 22.
        vector_field: `mlp`, a neural ODE between observations (equation 36), `none`, or a
            registered vector field.
        field_units: hidden layers of the vector field.
        activation: nonlinearity of the vector field.
        solver: how the vector field is integrated over a gap: `euler`, `midpoint`, `heun`, `rk4`,
            `dopri5`, `tsit5`, or a registered tableau.
        nodes: where the steps of the solver begin. `observations`: at the last observed row, and
            then every `max_step`; a row between two of these nodes is read by a further step that
            is not kept. So a prediction depends on what was observed alone, bit for bit, whatever
            other times are asked for. `rows`: at every row; each gap is divided into equal steps
            (the thesis' protocol). By default `observations`, unless `update_rows`, `readout`,
            `decay_rows` or `self_feeding` make a prediction depend on all rows anyway.
        steps_per_gap: steps of a fixed-step solver over one gap; between nodes, over a typical one.
        max_step: with nodes at observations, the distance of the nodes in model time; by default
            `typical_gap` over `steps_per_gap`. There are 2048 of them; after the last one the state
            stays as it is. With nodes at rows, the longest step: each gap takes as many equal steps
            as it needs, at least `steps_per_gap`; by default there is no bound.
        rtol: relative tolerance of an adaptive solver.
        atol: absolute tolerance of an adaptive solver, in units of the state.
        gradient: `backprop` through the solver's steps, or the `adjoint` method (algorithm 1).
        decay: `none`; `trainable`, the gamma_h of equation 26 from the times since observation of
            all channels; `vector` or `scalar`, exp(-tau gap) with one tau per unit or a single one
            (equation 42).
        decay_rows: `continuous`, the decay is a function of time only, for any rows
            at; `every_row`, gamma compounds at every row (the thesis' protocol);
            `observed_rows`, the state decays only where it is updated.
        input_decay: gamma_x, last values that decay to the training mean (equation 27).
        anchored: the state holds the channels themselves, and an observation sets them.
        trend: an anchored state also holds the slopes of the channels. At the start of training the
            model is a Kalman filter with damped velocity per channel, tuned on the training data:
            noise is filtered, and a slope continues. The vector field, damping and gains are
            learned from there.
        update_rows: `observed`, the cell acts where any channel is observed; `every`, at all rows.
        time_input: the time input of a cell without decay: `elapsed` since the last observed row,
            `delta` since each channel's last observation (equation 25), `gap` since the row before,
            or `none`.
        time_input_unit: of that time: the median `gap` of training, or the `longest` time met
            there, so that it is at most 1 in training. Times of many gaps are large compared to the
            values, and can take longer to learn from.
        self_feeding: fraction of rows at which the cell's input is the model's decoded
            prediction in place of the observed values (one draw per row for the whole batch,
            row 0 excepted), in training and in testing. Some public code does so by mistake.
        readout: `target`, the state is propagated to the requested time; `last_row`, the prediction
            is decoded from the state after the row before (the thesis' protocol).
        init: `normal`, weights N(0, 0.1^2) and biases 0; `fan_in`, weights N(0, 1/fan-in), biases
            0, last layer of the vector field times 0.1.
        typical_gap: model time of the median training gap; fixes the unit of model time.
        clock: start of the model time: at the `first_observation`, so that a prediction does
            not depend on the start of the recording, or at the `first_row`, observed or
            not (algorithms 2 and 3).
        gap_limit: time since the last observation saturates at this multiple of the longest one
            in training.
        bounded: the vector field and the cell are given values within the range of training,
            widened by half of it on each side, and no solver step leaves that range: a state cannot
            run away after an outlier or in a long outage. On for models with a vector field.
    """

    name: str = "anchored_ode_gru_d"
    hidden_size: int | None = None
    head: str | None = None
    decoder_units: tuple[int, ...] | None = None
    cell: str | None = None
    reset_after: bool | None = None
    vector_field: str | None = None
    field_units: tuple[int, ...] | None = None
    activation: Activation | None = None
    solver: str | None = None
    nodes: Literal["observations", "rows"] | None = None
    steps_per_gap: int | None = None
    max_step: float | None = None
    rtol: float | None = None
    atol: float | None = None
    gradient: Literal["backprop", "adjoint"] | None = None
    decay: Literal["none", "trainable", "vector", "scalar"] | None = None
    decay_rows: Literal["continuous", "every_row", "observed_rows"] | None = None
    input_decay: bool | None = None
    anchored: bool | None = None
    trend: bool | None = None
    update_rows: Literal["observed", "every"] | None = None
    time_input: Literal["none", "elapsed", "delta", "gap"] | None = None
    time_input_unit: Literal["gap", "longest"] | None = None
    self_feeding: float | None = None
    readout: Literal["target", "last_row"] | None = None
    init: Literal["normal", "fan_in"] | None = None
    typical_gap: float | None = None
    clock: Literal["first_observation", "first_row"] | None = None
    gap_limit: float | None = None
    bounded: bool | None = None

    def __post_init__(self) -> None:
        for field_ in fields(self):
            value = getattr(self, field_.name)
            if isinstance(value, list):  # from JSON and YAML
                object.__setattr__(self, field_.name, tuple(value))
        for name, choices in _CHOICES.items():
            if getattr(self, name) is not None:
                one_of(f"model option {name}", getattr(self, name), choices)
        for name in ("hidden_size", "steps_per_gap"):
            _check(self, name, lambda v: isinstance(v, int) and v >= 1, "an integer of at least 1")
        for name in ("max_step", "rtol", "atol", "typical_gap"):
            _check(self, name, lambda v: 0 < v < math.inf, "a positive number")
        for name in ("reset_after", "input_decay", "anchored", "trend", "bounded"):
            value = getattr(self, name)
            if not (value is None or isinstance(value, bool)):
                raise InputError(f"{name} must be true or false, got {value!r}")
        for name in ("decoder_units", "field_units"):
            _check(
                self,
                name,
                lambda v: isinstance(v, tuple) and all(isinstance(n, int) and n >= 1 for n in v),
                "a list of layer sizes, each at least 1",
            )
        _check(self, "gap_limit", lambda v: 1 <= v < math.inf, "at least 1, and finite")
        _check(self, "self_feeding", lambda v: 0 <= v <= 1, "a fraction from 0 to 1")
        if self.self_feeding and self.anchored:
            raise InputError(
                "self_feeding is an option of the plain recurrent models; an anchored model "
                "predicts from its own state: leave self_feeding at 0"
            )


_CHOICES: dict[str, tuple[str, ...]] = {
    "activation": ("tanh", "silu"),
    "nodes": ("observations", "rows"),
    "gradient": ("backprop", "adjoint"),
    "decay": ("none", "trainable", "vector", "scalar"),
    "decay_rows": ("continuous", "every_row", "observed_rows"),
    "update_rows": ("observed", "every"),
    "time_input": ("none", "elapsed", "delta", "gap"),
    "time_input_unit": ("gap", "longest"),
    "readout": ("target", "last_row"),
    "init": ("normal", "fan_in"),
    "clock": ("first_observation", "first_row"),
}


MASKS = ("rows", "values", "bursts", "dropout")
"""Ways of masking observed values; see `offbeat.data.masking.mask_out`."""

CUTS = ("one", "consecutive", "random")
"""Ways of cutting windows; see `offbeat.data.windows.windows`."""

SPLITS = ("trajectory", "time", "blocks")
"""Ways of splitting; see `offbeat.data.splits.apply_split`."""


ROWS_OR_SECONDS = (("window", "window_s"), ("burst_rows", "burst_s"))
"""Fields of `SplitConfig` that say the same, in rows and in seconds; one of both may be given."""


@dataclass(frozen=True)
class SplitConfig:
    """Options of windows, masks and the split into training, validation and test part.

    Attributes:
        window: rows of a window; None, and no window_s, keeps trajectories whole.
        window_s: length of a window in seconds, instead of in rows.
        cut: `one` window out of each trajectory, its start drawn; `consecutive`, one after the
            other; `random`, drawn for training, consecutive for the other parts.
            By default `one`, and `consecutive` where the split is by time or in blocks.
        window_count: windows that `random` draws from each trajectory; by default as many as are
            as long as the trajectory together.
        observed_fraction: fraction of the observed values that stays observed; None masks nothing.
        mask: `rows`, all channels together at random; `values`, each channel on its own; `bursts`,
            runs of consecutive rows; `dropout`, runs of each sensor on its own.
        burst_rows: rows of a run; None, and no burst_s, makes it a single one.
        burst_s: length of a run in seconds, instead of in rows.
        sensors: channels that drop out together in `dropout`, a list of names per sensor; by
            default channels that are always observed together.
        by: split by `trajectory`, at random; by `time`: the first rows train, those after them
            validate, the last ones test; or in `blocks`: each part has several, spread over the
            log. No window spans two parts.
        blocks: validation blocks, and as many test blocks, of a split in blocks; by default up to
            5, with 50 rows or more in each.
        gap_s: s, rows that are left out of the training part next to the other parts of a split in
            blocks.
        fractions: of the trajectories, or of the rows, for training, validation and test; they sum
            to 1.
        seed: of windows, masks and split.
    """

    window: int | None = None
    window_s: float | None = None
    cut: Literal["one", "consecutive", "random"] | None = None
    window_count: int | None = None
    observed_fraction: float | None = None
    mask: Literal["rows", "values", "bursts", "dropout"] = "rows"
    burst_rows: int | None = None
    burst_s: float | None = None
    sensors: tuple[tuple[str, ...], ...] | None = None
    by: Literal["trajectory", "time", "blocks"] = "trajectory"
    blocks: int | None = None
    gap_s: float | None = None
    fractions: tuple[float, float, float] = (0.7, 0.15, 0.15)
    seed: int = 0

    def __post_init__(self) -> None:
        object.__setattr__(self, "fractions", tuple(self.fractions))
        if self.sensors is not None:
            object.__setattr__(self, "sensors", tuple(tuple(names) for names in self.sensors))
        one_of("mask", self.mask, MASKS)
        one_of("way of splitting", self.by, SPLITS)
        if self.cut is not None:
            one_of("cut", self.cut, CUTS)
        for name in ("window", "window_count", "burst_rows", "blocks"):
            _check(self, name, lambda v: isinstance(v, int) and v >= 1, "an integer of at least 1")
        _check(self, "gap_s", lambda v: 0 <= v < math.inf, "seconds of at least 0")
        for name in ("window_s", "burst_s"):
            _check(self, name, lambda v: 0 < v < math.inf, "a positive number of seconds")
        for rows, seconds in ROWS_OR_SECONDS:
            if getattr(self, rows) is not None and getattr(self, seconds) is not None:
                raise InputError(f"give {rows} or {seconds}, not both")
        if self.window is None and self.window_s is None and self.cut is not None:
            raise InputError(f"cut={self.cut!r} needs the length of a window: window or window_s")
        if self.window_count is not None and self.cut != "random":
            raise InputError("window_count is an option of cut='random'; leave it out")
        if self.by != "blocks" and (self.blocks is not None or self.gap_s is not None):
            raise InputError("blocks and gap_s are options of by='blocks'; leave them out")
        check_seed(self.seed)

    @property
    def masking(self) -> dict[str, Any]:
        """The options of `mask_out`."""
        return {
            "observed_fraction": self.observed_fraction,
            "mask": self.mask,
            "burst_rows": self.burst_rows,
            "burst_s": self.burst_s,
            "sensors": self.sensors,
        }


REDRAWN = ("rows", "values")
"""Ways of masking that can be drawn anew in each epoch."""


@dataclass(frozen=True)
class RedrawConfig:
    """How windows and masks are drawn anew in each epoch; see `offbeat.data.redraw.redraw`.

    Attributes:
        observed_fractions: fractions that stay observed; each trajectory of each epoch has one of
            them, drawn with equal probability.
        window: rows of a window of each trajectory, its start drawn; None keeps them whole.
        mask: `rows`, all states together; `values`, each state on its own.
    """

    observed_fractions: tuple[float, ...]
    window: int | None = None
    mask: Literal["rows", "values"] = "rows"

    def __post_init__(self) -> None:
        given = self.observed_fractions
        if isinstance(given, list):  # from JSON and YAML
            object.__setattr__(self, "observed_fractions", tuple(given))
        _check(
            self,
            "observed_fractions",
            lambda v: isinstance(v, tuple | list) and len(v) and all(0 < each <= 1 for each in v),
            "a list of fractions, each above 0 and at most 1",
        )
        _check(self, "window", lambda v: isinstance(v, int) and v >= 2, "an integer of at least 2")
        one_of("mask that is drawn anew", self.mask, REDRAWN)


LOSSES = ("head", "relative")
"""Losses of `TrainConfig.loss`."""

PRECISIONS = ("float32", "tf32", "bf16")
"""Precisions of the products of a training step, see `TrainConfig.precision`."""


@dataclass(frozen=True)
class TaskConfig:
    """How tasks are drawn; see `offbeat.data.tasks.draw_tasks`.

    Attributes:
        horizon_s: s, longest time after the last observation that is asked for.
        gap_s: s, typical time between rows: the shortest one.
        window_s: s, length of a window; by default four horizons, at least 64 typical gaps.
        sensors: names of the channels of each sensor; by default as `sensors_of` finds.
        shares: fraction of each kind of task; by default those of predictions from the past.
    """

    horizon_s: float
    gap_s: float
    window_s: float | None = None
    sensors: tuple[tuple[str, ...], ...] | None = None
    shares: dict[str, float] | None = None

    def __post_init__(self) -> None:
        if self.sensors is not None:
            object.__setattr__(self, "sensors", tuple(tuple(names) for names in self.sensors))
        for name in ("horizon_s", "gap_s", "window_s"):
            _check(self, name, lambda v: 0 < v < math.inf, "a positive number of seconds")
        shares = self.shares or {}
        if any(not share >= 0 for share in shares.values()) or (
            self.shares is not None and not math.isclose(sum(shares.values()), 1, abs_tol=1e-6)
        ):
            raise InputError(f"shares of tasks must be fractions that sum to 1, got {self.shares}")

    @property
    def length_s(self) -> float:
        """s, length of a window."""
        if self.window_s is not None:
            return self.window_s
        return max(4 * self.horizon_s, 64 * self.gap_s)


@dataclass(frozen=True)
class TrainConfig:
    """Options of a training. A field that is None takes the value of the model's recipe.

    Attributes:
        epochs: passes over the training trajectories, or over `tasks_per_epoch` tasks.
        batch_size: trajectories per step.
        optimizer: `adamax`, `adam`, `adamw` or `sgd`.
        learning_rate: of the optimizer, at the start.
        schedule: `constant`, or `cosine` decay to zero over all steps.
        clip_norm: gradients are scaled down to this global norm; math.inf never does.
        loss_scale: the loss is multiplied by this. Adam-like optimizers are invariant to it;
            `clip_norm` is not.
        seed: of the order of the batches and of self-feeding.
        patience: stop when the validation MSE has not improved for this number of epochs; None
            never stops early.
        keep: weights of the model after `fit`: of the `last` epoch, or of the `best`
            validation MSE; by default the best where there is a validation set.
        checkpoint_every: steps between checkpoints inside an epoch; None writes one at the end
            of each epoch only.
        tasks: train on tasks that are drawn anew from the trajectories in each epoch, and validate
            on a fixed set of them; None trains on the trajectories and their masks as they are.
        tasks_per_epoch: number of tasks of an epoch.
        redraw: train on windows and masks that are drawn anew in each epoch, from whole
            trajectories; validation stays as it is given. None keeps the windows and masks of the
            training set.
        loss: `head`, that of the model's head in scaled units; or `relative`, errors in units of
            those of the best baseline for the channel and the time since its last observation.
            With it, or with tasks, `patience` and `keep` go by the validation score, the mean
            logarithm of the ratio of the MSE to that of the best baseline.
        precision: of the products of weights and activations in a step. `float32` is that of
            IEEE; `tf32` rounds what is multiplied to 10 bits, on a GPU; `bf16` to 7 bits, on a
            GPU by autocast, on the CPU in the compiled backend where the processor has
            AVX512-BF16 or AMX (`offbeat doctor` says so). Sums, weights, the optimizer, states,
            times, the loss and the validation stay as they are.
    """

    epochs: int | None = None
    batch_size: int | None = None
    optimizer: Literal["adamax", "adam", "adamw", "sgd"] | None = None
    learning_rate: float | None = None
    schedule: Literal["constant", "cosine"] | None = None
    clip_norm: float | None = None
    loss_scale: float | None = None
    seed: int = 0
    patience: int | None = None
    keep: Literal["last", "best"] | None = None
    checkpoint_every: int | None = None
    tasks: TaskConfig | None = None
    tasks_per_epoch: int | None = None
    redraw: RedrawConfig | None = None
    loss: Literal["head", "relative"] | None = None
    precision: Literal["float32", "tf32", "bf16"] | None = None

    def __post_init__(self) -> None:
        if isinstance(self.tasks, dict):  # from JSON and YAML
            object.__setattr__(self, "tasks", from_mapping(TaskConfig, self.tasks))
        if isinstance(self.redraw, dict):
            object.__setattr__(self, "redraw", from_mapping(RedrawConfig, self.redraw))
        if self.tasks is not None and self.redraw is not None:
            raise InputError(
                "tasks and redraw both say what an epoch consists of; give one of the two"
            )
        for name, choices in (
            ("optimizer", ("adamax", "adam", "adamw", "sgd")),
            ("schedule", ("constant", "cosine")),
            ("keep", ("last", "best")),
            ("loss", LOSSES),
            ("precision", PRECISIONS),
        ):
            if getattr(self, name) is not None:
                one_of(f"value of {name}", getattr(self, name), choices)
        check_seed(self.seed)
        for name in ("epochs", "batch_size", "patience", "checkpoint_every", "tasks_per_epoch"):
            _check(self, name, lambda v: isinstance(v, int) and v >= 1, "an integer of at least 1")
        for name in ("learning_rate", "loss_scale"):
            _check(self, name, lambda v: 0 < v < math.inf, "a positive number")
        _check(self, "clip_norm", lambda v: v > 0, "a positive number")


@dataclass(frozen=True)
class Recipe:
    """A `TrainConfig` with every field set.

    Attributes:
        epochs: as in `TrainConfig`, as are all others.
        batch_size: trajectories per step.
        optimizer: name of the optimizer.
        learning_rate: at the start.
        schedule: of the learning rate.
        keep: weights of the model after `fit`.
        clip_norm: largest norm of the gradients; None for no limit.
        loss_scale: factor of the loss.
        seed: of the order of the batches and of self-feeding.
        patience: epochs without improvement; None never stops early.
        checkpoint_every: steps; None writes a checkpoint per epoch.
        tasks: how tasks are drawn; None trains on the trajectories as they are.
        tasks_per_epoch: number of tasks.
        redraw: how windows and masks are drawn; None keeps those of the training set.
        loss: `head` or `relative`.
        precision: of the products of a step.
    """

    epochs: int
    batch_size: int
    optimizer: str
    learning_rate: float
    schedule: str
    keep: str
    clip_norm: float | None = None
    loss_scale: float = 1.0
    seed: int = 0
    patience: int | None = None
    checkpoint_every: int | None = None
    tasks: TaskConfig | None = None
    tasks_per_epoch: int = 1024
    redraw: RedrawConfig | None = None
    loss: str = "head"
    precision: str = "float32"

    @property
    def relative(self) -> bool:
        """Whether the validation score is relative to the best baseline."""
        return self.tasks is not None or self.loss == "relative"


def check_count(name: str, value: int) -> int:
    """A number of things, checked.

    Args:
        name: of the argument.
        value: given.

    Raises:
        InputError: it is no integer of at least 1.
    """
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise InputError(f"{name} must be an integer of at least 1, got {value!r}")
    return value


def check_seed(seed: int) -> int:
    """Checks and returns a seed.

    Raises:
        InputError: it is not an integer from 0 to 2**32 - 1.
    """
    if not isinstance(seed, int) or isinstance(seed, bool) or not 0 <= seed < 2**32:
        raise InputError(f"seed must be an integer from 0 to {2**32 - 1}, got {seed!r}")
    return seed


def _check(config: Any, name: str, good: Any, expected: str) -> None:
    value = getattr(config, name)
    if value is None:
        return
    try:
        fine = bool(good(value)) and not isinstance(value, bool)
    except TypeError:
        fine = False
    if not fine:
        raise InputError(f"{name} must be {expected}, got {value!r}")


def from_mapping(cls: type[Any], values: dict[str, Any]) -> Any:
    """Makes a config from a mapping, such as from a JSON or YAML file.

    Raises:
        InputError: a key is not a field of the config; the message lists the fields.
    """
    known = [field_.name for field_ in fields(cls)]
    for key in values:
        one_of(f"key of {cls.__name__}", key, known)
    return cls(**values)
