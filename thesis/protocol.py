"""The protocol of the thesis: every number of it, the runs it consists of, and their order."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any

from offbeat import InputError, ModelConfig, TrainConfig
from offbeat.errors import one_of

if TYPE_CHECKING:
    from offbeat import Dataset

SELF_FEEDING = ("gru", "gru_d")
"""Models that are fed their own predictions in the thesis' rows."""

MODELS: dict[str, str] = {
    "gru": "gru",
    "gru_d": "gru_d",
    "ode_rnn": "ode_rnn",
    "ode_gru_d": "ode_gru_d",
    "gru_fair": "gru",
    "gru_d_fair": "gru_d",
    "anchored_ode_gru_d": "anchored_ode_gru_d",
    "gru_unfed": "gru",
    "gru_d_unfed": "gru_d",
}
"""Labels of the record, each with its entry in the zoo. The first four are the thesis' rows."""

THESIS_ROWS = tuple(MODELS)[:4]
CONTROLS = ("gru_unfed", "gru_d_unfed")
"""GRU and GRU-D of the thesis' rows but for self-feeding: they show its effect."""


@dataclass(frozen=True)
class Run:
    """One training and its scores.

    Attributes:
        experiment: 1, learning curves (section 3.2), or 2, repeats (section 3.3).
        model: label, one of `MODELS`.
        observed_fraction: fraction of the rows that stay observed.
        repeat: counted from 0.
        epochs: passes over the training part.
        seed_draw: of windows, masks, split, order of the batches and generator. It follows from
            experiment, fraction and repeat alone, so that the models of a repeat are paired.
        seed_weights: of the initial weights.
    """

    experiment: int
    model: str
    observed_fraction: float
    repeat: int
    epochs: int
    seed_draw: int
    seed_weights: int

    @property
    def run_id(self) -> str:
        """Name of the run, of its folder too: `e2-ode_rnn-30-r04`."""
        percent = round(100 * self.observed_fraction)
        return f"e{self.experiment}-{self.model}-{percent}-r{self.repeat:02d}"


