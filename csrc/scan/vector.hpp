// Vectors of one instruction set and the functions of them that the scan uses. Included inside an
// anonymous namespace, after VECTOR_BYTES is set, so that each instruction set has its own copy.
//
// Every operation acts on each lane alone and in a fixed order. The compiler does not contract
// a * b + c; `fma` is explicit. The result of a lane does not depend on its position.

template <class T>
struct Lanes;
template <>
struct Lanes<float> {
  static constexpr int W = VECTOR_BYTES / 4;
  typedef float V __attribute__((vector_size(VECTOR_BYTES), may_alias));
  typedef float U __attribute__((vector_size(VECTOR_BYTES), aligned(4), may_alias));
  typedef int32_t I __attribute__((vector_size(VECTOR_BYTES), may_alias));
};
template <>
struct Lanes<double> {
  static constexpr int W = VECTOR_BYTES / 8;
  typedef double V __attribute__((vector_size(VECTOR_BYTES), may_alias));
  typedef double U __attribute__((vector_size(VECTOR_BYTES), aligned(8), may_alias));
  typedef int64_t I __attribute__((vector_size(VECTOR_BYTES), may_alias));
};
typedef Lanes<float>::V VF;
typedef Lanes<double>::V VD;

#define INLINE inline __attribute__((always_inline))
#define NOINLINE __attribute__((noinline))  // large functions with many callers

template <class T>
INLINE typename Lanes<T>::V load(const T* p) {
  return *reinterpret_cast<const typename Lanes<T>::U*>(p);
}
template <class T, class V>
INLINE void store(T* p, V v) {
  *reinterpret_cast<typename Lanes<T>::U*>(p) = v;
}
template <class T>
INLINE typename Lanes<T>::V broadcast(T s) {
  return s - typename Lanes<T>::V{};
}

#if defined(__AVX512F__) && VECTOR_BYTES == 64
INLINE VF fma(VF a, VF b, VF c) { return (VF)_mm512_fmadd_ps((__m512)a, (__m512)b, (__m512)c); }
INLINE VD fma(VD a, VD b, VD c) { return (VD)_mm512_fmadd_pd((__m512d)a, (__m512d)b, (__m512d)c); }
#elif defined(__FMA__) && VECTOR_BYTES == 32
INLINE VF fma(VF a, VF b, VF c) { return (VF)_mm256_fmadd_ps((__m256)a, (__m256)b, (__m256)c); }
INLINE VD fma(VD a, VD b, VD c) { return (VD)_mm256_fmadd_pd((__m256d)a, (__m256d)b, (__m256d)c); }
#elif defined(__aarch64__) && VECTOR_BYTES == 16
INLINE VF fma(VF a, VF b, VF c) {
  return (VF)vfmaq_f32((float32x4_t)c, (float32x4_t)a, (float32x4_t)b);
}
INLINE VD fma(VD a, VD b, VD c) {
  return (VD)vfmaq_f64((float64x2_t)c, (float64x2_t)a, (float64x2_t)b);
}
#else
INLINE VF fma(VF a, VF b, VF c) { return a * b + c; }
INLINE VD fma(VD a, VD b, VD c) { return a * b + c; }
#endif

// Four floats, for outputs that do not fill a vector.
typedef float F4 __attribute__((vector_size(16), may_alias));
typedef float U4 __attribute__((vector_size(16), aligned(4), may_alias));
INLINE F4 load_four(const float* p) { return *reinterpret_cast<const U4*>(p); }
#if defined(__FMA__)
INLINE F4 fma_four(F4 a, F4 b, F4 c) { return (F4)_mm_fmadd_ps((__m128)a, (__m128)b, (__m128)c); }
#elif defined(__aarch64__)
INLINE F4 fma_four(F4 a, F4 b, F4 c) {
  return (F4)vfmaq_f32((float32x4_t)c, (float32x4_t)a, (float32x4_t)b);
}
#else
INLINE F4 fma_four(F4 a, F4 b, F4 c) { return a * b + c; }
#endif

// A vector from runs of four floats that are `stride` apart.
#if defined(__AVX512F__) && VECTOR_BYTES == 64
INLINE VF load_fours(const float* p, int64_t stride) {
  __m512 v = _mm512_castps128_ps512(_mm_loadu_ps(p));
  v = _mm512_insertf32x4(v, _mm_loadu_ps(p + stride), 1);
  v = _mm512_insertf32x4(v, _mm_loadu_ps(p + 2 * stride), 2);
  return (VF)_mm512_insertf32x4(v, _mm_loadu_ps(p + 3 * stride), 3);
}
#elif defined(__AVX__) && VECTOR_BYTES == 32
INLINE VF load_fours(const float* p, int64_t stride) {
  return (VF)_mm256_insertf128_ps(_mm256_castps128_ps256(_mm_loadu_ps(p)),
                                  _mm_loadu_ps(p + stride), 1);
}
#else
INLINE VF load_fours(const float* p, int64_t) { return load(p); }
#endif

