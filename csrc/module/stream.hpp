// Streaming inference: part of module.cpp and library/stream.cpp. One trajectory, one row at a time,
// in buffers that are allocated once. The step inputs and the scaling of an anchored state, which
// PyTorch computes for a batch, are computed here for one row by the same operations in the same
// order, so that the bits are equal.

constexpr double LARGEST_VALUE = 1e15;  // models/model.py

enum TimeInput { TIME_INPUT_NONE, TIME_INPUT_ELAPSED, TIME_INPUT_GAP, TIME_INPUT_DELTA };

struct TimeSettings {  // how a model reads time; units and limits in s
  double unit = 1, time_input_unit = 1, elapsed_limit = 1, longest_delta = 1;
  int64_t time_input = TIME_INPUT_NONE;
  bool from_first_row = false, last_row = false, every_row = false, starts_only = false;
  bool exponential = false;  // the decay depends on the elapsed time, not on delta
};

// kernels/spec.py: nodes_before. The number of the last node before a time, and the time since
// then.
double node_before(double time, double& rest) {
  time = std::min(time, double(MOST_NODES));
  const double node = std::floor(time + 1e-6);
  rest = time - node < 1e-6 ? 0 : time - node;
  return node;
}

template <class T>
class StreamEngine {
 public:
  StreamEngine(const Spec& spec, const std::string& set, const Const<T>& weights,
               const Const<T>& mean, const Const<T>& std, const std::vector<int64_t>& decoder,
               const Maybe<T>& decoder_weights, const Const<T>& first_state, const Maybe<T>& low,
               const Maybe<T>& high, const Maybe<double>& filters, const Maybe<double>& prior,
               const TimeSettings& settings)
      : spec_(spec),
        kernels_(typed<T>(find_instruction_set(set))),
        time_(settings),
        decoder_(perceptron_of(decoder, TANH)),
        packed_("the packed weights", kernels_.stream_packed_size(spec)),
        scratch_("the scratch memory", kernels_.stream_scratch(spec)),
        decoder_packed_("the packed decoder",
                        decoder_.layers ? kernels_.stream_perceptron_size(decoder_) : 0),
        decoder_scratch_("the scratch memory of the decoder",
                         decoder_.layers ? kernels_.stream_perceptron_scratch(decoder_) : 0) {
    const int C = spec.channels, F = spec.decay_features, S = state_of(spec);
    const int64_t widths[] = {0, 1, 1, C};
    in_range("time_input", time_.time_input, TIME_INPUT_NONE, TIME_INPUT_DELTA);
    in_range("time_inputs", spec.time_inputs, widths[time_.time_input], widths[time_.time_input]);
    if (F) in_range("decay", F, time_.exponential ? 1 : C, time_.exponential ? 1 : C);
    check_shape("weights", weights, {flat_size(spec)});
    check_shape("mean", mean, {C});
    check_shape("std", std, {C});
    check_shape("first_state", first_state, {S});
    if (bool(decoder_.layers) == bool(spec.anchored))
      refuse("a state has either anchored channels or a decoder");
    if (decoder_.layers) {
      check_decoder(decoder_, spec);
      if (!decoder_weights) refuse("decoder_weights is None, but this model has a decoder");
      check_shape("decoder_weights", *decoder_weights, {perceptron_flat(decoder_)});
      kernels_.stream_perceptron_pack(decoder_, decoder_weights->data(), decoder_packed_.get());
    }
    kernels_.stream_pack(spec_, weights.data(), packed_.get());
    if (spec.bounded) {
      if (!low || !high) refuse("low or high is None, but this model is bounded");
      const int n = spec.anchored ? anchors_of(spec) : C;
      check_shape("low", *low, {n});
      check_shape("high", *high, {n});
      low_.assign(low->data(), low->data() + n);
      high_.assign(high->data(), high->data() + n);
    }
    if (spec.trend) {
      if (!filters || !prior) refuse("filters or prior is None, but this model has a trend");
      filters_ = filter_table(*filters, C);
      check_shape("prior", *prior, {C, 3});
      check_contiguous("prior", *prior);
      first_.covariance.assign(prior->data(), prior->data() + 3 * C);
    }
    mean_.assign(mean.data(), mean.data() + C);
    std_.assign(std.data(), std.data() + C);
    first_.state.assign(first_state.data(), first_state.data() + S);
    first_.last = mean_;
    first_.channel_at.assign(C, -INFINITY);
    now_ = first_;
    for (std::vector<T>* v : {&values_, &mask_, &delta_, &start_, &end_, &last_, &out_,
                              &level_gain_, &slope_gain_})
      v->assign(C, T(0));
    time_input_.assign(std::max(spec.time_inputs, 1), T(0));
    before_.assign(S, T(0));
    after_.assign(S, T(0));
  }

  void reset() { now_ = first_; }

