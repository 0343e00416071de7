// A model that runs live: part of module.cpp. One trajectory, one row at a time, every buffer made
// once. What torch computes for a batch outside the scan (ages, facts of a row, scaling of an
// anchored state) stands here again for one row, operation by operation, so that the bits agree:
// offbeat.models.ages.ages and offbeat.models.recurrence.RecurrentModel.facts.

enum Age { AGE_NONE, AGE_ELAPSED, AGE_GAP, AGE_DELTA };

struct Clockwork {  // how a model reads time; all in s
  double unit = 1, age_unit = 1, elapsed_limit = 1, longest_delta = 1;
  int age = AGE_NONE;
  bool from_first_row = false, last_row = false, every_row = false, starts_only = false;
  bool exponential = false;  // the decay is made from elapsed time, not from ages
};

template <class T>
class Live {
 public:
  Live(const Spec& spec, const std::string& body, const Const<T>& weights, const Const<T>& mean,
       const Const<T>& std, const std::vector<int>& decoder, const Maybe<T>& decoder_weights,
       const Const<T>& first_state, const Clockwork& clockwork)
      : spec_(spec),
        body_(typed<T>(body_named(body))),
        clock_(clockwork),
        packed_(body_.stream_packed_size(spec)),
        scratch_(body_.stream_scratch(spec)),
        decoder_(perceptron_of(decoder, TANH)),
        decoder_packed_(decoder.empty() ? 1 : body_.stream_perceptron_size(decoder_)),
        decoder_scratch_(decoder.empty() ? 1 : body_.stream_perceptron_scratch(decoder_)) {
    const int C = spec.channels, S = state_of(spec);
    check_shape("weights", weights, {flat_size(spec)});
    check_shape("mean", mean, {C});
    check_shape("std", std, {C});
    check_shape("first_state", first_state, {S});
    body_.stream_pack(spec_, weights.data(), packed_.get());
    if (decoder_.layers) {
      if (!decoder_weights) refuse("decoder_weights is missing; this model has a decoder");
      check_shape("decoder_weights", *decoder_weights, {perceptron_flat(decoder_)});
      body_.stream_perceptron_pack(decoder_, decoder_weights->data(), decoder_packed_.get());
      if (decoder_.sizes[0] != spec.hidden || decoder_.sizes[decoder_.layers] != C)
        refuse("the decoder does not fit the model");
    }
    mean_.assign(mean.data(), mean.data() + C);
    std_.assign(std.data(), std.data() + C);
    first_.state.assign(first_state.data(), first_state.data() + S);
    first_.last = mean_;
    first_.channel_at.assign(C, -INFINITY);
    now_ = first_;
    for (std::vector<T>* v : {&values_, &mask_, &delta_, &last_, &start_, &end_})
      v->assign(C, T(0));
    age_.assign(std::max(spec.ages, 1), T(0));
    before_.assign(S, T(0));
    after_.assign(S, T(0));
    out_.assign(std::max(C, 1), T(0));
  }

  void reset() { now_ = first_; }

  void observe(double time, const Const<T>& values, const Const<bool>& mask, bool fed) {
    check_shape("values", values, {spec_.channels});
    check_shape("mask", mask, {spec_.channels});
    run(time, values.data(), mask.data(), fed);
    now_.state.swap(after_);
    now_.time = time;
    now_.start = next_start_;
    if (seen_) now_.observed_at = time;
    for (int c = 0; c < spec_.channels; ++c)
      if (mask.data()[c]) now_.channel_at[c] = time, now_.last[c] = values.data()[c];
    now_.updated = update_;
    ++now_.rows;
  }

