// Checks of arguments: arrays, sizes, specs. Part of module.cpp and library/stream.cpp, which say
// what Array, Const and Maybe are.

// Becomes offbeat.errors.InputError in Python.
struct InputError : std::runtime_error {
  using std::runtime_error::runtime_error;
};

[[noreturn]] void refuse(const std::string& what) { throw InputError(what); }

std::string text_of(double x) {
  char text[32];
  std::snprintf(text, sizeof text, "%g", x);
  return text;
}

int64_t in_range(const char* name, int64_t value, int64_t least, int64_t most) {
  if (value < least || value > most)
    refuse(std::string(name) + " is " + std::to_string(value) + ", expected " +
           std::to_string(least) + " to " + std::to_string(most));
  return value;
}

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
  if (!good)
    refuse(std::string(name) + " has shape " + shape_of(a) + ", expected (" + wanted + ")");
  const size_t last = a.ndim() - 1;
  if (a.size() > 0 && a.shape(last) > 1 && a.stride(last) != 1)
    refuse(std::string(name) + " has stride " + std::to_string(a.stride(last)) +
           " along its last axis, expected 1; pass a contiguous array");
}

template <class A>
void check_contiguous(const char* name, const A& a) {
  if (a.size() == 0) return;
  int64_t stride = 1;
  for (size_t i = a.ndim(); i-- > 0;) {
    if (a.shape(i) > 1 && a.stride(i) != stride)
      refuse(std::string(name) + " is not contiguous; pass a contiguous array");
    stride *= int64_t(a.shape(i));
  }
}

