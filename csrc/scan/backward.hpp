// The backward pass of a block: part of Scan<T> (scan.hpp).
//
// Rows are processed in groups, last first. The tape of a group was stored by the forward pass, or
// is recomputed here. The products of a group are added to the gradient of each matrix together, so
// that the gradient moves through the cache once per group.

// Offsets, in units, of the gradients of a row's affine maps until they are added.
struct GradientLayout {
  int64_t gate, inner, start, end, decoder, field, field_size, size;
};
static GradientLayout gradient_layout(const Spec& s, const Dims& d, int max_steps) {
  GradientLayout l{};
  int64_t at = 0;
  auto take = [&](int n) {
    const int64_t here = at;
    at += n;
    return here;
  };
  l.gate = take(d.G);
  l.inner = take(d.H);
  l.start = take(d.F ? d.H : 0);
  l.end = take(d.F ? d.H : 0);
  l.decoder = at;
  for (int k = 0; k < s.decoder.layers; ++k) at += s.decoder.sizes[k + 1];
  l.field = at;
  for (int k = 0; k < s.field.layers; ++k) l.field_size += s.field.sizes[k + 1];
  l.size = at + l.field_size * s.stages * max_steps;
  return l;
}

template <class P>
struct Back {
  const Context<P>& c;
  GradientLayout places;
  Pairs& pairs;
  T *sums, *xt;
  T *z, *to_values, *stage_gradients, *to_node;  // scratch

  void push(int id, const T* to_out, const T* x) {
    if (pairs.count[id] == MAX_PAIRS) flush(c.map, pairs, P::W, c.lanes, sums, xt);
    const int n = pairs.count[id]++;
    pairs.to_out[id][n] = to_out;
    pairs.x[id][n] = x;
  }
};

// Computes the gradient of a perceptron's argument from the gradient of its result, which the
// caller has stored at the end of `kept_gradients`.
template <class P>
static NOINLINE void evaluate_backward(Back<P>& k, const Perceptron& shape, int first, const Net& n,
                                       const T* x, const T* kept, T* kept_gradients, T* to_x) {
  constexpr int W = P::W;
  T* to_out = kept_gradients;
  for (int l = 0; l + 1 < shape.layers; ++l) to_out += int64_t(shape.sizes[l + 1]) * W;
  for (int l = shape.layers - 1; l >= 0; --l) {
    const Matrix& m = k.c.map.m[first + l];
    const T* value = l ? kept + n.value[l - 1] * W : x;
    k.push(first + l, to_out, value);
    if (l == 0) {
      P::template transposed<false>(m, k.c.packed, k.c.lanes, to_out, to_x);
      break;
    }
    T* to_value = to_out - int64_t(shape.sizes[l]) * W;
    if (shape.activation == TANH) {
      P::through_tanh(m, k.c.packed, k.c.lanes, to_out, value, to_value);
    } else {
      P::template transposed<false>(m, k.c.packed, k.c.lanes, to_out, k.z);
      activate_backward<P>(shape.sizes[l], kept + n.slope[l - 1] * W, k.z, to_value);
    }
    to_out = to_value;
  }
}

