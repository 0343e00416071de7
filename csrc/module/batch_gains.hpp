// Gains of the filters of a batch, row by row: part of module.cpp.

template <class T>
void filter_gains(const Const<double>& filters, const Const<double>& delta, const Const<bool>& mask,
                  const Const<bool>& started, Array<double> covariance, Array<T> level,
                  Array<T> slope, double unit) {
  if (delta.ndim() != 3)
    refuse("delta has shape " + shape_of(delta) + ", expected (batch, rows, channels)");
  const int64_t batch = delta.shape(0), rows = delta.shape(1), C = delta.shape(2);
  const FilterTable table = filter_table(filters, C);
  check_shape("mask", mask, {batch, rows, C});
  check_shape("started", started, {batch, C});
  check_shape("covariance", covariance, {batch, C, 3});
  check_shape("level", level, {batch, rows, C});
  check_shape("slope", slope, {batch, rows, C});
  check_contiguous("delta", delta);
  check_contiguous("mask", mask);
  check_contiguous("started", started);
  check_contiguous("covariance", covariance);
  check_contiguous("level", level);
  check_contiguous("slope", slope);
  nb::gil_scoped_release unlocked;
  std::vector<uint8_t> seen(C);
  for (int64_t b = 0; b < batch; ++b) {
    for (int64_t c = 0; c < C; ++c) seen[c] = started.data()[b * C + c];
    for (int64_t i = b * rows * C; i < (b + 1) * rows * C; ++i) {
      const int64_t c = i % C;
      double gains[2] = {0, 0};
      if (mask.data()[i]) {
        filter_gain(table, c, delta.data()[i], seen[c], unit,
                    covariance.data() + (b * C + c) * 3, gains[0], gains[1]);
        seen[c] = 1;
      }
      level.data()[i] = T(gains[0]), slope.data()[i] = T(gains[1]);
    }
  }
}
