// The scan for one instruction set: the loop over rows, forward and backward.
//
//     decay -> dynamics over the gap -> (the state before the row) -> cell at an observation
//
// Included inside an anonymous namespace, once per instruction set. Activations are stored as
// [unit][lane]. Weights are packed in panels of TILE outputs, [panel][input][output in panel], and
// broadcast. Each block of lanes is computed independently, so its state and the weights stay in
// cache.
//
// The sums of each lane run over the inputs in order, both in a batch ([unit][lane], vectors over
// lanes) and in a stream ([unit], vectors over outputs). The results are equal bit for bit.

// Instruction sets that compute products in bfloat16 define BF16 and, with AMX, BF16_AMX.
#ifndef BF16
#define BF16 0
#endif

template <class T>
struct Scan {
  using V = typename Lanes<T>::V;
  static constexpr int VW = Lanes<T>::W;
  static constexpr T LARGEST_EXPONENT = 30;
  static constexpr T HIDDEN_LIMIT = 10;  // of a hidden unit in a bounded scan

  static V splat(T s) { return broadcast<T>(s); }

#include "weights.hpp"
#include "affine.hpp"
#if BF16
#include "bf16.hpp"
#endif
#include "layout.hpp"
#include "forward.hpp"
#include "weight_gradients.hpp"
#include "backward.hpp"
#include "cells.hpp"
#include "perceptron.hpp"
#include "stream.hpp"
#include "optimizer.hpp"
};
