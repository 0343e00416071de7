// A perceptron over many rows: part of module.cpp.

template <class T>
PerceptronJob<T> perceptron_job(const Perceptron& shape, const Const<T>& weights,
                                const Const<T>& x) {
  check_shape("weights", weights, {perceptron_flat(shape)});
  if (x.ndim() != 2) refuse("x has shape " + shape_of(x) + ", expected (rows, inputs)");
  in_range("the number of rows", int64_t(x.shape(0)), 0, MAX_COUNT);
  check_shape("x", x, {int64_t(x.shape(0)), shape.sizes[0]});
  PerceptronJob<T> job;
  job.shape = &shape;
  job.x = x.data(), job.n = int64_t(x.shape(0)), job.x_stride = x.stride(0);
  return job;
}

template <class T>
int64_t perceptron_tape(const Perceptron& shape, const InstructionSet& set, int64_t rows) {
  const Kernels<T>& kernels = typed<T>(set);
  const int64_t w = 2 * kernels.width;
  in_range("the number of rows", rows, 0, MAX_COUNT);
  return times((rows + w - 1) / w, kernels.perceptron_tape_row(shape));
}

template <class T>
void perceptron_forward(const Perceptron& shape, const InstructionSet& set, const Const<T>& weights,
                        const Const<T>& x, Array<T> y, std::optional<Array<T>> tape, int threads) {
  const Kernels<T>& kernels = typed<T>(set);
  PerceptronJob<T> job = perceptron_job<T>(shape, weights, x);
  check_shape("y", y, {job.n, shape.sizes[shape.layers]});
  check_contiguous("y", y);
  job.y = y.data();
  if (tape) {
    check_shape("tape", *tape, {perceptron_tape<T>(shape, set, job.n)});
    job.tape = tape->data();
  }
  nb::gil_scoped_release unlocked;
  const Buffer<T> panels("the packed weights", kernels.perceptron_packed_size(shape));
  kernels.perceptron_pack(shape, weights.data(), panels.get());
  job.packed = panels.get();
  const int64_t w = 2 * kernels.width, blocks = (job.n + w - 1) / w, batch = 16;
  spread<T>((blocks + batch - 1) / batch, threads, kernels.perceptron_scratch(shape),
            [&](int64_t task, T* scratch) {
              for (int64_t b = task * batch; b < std::min(blocks, (task + 1) * batch); ++b)
                kernels.perceptron_forward(job, b, scratch);
            });
}

// The backward pass of a job, spread over threads.
template <class T>
void perceptron_gradients(PerceptronJob<T>& job, const Kernels<T>& kernels, const T* weights,
                          T* flat, int threads) {
  const Perceptron& shape = *job.shape;
  const Buffer<T> panels("the packed weights", kernels.perceptron_packed_size(shape));
  kernels.perceptron_pack(shape, weights, panels.get());
  job.packed = panels.get();
  const int64_t w = 2 * kernels.width, blocks = (job.n + w - 1) / w;
  job.slots = int(std::clamp<int64_t>(blocks / 32, 1, 16));
  const Buffer<T> sums("the gradient of the weights",
                       times(job.slots, kernels.perceptron_sums(shape)));
  job.sums = sums.get();
  spread<T>(job.slots, threads, kernels.perceptron_scratch(shape), [&](int64_t slot, T* scratch) {
    kernels.perceptron_backward(job, int(slot), scratch);
  });
  kernels.perceptron_reduce(shape, sums.get(), job.slots, flat);
}

template <class T>
void perceptron_backward(const Perceptron& shape, const InstructionSet& set,
                         const Const<T>& weights, const Const<T>& x, const Const<T>& tape,
                         const Const<T>& to_y, Array<T> to_weights, std::optional<Array<T>> to_x,
                         int threads) {
  const Kernels<T>& kernels = typed<T>(set);
  PerceptronJob<T> job = perceptron_job<T>(shape, weights, x);
  check_shape("tape", tape, {perceptron_tape<T>(shape, set, job.n)});
  check_shape("to_y", to_y, {job.n, shape.sizes[shape.layers]});
  check_contiguous("to_y", to_y);
  check_shape("to_weights", to_weights, {perceptron_flat(shape)});
  if (to_x) {
    check_shape("to_x", *to_x, {job.n, shape.sizes[0]});
    check_contiguous("to_x", *to_x);
    job.to_x = to_x->data();
  }
  job.tape = const_cast<T*>(tape.data());
  job.to_y = to_y.data();
  T* flat = to_weights.data();
  nb::gil_scoped_release unlocked;
  perceptron_gradients<T>(job, kernels, weights.data(), flat, threads);
}

