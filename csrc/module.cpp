// The Python module: checks shapes, allocates scratch, spreads blocks over threads, and calls the
// body that this processor can run.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <memory>
#include <mutex>
#include <new>
#include <numeric>
#include <stdexcept>
#include <string>
#include <system_error>
#include <thread>
#include <vector>

#include "scan.hpp"

namespace nb = nanobind;

namespace offbeat {

extern const Bodies body_baseline;
#ifdef OFFBEAT_X86
extern const Bodies body_avx2;
extern const Bodies body_avx512;
#endif

namespace {

// --- which body runs --------------------------------------------------------------------------------

std::vector<const Bodies*> runnable() {
  std::vector<const Bodies*> found;
#ifdef OFFBEAT_X86
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") &&
      __builtin_cpu_supports("avx512dq"))
    found.push_back(&body_avx512);
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) found.push_back(&body_avx2);
#endif
  found.push_back(&body_baseline);
  return found;
}

const std::vector<const Bodies*>& bodies() {
  static const std::vector<const Bodies*> all = runnable();
  return all;
}

const Bodies& body_named(const std::string& name) {
  std::string names;
  for (const Bodies* b : bodies()) {
    if (name == b->name) return *b;
    names += std::string(names.empty() ? "" : ", ") + b->name;
  }
  throw nb::value_error(
      ("no body '" + name + "' runs on this processor; those that do: " + names).c_str());
}

template <class T>
const Body<T>& typed(const Bodies& b);
template <>
const Body<float>& typed(const Bodies& b) {
  return b.f32;
}
template <>
const Body<double>& typed(const Bodies& b) {
  return b.f64;
}

// --- memory and threads -----------------------------------------------------------------------------

template <class T>
class Buffer {  // aligned to a cache line, not initialised
 public:
  explicit Buffer(int64_t n)
      : data_(static_cast<T*>(::operator new(size_t(std::max<int64_t>(n, 1)) * sizeof(T),
                                             std::align_val_t(64)))) {}
  ~Buffer() { ::operator delete(data_, std::align_val_t(64)); }
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  T* get() const { return data_; }

 private:
  T* data_;
};

// Calls work(task, scratch) for each task; which thread takes which does not matter to the result.
template <class T, class Work>
void spread(int64_t tasks, int threads, int64_t scratch, const Work& work) {
  threads = int(std::min<int64_t>(std::max(threads, 1), tasks));
  std::vector<std::unique_ptr<Buffer<T>>> scratches;
  for (int i = 0; i < threads; ++i) scratches.push_back(std::make_unique<Buffer<T>>(scratch));
  std::atomic<int64_t> next{0};
  auto run = [&](int thread) {
    for (int64_t task = next++; task < tasks; task = next++) work(task, scratches[thread]->get());
  };
  std::vector<std::thread> others;
  for (int i = 1; i < threads; ++i) {
    try {
      others.emplace_back(run, i);
    } catch (const std::system_error&) {
      break;  // no more threads to be had: those that run take all tasks
    }
  }
  run(0);
  for (std::thread& t : others) t.join();
}

// A walk over the rows of a block, or of a slot of blocks.
struct Walk {
  int rows, cost;  // of a row
};

// Calls work(walk, begin, end, scratch) until each walk has got from 0 to its last row. With several
// threads it is done in stretches, the walk with most before it first, so that all end together
// although the blocks may not be a multiple of the threads. Which thread takes which stretch does
// not matter to the result.
template <class T, class Work>
void walk(const std::vector<Walk>& walks, int stretch, int threads, int64_t scratch,
          const Work& work) {
  const int64_t n = int64_t(walks.size());
  if (threads < 2 || n < 2 || n > 8 * threads) {
    spread<T>(n, threads, scratch,
              [&](int64_t i, T* memory) { work(int(i), 0, walks[i].rows, memory); });
    return;
  }
  std::mutex mutex;
  std::vector<int> done(n, 0);
  std::vector<bool> taken(n, false);
  spread<T>(std::min<int64_t>(threads, n), threads, scratch, [&](int64_t, T* memory) {
    int mine = -1, begin = 0, end = 0;
    for (;;) {
      {
        std::lock_guard<std::mutex> lock(mutex);
        if (mine >= 0) {
          done[mine] = end;
          taken[mine] = end >= walks[mine].rows;
        }
        int64_t most = -1;
        mine = -1;
        for (int64_t i = 0; i < n; ++i) {
          const int64_t left = int64_t(walks[i].rows - done[i]) * walks[i].cost;
          if (!taken[i] && left > most) most = left, mine = int(i);
        }
        // What is left is in the hands of others, who go on until it is done.
        if (mine < 0) return;
        taken[mine] = true;
        begin = done[mine];
        end = std::min(walks[mine].rows, begin + stretch);
      }
      work(mine, begin, end, memory);
    }
  });
}

