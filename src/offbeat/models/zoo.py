"""The zoo: each model of the field as a choice of parts. Table 2.1 of the thesis, as code."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

from offbeat.config import ModelConfig, TrainConfig, from_mapping
from offbeat.data.batch import Batch
from offbeat.data.scaler import Scaler, ScalerKind, check_observed
from offbeat.data.trajectory import Dataset
from offbeat.errors import InputError, one_of
from offbeat.models.model import Model
from offbeat.models.statistics import Statistics

_COMMON: dict[str, Any] = {
    "hidden_size": 15,
    "decoder_units": (100,),
    "cell": "gru",
    "reset_after": False,
    "vector_field": "none",
    "field_units": (100, 100, 100, 100),
    "activation": "tanh",
    "solver": "euler",
    "steps_per_gap": 1,
    "rtol": 1e-4,
    "atol": 1e-6,
    "gradient": "backprop",
    "decay": "none",
    "decay_rows": "continuous",
    "input_decay": False,
    "anchored": False,
    "update_rows": "observed",
    "time_input": "none",
    "time_input_unit": "gap",
    "self_feeding": 0.0,
    "readout": "target",
    "init": "normal",
    "typical_gap": 0.01,
    "clock": "first_observation",
    "gap_limit": 4.0,
}
"""Sizes and initial weights of the thesis (chapter 3, after Rubanova et al. 2019)."""

ZOO: dict[str, dict[str, Any]] = {
    "rnn": {"cell": "elman", "time_input": "elapsed"},
    "lstm": {"cell": "lstm", "time_input": "elapsed"},
    "gru": {"time_input": "elapsed"},
    "rnn_decay": {"decay": "vector", "time_input": "elapsed"},
    "gru_d": {"decay": "trainable", "input_decay": True},
    "neural_ode": {"cell": "none", "vector_field": "mlp"},
    "ode_rnn": {"vector_field": "mlp"},
    "ode_gru_d": {"decay": "trainable", "input_decay": True, "vector_field": "mlp"},
    "anchored_ode_gru_d": {
        "vector_field": "mlp",
        "anchored": True,
        "hidden_size": 32,
        "field_units": (100, 100, 100),
        "activation": "silu",
        "init": "fan_in",
        "typical_gap": 0.3,
    },
}
"""What each model changes of the common choice."""

THESIS_MODELS = ("gru", "gru_d", "ode_rnn", "ode_gru_d")
"""The four models that the thesis compares."""


def resolve(config: ModelConfig) -> ModelConfig:
    """Fills what a config leaves open with the choice of its zoo entry.

    Raises:
        InputError: the zoo has no such entry.
    """
    one_of("model", config.name, ZOO)
    chosen = {**_COMMON, **ZOO[config.name]}
    still_open = {
        f.name: chosen[f.name]
        for f in fields(config)
        if getattr(config, f.name) is None and f.name in chosen
    }
    return replace(config, **still_open)


def thesis_config(name: str, **options: Any) -> ModelConfig:
    """A model of the thesis under the thesis' protocol, oddities included.

    Predictions are read from the last row, the state moves from the first row on, gamma_h compounds
    at every row of the grid, a plain GRU is given the gap since the row before, and self-feeding,
    where it is on, leaves h undecayed at hidden rows.

    Args:
        name: `gru`, `gru_d`, `ode_rnn` or `ode_gru_d`.
        **options: fields of `ModelConfig`, `self_feeding=0.5` for the published GRU rows.
    """
    one_of("thesis model", name, THESIS_MODELS)
    feeding = bool(options.get("self_feeding"))
    protocol: dict[str, Any] = {
        "readout": "last_row",
        "clock": "first_row",
        "decay_rows": "observed_rows" if feeding else "every_row",
    }
    if name == "gru":
        protocol["time_input"] = "gap"
    return ModelConfig(name=name, **{**protocol, **options})


def train_config(name: str, **options: Any) -> TrainConfig:
    """The training that a model was measured with: the thesis' own, unless stated otherwise.

    The anchored model trains with Adam, cosine decay and clipped gradients, which it needs: its
    state holds the prediction itself, so one bad step is seen by all that follow.

    Args:
        name: id of the zoo's entry.
        **options: fields of `TrainConfig`, `epochs` above all.

    Raises:
        InputError: the zoo has no such entry, or an option is out of its range.
    """
    one_of("model", name, ZOO)
    own: dict[str, Any] = {}
    if ZOO[name].get("anchored"):
        own = {
            "optimizer": "adam",
            "learning_rate": 0.002,
            "schedule": "cosine",
            "clip_norm": 1.0,
            "loss_scale": 100.0,
        }
    config: TrainConfig = from_mapping(TrainConfig, {**own, **options})
    return config


def make_model(
    model: str | ModelConfig,
    train: Dataset,
    *,
    scaler: ScalerKind | Scaler = "standardise",
    seed: int = 0,
    **options: Any,
) -> Model:
    """Makes an untrained model for the channels, scales and gaps of a training set.

    Args:
        model: id of the zoo's entry, or a config.
        train: the training part; means, scales and gaps are measured on its observed cells.
        scaler: a kind, fitted on `train`, or a scaler fitted elsewhere.
        seed: of the initial weights.
        **options: fields of `ModelConfig` that replace the entry's own.

    Raises:
        InputError: unknown model or option, or a channel that is never observed.

    Example:
        >>> model = make_model("ode_rnn", train, hidden_size=32)  # doctest: +SKIP
    """
    config = ModelConfig(name=model) if isinstance(model, str) else model
    for key in options:
        one_of("model option", key, [f.name for f in fields(config)])
    config = resolve(replace(config, **options))
    check_observed(train.names, sum(t.observed.sum(axis=0) for t in train), len(train))
    if isinstance(scaler, str):
        scaler = Scaler.fit(scaler, train)
    elif len(scaler.shift) != train.channels:
        raise InputError(
            f"the scaler has {len(scaler.shift)} channels, the data has {train.channels}"
        )
    statistics = Statistics.of(Batch.of(train, scaler=scaler))
    return Model(config, statistics, scaler=scaler, names=train.names, units=train.units, seed=seed)
