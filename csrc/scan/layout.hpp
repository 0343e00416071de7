// The step inputs of a row, gathered for the lanes of a block, and the layout of the tape: part of
// Scan<T> (scan.hpp).

// --- from [lane][unit], the layout of the arguments, to [unit][lane] and back -------------------

// out[unit * W + lane] = lanes[lane][unit]
static NOINLINE void lanes_to_units(const T* const* lanes, int units, int W, T* out) {
  int first = 0;
  if constexpr (FAST_TRANSPOSE && sizeof(T) == 4)
    if (units >= 8 && W % 8 == 0)
      for (; first < units; first += 8) {
        const int u = first + 8 <= units ? first : units - 8;  // the last eight may overlap
        for (int lane = 0; lane < W; lane += 8)
          transpose_8_by_8([&](int i) { return lanes[lane + i] + u; },
                           [&](int i) { return out + int64_t(u + i) * W + lane; });
      }
  for (int lane = 0; lane < W; ++lane)
    for (int u = first; u < units; ++u) out[int64_t(u) * W + lane] = lanes[lane][u];
}
// lanes[lane][unit] = x[unit * W + lane], for the first `n` lanes
static NOINLINE void units_to_lanes(const T* x, int units, int n, int W, T* const* lanes) {
  for (int lane = 0; lane < n; ++lane) {
    int first = 0;
    if constexpr (FAST_TRANSPOSE && sizeof(T) == 4)
      if (units >= 8 && lane + 8 <= n) {
        for (; first < units; first += 8) {
          const int u = first + 8 <= units ? first : units - 8;
          transpose_8_by_8([&](int i) { return x + int64_t(u + i) * W + lane; },
                           [&](int i) { return lanes[lane + i] + u; });
        }
        lane += 7;
        continue;
      }
    for (int u = first; u < units; ++u) lanes[lane][u] = x[int64_t(u) * W + lane];
  }
}

// --- the tape of a row ----------------------------------------------------------------------

// Offsets in units, to be multiplied by P::W. `Net` is one evaluation of a perceptron.
struct Net {
  int64_t value[MAX_LAYERS], slope[MAX_LAYERS], size;
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
  int64_t u, start, end, before, node, gate, inner, innovation, decoded, h_before;
  int64_t decoder, step, step_size, applied, factor, arrived, slopes, stopped, limited, stage,
      stage_size, y, network, size;
  Net field_net, decoder_net;
  int64_t x_at, h_at, c_at, state;  // inside a state
};
template <class P>
static Layout<P> layout(const Spec& s, const Dims& d, int max_steps) {
  Layout<P> l{};
  int64_t at = 0;
  auto take = [&](int n) {
    const int64_t here = at;
    at += P::pad(n);
    return here;
  };
  l.h_at = P::pad(d.X);
  l.c_at = l.h_at + P::pad(d.H);
  l.state = l.c_at + (d.lstm ? P::pad(d.H) : 0);
  l.u = at, at += P::pad(d.I) + (P::ONE ? VW : 0);
  l.h_before = take(s.decoder.layers ? d.H : 0);
  l.start = take(d.F ? d.H : 0);
  l.end = take(d.F ? d.H : 0);
  l.before = at, at += l.state;
  l.node = at, at += s.nodes ? l.state : 0;
  l.gate = at, at += d.cell ? d.G / d.H * P::pad(d.H) : 0;
  l.inner = take(d.H);
  l.innovation = take(d.A);
  l.decoded = take(s.decoder.layers ? d.C : 0);
  l.decoder_net = net<P>(s.decoder);
  l.decoder = at, at += l.decoder_net.size;
  l.field_net = net<P>(s.field);
  l.step = at;
  int64_t step = 0;
  if (d.F) {
    l.applied = step, step += P::pad(d.H);
    l.factor = step, step += P::pad(d.H);
    l.arrived = step, step += P::pad(d.H);
  }
  if (d.trend) {
    l.slopes = step, step += P::pad(d.A);
    l.stopped = step, step += s.bounded ? P::pad(d.A) : 0;
  }
  l.limited = step, step += s.bounded ? P::pad(d.X) + P::pad(d.H) : 0;
  l.stage = step;
  l.y = 0;
  l.network = P::pad(d.X) + P::pad(d.H);
  l.stage_size = s.field.layers ? l.network + l.field_net.size : 0;
  step += l.stage_size * s.stages;
  l.step_size = step;
  l.size = at + step * max_steps;
  return l;
}
// The layout in units is the same for one and two vectors.
static int64_t tape_row(const Spec& s, int max_steps, int vectors) {
  return layout<Many<1>>(s, dims(s), max_steps).size * VW * vectors;
}

