"""`Stream`: runs a trained model on messages as they arrive."""

from __future__ import annotations

from typing import Any

import torch

from offbeat.answers.blend import Blend
from offbeat.answers.predict import Answering, answering
from offbeat.config import check_seed
from offbeat.data.scaler import Scaler
from offbeat.devices import resolved
from offbeat.models.base import BaseModel
from offbeat.models.corrected import CorrectedModel
from offbeat.models.model import Model
from offbeat.stream.blend_engine import BlendEngine
from offbeat.stream.corrected_engine import CorrectedEngine
from offbeat.stream.cpu_engine import CpuEngine
from offbeat.stream.engine import Engine
from offbeat.stream.live import LiveStream, StreamInfo
from offbeat.stream.options import StreamOptions, with_options
from offbeat.stream.replay import ReplayEngine
from offbeat.stream.torch_engine import TorchEngine


class Stream(LiveStream):
    """Runs a trained model on messages as they arrive, and predicts at any time.

    A stream of increasing times is the batch pass over the same rows, input transforms included:
    an angle that is sent wrapped is predicted wrapped. `StreamOptions` says what is done with
    messages that are late, repeated, stale or on another clock; counters record it.

    Models for which `predict` does not support `times` work here: the prediction is that of a
    row at that time, if it is the next one, and no row is added. A model with
    `readout="last_row"` predicts the same for every time. A model without a recurrent state is run
    again on its newest `window_rows` rows for each prediction.

    Args:
        model: trained; of a blend, or of the result of `learn`, predictions have intervals. Its
            weights must not change.
        options: what to do with messages out of order.
        time_unit: of all times given: s, ms, us or ns. Integers are exact.
        seed: of the generator of self-feeding.
        device: that the model is moved to, as of `fit`; by default its own. A message is one
            trajectory, which gains nothing from a GPU: `auto` takes the CPU for models of parts.
        **fields: fields of `StreamOptions` that replace those of `options`.

    Raises:
        InputError: an unknown unit or option, or an option out of its range.

    Example:
        >>> stream = Stream(model, time_unit="ns", late="reorder")  # doctest: +SKIP
        >>> stream.observe(1_700_000_000_123_456_789, {"knee": 0.3})  # doctest: +SKIP
        >>> stream.predict(1_700_000_000_133_456_789)  # doctest: +SKIP
    """

    def __init__(
        self,
        model: Answering,
        options: StreamOptions | None = None,
        *,
        time_unit: str = "s",
        seed: int = 0,
        device: str | torch.device | None = None,
        **fields: Any,
    ) -> None:
        model = answering(model)
        chosen, seed = with_options(options, fields), check_seed(seed)
        forward = model.forward if isinstance(model, Blend) else model
        if device is not None and forward is not None:
            forward.to(resolved(device, forward, batch=1))
        engine: Engine | None = None
        if forward is not None:
            window = chosen.window_rows or forward.statistics.rows or 1
            engine = engine_of(forward, seed=seed, window=window)
        if isinstance(model, Blend):
            engine = BlendEngine(model, engine)
        assert engine is not None
        super().__init__(engine, info_of(model), options=chosen, time_unit=time_unit)


def info_of(model: BaseModel | Blend) -> StreamInfo:
    """What a stream needs of a model or a blend besides an engine.

    Args:
        model: trained, or fitted.
    """
    if isinstance(model, Blend):
        forward = model.forward
        gap = model.tasks.gap_s if forward is None else forward.statistics.median_gap
        limit = 4.0 * float(model.stack.keys.bins.edges[-1])
        scaler = Scaler.identity(model.channels)
    else:
        inner = model.inner if isinstance(model, CorrectedModel) else model
        gap, scaler = model.statistics.median_gap, model.scaler
        limit = model.statistics.longest_elapsed
        if isinstance(inner, Model):
            limit *= float(inner.config.gap_limit or 1)
    return StreamInfo(
        names=model.names,
        units=model.units,
        scaler=scaler,
        median_gap=gap,
        elapsed_limit=limit,
        transforms=model.transforms,
        roles=model.roles,
    )


def engine_of(model: BaseModel, *, seed: int, window: int) -> Engine:
    """Returns the fastest engine that supports a model.

    Args:
        model: any.
        seed: of the generator of self-feeding.
        window: rows that a model without a recurrent state is run on.
    """
    if isinstance(model, CorrectedModel):
        return CorrectedEngine(model, engine_of(model.inner, seed=seed, window=window))
    if not isinstance(model, Model):
        return ReplayEngine(model, window=window)
    if CpuEngine.unsupported(model) is None:
        return CpuEngine(model, seed=seed)
    return TorchEngine(model, seed=seed)
