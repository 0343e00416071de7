// A step of Adamax over all weights, with the bits of PyTorch: part of Scan<T> (scan.hpp).

template <class X>
static INLINE X larger(X a, X b) {  // NaN where either is
  const X m = a > b ? a : b;
  return a == a ? m : a;
}

static void adamax(int64_t n, const T* gradient, T lerp, T beta, T eps, T step, T* average,
                   T* largest, T* weights) {
  int64_t i = 0;
  auto take = [&](V g, T* m, T* u, T* w) {
    const V mean = fma(splat(lerp), g - load<T>(m), load<T>(m));
    const V most = larger(load<T>(u) * beta, (g < T(0) ? -g : g) + eps);
    store<T>(m, mean), store<T>(u, most), store<T>(w, load<T>(w) + step * mean / most);
  };
  for (; i + VW <= n; i += VW) take(load<T>(gradient + i), average + i, largest + i, weights + i);
  if (i == n) return;
  T last[4][VW];  // the rest, in a vector that is filled with ones
  for (int r = 0; r < VW; ++r) {
    const bool used = i + r < n;
    last[0][r] = used ? gradient[i + r] : T(1), last[1][r] = used ? average[i + r] : T(1);
    last[2][r] = used ? largest[i + r] : T(1), last[3][r] = used ? weights[i + r] : T(1);
  }
  take(load<T>(last[0]), last[1], last[2], last[3]);
  for (int r = 0; i + r < n; ++r)
    average[i + r] = last[1][r], largest[i + r] = last[2][r], weights[i + r] = last[3][r];
}