  void observe(double time, const Const<T>& values, const Const<bool>& mask, bool use_prediction) {
    check_shape("values", values, {spec_.channels});
    check_shape("mask", mask, {spec_.channels});
    take(time, values.data(), mask.data(), use_prediction);
  }
  void take(double time, const T* values, const bool* mask, bool use_prediction) {
    run(time, values, mask, use_prediction);
    now_.state.swap(after_);
    now_.covariance.swap(next_covariance_);
    now_.time = time;
    now_.start = next_start_;
    if (observed_) now_.observed_at = time;
    for (int c = 0; c < spec_.channels; ++c)
      if (mask[c]) now_.channel_at[c] = time, now_.last[c] = values[c];
    if (observed_ || !spec_.nodes) now_.updated = update_;
    ++now_.rows;
  }

  void predict(const Const<double>& times, Array<double> out) {
    const int64_t n = times.ndim() == 1 ? int64_t(times.shape(0)) : 0;
    check_shape("times", times, {n});
    check_shape("out", out, {n, spec_.channels});
    check_contiguous("out", out);
    for (int64_t i = 0; i < n; ++i)
      predict_at(times.data()[i], out.data() + i * spec_.channels);
  }
  // The prediction of a row, and its observation. The dynamics run once, as in a batch.
  void step(double time, const T* values, const bool* mask, double* out) {
    if (out && time_.last_row) read(now_.state.data(), out);
    take(time, values, mask, false);
    if (out && !time_.last_row) read(before_.data(), out);
  }
  void predict_at(double time, double* out) {
    const T* state = now_.state.data();
    if (!time_.last_row) {
      run(time, nullptr, nullptr, false);
      state = before_.data();
    }
    read(state, out);
  }

  void reserve(int64_t slots) {
    in_range("slots", slots, 0, memory_limit() / (8 * size() + 256));
    slots_.assign(size_t(slots), first_);
  }
  void save(int slot) { slots_.at(slot) = now_; }
  void load(int slot) { now_ = slots_.at(slot); }

  // state, time, start, observed_at, channel_at, last, updated, covariance, rows: exact as doubles.
  int64_t size() const {
    return int64_t(now_.state.size() + now_.covariance.size()) + 2 * spec_.channels + 5;
  }
  void export_to(Array<double> out) const {
    check_shape("out", out, {size()});
    double* p = out.data();
    for (T v : now_.state) *p++ = v;
    *p++ = now_.time, *p++ = now_.start, *p++ = now_.observed_at;
    for (double v : now_.channel_at) *p++ = v;
    for (T v : now_.last) *p++ = v;
    *p++ = now_.updated;
    for (double v : now_.covariance) *p++ = v;
    *p++ = double(now_.rows);
  }
  void restore(const Const<double>& in) {
    check_shape("state", in, {size()});
    const double* p = in.data();
    const double rows = p[size() - 1];
    if (!(rows >= 0 && rows < 9e15)) refuse("the state has " + text_of(rows) + " rows");
    for (T& v : now_.state) v = T(*p++);
    now_.time = *p++, now_.start = *p++, now_.observed_at = *p++;
    for (double& v : now_.channel_at) v = *p++;
    for (T& v : now_.last) v = T(*p++);
    now_.updated = *p++ != 0;
    for (double& v : now_.covariance) v = *p++;
    now_.rows = int64_t(rows);
  }
  int64_t rows() const { return now_.rows; }
  int64_t channels() const { return spec_.channels; }

 private:
  struct State {
    std::vector<T> state, last;
    std::vector<double> channel_at, covariance;
    double time = NAN, start = INFINITY, observed_at = -INFINITY;
    bool updated = false;
    int64_t rows = 0;
  };