// --- arguments --------------------------------------------------------------------------------------

template <class T>
using Array = nb::ndarray<T, nb::device::cpu>;
template <class T>
using Const = nb::ndarray<const T, nb::device::cpu>;
template <class T>
using Maybe = std::optional<Const<T>>;

[[noreturn]] void refuse(const std::string& what) { throw nb::value_error(what.c_str()); }

template <class A>
std::string shape_of(const A& a) {
  std::string text = "(";
  for (size_t i = 0; i < a.ndim(); ++i) text += (i ? ", " : "") + std::to_string(a.shape(i));
  return text + ")";
}

template <class A>
void check_shape(const char* name, const A& a, std::initializer_list<int64_t> shape) {
  bool good = a.ndim() == shape.size();
  std::string wanted;
  size_t i = 0;
  for (int64_t n : shape) {
    if (good && int64_t(a.shape(i)) != n) good = false;
    wanted += (i++ ? ", " : "") + std::to_string(n);
  }
  if (!good) refuse(std::string(name) + " has shape " + shape_of(a) + ", expected (" + wanted + ")");
  if (shape.size() && *(shape.end() - 1) > 1 && a.stride(a.ndim() - 1) != 1)
    refuse(std::string(name) + " must have its last axis contiguous");
}

template <class A>
void check_contiguous(const char* name, const A& a) {
  int64_t stride = 1;
  for (size_t i = a.ndim(); i-- > 0;) {
    if (a.shape(i) > 1 && a.stride(i) != stride)
      refuse(std::string(name) + " must be contiguous");
    stride *= int64_t(a.shape(i));
  }
}

template <class T>
Fact<T> fact(const char* name, const Maybe<T>& a, int64_t batch, int64_t rows, int units) {
  if (!a) return {};
  if (units < 0)
    check_shape(name, *a, {batch, rows});
  else
    check_shape(name, *a, {batch, rows, units});
  return {a->data(), a->stride(0), a->stride(1)};
}
template <class T>
Fact<T> needed(const char* name, const Maybe<T>& a, int64_t batch, int64_t rows, int units) {
  if (!a) refuse(std::string(name) + " is missing; this scan needs it");
  return fact(name, a, batch, rows, units);
}

template <class T, class A>
Grid<T> grid(const char* name, const std::optional<A>& a, int64_t batch, int64_t rows, int units) {
  if (!a) return {};
  check_shape(name, *a, {batch, rows, units});
  return {const_cast<T*>(a->data()), a->stride(0), a->stride(1)};
}

int gates_of(const Spec& s) {
  const int factor[] = {0, 1, 1, 4, 3};
  return factor[s.cell] * s.hidden;
}
int state_of(const Spec& s) { return s.anchored + s.hidden + (s.cell == CELL_LSTM ? s.hidden : 0); }

int64_t perceptron_flat(const Perceptron& p) {
  int64_t n = 0;
  for (int l = 0; l < p.layers; ++l) n += int64_t(p.sizes[l + 1]) * (p.sizes[l] + 1);
  return n;
}
int64_t flat_size(const Spec& s) {
  const int64_t g = gates_of(s), h = s.hidden;
  int64_t n = 0;
  if (s.cell != CELL_NONE) n += g * (2 * s.channels + s.ages) + g;
  if (s.cell > CELL_SET) n += g * h;
  if (s.reset_after) n += h;
  if (s.cell != CELL_NONE) n += g * s.anchored;
  if (s.decay_features) n += h * s.decay_features + h;
  if (s.input_decay) n += 2 * s.channels;
  return n + perceptron_flat(s.field) + perceptron_flat(s.decoder);
}

