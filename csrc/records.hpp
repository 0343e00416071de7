// The records that the Python module and the kernels share. The kernels are compiled once per
// instruction set. Nothing here may be inline code: the linker keeps one copy of an inline
// function, and that copy may use instructions that the processor does not have.
#pragma once

#include <cstdint>

namespace offbeat {

constexpr int MAX_LAYERS = 16;
constexpr int MAX_STAGES = 8;
constexpr int MAX_GROUP = 128;
// With these limits, no size of one row (layout.hpp, weights.hpp) overflows 64 bits: at most 2^20
// steps of 8 stages of 17 layers of 2^20 units for 64 lanes and 128 rows is less than 2^62.
constexpr int64_t MAX_UNITS = 1 << 20;     // of a layer, of the channels, of the hidden state
constexpr int64_t MAX_STEPS = 1'000'000;   // of the solver over one gap
constexpr int MOST_NODES = 2048;           // after an observed row: kernels/spec.py
constexpr int TRACKED_NODES = 256;         // steps before a row with a gradient: kernels/spec.py
constexpr int64_t MAX_COUNT = 2147483647;  // trajectories, rows

enum Cell { CELL_NONE, CELL_START, CELL_ELMAN, CELL_LSTM, CELL_GRU };
enum Activation { TANH, SILU };
enum DecayRows { CONTINUOUS, EVERY_ROW, OBSERVED_ROWS };

// The shape of a perceptron: `layers` affine maps between sizes[0] ... sizes[layers].
struct Perceptron {
  int layers = 0;
  int sizes[MAX_LAYERS + 1] = {};
  int activation = TANH;
};

// offbeat.kernels.spec.ScanSpec with the tableau of its solver.
struct Spec {
  int channels = 0, hidden = 0, anchored = 0, trend = 0, time_inputs = 0;
  int cell = CELL_GRU, reset_after = 0;
  Perceptron field, decoder;
  int stages = 1, steps = 1;
  double a[MAX_STAGES][MAX_STAGES] = {}, b[MAX_STAGES] = {};
  double max_step = 0;  // 0: no bound; with nodes, no vector field
  int nodes = 0, bounded = 0;
  double decay_span = 1;
  int decay_features = 0, decay_rows = CONTINUOUS, input_decay = 0;
};

// One quantity of the step inputs. Element (lane, row, unit) is data[lane * by_lane + row * by_row
// + unit]. `data` is null where the scan does not use the quantity.
template <class T>
struct Quantity {
  const T* data = nullptr;
  int64_t by_lane = 0, by_row = 0;
};

template <class T>
struct InputPointers {
  Quantity<T> gap, update, updated, values, mask, time_input, decay_start, decay_end, delta, last,
      first_node, node, commit, level_gain, slope_gain;
  const T *mean = nullptr, *low = nullptr, *high = nullptr;  // (channels,), with a trend twice
  // (rows,) or null: 1 where the decoded state replaces the observed values.
  const uint8_t* use_prediction = nullptr;
};

// (lane, row, unit) of a result or of its gradient. `data` is null where it is not requested.
template <class T>
struct Grid {
  T* data = nullptr;
  int64_t by_lane = 0, by_row = 0;
};

// Trajectories that are computed together, one per lane of `vectors` vectors.
struct Block {
  int first = 0, lanes = 0, vectors = 0, rows = 0;
  int64_t tape = 0;  // offset of its tape
};

// Consecutive blocks whose weight gradients are summed in one buffer.
struct GradientSlot {
  int first = 0, last = 0;
};

template <class T>
struct Job {
  const Spec* spec = nullptr;
  InputPointers<T> inputs;
  int64_t batch = 0, n_rows = 0;
  const int32_t* order = nullptr;   // lane -> trajectory, longest first
  const int32_t* source = nullptr;  // lane -> trajectory in the step inputs
  const int32_t* length = nullptr;  // of each lane
  const Block* blocks = nullptr;
  const GradientSlot* slots = nullptr;
  const T* packed = nullptr;
  const T* state = nullptr;      // (batch, state)
  Grid<T> before, after;         // forward: results; backward: read
  Grid<T> to_before, to_after;   // backward
  T* to_state = nullptr;         // (batch, state)
  T* tape = nullptr;             // null: the backward pass recomputes it
  T* state_gradients = nullptr;  // backward: of each block, between two chunks of its rows
  T* sums = nullptr;             // weight gradients of all slots
  int max_steps = 1;             // of the longest gap
  int group = 4;                 // rows whose weight gradients are added together
};

// The squared errors of a perceptron at the states of trajectories, which are its rows one after
// the other: the output at row i of a trajectory is compared with target i - 1, and that at row 0
// with nothing.
template <class T>
struct Squares {
  const T* first = nullptr;  // (trajectories, stride of x): row i is read at i - 1, row 0 here
  int64_t rows = 0;          // of a trajectory
  const T* targets = nullptr;
  const int64_t* index = nullptr;  // where the targets of each trajectory lie
  int64_t by_trajectory = 0, by_row = 0;
  T norm = 0, scale = 0;    // of the gradient of a squared error
  T* squares = nullptr;     // (trajectories, rows - 1, out) of the errors
};

// A perceptron applied to many rows.
template <class T>
struct PerceptronJob {
  const Perceptron* shape = nullptr;
  const T* packed = nullptr;
  const T* x = nullptr;  // (rows, in)
  int64_t n = 0, x_stride = 0;
  T* y = nullptr;  // (rows, out)
  const T* to_y = nullptr;
  T* to_x = nullptr;  // or null
  T* tape = nullptr;
  T* sums = nullptr;
  int slots = 0;
  const Squares<T>* squares = nullptr;  // then the gradient of y comes from its squared error
};

// One row of one trajectory, in buffers that the stream owns.
template <class T>
struct StreamRow {
  const Spec* spec = nullptr;
  const T* packed = nullptr;
  T gap = 0, update = 0, updated = 0, first_node = 0, node = 0, commit = 0;
  const T *values = nullptr, *mask = nullptr, *time_input = nullptr, *decay_start = nullptr,
          *decay_end = nullptr, *delta = nullptr, *last = nullptr, *mean = nullptr, *low = nullptr,
          *high = nullptr, *level_gain = nullptr, *slope_gain = nullptr;
  int use_prediction = 0;
  T *state = nullptr, *before = nullptr, *after = nullptr;  // (state,) each, not padded
  T* scratch = nullptr;
};

template <class T>
struct Kernels {
  int width;  // lanes of a vector
  int64_t (*packed_size)(const Spec&);
  void (*pack)(const Spec&, const T* flat, T* packed);
  int64_t (*tape_row)(const Spec&, int max_steps, int vectors);
  int64_t (*forward_scratch)(const Spec&, int max_steps);
  int64_t (*backward_scratch)(const Spec&, int max_steps, int group);
  int64_t (*sums_size)(const Spec&);
  // Computes the rows [begin, end) of a block; the next call may continue at `end`. A call that
  // reaches the block's last row also fills the padding after it.
  void (*forward)(const Job<T>&, int block, int begin, int end, T* scratch);
  int64_t (*state_gradient_size)(const Spec&);  // of a block
  // The same rows in reverse order. A slot of several blocks takes all its rows in one call.
  void (*backward)(const Job<T>&, int slot, int begin, int end, T* scratch);
  void (*reduce)(const Spec&, const T* sums, int slots, T* flat);