// `g` is the gradient of the state after the row, and becomes the gradient of the state before the
// gap.
template <class P>
static NOINLINE void row_backward(Back<P>& k, const RowInputs<P>& f, const T* tape, T* slot, T* g,
                                  const Job<T>& job, const Block& b, int row) {
  const Context<P>& c = k.c;
  const Spec& s = c.s;
  const Dims& d = c.map.d;
  const Layout<P>& l = c.l;
  constexpr int W = P::W;
  auto at = [&](int64_t units) { return tape + units * W; };
  auto to = [&](int64_t units) { return slot + units * W; };
  T* gh = g + l.h_at * W;
  T* gate = to(k.places.gate);
  const bool values_need_gradient = f.active && (f.use_prediction || s.input_decay);

  if (s.nodes)  // a state that was not kept leaves that of the node to the next row
    P::each(d.S, [&](int64_t i, int lane) {
      const V all = load<T>(g + i), kept = load<T>(f.commit + lane);
      store<T>(g + i, kept != T(0) ? all : splat(0));
      store<T>(k.to_node + i, kept != T(0) ? splat(0) : all);
    });
  if (f.active) {
    cell_backward<P>(k, f, tape, slot, gh, g + l.c_at * W);
    k.push(M_IN, gate, at(l.u));
    if (d.A) {
      k.push(M_INNOV, gate, at(l.innovation));
      P::template transposed<false>(c.map.m[M_INNOV], c.packed, c.lanes, gate, k.z);
      const T* x = at(l.before);
      T* gv = g + int64_t(d.A) * W;
      T* to_odds = k.sums + c.map.trend_sum + int64_t(d.A) * VW;
      T* to_factor = to_odds + int64_t(d.A) * VW;
      P::each_unit(d.A, [&](int64_t i, int, int n) {
        const V m = load<T>(f.mask + i);
        V to_innovation = load<T>(k.z + i), kept = 1 - m;
        if (d.trend) {
          const V value = load<T>(f.values + i), gain = load<T>(f.level_gain + i);
          const V slope = load<T>(f.slope_gain + i), odds = P::constant(c.trend.odds, n);
          V outside;
          const V corrected = level_gain<P>(c, f, i, n, value, load<T>(x + i), outside);
          const V whole = fma(1 - gain, odds, gain);
          V by_odds = -gain * (1 - gain) / (whole * whole) * (value - load<T>(x + i));
          by_odds = outside != T(0) ? splat(0) : by_odds;
          T* own = to_odds + n * VW;
          store<T>(own, fma(by_odds, load<T>(g + i), load<T>(own)));
          own = to_factor + n * VW;
          const V to_slope = load<T>(gv + i) * slope;
          store<T>(own, fma(to_slope, load<T>(at(l.innovation) + i), load<T>(own)));
          to_innovation = fma(to_slope, P::constant(c.trend.factor, n), to_innovation);
          kept = 1 - corrected;
        }
        V to_x = m * to_innovation;
        if (s.bounded)
          to_x = to_x * inside(load<T>(x + i), P::constant(c.low, n), P::constant(c.high, n));
        store<T>(g + i, kept * load<T>(g + i) - to_x);
      });
    }
    if (values_need_gradient)
      P::template transposed<false>(c.map.m[M_IN], c.packed, c.lanes, gate, k.to_values);
  }
  collect<P>(job, b, job.to_before, row, d.S, true, g);

  // Dynamics and decay, last step first.
  Steps<P> p = steps_to_row<P>(s, f);
  auto reach_node = [&] {
    P::each(d.S, [&](int64_t i, int) { store<T>(g + i, load<T>(g + i) + load<T>(k.to_node + i)); });
  };
  const bool one_shot = !s.field.layers || (s.steps == 1 && s.max_step == 0);
  T* to_start = to(k.places.start);
  T* to_end = to(k.places.end);
  T* to_before = k.z + int64_t(widest<P>(s)) * W;
  if (d.F) {
    zero(to_start, int64_t(d.H) * W);
    zero(to_end, int64_t(d.H) * W);
    zero(to_before, int64_t(d.H) * W);
  }
  if (s.nodes && !p.read) reach_node();
  for (int q = p.whole + p.read - 1; q >= p.untracked; --q) {
    const T* step = at(l.step) + p.place(q) * l.step_size * W;
    set_step<P>(s, f, q, p);
    if (s.nodes && p.read && q == p.whole - 1) reach_node();
    if (s.field.layers) {
      T* kept = to(k.places.field) + p.place(q) * s.stages * k.places.field_size * W;
      runge_kutta_backward<P>(k, p.span, g, step + l.stage * W, step + l.limited * W, kept);
    }
    if (d.trend)
      along_trend_backward<P>(k, p, s.nodes && q < p.whole, g, step + l.slopes * W,
                              step + l.stopped * W);
    if (!d.F) continue;
    const T* applied = step + l.applied * W;
    const T* factor = step + l.factor * W;
    const T* arrived = step + l.arrived * W;
    const T* previous = applied - l.step_size * W;
    P::each(d.H, [&](int64_t i, int lane) {
      const V first = load<T>(at(l.start) + i), last = load<T>(at(l.end) + i);
      const V updated = load<T>(f.updated + lane);
      const Exponent e = exponent<P>(s, q, one_shot, first, last, updated, p, lane,
                                     load<T>(f.first + lane), previous + i);
      const V bounded = clip(e.reached), gamma = load<T>(factor + i), gradient = load<T>(gh + i);
      store<T>(gh + i, gradient * gamma);
      V to_growth = -gamma * gradient * load<T>(arrived + i);
      if (s.field.layers || s.nodes) to_growth = bounded - e.before >= T(0) ? to_growth : splat(0);
      // The applied exponent is the larger of the two; a tie splits the gradient.
      const V to_applied = load<T>(to_before + i);
      V slope = bounded > e.before ? splat(1) : bounded == e.before ? splat(T(0.5)) : splat(0);
      if (s.nodes) {
        const V active = load<T>(p.active + lane);
        slope = active != T(0) ? slope : splat(0);
        to_growth = active != T(0) ? to_growth : splat(0);
      }
      const V to_bounded = to_growth + to_applied * slope;
      const V to_previous = to_applied * (1 - slope) - to_growth;
      const V to_reached = to_bounded * inside(e.reached);
      V start = load<T>(to_start + i) + (1 - e.fraction) * to_reached;
      V end = load<T>(to_end + i) + e.fraction * to_reached;
      if (q == p.untracked && s.decay_rows == CONTINUOUS) {
        const V began = s.nodes ? fma(e.began, last - first, first) : first;
        V to_began = e.fresh != T(0) ? splat(0) : to_previous * inside(began);
        if (p.untracked) to_began = load<T>(p.later + lane) >= T(p.untracked) ? to_began : splat(0);
        start = start + (1 - e.began) * to_began;
        end = end + e.began * to_began;
      }
      store<T>(to_end + i, end);
      store<T>(to_start + i, start);
      store<T>(to_before + i, to_previous);
    });
  }
  if (s.nodes && p.read && !p.whole) reach_node();
  if (p.untracked)  // no gradient reaches the state before them
    for (int i = 0; i < W; ++i)
      if (p.cut(i))
        for (int u = 0; u < d.D; ++u) g[int64_t(u) * W + i] = 0;
  if (d.F) {
    P::each(d.H, [&](int64_t i, int lane) {
      const V valid = load<T>(f.valid + lane);
      V start = load<T>(to_start + i) * valid, end = load<T>(to_end + i) * valid;
      if (s.decay_rows != CONTINUOUS) end = end + start, start = splat(0);
      if (s.decay_rows == OBSERVED_ROWS) end = end * load<T>(f.update + lane);
      store<T>(to_start + i, start);
      store<T>(to_end + i, end);
    });
    k.push(M_DECAY, to_end, f.end);
    if (s.decay_rows == CONTINUOUS) k.push(M_DECAY, to_start, f.start);
  }

  if (!values_need_gradient) return;
  if (f.use_prediction) {
    T* kept = to(k.places.decoder);
    T* to_out = kept;
    for (int q = 0; q + 1 < s.decoder.layers; ++q) to_out += int64_t(s.decoder.sizes[q + 1]) * W;
    copy<P>(d.C, k.to_values, to_out);
    evaluate_backward<P>(k, s.decoder, M_DECODER, l.decoder_net, at(l.h_before), at(l.decoder),
                         kept, k.to_values);
    P::each(d.H,
            [&](int64_t i, int) { store<T>(gh + i, load<T>(gh + i) + load<T>(k.to_values + i)); });
  } else {
    const T* weight = c.input_decay;
    const T* bias = weight + up(d.C, VW);
    T* to_weight = k.sums + c.map.input_decay_weight_sum;
    T* to_bias = k.sums + c.map.input_decay_bias_sum;
    P::each_unit(d.C, [&](int64_t i, int, int n) {
      const V delta = load<T>(f.delta + i), mean = P::constant(f.mean, n);
      const V raw = fma(P::constant(weight, n), delta, P::constant(bias, n));
      const V gamma = exp_(raw < T(0) ? splat(0) : -raw);
      V to_raw = -gamma * load<T>(k.to_values + i) * (load<T>(f.last + i) - mean);
      to_raw = raw >= T(0) ? to_raw : splat(0);
      to_raw = load<T>(f.mask + i) != T(0) ? splat(0) : to_raw;
      store<T>(to_weight + n * VW, load<T>(to_weight + n * VW) + to_raw * delta);
      store<T>(to_bias + n * VW, load<T>(to_bias + n * VW) + to_raw);
    });
  }
}

