// Affine maps and activations, of a block and of a stream: part of Scan<T> (scan.hpp).

// Applied to each vector of a product before it is stored; the argument is its offset.
struct Plain {
  INLINE V operator()(V a, int64_t) const { return a; }
  INLINE void soon(int64_t) const {}
};
struct TimesTanhSlope {  // the derivative of tanh, computed from its value
  const T* value;
  INLINE V operator()(V a, int64_t i) const {
    const V y = load<T>(value + i);
    return a * fma(-y, y, splat(1));
  }
  // The tape comes from an outer cache, which a sum hides if it is asked for before.
  INLINE void soon(int64_t i) const { __builtin_prefetch(value + i); }
};

// tanh, stored where the backward pass finds it.
struct Tanh {
  T* value;
  INLINE V operator()(V a, int64_t) const { return tanh_(a); }
  INLINE void soon(int64_t i) const { __builtin_prefetch(value + i, 1); }
};

// y[o] = (accumulate ? y[o] : bias[o]) + sum over k of w[o][k] x[k], k in order. P panels at a time:
// their sums do not depend on each other, and a multiply-add takes several cycles.
// `W` is the stride of a unit.
template <int P, int NV, int W, bool ACCUMULATE, class Finish>
static INLINE void panels(const T* w, const T* bias, int rows, int in, const T* x, T* y, int64_t at,
                          const Finish& finish) {
  y += at;
  constexpr int R = P * TILE;
  for (int r = 0; r < R; ++r)
    if (r < rows)
      for (int v = 0; v < NV; ++v) finish.soon(at + r * W + v * VW);
  V acc[R][NV];
  for (int r = 0; r < R; ++r)
    for (int v = 0; v < NV; ++v) {
      if (ACCUMULATE)
        acc[r][v] = r < rows ? load<T>(y + r * W + v * VW) : splat(0);
      else
        acc[r][v] = splat(bias ? bias[r] : T(0));
    }
  for (int k = 0; k < in; ++k) {
    V xv[NV];
    for (int v = 0; v < NV; ++v) xv[v] = load<T>(x + int64_t(k) * W + v * VW);
    for (int p = 0; p < P; ++p)
      for (int r = 0; r < TILE; ++r) {
        const V wv = splat(w[(int64_t(p) * in + k) * TILE + r]);
        for (int v = 0; v < NV; ++v) acc[p * TILE + r][v] = fma(wv, xv[v], acc[p * TILE + r][v]);
      }
  }
  for (int r = 0; r < R; ++r)
    if (r < rows)
      for (int v = 0; v < NV; ++v)
        store<T>(y + r * W + v * VW, finish(acc[r][v], at + r * W + v * VW));
}

// Two vectors of lanes have enough sums in one panel, but for long ones with the 32 registers of
// AVX-512; one vector takes half of the registers.
static constexpr int LONG_SUM = 128;
template <int NV>
static constexpr int panels_at_once() {
  return NV > 1 ? 1 : (VECTOR_BYTES == 64 ? 32 : 16) / 2 / TILE;
}

