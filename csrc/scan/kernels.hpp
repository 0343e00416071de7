// The table of the functions of one instruction set.

template <class T>
constexpr Kernels<T> make_kernels() {
  using S = Scan<T>;
  Kernels<T> t{};
  t.width = S::VW;
  t.packed_size = S::packed_size;
  t.pack = S::pack;
  t.tape_row = S::tape_row;
  t.forward_scratch = S::forward_scratch;
  t.backward_scratch = S::backward_scratch;
  t.sums_size = S::sums_size;
  t.forward = S::forward;
  t.state_gradient_size = S::state_gradient_size;
  t.backward = S::backward;
  t.reduce = S::reduce;
  t.perceptron_packed_size = S::perceptron_packed_size;
  t.perceptron_pack = S::perceptron_pack;
  t.perceptron_tape_row = S::perceptron_tape_row;
  t.perceptron_scratch = S::perceptron_scratch;
  t.perceptron_sums = S::perceptron_sums;
  t.perceptron_forward = S::perceptron_forward;
  t.perceptron_backward = S::perceptron_backward;
  t.perceptron_reduce = S::perceptron_reduce;
  t.adamax = S::adamax;
  t.stream_packed_size = S::stream_packed_size;
  t.stream_pack = S::stream_pack;
  t.stream_scratch = S::stream_scratch;
  t.stream_row = S::stream_row;
  t.stream_perceptron_size = S::stream_perceptron_size;
  t.stream_perceptron_pack = S::stream_perceptron_pack;
  t.stream_perceptron_scratch = S::stream_perceptron_scratch;
  t.stream_perceptron = S::stream_perceptron;
  return t;
}
