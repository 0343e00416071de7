// One body of the scan: the loop over rows, forward and backward, for one instruction set.
//
//     decay -> flow over the gap -> (predictions are read here) -> cell at an observation
//
// Included by body_*.cpp inside an anonymous namespace. Activations lie as [unit][lane]; weights are
// packed in panels of TILE outputs, [panel][input][output in panel], and broadcast. A block of lanes
// runs through all rows by itself, so its state and the weights stay in cache.
//
// Each lane's sums run over the inputs in order, in a batch ([unit][lane], vectors over lanes) as in
// a stream ([unit], vectors over outputs): the same bits.

template <class T>
struct Scan {
  using V = typename Lanes<T>::V;
  static constexpr int VW = Lanes<T>::W;
  static constexpr T LARGEST_EXPONENT = 30;

  static V splat(T s) { return broadcast<T>(s); }

  // --- sizes --------------------------------------------------------------------------------------

  struct Dims {
    int C, H, A, F, ages, I, G, S, D, P;  // channels, hidden, anchored, decay features, ages, cell
                                          // inputs, gates, state, driven, width of the shown part
    bool cell, lstm;
  };
  static Dims dims(const Spec& s) {
    Dims d{};
    d.C = s.channels, d.H = s.hidden, d.A = s.anchored, d.F = s.decay_features, d.ages = s.ages;
    d.cell = s.cell != CELL_NONE;
    d.lstm = s.cell == CELL_LSTM;
    d.I = d.cell ? 2 * d.C + d.ages : 0;
    d.G = !d.cell ? 0 : d.H * (s.cell == CELL_GRU ? 3 : d.lstm ? 4 : 1);
    d.S = d.A + d.H + (d.lstm ? d.H : 0);
    d.D = d.A + d.H;
    return d;
  }
  static int up(int n, int m) { return (n + m - 1) / m * m; }

  // The matrices, in the order of the flat buffer (offbeat.kernels.fused.pack).
  enum { M_IN, M_REC, M_CAND, M_INNOV, M_DECAY, M_FIELD, M_DECODER = M_FIELD + MAX_LAYERS,
         M_END = M_DECODER + MAX_LAYERS };

  struct Matrix {
    int out = 0, in = 0;
    int64_t weight = -1, bias = -1;   // in the flat buffer; -1: there is none
    bool backward = false;
    int backward_in = 0;              // leading inputs that a gradient reaches
    int64_t panels = 0, transposed = 0, packed_bias = 0;  // in the packed buffer of batches
    int64_t sum = 0, bias_sum = 0;    // in the sums of a slot
    int split[4] = {};                // output rows begin anew at these (streams pad each segment)
    int splits = 1;
    int in_split = 0;                 // first part of the inputs (streams pad it)
    int64_t stream_panels = 0, stream_bias = 0;
    int padded_out = 0;
  };

  struct Map {
    Dims d;
    Matrix m[M_END];
    bool used[M_END] = {};
    int64_t recurrent_bias = -1, input_decay_weight = -1, input_decay_bias = -1, flat = 0;
    int64_t packed = 0, sums = 0, recurrent_bias_sum = 0, input_decay_weight_sum = 0,
            input_decay_bias_sum = 0, stream = 0;
    int64_t packed_vectors = 0;
  };

  static constexpr int TILE = 4;

  static void segments(Matrix& m, int n, int each) {
    m.splits = n;
    for (int i = 0; i < n; ++i) m.split[i] = each;
  }

  static NOINLINE Map map(const Spec& s) {
    Map p{};
    p.d = dims(s);
    const Dims& d = p.d;
    int64_t at = 0;
    auto add = [&](int id, int out, int in, bool backward, int backward_in) -> Matrix& {
      Matrix& m = p.m[id];
      p.used[id] = true;
      m.out = out, m.in = in, m.weight = at, m.backward = backward, m.backward_in = backward_in;
      m.in_split = in;
      m.split[0] = out;
      at += int64_t(out) * in;
      return m;
    };
    const bool shown_backward = s.input_decay || s.decoder.layers;
    if (d.cell) {
      Matrix& in = add(M_IN, d.G, d.I, shown_backward, d.C);
      segments(in, d.G / d.H, d.H);
      in.bias = at, at += d.G;
      if (s.cell == CELL_GRU) {
        segments(add(M_REC, 2 * d.H, d.H, true, d.H), 2, d.H);
        add(M_CAND, d.H, d.H, true, d.H);
      } else if (s.cell != CELL_SET) {
        segments(add(M_REC, d.G, d.H, true, d.H), d.G / d.H, d.H);
      }
      if (s.reset_after) {
        p.recurrent_bias = at;
        p.m[M_CAND].bias = at;
        at += d.H;
      }
      if (d.A) segments(add(M_INNOV, d.G, d.A, true, d.A), d.G / d.H, d.H);
    }
    if (d.F) {
      Matrix& m = add(M_DECAY, d.H, d.F, false, 0);
      m.bias = at, at += d.H;
    }
    if (s.input_decay) {
      p.input_decay_weight = at, at += d.C;
      p.input_decay_bias = at, at += d.C;
    }
    for (int k = 0; k < 2; ++k) {
      const Perceptron& net = k ? s.decoder : s.field;
      for (int l = 0; l < net.layers; ++l) {
        Matrix& m = add((k ? M_DECODER : M_FIELD) + l, net.sizes[l + 1], net.sizes[l], true,
                        net.sizes[l]);
        m.bias = at, at += m.out;
        if (!k && d.A && l == 0) m.in_split = d.A;
        if (!k && d.A && l == net.layers - 1) m.splits = 2, m.split[0] = d.A, m.split[1] = d.H;
      }
    }
    p.flat = at;
    int64_t packed = 0, sums = 0, stream = 0;
    for (int i = 0; i < M_END; ++i) {
      if (!p.used[i]) continue;
      Matrix& m = p.m[i];
      m.panels = packed, packed += int64_t(up(m.out, TILE)) * m.in;
      if (m.backward) m.transposed = packed, packed += int64_t(up(m.backward_in, TILE)) * m.out;
      if (m.bias >= 0) m.packed_bias = packed, packed += up(m.out, TILE);
      m.sum = sums, sums += int64_t(m.out) * up(m.in, VW);
      if (m.bias >= 0) m.bias_sum = sums, sums += int64_t(m.out) * VW;
      m.padded_out = 0;
      for (int k = 0; k < m.splits; ++k) m.padded_out += up(m.split[k], VW);
      m.stream_panels = stream, stream += int64_t(m.padded_out) * m.in;
      if (m.bias >= 0) m.stream_bias = stream, stream += m.padded_out;
    }
    if (s.input_decay) {
      p.packed_vectors = packed;
      packed += 2 * up(d.C, VW);
      p.input_decay_weight_sum = sums, sums += int64_t(d.C) * VW;
      p.input_decay_bias_sum = sums, sums += int64_t(d.C) * VW;
    }
    p.packed = packed, p.sums = sums;
    p.stream = stream + (s.input_decay ? 2 * up(d.C, VW) : 0);
    return p;
  }