Perceptron perceptron_of(const std::vector<int>& sizes, int activation) {
  Perceptron p;
  if (sizes.empty()) return p;
  if (sizes.size() < 2 || sizes.size() > MAX_LAYERS + 1)
    refuse("a perceptron of the fused body has 1 to " + std::to_string(MAX_LAYERS) + " layers, got " +
           std::to_string(int(sizes.size()) - 1));
  for (int n : sizes)
    if (n < 1) refuse("layer sizes must be at least 1, got " + std::to_string(n));
  p.layers = int(sizes.size()) - 1;
  std::copy(sizes.begin(), sizes.end(), p.sizes);
  p.activation = activation;
  return p;
}

Spec spec_of(int channels, int hidden, int anchored, int ages, int cell, bool reset_after,
             const std::vector<int>& field, int activation,
             const std::vector<std::vector<double>>& a, const std::vector<double>& b, int steps,
             double max_step, int decay_features, int decay_rows, bool input_decay,
             const std::vector<int>& decoder) {
  Spec s;
  s.channels = channels, s.hidden = hidden, s.anchored = anchored, s.ages = ages;
  s.cell = cell, s.reset_after = reset_after;
  if (channels < 1 || hidden < 1 || ages < 0 || (anchored != 0 && anchored != channels))
    refuse("sizes do not fit together: channels " + std::to_string(channels) + ", hidden " +
           std::to_string(hidden) + ", anchored " + std::to_string(anchored));
  if (cell < CELL_NONE || cell > CELL_GRU) refuse("unknown cell");
  if (reset_after && cell != CELL_GRU) refuse("reset_after needs a GRU");
  if (b.empty() || b.size() > MAX_STAGES || a.size() != b.size())
    refuse("a tableau of the fused body has 1 to " + std::to_string(MAX_STAGES) + " stages, got " +
           std::to_string(b.size()));
  s.stages = int(b.size());
  for (size_t i = 0; i < b.size(); ++i) {
    s.b[i] = b[i];
    if (a[i].size() != i) refuse("a tableau's row i has i weights");
    std::copy(a[i].begin(), a[i].end(), s.a[i]);
  }
  if (steps < 1) refuse("steps must be at least 1");
  s.steps = steps, s.max_step = max_step;
  s.decay_features = decay_features, s.decay_rows = decay_rows, s.input_decay = input_decay;
  s.field = perceptron_of(field, activation);
  s.decoder = perceptron_of(decoder, TANH);
  const int driven = anchored + hidden;
  if (s.field.layers && (field.front() != driven || field.back() != driven))
    refuse("the vector field must map " + std::to_string(driven) + " units to themselves");
  if (s.decoder.layers && (decoder.front() != hidden || decoder.back() != channels))
    refuse("the decoder must map " + std::to_string(hidden) + " units to " +
           std::to_string(channels) + " channels");
  if (s.decoder.layers && anchored) refuse("an anchored state has no decoder");
  return s;
}

// --- a batch ----------------------------------------------------------------------------------------

// Everything of a call that forward and backward share.
template <class T>
struct Call {
  Job<T> job;
  std::vector<int32_t> order, length, source;
  std::vector<Block> blocks;
  std::vector<Slot> slots;
  int64_t tape = 0;

  void order_lanes(int64_t batch, int64_t rows, const int64_t* lengths, const int64_t* index) {
    job.batch = batch, job.n_rows = rows;
    order.resize(batch);
    std::iota(order.begin(), order.end(), 0);
    auto of = [&](int32_t i) {
      return lengths ? std::clamp<int64_t>(lengths[i], 0, rows) : rows;
    };
    std::stable_sort(order.begin(), order.end(),
                     [&](int32_t i, int32_t j) { return of(i) > of(j); });
    for (int32_t i : order) {
      length.push_back(int32_t(of(i)));
      source.push_back(index ? int32_t(index[i]) : i);
    }
    job.order = order.data(), job.length = length.data(), job.source = source.data();
  }