// The step inputs of one row for the lanes of a block. A lane past its last row keeps its state.
template <class P>
struct RowInputs {
  T *gap, *update, *updated, *valid, *first, *node, *commit, *values, *mask, *time_input, *start,
      *end, *delta, *last, *level_gain, *slope_gain;
  const T* mean;
  T* zeros;  // inputs of a lane past its last row
  bool active = false, use_prediction = false;
};
static constexpr int ROW_SCALARS = 7;
static int64_t row_inputs_size(const Dims& d, int lanes) {
  return ROW_SCALARS * (lanes < VW ? VW : lanes) +
         ((d.trend ? 6 : 4) * d.C + d.time_inputs + 2 * d.F) * lanes + widest_quantity(d);
}
static int widest_quantity(const Dims& d) {
  return up(
      d.C > d.time_inputs ? (d.C > d.F ? d.C : d.F) : (d.time_inputs > d.F ? d.time_inputs : d.F),
      16);
}
template <class P>
static RowInputs<P> row_inputs(const Dims& d, T* at) {
  RowInputs<P> f{};
  for (T** p : {&f.gap, &f.update, &f.updated, &f.valid, &f.first, &f.node, &f.commit})
    *p = at, at += P::W;
  f.values = at, at += d.C * P::W;
  f.mask = at, at += d.C * P::W;
  f.time_input = at, at += d.time_inputs * P::W;
  f.start = at, at += d.F * P::W;
  f.end = at, at += d.F * P::W;
  f.delta = at, at += d.C * P::W;
  f.last = at, at += d.C * P::W;
  f.level_gain = at, at += d.trend ? d.C * P::W : 0;
  f.slope_gain = at, at += d.trend ? d.C * P::W : 0;
  f.zeros = at;
  zero(f.zeros, widest_quantity(d));
  return f;
}
// The rows of many trajectories are far apart in memory, so those `ahead` rows on are prefetched.
template <class P>
static NOINLINE void gather(const Job<T>& job, const Dims& d, const Block& b, int row,
                            RowInputs<P>& f, int ahead) {
  const bool more = row + ahead >= 0 && row + ahead < b.rows;
  f.use_prediction = job.inputs.use_prediction && job.inputs.use_prediction[row];
  f.active = false;
  for (int lane = 0; lane < P::W; ++lane) {
    const int64_t at = lane < b.lanes ? job.source[b.first + lane] : 0;
    const bool valid = lane < b.lanes && row < job.length[b.first + lane];
    f.valid[lane] = valid;
    auto one = [&](const Quantity<T>& quantity) {
      return valid && quantity.data ? quantity.data[at * quantity.by_lane + row * quantity.by_row]
                                    : T(0);
    };
    if (more && lane < b.lanes)
      __builtin_prefetch(job.inputs.gap.data + at * job.inputs.gap.by_lane +
                         (row + ahead) * job.inputs.gap.by_row);
    f.gap[lane] = one(job.inputs.gap);
    f.update[lane] = one(job.inputs.update);
    f.updated[lane] = one(job.inputs.updated);
    f.first[lane] = one(job.inputs.first_node);
    f.node[lane] = one(job.inputs.node);
    f.commit[lane] = one(job.inputs.commit);
    f.active |= d.cell && f.update[lane] != 0;
  }
  auto many = [&](const Quantity<T>& quantity, int n, T* out) {
    if (!quantity.data || !n) return;
    const T* lanes[P::W];
    for (int lane = 0; lane < P::W; ++lane)
      lanes[lane] = f.valid[lane] != 0
                        ? quantity.data + int64_t(job.source[b.first + lane]) * quantity.by_lane +
                              row * quantity.by_row
                        : f.zeros;
    if (more)
      for (int lane = 0; lane < b.lanes; ++lane) {
        const T* next = quantity.data + int64_t(job.source[b.first + lane]) * quantity.by_lane +
                        (row + ahead) * quantity.by_row;
        for (int u = 0; u < n; u += 64 / int(sizeof(T))) __builtin_prefetch(next + u);
        __builtin_prefetch(next + n - 1);
      }
    lanes_to_units(lanes, n, P::W, out);
  };
  many(job.inputs.values, d.C, f.values);
  many(job.inputs.mask, d.C, f.mask);
  many(job.inputs.time_input, d.time_inputs, f.time_input);
  many(job.inputs.decay_start, d.F, f.start);
  many(job.inputs.decay_end, d.F, f.end);
  many(job.inputs.delta, d.C, f.delta);
  many(job.inputs.last, d.C, f.last);
  many(job.inputs.level_gain, d.C, f.level_gain);
  many(job.inputs.slope_gain, d.C, f.slope_gain);
  f.mean = job.inputs.mean;
}