@dataclass(frozen=True)
class Protocol:
    """Every number that the thesis' experiments depend on, and of those that we add.

    Sections, equations, tables and figures are the thesis'. What it leaves open is settled as
    `docs/deviations.md` says.

    Attributes:
        robot: simulated robot (section 3.1): `qpos` and `qvel`, 14 channels, zero control.
        n_trajectories: simulated (section 3.1).
        recorded_rows: rows per simulated trajectory, one per physics step of 5 ms (section 3.1).
        state_seed: of the initial states: the seed of the public generator of the lost file.
        window: consecutive rows cut out of each trajectory, with a random start (section 3.1).
        scaler: normalisation `(x - min) / max` over all rows (section 3.1).
        parts: fractions of training, validation and test trajectories (section 3.1).
        observed_fractions: observed fractions of the rows (section 3.1; tables 3.1 to 3.6).
        hidden_size: units of the hidden state, all models of the thesis (section 3.2).
        decoder_units: hidden layers of the decoder, tanh between (OutputNN, section 3.2).
        field_units: hidden layers of the ODE function, tanh between (ODEFunc, section 3.2).
        solver: of the ODE (section 3.2).
        steps_per_gap: solver steps between two rows (section 3.2).
        typical_gap: model time between two rows.
        init: initial weights: `normal` is N(0, 0.1^2), biases 0 (section 3.2).
        batch_size: trajectories per step (section 3.2).
        optimizer: of the thesis' models (section 3.2).
        learning_rate: of the thesis' models, constant (section 3.2).
        epochs_of_curves: of experiment 1 (section 3.2; tables 3.1 to 3.5, figures 3.3 to 3.6).
        repeats: of experiment 2 (section 3.3; table 3.6, figures 3.7 to 3.10).
        epochs_of_repeats: of experiment 2 for each of `observed_fractions` (section 3.3).
        self_feeding: fraction of rows at which the GRU and GRU-D of the thesis' rows are fed their
            own predictions (inferred, `docs/deviations.md`).
        anchored_hidden_size: units of h in the anchored model, which is ours, as all that follows.
        anchored_field_units: hidden layers of its ODE function, SiLU between.
        anchored_typical_gap: model time between two rows: one Euler step of 0.3.
        anchored_optimizer: of the anchored model.
        anchored_learning_rate: at the start; it falls to 0 as a cosine over all steps.
        anchored_clip_norm: its gradients are scaled down to this norm.
        anchored_loss_scale: its loss is this multiple of the mean squared error.
    """

    robot: str = "hopper"
    n_trajectories: int = 10_000
    recorded_rows: int = 200
    state_seed: int = 123
    window: int = 100
    scaler: str = "divide_by_max"
    parts: tuple[float, float, float] = (0.7, 0.15, 0.15)
    observed_fractions: tuple[float, ...] = (0.9, 0.7, 0.5, 0.3)
    hidden_size: int = 15
    decoder_units: tuple[int, ...] = (100,)
    field_units: tuple[int, ...] = (100, 100, 100, 100)
    solver: str = "euler"
    steps_per_gap: int = 1
    typical_gap: float = 0.01
    init: str = "normal"
    batch_size: int = 50
    optimizer: str = "adamax"
    learning_rate: float = 0.001
    epochs_of_curves: int = 300
    repeats: int = 10
    epochs_of_repeats: tuple[int, ...] = (75, 50, 50, 50)
    self_feeding: float = 0.5
    anchored_hidden_size: int = 32
    anchored_field_units: tuple[int, ...] = (100, 100, 100)
    anchored_typical_gap: float = 0.3
    anchored_optimizer: str = "adam"
    anchored_learning_rate: float = 0.002
    anchored_clip_norm: float = 1.0
    anchored_loss_scale: float = 100.0

    def __post_init__(self) -> None:
        for field in fields(self):  # as JSON gives them back
            if isinstance(value := getattr(self, field.name), list):
                object.__setattr__(self, field.name, tuple(value))
        if len(self.epochs_of_repeats) != len(self.observed_fractions):
            raise InputError(
                f"epochs_of_repeats needs one number for each of the {len(self.observed_fractions)}"
                f" observed fractions, got {self.epochs_of_repeats}"
            )
        percents = [round(100 * fraction) for fraction in self.observed_fractions]
        fine = all(0 < fraction <= 1 for fraction in self.observed_fractions)
        if not percents or not fine or len(set(percents)) != len(percents):
            raise InputError(
                "observed_fractions must be above 0 and at most 1, and differ by a percent "
                f"or more, got {self.observed_fractions}"
            )
        if not 1 <= self.repeats <= 100:
            raise InputError(f"repeats must be from 1 to 100, got {self.repeats}")
        if min(self.epochs_of_curves, *self.epochs_of_repeats) < 1:
            raise InputError("epochs must be at least 1")

    @classmethod
    def tiny(cls) -> Protocol:
        """All of it, small: every model, fraction and experiment, in minutes on two cores.

        Its numbers mean nothing; that they can be made does.
        """
        return cls(
            n_trajectories=200, epochs_of_curves=3, repeats=3, epochs_of_repeats=(2, 1, 1, 1)
        )

    def runs(self) -> tuple[Run, ...]:
        """All runs, in an order in which a part of them is useful.

        Experiment 2 goes repeat by repeat, and in a repeat fraction by fraction, each over all
        models but the controls, so that what is done is always paired. The four models of
        experiment 1 at one fraction follow each of the first repeats. The controls come last.
        """
        runs, controls = list[Run](), list[Run]()
        for i in range(max(self.repeats, len(self.observed_fractions))):
            if i < self.repeats:
                for fraction, epochs in zip(
                    self.observed_fractions, self.epochs_of_repeats, strict=True
                ):
                    for model in MODELS:
                        (controls if model in CONTROLS else runs).append(
                            self._run(2, model, fraction, i, epochs)
                        )
            if i < len(self.observed_fractions):
                fraction = self.observed_fractions[i]
                runs += [
                    self._run(1, model, fraction, 0, self.epochs_of_curves) for model in THESIS_ROWS
                ]
        return (*runs, *controls)

    def _run(self, experiment: int, model: str, fraction: float, repeat: int, epochs: int) -> Run:
        draw = 100_000 * experiment + 1000 * round(100 * fraction) + repeat
        weights = 1_000_000 * (1 + list(MODELS).index(model)) + draw
        return Run(experiment, model, fraction, repeat, epochs, draw, weights)

    def steps(self, run: Run) -> int:
        """Optimizer steps of a run."""
        training = math.floor(self.parts[0] * self.n_trajectories + 0.5)
        return run.epochs * math.ceil(training / self.batch_size)

    # --- what a run is made of --------------------------------------------------------------------

    def simulate(self, *, progress: bool = True) -> Dataset:
        """The recorded trajectories that all runs cut their windows from."""
        from offbeat import simulate

        return simulate(
            self.robot,
            self.n_trajectories,
            self.recorded_rows,
            seed=self.state_seed,
            progress=progress,
        )

    def cut(self, recorded: Dataset, run: Run) -> tuple[Dataset, Dataset, Dataset]:
        """Training, validation and test part of a run: equal for all models of a repeat.

        Args:
            recorded: from `simulate`.
            run: names fraction and seed.
        """
        from offbeat import mask_out, split, windows

        cut = windows(recorded, self.window, seed=run.seed_draw)
        masked = mask_out(cut, run.observed_fraction, seed=run.seed_draw)
        train, validation, test = split(masked, self.parts, seed=run.seed_draw)
        return train, validation, test

    def model_config(self, label: str) -> ModelConfig:
        """What a model of the record consists of.

        The two fair models keep the thesis' readout and clock. Without self-feeding they see what
        the ODE models see; both update at every row, and GRU is given the time since each
        channel's last observation (equation 25). The controls are the rows of the thesis without
        self-feeding, and differ from them in nothing else.

        Args:
            label: one of `MODELS`.
        """
        from offbeat.models.zoo import thesis_config

        one_of("model of the protocol", label, MODELS)
        if label in CONTROLS:
            return replace(self.model_config(MODELS[label]), self_feeding=0.0)
        if label == "anchored_ode_gru_d":
            return ModelConfig(
                name=label,
                hidden_size=self.anchored_hidden_size,
                field_units=self.anchored_field_units,
                solver=self.solver,
                steps_per_gap=self.steps_per_gap,
                typical_gap=self.anchored_typical_gap,
                nodes="rows",
                bounded=False,
            )
        options: dict[str, Any] = {
            "hidden_size": self.hidden_size,
            "decoder_units": self.decoder_units,
            "field_units": self.field_units,
            "solver": self.solver,
            "steps_per_gap": self.steps_per_gap,
            "typical_gap": self.typical_gap,
            "init": self.init,
        }
        if label in SELF_FEEDING:
            options["self_feeding"] = self.self_feeding
        if label.endswith("_fair"):
            options["update_rows"] = "every"
        if label == "gru_fair":
            options |= {"time_input": "delta", "time_input_unit": "longest"}
        return thesis_config(MODELS[label], **options)

    def train_config(self, run: Run) -> TrainConfig:
        """How a run is trained: batches and generator follow from its draw, so they are paired too.

        Args:
            run: names model, epochs and seed.
        """
        from offbeat.models.zoo import train_config

        anchored: dict[str, Any] = {"clip_norm": self.anchored_clip_norm}
        anchored |= {"loss_scale": self.anchored_loss_scale, "schedule": "cosine"}
        own = run.model == "anchored_ode_gru_d"
        return train_config(
            MODELS[run.model],
            epochs=run.epochs,
            batch_size=self.batch_size,
            optimizer=self.anchored_optimizer if own else self.optimizer,
            learning_rate=self.anchored_learning_rate if own else self.learning_rate,
            seed=run.seed_draw,
            keep="last",
            **(anchored if own else {}),
        )


