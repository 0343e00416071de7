// A batch, forward and backward: part of module.cpp.

// What the forward and the backward pass share.
template <class T>
struct Call {
  Job<T> job;
  std::vector<int32_t> order, length, source;
  std::vector<Block> blocks;
  std::vector<GradientSlot> slots;
  int64_t tape = 0;

  void order_lanes(int64_t batch, int64_t rows, const int64_t* lengths, const int64_t* index) {
    job.batch = batch, job.n_rows = rows;
    order.resize(batch);
    std::iota(order.begin(), order.end(), 0);
    auto of = [&](int32_t i) { return lengths ? std::clamp<int64_t>(lengths[i], 0, rows) : rows; };
    std::stable_sort(order.begin(), order.end(),
                     [&](int32_t i, int32_t j) { return of(i) > of(j); });
    for (int32_t i : order) {
      length.push_back(int32_t(of(i)));
      source.push_back(index ? int32_t(index[i]) : i);
    }
    job.order = order.data(), job.length = length.data(), job.source = source.data();
  }

  void plan(const Spec& s, const Kernels<T>& kernels) {
    job.spec = &s;
    const int64_t batch = job.batch;
    const int w = kernels.width;
    for (int64_t at = 0; at < batch;) {
      Block b;
      b.first = int(at);
      b.vectors = batch - at > w ? 2 : 1;
      b.lanes = int(std::min<int64_t>(batch - at, int64_t(b.vectors) * w));
      b.rows = length[at];
      b.tape = tape;
      tape = plus(tape, times(b.rows, kernels.tape_row(s, job.max_steps, b.vectors)));
      blocks.push_back(b);
      at += b.lanes;
    }
    // Weight gradients: one slot per block, or per several consecutive blocks.
    const int n = int(blocks.size()), most = 64;
    const int count = std::min(n, most);
    for (int i = 0; i < count; ++i)
      slots.push_back({int(int64_t(n) * i / count), int(int64_t(n) * (i + 1) / count)});
    job.blocks = blocks.data(), job.slots = slots.data();
  }

  // Rows of a chunk: a sixteenth of all rows, in whole groups.
  int chunk() const {
    const int rows = std::max(1, int(job.n_rows) / 16);
    return (rows + job.group - 1) / job.group * job.group;
  }
};

// Steps of the solver over the longest gap; gaps after the last row of a trajectory do not count.
template <class T>
int most_steps(const Spec& s, const Call<T>& call) {
  const InputPointers<T>& in = call.job.inputs;
  if (s.nodes) {
    // A block takes the most steps of its lanes, and one more if any of them needs it.
    int whole = 0, read = s.field.layers ? 0 : 1;
    for (size_t i = 0; i < call.source.size(); ++i)
      for (int64_t row = 0; row < call.length[i]; ++row) {
        auto at = [&](const Quantity<T>& q) {
          return q.data[call.source[i] * q.by_lane + row * q.by_row];
        };
        whole = std::max(whole, steps_to_node(at(in.first_node), at(in.node)));
        if (at(in.gap) > 0 || s.decay_features) read = 1;
      }
    return std::max(1, std::min(whole, TRACKED_NODES + 1) + read);
  }
  const Quantity<T>& gap = in.gap;
  T longest = 0;
  if (s.max_step > 0 && s.field.layers)
    for (size_t i = 0; i < call.source.size(); ++i)
      for (int64_t row = 0; row < call.length[i]; ++row)
        longest = std::max(longest, gap.data[call.source[i] * gap.by_lane + row * gap.by_row]);
  return steps_of_gap(s, longest);
}

template <class T>
Call<T> prepare(const Spec& s, const Kernels<T>& kernels, const StepInputs<T>& f,
                const Const<T>& state) {
  const int64_t batch = state.ndim() ? int64_t(state.shape(0)) : 0;
  check_shape("state", state, {batch, state_of(s)});
  check_contiguous("state", state);
  in_range("the number of trajectories", batch, 1, MAX_COUNT);
  in_range("the number of rows", f.rows, 1, MAX_COUNT);
  if (f.table) f.check_table(batch);
  Call<T> call;
  take_rows(call.job, s, f, batch);
  const int64_t* lengths = nullptr;
  if (f.length) {
    check_shape("length", *f.length, {batch});
    lengths = f.length->data();
  }
  call.job.state = state.data();
  call.order_lanes(batch, f.rows, lengths, f.index ? f.index->data() : nullptr);
  call.job.max_steps = most_steps(s, call);
  call.plan(s, kernels);
  // Rows whose weight gradients are added together: about 64 lanes of evaluations of the vector
  // field, whose activations and gradients stay in the cache; without one, eight rows. Sums that
  // do not stay in the cache move through it less often with four times as many.
  const int64_t steps = s.field.layers ? s.stages * call.job.max_steps : 1;
  const int64_t lanes = s.field.layers ? 2 * kernels.width : 8;
  const bool large = kernels.sums_size(s) * int64_t(sizeof(T)) > (1 << 20);
  call.job.group = int(std::clamp<int64_t>((large ? 256 : 64) / (steps * lanes), 1, MAX_GROUP));
  return call;
}

