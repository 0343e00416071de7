#include <math.h>
#include <stddef.h>

#include <initializer_list>

#include "../records.hpp"
#include <immintrin.h>

#define VECTOR_BYTES 32

namespace offbeat {
namespace {
#include "vector.hpp"
#include "scan.hpp"
#include "kernels.hpp"
}  // namespace

extern const InstructionSet kernels_avx2;
constexpr InstructionSet kernels_avx2 = {"avx2", make_kernels<float>(), make_kernels<double>()};
}  // namespace offbeat