// The same for `LANES` lanes of a vector that is mostly empty: vectors run over the outputs of
// several panels, so that unused lanes cost nothing. They are set to 0. `X` is such a vector, or
// four floats for the last panels.
template <int LANES, int W, class X, class Finish>
static INLINE void few_store(const X (&acc)[LANES], int rows, T* y, int64_t at,
                             const Finish& finish) {
  for (int r = 0; r < int(sizeof(X) / sizeof(T)) && r < rows; ++r) {
    V lanes = splat(0);
    for (int lane = 0; lane < LANES; ++lane) lanes[lane] = acc[lane][r];
    store<T>(y + at + r * W, finish(lanes, at + r * W));
  }
}
template <class X>
static INLINE X load_wide(const T* p) {
  if constexpr (sizeof(X) / sizeof(T) == TILE)
    return load_four(p);
  else
    return load<T>(p);
}
template <int LANES, int N, class X, int W, bool ACCUMULATE, class Finish>
static INLINE void few_panels(const T* w, const T* bias, int rows, int in, const T* x, T* y,
                              int64_t at, const Finish& finish) {
  static_assert(TILE == 4, "a panel is four floats wide");
  constexpr int WIDE = sizeof(X) / sizeof(T);
  X acc[N][LANES];
  for (int n = 0; n < N; ++n)
    for (int lane = 0; lane < LANES; ++lane)
      for (int r = 0; r < WIDE; ++r) {
        const int o = n * WIDE + r;
        if (ACCUMULATE) acc[n][lane][r] = o < rows ? y[at + o * W + lane] : T(0);
      }
  if (!ACCUMULATE)
    for (int n = 0; n < N; ++n) {
      X start{};
      if (bias) start = load_wide<X>(bias + n * WIDE);
      for (int lane = 0; lane < LANES; ++lane) acc[n][lane] = start;
    }
  const int64_t panel = int64_t(TILE) * in;
  for (int k = 0; k < in; ++k)
    for (int n = 0; n < N; ++n) {
      const T* from = w + (n * WIDE / TILE) * panel + k * TILE;
      X wv;
      if constexpr (WIDE == TILE)
        wv = load_four(from);
      else
        wv = load_fours(from, panel);
      for (int lane = 0; lane < LANES; ++lane) {
        const T xv = x[int64_t(k) * W + lane];
        if constexpr (WIDE == TILE)
          acc[n][lane] = fma_four(wv, xv - F4{}, acc[n][lane]);
        else
          acc[n][lane] = fma(wv, splat(xv), acc[n][lane]);
      }
    }
  for (int n = 0; n < N; ++n)
    few_store<LANES, W>(acc[n], rows - n * WIDE, y, at + int64_t(n) * WIDE * W, finish);
}
template <int LANES, int W, bool ACCUMULATE, class Finish>
static NOINLINE void few(const T* w, const T* bias, int out, int in, const T* x, T* y, int64_t at,
                         const Finish& finish) {
  constexpr int N = (VECTOR_BYTES == 64 ? 12 : 8) / LANES;
  int o = 0;
  auto panels = [&](auto wide, auto n) {
    using X = decltype(wide);
    constexpr int MOST = n(), OUT = MOST * int(sizeof(X) / sizeof(T));
    few_panels<LANES, MOST, X, W, ACCUMULATE>(w + int64_t(o) * in, bias ? bias + o : nullptr,
                                              out - o < OUT ? out - o : OUT, in, x, y,
                                              at + int64_t(o) * W, finish);
    o += OUT;
  };
  const int padded = up(out, TILE);  // of the weights
  while (o + N * VW <= padded) panels(V{}, Count<N>{});
  while (o + 2 * VW <= padded) panels(V{}, Count<2>{});
  while (o + VW <= padded) panels(V{}, Count<1>{});
  while (o < out) panels(F4{}, Count<1>{});
}
template <int N>
struct Count {
  constexpr int operator()() const { return N; }
};

// How lanes are laid out: `Many` is a block of NV vectors of lanes, `One` the one lane of a stream.
template <int NV>
struct Many {
  static constexpr int W = NV * VW, N = NV;  // stride of a unit, vectors of a per-lane quantity
  static constexpr bool ONE = false;
  static int pad(int n) { return n; }
  template <bool ACCUMULATE>
  static NOINLINE void affine(const Matrix& m, const T* packed, int lanes, const T* x, T* y) {
    product<ACCUMULATE>(m.half, packed + m.panels, m.bias >= 0 ? packed + m.packed_bias : nullptr,
                        m.out, m.in, lanes, x, y, Plain{});
  }
  static NOINLINE void tanh_affine(const Matrix& m, const T* packed, int lanes, const T* x, T* y) {
    product<false>(m.half, packed + m.panels, m.bias >= 0 ? packed + m.packed_bias : nullptr,
                   m.out, m.in, lanes, x, y, Tanh{y});
  }
  // x[k] (+)= sum over o of w[o][k] y[o]
  template <bool ACCUMULATE>
  static NOINLINE void transposed(const Matrix& m, const T* packed, int lanes, const T* y, T* x) {
    product<ACCUMULATE>(m.half, packed + m.transposed, nullptr, m.backward_in, m.out, lanes, y, x,
                        Plain{});
  }
  // The same, times the derivative of tanh where the value of tanh is `value`.
  static NOINLINE void through_tanh(const Matrix& m, const T* packed, int lanes, const T* y,
                                    const T* value, T* x) {
    product<false>(m.half, packed + m.transposed, nullptr, m.backward_in, m.out, lanes, y, x,
                   TimesTanhSlope{value});
  }
  template <bool ACCUMULATE, class Finish>
  static INLINE void product(bool half, const T* w, const T* bias, int out, int in, int lanes,
                             const T* x, T* y, const Finish& finish) {
#if BF16
    if (half) return half_product<NV, ACCUMULATE>(w, bias, out, in, x, y, finish);
#else
    (void)half;
#endif
    if constexpr (sizeof(T) == 4) {  // the last vector may have few lanes
      constexpr int FULL = (NV - 1) * VW;
      const int n = lanes - FULL;
      auto rest = [&](auto count) {
        if constexpr (FULL > 0) whole<NV - 1, ACCUMULATE>(w, bias, out, in, x, y, finish);
        few<count(), W, ACCUMULATE>(w, bias, out, in, x + FULL, y, FULL, finish);
      };
      if (n == 1) return rest(Count<1>{});
      if (n == 2) return rest(Count<2>{});
      if (VW > 4 && n == 3) return rest(Count<3>{});
      if (VW > 4 && n == 4) return rest(Count<4>{});
    }
    whole<NV, ACCUMULATE>(w, bias, out, in, x, y, finish);
  }
  // The first `N` vectors of lanes.
  template <int N, bool ACCUMULATE, class Finish>
  static INLINE void whole(const T* w, const T* bias, int out, int in, const T* x, T* y,
                           const Finish& finish) {
    constexpr int P = panels_at_once<N>(), R = P * TILE;
    int o = 0;
    if (N > 1 && VECTOR_BYTES == 64 && in >= LONG_SUM)
      for (; o + 2 * TILE <= out; o += 2 * TILE)
        panels<2, N, W, ACCUMULATE>(w + int64_t(o) * in, bias ? bias + o : nullptr, 2 * TILE, in, x,
                                    y, int64_t(o) * W, finish);
    for (; P > 1 && o + R <= out; o += R)
      panels<P, N, W, ACCUMULATE>(w + int64_t(o) * in, bias ? bias + o : nullptr, R, in, x, y,
                                  int64_t(o) * W, finish);
    for (; o < out; o += TILE)
      panels<1, N, W, ACCUMULATE>(w + int64_t(o) * in, bias ? bias + o : nullptr,
                                  out - o < TILE ? out - o : TILE, in, x, y, int64_t(o) * W,
                                  finish);
  }
  template <class Fn>
  static INLINE void each(int units, Fn fn) {
    for (int u = 0; u < units; ++u)
      for (int v = 0; v < NV; ++v) fn(int64_t(u) * W + v * VW, v * VW);
  }
  // The same with a constant of each unit, as [unit].
  template <class Fn>
  static INLINE void each_unit(int units, Fn fn) {
    for (int u = 0; u < units; ++u)
      for (int v = 0; v < NV; ++v) fn(int64_t(u) * W + v * VW, v * VW, u);
  }
  static INLINE V constant(const T* p, int u) { return splat(p[u]); }
};