  static int64_t packed_size(const Spec& s) { return map(s).packed; }
  static int64_t sums_size(const Spec& s) { return map(s).sums; }
  static int64_t stream_packed_size(const Spec& s) { return map(s).stream; }

  static void pack_matrix(const Matrix& m, const T* flat, T* packed) {
    const T* w = flat + m.weight;
    T* p = packed + m.panels;
    for (int o = 0; o < m.out; o += TILE)
      for (int k = 0; k < m.in; ++k)
        for (int r = 0; r < TILE; ++r) *p++ = o + r < m.out ? w[int64_t(o + r) * m.in + k] : T(0);
    if (m.backward) {
      p = packed + m.transposed;
      for (int i = 0; i < m.backward_in; i += TILE)
        for (int o = 0; o < m.out; ++o)
          for (int r = 0; r < TILE; ++r)
            *p++ = i + r < m.backward_in ? w[int64_t(o) * m.in + i + r] : T(0);
    }
    if (m.bias >= 0) {
      p = packed + m.packed_bias;
      for (int o = 0; o < up(m.out, TILE); ++o) p[o] = o < m.out ? flat[m.bias + o] : T(0);
    }
  }
  static void pack(const Spec& s, const T* flat, T* packed) {
    const Map p = map(s);
    for (int i = 0; i < M_END; ++i)
      if (p.used[i]) pack_matrix(p.m[i], flat, packed);
    if (s.input_decay) pack_input_decay(p, flat, packed + p.packed_vectors);
  }
  static void pack_input_decay(const Map& p, const T* flat, T* out) {
    const int n = up(p.d.C, VW);
    for (int c = 0; c < n; ++c) {
      out[c] = c < p.d.C ? flat[p.input_decay_weight + c] : T(0);
      out[n + c] = c < p.d.C ? flat[p.input_decay_bias + c] : T(0);
    }
  }
  // Streams: [panel of VW outputs][input][output], each segment of outputs padded to whole vectors.
  static void stream_pack_matrix(const Matrix& m, const T* flat, T* packed) {
    const T* w = flat + m.weight;
    T* p = packed + m.stream_panels;
    T* bias = packed + m.stream_bias;
    int row = 0;
    for (int k = 0; k < m.splits; ++k) {
      for (int o = 0; o < m.split[k]; o += VW) {
        for (int i = 0; i < m.in; ++i)
          for (int r = 0; r < VW; ++r)
            *p++ = o + r < m.split[k] ? w[int64_t(row + o + r) * m.in + i] : T(0);
        if (m.bias >= 0)
          for (int r = 0; r < VW; ++r)
            *bias++ = o + r < m.split[k] ? flat[m.bias + row + o + r] : T(0);
      }
      row += m.split[k];
    }
  }
  static void stream_pack(const Spec& s, const T* flat, T* packed) {
    const Map p = map(s);
    for (int i = 0; i < M_END; ++i)
      if (p.used[i]) stream_pack_matrix(p.m[i], flat, packed);
    if (s.input_decay) pack_input_decay(p, flat, packed + p.stream - 2 * up(p.d.C, VW));
  }

  // --- between [lane][unit], as callers have it, and [unit][lane] ---------------------------------