static INLINE V clip(V a) {
  a = a < T(0) ? splat(0) : a;
  return a > LARGEST_EXPONENT ? splat(LARGEST_EXPONENT) : a;
}
static INLINE V inside(V a) {  // derivative of clip
  return a >= T(0) ? (a <= LARGEST_EXPONENT ? splat(1) : splat(0)) : splat(0);
}

// Of the trend of each channel: its parameters, and what a step from node to node does.
struct Trend {
  const T *damping, *odds, *factor, *kept, *reach, *bend;
};
// Over a time `span`, x moves by `reach` times v, and v is multiplied by `kept`. `bend` is the
// derivative of -reach by the damping.
struct Motion {
  V kept, reach, bend;
};
static INLINE Motion motion(V damping, V span) {
  // (1 - exp(-z)) / z and minus its derivative; near 0, where they cancel, by their series.
  constexpr int TERMS = sizeof(T) == 4 ? 8 : 14;
  const V z = damping * span, close = z < T(0.5) ? z : splat(0), away = z < T(0.5) ? splat(1) : z;
  V phi = splat(0), psi = splat(0);
  T last = 1;  // (TERMS + 1)!
  for (int m = 2; m <= TERMS + 1; ++m) last *= T(m);
  for (int m = TERMS - 1; m >= 0; --m) {
    const T sign = m % 2 ? T(-1) : T(1);
    psi = fma(psi, close, splat(sign * T(m + 1) / last));  // of (m + 2)!
    last /= T(m + 2);
    phi = fma(phi, close, splat(sign / last));  // of (m + 1)!
  }
  const V kept = exp_(-z), far = (1 - kept) / away;
  phi = z < T(0.5) ? phi : far;
  psi = z < T(0.5) ? psi : (far - kept) / away;
  return {kept, span * phi, span * span * psi};
}

template <class P>
struct Context {
  const Spec& s;
  const Map& map;
  const T* packed;
  const T* input_decay;  // weights, then biases
  Layout<P> l;
  T* work;                                  // scratch: a layer, then the slopes of the stages
  int lanes = P::W;                         // lanes in use; the others are padding
  const T *low = nullptr, *high = nullptr;  // of the driven units of a bounded scan
  const Trend trend = {};
};

// The range of the driven units, laid out as a state.
template <class P>
static void range(const Spec& s, const Dims& d, const T* low, const T* high, T* out) {
  if (!s.bounded) return;
  const int x = P::pad(d.X), n = x + P::pad(d.H);
  for (int u = 0; u < n; ++u) {
    const bool channel = u < d.X;
    out[u] = channel ? low[u] : -HIDDEN_LIMIT;
    out[n + u] = channel ? high[u] : HIDDEN_LIMIT;
  }
}
static int range_size(const Spec& s, const Dims& d) {
  return (s.bounded ? 2 * (up(d.X, VW) + up(d.H, VW)) : 0) + 3 * (d.trend ? up(d.A, VW) : 0);
}
// The trend of a scan; `constants` has room for three vectors of channels.
static Trend trend(const Spec& s, const Dims& d, const T* packed, T* constants) {
  if (!d.trend) return {};
  const int n = up(d.A, VW);
  for (int u = 0; u < n; u += VW) {
    const Motion m = motion(load<T>(packed + u), splat(T(s.max_step)));
    store<T>(constants + u, m.kept);
    store<T>(constants + n + u, m.reach);
    store<T>(constants + 2 * n + u, m.bend);
  }
  return {packed, packed + n, packed + 2 * n, constants, constants + n, constants + 2 * n};
}
// x inside of the range from `low` to `high`.
static INLINE V within(V x, V low, V high) {
  x = x < low ? low : x;
  return x > high ? high : x;
}
// The derivative of `within`; 0 at its ends, too.
static INLINE V inside(V x, V low, V high) {
  return x > low ? (x < high ? splat(1) : splat(0)) : splat(0);
}
