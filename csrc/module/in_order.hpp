// Live streams of messages in the order of time: part of module.cpp. The way of a message through
// stream/live.py, messages.py, placing.py and history.py in one call, by the same operations in the
// same order, for what is most frequent: a message that is the next row, joins the newest row, or
// is late and dropped. Anything else is refused unchanged (OTHER), and Python takes it.

enum Outcome { OTHER, NEW, MERGED, DUPLICATE, LATE, STALE };

constexpr double EXACT = 9007199254740992.0;  // 2^53

struct InOrderSettings {  // of stream/options.py, in s
  double ticks = 1, merge_within = 0, jump_back = 1, jump_ahead = INFINITY, stale_after = INFINITY,
         long_gap = INFINITY;
  bool resets_long_gap = false, drops_late = true, takes_last = true, takes_twice = true;
  int64_t kept = 1;
};

struct Counts {
  int64_t messages = 0, rows = 0, merged = 0, duplicates = 0, late = 0, stale = 0, empty = 0,
          not_finite = 0, long_gaps = 0, predictions = 0;
};

class Time {  // a plain number of Python: an integer of 64 bits, or a double
 public:
  bool read(PyObject* o) {
    if (PyFloat_CheckExact(o)) {
      whole_ = false;
      real_ = PyFloat_AsDouble(o);
      return std::abs(real_) < EXACT;
    }
    if (!PyLong_CheckExact(o)) return false;
    int overflow = 0;
    integer_ = PyLong_AsLongLongAndOverflow(o, &overflow);
    whole_ = true;
    real_ = double(integer_);
    return !overflow;
  }
  // messages.py: Clock.seconds. False: it needs numbers of Python.
  bool since(const Time& origin, double ticks, double& seconds) const {
    if (whole_ && origin.whole_) {
      long long difference;
      if (__builtin_sub_overflow(integer_, origin.integer_, &difference)) return false;
      seconds = double(difference) / ticks;
      return std::abs(double(difference)) < EXACT;
    }
    seconds = (real_ - origin.real_) / ticks;
    return std::abs(real_) < EXACT && std::abs(origin.real_) < EXACT;
  }

 private:
  bool whole_ = false;
  long long integer_ = 0;
  double real_ = 0;
};

template <class T>
class InOrder {
 public:
  // index: name of a channel to its number; array: the type numpy.ndarray; reach: (2, channels)
  // values between these count as measured; exogenous: channels that are not predicted.
  InOrder(StreamEngine<T>& engine, nb::dict index, nb::object array, const Const<double>& shift,
          const Const<double>& scale, const Const<double>& reach,
          const std::vector<int64_t>& exogenous, const InOrderSettings& settings)
      : engine_(engine), index_(std::move(index)), array_(std::move(array)), set_(settings) {
    const int64_t C = channels_ = engine.channels();
    check_shape("shift", shift, {C});
    check_shape("scale", scale, {C});
    check_shape("reach", reach, {2, C});
    check_contiguous("reach", reach);
    in_range("kept", set_.kept, 1, INT32_MAX);
    shift_.assign(shift.data(), shift.data() + C);
    scale_.assign(scale.data(), scale.data() + C);
    low_.assign(reach.data(), reach.data() + C);
    high_.assign(reach.data() + C, reach.data() + 2 * C);
    for (int64_t c : exogenous) exogenous_.push_back(in_range("exogenous", c, 0, C - 1));
    raw_.assign(C, 0.0);
    row_ = joined_ = Row{0, 0, -1, std::vector<T>(C, T(0)), std::vector<uint8_t>(C, 0)};
  }

  // Continues from the rows of Python: their times, slots, and the values of the newest.
  bool open(nb::handle origin, const std::vector<double>& times, const std::vector<int64_t>& slots,
            const Const<T>& values, const Const<bool>& mask, const std::vector<int64_t>& free,
            double floor, std::optional<double> seen, double longest_gap) {
    check_shape("values", values, {channels_});
    check_shape("mask", mask, {channels_});
    if (times.empty() || times.size() != slots.size() || int64_t(times.size()) > set_.kept ||
        free.size() < 2)
      refuse("rows and slots do not fit");
    if (!origin_.read(origin.ptr())) return false;
    rows_.resize(size_t(set_.kept) + 1, row_);
    first_ = 0, count_ = times.size(), undo_ = 2 * set_.kept + 1, free_ = free;
    for (size_t i = 0; i < count_; ++i)
      rows_[i].time = times[i], rows_[i].slot = slots[i], rows_[i].given = int64_t(i);
    Row& last = newest_row();
    std::copy_n(values.data(), channels_, last.values.begin());
    for (int64_t c = 0; c < channels_; ++c) last.mask[c] = mask.data()[c];
    floor_ = floor, seen_ = seen.value_or(NAN), longest_gap_ = longest_gap;
    counts_ = Counts();
    return open_ = true;
  }