  // out[unit * W + lane] = lanes[lane][unit]
  static NOINLINE void lanes_to_units(const T* const* lanes, int units, int W, T* out) {
    int first = 0;
    if constexpr (FAST_TURN && sizeof(T) == 4)
      if (units >= 8 && W % 8 == 0)
        for (; first < units; first += 8) {
          const int u = first + 8 <= units ? first : units - 8;  // the last eight may overlap
          for (int lane = 0; lane < W; lane += 8)
            turn_8_by_8([&](int i) { return lanes[lane + i] + u; },
                        [&](int i) { return out + int64_t(u + i) * W + lane; });
        }
    for (int lane = 0; lane < W; ++lane)
      for (int u = first; u < units; ++u) out[int64_t(u) * W + lane] = lanes[lane][u];
  }
  // lanes[lane][unit] = x[unit * W + lane], for the first `n` lanes
  static NOINLINE void units_to_lanes(const T* x, int units, int n, int W, T* const* lanes) {
    for (int lane = 0; lane < n; ++lane) {
      int first = 0;
      if constexpr (FAST_TURN && sizeof(T) == 4)
        if (units >= 8 && lane + 8 <= n) {
          for (; first < units; first += 8) {
            const int u = first + 8 <= units ? first : units - 8;
            turn_8_by_8([&](int i) { return x + int64_t(u + i) * W + lane; },
                        [&](int i) { return lanes[lane + i] + u; });
          }
          lane += 7;
          continue;
        }
      for (int u = first; u < units; ++u) lanes[lane][u] = x[int64_t(u) * W + lane];
    }
  }

  // --- affine maps ----------------------------------------------------------------------------------

  // What becomes of a product before it is stored, at an offset of its result.
  struct Plain {
    INLINE V operator()(V a, int64_t) const { return a; }
  };
  struct TimesTanhSlope {  // that follows from the value of tanh
    const T* value;
    INLINE V operator()(V a, int64_t i) const {
      const V y = load<T>(value + i);
      return a * fma(-y, y, splat(1));
    }
  };

  // y[o] = (accumulate ? y[o] : bias[o]) + sum over k of w[o][k] x[k], k in order.
  template <int NV, bool ACCUMULATE, class Finish>
  static INLINE void panel(const T* w, const T* bias, int rows, int in, const T* x, T* y,
                           int64_t at, const Finish& finish) {
    y += at;
    constexpr int W = NV * VW;
    V acc[TILE][NV];
    for (int r = 0; r < TILE; ++r)
      for (int v = 0; v < NV; ++v) {
        if (ACCUMULATE)
          acc[r][v] = r < rows ? load<T>(y + r * W + v * VW) : splat(0);
        else
          acc[r][v] = splat(bias ? bias[r] : T(0));
      }
    for (int k = 0; k < in; ++k) {
      V xv[NV];
      for (int v = 0; v < NV; ++v) xv[v] = load<T>(x + int64_t(k) * W + v * VW);
      for (int r = 0; r < TILE; ++r) {
        const V wv = splat(w[k * TILE + r]);
        for (int v = 0; v < NV; ++v) acc[r][v] = fma(wv, xv[v], acc[r][v]);
      }
    }
    for (int r = 0; r < TILE; ++r)
      if (r < rows)
        for (int v = 0; v < NV; ++v)
          store<T>(y + r * W + v * VW, finish(acc[r][v], at + r * W + v * VW));
  }

  // The same for `LANES` lanes of a vector that is mostly empty: vectors over the outputs of N panels,
  // so that lanes which are not there cost nothing. They are set to 0.
  template <int LANES, int N, bool ACCUMULATE, class Finish>
  static INLINE void few_panels(const T* w, const T* bias, int rows, int in, const T* x, T* y,
                                int64_t at, const Finish& finish) {
    y += at;
    static_assert(TILE == 4, "a panel is four floats wide");
    F4 acc[N][LANES];
    for (int n = 0; n < N; ++n)
      for (int lane = 0; lane < LANES; ++lane)
        for (int r = 0; r < TILE; ++r) {
          const int o = n * TILE + r;
          acc[n][lane][r] = ACCUMULATE ? (o < rows ? y[o * VW + lane] : T(0))
                                       : (bias ? bias[o] : T(0));
        }
    for (int k = 0; k < in; ++k)
      for (int n = 0; n < N; ++n) {
        const F4 wv = load_four(w + (int64_t(n) * in + k) * TILE);
        for (int lane = 0; lane < LANES; ++lane)
          acc[n][lane] = fma_four(wv, x[int64_t(k) * VW + lane] - F4{}, acc[n][lane]);
      }
    for (int o = 0; o < N * TILE && o < rows; ++o) {
      store<T>(y + o * VW, splat(0));
      for (int lane = 0; lane < LANES; ++lane) y[o * VW + lane] = acc[o / TILE][lane][o % TILE];
      store<T>(y + o * VW, finish(load<T>(y + o * VW), at + o * VW));
    }
  }
  template <int LANES, int N, bool ACCUMULATE, class Finish>
  static NOINLINE void few(const T* w, const T* bias, int out, int in, const T* x, T* y,
                           const Finish& finish) {
    int o = 0;
    for (; o + N * TILE <= out; o += N * TILE)
      few_panels<LANES, N, ACCUMULATE>(w + int64_t(o) * in, bias ? bias + o : nullptr, N * TILE, in,
                                       x, y, int64_t(o) * VW, finish);
    for (; o < out; o += TILE)
      few_panels<LANES, 1, ACCUMULATE>(w + int64_t(o) * in, bias ? bias + o : nullptr, out - o, in,
                                       x, y, int64_t(o) * VW, finish);
  }