  // Computes the state before and after a row, in before_ and after_.
  void run(double time, const T* values, const bool* mask, bool use_prediction) {
    const int C = spec_.channels;
    observed_ = false;
    for (int c = 0; c < C; ++c) {
      const bool on = mask && mask[c];
      observed_ |= on;
      mask_[c] = on;
      values_[c] = !on ? T(0) : spec_.anchored ? (values[c] - mean_[c]) / std_[c] : values[c];
      last_[c] = now_.last[c];
      if (!spec_.bounded) continue;
      const T low = spec_.anchored ? T(-LARGEST_VALUE) : low_[c];
      const T high = spec_.anchored ? T(LARGEST_VALUE) : high_[c];
      if (on) values_[c] = std::min(std::max(values_[c], low), high);
      if (!spec_.anchored) last_[c] = std::min(std::max(last_[c], low), high);
    }
    const double before = std::isnan(now_.time) ? time : now_.time;
    const bool starts = time_.from_first_row || observed_;
    next_start_ = std::min(now_.start, starts ? time : INFINITY);
    const double clock = std::max(now_.observed_at, next_start_);
    const double past = std::max(time - clock, 0.0), past_before = std::max(before - clock, 0.0);
    const double elapsed = std::min(past, time_.elapsed_limit);
    const double elapsed_before = std::min(past_before, time_.elapsed_limit);
    const double lost = past - elapsed, lost_before = past_before - elapsed_before;
    update_ = time_.starts_only ? observed_ && std::isinf(now_.observed_at)
              : time_.every_row ? true
                                : observed_;
    next_covariance_ = now_.covariance;
    if (spec_.decay_features || spec_.input_decay || time_.time_input == TIME_INPUT_DELTA ||
        spec_.trend) {
      for (int c = 0; c < C; ++c) {
        const double channel_clock = std::max(now_.channel_at[c], next_start_);
        const double delta = std::max(time - lost - channel_clock, 0.0);
        const double delta_before = std::max((before - lost_before) - channel_clock, 0.0);
        delta_[c] = T(delta / time_.unit);
        if (spec_.trend) {
          double level = 0, slope = 0;
          if (mask && mask[c])
            filter_gain(filters_, c, delta, !std::isinf(now_.channel_at[c]), time_.unit,
                        next_covariance_.data() + 3 * c, level, slope);
          level_gain_[c] = T(level), slope_gain_[c] = T(slope);
        }
        if (!time_.exponential && !spec_.nodes)
          start_[c] = T(delta_before / time_.unit), end_[c] = delta_[c];
        if (!time_.exponential && spec_.nodes) {
          const double since = std::max(std::min(clock, time) - channel_clock, 0.0);
          start_[c] = T(since / time_.unit);
          end_[c] = T((since + time_.elapsed_limit) / time_.unit);
        }
        if (time_.time_input == TIME_INPUT_DELTA)
          time_input_[c] = T(std::min(delta, time_.longest_delta) / time_.time_input_unit);
      }
    }
    if (time_.exponential && !spec_.nodes)
      start_[0] = T(elapsed_before / time_.unit), end_[0] = T(elapsed / time_.unit);
    if (time_.exponential && spec_.nodes)
      start_[0] = T(0), end_[0] = T(time_.elapsed_limit / time_.unit);
    if (time_.time_input == TIME_INPUT_ELAPSED) time_input_[0] = T(elapsed / time_.time_input_unit);
    if (time_.time_input == TIME_INPUT_GAP)
      time_input_[0] = T((time - before) / time_.time_input_unit);

    StreamRow<T> row;
    row.spec = &spec_;
    row.packed = packed_.get();
    row.gap = T((elapsed - elapsed_before) / time_.unit);
    if (spec_.nodes) {
      row.gap = T(elapsed / time_.unit);
      row.commit = observed_;
      if (spec_.max_step > 0) {
        double rest = 0;
        const double step = time_.unit * spec_.max_step;
        row.first_node = T(node_before(elapsed_before / step, rest));
        row.node = T(node_before(elapsed / step, rest));
        row.gap = T(rest * spec_.max_step);
        steps_to_node(row.first_node, row.node);
      }
    }
    row.update = update_;
    row.updated = now_.updated;
    row.values = values_.data(), row.mask = mask_.data(), row.time_input = time_input_.data();
    row.decay_start = start_.data(), row.decay_end = end_.data();
    row.delta = delta_.data(), row.last = last_.data(), row.mean = mean_.data();
    row.low = low_.data(), row.high = high_.data();
    row.level_gain = level_gain_.data(), row.slope_gain = slope_gain_.data();
    row.use_prediction = use_prediction;
    row.state = now_.state.data(), row.before = before_.data(), row.after = after_.data();
    row.scratch = scratch_.get();
    if (!spec_.nodes) steps_of_gap(spec_, row.gap);  // refuses a gap of too many
    kernels_.stream_row(row);
  }

  void read(const T* state, double* out) {
    if (decoder_.layers) {
      kernels_.stream_perceptron(decoder_, decoder_packed_.get(), state, out_.data(),
                                 decoder_scratch_.get());
      for (int c = 0; c < spec_.channels; ++c) out[c] = out_[c];
      return;
    }
    for (int c = 0; c < spec_.channels; ++c) {
      const T scaled = state[c] * std_[c];
      out[c] = scaled + mean_[c];
    }
  }

  Spec spec_;
  const Kernels<T>& kernels_;
  TimeSettings time_;
  Perceptron decoder_;
  Buffer<T> packed_, scratch_, decoder_packed_, decoder_scratch_;
  std::vector<T> mean_, std_, low_, high_, values_, mask_, delta_, start_, end_, last_, time_input_,
      before_, after_, out_, level_gain_, slope_gain_;
  std::vector<double> next_covariance_;
  FilterTable filters_;
  State first_, now_;
  std::vector<State> slots_;
  bool observed_ = false, update_ = false;
  double next_start_ = 0;
};
