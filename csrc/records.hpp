// What the module and the bodies share: plain records and nothing else. A body is compiled for an
// instruction set of its own, so nothing here may be inline code that a linker could share.
#pragma once

#include <cstdint>

namespace offbeat {

constexpr int MAX_LAYERS = 16;
constexpr int MAX_STAGES = 8;
constexpr int MAX_GROUP = 128;

enum Cell { CELL_NONE, CELL_SET, CELL_ELMAN, CELL_LSTM, CELL_GRU };
enum Activation { TANH, SILU };
enum DecayRows { CONTINUOUS, EVERY_ROW, OBSERVED_ROWS };

// The shape of a perceptron: `layers` affine maps between sizes[0] ... sizes[layers].
struct Perceptron {
  int layers = 0;
  int sizes[MAX_LAYERS + 1] = {};
  int activation = TANH;
};

// offbeat.kernels.spec.ScanSpec, with the tableau of its solver.
struct Spec {
  int channels = 0, hidden = 0, anchored = 0, ages = 0;
  int cell = CELL_GRU, reset_after = 0;
  Perceptron field, decoder;
  int stages = 1, steps = 1;
  double a[MAX_STAGES][MAX_STAGES] = {}, b[MAX_STAGES] = {};
  double max_step = 0;  // 0: no bound
  int decay_features = 0, decay_rows = CONTINUOUS, input_decay = 0;
};

// One quantity at each row: element (lane, row, unit) lies at data[lane * by_lane + row * by_row +
// unit]; data is null where the scan has no such quantity.
template <class T>
struct Fact {
  const T* data = nullptr;
  int64_t by_lane = 0, by_row = 0;
};

template <class T>
struct Rows {
  Fact<T> gap, update, updated, values, mask, age, decay_start, decay_end, delta, last;
  const T* mean = nullptr;      // (channels,)
  const uint8_t* fed = nullptr; // (rows,) or null
};

// (lane, row, unit) of a result or of its gradient; null where it is not asked for.
template <class T>
struct Grid {
  T* data = nullptr;
  int64_t by_lane = 0, by_row = 0;
};

// Lanes that run through the rows together, `vectors` vectors wide.
struct Block {
  int first = 0, lanes = 0, vectors = 0, rows = 0;
  int64_t tape = 0;  // where its tape begins
};

// Consecutive blocks whose gradients of weights are added up in one place.
struct Slot {
  int first = 0, last = 0;
};

template <class T>
struct Job {
  const Spec* spec = nullptr;
  Rows<T> rows;
  int64_t batch = 0, n_rows = 0;
  const int32_t* order = nullptr;   // lane -> trajectory, longest first
  const int32_t* source = nullptr;  // lane -> where the facts of its trajectory are
  const int32_t* length = nullptr;  // of each lane
  const Block* blocks = nullptr;
  const Slot* slots = nullptr;
  const T* packed = nullptr;
  const T* state = nullptr;         // (batch, state)
  Grid<T> before, after;            // forward: results; backward: read
  Grid<T> to_before, to_after;      // backward
  T* to_state = nullptr;            // (batch, state)
  T* tape = nullptr;                // null: the backward pass computes it again
  T* carried = nullptr;             // backward: of each block, between two stretches of its rows
  T* sums = nullptr;                // of all slots
  int max_steps = 1;                // over all gaps
  int group = 4;                    // rows whose weight gradients are added in one go
};

// A perceptron applied to many rows.
template <class T>
struct PerceptronJob {
  const Perceptron* shape = nullptr;
  const T* packed = nullptr;
  const T* x = nullptr;  // (rows, in)
  int64_t n = 0, x_stride = 0;
  T* y = nullptr;        // (rows, out)
  const T* to_y = nullptr;
  T* to_x = nullptr;     // or null
  T* tape = nullptr;
  T* sums = nullptr;
  int slots = 0;
};

// One row of one trajectory, carried in buffers that live as long as the stream.
template <class T>
struct StreamRow {
  const Spec* spec = nullptr;
  const T* packed = nullptr;
  T gap = 0, update = 0, updated = 0;
  const T *values = nullptr, *mask = nullptr, *age = nullptr, *decay_start = nullptr,
          *decay_end = nullptr, *delta = nullptr, *last = nullptr, *mean = nullptr;
  int fed = 0;
  T *state = nullptr, *before = nullptr, *after = nullptr;  // (state,) each; unpadded
  T* scratch = nullptr;
};

template <class T>
struct Body {
  int width;  // lanes of a vector
  int64_t (*packed_size)(const Spec&);
  void (*pack)(const Spec&, const T* flat, T* packed);
  int64_t (*tape_row)(const Spec&, int max_steps, int vectors);
  int64_t (*forward_scratch)(const Spec&, int max_steps);
  int64_t (*backward_scratch)(const Spec&, int max_steps, int group);
  int64_t (*sums_size)(const Spec&);
  // Rows from `begin` on and before `end`, in the order of time; the walk may stop and go on
  // anywhere. `end` at the block's last row includes the padding behind it.
  void (*forward)(const Job<T>&, int block, int begin, int end, T* scratch);
  int64_t (*carried_size)(const Spec&);  // of a block
  // The same rows backwards; a slot of several blocks must be walked in one go.
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

  int64_t (*stream_packed_size)(const Spec&);
  void (*stream_pack)(const Spec&, const T* flat, T* packed);
  int64_t (*stream_scratch)(const Spec&);
  void (*stream_row)(const StreamRow<T>&);
  int64_t (*stream_perceptron_size)(const Perceptron&);
  void (*stream_perceptron_pack)(const Perceptron&, const T* flat, T* packed);
  int64_t (*stream_perceptron_scratch)(const Perceptron&);
  void (*stream_perceptron)(const Perceptron&, const T* packed, const T* x, T* y, T* scratch);
};

struct Bodies {
  const char* name;
  Body<float> f32;
  Body<double> f64;
};

}  // namespace offbeat
