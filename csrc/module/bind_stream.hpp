// Streaming inference in Python: part of module.cpp.

template <class T>
void bind_stream(nb::module_& m, const std::string& suffix) {
  nb::class_<StreamEngine<T>>(m, ("StreamEngine_" + suffix).c_str())
      .def(
          "__init__",
          [](StreamEngine<T>* self, const Spec& spec, const std::string& set, Const<T> weights,
             Const<T> mean, Const<T> std, const std::vector<int64_t>& decoder,
             Maybe<T> decoder_weights, Const<T> first_state, Maybe<T> low, Maybe<T> high,
             double unit, double time_input_unit, double elapsed_limit, double longest_delta,
             int64_t time_input, bool from_first_row, bool last_row, bool every_row,
             bool starts_only, bool exponential, Maybe<double> filters, Maybe<double> prior) {
            TimeSettings c;
            c.unit = unit, c.time_input_unit = time_input_unit, c.elapsed_limit = elapsed_limit;
            c.longest_delta = longest_delta, c.time_input = time_input,
            c.from_first_row = from_first_row;
            c.last_row = last_row, c.every_row = every_row, c.starts_only = starts_only;
            c.exponential = exponential;
            new (self) StreamEngine<T>(spec, set, weights, mean, std, decoder, decoder_weights,
                                       first_state, low, high, filters, prior, c);
          },
          nb::arg("spec"), nb::arg("instruction_set"), nb::arg("weights").noconvert(),
          nb::arg("mean").noconvert(), nb::arg("std").noconvert(), nb::arg("decoder"),
          nb::arg("decoder_weights").noconvert().none(), nb::arg("first_state").noconvert(),
          nb::arg("low").noconvert() = nb::none(), nb::arg("high").noconvert() = nb::none(),
          nb::arg("unit"), nb::arg("time_input_unit"), nb::arg("elapsed_limit"),
          nb::arg("longest_delta"), nb::arg("time_input"), nb::arg("from_first_row"),
          nb::arg("last_row"), nb::arg("every_row"), nb::arg("starts_only"), nb::arg("exponential"),
          nb::arg("filters").noconvert() = nb::none(), nb::arg("prior").noconvert() = nb::none())
      .def("reset", &StreamEngine<T>::reset)
      .def("observe", &StreamEngine<T>::observe, nb::arg("time"), nb::arg("values").noconvert(),
           nb::arg("mask").noconvert(), nb::arg("use_prediction"))
      .def("predict", &StreamEngine<T>::predict, nb::arg("times").noconvert(),
           nb::arg("out").noconvert())
      .def("reserve", &StreamEngine<T>::reserve, nb::arg("slots"))
      .def("save", &StreamEngine<T>::save, nb::arg("slot"))
      .def("load", &StreamEngine<T>::load, nb::arg("slot"))
      .def("export_to", &StreamEngine<T>::export_to, nb::arg("out").noconvert())
      .def("restore", &StreamEngine<T>::restore, nb::arg("state").noconvert())
      .def_prop_ro("size", &StreamEngine<T>::size)
      .def_prop_ro("rows", &StreamEngine<T>::rows);
}
