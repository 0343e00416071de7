"""`Stream`: a trained model, live."""

from __future__ import annotations

from typing import Any

from offbeat.config import check_seed
from offbeat.models.model import Model
from offbeat.stream.cpu_engine import CpuEngine
from offbeat.stream.engine import Engine
from offbeat.stream.live import Frame, LiveStream
from offbeat.stream.options import StreamOptions, with_options
from offbeat.stream.torch_engine import TorchEngine


class Stream(LiveStream):
    """A trained model fed with messages as they come; predictions at any time, in original units.

    A stream of increasing times is the batch pass over the same rows. What it does with messages
    that are late, repeated, stale or on another clock is said by `StreamOptions`, and counted.

    Models of the thesis' protocol that `predict` refuses to ask for times can be asked here: the
    answer is the prediction of a row at that time, should it come next, and no row is added. One
    with `readout="last_row"` gives the same answer for every time.

    Args:
        model: trained; its weights must stay as they are.
        policies: what to do with messages out of order.
        time_unit: of all times given: s, ms, us or ns. Integers are exact.
        seed: of the generator of self-feeding.
        **options: fields of `StreamOptions` that replace those of `policies`.

    Raises:
        InputError: an unknown unit or option, or a policy out of its range.

    Example:
        >>> stream = Stream(model, time_unit="ns", late="reorder")  # doctest: +SKIP
        >>> stream.observe(1_700_000_000_123_456_789, {"knee": 0.3})  # doctest: +SKIP
        >>> stream.predict(1_700_000_000_133_456_789)  # doctest: +SKIP
    """

    def __init__(
        self,
        model: Model,
        policies: StreamOptions | None = None,
        *,
        time_unit: str = "s",
        seed: int = 0,
        **options: Any,
    ) -> None:
        frame = Frame(
            names=model.names,
            units=model.units,
            scaler=model.scaler,
            median_gap=model.statistics.median_gap,
            elapsed_limit=model.statistics.longest_elapsed * float(model.config.gap_limit or 1),
        )
        super().__init__(
            engine_of(model, seed=check_seed(seed)),
            frame,
            policies=with_options(policies, options),
            time_unit=time_unit,
        )


def engine_of(model: Model, *, seed: int) -> Engine:
    """The fastest engine that runs a model: compiled code where it can, else torch."""
    if model.runs_compiled():
        return CpuEngine(model, seed=seed)
    return TorchEngine(model, seed=seed)
