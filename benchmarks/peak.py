"""The most multiply-adds that one core does: a loop in registers, compiled here.

It is the limit that a training step is compared with. Each repeat takes some milliseconds, and the
best counts, so that a busy machine changes little.

    python benchmarks/peak.py --json results/benchmarks/peak.json
"""

from __future__ import annotations

import argparse
import ctypes
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

from common import machine, write

WIDTHS = {"avx2": (8, ["-mavx2", "-mfma"]), "avx512": (16, ["-mavx512f", "-mfma"])}
CHAINS = 12
"""Sums that do not depend on each other; a multiply-add takes four to five cycles."""

SOURCE = """
typedef float V __attribute__((vector_size(4 * WIDTH)));
float loop(long n, float a, float b) {
  V sum[CHAINS], x = a - (V){}, y = b - (V){};
  for (int i = 0; i < CHAINS; ++i) sum[i] = (float)i - (V){};
  for (long k = 0; k < n; ++k) {
#pragma GCC unroll 16
    for (int i = 0; i < CHAINS; ++i) sum[i] = sum[i] * x + y;
  }
  V all = sum[0];
  for (int i = 1; i < CHAINS; ++i) all += sum[i];
  return all[0];
}
"""


def peak(name: str, repeats: int) -> float:
    """GFLOP/s of one core with an instruction set, float32; a multiply-add counts as two."""
    width, flags = WIDTHS[name]
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder) / "loop.c", Path(folder) / "loop.so"
        source.write_text(SOURCE)
        defined = [f"-DWIDTH={width}", f"-DCHAINS={CHAINS}", "-ffp-contract=fast"]
        command = ["cc", "-O3", "-shared", "-fPIC", *flags, *defined, source, "-o", library]
        subprocess.run(command, check=True)
        loop = ctypes.CDLL(str(library)).loop
    loop.argtypes, loop.restype = [ctypes.c_long, ctypes.c_float, ctypes.c_float], ctypes.c_float
    steps, best = 500_000, float("inf")
    for _ in range(repeats):
        start = time.process_time()
        loop(steps, 0.999, 0.001)
        best = min(best, time.process_time() - start)
    return 2 * width * CHAINS * steps / best / 1e9


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=300)
    parser.add_argument("--json")
    options = parser.parse_args()
    flags = Path("/proc/cpuinfo").read_text().split()
    found: dict[str, Any] = {}
    for name in WIDTHS:
        if {"avx2": "avx2", "avx512": "avx512f"}[name] in flags:
            found[name] = round(peak(name, options.repeats), 1)
            print(f"{name:8} {found[name]:8.1f} GFLOP/s on one core", flush=True)
    write(options.json, {"machine": machine(), "options": vars(options), "gflops": found})


if __name__ == "__main__":
    main()