  // A policy of lanes: a block of NV vectors of lanes, or the one lane of a stream.
  template <int NV>
  struct Many {
    static constexpr int W = NV * VW, N = NV;  // distance of units, vectors of a per-lane quantity
    static constexpr bool ONE = false;
    static int pad(int n) { return n; }
    template <bool ACCUMULATE>
    static NOINLINE void affine(const Matrix& m, const T* packed, int lanes, const T* x, T* y) {
      product<ACCUMULATE>(packed + m.panels, m.bias >= 0 ? packed + m.packed_bias : nullptr, m.out,
                          m.in, lanes, x, y, Plain{});
    }
    // x[k] (+)= sum over o of w[o][k] y[o]
    template <bool ACCUMULATE>
    static NOINLINE void transposed(const Matrix& m, const T* packed, int lanes, const T* y, T* x) {
      product<ACCUMULATE>(packed + m.transposed, nullptr, m.backward_in, m.out, lanes, y, x,
                          Plain{});
    }
    // The same, times the slope of tanh where its value is `value`.
    static NOINLINE void through_tanh(const Matrix& m, const T* packed, int lanes, const T* y,
                                      const T* value, T* x) {
      product<false>(packed + m.transposed, nullptr, m.backward_in, m.out, lanes, y, x,
                     TimesTanhSlope{value});
    }
    template <bool ACCUMULATE, class Finish>
    static INLINE void product(const T* w, const T* bias, int out, int in, int lanes, const T* x,
                               T* y, const Finish& finish) {
      if constexpr (NV == 1 && sizeof(T) == 4) {
        if (lanes == 1) return few<1, 8, ACCUMULATE>(w, bias, out, in, x, y, finish);
        if (lanes == 2) return few<2, 4, ACCUMULATE>(w, bias, out, in, x, y, finish);
        if (VW > 4 && lanes == 3) return few<3, 3, ACCUMULATE>(w, bias, out, in, x, y, finish);
        if (VW > 4 && lanes == 4) return few<4, 3, ACCUMULATE>(w, bias, out, in, x, y, finish);
      }
      for (int o = 0; o < out; o += TILE)
        panel<NV, ACCUMULATE>(w + int64_t(o) * in, bias ? bias + o : nullptr,
                              out - o < TILE ? out - o : TILE, in, x, y, int64_t(o) * W, finish);
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
      // Several panels side by side hide the latency of a sum.
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
        acc[n] = ACCUMULATE ? load<T>(y + o + n * VW)
                            : bias ? load<T>(bias + o + n * VW) : splat(0);
      for (int k = 0; k < first; ++k) {
        const V xv = splat(x[k]);
        for (int n = 0; n < N; ++n)
          acc[n] = fma(load<T>(w + (int64_t(n) * in + k) * VW), xv, acc[n]);
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
    P::each(units, [&](int64_t i, int) {
      store<T>(to_z + i, load<T>(to_value + i) * load<T>(slope + i));
    });
  }

  // --- what is kept of a row ------------------------------------------------------------------------

  // Offsets in units, each to be multiplied by the policy's W. `Net` is one evaluation.
  struct Net {
    int value[MAX_LAYERS], slope[MAX_LAYERS], size;
  };
  template <class P>
  static Net net(const Perceptron& shape) {
    Net n{};
    for (int l = 0; l + 1 < shape.layers; ++l) {
      n.value[l] = n.size, n.size += P::pad(shape.sizes[l + 1]);
      n.slope[l] = n.size;
      if (shape.activation == SILU) n.size += P::pad(shape.sizes[l + 1]);
    }
    return n;
  }
  template <class P>
  struct Layout {
    int u, start, end, before, gate, held, innovation, decoded, hidden, carried;
    int decoder, step, step_size, applied, factor, arrived, stage, stage_size, y, network, size;
    Net field_net, decoder_net;
    int x_at, h_at, c_at, state;  // inside a state
  };
  template <class P>
  static Layout<P> layout(const Spec& s, const Dims& d, int max_steps) {
    Layout<P> l{};
    int at = 0;
    auto take = [&](int n) {
      const int here = at;
      at += P::pad(n);
      return here;
    };
    l.h_at = P::pad(d.A);
    l.c_at = l.h_at + P::pad(d.H);
    l.state = l.c_at + (d.lstm ? P::pad(d.H) : 0);
    l.u = at, at += P::pad(d.I) + (P::ONE ? VW : 0);
    l.carried = take(s.decoder.layers || d.lstm ? d.H : 0);
    l.start = take(d.F ? d.H : 0);
    l.end = take(d.F ? d.H : 0);
    l.before = at, at += l.state;
    l.gate = at, at += d.cell ? d.G / d.H * P::pad(d.H) : 0;
    l.held = take(d.H);
    l.hidden = take(d.H);
    l.innovation = take(d.A);
    l.decoded = take(s.decoder.layers ? d.C : 0);
    l.decoder_net = net<P>(s.decoder);
    l.decoder = at, at += l.decoder_net.size;
    l.field_net = net<P>(s.field);
    l.step = at;
    int step = 0;
    if (d.F) {
      l.applied = step, step += P::pad(d.H);
      l.factor = step, step += P::pad(d.H);
      l.arrived = step, step += P::pad(d.H);
    }
    l.stage = step;
    l.y = 0;
    l.network = P::pad(d.A) + P::pad(d.H);
    l.stage_size = s.field.layers ? l.network + l.field_net.size : 0;
    step += l.stage_size * s.stages;
    l.step_size = step;
    l.size = at + step * max_steps;
    return l;
  }
  // Every policy of blocks has the same layout in units.
  static int64_t tape_row(const Spec& s, int max_steps, int vectors) {
    return int64_t(layout<Many<1>>(s, dims(s), max_steps).size) * VW * vectors;
  }

  // The facts of one row for the lanes of a block; a lane that has ended stands still.
  template <class P>
  struct Facts {
    T *gap, *update, *updated, *alive, *values, *mask, *age, *start, *end, *delta, *last;
    const T* mean;
    T* nothing;  // zeros for a lane that has ended
    bool active = false, fed = false;
  };
  static constexpr int LANE_FACTS = 4;
  static int facts_size(const Dims& d, int lanes) {
    return LANE_FACTS * (lanes < VW ? VW : lanes) + (4 * d.C + d.ages + 2 * d.F) * lanes +
           widest_fact(d);
  }
  static int widest_fact(const Dims& d) {
    return up(d.C > d.ages ? (d.C > d.F ? d.C : d.F) : (d.ages > d.F ? d.ages : d.F), 16);
  }
  template <class P>
  static Facts<P> facts(const Dims& d, T* at) {
    Facts<P> f{};
    for (T** p : {&f.gap, &f.update, &f.updated, &f.alive}) *p = at, at += P::W;
    f.values = at, at += d.C * P::W;
    f.mask = at, at += d.C * P::W;
    f.age = at, at += d.ages * P::W;
    f.start = at, at += d.F * P::W;
    f.end = at, at += d.F * P::W;
    f.delta = at, at += d.C * P::W;
    f.last = at, at += d.C * P::W;
    f.nothing = at;
    zero(f.nothing, widest_fact(d));
    return f;
  }
  // Rows of many trajectories lie far apart: what is needed `ahead` rows on is asked for now.
  template <class P>
  static NOINLINE void gather(const Job<T>& job, const Dims& d, const Block& b, int row,
                              Facts<P>& f, int ahead) {
    const bool more = row + ahead >= 0 && row + ahead < b.rows;
    f.fed = job.rows.fed && job.rows.fed[row];
    f.active = false;
    for (int lane = 0; lane < P::W; ++lane) {
      const int64_t at = lane < b.lanes ? job.source[b.first + lane] : 0;
      const bool alive = lane < b.lanes && row < job.length[b.first + lane];
      f.alive[lane] = alive;
      auto one = [&](const Fact<T>& fact) {
        return alive && fact.data ? fact.data[at * fact.by_lane + row * fact.by_row] : T(0);
      };
      if (more && lane < b.lanes)
        __builtin_prefetch(job.rows.gap.data + at * job.rows.gap.by_lane +
                           (row + ahead) * job.rows.gap.by_row);
      f.gap[lane] = one(job.rows.gap);
      f.update[lane] = one(job.rows.update);
      f.updated[lane] = one(job.rows.updated);
      f.active |= d.cell && f.update[lane] != 0;
    }
    auto many = [&](const Fact<T>& fact, int n, T* out) {
      if (!fact.data || !n) return;
      const T* lanes[P::W];
      for (int lane = 0; lane < P::W; ++lane)
        lanes[lane] = f.alive[lane] != 0 ? fact.data + int64_t(job.source[b.first + lane]) * fact.by_lane +
                                               row * fact.by_row
                                         : f.nothing;
      if (more)
        for (int lane = 0; lane < b.lanes; ++lane) {
          const T* next = fact.data + int64_t(job.source[b.first + lane]) * fact.by_lane +
                          (row + ahead) * fact.by_row;
          for (int u = 0; u < n; u += 64 / int(sizeof(T))) __builtin_prefetch(next + u);
          __builtin_prefetch(next + n - 1);
        }
      lanes_to_units(lanes, n, P::W, out);
    };
    many(job.rows.values, d.C, f.values);
    many(job.rows.mask, d.C, f.mask);
    many(job.rows.age, d.ages, f.age);
    many(job.rows.decay_start, d.F, f.start);
    many(job.rows.decay_end, d.F, f.end);
    many(job.rows.delta, d.C, f.delta);
    many(job.rows.last, d.C, f.last);
    f.mean = job.rows.mean;
  }

  static INLINE V clip(V a) {
    a = a < T(0) ? splat(0) : a;
    return a > LARGEST_EXPONENT ? splat(LARGEST_EXPONENT) : a;
  }
  static INLINE V inside(V a) {  // derivative of clip
    return a >= T(0) ? (a <= LARGEST_EXPONENT ? splat(1) : splat(0)) : splat(0);
  }

  template <class P>
  struct Context {
    const Spec& s;
    const Map& map;
    const T* packed;
    const T* input_decay;  // weights, then biases
    Layout<P> l;
    T* work;               // slopes of the stages, and other scratch
    int lanes = P::W;      // that there are; the others are padding
  };

  // --- forward --------------------------------------------------------------------------------------

  template <class P>
  static NOINLINE void evaluate(const Context<P>& c, const Perceptron& shape, int first, const Net& n,
                       const T* x, T* kept, T* out, T* z) {
    for (int l = 0; l < shape.layers; ++l) {
      const Matrix& m = c.map.m[first + l];
      const bool last = l == shape.layers - 1;
      P::template affine<false>(m, c.packed, c.lanes, x, last ? out : z);
      if (last) break;
      T* value = kept + int64_t(n.value[l]) * P::W;
      activate<P>(shape.activation, shape.sizes[l + 1], z, value,
                  kept + int64_t(n.slope[l]) * P::W);
      x = value;
    }
  }

  template <class P>
  static int steps_of(const Spec& s, const T* gap, T* steps) {
    int most = s.steps;
    constexpr int n = P::ONE ? VW : P::W;
    for (int i = 0; i < n; ++i) {
      steps[i] = T(s.steps);
      if (s.max_step > 0) {
        const T wanted = ::ceil(gap[i] / T(s.max_step) - T(1e-6));
        if (wanted > steps[i]) steps[i] = wanted;
        if (steps[i] > most) most = int(steps[i]);
      }
    }
    return most;
  }

  template <class P>
  static NOINLINE void row_forward(const Context<P>& c, const Facts<P>& f, T* state, T* tape) {
    const Spec& s = c.s;
    const Dims& d = c.map.d;
    const Layout<P>& l = c.l;
    constexpr int W = P::W;
    auto at = [&](int units) { return tape + int64_t(units) * W; };
    T* h = state + int64_t(l.h_at) * W;
    T* memory = state + int64_t(l.c_at) * W;
    T* z = c.work;  // the widest layer fits

    // The cell's input, from the state before the gap where it is fed back.
    T* u = at(l.u);
    T* gate = at(l.gate);
    if (f.active) {
      if (f.fed) {
        copy<P>(d.H, h, at(l.carried));
        evaluate<P>(c, s.decoder, M_DECODER, l.decoder_net, h, at(l.decoder), at(l.decoded), z);
        copy<P>(d.C, at(l.decoded), u);
      } else if (s.input_decay) {
        const T* weight = c.input_decay;
        const T* bias = weight + up(d.C, VW);
        P::each_unit(d.C, [&](int64_t i, int, int k) {
          const V mask = load<T>(f.mask + i);
          V a = fma(P::constant(weight, k), load<T>(f.delta + i), P::constant(bias, k));
          a = a < T(0) ? splat(0) : a;
          const V gamma = exp_(-a), mean = P::constant(f.mean, k);
          const V faded = fma(gamma, load<T>(f.last + i), (1 - gamma) * mean);
          store<T>(u + i, mask != T(0) ? load<T>(f.values + i) : faded);
        });
      } else {
        copy<P>(d.C, f.values, u);
      }
      copy<P>(d.C, f.mask, u + int64_t(d.C) * W);
      copy<P>(d.ages, f.age, u + int64_t(2 * d.C) * W);
      P::template affine<false>(c.map.m[M_IN], c.packed, c.lanes, u, gate);
    }

    // Decay and flow.
    T* start = at(l.start);
    T* end = at(l.end);
    const bool one_shot = !s.field.layers || (s.steps == 1 && s.max_step == 0);
    if (d.F) {
      P::template affine<false>(c.map.m[M_DECAY], c.packed, c.lanes, f.start, start);
      P::template affine<false>(c.map.m[M_DECAY], c.packed, c.lanes, f.end, end);
      P::each(d.H, [&](int64_t i, int lane) {
        const V alive = load<T>(f.alive + lane);
        V first = load<T>(start + i) * alive, last = load<T>(end + i) * alive;
        if (s.decay_rows == OBSERVED_ROWS) last = last * load<T>(f.update + lane);
        if (s.decay_rows != CONTINUOUS) first = last;
        store<T>(start + i, first);
        store<T>(end + i, last);
      });
    }
    T steps[P::ONE ? VW : W], span[P::ONE ? VW : W];
    const int most = s.field.layers ? steps_of<P>(s, f.gap, steps) : 1;
    for (int k = 0; k < most; ++k) {
      T* step = at(l.step) + int64_t(k) * l.step_size * W;
      if (d.F) {
        T* applied = step + int64_t(l.applied) * W;
        T* factor = step + int64_t(l.factor) * W;
        T* arrived = step + int64_t(l.arrived) * W;
        const T* previous = applied - int64_t(l.step_size) * W;
        P::each(d.H, [&](int64_t i, int lane) {
          const V first = load<T>(start + i), last = load<T>(end + i);
          V known;
          if (k)
            known = load<T>(previous + i);
          else if (s.decay_rows != CONTINUOUS)
            known = splat(0);
          else
            known = load<T>(f.updated + lane) != T(0) ? splat(0) : clip(first);
          V reached = last;
          if (!one_shot) {
            V share = T(k + 1) / load<T>(steps + lane);
            share = share > T(1) ? splat(1) : share;
            reached = fma(share, last - first, first);
          }
          V grown = clip(reached) - known;
          if (s.field.layers) grown = grown < T(0) ? splat(0) : grown;
          const V gamma = exp_(-grown), before = load<T>(h + i);
          store<T>(arrived + i, before);
          store<T>(factor + i, gamma);
          store<T>(h + i, before * gamma);
          const V bounded = clip(reached);
          store<T>(applied + i, bounded > known ? bounded : known);
        });
      }
      if (!s.field.layers) break;
      for (int i = 0; i < (P::ONE ? VW : W); ++i)
        span[i] = T(k) < steps[i] ? f.gap[i] / steps[i] : T(0);
      runge_kutta<P>(c, span, state, step + int64_t(l.stage) * W, z);
    }

    copy<P>(P::ONE ? l.state : d.S, state, at(l.before));
    if (!f.active) return;
    if (d.A) {
      T* e = at(l.innovation);
      P::each(d.A, [&](int64_t i, int) {
        store<T>(e + i, load<T>(f.mask + i) * (load<T>(f.values + i) - load<T>(state + i)));
      });
      P::template affine<true>(c.map.m[M_INNOV], c.packed, c.lanes, e, gate);
      P::each(d.A, [&](int64_t i, int) {
        const V m = load<T>(f.mask + i);
        store<T>(state + i, m * load<T>(f.values + i) + (1 - m) * load<T>(state + i));
      });
    }
    cell_forward<P>(c, f, h, memory, gate, at(l.held), at(l.hidden));
  }

  template <class P>
  static INLINE void copy(int units, const T* from, T* to) {
    P::each(units, [&](int64_t i, int) { store<T>(to + i, load<T>(from + i)); });
  }

  // One step of each lane's own span; the stages and their layers stay on the tape.
  template <class P>
  static NOINLINE void runge_kutta(const Context<P>& c, const T* span, T* state, T* stages, T* z) {
    const Spec& s = c.s;
    const Layout<P>& l = c.l;
    constexpr int W = P::W;
    const int driven = P::ONE ? l.network : c.map.d.D;
    T* slopes = c.work + work_slopes<P>(s);
    const int64_t size = int64_t(l.network) * W + (P::ONE ? VW : 0);
    for (int j = 0; j < s.stages; ++j) {
      T* stage = stages + int64_t(j) * l.stage_size * W;
      if (j == 0) {
        copy<P>(driven, state, stage);
      } else {
        P::each(driven, [&](int64_t i, int lane) {
          V sum = splat(0);
          for (int q = 0; q < j; ++q)
            if (s.a[j][q] != 0) sum = fma(splat(T(s.a[j][q])), load<T>(slopes + q * size + i), sum);
          store<T>(stage + i, fma(load<T>(span + lane), sum, load<T>(state + i)));
        });
      }
      evaluate<P>(c, s.field, M_FIELD, l.field_net, stage, stage + int64_t(l.network) * W,
                  slopes + j * size, z);
    }
    P::each(driven, [&](int64_t i, int lane) {
      V sum = splat(0);
      for (int q = 0; q < s.stages; ++q)
        if (s.b[q] != 0) sum = fma(splat(T(s.b[q])), load<T>(slopes + q * size + i), sum);
      store<T>(state + i, fma(load<T>(span + lane), sum, load<T>(state + i)));
    });
  }

  // `gate` holds the input's part and becomes the activated gates.
  template <class P>
  static NOINLINE void cell_forward(const Context<P>& c, const Facts<P>& f, T* h, T* memory, T* gate,
                           T* held, T* hidden) {
    const Spec& s = c.s;
    const Dims& d = c.map.d;
    constexpr int W = P::W;
    const int64_t n = int64_t(P::pad(d.H)) * W;
    if (s.cell == CELL_SET) {
      P::each(d.H, [&](int64_t i, int lane) {
        const V on = load<T>(f.update + lane);
        store<T>(h + i, on * load<T>(gate + i) + (1 - on) * load<T>(h + i));
      });
      return;
    }
    if (s.cell != CELL_GRU) {
      P::template affine<true>(c.map.m[M_REC], c.packed, c.lanes, h, gate);
      if (s.cell == CELL_ELMAN) {  // equation 6
        P::each(d.H, [&](int64_t i, int lane) {
          const V on = load<T>(f.update + lane), fresh = tanh_(load<T>(gate + i));
          store<T>(gate + i, fresh);
          store<T>(h + i, on * fresh + (1 - on) * load<T>(h + i));
        });
        return;
      }
      P::each(d.H, [&](int64_t i, int lane) {  // equations 14-19
        const V on = load<T>(f.update + lane), off = 1 - on;
        const V forget = sigmoid_(load<T>(gate + i)), insert = sigmoid_(load<T>(gate + n + i));
        const V node = tanh_(load<T>(gate + 2 * n + i));
        const V output = sigmoid_(load<T>(gate + 3 * n + i));
        const V old = load<T>(memory + i);
        const V fresh = fma(forget, old, insert * node), bent = tanh_(fresh);
        store<T>(gate + i, forget), store<T>(gate + n + i, insert);
        store<T>(gate + 2 * n + i, node), store<T>(gate + 3 * n + i, output);
        store<T>(held + i, bent);
        store<T>(memory + i, on * fresh + off * old);
        store<T>(h + i, on * output * bent + off * load<T>(h + i));
      });
      return;
    }
    // equations 20-23, and 29-32 with the gates of GRU-D
    P::template affine<true>(c.map.m[M_REC], c.packed, c.lanes, h, gate);
    P::each(d.H, [&](int64_t i, int) {
      const V r = sigmoid_(load<T>(gate + n + i));
      store<T>(gate + i, sigmoid_(load<T>(gate + i)));
      store<T>(gate + n + i, r);
      if (!s.reset_after) store<T>(held + i, r * load<T>(h + i));
    });
    if (s.reset_after) {
      P::template affine<false>(c.map.m[M_CAND], c.packed, c.lanes, h, held);
      P::each(d.H, [&](int64_t i, int) {
        T* g = gate + 2 * n + i;
        store<T>(g, fma(load<T>(gate + n + i), load<T>(held + i), load<T>(g)));
      });
    } else {
      P::template affine<true>(c.map.m[M_CAND], c.packed, c.lanes, held, gate + 2 * n);
    }
    (void)hidden;
    P::each(d.H, [&](int64_t i, int lane) {
      const V candidate = tanh_(load<T>(gate + 2 * n + i)), old = load<T>(h + i);
      store<T>(gate + 2 * n + i, candidate);
      store<T>(h + i, fma(load<T>(gate + i) * load<T>(f.update + lane), candidate - old, old));
    });
  }

  template <class P>
  static int widest(const Spec& s) {
    const Dims d = dims(s);
    int n = d.G / (d.H ? d.H : 1) * P::pad(d.H);
    for (const Perceptron* p : {&s.field, &s.decoder})
      for (int l = 0; l <= p->layers; ++l)
        if (P::pad(p->sizes[l]) + VW > n) n = P::pad(p->sizes[l]) + VW;
    const int driven = P::pad(d.A) + P::pad(d.H);
    return (n > driven ? n : driven) + VW;
  }
  template <class P>
  static int64_t work_slopes(const Spec& s) {
    return int64_t(widest<P>(s)) * P::W;
  }
  template <class P>
  static int64_t work_size(const Spec& s) {
    const Dims d = dims(s);
    const int64_t slope = int64_t(P::pad(d.A) + P::pad(d.H)) * P::W + VW;
    return work_slopes<P>(s) + slope * s.stages + VW;
  }

  template <class P>
  static NOINLINE void scatter(const Job<T>& job, const Block& b, const Grid<T>& grid, int row,
                      const T* state, int units) {
    if (!grid.data) return;
    T* lanes[P::W];
    for (int lane = 0; lane < b.lanes; ++lane)
      lanes[lane] = grid.data + job.order[b.first + lane] * grid.by_lane + row * grid.by_row;
    units_to_lanes(state, units, b.lanes, P::W, lanes);
  }
  template <class P>
  static NOINLINE void collect(const Job<T>& job, const Block& b, const Grid<T>& grid, int row, int units,
                      bool add, T* out) {
    if (!grid.data) {
      if (!add) zero(out, int64_t(units) * P::W);
      return;
    }
    if (!add) zero(out, int64_t(units) * P::W);
    for (int lane = 0; lane < b.lanes; ++lane) {
      const T* in = grid.data + job.order[b.first + lane] * grid.by_lane + row * grid.by_row;
      for (int u = 0; u < units; ++u) out[int64_t(u) * P::W + lane] += in[u];
    }
  }
  static void zero(T* p, int64_t n) { __builtin_memset(p, 0, size_t(n) * sizeof(T)); }

  template <class P>
  static void first_state(const Job<T>& job, const Block& b, T* state) {
    const int S = dims(*job.spec).S;
    Grid<T> grid{const_cast<T*>(job.state), S, 0};
    collect<P>(job, b, grid, 0, S, false, state);
  }

  static int64_t forward_scratch(const Spec& s, int max_steps) {
    using P = Many<2>;
    const Dims d = dims(s);
    return int64_t(d.S) * P::W + facts_size(d, P::W) + work_size<P>(s) +
           tape_row(s, max_steps, 2) + 64;
  }

  template <class P>
  static Context<P> context(const Job<T>& job, const Block& b, const Map& map, T* work) {
    return Context<P>{*job.spec, map, job.packed, job.packed + map.packed_vectors,
                      layout<P>(*job.spec, map.d, job.max_steps), work, b.lanes};
  }

  template <class P>
  static void block_forward(const Job<T>& job, const Block& b, int begin, int end, T* scratch) {
    const Map p = map(*job.spec);
    const Dims& d = p.d;
    T* state = scratch;
    T* lanes = state + int64_t(d.S) * P::W;
    T* work = lanes + facts_size(d, P::W);
    T* own = work + work_size<P>(*job.spec);
    const Context<P> c = context<P>(job, b, p, work);
    Facts<P> f = facts<P>(d, lanes);
    const int64_t row_size = int64_t(c.l.size) * P::W;
    if (begin)
      collect<P>(job, b, job.after, begin - 1, d.S, false, state);
    else
      first_state<P>(job, b, state);
    if (end >= b.rows) end = int(job.n_rows);
    for (int row = begin; row < end; ++row) {
      if (row < b.rows) {
        T* tape = job.tape ? job.tape + b.tape + row * row_size : own;
        gather<P>(job, d, b, row, f, 2);
        row_forward<P>(c, f, state, tape);
        scatter<P>(job, b, job.before, row, tape + int64_t(c.l.before) * P::W, d.S);
      } else {
        scatter<P>(job, b, job.before, row, state, d.S);
      }
      scatter<P>(job, b, job.after, row, state, d.S);
    }
  }

  static void forward(const Job<T>& job, int block, int begin, int end, T* scratch) {
    const Block& b = job.blocks[block];
    if (b.vectors == 2)
      block_forward<Many<2>>(job, b, begin, end, scratch);
    else
      block_forward<Many<1>>(job, b, begin, end, scratch);
  }

#include "backward.hpp"
#include "perceptron.hpp"
#include "stream.hpp"
};
