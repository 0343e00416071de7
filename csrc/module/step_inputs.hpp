// The step inputs of a batch, checked: part of module.cpp.

enum {
  GAP,
  UPDATE,
  UPDATED,
  VALUES,
  MASK,
  TIME_INPUT,
  DECAY_START,
  DECAY_END,
  DELTA,
  LAST,
  FIRST_NODE,
  NODE,
  COMMIT,
  LEVEL_GAIN,
  SLOPE_GAIN,
  QUANTITIES
};
const char* const NAMES[QUANTITIES] = {
    "gap",       "update", "updated", "values",     "mask", "time_input", "decay_start", "decay_end",
    "delta",     "last",   "first_node", "node",    "commit", "level_gain", "slope_gain"};

// Step inputs as Python passes them: one array per quantity, or a table of many trajectories with
// the quantities as columns and the indices of the trajectories of this batch.
template <class T>
struct StepInputs {
  std::vector<Maybe<T>> arrays;
  Maybe<T> low, high, mean;
  std::optional<Const<uint8_t>> use_prediction;
  std::optional<Const<int64_t>> length;
  Maybe<T> table;  // (trajectories, rows, columns)
  std::optional<Const<int64_t>> index;
  std::vector<std::pair<int64_t, int64_t>> places;  // first column and number of columns, 0: none
  int64_t rows = 0;

  Quantity<T> get(int which, int64_t batch, int units) const {
    if (!table) return quantity(NAMES[which], arrays[which], batch, rows, units);
    const auto [first, width] = places[which];
    if (!width) refuse(std::string(NAMES[which]) + " is missing; this scan needs it");
    const int64_t wanted = std::max(units, 1), columns = int64_t(table->shape(2));
    if (width != wanted || first < 0 || first > columns - width)
      refuse(std::string(NAMES[which]) + " has " + std::to_string(width) + " columns from column " +
             std::to_string(first) + " on, expected " + std::to_string(wanted) +
             " columns inside the table of " + std::to_string(columns));
    return {table->data() + first, table->stride(0), table->stride(1)};
  }

  // Checks that the table has the requested trajectories and rows.
  void check_table(int64_t batch) const {
    check_shape("index", *index, {batch});
    check_contiguous("index", *index);
    const int64_t n =
        in_range("the number of trajectories in the table", int64_t(table->shape(0)), 0, MAX_COUNT);
    for (int64_t i = 0; i < batch; ++i)
      if (index->data()[i] < 0 || index->data()[i] >= n)
        refuse("index " + std::to_string(index->data()[i]) + " is not in the table of " +
               std::to_string(n) + " trajectories");
    if (rows > int64_t(table->shape(1)) || (table->shape(2) > 1 && table->stride(2) != 1))
      refuse("the table has shape " + shape_of(*table) + ", expected at least " +
             std::to_string(rows) + " rows and contiguous columns");
  }
};

template <class T>
void take_rows(Job<T>& job, const Spec& s, const StepInputs<T>& f, int64_t batch) {
  InputPointers<T>& r = job.inputs;
  r.gap = f.get(GAP, batch, -1);
  r.update = f.get(UPDATE, batch, -1);
  r.values = f.get(VALUES, batch, s.channels);
  r.mask = f.get(MASK, batch, s.channels);
  if (s.time_inputs) r.time_input = f.get(TIME_INPUT, batch, s.time_inputs);
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
  if (s.nodes) {
    r.first_node = f.get(FIRST_NODE, batch, -1);
    r.node = f.get(NODE, batch, -1);
    r.commit = f.get(COMMIT, batch, -1);
  }
  if (s.trend) {
    r.level_gain = f.get(LEVEL_GAIN, batch, s.channels);
    r.slope_gain = f.get(SLOPE_GAIN, batch, s.channels);
  }
  if (s.bounded && s.anchored) {
    if (!f.low || !f.high) refuse("low or high is missing; a bounded scan needs them");
    check_shape("low", *f.low, {anchors_of(s)});
    check_shape("high", *f.high, {anchors_of(s)});
    r.low = f.low->data(), r.high = f.high->data();
  }
  if (s.decoder.layers && f.use_prediction) {
    check_shape("use_prediction", *f.use_prediction, {f.rows});
    r.use_prediction = f.use_prediction->data();
  }
}
