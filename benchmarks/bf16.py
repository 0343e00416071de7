"""What products in bfloat16 could gain: one layer of a vector field against float32.

The layer, compiled here, has the layout of the scan ([unit][lane], 32 trajectories) and as many
units as inputs. Eight layers take turns, so that weights come from the cache as in a scan. It needs
a processor with AVX512-BF16.

    python benchmarks/bf16.py --json results/benchmarks/bf16.json
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from common import machine, write

SOURCE = r"""
#include <immintrin.h>
#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <ctime>

constexpr int LANES = 32, LAYERS = 8;

__attribute__((noinline)) void layer(int n, const float* w, const float* x, float* y) {
  for (int o = 0; o < n; o += 4) {
    __m512 sum[4][2];
    for (auto& r : sum) r[0] = r[1] = _mm512_setzero_ps();
    for (int k = 0; k < n; ++k) {
      const __m512 a = _mm512_loadu_ps(x + k * LANES), b = _mm512_loadu_ps(x + k * LANES + 16);
      for (int r = 0; r < 4; ++r) {
        const __m512 each = _mm512_set1_ps(w[o * n + k * 4 + r]);
        sum[r][0] = _mm512_fmadd_ps(each, a, sum[r][0]);
        sum[r][1] = _mm512_fmadd_ps(each, b, sum[r][1]);
      }
    }
    for (int r = 0; r < 4; ++r)
      for (int v = 0; v < 2; ++v) _mm512_storeu_ps(y + (o + r) * LANES + 16 * v, sum[r][v]);
  }
}
// Weights and x in pairs of inputs.
__attribute__((noinline)) void layer(int n, const uint32_t* w, const uint32_t* x, float* y) {
  for (int o = 0; o < n; o += 4) {
    __m512 sum[4][2];
    for (auto& r : sum) r[0] = r[1] = _mm512_setzero_ps();
    for (int k = 0; k < n / 2; ++k) {
      const __m512bh a = (__m512bh)_mm512_loadu_si512(x + k * LANES);
      const __m512bh b = (__m512bh)_mm512_loadu_si512(x + k * LANES + 16);
      for (int r = 0; r < 4; ++r) {
        const __m512bh each = (__m512bh)_mm512_set1_epi32(w[o * n / 2 + k * 4 + r]);
        sum[r][0] = _mm512_dpbf16_ps(sum[r][0], each, a);
        sum[r][1] = _mm512_dpbf16_ps(sum[r][1], each, b);
      }
    }
    for (int r = 0; r < 4; ++r)
      for (int v = 0; v < 2; ++v) _mm512_storeu_ps(y + (o + r) * LANES + 16 * v, sum[r][v]);
  }
}
__attribute__((noinline)) void round_pairs(int n, const float* x, uint32_t* to) {
  for (int k = 0; k < n; k += 2)
    for (int v = 0; v < LANES; v += 16) {
      const __m512i both = (__m512i)_mm512_cvtne2ps_pbh(
          _mm512_loadu_ps(x + (k + 1) * LANES + v), _mm512_loadu_ps(x + k * LANES + v));
      const __m512i low = _mm512_cvtepu16_epi32(_mm512_castsi512_si256(both));
      const __m512i high = _mm512_cvtepu16_epi32(_mm512_extracti64x4_epi64(both, 1));
      _mm512_storeu_si512(to + k / 2 * LANES + v,
                          _mm512_or_si512(low, _mm512_slli_epi32(high, 16)));
    }
}
double now() {
  timespec t;
  clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &t);
  return t.tv_sec * 1e9 + t.tv_nsec;
}
template <class F>
double turn(F one) {
  const double start = now();
  for (int i = 0; i < 5 * LAYERS; ++i) one(i % LAYERS);
  return (now() - start) / (5 * LAYERS);
}
int main(int, char** argv) {
  const int n = atoi(argv[1]), turns = atoi(argv[2]);
  auto* w = (float*)aligned_alloc(64, 4L * LAYERS * n * n);
  auto* pairs = (uint32_t*)aligned_alloc(64, 2L * LAYERS * n * n);
  auto* x = (float*)aligned_alloc(64, 4L * n * LANES);
  auto* rounded = (uint32_t*)aligned_alloc(64, 2L * n * LANES);
  auto* y = (float*)aligned_alloc(64, 4L * n * LANES);
  for (long i = 0; i < long(LAYERS) * n * n; ++i) w[i] = 0.01f;
  for (long i = 0; i < long(LAYERS) * n * n / 2; ++i) pairs[i] = 0x3c243c24;
  for (int i = 0; i < n * LANES; ++i) x[i] = 0.1f;
  double single = 1e30, half = 1e30;
  for (int i = 0; i < turns; ++i) {
    single = std::min(single, turn([&](int l) { layer(n, w + long(l) * n * n, x, y); }));
    half = std::min(half, turn([&](int l) {
      round_pairs(n, x, rounded);
      layer(n, pairs + long(l) * n * n / 2, rounded, y);
    }));
  }
  printf("{\"float32_ns\": %.0f, \"bf16_ns\": %.0f, \"ratio\": %.2f}\n", single, half,
         single / half);
}
"""


def main() -> None:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--units", type=int, nargs="+", default=[64, 128, 256])
    parser.add_argument("--repeats", type=int, default=60)
    parser.add_argument("--json")
    options = parser.parse_args()
    if "avx512_bf16" not in Path("/proc/cpuinfo").read_text():
        raise SystemExit("this processor has no AVX512-BF16 (avx512_bf16 in /proc/cpuinfo)")
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as folder:
        source, program = Path(folder) / "bf16.cpp", Path(folder) / "bf16"
        source.write_text(SOURCE)
        flags = ["-mavx512f", "-mavx512bf16", "-mavx512vl", "-mavx512dq", "-mavx512bw", "-mfma"]
        command = ["c++", "-O3", "-std=c++17", *flags, str(source), "-o", str(program)]
        subprocess.run(command, check=True)
        for units in options.units:
            command = [str(program), str(units), str(options.repeats)]
            done = subprocess.run(command, capture_output=True, check=True, text=True)
            found[str(units)] = json.loads(done.stdout)
            print(f"{units:4} units, 32 trajectories: {done.stdout.strip()}", flush=True)
    write(options.json, {"machine": machine(), "options": vars(options), "layers": found})


if __name__ == "__main__":
    main()