  void plan(const Spec& s, const Body<T>& body) {
    job.spec = &s;
    const int64_t batch = job.batch;
    const int w = body.width;
    for (int64_t at = 0; at < batch;) {
      Block b;
      b.first = int(at);
      b.vectors = batch - at > w ? 2 : 1;
      b.lanes = int(std::min<int64_t>(batch - at, int64_t(b.vectors) * w));
      b.rows = length[at];
      b.tape = tape;
      tape += int64_t(b.rows) * body.tape_row(s, job.max_steps, b.vectors);
      blocks.push_back(b);
      at += b.lanes;
    }
    // Sums of gradients: a place of its own for each block, or for some neighbours.
    const int n = int(blocks.size()), most = 64;
    const int count = std::min(n, most);
    for (int i = 0; i < count; ++i)
      slots.push_back({int(int64_t(n) * i / count), int(int64_t(n) * (i + 1) / count)});
    job.blocks = blocks.data(), job.slots = slots.data();
  }

  // Rows between two looks at who is behind: a sixteenth of all, in whole groups.
  int stretch() const {
    const int rows = std::max(1, int(job.n_rows) / 16);
    return (rows + job.group - 1) / job.group * job.group;
  }
};

template <class T>
int most_steps(const Spec& s, const Fact<T>& gap, const std::vector<int32_t>& source,
               int64_t rows) {
  int64_t most = s.steps;
  if (s.max_step > 0 && s.field.layers) {
    T longest = 0;
    for (int64_t i : source)
      for (int64_t j = 0; j < rows; ++j)
        longest = std::max(longest, gap.data[i * gap.by_lane + j * gap.by_row]);
    const T wanted = std::ceil(longest / T(s.max_step) - T(1e-6));
    if (!(wanted < T(1e6)))
      refuse("a gap asks for over a million steps; raise max_step");
    most = std::max<int64_t>(most, int64_t(wanted));
  }
  return int(most);
}

enum { GAP, UPDATE, UPDATED, VALUES, MASK, AGE, DECAY_START, DECAY_END, DELTA, LAST, QUANTITIES };
const char* const NAMES[QUANTITIES] = {"gap", "update",      "updated",   "values", "mask",
                                       "age", "decay_start", "decay_end", "delta",  "last"};

// What is known of the rows: an array per quantity, or one table of many trajectories that has the
// quantities side by side, and which of its trajectories are meant.
template <class T>
struct Facts {
  std::vector<Maybe<T>> arrays;
  Maybe<T> mean;
  std::optional<Const<uint8_t>> fed;
  std::optional<Const<int64_t>> length;
  Maybe<T> table;  // (trajectories, rows, columns)
  std::optional<Const<int64_t>> index;
  std::vector<std::pair<int, int>> places;  // first column and number of columns, 0: none
  int64_t rows = 0;

  Fact<T> get(int which, int64_t batch, int units) const {
    if (!table) return needed(NAMES[which], arrays[which], batch, rows, units);
    const auto [first, width] = places[which];
    if (!width) refuse(std::string(NAMES[which]) + " is missing; this scan needs it");
    if (width != std::max(units, 1) || first < 0 || first + width > int64_t(table->shape(2)))
      refuse(std::string(NAMES[which]) + " must have " + std::to_string(std::max(units, 1)) +
             " columns inside the table, got columns " + std::to_string(first) + " to " +
             std::to_string(first + width));
    return {table->data() + first, table->stride(0), table->stride(1)};
  }

  // Checks that the table has the trajectories and rows that are asked for.
  void check_table(int64_t batch) const {
    check_shape("index", *index, {batch});
    check_contiguous("index", *index);
    const int64_t n = int64_t(table->shape(0));
    for (int64_t i = 0; i < batch; ++i)
      if (index->data()[i] < 0 || index->data()[i] >= n)
        refuse("index " + std::to_string(index->data()[i]) + " is not in the table of " +
               std::to_string(n) + " trajectories");
    if (rows > int64_t(table->shape(1)) || (table->shape(2) > 1 && table->stride(2) != 1))
      refuse("the table has shape " + shape_of(*table) + ", expected at least " +
             std::to_string(rows) + " rows, and columns that lie in one piece");
  }
};