struct One {
  static constexpr int W = 1, N = 1;
  static constexpr bool ONE = true;
  static int pad(int n) { return up(n, VW); }
  template <bool ACCUMULATE>
  static NOINLINE void affine(const Matrix& m, const T* packed, int, const T* x, T* y) {
    const T* w = packed + m.stream_panels;
    const T* bias = m.bias >= 0 ? packed + m.stream_bias : nullptr;
    const int first = m.in_split, second = m.in - first;
    const T* x2 = x + pad(first);
    int o = 0;
    // Several panels at a time hide the latency of a sum.
    for (; o + 4 * VW <= m.padded_out; o += 4 * VW)
      panels<4, ACCUMULATE>(w + int64_t(o) * m.in, bias, o, first, second, m.in, x, x2, y);
    for (; o + 2 * VW <= m.padded_out; o += 2 * VW)
      panels<2, ACCUMULATE>(w + int64_t(o) * m.in, bias, o, first, second, m.in, x, x2, y);
    for (; o < m.padded_out; o += VW)
      panels<1, ACCUMULATE>(w + int64_t(o) * m.in, bias, o, first, second, m.in, x, x2, y);
  }
  template <int N, bool ACCUMULATE>
  static INLINE void panels(const T* w, const T* bias, int o, int first, int second, int in,
                            const T* x, const T* x2, T* y) {
    V acc[N];
    for (int n = 0; n < N; ++n)
      acc[n] = ACCUMULATE ? load<T>(y + o + n * VW) : bias ? load<T>(bias + o + n * VW) : splat(0);
    for (int k = 0; k < first; ++k) {
      const V xv = splat(x[k]);
      for (int n = 0; n < N; ++n) acc[n] = fma(load<T>(w + (int64_t(n) * in + k) * VW), xv, acc[n]);
    }
    for (int k = 0; k < second; ++k) {
      const V xv = splat(x2[k]);
      for (int n = 0; n < N; ++n)
        acc[n] = fma(load<T>(w + (int64_t(n) * in + first + k) * VW), xv, acc[n]);
    }
    for (int n = 0; n < N; ++n) store<T>(y + o + n * VW, acc[n]);
  }
  template <class Fn>
  static INLINE void each(int units, Fn fn) {
    for (int u = 0; u < units; u += VW) fn(int64_t(u), 0);
  }
  template <class Fn>
  static INLINE void each_unit(int units, Fn fn) {
    for (int u = 0; u < units; u += VW) fn(int64_t(u), 0, u);
  }
  static INLINE V constant(const T* p, int u) { return load<T>(p + u); }
};

template <class P>
static NOINLINE void activate(int activation, int units, const T* z, T* value, T* slope) {
  if (activation == TANH) {
    P::each(units, [&](int64_t i, int) { store<T>(value + i, tanh_(load<T>(z + i))); });
    return;
  }
  P::each(units, [&](int64_t i, int) {
    const V x = load<T>(z + i), s = sigmoid_(x);
    store<T>(slope + i, fma(x * s, 1 - s, s));
    store<T>(value + i, x * s);
  });
}
// to_z = to_value * slope
template <class P>
static NOINLINE void activate_backward(int units, const T* slope, const T* to_value, T* to_z) {
  P::each(units,
          [&](int64_t i, int) { store<T>(to_z + i, load<T>(to_value + i) * load<T>(slope + i)); });
}