  // Number of rows that Python does not have.
  int64_t made() const {
    int64_t n = 0;
    for (size_t i = 0; i < count_; ++i) n += row(i).given < 0;
    return n;
  }

  // Returns what has changed since `open`: the numbers of the given rows that are left, times and
  // slots of the others, whose values are written, free slots, floor, seen, the longest gap, and
  // the counts.
  nb::tuple close(Array<T> values, Array<bool> mask) {
    const int64_t n = made();
    check_shape("values", values, {n, channels_});
    check_shape("mask", mask, {n, channels_});
    check_contiguous("values", values);
    check_contiguous("mask", mask);
    std::vector<double> times;
    std::vector<int64_t> given, slots;
    for (size_t i = 0; i < count_; ++i) {
      const Row& r = row(i);
      if (r.given >= 0) {
        given.push_back(r.given);
        continue;
      }
      std::copy(r.values.begin(), r.values.end(), values.data() + times.size() * channels_);
      for (int64_t c = 0; c < channels_; ++c)
        mask.data()[times.size() * channels_ + c] = r.mask[c] != 0;
      times.push_back(r.time), slots.push_back(r.slot);
    }
    open_ = false;
    nb::dict counts;
    const Counts& c = counts_;
    counts["messages"] = c.messages, counts["rows"] = c.rows, counts["merged"] = c.merged;
    counts["duplicates"] = c.duplicates, counts["late"] = c.late, counts["stale"] = c.stale;
    counts["empty"] = c.empty, counts["not_finite"] = c.not_finite;
    counts["long_gaps"] = c.long_gaps, counts["predictions"] = c.predictions;
    std::optional<double> seen;
    if (!std::isnan(seen_)) seen = seen_;
    return nb::make_tuple(given, times, slots, free_, floor_, seen, longest_gap_, counts);
  }

  bool is_open() const { return open_; }
  double newest() const { return row(count_ - 1).time; }

  // live.py: step, and observe without `out`. `out` is written where the outcome is NEW.
  int observe(nb::handle t, nb::handle values, const std::optional<Array<double>>& out) {
    if (out) check_shape("out", *out, {channels_});
    Time at;
    double time = 0;
    int64_t measured = 0, not_finite = 0;
    if (!open_ || !at.read(t.ptr()) || !at.since(origin_, set_.ticks, time) ||
        !read(values.ptr()))
      return OTHER;
    scale(measured, not_finite);
    const int outcome = place(time, measured, out ? out->data() : nullptr);
    if (outcome == OTHER) return OTHER;
    ++counts_.messages;
    counts_.not_finite += not_finite;
    counts_.empty += measured == 0;
    return outcome;
  }

  // live.py: predict, for one time.
  bool predict(nb::handle t, Array<double> out) {
    check_shape("out", out, {channels_});
    Time at;
    double time = 0;
    if (!open_ || !at.read(t.ptr()) || !at.since(origin_, set_.ticks, time)) return false;
    if (newest() - time > set_.merge_within) return false;
    try {
      engine_.predict_at(std::max(time, newest()), out.data());
      if (!original(out.data())) return false;
    } catch (const std::exception&) {  // Python repeats it, and reports it
      return false;
    }
    return ++counts_.predictions, true;
  }

 private:
  struct Row {
    double time;
    int64_t slot, given;  // its number when `open` was called; -1: new, or changed since
    std::vector<T> values;
    std::vector<uint8_t> mask;
    const bool* measured() const { return reinterpret_cast<const bool*>(mask.data()); }
  };

  Row& row(size_t i) { return rows_[(first_ + i) % rows_.size()]; }
  const Row& row(size_t i) const { return rows_[(first_ + i) % rows_.size()]; }
  Row& newest_row() { return row(count_ - 1); }

  // --- messages.py: RowReader ---------------------------------------------------------------

  static bool number(PyObject* o, double& value) {
    if (o == Py_None) return value = NAN, true;
    if (PyFloat_Check(o)) return value = PyFloat_AsDouble(o), true;
    if (!PyLong_CheckExact(o)) return false;
    int overflow = 0;
    value = double(PyLong_AsLongLongAndOverflow(o, &overflow));
    return !overflow;
  }