_KEYS = ("experiment", "model", "observed_fraction", "repeat")


def select(runs: Iterable[Run], only: str | None) -> tuple[Run, ...]:
    """The runs that a filter such as `experiment=1,model=ode_rnn,model=gru` names, in their order.

    Args:
        runs: to choose from.
        only: `key=value`, separated by commas; a key given twice allows either value. Keys:
            experiment, model, observed_fraction (or fraction), repeat. None chooses all.

    Raises:
        InputError: a key or value is not understood, or nothing is left.
    """
    runs = tuple(runs)
    if not only:
        return runs
    wanted: dict[str, list[Any]] = {}
    for part in only.split(","):
        key, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals or not value:
            raise InputError(f"got {part!r} in only={only!r}, expected key=value")
        key = "observed_fraction" if key == "fraction" else key
        one_of("key of only", key, _KEYS)
        wanted.setdefault(key, []).append(_value(key, value, only))
    chosen = tuple(
        run for run in runs if all(getattr(run, key) in values for key, values in wanted.items())
    )
    if not chosen:
        raise InputError(f"only={only!r} leaves none of the {len(runs)} runs; loosen it")
    return chosen


def _value(key: str, text: str, only: str) -> Any:
    if key == "model":
        return one_of("model of the protocol", text, MODELS)
    try:
        return float(text) if key == "observed_fraction" else int(text)
    except ValueError:
        raise InputError(f"{key} must be a number, got {text!r} in only={only!r}") from None