template <class T>
Quantity<T> optional_quantity(const char* name, const Maybe<T>& a, int64_t batch, int64_t rows,
                              int units) {
  if (!a) return {};
  if (units < 0)
    check_shape(name, *a, {batch, rows});
  else
    check_shape(name, *a, {batch, rows, units});
  return {a->data(), a->stride(0), a->stride(1)};
}
template <class T>
Quantity<T> quantity(const char* name, const Maybe<T>& a, int64_t batch, int64_t rows, int units) {
  if (!a) refuse(std::string(name) + " is missing; this scan needs it");
  return optional_quantity(name, a, batch, rows, units);
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
int anchors_of(const Spec& s) { return s.trend ? 2 * s.anchored : s.anchored; }
int state_of(const Spec& s) {
  return anchors_of(s) + s.hidden + (s.cell == CELL_LSTM ? s.hidden : 0);
}

int64_t perceptron_flat(const Perceptron& p) {
  int64_t n = 0;
  for (int l = 0; l < p.layers; ++l) n += int64_t(p.sizes[l + 1]) * (p.sizes[l] + 1);
  return n;
}
int64_t flat_size(const Spec& s) {
  const int64_t g = gates_of(s), h = s.hidden;
  int64_t n = 0;
  if (s.cell != CELL_NONE) n += g * (2 * s.channels + s.time_inputs) + g;
  if (s.cell > CELL_START) n += g * h;
  if (s.reset_after) n += h;
  if (s.cell != CELL_NONE) n += g * s.anchored;
  if (s.decay_features) n += h * s.decay_features + h;
  if (s.input_decay) n += 2 * s.channels;
  if (s.trend) n += 3 * s.anchored;
  return n + perceptron_flat(s.field) + perceptron_flat(s.decoder);
}

void check_decoder(const Perceptron& decoder, const Spec& s) {
  const int in = decoder.sizes[0], out = decoder.sizes[decoder.layers];
  if (in != s.hidden || out != s.channels)
    refuse("the decoder maps " + std::to_string(in) + " units to " + std::to_string(out) +
           ", expected " + std::to_string(s.hidden) + " to " + std::to_string(s.channels));
}

Perceptron perceptron_of(const std::vector<int64_t>& sizes, int64_t activation) {
  Perceptron p;
  if (sizes.empty()) return p;
  p.layers = int(in_range("the number of layers", int64_t(sizes.size()) - 1, 1, MAX_LAYERS));
  for (size_t i = 0; i < sizes.size(); ++i)
    p.sizes[i] = int(in_range("the size of a layer", sizes[i], 1, MAX_UNITS));
  p.activation = int(in_range("activation", activation, TANH, SILU));
  return p;
}

Spec spec_of(int64_t channels, int64_t hidden, int64_t anchored, int64_t time_inputs, int64_t cell,
             bool reset_after, const std::vector<int64_t>& field, int64_t activation,
             const std::vector<std::vector<double>>& a, const std::vector<double>& b, int64_t steps,
             double max_step, bool nodes, double decay_span, bool bounded, int64_t decay_features,
             int64_t decay_rows, bool input_decay, const std::vector<int64_t>& decoder,
             bool trend) {
  Spec s;
  s.channels = int(in_range("channels", channels, 1, MAX_UNITS));
  s.hidden = int(in_range("hidden_size", hidden, 1, MAX_UNITS));
  s.time_inputs = int(in_range("time_inputs", time_inputs, 0, MAX_UNITS));
  s.anchored = int(in_range("the number of anchored channels", anchored, 0, channels));
  if (anchored && anchored != channels)
    refuse("the number of anchored channels is " + std::to_string(anchored) + ", expected 0 or " +
           std::to_string(channels));
  s.trend = trend;
  if (trend && !anchored) refuse("trend is True, but no channel is anchored");
  s.cell = int(in_range("cell", cell, CELL_NONE, CELL_GRU));
  s.reset_after = reset_after;
  if (reset_after && cell != CELL_GRU) refuse("reset_after is True, but the cell is not a GRU");
  s.stages = int(in_range("the number of stages", int64_t(b.size()), 1, MAX_STAGES));
  if (a.size() != b.size()) refuse("a and b of the tableau differ in their number of stages");
  for (size_t i = 0; i < b.size(); ++i) {
    s.b[i] = b[i];
    if (a[i].size() != i)
      refuse("row " + std::to_string(i) + " of the tableau has " + std::to_string(a[i].size()) +
             " weights, expected " + std::to_string(i));
    std::copy(a[i].begin(), a[i].end(), s.a[i]);
  }
  s.steps = int(in_range("steps_per_gap", steps, 1, MAX_STEPS));
  if (!(max_step >= 0) || std::isinf(max_step))
    refuse("max_step is " + text_of(max_step) + ", expected a finite number above 0");
  s.max_step = max_step;
  s.nodes = nodes;
  s.bounded = bounded;
  if (!(decay_span > 0) || std::isinf(decay_span))
    refuse("decay_span is " + text_of(decay_span) + ", expected a finite number above 0");
  s.decay_span = decay_span;
  s.decay_features = int(in_range("decay", decay_features, 0, MAX_UNITS));
  s.decay_rows = int(in_range("decay_rows", decay_rows, CONTINUOUS, OBSERVED_ROWS));
  s.input_decay = input_decay;
  if (nodes && decay_rows != CONTINUOUS) refuse("a scan with nodes has a continuous decay");
  s.field = perceptron_of(field, activation);
  s.decoder = perceptron_of(decoder, TANH);
  const int64_t driven = anchors_of(s) + hidden;
  if (s.field.layers && (field.front() != driven || field.back() != driven))
    refuse("the vector field maps " + std::to_string(field.front()) + " units to " +
           std::to_string(field.back()) + ", expected " + std::to_string(driven) + " to " +
           std::to_string(driven));
  if (s.decoder.layers) check_decoder(s.decoder, s);
  if (s.decoder.layers && anchored) refuse("an anchored state has no decoder");
  return s;
}

// The number of steps from the node that the state has reached to the last one before a row.
template <class T>
int steps_to_node(T first, T node) {
  if (!(first >= 0 && first <= node && node <= T(MOST_NODES)))
    refuse("first_node is " + text_of(first) + " and node " + text_of(node) +
           ", expected 0 <= first_node <= node <= " + std::to_string(MOST_NODES));
  return int(node) - int(first);
}

// The number of solver steps over a gap.
template <class T>
int steps_of_gap(const Spec& s, T gap) {
  if (!(s.max_step > 0) || !s.field.layers || !(gap > 0)) return s.steps;
  const T steps = std::ceil(gap / T(s.max_step) - T(1e-6));
  if (!(steps <= T(MAX_STEPS)))
    refuse("a gap of " + text_of(gap) + " needs more than " + std::to_string(MAX_STEPS) +
           " steps of at most max_step = " + text_of(s.max_step) + "; use a larger max_step");
  return std::max(s.steps, int(steps));
}
