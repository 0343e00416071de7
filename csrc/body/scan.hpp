// One body of the scan: the loop over rows, forward and backward, for one instruction set.
//
//     decay -> flow over the gap -> (predictions are read here) -> cell at an observation
//
// Included by each body inside an anonymous namespace. Activations lie as [unit][lane]; weights are
// packed in panels of TILE outputs, [panel][input][output in panel], and broadcast. A block of
// lanes runs through all rows by itself, so its state and the weights stay in cache.
//
// Each lane's sums run over the inputs in order, in a batch ([unit][lane], vectors over lanes) as
// in a stream ([unit], vectors over outputs): the same bits.

template <class T>
struct Scan {
  using V = typename Lanes<T>::V;
  static constexpr int VW = Lanes<T>::W;
  static constexpr T LARGEST_EXPONENT = 30;

  static V splat(T s) { return broadcast<T>(s); }

#include "weights.hpp"
#include "affine.hpp"
#include "rows.hpp"
#include "forward.hpp"
#include "backward.hpp"
#include "perceptron.hpp"
#include "stream.hpp"
};
