// All weights of a model in one vector: part of module.cpp.

template <class T>
void adamax(const InstructionSet& set, const Const<T>& gradient, double lerp, double beta,
            double eps, double step, Array<T> average, Array<T> largest, Array<T> weights) {
  const int64_t n = weights.ndim() ? int64_t(weights.shape(0)) : 0;
  check_shape("weights", weights, {n});
  check_shape("gradient", gradient, {n});
  check_shape("average", average, {n});
  check_shape("largest", largest, {n});
  check_contiguous("weights", weights);
  check_contiguous("gradient", gradient);
  check_contiguous("average", average);
  check_contiguous("largest", largest);
  typed<T>(set).adamax(n, gradient.data(), T(lerp), T(beta), T(eps), T(step), average.data(),
                       largest.data(), weights.data());
}

// to[a + k] (+)= from[b + k] for k < n and each (a, b, n) of `places`.
template <class T>
void move_weights(Array<T> to, const Const<T>& from, const Const<int64_t>& places, bool add) {
  const int64_t segments = places.ndim() ? int64_t(places.shape(0)) : 0;
  check_shape("places", places, {segments, 3});
  check_contiguous("places", places);
  check_shape("to", to, {to.ndim() ? int64_t(to.shape(0)) : 0});
  check_shape("from", from, {from.ndim() ? int64_t(from.shape(0)) : 0});
  check_contiguous("to", to);
  check_contiguous("from", from);
  for (const int64_t* p = places.data(); p < places.data() + 3 * segments; p += 3) {
    in_range("the length of a segment", p[2], 0, int64_t(std::min(to.shape(0), from.shape(0))));
    in_range("the place of a segment", p[0], 0, int64_t(to.shape(0)) - p[2]);
    in_range("the source of a segment", p[1], 0, int64_t(from.shape(0)) - p[2]);
    T* out = to.data() + p[0];
    const T* in = from.data() + p[1];
    for (int64_t k = 0; k < p[2]; ++k) out[k] = add ? out[k] + in[k] : in[k];
  }
}