template <class T>
void take_rows(Job<T>& job, const Spec& s, const Facts<T>& f, int64_t batch) {
  Rows<T>& r = job.rows;
  r.gap = f.get(GAP, batch, -1);
  r.update = f.get(UPDATE, batch, -1);
  r.values = f.get(VALUES, batch, s.channels);
  r.mask = f.get(MASK, batch, s.channels);
  if (s.ages) r.age = f.get(AGE, batch, s.ages);
  if (s.decay_features) {
    r.decay_start = f.get(DECAY_START, batch, s.decay_features);
    r.decay_end = f.get(DECAY_END, batch, s.decay_features);
    r.updated = f.get(UPDATED, batch, -1);
  }
  if (s.input_decay) {
    r.delta = f.get(DELTA, batch, s.channels);
    r.last = f.get(LAST, batch, s.channels);
    if (!f.mean) refuse("mean is missing; this scan needs it");
    check_shape("mean", *f.mean, {s.channels});
    r.mean = f.mean->data();
  }
  if (s.decoder.layers && f.fed) {
    check_shape("fed", *f.fed, {f.rows});
    r.fed = f.fed->data();
  }
}

template <class T>
Call<T> prepare(const Spec& s, const Body<T>& body, const Facts<T>& f, const Const<T>& state) {
  const int64_t batch = state.ndim() ? int64_t(state.shape(0)) : 0;
  check_shape("state", state, {batch, state_of(s)});
  check_contiguous("state", state);
  if (batch < 1 || f.rows < 1) refuse("a scan needs at least one trajectory and one row");
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
  call.job.max_steps = most_steps(s, call.job.rows.gap, call.source, f.rows);
  call.plan(s, body);
  // Enough lanes per addition to the gradients, and no more memory than that takes.
  const int evaluations = s.field.layers ? s.stages * call.job.max_steps : 1;
  call.job.group = std::clamp(8 / evaluations, 1, MAX_GROUP);
  return call;
}

template <class T>
std::unique_ptr<Buffer<T>> packed(const Spec& s, const Body<T>& body, const Const<T>& weights) {
  check_shape("weights", weights, {flat_size(s)});
  auto buffer = std::make_unique<Buffer<T>>(body.packed_size(s));
  body.pack(s, weights.data(), buffer->get());
  return buffer;
}

template <class T>
int64_t tape_size(const Spec& s, const Bodies& named, const Facts<T>& f, const Const<T>& state) {
  return prepare<T>(s, typed<T>(named), f, state).tape;
}

template <class T>
void scan_forward(const Spec& s, const Bodies& named, const Const<T>& weights, const Facts<T>& f,
                  const Const<T>& state, Array<T> before, Array<T> after,
                  std::optional<Array<T>> tape, int threads) {
  const Body<T>& body = typed<T>(named);
  Call<T> call = prepare<T>(s, body, f, state);
  Job<T>& job = call.job;
  job.before = grid<T>("before", std::optional<Array<T>>(before), job.batch, job.n_rows, state_of(s));
  job.after = grid<T>("after", std::optional<Array<T>>(after), job.batch, job.n_rows, state_of(s));
  if (tape) {
    check_shape("tape", *tape, {call.tape});
    job.tape = tape->data();
  }
  nb::gil_scoped_release unlocked;
  const auto weight = packed<T>(s, body, weights);
  job.packed = weight->get();
  std::vector<Walk> walks;
  for (const Block& b : call.blocks) walks.push_back({b.rows, b.vectors});
  walk<T>(walks, call.stretch(), threads, body.forward_scratch(s, job.max_steps),
          [&](int block, int begin, int end, T* scratch) {
            body.forward(job, block, begin, end, scratch);
          });
}

