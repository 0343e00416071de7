// The Python module: checks shapes, allocates scratch, spreads blocks over threads, and calls the
// body that this processor can run.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <atomic>
#include <cmath>
#include <memory>
#include <mutex>
#include <new>
#include <numeric>
#include <stdexcept>
#include <string>
#include <system_error>
#include <thread>
#include <vector>

#include "../records.hpp"

namespace nb = nanobind;

namespace offbeat {

extern const Bodies body_baseline;
#ifdef OFFBEAT_X86
extern const Bodies body_avx2;
extern const Bodies body_avx512;
#endif

namespace {

#include "bodies.hpp"
#include "threads.hpp"
#include "arguments.hpp"
#include "facts.hpp"
#include "batch.hpp"
#include "perceptron.hpp"
#include "live.hpp"

template <class T>
void bind(nb::module_& m, const char* suffix) {
  const std::string end = suffix;
  nb::class_<Facts<T>>(m, ("Facts_" + end).c_str())
      .def(
          "__init__",
          [](Facts<T>* self, Maybe<T> gap, Maybe<T> update, Maybe<T> updated, Maybe<T> values,
             Maybe<T> mask, Maybe<T> age, Maybe<T> decay_start, Maybe<T> decay_end, Maybe<T> delta,
             Maybe<T> last, Maybe<T> mean, std::optional<Const<uint8_t>> fed,
             std::optional<Const<int64_t>> length) {
            if (!gap || gap->ndim() != 2) refuse("gap must have shape (batch, rows)");
            const int64_t rows = int64_t(gap->shape(1));
            new (self) Facts<T>{{gap, update, updated, values, mask, age, decay_start, decay_end,
                                 delta, last},
                                mean, fed, length, {}, {}, {}, rows};
          },
          nb::arg("gap").noconvert(), nb::arg("update").noconvert(),
          nb::arg("updated").noconvert().none(), nb::arg("values").noconvert(),
          nb::arg("mask").noconvert(), nb::arg("age").noconvert().none(),
          nb::arg("decay_start").noconvert().none(), nb::arg("decay_end").noconvert().none(),
          nb::arg("delta").noconvert().none(), nb::arg("last").noconvert().none(),
          nb::arg("mean").noconvert().none(), nb::arg("fed").noconvert().none(),
          nb::arg("length").noconvert().none())
      .def(
          "__init__",
          [](Facts<T>* self, Const<T> table, Const<int64_t> index,
             const std::vector<std::pair<int, int>>& places, int64_t rows, Maybe<T> mean,
             std::optional<Const<uint8_t>> fed, std::optional<Const<int64_t>> length) {
            if (table.ndim() != 3 || index.ndim() != 1)
              refuse("a table must have three axes and its index one");
            if (places.size() != QUANTITIES) refuse("a table needs a place for every quantity");
            new (self) Facts<T>{{}, mean, fed, length, table, index, places, rows};
          },
          nb::arg("table").noconvert(), nb::arg("index").noconvert(), nb::arg("places"),
          nb::arg("rows"), nb::arg("mean").noconvert().none(), nb::arg("fed").noconvert().none(),
          nb::arg("length").noconvert().none());
  m.def(
      "tape_size",
      [](const Spec& s, const std::string& body, const Facts<T>& f, Const<T> state) {
        return tape_size<T>(s, body_named(body), f, state);
      },
      nb::arg("spec"), nb::arg("body"), nb::arg("facts"), nb::arg("state").noconvert());
  m.def(
      "scan_forward",
      [](const Spec& s, const std::string& body, Const<T> weights, const Facts<T>& f,
         Const<T> state, Array<T> before, Array<T> after, std::optional<Array<T>> tape,
         int threads) {
        scan_forward<T>(s, body_named(body), weights, f, state, before, after, tape, threads);
      },
      nb::arg("spec"), nb::arg("body"), nb::arg("weights").noconvert(), nb::arg("facts"),
      nb::arg("state").noconvert(), nb::arg("before").noconvert(), nb::arg("after").noconvert(),
      nb::arg("tape").noconvert().none(), nb::arg("threads"));
  m.def(
      "scan_backward",
      [](const Spec& s, const std::string& body, Const<T> weights, const Facts<T>& f,
         Const<T> state, Const<T> after, std::optional<Const<T>> tape,
         std::optional<Const<T>> to_before, std::optional<Const<T>> to_after, Array<T> to_weights,
         Array<T> to_state, int threads, int group) {
        scan_backward<T>(s, body_named(body), weights, f, state, after, tape, to_before, to_after,
                         to_weights, to_state, threads, group);
      },
      nb::arg("spec"), nb::arg("body"), nb::arg("weights").noconvert(), nb::arg("facts"),
      nb::arg("state").noconvert(), nb::arg("after").noconvert(),
      nb::arg("tape").noconvert().none(),
      nb::arg("to_before").noconvert().none(), nb::arg("to_after").noconvert().none(),
      nb::arg("to_weights").noconvert(), nb::arg("to_state").noconvert(), nb::arg("threads"),
      nb::arg("group") = 0);
  m.def(
      ("perceptron_tape_" + end).c_str(),
      [](const Perceptron& p, const std::string& body, int64_t rows) {
        return perceptron_tape<T>(p, body_named(body), rows);
      });
  m.def(
      "perceptron_forward",
      [](const Perceptron& p, const std::string& body, Const<T> weights, Const<T> x, Array<T> y,
         std::optional<Array<T>> tape, int threads) {
        perceptron_forward<T>(p, body_named(body), weights, x, y, tape, threads);
      },
      nb::arg("shape"), nb::arg("body"), nb::arg("weights").noconvert(), nb::arg("x").noconvert(),
      nb::arg("y").noconvert(), nb::arg("tape").noconvert().none(), nb::arg("threads"));
  m.def(
      "perceptron_backward",
      [](const Perceptron& p, const std::string& body, Const<T> weights, Const<T> x, Const<T> tape,
         Const<T> to_y, Array<T> to_weights, std::optional<Array<T>> to_x, int threads) {
        perceptron_backward<T>(p, body_named(body), weights, x, tape, to_y, to_weights, to_x,
                               threads);
      },
      nb::arg("shape"), nb::arg("body"), nb::arg("weights").noconvert(), nb::arg("x").noconvert(),
      nb::arg("tape").noconvert(), nb::arg("to_y").noconvert(), nb::arg("to_weights").noconvert(),
      nb::arg("to_x").noconvert().none(), nb::arg("threads"));
  bind_live<T>(m, end);
}

}  // namespace
}  // namespace offbeat

