"""`offbeat export`."""

from __future__ import annotations

from pathlib import Path

from offbeat.cli.common import say
from offbeat.errors import one_of
from offbeat.progress import busy


def export_command(model: Path, out: Path, to: str = "onnx", json: bool = False) -> None:
    """Export one streaming step of a model or blend to ONNX, or a model for C++.

    A run of offbeat train holds a blend, whose predictions have intervals.
    An ONNX file runs without torch: in offbeat.OnnxStream, offbeat stream FILE, or any runtime.
    A file for C++ runs in the library of examples/cpp: models without transforms, in the compiled
    backend.

    Args:
        model: folder of a run or of a saved model.
        out: file to write; .onnx for ONNX.
        to: format of the file: onnx or cpp.
        json: print what was written as JSON.
    """
    one_of("export format", to, ("onnx", "cpp"))
    if to == "onnx":
        one_of("suffix of out", out.suffix, (".onnx",))

    from offbeat.answers.saved import load_run
    from offbeat.files import writable

    writable(out)
    loaded = load_run(model)
    with busy("exporting"):
        if to == "cpp":
            from offbeat.stream.file import write_stream

            write_stream(loaded, out)
        else:
            from offbeat.export.exporter import export_onnx

            export_onnx(loaded, out)
    size = out.stat().st_size
    result = {"written": str(out), "model": loaded.name, "bytes": size}
    say(result, f"{out}: one step of {loaded.name}, {size} bytes", json)