template <class T>
void scan_backward(const Spec& s, const Bodies& named, const Const<T>& weights, const Facts<T>& f,
                   const Const<T>& state, const Const<T>& after, std::optional<Const<T>> tape,
                   std::optional<Const<T>> to_before, std::optional<Const<T>> to_after,
                   Array<T> to_weights, Array<T> to_state, int threads, int group) {
  const Body<T>& body = typed<T>(named);
  Call<T> call = prepare<T>(s, body, f, state);
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
  const auto weight = packed<T>(s, body, weights);
  job.packed = weight->get();
  const Buffer<T> sums(int64_t(call.slots.size()) * body.sums_size(s));
  job.sums = sums.get();
  const Buffer<T> carried(int64_t(call.blocks.size()) * body.carried_size(s));
  job.carried = carried.get();
  std::vector<Walk> walks;
  for (const Slot& slot : call.slots) {
    const Block& b = call.blocks[slot.first];
    walks.push_back({b.rows, b.vectors});
  }
  const bool whole = call.slots.size() < call.blocks.size();
  walk<T>(walks, whole ? int(job.n_rows) : call.stretch(), threads,
          body.backward_scratch(s, job.max_steps, job.group),
          [&](int slot, int begin, int end, T* scratch) {
            const int rows = walks[slot].rows;
            body.backward(job, slot, rows - end, rows - begin, scratch);
          });
  body.reduce(s, sums.get(), int(call.slots.size()), flat);
}

// --- a perceptron over many rows --------------------------------------------------------------------

template <class T>
PerceptronJob<T> perceptron_job(const Perceptron& shape, const Const<T>& weights,
                                const Const<T>& x) {
  check_shape("weights", weights, {perceptron_flat(shape)});
  if (x.ndim() != 2) refuse("x must have shape (rows, inputs), got " + shape_of(x));
  check_shape("x", x, {int64_t(x.shape(0)), shape.sizes[0]});
  PerceptronJob<T> job;
  job.shape = &shape;
  job.x = x.data(), job.n = int64_t(x.shape(0)), job.x_stride = x.stride(0);
  return job;
}

template <class T>
int64_t perceptron_tape(const Perceptron& shape, const Bodies& named, int64_t rows) {
  const Body<T>& body = typed<T>(named);
  const int64_t w = 2 * body.width;
  return (rows + w - 1) / w * body.perceptron_tape_row(shape);
}

template <class T>
void perceptron_forward(const Perceptron& shape, const Bodies& named, const Const<T>& weights,
                        const Const<T>& x, Array<T> y, std::optional<Array<T>> tape, int threads) {
  const Body<T>& body = typed<T>(named);
  PerceptronJob<T> job = perceptron_job<T>(shape, weights, x);
  check_shape("y", y, {job.n, shape.sizes[shape.layers]});
  check_contiguous("y", y);
  job.y = y.data();
  if (tape) {
    check_shape("tape", *tape, {perceptron_tape<T>(shape, named, job.n)});
    job.tape = tape->data();
  }
  nb::gil_scoped_release unlocked;
  const Buffer<T> panels(body.perceptron_packed_size(shape));
  body.perceptron_pack(shape, weights.data(), panels.get());
  job.packed = panels.get();
  const int64_t w = 2 * body.width, blocks = (job.n + w - 1) / w, batch = 16;
  spread<T>((blocks + batch - 1) / batch, threads, body.perceptron_scratch(shape),
            [&](int64_t task, T* scratch) {
              for (int64_t b = task * batch; b < std::min(blocks, (task + 1) * batch); ++b)
                body.perceptron_forward(job, b, scratch);
            });
}

template <class T>
void perceptron_backward(const Perceptron& shape, const Bodies& named, const Const<T>& weights,
                         const Const<T>& x, const Const<T>& tape, const Const<T>& to_y,
                         Array<T> to_weights, std::optional<Array<T>> to_x, int threads) {
  const Body<T>& body = typed<T>(named);
  PerceptronJob<T> job = perceptron_job<T>(shape, weights, x);
  check_shape("tape", tape, {perceptron_tape<T>(shape, named, job.n)});
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
  const Buffer<T> panels(body.perceptron_packed_size(shape));
  body.perceptron_pack(shape, weights.data(), panels.get());
  job.packed = panels.get();
  const int64_t w = 2 * body.width, blocks = (job.n + w - 1) / w;
  job.slots = int(std::clamp<int64_t>(blocks / 32, 1, 16));
  const Buffer<T> sums(job.slots * body.perceptron_sums(shape));
  job.sums = sums.get();
  spread<T>(job.slots, threads, body.perceptron_scratch(shape),
            [&](int64_t slot, T* scratch) { body.perceptron_backward(job, int(slot), scratch); });
  body.perceptron_reduce(shape, sums.get(), job.slots, flat);
}