  int64_t (*perceptron_packed_size)(const Perceptron&);
  void (*perceptron_pack)(const Perceptron&, const T* flat, T* packed);
  int64_t (*perceptron_tape_row)(const Perceptron&);  // per block of 2 * width rows
  int64_t (*perceptron_scratch)(const Perceptron&);
  int64_t (*perceptron_sums)(const Perceptron&);
  void (*perceptron_forward)(const PerceptronJob<T>&, int64_t block, T* scratch);
  void (*perceptron_backward)(const PerceptronJob<T>&, int slot, T* scratch);
  void (*perceptron_reduce)(const Perceptron&, const T* sums, int slots, T* flat);

  void (*adamax)(int64_t n, const T* gradient, T lerp, T beta, T eps, T step, T* average,
                 T* largest, T* weights);

  int64_t (*stream_packed_size)(const Spec&);
  void (*stream_pack)(const Spec&, const T* flat, T* packed);
  int64_t (*stream_scratch)(const Spec&);
  void (*stream_row)(const StreamRow<T>&);
  int64_t (*stream_perceptron_size)(const Perceptron&);
  void (*stream_perceptron_pack)(const Perceptron&, const T* flat, T* packed);
  int64_t (*stream_perceptron_scratch)(const Perceptron&);
  void (*stream_perceptron)(const Perceptron&, const T* packed, const T* x, T* y, T* scratch);
};

struct InstructionSet {
  const char* name;
  Kernels<float> f32;
  Kernels<double> f64;
};

}  // namespace offbeat
