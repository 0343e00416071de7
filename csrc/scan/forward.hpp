// The forward pass of a block: part of Scan<T> (scan.hpp).

template <class P>
static NOINLINE void evaluate(const Context<P>& c, const Perceptron& shape, int first, const Net& n,
                              const T* x, T* kept, T* out, T* z) {
  for (int l = 0; l < shape.layers; ++l) {
    const Matrix& m = c.map.m[first + l];
    const bool last = l == shape.layers - 1;
    T* value = kept + n.value[l] * P::W;
    if constexpr (!P::ONE)
      if (!last && shape.activation == TANH) {
        P::tanh_affine(m, c.packed, c.lanes, x, value);
        x = value;
        continue;
      }
    P::template affine<false>(m, c.packed, c.lanes, x, last ? out : z);
    if (last) break;
    activate<P>(shape.activation, shape.sizes[l + 1], z, value, kept + n.slope[l] * P::W);
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

// The steps of one row. Without nodes, `whole` steps divide the gap. With nodes, `whole` steps lead
// to the last node, and one more reads the row where `read` is set. Lanes end at the same step.
// The last TRACKED_NODES steps have a gradient and places of their own on the tape; those before
// share the place 0.
template <class P>
struct Steps {
  static constexpr int N = P::ONE ? VW : P::W;
  int whole = 1, read = 0, untracked = 0;
  T count[N];     // without nodes: steps of each lane
  T span[N];      // length of the current step
  T fraction[N];  // of the time between the inputs of the decay, at the end of the step
  T active[N];    // with nodes: 0 where a lane has taken its steps
  T first[N];     // with nodes: the fraction at the first node
  T later[N];     // with nodes: how many steps a lane begins later than the first one
  int64_t place(int step) const {
    return !untracked ? step : step < untracked ? 0 : step - untracked + 1;
  }
  // A lane has steps without a gradient.
  bool cut(int lane) const { return T(untracked) > later[lane]; }
};
template <class P>
static Steps<P> steps_to_row(const Spec& s, const RowInputs<P>& f) {
  Steps<P> p;
  if (!s.nodes) {
    if (s.field.layers) p.whole = steps_of<P>(s, f.gap, p.count);
    return p;  // a trend without a field is exact over the whole gap
  }
  p.whole = 0;
  for (int i = 0; i < Steps<P>::N; ++i) {
    const int whole = int(f.node[i]) - int(f.first[i]);
    if (whole > p.whole) p.whole = whole;
    const bool fresh = s.decay_features && f.node[i] == 0 && f.updated[i] != 0;
    if (f.gap[i] > 0 || fresh) p.read = 1;
    p.first[i] = f.first[i] * T(s.max_step) / T(s.decay_span);
    p.later[i] = T(whole);
  }
  for (int i = 0; i < Steps<P>::N; ++i) p.later[i] = T(p.whole) - p.later[i];
  if (p.whole > TRACKED_NODES) p.untracked = p.whole - TRACKED_NODES;
  return p;
}
template <class P>
static void set_step(const Spec& s, const RowInputs<P>& f, int k, Steps<P>& p) {
  for (int i = 0; i < Steps<P>::N; ++i) {
    if (!s.nodes) {
      if (s.field.layers)
        p.span[i] = T(k) < p.count[i] ? f.gap[i] / p.count[i] : T(0);
      else
        p.span[i] = f.gap[i];
      continue;
    }
    const bool read = k == p.whole;
    const T node = read ? f.node[i] : f.first[i] + (T(k + 1) - p.later[i]);
    p.active[i] = read || T(k) >= p.later[i];
    p.span[i] = read ? f.gap[i] : p.active[i] * T(s.max_step);
    p.fraction[i] = (node * T(s.max_step) + (read ? f.gap[i] : T(0))) / T(s.decay_span);
  }
}

// The exponent of a decay at a step of the solver: applied before the step, reached at its end, and
// the fraction of the time between the inputs of the decay at its end. At the first step `before`
// is the exponent at the fraction `began`, or 0 where `fresh` is 1.
struct Exponent {
  V before, reached, fraction, began, fresh;
};
template <class P>
static INLINE Exponent exponent(const Spec& s, int step, bool one_shot, V first, V last, V updated,
                                const Steps<P>& p, int lane, V node, const T* previous) {
  Exponent e{splat(0), last, splat(1), splat(0), splat(1)};
  const V on = updated != T(0) ? splat(1) : splat(0);
  if (s.nodes) {
    e.fresh = node == T(0) ? on : splat(0);
    const V one = on * (T(s.max_step) / T(s.decay_span));
    const V along = last >= first ? load<T>(p.first + lane) : one;
    e.began = node > T(0) ? along : splat(0);
  } else if (s.decay_rows == CONTINUOUS) {
    e.fresh = on;
  }
  if (step)
    e.before = load<T>(previous);
  else
    e.before =
        e.fresh != T(0) ? splat(0) : clip(s.nodes ? fma(e.began, last - first, first) : first);
  if (s.nodes) {
    e.fraction = load<T>(p.fraction + lane);
    e.reached = fma(e.fraction, last - first, first);
  } else if (!one_shot) {
    e.fraction = T(step + 1) / load<T>(p.count + lane);
    e.fraction = e.fraction > T(1) ? splat(1) : e.fraction;
    e.reached = fma(e.fraction, last - first, first);
  }
  return e;
}

template <class P>
static NOINLINE void row_forward(const Context<P>& c, const RowInputs<P>& f, T* state, T* tape) {
  const Spec& s = c.s;
  const Dims& d = c.map.d;
  const Layout<P>& l = c.l;
  constexpr int W = P::W;
  auto at = [&](int64_t units) { return tape + units * W; };
  T* h = state + l.h_at * W;
  T* z = c.work;  // as wide as the widest layer

  // The cell's input: observed values, decayed values, or the decoded state before the gap.
  T* u = at(l.u);
  T* gate = at(l.gate);
  if (f.active) {
    if (f.use_prediction) {
      copy<P>(d.H, h, at(l.h_before));
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
        const V decayed = fma(gamma, load<T>(f.last + i), (1 - gamma) * mean);
        store<T>(u + i, mask != T(0) ? load<T>(f.values + i) : decayed);
      });
    } else if (s.bounded && d.A) {
      P::each_unit(d.C, [&](int64_t i, int, int k) {
        store<T>(u + i,
                 within(load<T>(f.values + i), P::constant(c.low, k), P::constant(c.high, k)));
      });
    } else {
      copy<P>(d.C, f.values, u);
    }
    copy<P>(d.C, f.mask, u + int64_t(d.C) * W);
    copy<P>(d.time_inputs, f.time_input, u + int64_t(2 * d.C) * W);
    P::template affine<false>(c.map.m[M_IN], c.packed, c.lanes, u, gate);
  }

  // Decay and dynamics over the gap.
  T* start = at(l.start);
  T* end = at(l.end);
  const bool one_shot = !s.field.layers || (s.steps == 1 && s.max_step == 0);  // without nodes
  if (d.F) {
    P::template affine<false>(c.map.m[M_DECAY], c.packed, c.lanes, f.start, start);
    P::template affine<false>(c.map.m[M_DECAY], c.packed, c.lanes, f.end, end);
    P::each(d.H, [&](int64_t i, int lane) {
      const V valid = load<T>(f.valid + lane);
      V first = load<T>(start + i) * valid, last = load<T>(end + i) * valid;
      if (s.decay_rows == OBSERVED_ROWS) last = last * load<T>(f.update + lane);
      if (s.decay_rows != CONTINUOUS) first = last;
      store<T>(start + i, first);
      store<T>(end + i, last);
    });
  }
  Steps<P> p = steps_to_row<P>(s, f);
  const int units = P::ONE ? int(l.state) : d.S;
  for (int k = 0; k < p.whole + p.read; ++k) {
    if (s.nodes && k == p.whole) copy<P>(units, state, at(l.node));
    set_step<P>(s, f, k, p);
    T* step = at(l.step) + p.place(k) * l.step_size * W;
    if (d.F) {
      T* applied = step + l.applied * W;
      T* factor = step + l.factor * W;
      T* arrived = step + l.arrived * W;
      const T* previous = p.place(k) ? applied - l.step_size * W : applied;
      P::each(d.H, [&](int64_t i, int lane) {
        const V first = load<T>(start + i), last = load<T>(end + i);
        const V updated = load<T>(f.updated + lane);
        const Exponent e = exponent<P>(s, k, one_shot, first, last, updated, p, lane,
                                       load<T>(f.first + lane), previous + i);
        V growth = clip(e.reached) - e.before;
        if (s.field.layers || s.nodes) growth = growth < T(0) ? splat(0) : growth;
        const V bounded = clip(e.reached);
        V after = bounded > e.before ? bounded : e.before;
        if (s.nodes) {
          const V active = load<T>(p.active + lane);
          growth = active != T(0) ? growth : splat(0);
          after = active != T(0) ? after : e.before;
        }
        const V gamma = exp_(-growth), before = load<T>(h + i);
        store<T>(arrived + i, before);
        store<T>(factor + i, gamma);
        store<T>(h + i, before * gamma);
        store<T>(applied + i, after);
      });
    }
    if (d.trend)
      along_trend<P>(c, p, s.nodes && k < p.whole, state, step + l.slopes * W,
                     step + l.stopped * W);
    if (s.field.layers)
      runge_kutta<P>(c, p.span, state, step + l.stage * W, step + l.limited * W, z);
  }
  if (s.nodes && !p.read) copy<P>(units, state, at(l.node));

  copy<P>(P::ONE ? l.state : d.S, state, at(l.before));
  if (f.active) update<P>(c, f, state, tape);
  if (!s.nodes) return;
  const T* node = at(l.node);
  P::each(units, [&](int64_t i, int lane) {
    const V kept = load<T>(f.commit + lane);
    store<T>(state + i, kept != T(0) ? load<T>(state + i) : load<T>(node + i));
  });
}

