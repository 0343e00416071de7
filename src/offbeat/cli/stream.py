"""`offbeat stream`."""

from __future__ import annotations

from pathlib import Path

from offbeat.config import check_seed
from offbeat.stream.options import StreamOptions


def stream_command(
    model: Path,
    options: StreamOptions = StreamOptions(),  # noqa: B008  # frozen
    horizon_s: float | None = None,
    time_unit: str = "s",
    state: Path | None = None,
    seed: int = 0,
    device: str = "cpu",
    stats: bool = False,
) -> None:
    """Run a model live: reads JSON lines from standard input, writes an answer for each.

    The answer to {"t": 0.25, "values": {"knee": 0.3}} says what was done with the message and holds
    a prediction. Channels that are null or left out were not measured. {"predict": 0.3} predicts
    without an observation; {"reset": true}, {"counters": true}, {"state": true} and
    {"restore": STATE} are further requests. The answer to a bad line is {"error": ...}. The command
    ends at the end of the input or on SIGTERM, once every line that had arrived is answered.

    Args:
        model: folder of a run or of a saved model, or a file that `offbeat export` wrote.
        options: what is done with messages that are late, repeated, stale or on another clock.
        horizon_s: predict this many seconds after the newest row; by default each row is predicted
            at its own time, before its values are used.
        time_unit: unit of all times: s, ms, us or ns. Integers are exact.
        state: JSON file with the state of a stream: restored if the file exists, written at the
            end.
        seed: seed of models that draw random numbers (those trained with --model.self_feeding).
        device: device that computes the model: cpu, cuda, cuda:1 or auto.
        stats: print latencies and counters as JSON on standard error at the end.
    """
    import json
    import os
    import sys
    import time

    from offbeat.data.source import read_json
    from offbeat.errors import FileFormatError, InputError
    from offbeat.files import writable, write_json
    from offbeat.stream.latency import Latency
    from offbeat.stream.lines import LineSession
    from offbeat.stream.live import LiveStream
    from offbeat.stream.pipes import serve

    check_seed(seed)
    if state is not None:
        writable(state)
    stream: LiveStream
    if model.suffix == ".onnx":
        from offbeat.export.runner import OnnxStream

        stream = OnnxStream(model, options, time_unit=time_unit)
    else:
        import torch

        from offbeat.answers.saved import load_run
        from offbeat.stream.stream import Stream

        torch.set_num_threads(1)
        loaded = load_run(model)
        stream = Stream(loaded, options, time_unit=time_unit, seed=seed, device=device)
    if state is not None and state.exists():
        try:
            stream.restore(read_json(state))
        except InputError as error:
            raise FileFormatError(f"{state} can't be restored: {error}") from None
    session, latency = LineSession(stream, horizon_s=horizon_s), Latency()

    def answer(line: bytes) -> bytes:
        began = time.perf_counter_ns()
        reply = session.answer(line)
        latency.add(time.perf_counter_ns() - began)
        return reply

    if sys.stdin is None or sys.stdout is None:
        raise InputError(
            "standard input and standard output must be open; a stream reads and answers"
        )
    sys.stdout.flush()
    complete = serve(answer, session.refuse, source=sys.stdin.fileno(), sink=sys.stdout.fileno())
    if not complete:
        # The interpreter would try to flush a pipe that is closed.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, sys.stdout.fileno())
        os.close(nowhere)
    if state is not None:
        write_json(state, stream.state())
    if stats:
        counted = {
            "lines": session.lines,
            "bad_lines": session.bad_lines,
            "answers_heard_to_the_end": complete,
            "latency": latency.to_dict(),
            "counters": stream.counters.to_dict() | {"pending": stream.pending},
        }
        print(json.dumps(counted, indent=2), file=sys.stderr)
