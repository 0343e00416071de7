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
#include "table.hpp"
}  // namespace

extern const Bodies body_avx512;
constexpr Bodies body_avx512 = {"avx512", table<float>(), table<double>()};
}  // namespace offbeat