  bool read(PyObject* values) {
    if (reinterpret_cast<PyObject*>(Py_TYPE(values)) == array_.ptr()) return read_array(values);
    if (PyDict_CheckExact(values)) {
      std::fill(raw_.begin(), raw_.end(), NAN);
      PyObject *name, *value;
      for (Py_ssize_t at = 0; PyDict_Next(values, &at, &name, &value);) {
        if (!PyUnicode_CheckExact(name)) return false;
        PyObject* found = PyDict_GetItemWithError(index_.ptr(), name);  // borrowed
        if (!found || !number(value, raw_[size_t(PyLong_AsLong(found))])) return false;
      }
      return true;
    }
    const bool list = PyList_CheckExact(values);
    if (!list && !PyTuple_CheckExact(values)) return false;
    if ((list ? PyList_Size(values) : PyTuple_Size(values)) != channels_) return false;
    for (int64_t c = 0; c < channels_; ++c)
      if (!number(list ? PyList_GetItem(values, c) : PyTuple_GetItem(values, c), raw_[c]))
        return false;
    return true;
  }

  bool read_array(PyObject* values) {
    Py_buffer view;
    if (PyObject_GetBuffer(values, &view, PyBUF_STRIDES | PyBUF_FORMAT)) {
      PyErr_Clear();
      return false;
    }
    const std::string_view format(view.format);
    const bool f64 = format == "d", f32 = format == "f";
    const bool good = view.ndim == 1 && view.shape[0] == channels_ && (f64 || f32);
    for (int64_t c = 0; good && c < channels_; ++c) {
      const char* at = static_cast<const char*>(view.buf) + c * view.strides[0];
      float narrow;
      if (f64) std::memcpy(&raw_[c], at, sizeof(double));
      if (f32) std::memcpy(&narrow, at, sizeof(float)), raw_[c] = narrow;
    }
    PyBuffer_Release(&view);
    return good;
  }

  void scale(int64_t& measured, int64_t& not_finite) {
    for (int64_t c = 0; c < channels_; ++c) {
      const double raw = raw_[c];
      const bool on = raw >= low_[c] && raw <= high_[c];
      row_.mask[c] = on;
      measured += on;
      not_finite += !on && !std::isnan(raw);
      row_.values[c] = T(((on ? raw : shift_[c]) - shift_[c]) / scale_[c]);
    }
  }

  // --- placing.py: Placement, history.py: History -------------------------------------------

  int place(double time, int64_t measured, double* out) {
    const double ahead = time - newest();
    if (ahead < -set_.jump_back || ahead > set_.jump_ahead) return OTHER;
    if (std::abs(ahead) <= set_.merge_within) return join();
    if (ahead > 0) return append(time, measured, out);
    if (-ahead > set_.stale_after) return ++counts_.stale, STALE;
    return set_.drops_late ? (++counts_.late, LATE) : OTHER;
  }

  int append(double time, int64_t measured, double* out) {
    const double gap = measured && !std::isnan(seen_) ? time - seen_ : 0.0;
    const bool is_long = gap > set_.long_gap;
    if (is_long && set_.resets_long_gap) return OTHER;
    try {
      engine_.save(int(free_.back()));
      engine_.step(time, row_.values.data(), row_.measured(), out);
      if (out && !original(out)) {
        engine_.load(int(free_.back()));
        return OTHER;
      }
    } catch (const std::exception&) {  // Python repeats it, and reports it
      return OTHER;
    }
    row_.time = time, row_.slot = free_.back(), row_.given = -1;
    free_.pop_back();
    ++count_;
    std::swap(newest_row(), row_);
    if (int64_t(count_) > set_.kept) {
      free_.push_back(row(0).slot);
      floor_ = row(0).time;
      first_ = (first_ + 1) % rows_.size(), --count_;
    }
    ++counts_.rows;
    counts_.predictions += out != nullptr;
    if (measured) {
      seen_ = time;
      counts_.long_gaps += is_long;
      longest_gap_ = std::max(longest_gap_, gap);
    }
    return NEW;
  }

