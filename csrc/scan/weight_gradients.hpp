// Gradients of weights: sums of outer products, and their reduction over slots. Part of Scan<T>
// (scan.hpp).

// Products that are not added yet: to_out (out, lane) times x (in, lane), summed over lanes.
static constexpr int MAX_PAIRS = 128, PAIRS_AT_ONCE = 8;
struct Pairs {
  int count[M_END] = {};
  const T* to_out[M_END][MAX_PAIRS];
  const T* x[M_END][MAX_PAIRS];
};

template <int R, int NV>
static INLINE void outer_tile(int pairs, int W, int lanes, const T* const* to_out, int o,
                              const T* xt, int64_t in, int i, T* sum) {
  V acc[R][NV];
  for (int r = 0; r < R; ++r)
    for (int v = 0; v < NV; ++v) acc[r][v] = load<T>(sum + (o + r) * in + i + v * VW);
  for (int e = 0; e < pairs; ++e) {
    const T* g = to_out[e] + int64_t(o) * W;
    for (int lane = 0; lane < lanes; ++lane) {
      V xv[NV];
      for (int v = 0; v < NV; ++v) xv[v] = load<T>(xt + i + v * VW);
      xt += in;
      for (int r = 0; r < R; ++r) {
        const V gv = splat(g[r * W + lane]);
        for (int v = 0; v < NV; ++v) acc[r][v] = fma(gv, xv[v], acc[r][v]);
      }
    }
  }
  for (int r = 0; r < R; ++r)
    for (int v = 0; v < NV; ++v) store<T>(sum + (o + r) * in + i + v * VW, acc[r][v]);
}

// All outputs against one strip of NV vectors of inputs; R * NV sums at a time hide their latency.
template <int R, int NV>
static NOINLINE void outer_strip(int pairs, int W, int lanes, const T* const* to_out, int out,
                                 const T* xt, int in, int i, T* sum) {
  int o = 0;
  for (; o + R <= out; o += R) outer_tile<R, NV>(pairs, W, lanes, to_out, o, xt, in, i, sum);
  for (; o < out; ++o) outer_tile<1, NV>(pairs, W, lanes, to_out, o, xt, in, i, sum);
}

// [unit][lane] to [lane][unit] of the lanes in use; units are padded with zeros.
static void transpose(const T* x, int units, int padded, int W, int lanes, T* xt) {
  T* to[2 * VW];
  for (int lane = 0; lane < lanes; ++lane) {
    to[lane] = xt + int64_t(lane) * padded;
    for (int u = units; u < padded; ++u) to[lane][u] = 0;
  }
  units_to_lanes(x, units, lanes, W, to);
}

// Numbers of scratch memory, `xt`, that `add_pairs` needs.
static int64_t outer_scratch(const Matrix& m, int W) {
  const int64_t some = PAIRS_AT_ONCE;
  return m.half ? some * 16 * (up(m.out, 16) + up(m.in, 16)) : some * W * up(m.in, VW);
}
static int64_t outer_scratch(const Map& map, int W) {
  int64_t n = 0;
  for (int i = 0; i < M_END; ++i)
    if (map.used[i] && outer_scratch(map.m[i], W) > n) n = outer_scratch(map.m[i], W);
  return n;
}

static NOINLINE void add_pairs(const Matrix& m, int pairs, int W, int lanes, const T* const* to_out,
                               const T* const* x, T* sums, T* xt) {
  const int in = up(m.in, VW);
  T* sum = sums + m.sum;
  for (int first = 0; first < pairs; first += PAIRS_AT_ONCE) {
    const int n = pairs - first < PAIRS_AT_ONCE ? pairs - first : PAIRS_AT_ONCE;
#if BF16
    if (m.half) {
      add_half_pairs(m, n, W, lanes, to_out + first, x + first, sum, xt);
      continue;
    }
#endif
    for (int e = 0; e < n; ++e)
      transpose(x[first + e], m.in, in, W, lanes, xt + int64_t(e) * lanes * in);
    for (int i = 0; i < in;) {  // strips of three or four vectors, then of two or one
      const int left = (in - i) / VW;
      if (VECTOR_BYTES == 64 && left == 4) {  // AVX-512 has registers for sixteen sums
        outer_strip<4, 4>(n, W, lanes, to_out + first, m.out, xt, in, i, sum);
        i += 4 * VW;
      } else if (left == 3 || left > 4) {
        outer_strip<4, 3>(n, W, lanes, to_out + first, m.out, xt, in, i, sum);
        i += 3 * VW;
      } else if (left >= 2) {
        outer_strip<4, 2>(n, W, lanes, to_out + first, m.out, xt, in, i, sum);
        i += 2 * VW;
      } else {
        outer_strip<8, 1>(n, W, lanes, to_out + first, m.out, xt, in, i, sum);
        i += VW;
      }
    }
  }
  if (m.bias < 0) return;
  for (int o = 0; o < m.out; ++o) {
    T* to = sums + m.bias_sum + int64_t(o) * VW;
    V acc = load<T>(to);
    for (int e = 0; e < pairs; ++e)
      for (int v = 0; v < W; v += VW) acc += load<T>(to_out[e] + int64_t(o) * W + v);
    store<T>(to, acc);
  }
}

static void flush(const Map& map, Pairs& pairs, int W, int lanes, T* sums, T* xt) {
  for (int i = 0; i < M_END; ++i) {
    if (!pairs.count[i]) continue;
    add_pairs(map.m[i], pairs.count[i], W, lanes, pairs.to_out[i], pairs.x[i], sums, xt);
    pairs.count[i] = 0;
  }
}

static void reduce_matrix(const Matrix& m, const T* sums, T* flat) {
  const int in = up(m.in, VW);
  for (int o = 0; o < m.out; ++o)
    for (int k = 0; k < m.in; ++k) {
      int64_t at = int64_t(o) * in + k;
#if BF16
      if (m.half) at = sum_place(o, k, in);
#endif
      flat[m.weight + int64_t(o) * m.in + k] += sums[m.sum + at];
    }
  if (m.bias >= 0) reduce_lanes(sums + m.bias_sum, m.out, flat + m.bias);
}
static void reduce_lanes(const T* sums, int units, T* flat) {
  for (int u = 0; u < units; ++u) {
    T total = 0;
    for (int i = 0; i < VW; ++i) total += sums[int64_t(u) * VW + i];
    flat[u] += total;
  }
}

// The slots are added in their order, whichever thread filled them.
static void reduce(const Spec& s, const T* sums, int n, T* flat) {
  const Map p = map(s);
  zero(flat, p.flat);
  for (int slot = 0; slot < n; ++slot, sums += p.sums) {
    for (int i = 0; i < M_END; ++i)
      if (p.used[i]) reduce_matrix(p.m[i], sums, flat);
    if (s.trend) reduce_lanes(sums + p.trend_sum, 3 * p.d.A, flat + p.trend_weight);
    if (!s.input_decay) continue;
    reduce_lanes(sums + p.input_decay_weight_sum, p.d.C, flat + p.input_decay_weight);
    reduce_lanes(sums + p.input_decay_bias_sum, p.d.C, flat + p.input_decay_bias);
  }
}