// What a step does to a channel: from node to node by constants, else by the step's length.
template <class P>
static INLINE Motion motion_of(const Context<P>& c, const Steps<P>& p, bool whole, int lane,
                               int unit) {
  if (!whole) return motion(P::constant(c.trend.damping, unit), load<T>(p.span + lane));
  const V active = load<T>(p.active + lane), none = splat(0);
  return {active != T(0) ? P::constant(c.trend.kept, unit) : splat(1),
          active != T(0) ? P::constant(c.trend.reach, unit) : none,
          active != T(0) ? P::constant(c.trend.bend, unit) : none};
}

// The damped trend of the anchored channels over a step, which does not leave the range of x. The
// tape keeps the slopes before it, and what became of x, as `limited` of `runge_kutta`.
template <class P>
static NOINLINE void along_trend(const Context<P>& c, const Steps<P>& p, bool whole, T* state,
                                 T* slopes, T* stopped) {
  const Dims& d = c.map.d;
  const Slopes<P> to(d, state, c.work);
  P::each_unit(d.A, [&](int64_t i, int lane, int k) {
    const Motion m = motion_of<P>(c, p, whole, lane, k);
    const V old = load<T>(state + i), v = load<T>(to.v + i);
    V moved = fma(m.reach, v, old);
    store<T>(slopes + i, v);
    if (c.s.bounded)
      store<T>(stopped + i, stop(old, P::constant(c.low, k), P::constant(c.high, k), moved));
    store<T>(to.new_x + i, moved);
    store<T>(to.new_v + i, m.kept * v);
  });
  to.done(d, state);
}
// x and v of a state. In a stream they are next to each other, so whole vectors of new ones are
// stored elsewhere first.
template <class P>
struct Slopes {
  T *v, *new_x, *new_v;
  Slopes(const Dims& d, T* state, T* work)
      : v(state + int64_t(d.A) * P::W),
        new_x(P::ONE ? work : state),
        new_v(P::ONE ? work + P::pad(d.A) : v) {}
  void done(const Dims& d, T* state) const {
    if (!P::ONE) return;
    for (int i = 0; i < d.A; ++i) state[i] = new_x[i], v[i] = new_v[i];
  }
};
// Stops a step where it leaves the range; outside of it, it can only move back. Returns 1 for the
// result of the step, 0 for an end of the range, -1 for the old state, which was outside of it.
static INLINE V stop(V old, V low, V high, V& moved) {
  const V least = old < low ? old : low, most = old > high ? old : high;
  V kind = moved < least ? (old < low ? splat(-1) : splat(0)) : splat(1);
  moved = moved < least ? least : moved;
  kind = moved > most ? (old > high ? splat(-1) : splat(0)) : kind;
  moved = moved > most ? most : moved;
  return kind;
}