template <class T>
std::unique_ptr<Buffer<T>> packed(const Spec& s, const Kernels<T>& kernels,
                                  const Const<T>& weights) {
  check_shape("weights", weights, {flat_size(s)});
  auto buffer = std::make_unique<Buffer<T>>("the packed weights", kernels.packed_size(s));
  kernels.pack(s, weights.data(), buffer->get());
  return buffer;
}

template <class T>
int64_t tape_size(const Spec& s, const InstructionSet& set, const StepInputs<T>& f,
                  const Const<T>& state) {
  return prepare<T>(s, typed<T>(set), f, state).tape;
}

template <class T>
void scan_forward(const Spec& s, const InstructionSet& set, const Const<T>& weights,
                  const StepInputs<T>& f, const Const<T>& state, Array<T> before, Array<T> after,
                  std::optional<Array<T>> tape, int threads) {
  const Kernels<T>& kernels = typed<T>(set);
  Call<T> call = prepare<T>(s, kernels, f, state);
  Job<T>& job = call.job;
  const int width = state_of(s);
  job.before = grid<T>("before", std::optional<Array<T>>(before), job.batch, job.n_rows, width);
  job.after = grid<T>("after", std::optional<Array<T>>(after), job.batch, job.n_rows, width);
  if (tape) {
    check_shape("tape", *tape, {call.tape});
    job.tape = tape->data();
  }
  nb::gil_scoped_release unlocked;
  const auto weight = packed<T>(s, kernels, weights);
  job.packed = weight->get();
  std::vector<BlockRun> runs;
  for (const Block& b : call.blocks) runs.push_back({b.rows, b.vectors});
  run_chunks<T>(runs, call.chunk(), threads, kernels.forward_scratch(s, job.max_steps),
                [&](int block, int begin, int end, T* scratch) {
                  kernels.forward(job, block, begin, end, scratch);
                });
}

template <class T>
void scan_backward(const Spec& s, const InstructionSet& set, const Const<T>& weights,
                   const StepInputs<T>& f, const Const<T>& state, const Const<T>& after,
                   std::optional<Const<T>> tape, std::optional<Const<T>> to_before,
                   std::optional<Const<T>> to_after, Array<T> to_weights, Array<T> to_state,
                   int threads, int group) {
  const Kernels<T>& kernels = typed<T>(set);
  Call<T> call = prepare<T>(s, kernels, f, state);
  Job<T>& job = call.job;
  if (group > 0) job.group = std::min(group, MAX_GROUP);
  const int width = state_of(s);
  job.after = grid<T>("after", std::optional<Const<T>>(after), job.batch, job.n_rows, width);
  job.to_before = grid<T>("to_before", to_before, job.batch, job.n_rows, width);
  job.to_after = grid<T>("to_after", to_after, job.batch, job.n_rows, width);
  check_shape("to_weights", to_weights, {flat_size(s)});
  check_shape("to_state", to_state, {job.batch, width});
  check_contiguous("to_state", to_state);
  job.to_state = to_state.data();
  if (tape) {
    check_shape("tape", *tape, {call.tape});
    job.tape = const_cast<T*>(tape->data());
  }
  T* flat = to_weights.data();
  nb::gil_scoped_release unlocked;
  const auto weight = packed<T>(s, kernels, weights);
  job.packed = weight->get();
  const Buffer<T> sums("the gradient of the weights",
                       times(int64_t(call.slots.size()), kernels.sums_size(s)));
  job.sums = sums.get();
  const Buffer<T> state_gradients(
      "the gradient of the states",
      times(int64_t(call.blocks.size()), kernels.state_gradient_size(s)));
  job.state_gradients = state_gradients.get();
  std::vector<BlockRun> runs;
  for (const GradientSlot& slot : call.slots) {
    const Block& b = call.blocks[slot.first];
    runs.push_back({b.rows, b.vectors});
  }
  const bool whole = call.slots.size() < call.blocks.size();
  run_chunks<T>(runs, whole ? int(job.n_rows) : call.chunk(), threads,
                kernels.backward_scratch(s, job.max_steps, job.group),
                [&](int slot, int begin, int end, T* scratch) {
                  const int rows = runs[slot].rows;
                  kernels.backward(job, slot, rows - end, rows - begin, scratch);
                });
  kernels.reduce(s, sums.get(), int(call.slots.size()), flat);
}
