// A perceptron over many rows, forward and backward: part of Scan<T> (scan.hpp).

static Map perceptron_map(const Perceptron& shape) {
  Spec s{};
  s.cell = CELL_NONE;
  s.field = shape;
  return map(s);
}
static int64_t perceptron_packed_size(const Perceptron& shape) {
  return perceptron_map(shape).packed;
}
static int64_t perceptron_sums(const Perceptron& shape) { return perceptron_map(shape).sums; }
static void perceptron_pack(const Perceptron& shape, const T* flat, T* packed) {
  const Map p = perceptron_map(shape);
  for (int l = 0; l < shape.layers; ++l) pack_matrix(p.m[M_FIELD + l], flat, packed);
}
static int perceptron_widest(const Perceptron& shape) {
  int n = 0;
  for (int l = 0; l <= shape.layers; ++l)
    if (shape.sizes[l] > n) n = shape.sizes[l];
  return n;
}
static int64_t perceptron_tape_row(const Perceptron& shape) {
  return int64_t(shape.sizes[0] + net<Many<2>>(shape).size) * Many<2>::W;
}
static int64_t perceptron_scratch(const Perceptron& shape) {
  using P = Many<2>;
  int gradients = 0;
  for (int l = 0; l < shape.layers; ++l) gradients += shape.sizes[l + 1];
  const int wide = up(perceptron_widest(shape), VW);
  return perceptron_tape_row(shape) +
         int64_t(PERCEPTRON_GROUP) * (int64_t(gradients) * P::W + perceptron_tape_row(shape)) +
         int64_t(2 * wide) * P::W + outer_scratch(perceptron_map(shape), P::W) + 64;
}
static constexpr int PERCEPTRON_GROUP = 4;

// Rows of a matrix become lanes; lanes beyond the last row are 0.
template <class P>
static void take_rows(const T* x, int64_t stride, int units, int lanes, T* out) {
  const T* rows[P::W];
  for (int lane = 0; lane < P::W; ++lane) rows[lane] = x + (lane < lanes ? lane : 0) * stride;
  lanes_to_units(rows, units, P::W, out);
  for (int lane = lanes; lane < P::W; ++lane)
    for (int u = 0; u < units; ++u) out[int64_t(u) * P::W + lane] = 0;
}
template <class P>
static void give_rows(const T* x, int units, int lanes, T* out, int64_t stride) {
  T* rows[P::W];
  for (int lane = 0; lane < lanes; ++lane) rows[lane] = out + lane * stride;
  units_to_lanes(x, units, lanes, P::W, rows);
}

static void perceptron_forward(const PerceptronJob<T>& job, int64_t block, T* scratch) {
  using P = Many<2>;
  const Perceptron& shape = *job.shape;
  const Map p = perceptron_map(shape);
  Spec s{};
  const Context<P> c{s, p, job.packed, nullptr, Layout<P>{}, nullptr};
  const int64_t first = block * P::W, row_size = perceptron_tape_row(shape);
  T* tape = job.tape ? job.tape + block * row_size : scratch;
  T* z = scratch + row_size;
  T* out = z + int64_t(up(perceptron_widest(shape), VW)) * P::W;
  const int in = shape.sizes[0], n_out = shape.sizes[shape.layers];
  const int lanes = job.n - first < P::W ? int(job.n - first) : P::W;
  take_rows<P>(job.x + first * job.x_stride, job.x_stride, in, lanes, tape);
  evaluate<P>(c, shape, M_FIELD, net<P>(shape), tape, tape + int64_t(in) * P::W, out, z);
  give_rows<P>(out, n_out, lanes, job.y + first * n_out, n_out);
}

