"""`offbeat export`."""

from __future__ import annotations

from pathlib import Path

from offbeat.cli.common import say
from offbeat.errors import one_of
from offbeat.progress import busy


def export_command(model: Path, out: Path, to: str = "onnx", json: bool = False) -> None:
    """Export one streaming step of a model or blend to ONNX, its state as inputs and outputs.

    A run of offbeat train holds a blend, whose predictions have intervals.
    The file runs without torch: in offbeat.OnnxStream, offbeat stream FILE, or any ONNX runtime.

    Args:
        model: folder of a run or of a checkpoint.
        out: .onnx file to write.
        to: format of the file: onnx.
        json: print what was written as JSON.
    """
    one_of("export format", to, ("onnx",))
    one_of("suffix of out", out.suffix, (".onnx",))

    from offbeat.answers.saved import load_run
    from offbeat.export.exporter import export_onnx
    from offbeat.files import writable

    writable(out)
    loaded = load_run(model)
    with busy("exporting"):
        export_onnx(loaded, out)
    size = out.stat().st_size
    result = {"written": str(out), "model": loaded.name, "bytes": size}
    say(result, f"{out}: one step of {loaded.name}, {size} bytes", json)