  int join() {
    Row& old = newest_row();
    bool repeated = false, changed = false;
    for (int64_t c = 0; c < channels_; ++c) {
      const bool twice = row_.mask[c] && old.mask[c];
      const bool taken = row_.mask[c] && (set_.takes_last || !old.mask[c]);
      joined_.values[c] = taken ? row_.values[c] : old.values[c];
      joined_.mask[c] = taken || old.mask[c];
      repeated |= twice;
      changed |= joined_.values[c] != old.values[c] || joined_.mask[c] != old.mask[c];
    }
    if (repeated && !set_.takes_twice) return OTHER;
    if (changed) {
      const int64_t slot = free_.back();
      engine_.save(int(undo_));
      engine_.load(int(old.slot));
      try {
        engine_.save(int(slot));
        engine_.take(old.time, joined_.values.data(), joined_.measured(), false);
      } catch (const std::exception&) {
        engine_.load(int(undo_));
        return OTHER;
      }
      free_.back() = old.slot;
      joined_.time = old.time, joined_.slot = slot, joined_.given = -1;
      std::swap(old, joined_);
      seen_ = std::isnan(seen_) ? newest() : std::max(seen_, newest());
    }
    counts_.duplicates += repeated;
    counts_.merged += changed;
    return changed ? MERGED : DUPLICATE;
  }

  // Converts (channels,) to original units; false where one is not finite.
  bool original(double* out) const {
    for (int64_t c = 0; c < channels_; ++c)
      if (!std::isfinite(out[c])) return false;
    for (int64_t c = 0; c < channels_; ++c) {
      const double scaled = out[c] * scale_[c];
      out[c] = scaled + shift_[c];
    }
    for (int64_t c : exogenous_) out[c] = NAN;
    return true;
  }

  StreamEngine<T>& engine_;
  nb::dict index_;
  nb::object array_;
  InOrderSettings set_;
  int64_t channels_ = 0, undo_ = 0;
  std::vector<double> shift_, scale_, low_, high_, raw_;
  std::vector<int64_t> exogenous_, free_;
  std::vector<Row> rows_;  // a ring
  size_t first_ = 0, count_ = 0;
  Row row_, joined_;
  Time origin_;
  Counts counts_;
  double floor_ = -INFINITY, seen_ = NAN, longest_gap_ = 0;
  bool open_ = false;
};

template <class T>
void bind_in_order(nb::module_& m, const std::string& suffix) {
  nb::class_<InOrder<T>>(m, ("InOrder_" + suffix).c_str())
      .def(
          "__init__",
          [](InOrder<T>* self, StreamEngine<T>& engine, nb::dict index, nb::object array,
             Const<double> shift, Const<double> scale, Const<double> reach,
             const std::vector<int64_t>& exogenous, double ticks, double merge_within,
             double jump_back, double jump_ahead, double stale_after, double long_gap,
             bool resets_long_gap, bool drops_late, bool takes_last, bool takes_twice,
             int64_t kept) {
            InOrderSettings s;
            s.ticks = ticks, s.merge_within = merge_within, s.jump_back = jump_back;
            s.jump_ahead = jump_ahead, s.stale_after = stale_after, s.long_gap = long_gap;
            s.resets_long_gap = resets_long_gap, s.drops_late = drops_late;
            s.takes_last = takes_last, s.takes_twice = takes_twice, s.kept = kept;
            new (self) InOrder<T>(engine, std::move(index), std::move(array), shift, scale, reach,
                                  exogenous, s);
          },
          nb::keep_alive<1, 2>(), nb::arg("engine"), nb::arg("index"), nb::arg("array"),
          nb::arg("shift").noconvert(), nb::arg("scale").noconvert(), nb::arg("reach").noconvert(),
          nb::arg("exogenous"), nb::arg("ticks"), nb::arg("merge_within"), nb::arg("jump_back"),
          nb::arg("jump_ahead"), nb::arg("stale_after"), nb::arg("long_gap"),
          nb::arg("resets_long_gap"), nb::arg("drops_late"), nb::arg("takes_last"),
          nb::arg("takes_twice"), nb::arg("kept"))
      .def("open", &InOrder<T>::open, nb::arg("origin"), nb::arg("times"), nb::arg("slots"),
           nb::arg("values").noconvert(), nb::arg("mask").noconvert(), nb::arg("free"),
           nb::arg("floor"), nb::arg("seen").none(), nb::arg("longest_gap"))
      .def("close", &InOrder<T>::close, nb::arg("values").noconvert(), nb::arg("mask").noconvert())
      .def("observe", &InOrder<T>::observe, nb::arg("t"), nb::arg("values"),
           nb::arg("out").noconvert().none())
      .def("predict", &InOrder<T>::predict, nb::arg("t"), nb::arg("out").noconvert())
      .def_prop_ro("made", &InOrder<T>::made)
      .def_prop_ro("is_open", &InOrder<T>::is_open)
      .def_prop_ro("newest", &InOrder<T>::newest);
}
