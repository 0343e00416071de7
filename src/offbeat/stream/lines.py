"""A stream driven by JSON lines; each line gets one line as its answer, in order."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.errors import InputError, OffbeatError
from offbeat.stream.live import LiveStream


class LineSession:
    """Answers JSON lines.

        {"t": T, "values": {"CHANNEL": V, ...}}   V null, NaN or left out: not measured
        {"t": T, "values": [V, ...], "now": N}    in the order of the model; now is optional
        {"predict": T}  {"predict": [T, ...]}     consumes nothing
        {"reset": true}  {"counters": true}  {"state": true}  {"restore": STATE}

    An observation is answered with what was done with it and, where it is a new row, with the
    prediction that was made for it before its values were used: one step ahead. With a horizon, it
    is answered with the prediction `horizon_s` after the newest row. Where the model is a blend,
    predictions at a time have `low` and `high` beside them, the ends of their interval of 90 %.
    Where the state left the finite numbers and was reset, the answer has `"recovered": true`.

    Args:
        stream: takes the observations.
        horizon_s: s from the newest row to the time predicted at; None predicts each new row.
    """

    def __init__(self, stream: LiveStream, *, horizon_s: float | None = None) -> None:
        if horizon_s is not None and not 0 <= horizon_s < float("inf"):
            raise InputError(f"horizon_s must be 0 s or more, and finite, got {horizon_s!r}")
        self.stream, self.horizon_s = stream, horizon_s
        self.lines = self.bad_lines = 0

    def answer(self, line: bytes) -> bytes:
        """Answers a line, newline included; empty for a blank one. Invalid input never raises."""
        self.lines += 1
        if not line.strip():
            return b""
        try:
            text = json.dumps(self._answer(line), allow_nan=False)
        except (
            *(OffbeatError, ValueError, RecursionError),
            *(ArithmeticError, AttributeError, LookupError, TypeError),
        ) as error:
            return self._refusal(str(error) or type(error).__name__)
        return text.encode() + b"\n"

    def refuse(self, why: str) -> bytes:
        """The answer to a line that was not read."""
        self.lines += 1
        return self._refusal(why)

    def _refusal(self, why: str) -> bytes:
        self.bad_lines += 1
        message = " ".join(why.split())
        return json.dumps({"error": message, "line": self.lines}).encode() + b"\n"

    def _answer(self, line: bytes) -> dict[str, Any]:
        try:
            message = json.loads(line.decode("utf-8"))
        except ValueError as error:
            raise InputError(f"not JSON ({error}); every line is one object") from None
        if not isinstance(message, dict):
            raise InputError(f"a line must be a JSON object, got {type(message).__name__}")
        keys = message.keys()
        if {"t", "values"} <= keys <= {"t", "values", "now"}:
            before = self.stream.recoveries
            answer = self._observe(message)
            recovered = self.stream.recoveries > before
            return {**answer, "recovered": True} if recovered else answer
        if keys == {"predict"}:
            t = message["predict"]
            return {"predict": t, **self._predicted(t)}
        if keys == {"restore"}:
            self.stream.restore(message["restore"])
            return {"restored": True}
        if keys in ({"reset"}, {"state"}, {"counters"}):
            (key,) = keys
            if message[key] is not True:
                raise InputError(f"{key!r} must be true, got {message[key]!r}")
            return self._command(key)
        raise InputError(
            f"a line with the keys {', '.join(sorted(keys)) or 'none'} is not known; "
            "expected 't' and 'values' (and 'now'), or one of 'predict', 'reset', 'counters', "
            "'state', 'restore'"
        )

    def _observe(self, message: dict[str, Any]) -> dict[str, Any]:
        t, values, now = message["t"], message["values"], message.get("now")
        if self.horizon_s is None:
            outcome, predicted = self.stream.step(t, values, now=now)
            return {"t": t, "outcome": outcome, "prediction": self._named(predicted)}
        outcome = self.stream.observe(t, values, now=now)
        at = self.stream.after(self.horizon_s)
        after = {"prediction": None} if at is None else self._predicted(at)
        return {"t": t, "outcome": outcome, "at": at, **after}

    def _predicted(self, t: Any) -> dict[str, Any]:
        """The prediction at a time, and its interval of 90 % where the model has one."""
        predicted = self.stream.predict(t)
        answer = {"prediction": self._named(predicted)}
        if self.stream.has_intervals:
            half = self.stream.half_width(t).reshape(predicted.shape)
            answer |= {"low": self._named(predicted - half), "high": self._named(predicted + half)}
        return answer

    def _command(self, key: str) -> dict[str, Any]:
        if key == "state":
            return {"state": self.stream.state()}
        if key == "counters":
            return {"counters": self.stream.counters.to_dict() | {"pending": self.stream.pending}}
        self.stream.reset()
        return {"reset": True}

    def _named(self, prediction: NDArray[np.float64] | None) -> dict[str, Any] | None:
        """Channel to number, or to one number per time; without exogenous channels."""
        if prediction is None:
            return None
        columns = zip(self.stream.names, prediction.T, strict=True)
        return {name: column.tolist() for name, column in columns if not np.isnan(column).any()}
