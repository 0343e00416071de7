// Arguments from Python, checked: arrays, sizes, a spec: part of module.cpp.

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
  if (!good)
    refuse(std::string(name) + " has shape " + shape_of(a) + ", expected (" + wanted + ")");
  if (shape.size() && *(shape.end() - 1) > 1 && a.stride(a.ndim() - 1) != 1)
    refuse(std::string(name) + " must have its last axis contiguous");
}

template <class A>
void check_contiguous(const char* name, const A& a) {
  int64_t stride = 1;
  for (size_t i = a.ndim(); i-- > 0;) {
    if (a.shape(i) > 1 && a.stride(i) != stride) refuse(std::string(name) + " must be contiguous");
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
int state_of(const Spec& s) { return s.anchored + s.hidden + (s.cell == CELL_LSTM ? s.hidden : 0); }

int64_t perceptron_flat(const Perceptron& p) {
  int64_t n = 0;
  for (int l = 0; l < p.layers; ++l) n += int64_t(p.sizes[l + 1]) * (p.sizes[l] + 1);
  return n;
}
int64_t flat_size(const Spec& s) {
  const int64_t g = gates_of(s), h = s.hidden;
  int64_t n = 0;
  if (s.cell != CELL_NONE) n += g * (2 * s.channels + s.time_inputs) + g;
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
    refuse("a perceptron of the compiled backend has 1 to " + std::to_string(MAX_LAYERS) +
           " layers, got " + std::to_string(int(sizes.size()) - 1));
  for (int n : sizes)
    if (n < 1) refuse("layer sizes must be at least 1, got " + std::to_string(n));
  p.layers = int(sizes.size()) - 1;
  std::copy(sizes.begin(), sizes.end(), p.sizes);
  p.activation = activation;
  return p;
}

Spec spec_of(int channels, int hidden, int anchored, int time_inputs, int cell, bool reset_after,
             const std::vector<int>& field, int activation,
             const std::vector<std::vector<double>>& a, const std::vector<double>& b, int steps,
             double max_step, int decay_features, int decay_rows, bool input_decay,
             const std::vector<int>& decoder) {
  Spec s;
  s.channels = channels, s.hidden = hidden, s.anchored = anchored, s.time_inputs = time_inputs;
  s.cell = cell, s.reset_after = reset_after;
  if (channels < 1 || hidden < 1 || time_inputs < 0 || (anchored != 0 && anchored != channels))
    refuse("sizes do not fit together: channels " + std::to_string(channels) + ", hidden " +
           std::to_string(hidden) + ", anchored " + std::to_string(anchored));
  if (cell < CELL_NONE || cell > CELL_GRU) refuse("unknown cell");
  if (reset_after && cell != CELL_GRU) refuse("reset_after needs a GRU");
  if (b.empty() || b.size() > MAX_STAGES || a.size() != b.size())
    refuse("a tableau of the compiled backend has 1 to " + std::to_string(MAX_STAGES) +
           " stages, got " + std::to_string(b.size()));
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
