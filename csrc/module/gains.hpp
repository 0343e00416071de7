// Gains of Kalman filters with damped velocity, which are step inputs of a trend: part of
// module.cpp and library/stream.cpp. models/gains.py has the same in PyTorch, and
// baselines/kalman.py the model.

// Filters of channels: one row each for clock, damping, drive, walk.
struct FilterTable {
  std::vector<double> values;
  int64_t channels = 0;
  const double* row(int i) const { return values.data() + i * channels; }
};

// Integrals over an exponential decay: (1 - e) / z, and the covariances of slope, level and slope,
// and level per drive, gap and its powers. Near 0, where the closed forms cancel, by their series.
struct Integrals {
  double reach, slope, both, level;
};
class IntegralSeries {
 public:
  IntegralSeries() {
    double factorial[TERMS + 2] = {1};
    for (int m = 1; m < TERMS + 2; ++m) factorial[m] = factorial[m - 1] * m;
    for (int m = 0; m < TERMS; ++m) {
      const double sign = m % 2 ? -1 : 1;
      decayed[m] = sign / factorial[m];
      reach[m] = sign / factorial[m + 1];
    }
    for (int m = 0; m < TERMS; ++m)
      for (int j = 0; j <= m; ++j) {
        slope[m] += decayed[j] * decayed[m - j] / (m + 1);
        both[m] += decayed[j] * reach[m - j] / (m + 2);
        level[m] += reach[j] * reach[m - j] / (m + 3);
      }
  }
  Integrals at(double z) const {
    return {sum(reach, z), sum(slope, z), sum(both, z), sum(level, z)};
  }

 private:
  static constexpr int TERMS = 14;
  static double sum(const double* c, double z) {
    double result = c[TERMS - 1];
    for (int m = TERMS - 2; m >= 0; --m) result = result * z + c[m];
    return result;
  }
  double decayed[TERMS] = {}, reach[TERMS] = {}, slope[TERMS] = {}, both[TERMS] = {},
         level[TERMS] = {};
};
Integrals integrals(double z, double e) {
  static const IntegralSeries series;
  if (z < 0.3) return series.at(z);  // SERIES_BELOW of baselines/kalman.py
  const double e1 = -std::expm1(-z), half = 0.5 * (1 - e * e);
  return {e1 / z, half / z, 0.5 * e1 * e1 / (z * z), (z - 2 * e1 + half) / (z * z * z)};
}

// The gains of an observation of a channel, `delta` s after the one before where there was one, and
// the covariance (level, both, slope) after it in place. `unit` is that of the slopes, in s.
void filter_gain(const FilterTable& filters, int64_t channel, double delta, bool started,
                 double unit, double* cov, double& level, double& slope) {
  const double clock = filters.row(0)[channel];
  if (started) {
    const double gap = delta / clock, damping = filters.row(1)[channel];
    const double drive = filters.row(2)[channel], walk = filters.row(3)[channel];
    const double z = gap * damping, e = std::exp(-z);
    const Integrals of = integrals(z, e);
    const double reach = gap * of.reach;
    const double both = cov[1] + reach * cov[2];
    cov[0] = cov[0] + reach * cov[1] + reach * both + drive * gap * gap * gap * of.level +
             walk * gap;
    cov[1] = e * both + drive * gap * gap * of.both;
    cov[2] = e * e * cov[2] + drive * gap * of.slope;
  }
  const double total = cov[0] + 1, kept = 1 / total, gain = cov[1] / total;
  level = cov[0] / total;
  slope = gain * (unit / clock);
  cov[2] = std::max(cov[2] - gain * cov[1], 0.0);
  cov[0] *= kept, cov[1] *= kept;
}

FilterTable filter_table(const Const<double>& filters, int64_t channels) {
  check_shape("filters", filters, {4, channels});
  check_contiguous("filters", filters);
  const double* p = filters.data();
  for (int64_t i = 0; i < 4 * channels; ++i)
    if (!(p[i] >= 0) || std::isinf(p[i]) || (i < channels && p[i] == 0))
      refuse("filters has the entry " + text_of(p[i]) + ", expected finite numbers of at least 0");
  return {std::vector<double>(p, p + 4 * channels), channels};
}
