// Runs a trained model on live measurements from C++, without Python. See examples/cpp.
#pragma once

#include <memory>
#include <string>
#include <vector>

namespace offbeat {

// A model that offbeat.stream.file.write_stream wrote. It gives the bits of offbeat.Stream for
// messages in the order of time. Memory does not grow; a call allocates nothing after the first of
// its kind. Not thread-safe: calls must not overlap.
class Stream {
 public:
  // Throws std::runtime_error: the file is missing, damaged or of another version.
  explicit Stream(const std::string& path);
  ~Stream();
  Stream(Stream&&) noexcept;
  Stream& operator=(Stream&&) noexcept;

  int channels() const;
  const std::vector<std::string>& names() const;
  const std::vector<std::string>& units() const;
  // "avx512", "avx2" or "baseline": the best that this processor runs.
  const std::string& instruction_set() const;

  // Consumes the values (channels,) that were measured at a time, in original units; NaN: not
  // measured. `t` is in s, from any fixed origin, and later than that of the row before. Throws
  // std::runtime_error otherwise, and changes nothing.
  void observe(double t, const double* values);

  // Predicts (channels,) at a time that is not before the newest row. Changes nothing. A prediction
  // is not finite where the state is not: check it, and reset.
  void predict(double t, double* prediction);

  // Predicts a row, then observes it; faster than the two calls.
  void step(double t, const double* values, double* prediction);

  // Forgets all rows.
  void reset();

 private:
  struct Implementation;
  std::unique_ptr<Implementation> self_;
};

}  // namespace offbeat
