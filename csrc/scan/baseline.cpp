#include <math.h>
#include <stddef.h>

#include <initializer_list>

#include "../records.hpp"
#if defined(__aarch64__)
#include <arm_neon.h>
#endif

#define VECTOR_BYTES 16

namespace offbeat {
namespace {
#include "vector.hpp"
#include "scan.hpp"
#include "kernels.hpp"
}  // namespace

extern const InstructionSet kernels_baseline;
constexpr InstructionSet kernels_baseline = {"baseline", make_kernels<float>(),
                                             make_kernels<double>()};
}  // namespace offbeat
