// The forward pass of a block: part of Scan<T> (scan.hpp).

template <class P>
static NOINLINE void evaluate(const Context<P>& c, const Perceptron& shape, int first, const Net& n,
                              const T* x, T* kept, T* out, T* z) {
  for (int l = 0; l < shape.layers; ++l) {
    const Matrix& m = c.map.m[first + l];
    const bool last = l == shape.layers - 1;
    P::template affine<false>(m, c.packed, c.lanes, x, last ? out : z);
    if (last) break;
    T* value = kept + n.value[l] * P::W;
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

// The exponent of a decay at a step of the solver: applied before the step, reached at its end, and
// the fraction of the gap at its end.
struct Exponent {
  V before, reached, fraction;
};
static INLINE Exponent exponent(const Spec& s, int step, bool one_shot, V first, V last, V updated,
                                const T* steps, const T* previous) {
  Exponent e{splat(0), last, splat(1)};
  if (step)
    e.before = load<T>(previous);
  else if (s.decay_rows == CONTINUOUS)
    e.before = updated != T(0) ? splat(0) : clip(first);
  if (!one_shot) {
    e.fraction = T(step + 1) / load<T>(steps);
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
  T* memory = state + l.c_at * W;
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
  const bool one_shot = !s.field.layers || (s.steps == 1 && s.max_step == 0);
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
  T steps[P::ONE ? VW : W], span[P::ONE ? VW : W];
  const int most = s.field.layers ? steps_of<P>(s, f.gap, steps) : 1;
  for (int k = 0; k < most; ++k) {
    T* step = at(l.step) + int64_t(k) * l.step_size * W;
    if (d.F) {
      T* applied = step + l.applied * W;
      T* factor = step + l.factor * W;
      T* arrived = step + l.arrived * W;
      const T* previous = applied - l.step_size * W;
      P::each(d.H, [&](int64_t i, int lane) {
        const V first = load<T>(start + i), last = load<T>(end + i);
        const V updated = load<T>(f.updated + lane);
        const Exponent e =
            exponent(s, k, one_shot, first, last, updated, steps + lane, previous + i);
        V growth = clip(e.reached) - e.before;
        if (s.field.layers) growth = growth < T(0) ? splat(0) : growth;
        const V gamma = exp_(-growth), before = load<T>(h + i);
        store<T>(arrived + i, before);
        store<T>(factor + i, gamma);
        store<T>(h + i, before * gamma);
        const V bounded = clip(e.reached);
        store<T>(applied + i, bounded > e.before ? bounded : e.before);
      });
    }
    if (!s.field.layers) break;
    for (int i = 0; i < (P::ONE ? VW : W); ++i)
      span[i] = T(k) < steps[i] ? f.gap[i] / steps[i] : T(0);
    runge_kutta<P>(c, span, state, step + l.stage * W, z);
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
  cell_forward<P>(c, f, h, memory, gate, at(l.inner));
}

template <class P>
static INLINE void copy(int units, const T* from, T* to) {
  P::each(units, [&](int64_t i, int) { store<T>(to + i, load<T>(from + i)); });
}

// One step of the solver, of length `span` in each lane. The tape keeps the stages and their
// layers.
template <class P>
static NOINLINE void runge_kutta(const Context<P>& c, const T* span, T* state, T* stages, T* z) {
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
    evaluate<P>(c, s.field, M_FIELD, l.field_net, stage, stage + l.network * W, slopes + j * size,
                z);
  }
  P::each(driven, [&](int64_t i, int lane) {
    V sum = splat(0);
    for (int q = 0; q < s.stages; ++q)
      if (s.b[q] != 0) sum = fma(splat(T(s.b[q])), load<T>(slopes + q * size + i), sum);
    store<T>(state + i, fma(load<T>(span + lane), sum, load<T>(state + i)));
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
static NOINLINE void collect(const Job<T>& job, const Block& b, const Grid<T>& grid, int row,
                             int units, bool add, T* out) {
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
  return int64_t(d.S) * P::W + row_inputs_size(d, P::W) + work_size<P>(s) +
         tape_row(s, max_steps, 2) + 64;
}

template <class P>
static Context<P> context(const Job<T>& job, const Block& b, const Map& map, T* work) {
  return Context<P>{*job.spec,
                    map,
                    job.packed,
                    job.packed + map.packed_vectors,
                    layout<P>(*job.spec, map.d, job.max_steps),
                    work,
                    b.lanes};
}

template <class P>
static void block_forward(const Job<T>& job, const Block& b, int begin, int end, T* scratch) {
  const Map p = map(*job.spec);
  const Dims& d = p.d;
  T* state = scratch;
  T* lanes = state + int64_t(d.S) * P::W;
  T* work = lanes + row_inputs_size(d, P::W);
  T* own = work + work_size<P>(*job.spec);
  const Context<P> c = context<P>(job, b, p, work);
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