template <class P>
static NOINLINE void along_trend_backward(Back<P>& k, const Steps<P>& p, bool whole, T* g,
                                          const T* slopes, const T* stopped) {
  const Context<P>& c = k.c;
  const int A = c.map.d.A;
  T* gv = g + int64_t(A) * P::W;
  T* to_damping = k.sums + c.map.trend_sum;
  P::each_unit(A, [&](int64_t i, int lane, int n) {
    const Motion m = motion_of<P>(c, p, whole, lane, n);
    const V v = load<T>(slopes + i), to_v = load<T>(gv + i);
    V to_moved = load<T>(g + i);
    if (c.s.bounded) {
      const V kind = load<T>(stopped + i), all = to_moved;
      to_moved = kind > T(0) ? all : splat(0);
      store<T>(g + i, kind != T(0) ? all : splat(0));
    }
    const V span = load<T>(p.span + lane);
    T* own = to_damping + n * VW;
    store<T>(own, load<T>(own) - v * (to_v * span * m.kept + to_moved * m.bend));
    store<T>(gv + i, fma(m.reach, to_moved, m.kept * to_v));
  });
}

template <class P>
static NOINLINE void runge_kutta_backward(Back<P>& k, const T* span, T* g, const T* stages,
                                          const T* limited, T* kept) {
  const Context<P>& c = k.c;
  const Spec& s = c.s;
  const Layout<P>& l = c.l;
  constexpr int W = P::W;
  const int driven = c.map.d.D;
  const int64_t size = int64_t(driven) * W;
  T* to_stage = k.stage_gradients;
  const T* moved = g;  // the gradient of the step
  if (s.bounded) {
    T* own = to_stage + s.stages * size;
    P::each(driven, [&](int64_t i, int) {
      const V kind = load<T>(limited + i), all = load<T>(g + i);
      store<T>(own + i, kind > T(0) ? all : splat(0));
      store<T>(g + i, kind != T(0) ? all : splat(0));
    });
    moved = own;
  }
  for (int j = s.stages - 1; j >= 0; --j) {
    T* own = kept + int64_t(j) * k.places.field_size * W;
    T* to_slope = own + int64_t(k.places.field_size - driven) * W;
    P::each(driven, [&](int64_t i, int lane) {
      V sum = T(s.b[j]) * load<T>(moved + i);
      for (int q = j + 1; q < s.stages; ++q)
        if (s.a[q][j] != 0) sum = fma(splat(T(s.a[q][j])), load<T>(to_stage + q * size + i), sum);
      store<T>(to_slope + i, sum * load<T>(span + lane));
    });
    const T* stage = stages + int64_t(j) * l.stage_size * W;
    evaluate_backward<P>(k, s.field, M_FIELD, l.field_net, stage, stage + l.network * W, own,
                         to_stage + j * size);
    if (s.bounded)
      P::each_unit(driven, [&](int64_t i, int, int n) {
        T* own_stage = to_stage + j * size + i;
        store<T>(own_stage, load<T>(own_stage) * inside(load<T>(stage + i), P::constant(c.low, n),
                                                        P::constant(c.high, n)));
      });
  }
  P::each(driven, [&](int64_t i, int) {
    V sum = load<T>(g + i);
    for (int j = 0; j < s.stages; ++j) sum += load<T>(to_stage + j * size + i);
    store<T>(g + i, sum);
  });
}

