"""The zoo: models as choices of parts with training recipes.

These are the models of table 2.1 of the thesis, and anchored models with a trend. `register_model`
adds others.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import torch
from torch import nn

from offbeat.config import ModelConfig, Recipe, TrainConfig, check_seed, from_mapping
from offbeat.data.batch import Batch
from offbeat.data.scaler import SCALERS, Scaler, ScalerKind, check_observed
from offbeat.data.shards import ShardedDataset
from offbeat.data.trajectory import EXOGENOUS, Dataset
from offbeat.data.transforms import Transforms
from offbeat.errors import InputError, one_of
from offbeat.models.base import BaseModel, DataInfo
from offbeat.models.foreign import ForeignModel
from offbeat.models.gains import tune_filters
from offbeat.models.model import Model, depends_on_rows
from offbeat.models.statistics import Statistics
from offbeat.registry import Registry

COMMON: dict[str, Any] = {
    "hidden_size": 15,
    "head": "point",
    "decoder_units": (100,),
    "cell": "gru",
    "reset_after": False,
    "vector_field": "none",
    "field_units": (100, 100, 100, 100),
    "activation": "tanh",
    "solver": "euler",
    "nodes": "observations",
    "steps_per_gap": 1,
    "rtol": 1e-4,
    "atol": 1e-6,
    "gradient": "backprop",
    "decay": "none",
    "decay_rows": "continuous",
    "input_decay": False,
    "anchored": False,
    "trend": False,
    "update_rows": "observed",
    "time_input": "none",
    "time_input_unit": "gap",
    "self_feeding": 0.0,
    "readout": "target",
    "init": "normal",
    "typical_gap": 0.01,
    "clock": "first_observation",
    "gap_limit": 4.0,
    "bounded": False,
}
"""Sizes and initial weights of the thesis (chapter 3, after Rubanova et al. 2019)."""

_ANCHORED: dict[str, Any] = {
    "vector_field": "mlp",
    "anchored": True,
    "hidden_size": 32,
    "field_units": (100, 100, 100),
    "activation": "silu",
    "init": "fan_in",
    "typical_gap": 0.3,
}

ZOO: dict[str, dict[str, Any]] = {
    "rnn": {"cell": "elman", "time_input": "elapsed"},
    "lstm": {"cell": "lstm", "time_input": "elapsed"},
    "gru": {"time_input": "elapsed"},
    "rnn_decay": {"decay": "vector", "time_input": "elapsed"},
    "gru_d": {"decay": "trainable", "input_decay": True},
    "neural_ode": {"cell": "none", "vector_field": "mlp"},
    "ode_rnn": {"vector_field": "mlp"},
    "ode_gru_d": {"decay": "trainable", "input_decay": True, "vector_field": "mlp"},
    "anchored_ode_gru_d": _ANCHORED,
    # Slopes widen the vector field's ends; its narrower inner layers make up for it.
    "anchored_trend": {**_ANCHORED, "trend": True, "field_units": (96, 96, 96)},
    "anchored_trend_large": {
        **_ANCHORED,
        "trend": True,
        "hidden_size": 64,
        "field_units": (256, 256, 256),
    },
}
"""Options of each model that differ from the common choice."""

THESIS_MODELS = ("gru", "gru_d", "ode_rnn", "ode_gru_d")
"""The four models that the thesis compares."""

_THESIS_RECIPE: dict[str, Any] = {
    "epochs": 50,
    "batch_size": 50,
    "optimizer": "adamax",
    "learning_rate": 1e-3,
    "schedule": "constant",
    "loss_scale": 1.0,
}
_ANCHORED_RECIPE: dict[str, Any] = {
    **_THESIS_RECIPE,
    "optimizer": "adam",
    "learning_rate": 0.002,
    "schedule": "cosine",
    "clip_norm": 1.0,
    "loss_scale": 100.0,
}
_FOREIGN_RECIPE: dict[str, Any] = {**_THESIS_RECIPE, "optimizer": "adam"}
_TASK_RECIPE: dict[str, Any] = {
    "epochs": 25,
    "batch_size": 16,
    "optimizer": "adam",
    "learning_rate": 0.003,
    "schedule": "cosine",
    "clip_norm": 1.0,
    "loss_scale": 1.0,
    "tasks_per_epoch": 1024,
    "loss": "relative",
}
"""Of any model that is trained on tasks: at least 1,600 steps, however short the log is."""


@dataclass(frozen=True)
class ModelEntry:
    """An entry of the registry of models.

    Attributes:
        options: fields of `ModelConfig` that differ from the common choice.
        recipe: fields of `TrainConfig` that the model is trained with by default.
        factory: of a registered module: (data, **options) to a module; None for a composed model.
    """

    options: Mapping[str, Any] = field(default_factory=dict)
    recipe: Mapping[str, Any] = field(default_factory=dict)
    factory: Callable[..., nn.Module] | None = None


def _adopt(found: Any) -> ModelEntry:
    """The entry of what an entry point of another package gives."""
    if isinstance(found, ModelEntry):
        return found
    if isinstance(found, type) and issubclass(found, nn.Module):
        return ModelEntry({}, _FOREIGN_RECIPE, found)
    raise TypeError("expected a subclass of torch.nn.Module, or a function that registers one")


MODELS: Registry[ModelEntry] = Registry("model", group="offbeat.models", adopt=_adopt)
"""Models by the name that `make_model` takes."""

for _name, _options in ZOO.items():
    # An anchored state is the prediction itself, so a bad step affects all later ones:
    # it needs Adam, cosine decay and clipped gradients.
    _recipe = _ANCHORED_RECIPE if _options.get("anchored") else _THESIS_RECIPE
    if _name == "anchored_trend_large":
        _recipe = {**_recipe, "learning_rate": 0.0015}
    MODELS.register(_name, ModelEntry(_options, _recipe))


def list_models() -> tuple[str, ...]:
    """Names of all models that `make_model` supports, including those of other packages."""
    return tuple(MODELS)


def register_model(
    name: str,
    model: Callable[..., nn.Module] | Mapping[str, Any],
    *,
    recipe: Mapping[str, Any] | None = None,
    replace: bool = False,
) -> None:
    """Registers a model for `make_model`, `fit`, `evaluate` and the command line.

    Args:
        name: of the model.
        model: a class or function that takes a `DataInfo` and keyword options and returns a
            `torch.nn.Module` whose `forward(batch)` returns a `Prediction` of every row from what
            was observed before it; or a choice of parts, as fields of `ModelConfig`.
        recipe: fields of `TrainConfig` to train it with; by default Adam at 0.001 for a module,
            and that of the thesis for a choice of parts.
        replace: allow a name that is taken.

    Raises:
        InputError: the name is taken, a field is unknown, or the model is none of these.
    """
    composed = isinstance(model, Mapping)
    common = _THESIS_RECIPE if composed else _FOREIGN_RECIPE
    chosen = {**common, **(recipe or {})}
    from_mapping(TrainConfig, chosen)
    if isinstance(model, Mapping):
        for key in model:
            one_of("model option", key, [f.name for f in fields(ModelConfig)])
        entry = ModelEntry(dict(model), chosen)
    elif not callable(model):
        raise InputError(
            f"a model must be a class, a function that makes a module, or a mapping, got {model!r}"
        )
    else:
        entry = ModelEntry({}, chosen, model)
    MODELS.register(name, entry, replace=replace)


def resolve(config: ModelConfig) -> ModelConfig:
    """Replaces None in a config by the choice of its zoo entry, and what follows from it.

    Raises:
        InputError: the zoo has no such entry.
    """
    chosen = {**COMMON, **MODELS[config.name].options}
    still_open = {
        f.name: chosen[f.name]
        for f in fields(config)
        if getattr(config, f.name) is None and f.name in chosen
    }
    whole = replace(config, **still_open)
    if config.nodes is None and depends_on_rows(whole):
        still_open["nodes"] = "rows"
    if config.bounded is None and "bounded" not in MODELS[config.name].options:
        still_open["bounded"] = whole.vector_field != "none"
    return replace(config, **still_open)


def thesis_config(name: str, **options: Any) -> ModelConfig:
    """The configuration of a model in the thesis' protocol.

    Predictions are decoded from the last row, the clock starts at the first row, gamma_h compounds
    at every row of the grid, the solver takes its steps from row to row and is not bounded, a plain
    GRU is given the gap since the row before, and self-feeding,
    where it is on, does not decay h at masked rows.

    Args:
        name: `gru`, `gru_d`, `ode_rnn` or `ode_gru_d`.
        **options: fields of `ModelConfig`, `self_feeding=0.5` for the published GRU rows.
    """
    one_of("thesis model", name, THESIS_MODELS)
    feeding = bool(options.get("self_feeding"))
    protocol: dict[str, Any] = {
        "nodes": "rows",
        "bounded": False,
        "readout": "last_row",
        "clock": "first_row",
        "decay_rows": "observed_rows" if feeding else "every_row",
    }
    if name == "gru":
        protocol["time_input"] = "gap"
    return ModelConfig(name=name, **{**protocol, **options})


def train_config(name: str, **options: Any) -> TrainConfig:
    """The training recipe of a model, with every field set.

    Args:
        name: of the model.
        **options: fields of `TrainConfig` that replace those of the recipe.

    Raises:
        InputError: there is no such model, or an option is out of its range.
    """
    given = {key: value for key, value in options.items() if value is not None}
    config: TrainConfig = from_mapping(TrainConfig, {**MODELS[name].recipe, **given})
    return config


def recipe_of(name: str, config: TrainConfig | None = None, *, validated: bool) -> Recipe:
    """The training configuration of a model, completed by its recipe.

    Args:
        name: of the model; an unknown one gets the default recipe of registered modules.
        config: given options; None for the recipe.
        validated: whether there is a validation set; then the best weights on it are kept.
    """
    entry = MODELS[name] if name in MODELS else ModelEntry(factory=nn.Module)
    common = _THESIS_RECIPE if entry.factory is None else _FOREIGN_RECIPE
    asked = (
        {}
        if config is None
        else {
            f.name: value for f in fields(config) if (value := getattr(config, f.name)) is not None
        }
    )
    tasks = _TASK_RECIPE if "tasks" in asked else {}
    if asked.get("clip_norm") == math.inf:
        asked["clip_norm"] = None
    keep = "best" if validated else "last"
    return Recipe(**{"keep": keep, **common, **entry.recipe, **tasks, **asked})


def make_model(
    model: str | ModelConfig,
    train: Dataset | ShardedDataset,
    *,
    scaler: ScalerKind | Scaler = "standardise",
    seed: int = 0,
    tasks: Dataset | None = None,
    **options: Any,
) -> Any:
    """Makes an untrained model for the channels, scales and gaps of a training set.

    Args:
        model: name of a model, or a config.
        train: the training set; means, scales and gaps are measured on its observed values. A
            folder of `Dataset.open` is read once for them.
        scaler: a kind, fitted on `train`, or a scaler fitted elsewhere.
        seed: of the initial weights.
        tasks: that the filters of a model with a trend are tuned on; by default the training set,
            or tasks that are drawn from it where nothing in it is masked.
        **options: fields of `ModelConfig` that replace the entry's; for a registered module,
            the arguments of its factory.

    Returns:
        A `Model`, or a `ForeignModel` for a registered module.

    Raises:
        InputError: unknown model or option, or a channel that is never observed.

    Example:
        >>> model = make_model("ode_rnn", train, hidden_size=32)  # doctest: +SKIP
    """
    sharded: ShardedDataset | None = None
    if isinstance(train, ShardedDataset):
        sharded, train = train, train.sample()
    train = Dataset.of(train)
    check_seed(seed)
    name = model if isinstance(model, str) else model.name
    entry = MODELS[name]
    if entry.factory is not None:
        info = _info(train, scaler) if sharded is None else _info_of(sharded, train, scaler)
        return _foreign(name, entry.factory, info, options, seed)
    config = ModelConfig(name=model) if isinstance(model, str) else model
    for key in options:
        one_of("model option", key, [f.name for f in fields(config)])
    config = resolve(replace(config, **options))
    info = _info(train, scaler) if sharded is None else _info_of(sharded, train, scaler)
    if config.trend:
        filters = tune_filters(train if tasks is None else tasks)
        info = replace(info, statistics=replace(info.statistics, filters=filters))
    return Model(config, info, seed=seed)


def _info(train: Dataset, scaler: ScalerKind | Scaler) -> DataInfo:
    count = sum(t.observed.sum(axis=0) for t in train)
    check_observed(train.names, count, len(train), roles=train.roles)
    if isinstance(scaler, str):
        scaler = Scaler.fit(scaler, train)
    elif len(scaler.shift) != train.channels:
        raise InputError(
            f"the scaler has {len(scaler.shift)} channels, the data has {train.channels}"
        )
    batch = Batch.of(train, scaler=scaler)
    if all(role == EXOGENOUS for role in batch.roles):
        raise InputError(
            "every channel is exogenous, so there is nothing to predict; give one the role 'state'"
        )
    return DataInfo(
        train.names,
        train.units,
        batch.roles,
        scaler,
        Statistics.of(batch, robust=scaler.kind == "robust"),
        Transforms.of(train),
    )


def _info_of(sharded: ShardedDataset, sample: Dataset, scaler: ScalerKind | Scaler) -> DataInfo:
    """`_info` of a folder, from one pass over it."""
    if all(role == EXOGENOUS for role in sharded.roles):
        raise InputError(
            "every channel is exogenous, so there is nothing to predict; give one the role 'state'"
        )
    found = sharded.moments
    check_observed(sharded.names, found.count, len(sharded), roles=sharded.roles)
    if isinstance(scaler, str):
        one_of("scaler", scaler, SCALERS)
        each = (found.count, found.mean, found.variance, found.low, found.high)
        scaler = Scaler.of_moments(scaler, sharded.names, *each)
    rows = max(max(shard.rows) for shard in sharded.shards)
    rows = rows if sharded.window is None else min(rows, sharded.window)
    return DataInfo(
        sharded.names,
        sharded.units,
        sharded.roles,
        scaler,
        Statistics.of_moments(found, scaler, rows=rows),
        Transforms.of(sample),
    )


def build(name: str, config: Mapping[str, Any], data: DataInfo, *, seed: int = 0) -> BaseModel:
    """Makes a model from the record of a checkpoint.

    Args:
        name: of the model.
        config: fields of `ModelConfig`, or the options of a registered module.
        data: properties of the data that it is made for.
        seed: of the initial weights.

    Raises:
        InputError: a field is wrong.
    """
    if name in MODELS and (factory := MODELS[name].factory) is not None:
        return _foreign(name, factory, data, dict(config), seed)
    return Model(from_mapping(ModelConfig, dict(config)), data, seed=seed)


def _foreign(
    name: str,
    factory: Callable[..., nn.Module],
    data: DataInfo,
    options: dict[str, Any],
    seed: int,
) -> ForeignModel:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        try:
            module = factory(data, **options)
        except TypeError as error:
            raise InputError(f"the model {name!r} cannot be made: {error}") from error
    return ForeignModel(name, module, data, options)
