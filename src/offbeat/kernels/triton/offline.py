"""Compiles the kernels for a GPU without one, and reports what they need of it.

    python -m offbeat.kernels.triton.offline --arch 80 90

`TRITON_INTERPRET` must not be set. The wheel of Triton has the assembler.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import tempfile
from dataclasses import asdict, dataclass
from itertools import product
from pathlib import Path
from typing import Any

from offbeat.errors import InputError
from offbeat.kernels.spec import ScanSpec
from offbeat.kernels.triton.backend import interpreted, options, tiles
from offbeat.kernels.triton.shape import Shape

SHARED_LIMIT = {80: 99 * 1024, 90: 227 * 1024}
"""Bytes of shared memory that a program may have. A100 has 163 KiB; other GPUs that run code for
its generation have 99 KiB."""


@dataclass(frozen=True)
class Compiled:
    """What a compiled kernel needs.

    Attributes:
        kernel: its name.
        arch: compute capability times ten.
        shared: bytes of shared memory of a program.
        registers: of a thread.
        spilled: bytes of a thread that do not fit into registers: its stack, and local memory.
        code: bytes of the machine code.
    """

    kernel: str
    arch: int
    shared: int
    registers: int
    spilled: int
    code: int


def compiled(kernel: str, shape: Shape, arch: int) -> Compiled:
    """Compiles a kernel for a shape.

    Args:
        kernel: `forward` or `backward`.
        shape: of the scan.
        arch: compute capability times ten, such as 80 or 90.

    Raises:
        InputError: Triton interprets kernels in this process.
    """
    if interpreted():
        raise InputError("TRITON_INTERPRET is set; unset it to compile kernels")
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from offbeat.kernels.triton.backward import scan_backward
    from offbeat.kernels.triton.forward import scan_forward

    function: Any = {"forward": scan_forward, "backward": scan_backward}[kernel]
    constants: dict[str, Any] = {"c": shape}
    if kernel == "backward":
        constants |= {"HAS_BEFORE": True, "HAS_AFTER": True}
    integers = {"batch", "rows", "slot_stride", "begin", "stop_at", "places"}
    kinds = {"layers": "*i32", "steps": "*i32", "slots": "*i64"} | dict.fromkeys(integers, "i32")
    signature = {
        name: "constexpr" if name in constants else kinds.get(name, "*fp32")
        for name in function.arg_names
    }
    # As at a launch: all buffers are aligned to 16 bytes.
    aligned: Any = {
        (i,): [["tt.divisibility", 16]]
        for i, name in enumerate(function.arg_names)
        if signature[name].startswith("*")
    }
    source = ASTSource(fn=function, signature=signature, constexprs=constants, attrs=aligned)
    found = triton.compile(source, target=GPUTarget("cuda", arch, 32), options=options(shape))
    usage = _usage(found.asm["cubin"])
    return Compiled(
        kernel,
        arch,
        found.metadata.shared,
        usage["REG"],
        usage["LOCAL"] + usage["STACK"],
        len(found.asm["cubin"]),
    )


def _usage(cubin: bytes) -> dict[str, int]:
    """Registers, stack and local memory of a kernel."""
    import triton

    tool = Path(triton.__file__).parent / "backends" / "nvidia" / "bin" / "cuobjdump"
    with tempfile.NamedTemporaryFile(suffix=".cubin") as file:
        file.write(cubin)
        file.flush()
        text = subprocess.run(
            [tool, "--dump-resource-usage", file.name], capture_output=True, text=True, check=True
        ).stdout
    return {name: int(number) for name, number in re.findall(r"(REG|LOCAL|STACK):(\d+)", text)}


def example(hidden: int, *, anchored: bool = True) -> ScanSpec:
    """A spec with every part that the models of the zoo have, as wide as `hidden` allows.

    Args:
        hidden: units of h.
        anchored: the channels are part of the state, with a trend; else h decays.
    """
    units = {15: 100, 64: 128}.get(hidden, hidden)
    channels = 14
    driven = hidden + 2 * channels * anchored
    return ScanSpec(
        channels=channels,
        hidden_size=hidden,
        cell="gru",
        gates=3 * hidden,
        anchored=anchored,
        trend=anchored,
        field=(driven, units, units, units, driven),
        activation="silu" if anchored else "tanh",
        max_step=0.3,
        nodes=True,
        decay_span=4.0,
        bounded=True,
        decay=0 if anchored else channels,
    )


def main() -> None:
    """Compiles the shapes of `benchmarks/gpu.py` and prints a line for each."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--arch", type=int, nargs="+", default=[80, 90])
    parser.add_argument("--hidden", type=int, nargs="+", default=[15, 64, 256])
    parser.add_argument("--batch", type=int, nargs="+", default=[50, 512, 4096])
    parser.add_argument("--precision", nargs="+", default=["ieee", "tf32"])
    parser.add_argument("--anchored", nargs="+", default=["yes", "no"], choices=["yes", "no"])
    parser.add_argument("--kernel", nargs="+", default=["forward", "backward"])
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    if not given.json:
        print(
            "kernel   arch precision hidden batch anchored tiles         shared registers spilled"
            "    code"
        )
    chosen = product(given.arch, given.precision, given.hidden, given.batch, given.anchored)
    for (arch, precision, hidden, batch, anchored), kernel in product(chosen, given.kernel):
        spec = example(hidden, anchored=anchored == "yes")
        shape = Shape.of(spec, tiles(spec, batch, precision), precision)
        one = compiled(kernel, shape, arch)
        if given.json:
            print(json.dumps(asdict(one)), flush=True)
            continue
        print(
            f"{kernel:8} {arch:4} {precision:9} {hidden:6} {batch:5} {anchored:8} "
            f"{shape.BM:2} x{shape.BN:4} x{shape.BK:3} {one.shared:8} {one.registers:9} "
            f"{one.spilled:7} {one.code:7}",
            flush=True,
        )


if __name__ == "__main__":
    main()