#include "live.hpp"

template <class T>
void bind(nb::module_& m, const char* suffix) {
  const std::string end = suffix;
  nb::class_<Facts<T>>(m, ("Facts_" + end).c_str())
      .def(
          "__init__",
          [](Facts<T>* self, Maybe<T> gap, Maybe<T> update, Maybe<T> updated, Maybe<T> values,
             Maybe<T> mask, Maybe<T> age, Maybe<T> decay_start, Maybe<T> decay_end, Maybe<T> delta,
             Maybe<T> last, Maybe<T> mean, std::optional<Const<uint8_t>> fed,
             std::optional<Const<int64_t>> length) {
            if (!gap || gap->ndim() != 2) refuse("gap must have shape (batch, rows)");
            const int64_t rows = int64_t(gap->shape(1));
            new (self) Facts<T>{{gap, update, updated, values, mask, age, decay_start, decay_end,
                                 delta, last},
                                mean, fed, length, {}, {}, {}, rows};
          },
          nb::arg("gap").noconvert(), nb::arg("update").noconvert(),
          nb::arg("updated").noconvert().none(), nb::arg("values").noconvert(),
          nb::arg("mask").noconvert(), nb::arg("age").noconvert().none(),
          nb::arg("decay_start").noconvert().none(), nb::arg("decay_end").noconvert().none(),
          nb::arg("delta").noconvert().none(), nb::arg("last").noconvert().none(),
          nb::arg("mean").noconvert().none(), nb::arg("fed").noconvert().none(),
          nb::arg("length").noconvert().none())
      .def(
          "__init__",
          [](Facts<T>* self, Const<T> table, Const<int64_t> index,
             const std::vector<std::pair<int, int>>& places, int64_t rows, Maybe<T> mean,
             std::optional<Const<uint8_t>> fed, std::optional<Const<int64_t>> length) {
            if (table.ndim() != 3 || index.ndim() != 1)
              refuse("a table must have three axes and its index one");
            if (places.size() != QUANTITIES) refuse("a table needs a place for every quantity");
            new (self) Facts<T>{{}, mean, fed, length, table, index, places, rows};
          },
          nb::arg("table").noconvert(), nb::arg("index").noconvert(), nb::arg("places"),
          nb::arg("rows"), nb::arg("mean").noconvert().none(), nb::arg("fed").noconvert().none(),
          nb::arg("length").noconvert().none());
  m.def(
      "tape_size",
      [](const Spec& s, const std::string& body, const Facts<T>& f, Const<T> state) {
        return tape_size<T>(s, body_named(body), f, state);
      },
      nb::arg("spec"), nb::arg("body"), nb::arg("facts"), nb::arg("state").noconvert());
  m.def(
      "scan_forward",
      [](const Spec& s, const std::string& body, Const<T> weights, const Facts<T>& f,
         Const<T> state, Array<T> before, Array<T> after, std::optional<Array<T>> tape,
         int threads) {
        scan_forward<T>(s, body_named(body), weights, f, state, before, after, tape, threads);
      },
      nb::arg("spec"), nb::arg("body"), nb::arg("weights").noconvert(), nb::arg("facts"),
      nb::arg("state").noconvert(), nb::arg("before").noconvert(), nb::arg("after").noconvert(),
      nb::arg("tape").noconvert().none(), nb::arg("threads"));
  m.def(
      "scan_backward",
      [](const Spec& s, const std::string& body, Const<T> weights, const Facts<T>& f,
         Const<T> state, Const<T> after, std::optional<Const<T>> tape,
         std::optional<Const<T>> to_before, std::optional<Const<T>> to_after, Array<T> to_weights,
         Array<T> to_state, int threads, int group) {
        scan_backward<T>(s, body_named(body), weights, f, state, after, tape, to_before, to_after,
                         to_weights, to_state, threads, group);
      },
      nb::arg("spec"), nb::arg("body"), nb::arg("weights").noconvert(), nb::arg("facts"),
      nb::arg("state").noconvert(), nb::arg("after").noconvert(), nb::arg("tape").noconvert().none(),
      nb::arg("to_before").noconvert().none(), nb::arg("to_after").noconvert().none(),
      nb::arg("to_weights").noconvert(), nb::arg("to_state").noconvert(), nb::arg("threads"),
      nb::arg("group") = 0);
  m.def(
      ("perceptron_tape_" + end).c_str(),
      [](const Perceptron& p, const std::string& body, int64_t rows) {
        return perceptron_tape<T>(p, body_named(body), rows);
      });
  m.def(
      "perceptron_forward",
      [](const Perceptron& p, const std::string& body, Const<T> weights, Const<T> x, Array<T> y,
         std::optional<Array<T>> tape, int threads) {
        perceptron_forward<T>(p, body_named(body), weights, x, y, tape, threads);
      },
      nb::arg("shape"), nb::arg("body"), nb::arg("weights").noconvert(), nb::arg("x").noconvert(),
      nb::arg("y").noconvert(), nb::arg("tape").noconvert().none(), nb::arg("threads"));
  m.def(
      "perceptron_backward",
      [](const Perceptron& p, const std::string& body, Const<T> weights, Const<T> x, Const<T> tape,
         Const<T> to_y, Array<T> to_weights, std::optional<Array<T>> to_x, int threads) {
        perceptron_backward<T>(p, body_named(body), weights, x, tape, to_y, to_weights, to_x,
                               threads);
      },
      nb::arg("shape"), nb::arg("body"), nb::arg("weights").noconvert(), nb::arg("x").noconvert(),
      nb::arg("tape").noconvert(), nb::arg("to_y").noconvert(), nb::arg("to_weights").noconvert(),
      nb::arg("to_x").noconvert().none(), nb::arg("threads"));
  bind_live<T>(m, end);
}

}  // namespace
}  // namespace offbeat

