// Sizes of a scan, its matrices, and how their weights are packed: part of Scan<T> (scan.hpp).

struct Dims {
  // Channels, hidden units, anchored channels, units of the state before h (anchored channels and
  // their slopes), decay features, time inputs, cell inputs, gates, state, driven units (those that
  // the vector field changes).
  int C, H, A, X, F, time_inputs, I, G, S, D;
  bool cell, lstm, trend;
};
static Dims dims(const Spec& s) {
  Dims d{};
  d.C = s.channels, d.H = s.hidden, d.A = s.anchored, d.F = s.decay_features,
  d.time_inputs = s.time_inputs;
  d.cell = s.cell != CELL_NONE;
  d.lstm = s.cell == CELL_LSTM;
  d.I = d.cell ? 2 * d.C + d.time_inputs : 0;
  d.G = !d.cell ? 0 : d.H * (s.cell == CELL_GRU ? 3 : d.lstm ? 4 : 1);
  d.trend = s.trend;
  d.X = d.trend ? 2 * d.A : d.A;
  d.S = d.X + d.H + (d.lstm ? d.H : 0);
  d.D = d.X + d.H;
  return d;
}
static int up(int n, int m) { return (n + m - 1) / m * m; }

// The matrices in the order of the flat buffer of all weights (cpu.py).
enum {
  M_IN,
  M_REC,
  M_CAND,
  M_INNOV,
  M_DECAY,
  M_FIELD,
  M_DECODER = M_FIELD + MAX_LAYERS,
  M_END = M_DECODER + MAX_LAYERS
};

struct Matrix {
  int out = 0, in = 0;
  int64_t weight = -1, bias = -1;  // in the flat buffer; -1: none
  bool backward = false, half = false;  // half: products in bfloat16 (bf16.hpp)
  int backward_in = 0;                                  // leading inputs that need a gradient
  int64_t panels = 0, transposed = 0, packed_bias = 0;  // in the packed buffer of batches
  int64_t sum = 0, bias_sum = 0;                        // in the sums of a slot
  int split[4] = {};  // segments of the outputs, which streams pad one by one
  int splits = 1;
  int in_split = 0;  // first segment of the inputs, which streams pad
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
  // Vectors of the trend, one after the other: damping, odds, factor.
  int64_t trend_weight = -1, packed_trend = 0, trend_sum = 0, stream_trend = 0;
};

static constexpr int TILE = 4;

// Numbers of the weights of a product, with their padding.
static int64_t panels_size(const Matrix& m, int out, int in) {
  return m.half ? int64_t(up(out, 16)) * up(in, 32) / 2 : int64_t(up(out, TILE)) * in;
}

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
  const bool values_backward = s.input_decay || s.decoder.layers;
  if (d.cell) {
    Matrix& in = add(M_IN, d.G, d.I, values_backward, d.C);
    segments(in, d.G / d.H, d.H);
    in.bias = at, at += d.G;
    if (s.cell == CELL_GRU) {
      segments(add(M_REC, 2 * d.H, d.H, true, d.H), 2, d.H);
      add(M_CAND, d.H, d.H, true, d.H);
    } else if (s.cell != CELL_START) {
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
  if (d.trend) p.trend_weight = at, at += 3 * d.A;
  for (int k = 0; k < 2; ++k) {
    const Perceptron& net = k ? s.decoder : s.field;
    for (int l = 0; l < net.layers; ++l) {
      Matrix& m =
          add((k ? M_DECODER : M_FIELD) + l, net.sizes[l + 1], net.sizes[l], true, net.sizes[l]);
      m.bias = at, at += m.out;
      if (!k && d.A && l == 0) m.in_split = d.X;
      if (!k && d.A && l == net.layers - 1) m.splits = 2, m.split[0] = d.X, m.split[1] = d.H;
    }
  }
  p.flat = at;
  int64_t packed = 0, sums = 0, stream = 0;
  for (int i = 0; i < M_END; ++i) {
    if (!p.used[i]) continue;
    Matrix& m = p.m[i];
    m.half = BF16 && i != M_DECAY;  // its inputs are times
    if (m.half) packed = (packed + 15) / 16 * 16;
    m.panels = packed, packed += panels_size(m, m.out, m.in);
    if (m.backward) m.transposed = packed, packed += panels_size(m, m.backward_in, m.out);
    if (m.bias >= 0) m.packed_bias = packed, packed += up(m.out, TILE);
    m.sum = sums, sums += int64_t(m.half ? up(m.out, 16) : m.out) * up(m.in, VW);
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
  if (d.trend) {
    p.stream_trend = stream, stream += 3 * up(d.A, VW);
    p.packed_trend = packed, packed += 3 * up(d.A, VW);
    p.trend_sum = sums, sums += int64_t(3) * d.A * VW;
  }
  p.packed = packed, p.sums = sums;
  p.stream = stream + (s.input_decay ? 2 * up(d.C, VW) : 0);
  return p;
}

static int64_t packed_size(const Spec& s) { return map(s).packed; }
static int64_t sums_size(const Spec& s) { return map(s).sums; }
static int64_t stream_packed_size(const Spec& s) { return map(s).stream; }

static void pack_panels(const Matrix& m, const T* w, T* packed) {
  T* p = packed + m.panels;
  for (int o = 0; o < m.out; o += TILE)
    for (int k = 0; k < m.in; ++k)
      for (int r = 0; r < TILE; ++r) *p++ = o + r < m.out ? w[int64_t(o + r) * m.in + k] : T(0);
  if (!m.backward) return;
  p = packed + m.transposed;
  for (int i = 0; i < m.backward_in; i += TILE)
    for (int o = 0; o < m.out; ++o)
      for (int r = 0; r < TILE; ++r)
        *p++ = i + r < m.backward_in ? w[int64_t(o) * m.in + i + r] : T(0);
}
static void pack_halves(const Matrix& m, const T* w, T* packed) {
#if BF16
  pack_tiles(m.out, m.in, packed + m.panels,
             [&](int o, int i) { return w[int64_t(o) * m.in + i]; });
  if (m.backward)
    pack_tiles(m.backward_in, m.out, packed + m.transposed,
               [&](int i, int o) { return w[int64_t(o) * m.in + i]; });
#else
  (void)m, (void)w, (void)packed;
#endif
}
static void pack_matrix(const Matrix& m, const T* flat, T* packed) {
  if (m.half)
    pack_halves(m, flat + m.weight, packed);
  else
    pack_panels(m, flat + m.weight, packed);
  if (m.bias >= 0) {
    T* p = packed + m.packed_bias;
    for (int o = 0; o < up(m.out, TILE); ++o) p[o] = o < m.out ? flat[m.bias + o] : T(0);
  }
}
static void pack(const Spec& s, const T* flat, T* packed) {
  const Map p = map(s);
  for (int i = 0; i < M_END; ++i)
    if (p.used[i]) pack_matrix(p.m[i], flat, packed);
  if (s.input_decay) pack_input_decay(p, flat, packed + p.packed_vectors);
  if (s.trend) pack_trend(p, flat, packed + p.packed_trend);
}
// Padding is 1, so that all arithmetic on it is finite.
static void pack_trend(const Map& p, const T* flat, T* out) {
  const int n = up(p.d.A, VW);
  for (int k = 0; k < 3; ++k)
    for (int c = 0; c < n; ++c)
      out[k * n + c] = c < p.d.A ? flat[p.trend_weight + k * p.d.A + c] : T(1);
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
  if (s.trend) pack_trend(p, flat, packed + p.stream_trend);
}
