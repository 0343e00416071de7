// Products in bfloat16 with AMX; all else is that of avx512.cpp.
#include <math.h>
#include <stddef.h>

#include <initializer_list>

#include "../records.hpp"
#include <immintrin.h>

#define VECTOR_BYTES 64
#define BF16 1
#define BF16_AMX 1

namespace offbeat {
namespace {
#include "vector.hpp"
#include "scan.hpp"
#include "kernels.hpp"

using S = Scan<float>;
constexpr Kernels<float> with_tiles() {
  Kernels<float> t = make_kernels<float>();
  t.forward = [](const Job<float>& job, int block, int begin, int end, float* scratch) {
    const S::Tiles tiles;
    S::forward(job, block, begin, end, scratch);
  };
  t.backward = [](const Job<float>& job, int slot, int begin, int end, float* scratch) {
    const S::Tiles tiles;
    S::backward(job, slot, begin, end, scratch);
  };
  t.perceptron_forward = [](const PerceptronJob<float>& job, int64_t block, float* scratch) {
    const S::Tiles tiles;
    S::perceptron_forward(job, block, scratch);
  };
  t.perceptron_backward = [](const PerceptronJob<float>& job, int slot, float* scratch) {
    const S::Tiles tiles;
    S::perceptron_backward(job, slot, scratch);
  };
  return t;
}
}  // namespace

extern const InstructionSet kernels_amx_bf16;
constexpr InstructionSet kernels_amx_bf16 = {"amx_bf16", with_tiles(), {}};
}  // namespace offbeat