// A block of rows whose errors are squared, and the gradient of their outputs.
template <class P>
static void squares_forward(const PerceptronJob<T>& job, const Context<P>& c, const Net& kept,
                            int64_t first, int lanes, T* tape, T* z, T* out, T* to_out) {
  const Perceptron& shape = *job.shape;
  const Squares<T>& q = *job.squares;
  const int in = shape.sizes[0], n_out = shape.sizes[shape.layers];
  const T *x[P::W], *target[P::W];
  T counts[P::W];
  for (int lane = 0; lane < P::W; ++lane) {
    const int64_t i = first + (lane < lanes ? lane : 0), one = i / q.rows, row = i % q.rows;
    counts[lane] = T(lane < lanes && row);
    target[lane] = q.targets + q.index[one] * q.by_trajectory + (row ? row - 1 : 0) * q.by_row;
    x[lane] = !q.first ? job.x + i * job.x_stride
              : row    ? job.x + (i - 1) * job.x_stride
                       : q.first + one * job.x_stride;
  }
  lanes_to_units(x, in, P::W, tape);
  for (int lane = lanes; lane < P::W; ++lane)
    for (int u = 0; u < in; ++u) tape[int64_t(u) * P::W + lane] = 0;
  evaluate<P>(c, shape, M_FIELD, kept, tape, tape + int64_t(in) * P::W, out, z);
  lanes_to_units(target, n_out, P::W, to_out);
  P::each(n_out, [&](int64_t i, int lane) {
    const V error = load<T>(out + i) - load<T>(to_out + i), to = q.norm * error * q.scale;
    store<T>(out + i, error * error);
    store<T>(to_out + i, load<T>(counts + lane) != T(0) ? to : splat(0));
  });
  T* squares[P::W];
  for (int lane = 0; lane < lanes; ++lane) {
    const int64_t i = first + lane, row = i % q.rows;
    squares[lane] = row ? q.squares + (i - i / q.rows - 1) * n_out : z;  // `z` is not read
  }
  units_to_lanes(out, n_out, lanes, P::W, squares);
}
// The gradient of their inputs. That of the first state is not needed.
template <class P>
static void squares_backward(const PerceptronJob<T>& job, int64_t first, int lanes, const T* to_x,
                             T* unused) {
  const Squares<T>& q = *job.squares;
  T* to[P::W];
  for (int lane = 0; lane < lanes; ++lane) {
    const int64_t i = first + lane;
    to[lane] = !q.first     ? job.to_x + i * job.x_stride
               : i % q.rows ? job.to_x + (i - 1) * job.x_stride
                            : unused;
  }
  units_to_lanes(to_x, job.shape->sizes[0], lanes, P::W, to);
}

static void perceptron_backward(const PerceptronJob<T>& job, int slot, T* scratch) {
  using P = Many<2>;
  const Perceptron& shape = *job.shape;
  const Map p = perceptron_map(shape);
  Spec s{};
  const Context<P> c{s, p, job.packed, nullptr, Layout<P>{}, nullptr};
  const Net kept = net<P>(shape);
  const int64_t row_size = perceptron_tape_row(shape);
  const int in = shape.sizes[0], n_out = shape.sizes[shape.layers];
  const int wide = up(perceptron_widest(shape), VW);
  int gradients = 0;
  for (int l = 0; l < shape.layers; ++l) gradients += shape.sizes[l + 1];
  T* z = scratch;
  T* to_x = z + int64_t(wide) * P::W;
  T* xt = to_x + int64_t(wide) * P::W;
  T* own = xt + outer_scratch(p, P::W);
  T* tapes = own + int64_t(PERCEPTRON_GROUP) * gradients * P::W;
  T* sums = job.sums + slot * p.sums;
  zero(sums, p.sums);
  Pairs pairs;
  Back<P> k{c, GradientLayout{}, pairs, sums, xt, z, nullptr, nullptr, nullptr};
  const int64_t blocks = (job.n + P::W - 1) / P::W;
  const int64_t begin = blocks * slot / job.slots, end = blocks * (slot + 1) / job.slots;
  for (int64_t block = begin; block < end; ++block) {
    const int64_t first = block * P::W;
    const int64_t place = (block - begin) % PERCEPTRON_GROUP;
    T* to_layers = own + place * int64_t(gradients) * P::W;
    T* to_out = to_layers + int64_t(gradients - n_out) * P::W;
    const int lanes = job.n - first < P::W ? int(job.n - first) : P::W;
    T* tape = job.squares ? tapes + place * row_size : job.tape + block * row_size;
    if (job.squares)
      squares_forward<P>(job, c, kept, first, lanes, tape, to_x, z, to_out);
    else
      take_rows<P>(job.to_y + first * n_out, n_out, n_out, lanes, to_out);
    evaluate_backward<P>(k, shape, M_FIELD, kept, tape, tape + int64_t(in) * P::W, to_layers, to_x);
    if (job.squares)
      squares_backward<P>(job, first, lanes, to_x, z);
    else if (job.to_x)
      give_rows<P>(to_x, in, lanes, job.to_x + first * in, in);
    if (place == PERCEPTRON_GROUP - 1 || block + 1 == end)
      flush(p, pairs, P::W, P::W, sums, xt);
  }
}

static void perceptron_reduce(const Perceptron& shape, const T* sums, int n, T* flat) {
  const Map p = perceptron_map(shape);
  zero(flat, p.flat);
  for (int slot = 0; slot < n; ++slot, sums += p.sums)
    for (int l = 0; l < shape.layers; ++l) reduce_matrix(p.m[M_FIELD + l], sums, flat);
}