  void predict(const Const<double>& times, Array<double> out) {
    const int64_t n = times.ndim() == 1 ? int64_t(times.shape(0)) : 0;
    check_shape("times", times, {n});
    check_shape("out", out, {n, spec_.channels});
    check_contiguous("out", out);
    for (int64_t i = 0; i < n; ++i) {
      const T* state = now_.state.data();
      if (!clock_.last_row) {
        run(times.data()[i], nullptr, nullptr, false);
        state = before_.data();
      }
      read(state, out.data() + i * spec_.channels);
    }
  }

  void reserve(int slots) { slots_.assign(slots, first_); }
  void save(int slot) { slots_.at(slot) = now_; }
  void load(int slot) { now_ = slots_.at(slot); }

  // state, time, start, observed_at, channel_at, last, updated, rows: exact as doubles.
  int64_t size() const { return int64_t(now_.state.size()) + 2 * spec_.channels + 5; }
  void export_to(Array<double> out) const {
    check_shape("out", out, {size()});
    double* p = out.data();
    for (T v : now_.state) *p++ = v;
    *p++ = now_.time, *p++ = now_.start, *p++ = now_.observed_at;
    for (double v : now_.channel_at) *p++ = v;
    for (T v : now_.last) *p++ = v;
    *p++ = now_.updated, *p++ = double(now_.rows);
  }
  void restore(const Const<double>& in) {
    check_shape("state", in, {size()});
    const double* p = in.data();
    for (T& v : now_.state) v = T(*p++);
    now_.time = *p++, now_.start = *p++, now_.observed_at = *p++;
    for (double& v : now_.channel_at) v = *p++;
    for (T& v : now_.last) v = T(*p++);
    now_.updated = *p++ != 0, now_.rows = int64_t(*p++);
  }
  int64_t rows() const { return now_.rows; }

 private:
  struct State {
    std::vector<T> state, last;
    std::vector<double> channel_at;
    double time = NAN, start = INFINITY, observed_at = -INFINITY;
    bool updated = false;
    int64_t rows = 0;
  };

  // Carries the state to a row and over it; leaves both in before_ and after_.
  void run(double time, const T* values, const bool* mask, bool fed) {
    const int C = spec_.channels;
    seen_ = false;
    for (int c = 0; c < C; ++c) {
      const bool on = mask && mask[c];
      seen_ |= on;
      mask_[c] = on;
      values_[c] = !on ? T(0) : spec_.anchored ? (values[c] - mean_[c]) / std_[c] : values[c];
    }
    const double before = std::isnan(now_.time) ? time : now_.time;
    const bool starts = clock_.from_first_row || seen_;
    next_start_ = std::min(now_.start, starts ? time : INFINITY);
    const double clock = std::max(now_.observed_at, next_start_);
    const double past = std::max(time - clock, 0.0), past_before = std::max(before - clock, 0.0);
    const double elapsed = std::min(past, clock_.elapsed_limit);
    const double elapsed_before = std::min(past_before, clock_.elapsed_limit);
    const double lost = past - elapsed, lost_before = past_before - elapsed_before;
    update_ = clock_.starts_only  ? seen_ && std::isinf(now_.observed_at)
              : clock_.every_row ? true
                                 : seen_;
    if (spec_.decay_features || spec_.input_decay || clock_.age == AGE_DELTA) {
      for (int c = 0; c < C; ++c) {
        const double channel_clock = std::max(now_.channel_at[c], next_start_);
        const double delta = std::max(time - lost - channel_clock, 0.0);
        const double delta_before = std::max((before - lost_before) - channel_clock, 0.0);
        delta_[c] = T(delta / clock_.unit);
        if (!clock_.exponential) start_[c] = T(delta_before / clock_.unit), end_[c] = delta_[c];
        if (clock_.age == AGE_DELTA)
          age_[c] = T(std::min(delta, clock_.longest_delta) / clock_.age_unit);
      }
    }
    if (clock_.exponential)
      start_[0] = T(elapsed_before / clock_.unit), end_[0] = T(elapsed / clock_.unit);
    if (clock_.age == AGE_ELAPSED) age_[0] = T(elapsed / clock_.age_unit);
    if (clock_.age == AGE_GAP) age_[0] = T((time - before) / clock_.age_unit);

    StreamRow<T> row;
    row.spec = &spec_;
    row.packed = packed_.get();
    row.gap = T((elapsed - elapsed_before) / clock_.unit);
    row.update = update_;
    row.updated = now_.updated;
    row.values = values_.data(), row.mask = mask_.data(), row.age = age_.data();
    row.decay_start = start_.data(), row.decay_end = end_.data();
    row.delta = delta_.data(), row.last = now_.last.data(), row.mean = mean_.data();
    row.fed = fed;
    row.state = now_.state.data(), row.before = before_.data(), row.after = after_.data();
    row.scratch = scratch_.get();
    body_.stream_row(row);
  }

