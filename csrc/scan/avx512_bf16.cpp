// Products in bfloat16 with AVX512-BF16; all else is that of avx512.cpp.
#include <math.h>
#include <stddef.h>

#include <initializer_list>

#include "../records.hpp"
#include <immintrin.h>

#define VECTOR_BYTES 64
#define BF16 1

namespace offbeat {
namespace {
#include "vector.hpp"
#include "scan.hpp"
#include "kernels.hpp"
}  // namespace

extern const InstructionSet kernels_avx512_bf16;
constexpr InstructionSet kernels_avx512_bf16 = {"avx512_bf16", make_kernels<float>(), {}};
}  // namespace offbeat