// Asks for memory that is needed soon: the tape of a whole batch is larger than the inner caches.
static NOINLINE void prefetch(const T* p, int64_t n) {
  for (int64_t i = 0; i < n; i += 64 / int(sizeof(T))) __builtin_prefetch(p + i, 0, 2);
}

static int64_t backward_scratch(const Spec& s, int max_steps, int group) {
  using P = Many<2>;
  const Map p = map(s);
  const Dims& d = p.d;
  const int64_t per_row = tape_row(s, max_steps, 2) + row_inputs_size(d, P::W) +
                          int64_t(gradient_layout(s, d, max_steps).size) * P::W;
  return per_row * group + work_size<P>(s) + int64_t(widest<P>(s)) * P::W + int64_t(d.S) * P::W +
         int64_t(d.H + (d.C > d.H ? d.C : d.H) + d.D * (s.stages + 1) + d.S) * P::W +
         range_size(s, d) + outer_scratch(p, P::W) + 64;
}

template <class P>
static void block_backward(const Job<T>& job, const Block& b, int begin, int end, T* g, T* sums,
                           T* scratch) {
  const Spec& s = *job.spec;
  const Map p = map(s);
  const Dims& d = p.d;
  const GradientLayout places = gradient_layout(s, d, job.max_steps);
  T* at = scratch;
  auto take = [&](int64_t n) {
    T* here = at;
    at += n;
    return here;
  };
  const int64_t W = P::W;
  T* state = take(d.S * W);
  T* work = take(work_size<P>(s));
  const Context<P> c = context<P>(job, b, p, work, take(range_size(s, d)));
  const int64_t row_size = c.l.size * W, slot_size = int64_t(places.size) * W;
  const int64_t inputs_size = row_inputs_size(d, P::W);
  Pairs pairs;
  T* z = take((widest<P>(s) + d.H) * W);  // the gradient of the applied exponent follows it
  T* to_values = take((d.C > d.H ? d.C : d.H) * W);
  T* stage_gradients = take(int64_t(d.D) * (s.stages + 1) * W);
  T* to_node = take(d.S * W);
  T* xt = take(outer_scratch(p, P::W));
  Back<P> k{c, places, pairs, sums, xt, z, to_values, stage_gradients, to_node};
  T* lanes = take(inputs_size * job.group);
  T* gradients = take(slot_size * job.group);
  T* own = job.tape ? nullptr : take(row_size * job.group);

  if (end >= b.rows) {
    end = b.rows;
    zero(g, d.S * W);
    for (int64_t row = job.n_rows - 1; row >= b.rows; --row) {
      collect<P>(job, b, job.to_after, int(row), d.S, true, g);
      collect<P>(job, b, job.to_before, int(row), d.S, true, g);
    }
  }
  RowInputs<P> f[MAX_GROUP];
  for (int last = end; last > begin; last -= job.group) {
    const int first = last - begin > job.group ? last - job.group : begin;
    if (!job.tape) {
      if (first)
        collect<P>(job, b, job.after, first - 1, d.S, false, state);
      else
        first_state<P>(job, b, state);
    }
    for (int row = first; row < last; ++row) {
      f[row - first] = row_inputs<P>(d, lanes + (row - first) * inputs_size);
      gather<P>(job, d, b, row, f[row - first], -job.group);
      if (!job.tape) row_forward<P>(c, f[row - first], state, own + (row - first) * row_size);
    }
    for (int row = last - 1; row >= first; --row) {
      const T* tape =
          job.tape ? job.tape + b.tape + row * row_size : own + (row - first) * row_size;
      if (job.tape && row) prefetch(tape - row_size, row_size);
      collect<P>(job, b, job.to_after, row, d.S, true, g);
      row_backward<P>(k, f[row - first], tape, gradients + (row - first) * slot_size, g, job, b,
                      row);
    }
    flush(p, pairs, P::W, b.lanes, sums, xt);
  }
  if (job.to_state && begin == 0) {
    Grid<T> grid{job.to_state, d.S, 0};
    scatter<P>(job, b, grid, 0, g, d.S);
  }
}

static int64_t state_gradient_size(const Spec& s) { return int64_t(dims(s).S) * 2 * VW; }

static void backward(const Job<T>& job, int slot, int begin, int end, T* scratch) {
  const int64_t size = sums_size(*job.spec);
  T* sums = job.sums + slot * size;
  if (end >= job.blocks[job.slots[slot].first].rows) zero(sums, size);
  for (int i = job.slots[slot].first; i < job.slots[slot].last; ++i) {
    const Block& b = job.blocks[i];
    T* g = job.state_gradients + i * state_gradient_size(*job.spec);
    if (b.vectors == 2)
      block_backward<Many<2>>(job, b, begin, end, g, sums, scratch);
    else
      block_backward<Many<1>>(job, b, begin, end, g, sums, scratch);
  }
}