  void read(const T* state, double* out) {
    if (decoder_.layers) {
      body_.stream_perceptron(decoder_, decoder_packed_.get(), state, out_.data(),
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
  const Body<T>& body_;
  Clockwork clock_;
  Buffer<T> packed_, scratch_;
  Perceptron decoder_;
  Buffer<T> decoder_packed_, decoder_scratch_;
  std::vector<T> mean_, std_, values_, mask_, delta_, last_, start_, end_, age_, before_, after_,
      out_;
  State first_, now_;
  std::vector<State> slots_;
  bool seen_ = false, update_ = false;
  double next_start_ = 0;
};

template <class T>
void bind_live(nb::module_& m, const std::string& suffix) {
  nb::class_<Live<T>>(m, ("Live_" + suffix).c_str())
      .def(
          "__init__",
          [](Live<T>* self, const Spec& spec, const std::string& body, Const<T> weights,
             Const<T> mean, Const<T> std, const std::vector<int>& decoder,
             Maybe<T> decoder_weights, Const<T> first_state, double unit, double age_unit,
             double elapsed_limit, double longest_delta, int age, bool from_first_row,
             bool last_row, bool every_row, bool starts_only, bool exponential) {
            Clockwork c;
            c.unit = unit, c.age_unit = age_unit, c.elapsed_limit = elapsed_limit;
            c.longest_delta = longest_delta, c.age = age, c.from_first_row = from_first_row;
            c.last_row = last_row, c.every_row = every_row, c.starts_only = starts_only;
            c.exponential = exponential;
            new (self) Live<T>(spec, body, weights, mean, std, decoder, decoder_weights,
                               first_state, c);
          },
          nb::arg("spec"), nb::arg("body"), nb::arg("weights").noconvert(),
          nb::arg("mean").noconvert(), nb::arg("std").noconvert(), nb::arg("decoder"),
          nb::arg("decoder_weights").noconvert().none(), nb::arg("first_state").noconvert(),
          nb::arg("unit"), nb::arg("age_unit"), nb::arg("elapsed_limit"),
          nb::arg("longest_delta"), nb::arg("age"), nb::arg("from_first_row"),
          nb::arg("last_row"), nb::arg("every_row"), nb::arg("starts_only"),
          nb::arg("exponential"))
      .def("reset", &Live<T>::reset)
      .def("observe", &Live<T>::observe, nb::arg("time"), nb::arg("values").noconvert(),
           nb::arg("mask").noconvert(), nb::arg("fed"))
      .def("predict", &Live<T>::predict, nb::arg("times").noconvert(), nb::arg("out").noconvert())
      .def("reserve", &Live<T>::reserve, nb::arg("slots"))
      .def("save", &Live<T>::save, nb::arg("slot"))
      .def("load", &Live<T>::load, nb::arg("slot"))
      .def("export_to", &Live<T>::export_to, nb::arg("out").noconvert())
      .def("restore", &Live<T>::restore, nb::arg("state").noconvert())
      .def_prop_ro("size", &Live<T>::size)
      .def_prop_ro("rows", &Live<T>::rows);
}
