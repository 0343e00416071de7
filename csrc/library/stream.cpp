// The library of offbeat.hpp: the engine of the Python module (module/stream.hpp) on views of the
// arrays in a file.
#include "offbeat.hpp"

#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <fstream>
#include <limits>
#include <map>
#include <mutex>
#include <new>
#include <optional>
#include <sstream>
#include <stdexcept>
#include <system_error>
#include <thread>

#include "../records.hpp"

namespace offbeat {

extern const InstructionSet kernels_baseline;
#ifdef OFFBEAT_X86
extern const InstructionSet kernels_avx2;
extern const InstructionSet kernels_avx512;
#endif

namespace {

// A contiguous array of another's memory, with the interface of nanobind's.
template <class T>
class View {
 public:
  View(T* data, std::vector<int64_t> shape) : data_(data), shape_(std::move(shape)) {}
  T* data() const { return data_; }
  size_t ndim() const { return shape_.size(); }
  int64_t shape(size_t i) const { return shape_[i]; }
  int64_t stride(size_t i) const {
    int64_t n = 1;
    for (size_t k = i + 1; k < shape_.size(); ++k) n *= shape_[k];
    return n;
  }
  int64_t size() const {
    int64_t n = 1;
    for (int64_t each : shape_) n *= each;
    return n;
  }

 private:
  T* data_;
  std::vector<int64_t> shape_;
};
template <class T>
using Array = View<T>;
template <class T>
using Const = View<const T>;
template <class T>
using Maybe = std::optional<Const<T>>;

#include "../module/arguments.hpp"
#include "../module/instruction_sets.hpp"
#include "../module/threads.hpp"
#include "../module/gains.hpp"
#include "../module/stream.hpp"

// The arrays of a file, by name: stream/file.py writes it.
class File {
 public:
  explicit File(const std::string& path) : path_(path) {
    std::ifstream in(path, std::ios::binary);
    if (!in) refuse(path + " can't be read");
    std::string line;
    std::getline(in, line);
    if (line != "offbeat-stream 1")
      refuse(path + " is no model of version 1 that offbeat.stream.file.write_stream wrote");
    while (std::getline(in, line) && line != "end") {
      std::istringstream words(line);
      std::string name;
      Entry entry;
      int64_t n = 1;
      words >> name >> entry.kind;
      for (int64_t size; words >> size; n *= size) {
        if (size < 0 || size > MAX_COUNT || n > MAX_COUNT) damaged();
        entry.shape.push_back(size);
      }
      const int64_t width = entry.kind == "f8" || entry.kind == "i8" ? 8
                            : entry.kind == "f4"                     ? 4
                            : entry.kind == "u1"                     ? 1
                                                                     : 0;
      if (!width) damaged();
      for (int64_t left = n * width; left > 0;) {  // so that a wrong size asks for little memory
        char piece[4096];
        const int64_t some = std::min<int64_t>(left, sizeof piece);
        if (!in.read(piece, some)) damaged();
        entry.bytes.append(piece, size_t(some));
        left -= some;
      }
      entries_.emplace(name, std::move(entry));
    }
    if (line != "end") damaged();
  }

  bool has(const std::string& name) const { return entries_.count(name) > 0; }
  template <class T>
  Const<T> array(const std::string& name) const {
    const Entry& e = entry(name, std::is_integral_v<T> ? "i8" : sizeof(T) == 8 ? "f8" : "f4");
    return {reinterpret_cast<const T*>(e.bytes.data()), e.shape};
  }
  template <class T>
  Maybe<T> maybe(const std::string& name) const {
    return has(name) ? Maybe<T>(array<T>(name)) : std::nullopt;
  }
  template <class T>
  std::vector<T> all(const std::string& name) const {
    const Const<T> a = array<T>(name);
    return {a.data(), a.data() + a.size()};
  }
  template <class T = int64_t>
  T one(const std::string& name) const {
    const Const<T> a = array<T>(name);
    if (a.size() != 1) damaged();
    return *a.data();
  }
  std::string text(const std::string& name) const { return entry(name, "u1").bytes; }
  std::vector<std::string> texts(const std::string& name) const {
    std::vector<std::string> found;
    std::istringstream in(text(name));
    for (std::string line; std::getline(in, line);) found.push_back(line);
    return found;
  }
  [[noreturn]] void damaged() const { refuse(path_ + " is damaged; write it again"); }