// The targets of the rows after the first of some trajectories.
template <class T>
void check_targets(const Const<T>& targets, const Const<int64_t>& index, int64_t batch,
                   int64_t rows, int64_t out) {
  in_range("the number of trajectories", batch, 1, MAX_COUNT);
  in_range("the number of rows", rows, 2, MAX_COUNT / batch);
  if (targets.ndim() != 3) refuse("targets has shape " + shape_of(targets) + ", expected 3 axes");
  check_shape("targets", targets, {int64_t(targets.shape(0)), int64_t(targets.shape(1)), out});
  in_range("the number of rows of the targets", int64_t(targets.shape(1)), rows - 1, MAX_COUNT);
  check_shape("index", index, {batch});
  for (int64_t i = 0; i < batch; ++i)
    in_range("an entry of index", index.data()[i], 0, int64_t(targets.shape(0)) - 1);
}

// Squared errors of the outputs at the states of trajectories, and their gradients (records.hpp).
template <class T>
void perceptron_squares(const Perceptron& shape, const InstructionSet& set, const Const<T>& weights,
                        const Const<T>& states, const Maybe<T>& first, int64_t column,
                        const Const<T>& targets, const Const<int64_t>& index, double norm,
                        double scale, Array<T> errors, Array<T> to_weights, Array<T> to_states,
                        int threads) {
  if (states.ndim() != 3)
    refuse("states has shape " + shape_of(states) + ", expected (trajectories, rows, units)");
  const int64_t batch = int64_t(states.shape(0)), rows = int64_t(states.shape(1));
  const int64_t width = int64_t(states.shape(2)), out = shape.sizes[shape.layers];
  check_targets<T>(targets, index, batch, rows, out);
  in_range("the first column of the inputs", column, 0, width - shape.sizes[0]);
  check_shape("weights", weights, {perceptron_flat(shape)});
  check_shape("to_weights", to_weights, {perceptron_flat(shape)});
  check_contiguous("states", states);
  check_shape("to_states", to_states, {batch, rows, width});
  check_contiguous("to_states", to_states);
  check_shape("squares", errors, {batch, rows - 1, out});
  check_contiguous("squares", errors);
  if (first) {
    check_shape("first", *first, {batch, width});
    check_contiguous("first", *first);
  }
  Squares<T> squares;
  squares.first = first ? first->data() + column : nullptr, squares.rows = rows;
  squares.targets = targets.data(), squares.index = index.data();
  squares.by_trajectory = targets.stride(0), squares.by_row = targets.stride(1);
  squares.norm = T(norm), squares.scale = T(scale), squares.squares = errors.data();
  PerceptronJob<T> job;
  job.shape = &shape;
  job.x = states.data() + column, job.x_stride = width, job.n = batch * rows;
  job.to_x = to_states.data() + column;
  job.squares = &squares;
  T* flat = to_weights.data();
  nb::gil_scoped_release unlocked;
  perceptron_gradients<T>(job, typed<T>(set), weights.data(), flat, threads);
}

// The same where the first units of a state are the outputs, apart from their unit and zero.
template <class T>
void state_squares(const Const<T>& states, const Const<T>& unit, const Const<T>& zero,
                   const Const<T>& targets, const Const<int64_t>& index, double norm, double scale,
                   Array<T> squares, Array<T> to_states) {
  if (states.ndim() != 3)
    refuse("states has shape " + shape_of(states) + ", expected (trajectories, rows, units)");
  const int64_t batch = int64_t(states.shape(0)), rows = int64_t(states.shape(1));
  const int64_t width = int64_t(states.shape(2));
  if (squares.ndim() != 3) refuse("squares has shape " + shape_of(squares) + ", expected 3 axes");
  const int64_t out = in_range("the number of outputs", int64_t(squares.shape(2)), 0, width);
  check_targets<T>(targets, index, batch, rows, out);
  check_shape("unit", unit, {out});
  check_shape("zero", zero, {out});
  check_contiguous("states", states);
  check_shape("to_states", to_states, {batch, rows, width});
  check_contiguous("to_states", to_states);
  check_shape("squares", squares, {batch, rows - 1, out});
  check_contiguous("squares", squares);
  const T *x = states.data(), *by = unit.data(), *from = zero.data();
  T *to = to_states.data(), *square = squares.data();
  const T a = T(norm), b = T(scale);
  nb::gil_scoped_release unlocked;
  for (int64_t i = 0; i < batch; ++i) {
    const T* target = targets.data() + index.data()[i] * targets.stride(0);
    std::fill(to, to + out, T(0));
    for (int64_t row = 1; row < rows; ++row) {
      x += width, to += width;
      for (int64_t c = 0; c < out; ++c) {
        const T error = (x[c] * by[c] + from[c]) - target[c];
        square[c] = error * error;
        to[c] = a * error * b * by[c];
      }
      square += out, target += targets.stride(1);
    }
    x += width, to += width;
  }
}