// The gain of a level: 1 where the value or the state is out of range.
template <class P>
static INLINE V level_gain(const Context<P>& c, const RowInputs<P>& f, int64_t i, int k, V value,
                           V x, V& outside) {
  const V gain = load<T>(f.level_gain + i);
  const V corrected = gain / fma(1 - gain, P::constant(c.trend.odds, k), gain);
  outside = splat(0);
  if (!c.s.bounded) return corrected;
  const V low = P::constant(c.low, k), high = P::constant(c.high, k);
  outside = within(value, low, high) != value ? splat(1) : splat(0);
  outside = within(x, low, high) != x ? splat(1) : outside;
  outside = load<T>(f.mask + i) != T(0) ? outside : splat(0);
  return outside != T(0) ? splat(1) : corrected;
}

// The observation of a row: anchored channels take the observed values, or with a trend move by
// gains, and the cell acts.
template <class P>
static NOINLINE void update(const Context<P>& c, const RowInputs<P>& f, T* state, T* tape) {
  const Spec& s = c.s;
  const Dims& d = c.map.d;
  const Layout<P>& l = c.l;
  constexpr int W = P::W;
  T* gate = tape + l.gate * W;
  if (d.A) {
    T* e = tape + l.innovation * W;
    P::each_unit(d.A, [&](int64_t i, int, int k) {
      V value = load<T>(f.values + i), x = load<T>(state + i);
      if (s.bounded) {
        const V low = P::constant(c.low, k), high = P::constant(c.high, k);
        value = within(value, low, high), x = within(x, low, high);
      }
      store<T>(e + i, load<T>(f.mask + i) * (value - x));
    });
    P::template affine<true>(c.map.m[M_INNOV], c.packed, c.lanes, e, gate);
    if (d.trend) {
      const Slopes<P> to(d, state, c.work);
      P::each_unit(d.A, [&](int64_t i, int, int k) {
        const V value = load<T>(f.values + i), x = load<T>(state + i);
        V outside;
        const V gain = level_gain<P>(c, f, i, k, value, x, outside);
        const V factor = load<T>(f.slope_gain + i) * P::constant(c.trend.factor, k);
        const V v = fma(factor, load<T>(e + i), load<T>(to.v + i));
        store<T>(to.new_x + i, gain * value + (1 - gain) * x);
        store<T>(to.new_v + i, v);
      });
      to.done(d, state);
    } else {
      P::each(d.A, [&](int64_t i, int) {
        const V m = load<T>(f.mask + i);
        store<T>(state + i, m * load<T>(f.values + i) + (1 - m) * load<T>(state + i));
      });
    }
  }
  cell_forward<P>(c, f, state + l.h_at * W, state + l.c_at * W, gate, tape + l.inner * W);
}