 private:
  struct Entry {
    std::string kind, bytes;
    std::vector<int64_t> shape;
  };
  const Entry& entry(const std::string& name, const std::string& kind) const {
    const auto found = entries_.find(name);
    if (found == entries_.end() || found->second.kind != kind) damaged();
    return found->second;
  }
  std::string path_;
  std::map<std::string, Entry> entries_;
};

Spec spec_in(const File& f) {
  const std::vector<double> weights = f.all<double>("b"), below = f.all<double>("a");
  std::vector<std::vector<double>> a(weights.size());
  size_t at = 0;
  for (size_t i = 0; i < a.size(); ++i)
    for (size_t j = 0; j < i; ++j) {
      if (at == below.size()) f.damaged();
      a[i].push_back(below[at++]);
    }
  return spec_of(f.one("channels"), f.one("hidden"), f.one("anchored"), f.one("time_inputs"),
                 f.one("cell"), f.one("reset_after"), f.all<int64_t>("field"), f.one("activation"),
                 a, weights, f.one("steps"), f.one<double>("max_step"), f.one("nodes"),
                 f.one<double>("decay_span"), f.one("bounded"), f.one("decay_features"),
                 f.one("decay_rows"), f.one("input_decay"), f.all<int64_t>("spec_decoder"),
                 f.one("trend"));
}

TimeSettings settings_in(const File& f) {
  TimeSettings s;
  s.unit = f.one<double>("unit"), s.time_input_unit = f.one<double>("time_input_unit");
  s.elapsed_limit = f.one<double>("elapsed_limit");
  s.longest_delta = f.one<double>("longest_delta");
  s.time_input = f.one("time_input"), s.from_first_row = f.one("from_first_row");
  s.last_row = f.one("last_row"), s.every_row = f.one("every_row");
  s.starts_only = f.one("starts_only"), s.exponential = f.one("exponential");
  return s;
}

class Runner {  // of either type of numbers
 public:
  virtual ~Runner() = default;
  virtual void observe(double time, const double* values, double* out) = 0;
  virtual void predict(double time, double* out) = 0;
  virtual void reset() = 0;
};

template <class T>
class TypedRunner final : public Runner {
 public:
  TypedRunner(const File& f, const std::string& set)
      : engine_(spec_in(f), set, f.array<T>("weights"), f.array<T>("mean"), f.array<T>("std"),
                f.all<int64_t>("decoder"), f.maybe<T>("decoder_weights"), f.array<T>("first_state"),
                f.maybe<T>("low"), f.maybe<T>("high"), f.maybe<double>("filters"),
                f.maybe<double>("prior"), settings_in(f)),
        shift_(f.all<double>("shift")),
        scale_(f.all<double>("scale")),
        exogenous_(f.all<int64_t>("exogenous")),
        row_(engine_.channels()),
        measured_(new bool[size_t(engine_.channels())]) {
    const size_t C = size_t(engine_.channels());
    if (shift_.size() != C || scale_.size() != C) f.damaged();
    for (int64_t c : exogenous_)
      if (c < 0 || c >= engine_.channels()) f.damaged();
    // stream/messages.py: RowReader. Values between these stay finite when scaled.
    const double largest = std::numeric_limits<double>::max() / 4;
    for (size_t c = 0; c < C; ++c) {
      const double reach = std::min(
          0.99 * double(std::numeric_limits<T>::max()) * std::abs(scale_[c]), largest);
      low_.push_back(shift_[c] - reach), high_.push_back(shift_[c] + reach);
    }
  }

  void observe(double time, const double* values, double* out) override {
    for (size_t c = 0; c < row_.size(); ++c) {
      measured_[c] = values[c] >= low_[c] && values[c] <= high_[c];
      row_[c] = T(((measured_[c] ? values[c] : shift_[c]) - shift_[c]) / scale_[c]);
    }
    engine_.step(time, row_.data(), measured_.get(), out);
    if (out) original(out);
  }
  void predict(double time, double* out) override {
    engine_.predict_at(time, out);
    original(out);
  }
  void reset() override { engine_.reset(); }

 private:
  void original(double* out) const {
    for (size_t c = 0; c < row_.size(); ++c) {
      const double scaled = out[c] * scale_[c];
      out[c] = scaled + shift_[c];
    }
    for (int64_t c : exogenous_) out[c] = NAN;
  }

  StreamEngine<T> engine_;
  std::vector<double> shift_, scale_, low_, high_;
  std::vector<int64_t> exogenous_;
  std::vector<T> row_;
  std::unique_ptr<bool[]> measured_;
};

}  // namespace

struct Stream::Implementation {
  std::unique_ptr<Runner> runner;
  std::vector<std::string> names, units;
  std::string instruction_set;
  bool started = false;
  double origin = 0, newest = 0;  // s; `newest` since the origin

  double since(double t) const {
    if (!std::isfinite(t)) refuse("a time must be finite, got " + text_of(t));
    return started ? t - origin : 0.0;
  }
  void observe(double t, const double* values, double* out) {
    const double time = since(t);
    if (started && time <= newest)
      refuse("a row is " + text_of(newest - time) +
             " s older than the newest one; rows come in the order of time");
    runner->observe(time, values, out);
    if (!started) origin = t;
    started = true, newest = time;
  }
};

Stream::Stream(const std::string& path) : self_(new Implementation) {
  const File f(path);
  const std::string set = self_->instruction_set = instruction_sets().front()->name;
  if (f.text("dtype") == "float32")
    self_->runner = std::make_unique<TypedRunner<float>>(f, set);
  else
    self_->runner = std::make_unique<TypedRunner<double>>(f, set);
  self_->names = f.texts("names"), self_->units = f.texts("channel_units");
  if (int64_t(self_->names.size()) != f.one("channels")) f.damaged();
}
Stream::~Stream() = default;
Stream::Stream(Stream&&) noexcept = default;
Stream& Stream::operator=(Stream&&) noexcept = default;

int Stream::channels() const { return int(self_->names.size()); }
const std::vector<std::string>& Stream::names() const { return self_->names; }
const std::vector<std::string>& Stream::units() const { return self_->units; }
const std::string& Stream::instruction_set() const { return self_->instruction_set; }

void Stream::observe(double t, const double* values) { self_->observe(t, values, nullptr); }
void Stream::step(double t, const double* values, double* prediction) {
  self_->observe(t, values, prediction);
}
void Stream::predict(double t, double* prediction) {
  const double time = self_->since(t);
  if (time < self_->newest)
    refuse("asked for a time " + text_of(self_->newest - time) + " s before the newest row");
  self_->runner->predict(time, prediction);
}
void Stream::reset() {
  self_->runner->reset();
  self_->started = false, self_->newest = 0;
}

}  // namespace offbeat
