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
#include "table.hpp"
}  // namespace

extern const Bodies body_baseline;
constexpr Bodies body_baseline = {"baseline", table<float>(), table<double>()};
}  // namespace offbeat