template <class P>
static INLINE void copy(int units, const T* from, T* to) {
  P::each(units, [&](int64_t i, int) { store<T>(to + i, load<T>(from + i)); });
}

// One step of the solver, of length `span` in each lane. The tape keeps the stages and their
// layers. In a bounded scan the field is evaluated within the range of the state, and the step does
// not leave it; `limited` keeps what `stop` returned.
template <class P>
static NOINLINE void runge_kutta(const Context<P>& c, const T* span, T* state, T* stages,
                                 T* limited, T* z) {
  const Spec& s = c.s;
  const Layout<P>& l = c.l;
  constexpr int W = P::W;
  const int driven = P::ONE ? l.network : c.map.d.D;
  T* slopes = c.work + work_slopes<P>(s);
  const int64_t size = l.network * W + (P::ONE ? VW : 0);
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
    if (s.bounded)
      P::each_unit(driven, [&](int64_t i, int, int k) {
        store<T>(stage + i,
                 within(load<T>(stage + i), P::constant(c.low, k), P::constant(c.high, k)));
      });
    evaluate<P>(c, s.field, M_FIELD, l.field_net, stage, stage + l.network * W, slopes + j * size,
                z);
  }
  P::each_unit(driven, [&](int64_t i, int lane, int k) {
    V sum = splat(0);
    for (int q = 0; q < s.stages; ++q)
      if (s.b[q] != 0) sum = fma(splat(T(s.b[q])), load<T>(slopes + q * size + i), sum);
    const V old = load<T>(state + i);
    V moved = fma(load<T>(span + lane), sum, old);
    if (s.bounded)
      store<T>(limited + i, stop(old, P::constant(c.low, k), P::constant(c.high, k), moved));
    store<T>(state + i, moved);
  });
}

