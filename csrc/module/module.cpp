// The Python module: checks shapes, allocates scratch, spreads blocks over threads, and calls the
// best instruction set that this processor has.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <unistd.h>
#ifdef OFFBEAT_BF16
#include <cpuid.h>
#include <sys/syscall.h>
#endif

#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <exception>
#include <memory>
#include <mutex>
#include <new>
#include <numeric>
#include <stdexcept>
#include <string>
#include <string_view>
#include <system_error>
#include <thread>
#include <vector>

#include "../records.hpp"

namespace nb = nanobind;

namespace offbeat {

extern const InstructionSet kernels_baseline;
#ifdef OFFBEAT_X86
extern const InstructionSet kernels_avx2;
extern const InstructionSet kernels_avx512;
#ifdef OFFBEAT_BF16
extern const InstructionSet kernels_avx512_bf16, kernels_amx_bf16;
#endif
#endif

namespace {

template <class T>
using Array = nb::ndarray<T, nb::device::cpu>;
template <class T>
using Const = nb::ndarray<const T, nb::device::cpu>;
template <class T>
using Maybe = std::optional<Const<T>>;

#include "arguments.hpp"
#include "instruction_sets.hpp"
#include "bf16_sets.hpp"
#include "threads.hpp"
#include "step_inputs.hpp"
#include "batch.hpp"
#include "perceptron.hpp"
#include "flat_weights.hpp"
#include "gains.hpp"
#include "batch_gains.hpp"
#include "stream.hpp"
#include "bind_stream.hpp"
#include "in_order.hpp"

template <class T>
void bind(nb::module_& m, const char* suffix) {
  const std::string end = suffix;
  nb::class_<StepInputs<T>>(m, ("StepInputs_" + end).c_str())
      .def(
          "__init__",
          [](StepInputs<T>* self, Maybe<T> gap, Maybe<T> update, Maybe<T> updated, Maybe<T> values,
             Maybe<T> mask, Maybe<T> time_input, Maybe<T> decay_start, Maybe<T> decay_end,
             Maybe<T> delta, Maybe<T> last, Maybe<T> mean,
             std::optional<Const<uint8_t>> use_prediction, std::optional<Const<int64_t>> length,
             Maybe<T> first_node, Maybe<T> node, Maybe<T> commit, Maybe<T> low, Maybe<T> high,
             Maybe<T> level_gain, Maybe<T> slope_gain) {
            if (!gap || gap->ndim() != 2)
              refuse("gap has shape " + (gap ? shape_of(*gap) : "None") +
                     ", expected (batch, rows)");
            const int64_t rows = int64_t(gap->shape(1));
            new (self) StepInputs<T>{{gap, update, updated, values, mask, time_input, decay_start,
                                      decay_end, delta, last, first_node, node, commit, level_gain,
                                      slope_gain},
                                     low,
                                     high,
                                     mean,
                                     use_prediction,
                                     length,
                                     {},
                                     {},
                                     {},
                                     rows};
          },
          nb::arg("gap").noconvert(), nb::arg("update").noconvert(),
          nb::arg("updated").noconvert().none(), nb::arg("values").noconvert(),
          nb::arg("mask").noconvert(), nb::arg("time_input").noconvert().none(),
          nb::arg("decay_start").noconvert().none(), nb::arg("decay_end").noconvert().none(),
          nb::arg("delta").noconvert().none(), nb::arg("last").noconvert().none(),
          nb::arg("mean").noconvert().none(), nb::arg("use_prediction").noconvert().none(),
          nb::arg("length").noconvert().none(), nb::arg("first_node").noconvert() = nb::none(),
          nb::arg("node").noconvert() = nb::none(), nb::arg("commit").noconvert() = nb::none(),
          nb::arg("low").noconvert() = nb::none(), nb::arg("high").noconvert() = nb::none(),
          nb::arg("level_gain").noconvert() = nb::none(),
          nb::arg("slope_gain").noconvert() = nb::none())
      .def(
          "__init__",
          [](StepInputs<T>* self, Const<T> table, Const<int64_t> index,
             std::vector<std::pair<int64_t, int64_t>> places, int64_t rows, Maybe<T> mean,
             std::optional<Const<uint8_t>> use_prediction, std::optional<Const<int64_t>> length,
             Maybe<T> low, Maybe<T> high) {
            if (table.ndim() != 3)
              refuse("table has shape " + shape_of(table) +
                     ", expected (trajectories, rows, columns)");
            // The last quantities belong to nodes and trends, and may be left out.
            in_range("the number of places", int64_t(places.size()), FIRST_NODE, QUANTITIES);
            places.resize(QUANTITIES);
            new (self) StepInputs<T>{{},     low,   high,  mean,   use_prediction,
                                     length, table, index, places, rows};
          },
          nb::arg("table").noconvert(), nb::arg("index").noconvert(), nb::arg("places"),
          nb::arg("rows"), nb::arg("mean").noconvert().none(),
          nb::arg("use_prediction").noconvert().none(), nb::arg("length").noconvert().none(),
          nb::arg("low").noconvert() = nb::none(), nb::arg("high").noconvert() = nb::none());
  m.def(
      "tape_size",
      [](const Spec& s, const std::string& set, const StepInputs<T>& inputs, Const<T> state) {
        return tape_size<T>(s, find_set(set), inputs, state);
      },
      nb::arg("spec"), nb::arg("instruction_set"), nb::arg("inputs"), nb::arg("state").noconvert());
  m.def(
      "scan_forward",
      [](const Spec& s, const std::string& set, Const<T> weights, const StepInputs<T>& inputs,
         Const<T> state, Array<T> before, Array<T> after, std::optional<Array<T>> tape,
         int threads) {
        scan_forward<T>(s, find_set(set), weights, inputs, state, before, after, tape,
                        threads);
      },
      nb::arg("spec"), nb::arg("instruction_set"), nb::arg("weights").noconvert(),
      nb::arg("inputs"), nb::arg("state").noconvert(), nb::arg("before").noconvert(),
      nb::arg("after").noconvert(), nb::arg("tape").noconvert().none(), nb::arg("threads"));
  m.def(
      "scan_backward",
      [](const Spec& s, const std::string& set, Const<T> weights, const StepInputs<T>& inputs,
         Const<T> state, Const<T> after, std::optional<Const<T>> tape,
         std::optional<Const<T>> to_before, std::optional<Const<T>> to_after, Array<T> to_weights,
         Array<T> to_state, int threads, int group) {
        scan_backward<T>(s, find_set(set), weights, inputs, state, after, tape,
                         to_before, to_after, to_weights, to_state, threads, group);
      },
      nb::arg("spec"), nb::arg("instruction_set"), nb::arg("weights").noconvert(),
      nb::arg("inputs"), nb::arg("state").noconvert(), nb::arg("after").noconvert(),
      nb::arg("tape").noconvert().none(), nb::arg("to_before").noconvert().none(),
      nb::arg("to_after").noconvert().none(), nb::arg("to_weights").noconvert(),
      nb::arg("to_state").noconvert(), nb::arg("threads"), nb::arg("group") = 0);
  m.def(("perceptron_tape_" + end).c_str(),
        [](const Perceptron& p, const std::string& set, int64_t rows) {
          return perceptron_tape<T>(p, find_set(set), rows);
        });
  m.def(
      "perceptron_forward",
      [](const Perceptron& p, const std::string& set, Const<T> weights, Const<T> x, Array<T> y,
         std::optional<Array<T>> tape, int threads) {
        perceptron_forward<T>(p, find_set(set), weights, x, y, tape, threads);
      },
      nb::arg("shape"), nb::arg("instruction_set"), nb::arg("weights").noconvert(),
      nb::arg("x").noconvert(), nb::arg("y").noconvert(), nb::arg("tape").noconvert().none(),
      nb::arg("threads"));
  m.def(
      "perceptron_backward",
      [](const Perceptron& p, const std::string& set, Const<T> weights, Const<T> x, Const<T> tape,
         Const<T> to_y, Array<T> to_weights, std::optional<Array<T>> to_x, int threads) {
        perceptron_backward<T>(p, find_set(set), weights, x, tape, to_y, to_weights,
                               to_x, threads);
      },
      nb::arg("shape"), nb::arg("instruction_set"), nb::arg("weights").noconvert(),
      nb::arg("x").noconvert(), nb::arg("tape").noconvert(), nb::arg("to_y").noconvert(),
      nb::arg("to_weights").noconvert(), nb::arg("to_x").noconvert().none(), nb::arg("threads"));
  m.def(
      "perceptron_squares",
      [](const Perceptron& p, const std::string& set, Const<T> weights, Const<T> states,
         Maybe<T> first, int64_t column, Const<T> targets, Const<int64_t> index, double norm,
         double scale, Array<T> squares, Array<T> to_weights, Array<T> to_states,
         int threads) {
        perceptron_squares<T>(p, find_set(set), weights, states, first, column, targets,
                              index, norm, scale, squares, to_weights, to_states, threads);
      },
      nb::arg("shape"), nb::arg("instruction_set"), nb::arg("weights").noconvert(),
      nb::arg("states").noconvert(), nb::arg("first").noconvert().none(), nb::arg("column"),
      nb::arg("targets").noconvert(), nb::arg("index").noconvert(), nb::arg("norm"),
      nb::arg("scale"), nb::arg("squares").noconvert(), nb::arg("to_weights").noconvert(),
      nb::arg("to_states").noconvert(), nb::arg("threads"));
  m.def(
      "state_squares",
      [](Const<T> states, Const<T> unit, Const<T> zero, Const<T> targets, Const<int64_t> index,
         double norm, double scale, Array<T> squares, Array<T> to_states) {
        state_squares<T>(states, unit, zero, targets, index, norm, scale, squares, to_states);
      },
      nb::arg("states").noconvert(), nb::arg("unit").noconvert(), nb::arg("zero").noconvert(),
      nb::arg("targets").noconvert(), nb::arg("index").noconvert(), nb::arg("norm"),
      nb::arg("scale"), nb::arg("squares").noconvert(), nb::arg("to_states").noconvert());
  m.def(
      "adamax",
      [](const std::string& set, Const<T> gradient, double lerp, double beta, double eps,
         double step, Array<T> average, Array<T> largest, Array<T> weights) {
        adamax<T>(find_set(set), gradient, lerp, beta, eps, step, average, largest,
                  weights);
      },
      nb::arg("instruction_set"), nb::arg("gradient").noconvert(), nb::arg("lerp"),
      nb::arg("beta"), nb::arg("eps"), nb::arg("step"), nb::arg("average").noconvert(),
      nb::arg("largest").noconvert(), nb::arg("weights").noconvert());
  m.def(
      "move_weights",
      [](Array<T> to, Const<T> from, Const<int64_t> places, bool add) {
        move_weights<T>(to, from, places, add);
      },
      nb::arg("to").noconvert(), nb::arg("source").noconvert(), nb::arg("places").noconvert(),
      nb::arg("add"));
  m.def(
      "filter_gains",
      [](Const<double> filters, Const<double> delta, Const<bool> mask, Const<bool> started,
         Array<double> covariance, Array<T> level, Array<T> slope, double unit) {
        filter_gains<T>(filters, delta, mask, started, covariance, level, slope, unit);
      },
      nb::arg("filters").noconvert(), nb::arg("delta").noconvert(), nb::arg("mask").noconvert(),
      nb::arg("started").noconvert(), nb::arg("covariance").noconvert(),
      nb::arg("level").noconvert(), nb::arg("slope").noconvert(), nb::arg("unit"));
  bind_stream<T>(m, end);
  bind_in_order<T>(m, end);
}

}  // namespace
}  // namespace offbeat

