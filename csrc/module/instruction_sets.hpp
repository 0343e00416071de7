// The instruction sets that this processor can run: part of module.cpp and
// library/stream.cpp.

std::vector<const InstructionSet*> runnable() {
  std::vector<const InstructionSet*> found;
#ifdef OFFBEAT_X86
  __builtin_cpu_init();
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") &&
      __builtin_cpu_supports("avx512dq"))
    found.push_back(&kernels_avx512);
  if (__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma"))
    found.push_back(&kernels_avx2);
#endif
  found.push_back(&kernels_baseline);
  return found;
}

const std::vector<const InstructionSet*>& instruction_sets() {
  static const std::vector<const InstructionSet*> all = runnable();
  return all;
}

const InstructionSet& find_instruction_set(const std::string& name) {
  std::string names;
  for (const InstructionSet* set : instruction_sets()) {
    if (name == set->name) return *set;
    names += std::string(names.empty() ? "" : ", ") + set->name;
  }
  refuse("this processor does not run the instruction set '" + name + "', it runs " + names);
}

template <class T>
const Kernels<T>& typed(const InstructionSet& b);
template <>
const Kernels<float>& typed(const InstructionSet& b) {
  return b.f32;
}
template <>
const Kernels<double>& typed(const InstructionSet& b) {
  if (!b.f64.width) refuse(std::string("the instruction set ") + b.name + " has float32 alone");
  return b.f64;
}
