#include <nanobind/nanobind.h>
NB_MODULE(_fused, m) { m.attr("answer") = 42; }