// NaN stays NaN: the processor's minimum and maximum return their second operand if either is NaN.
#if defined(__AVX512F__) && VECTOR_BYTES == 64
INLINE VF at_most(VF x, float b) { return (VF)_mm512_min_ps((__m512)broadcast(b), (__m512)x); }
INLINE VF at_least(VF x, float b) { return (VF)_mm512_max_ps((__m512)broadcast(b), (__m512)x); }
#elif defined(__AVX__) && VECTOR_BYTES == 32
INLINE VF at_most(VF x, float b) { return (VF)_mm256_min_ps((__m256)broadcast(b), (__m256)x); }
INLINE VF at_least(VF x, float b) { return (VF)_mm256_max_ps((__m256)broadcast(b), (__m256)x); }
#else
INLINE VF at_most(VF x, float bound) { return x > bound ? broadcast(bound) : x; }
INLINE VF at_least(VF x, float bound) { return x < bound ? broadcast(bound) : x; }
#endif

// e^x to about one unit in the last place: x = n ln 2 + r, e^r by a polynomial, 2^n by the bits of
// the exponent. The coefficients minimise the relative error on |r| <= ln(2) / 2.
INLINE VF exp_(VF x) {
  typedef Lanes<float>::I I;
  const VF clipped = at_least(at_most(x, 88.3762626647949f), -87.0f);
  const float magic = 12582912.0f;  // 1.5 * 2^23: the sum's last bits are the nearest integer
  const VF shifted = fma(clipped, broadcast(1.44269504088896341f), broadcast(magic));
  const VF n = shifted - magic;
  VF r = fma(n, broadcast(-0.693359375f), clipped);
  r = fma(n, broadcast(2.12194440e-4f), r);
  VF p = broadcast(0.0013814602280035615f);
  p = fma(p, r, broadcast(0.008368715643882751f));
  p = fma(p, r, broadcast(0.04166838899254799f));
  p = fma(p, r, broadcast(0.1666652113199234f));
  p = fma(p, r, broadcast(0.4999999403953552f));
  p = fma(p * r, r, r) + 1.0f;
  const VF scaled = (VF)((I)p + (((I)shifted - (I)broadcast(magic)) << 23));
  return x == x ? scaled : x;
}

// tanh by a rational function whose coefficients minimise the relative error on |x| <= 9.
INLINE VF tanh_(VF x) {
  const VF c = at_least(at_most(x, 9.0f), -9.0f);
  const VF s = c * c;
  VF p = broadcast(-8.488485927740067e-14f);
  p = fma(p, s, broadcast(5.277864249328928e-11f));
  p = fma(p, s, broadcast(-2.0225057213953934e-08f));
  p = fma(p, s, broadcast(1.1154267936870513e-05f));
  p = fma(p, s, broadcast(0.003103952426080618f));
  p = fma(p, s, broadcast(0.13084006728068379f));
  p = fma(p, s, broadcast(0.9999999933915865f));
  VF q = broadcast(0.0002546139664214674f);
  q = fma(q, s, broadcast(0.024495163370306997f));
  q = fma(q, s, broadcast(0.46417333830218066f));
  q = fma(q, s, broadcast(1.0f));
  return c * p / q;
}

// Double precision is for tests: the functions of the C library, lane by lane.
INLINE VD exp_(VD x) {
  for (int i = 0; i < Lanes<double>::W; ++i) x[i] = ::exp(x[i]);
  return x;
}
INLINE VD tanh_(VD x) {
  for (int i = 0; i < Lanes<double>::W; ++i) x[i] = ::tanh(x[i]);
  return x;
}

template <class V>
INLINE V sigmoid_(V x) {
  return 1 / (1 + exp_(-x));
}

// Transposes the 8 rows of 8 floats at `x(i)` into `y(i)`.
#if defined(__AVX__)
#define FAST_TRANSPOSE 1
template <class X, class Y>
INLINE void transpose_8_by_8(const X& x, const Y& y) {
  __m256 r[8], t[8];
  for (int i = 0; i < 8; ++i) r[i] = _mm256_loadu_ps(x(i));
  for (int i = 0; i < 8; i += 2) {
    t[i] = _mm256_unpacklo_ps(r[i], r[i + 1]);
    t[i + 1] = _mm256_unpackhi_ps(r[i], r[i + 1]);
  }
  for (int i = 0; i < 8; i += 4) {
    r[i] = _mm256_shuffle_ps(t[i], t[i + 2], 0x44);
    r[i + 1] = _mm256_shuffle_ps(t[i], t[i + 2], 0xee);
    r[i + 2] = _mm256_shuffle_ps(t[i + 1], t[i + 3], 0x44);
    r[i + 3] = _mm256_shuffle_ps(t[i + 1], t[i + 3], 0xee);
  }
  for (int i = 0; i < 4; ++i) {
    _mm256_storeu_ps(y(i), _mm256_permute2f128_ps(r[i], r[i + 4], 0x20));
    _mm256_storeu_ps(y(i + 4), _mm256_permute2f128_ps(r[i], r[i + 4], 0x31));
  }
}
#else
#define FAST_TRANSPOSE 0
template <class X, class Y>
INLINE void transpose_8_by_8(const X&, const Y&) {}
#endif
