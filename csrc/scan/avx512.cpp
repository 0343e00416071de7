#include <math.h>
#include <stddef.h>

#include <initializer_list>

#include "../records.hpp"
#include <immintrin.h>

#define VECTOR_BYTES 64

namespace offbeat {
namespace {
#include "vector.hpp"
#include "scan.hpp"
#include "kernels.hpp"
}  // namespace

extern const InstructionSet kernels_avx512;
constexpr InstructionSet kernels_avx512 = {"avx512", make_kernels<float>(), make_kernels<double>()};
}  // namespace offbeat
