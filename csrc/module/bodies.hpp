// The bodies that this processor can run: part of module.cpp.

std::vector<const Bodies*> runnable() {
  std::vector<const Bodies*> found;
#ifdef OFFBEAT_X86
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") &&
      __builtin_cpu_supports("avx512dq"))
    found.push_back(&body_avx512);
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma")) found.push_back(&body_avx2);
#endif
  found.push_back(&body_baseline);
  return found;
}

const std::vector<const Bodies*>& bodies() {
  static const std::vector<const Bodies*> all = runnable();
  return all;
}

const Bodies& body_named(const std::string& name) {
  std::string names;
  for (const Bodies* b : bodies()) {
    if (name == b->name) return *b;
    names += std::string(names.empty() ? "" : ", ") + b->name;
  }
  throw nb::value_error(
      ("no body '" + name + "' runs on this processor; those that do: " + names).c_str());
}

template <class T>
const Body<T>& typed(const Bodies& b);
template <>
const Body<float>& typed(const Bodies& b) {
  return b.f32;
}
template <>
const Body<double>& typed(const Bodies& b) {
  return b.f64;
}