NB_MODULE(_fused, m) {
  using namespace offbeat;
  nb::set_leak_warnings(false);  // caches of specs live until the interpreter ends
  m.doc() = "The fused body of the scan; offbeat.kernels.fused is its Python face.";
  m.def("bodies", [] {
    std::vector<std::string> names;
    for (const Bodies* b : bodies()) names.emplace_back(b->name);
    return names;
  });
  m.def("width", [](const std::string& body) { return body_named(body).f32.width; });
  nb::class_<Spec>(m, "Spec")
      .def(
          "__init__",
          [](Spec* self, int channels, int hidden, int anchored, int ages, int cell,
             bool reset_after, const std::vector<int>& field, int activation,
             const std::vector<std::vector<double>>& a, const std::vector<double>& b, int steps,
             double max_step, int decay_features, int decay_rows, bool input_decay,
             const std::vector<int>& decoder) {
            new (self) Spec(spec_of(channels, hidden, anchored, ages, cell, reset_after, field,
                                    activation, a, b, steps, max_step, decay_features, decay_rows,
                                    input_decay, decoder));
          },
          nb::arg("channels"), nb::arg("hidden"), nb::arg("anchored"), nb::arg("ages"),
          nb::arg("cell"), nb::arg("reset_after"), nb::arg("field"), nb::arg("activation"),
          nb::arg("a"), nb::arg("b"), nb::arg("steps"), nb::arg("max_step"),
          nb::arg("decay_features"), nb::arg("decay_rows"), nb::arg("input_decay"),
          nb::arg("decoder"))
      .def_prop_ro("flat_size", [](const Spec& s) { return flat_size(s); })
      .def_prop_ro("state_size", [](const Spec& s) { return state_of(s); });
  nb::class_<Perceptron>(m, "Perceptron")
      .def("__init__",
           [](Perceptron* self, const std::vector<int>& sizes, int activation) {
             if (sizes.size() < 2) refuse("a perceptron needs sizes of its input and its output");
             new (self) Perceptron(perceptron_of(sizes, activation));
           },
           nb::arg("sizes"), nb::arg("activation"));
  bind<float>(m, "f32");
  bind<double>(m, "f64");
}
