// The instruction sets for products in bfloat16: part of module.cpp. They are chosen by name alone.

#ifdef OFFBEAT_BF16
// Asks Linux once for the tile registers of AMX, which a process may use after that.
bool tiles_are_allowed() {
  constexpr long ARCH_REQ_XCOMP_PERM = 0x1023, XFEATURE_XTILEDATA = 18;
  return syscall(SYS_arch_prctl, ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA) == 0;
}
std::vector<const InstructionSet*> runnable_bf16() {
  std::vector<const InstructionSet*> found;
  unsigned a, b, c, d;
  // CPUID leaf 7: AVX512BW is bit 30 of EBX, AMX-BF16 and AMX-TILE are bits 22 and 24 of EDX;
  // AVX512-BF16 is bit 5 of EAX of its subleaf 1.
  if (instruction_sets().front() != &kernels_avx512 || !__get_cpuid_count(7, 0, &a, &b, &c, &d) ||
      !(b >> 30 & 1))
    return found;
  const bool amx = d >> 22 & d >> 24 & 1;
  if (!__get_cpuid_count(7, 1, &a, &b, &c, &d) || !(a >> 5 & 1)) return found;
  if (amx && tiles_are_allowed()) found.push_back(&kernels_amx_bf16);
  found.push_back(&kernels_avx512_bf16);
  return found;
}
#else
std::vector<const InstructionSet*> runnable_bf16() { return {}; }
#endif

const std::vector<const InstructionSet*>& bf16_sets() {
  static const std::vector<const InstructionSet*> all = runnable_bf16();
  return all;
}

// An instruction set of either kind.
const InstructionSet& find_set(const std::string& name) {
  const bool bf16 = name.size() > 4 && !name.compare(name.size() - 4, 4, "bf16");
  if (bf16)
    for (const InstructionSet* set : bf16_sets())
      if (name == set->name) return *set;
  return find_instruction_set(name);
}