NB_MODULE(_cpu, m) {
  using namespace offbeat;
  nb::set_leak_warnings(false);  // cached specs live as long as the interpreter
  nb::register_exception_translator([](const std::exception_ptr& error, void*) {
    try {
      std::rethrow_exception(error);
    } catch (const InputError& e) {
      const nb::object type = nb::module_::import_("offbeat.errors").attr("InputError");
      PyErr_SetString(type.ptr(), e.what());
    }
  });
  m.doc() = "The compiled backend of the scan; offbeat.kernels.cpu calls it.";
  m.def("instruction_sets", [] {
    std::vector<std::string> names;
    for (const InstructionSet* set : instruction_sets()) names.emplace_back(set->name);
    return names;
  });
  m.def("bf16_sets", [] {
    std::vector<std::string> names;
    for (const InstructionSet* set : bf16_sets()) names.emplace_back(set->name);
    return names;
  });
  m.def("width", [](const std::string& set) { return find_set(set).f32.width; });
  nb::class_<Spec>(m, "Spec")
      .def(
          "__init__",
          [](Spec* self, int64_t channels, int64_t hidden, int64_t anchored, int64_t time_inputs,
             int64_t cell, bool reset_after, const std::vector<int64_t>& field, int64_t activation,
             const std::vector<std::vector<double>>& a, const std::vector<double>& b, int64_t steps,
             double max_step, bool nodes, double decay_span, bool bounded, int64_t decay_features,
             int64_t decay_rows, bool input_decay, const std::vector<int64_t>& decoder,
             bool trend) {
            new (self) Spec(spec_of(channels, hidden, anchored, time_inputs, cell, reset_after,
                                    field, activation, a, b, steps, max_step, nodes, decay_span,
                                    bounded, decay_features, decay_rows, input_decay, decoder,
                                    trend));
          },
          nb::arg("channels"), nb::arg("hidden"), nb::arg("anchored"), nb::arg("time_inputs"),
          nb::arg("cell"), nb::arg("reset_after"), nb::arg("field"), nb::arg("activation"),
          nb::arg("a"), nb::arg("b"), nb::arg("steps"), nb::arg("max_step"),
          nb::arg("nodes") = false, nb::arg("decay_span") = 1.0, nb::arg("bounded") = false,
          nb::arg("decay_features"), nb::arg("decay_rows"), nb::arg("input_decay"),
          nb::arg("decoder"), nb::arg("trend") = false)
      .def_prop_ro("flat_size", [](const Spec& s) { return flat_size(s); })
      .def_prop_ro("state_size", [](const Spec& s) { return state_of(s); });
  nb::class_<Perceptron>(m, "Perceptron")
      .def(
          "__init__",
          [](Perceptron* self, const std::vector<int64_t>& sizes, int64_t activation) {
            in_range("the number of sizes", int64_t(sizes.size()), 2, MAX_LAYERS + 1);
            new (self) Perceptron(perceptron_of(sizes, activation));
          },
          nb::arg("sizes"), nb::arg("activation"));
  bind<float>(m, "f32");
  bind<double>(m, "f64");
}