template <class P>
static int widest(const Spec& s) {
  const Dims d = dims(s);
  int n = d.G / (d.H ? d.H : 1) * P::pad(d.H);
  for (const Perceptron* p : {&s.field, &s.decoder})
    for (int l = 0; l <= p->layers; ++l)
      if (P::pad(p->sizes[l]) + VW > n) n = P::pad(p->sizes[l]) + VW;
  const int driven = P::pad(d.X) + P::pad(d.H);
  return (n > driven ? n : driven) + VW;
}
template <class P>
static int64_t work_slopes(const Spec& s) {
  return int64_t(widest<P>(s)) * P::W;
}
template <class P>
static int64_t work_size(const Spec& s) {
  const Dims d = dims(s);
  const int64_t slope = int64_t(P::pad(d.X) + P::pad(d.H)) * P::W + VW;
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
static NOINLINE void collect(const Job<T>& job, const Block& b, const Grid<T>& grid, int row,
                             int units, bool add, T* out) {
  if (!grid.data) {
    if (!add) zero(out, int64_t(units) * P::W);
    return;
  }
  const T* lanes[P::W];
  for (int lane = 0; lane < P::W; ++lane)  // lanes that are not in use repeat the first one
    lanes[lane] =
        grid.data + job.order[b.first + (lane < b.lanes ? lane : 0)] * grid.by_lane +
        row * grid.by_row;
  // A few units at a time, which stay in the inner cache.
  constexpr int SOME = 16;
  alignas(64) T found[SOME * P::W];
  for (int u = 0; u < units; u += SOME) {
    const int n = units - u < SOME ? units - u : SOME;
    lanes_to_units(lanes, n, P::W, found);
    for (int64_t i = 0; i < int64_t(n) * P::W; i += VW) {
      const int first = int(i % P::W);
      V x = load<T>(found + i);
      if (first + VW > b.lanes)
        for (int r = 0; r < VW; ++r) x[r] = first + r < b.lanes ? x[r] : T(0);
      T* to = out + int64_t(u) * P::W + i;
      store<T>(to, (add ? load<T>(to) : splat(0)) + x);
    }
    for (const T*& lane : lanes) lane += SOME;
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
  return int64_t(d.S) * P::W + row_inputs_size(d, P::W) + work_size<P>(s) +
         tape_row(s, max_steps, 2) + range_size(s, d) + 64;
}

template <class P>
static Context<P> context(const Job<T>& job, const Block& b, const Map& map, T* work, T* limits) {
  range<P>(*job.spec, map.d, job.inputs.low, job.inputs.high, limits);
  return Context<P>{*job.spec,
                    map,
                    job.packed,
                    job.packed + map.packed_vectors,
                    layout<P>(*job.spec, map.d, job.max_steps),
                    work,
                    b.lanes,
                    limits,
                    limits + P::pad(map.d.X) + P::pad(map.d.H),
                    trend(*job.spec, map.d, job.packed + map.packed_trend,
                          limits + range_size(*job.spec, map.d) - 3 * up(map.d.A, VW))};
}

template <class P>
static void block_forward(const Job<T>& job, const Block& b, int begin, int end, T* scratch) {
  const Map p = map(*job.spec);
  const Dims& d = p.d;
  T* state = scratch;
  T* lanes = state + int64_t(d.S) * P::W;
  T* work = lanes + row_inputs_size(d, P::W);
  T* limits = work + work_size<P>(*job.spec);
  T* own = limits + range_size(*job.spec, d);
  const Context<P> c = context<P>(job, b, p, work, limits);
  RowInputs<P> f = row_inputs<P>(d, lanes);
  const int64_t row_size = c.l.size * P::W;
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
      scatter<P>(job, b, job.before, row, tape + c.l.before * P::W, d.S);
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