NB_MODULE(_fused, m) {
  using namespace offbeat;
  nb::set_leak_warnings(false);  // caches of specs live until the interpreter ends
  m.doc() = "The fused body of the scan; offbeat.kernels.fused is its Python face.";
  m.def("bodies", [] {
    std::vector<std::string> names;
    for (const Bodies* b : bodies()) names.emplace_back(b->name);
    return names;
  });
  m.def("width", [](const std::string& body) { return body_named(body).f32.width; });
  nb::class_<Spec>(m, "Spec")
      .def(
          "__init__",
          [](Spec* self, int channels, int hidden, int anchored, int ages, int cell,
             bool reset_after, const std::vector<int>& field, int activation,
             const std::vector<std::vector<double>>& a, const std::vector<double>& b, int steps,
             double max_step, int decay_features, int decay_rows, bool input_decay,
             const std::vector<int>& decoder) {
            new (self) Spec(spec_of(channels, hidden, anchored, ages, cell, reset_after, field,
                                    activation, a, b, steps, max_step, decay_features, decay_rows,
                                    input_decay, decoder));
          },
          nb::arg("channels"), nb::arg("hidden"), nb::arg("anchored"), nb::arg("ages"),
          nb::arg("cell"), nb::arg("reset_after"), nb::arg("field"), nb::arg("activation"),
          nb::arg("a"), nb::arg("b"), nb::arg("steps"), nb::arg("max_step"),
          nb::arg("decay_features"), nb::arg("decay_rows"), nb::arg("input_decay"),
          nb::arg("decoder"))
      .def_prop_ro("flat_size", [](const Spec& s) { return flat_size(s); })
      .def_prop_ro("state_size", [](const Spec& s) { return state_of(s); });
  nb::class_<Perceptron>(m, "Perceptron")
      .def("__init__",
           [](Perceptron* self, const std::vector<int>& sizes, int activation) {
             if (sizes.size() < 2) refuse("a perceptron needs sizes of its input and its output");
             new (self) Perceptron(perceptron_of(sizes, activation));
           },
           nb::arg("sizes"), nb::arg("activation"));
  bind<float>(m, "f32");
  bind<double>(m, "f64");
}
