// One row of one trajectory, without a gradient: part of Scan<T> (scan.hpp). It runs the same
// `row_forward` as a batch, with vectors over units in place of lanes.

static int64_t stream_inputs_size(const Dims& d) {
  return ROW_SCALARS * VW + (d.trend ? 6 : 4) * up(d.C, VW) + up(d.time_inputs, VW) +
         2 * up(d.F, VW) + up(d.C, VW);
}
static int64_t stream_scratch(const Spec& s) {
  const Dims d = dims(s);
  const Layout<One> l = layout<One>(s, d, 1);
  return stream_inputs_size(d) + l.state + l.size + work_size<One>(s) + range_size(s, d) + 8 * VW;
}

static void stream_row(const StreamRow<T>& row) {
  const Spec& s = *row.spec;
  const Map p = map(s);
  const Dims& d = p.d;
  T* at = row.scratch;
  auto take = [&](int64_t n) {
    T* here = at;
    at += n;
    return here;
  };
  RowInputs<One> f{};
  for (T** lane : {&f.gap, &f.update, &f.updated, &f.valid, &f.first, &f.node, &f.commit})
    *lane = take(VW);
  for (int i = 0; i < VW; ++i) {
    f.gap[i] = row.gap, f.update[i] = row.update, f.updated[i] = row.updated, f.valid[i] = 1;
    f.first[i] = row.first_node, f.node[i] = row.node, f.commit[i] = row.commit;
  }
  auto padded = [&](const T* from, int n) {
    T* to = take(up(n, VW));
    if (from)
      for (int i = 0; i < up(n, VW); ++i) to[i] = i < n ? from[i] : T(0);
    return to;
  };
  f.values = padded(row.values, d.C);
  f.mask = padded(row.mask, d.C);
  f.time_input = padded(row.time_input, d.time_inputs);
  f.start = padded(row.decay_start, d.F);
  f.end = padded(row.decay_end, d.F);
  f.delta = padded(row.delta, d.C);
  f.last = padded(row.last, d.C);
  f.mean = padded(row.mean, d.C);
  if (d.trend) {
    f.level_gain = padded(row.level_gain, d.C);
    f.slope_gain = padded(row.slope_gain, d.C);
  }
  f.active = d.cell && row.update != 0;
  f.use_prediction = row.use_prediction && s.decoder.layers;

  Layout<One> l = layout<One>(s, d, 1);
  // All steps use the memory of the first. With `step_size` 0, a step finds the exponent that the
  // step before has applied at its own place.
  l.step_size = 0;
  T* state = take(l.state + VW);
  T* tape = take(l.size + VW);
  T* work = take(work_size<One>(s));
  T* limits = take(range_size(s, d));
  range<One>(s, d, row.low, row.high, limits);
  const Context<One> c{s,
                       p,
                       row.packed,
                       row.packed + p.stream - 2 * up(d.C, VW),
                       l,
                       work,
                       1,
                       limits,
                       limits + l.network,
                       trend(s, d, row.packed + p.stream_trend,
                             limits + range_size(s, d) - 3 * up(d.A, VW))};
  const int64_t place[3] = {0, l.h_at, l.c_at}, width[3] = {d.X, d.H, d.lstm ? d.H : 0};
  auto unpadded = [&](const T* from, T* to) {
    for (int k = 0; k < 3; ++k)
      for (int64_t i = 0; i < width[k]; ++i) *to++ = from[place[k] + i];
  };
  zero(state, l.state);
  const T* from = row.state;
  for (int k = 0; k < 3; ++k)
    for (int64_t i = 0; i < width[k]; ++i) state[place[k] + i] = *from++;
  row_forward<One>(c, f, state, tape);
  unpadded(tape + l.before, row.before);
  unpadded(state, row.after);
}

static int64_t stream_perceptron_size(const Perceptron& shape) {
  return perceptron_map(shape).stream;
}
static void stream_perceptron_pack(const Perceptron& shape, const T* flat, T* packed) {
  const Map p = perceptron_map(shape);
  for (int l = 0; l < shape.layers; ++l) stream_pack_matrix(p.m[M_FIELD + l], flat, packed);
}
static int64_t stream_perceptron_scratch(const Perceptron& shape) {
  return net<One>(shape).size + 2 * up(perceptron_widest(shape), VW) + 4 * VW;
}
static void stream_perceptron(const Perceptron& shape, const T* packed, const T* x, T* y,
                              T* scratch) {
  const Map p = perceptron_map(shape);
  Spec s{};
  const Context<One> c{s, p, packed, nullptr, Layout<One>{}, nullptr};
  const int wide = up(perceptron_widest(shape), VW) + VW;
  T* z = scratch;
  T* out = z + wide;
  evaluate<One>(c, shape, M_FIELD, net<One>(shape), x, out + wide, out, z);
  for (int u = 0; u < shape.sizes[shape.layers]; ++u) y[u] = out[u];
}
