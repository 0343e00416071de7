// The cells, forward and backward: part of Scan<T> (scan.hpp).

// `gate` is the projection of the inputs, and becomes the activated gates.
template <class P>
static NOINLINE void cell_forward(const Context<P>& c, const RowInputs<P>& f, T* h, T* memory,
                                  T* gate, T* inner) {
  const Spec& s = c.s;
  const Dims& d = c.map.d;
  constexpr int W = P::W;
  const int64_t n = int64_t(P::pad(d.H)) * W;
  if (s.cell == CELL_START) {
    P::each(d.H, [&](int64_t i, int lane) {
      const V on = load<T>(f.update + lane);
      store<T>(h + i, on * load<T>(gate + i) + (1 - on) * load<T>(h + i));
    });
    return;
  }
  if (s.cell != CELL_GRU) {
    P::template affine<true>(c.map.m[M_REC], c.packed, c.lanes, h, gate);
    if (s.cell == CELL_ELMAN) {  // equation 6
      P::each(d.H, [&](int64_t i, int lane) {
        const V on = load<T>(f.update + lane), fresh = tanh_(load<T>(gate + i));
        store<T>(gate + i, fresh);
        store<T>(h + i, on * fresh + (1 - on) * load<T>(h + i));
      });
      return;
    }
    P::each(d.H, [&](int64_t i, int lane) {  // equations 14-19
      const V on = load<T>(f.update + lane), off = 1 - on;
      const V forget = sigmoid_(load<T>(gate + i)), insert = sigmoid_(load<T>(gate + n + i));
      const V node = tanh_(load<T>(gate + 2 * n + i));
      const V output = sigmoid_(load<T>(gate + 3 * n + i));
      const V old = load<T>(memory + i);
      const V fresh = fma(forget, old, insert * node), squashed = tanh_(fresh);
      store<T>(gate + i, forget), store<T>(gate + n + i, insert);
      store<T>(gate + 2 * n + i, node), store<T>(gate + 3 * n + i, output);
      store<T>(inner + i, squashed);
      store<T>(memory + i, on * fresh + off * old);
      store<T>(h + i, on * output * squashed + off * load<T>(h + i));
    });
    return;
  }
  // equations 20-23, and 29-32 for the gates of GRU-D
  P::template affine<true>(c.map.m[M_REC], c.packed, c.lanes, h, gate);
  P::each(d.H, [&](int64_t i, int) {
    const V r = sigmoid_(load<T>(gate + n + i));
    store<T>(gate + i, sigmoid_(load<T>(gate + i)));
    store<T>(gate + n + i, r);
    if (!s.reset_after) store<T>(inner + i, r * load<T>(h + i));
  });
  if (s.reset_after) {
    P::template affine<false>(c.map.m[M_CAND], c.packed, c.lanes, h, inner);
    P::each(d.H, [&](int64_t i, int) {
      T* g = gate + 2 * n + i;
      store<T>(g, fma(load<T>(gate + n + i), load<T>(inner + i), load<T>(g)));
    });
  } else {
    P::template affine<true>(c.map.m[M_CAND], c.packed, c.lanes, inner, gate + 2 * n);
  }
  P::each(d.H, [&](int64_t i, int lane) {
    const V candidate = tanh_(load<T>(gate + 2 * n + i)), old = load<T>(h + i);
    store<T>(gate + 2 * n + i, candidate);
    store<T>(h + i, fma(load<T>(gate + i) * load<T>(f.update + lane), candidate - old, old));
  });
}

// Computes the gradient of the gates; `gh` and `gc` become the gradients before the update.
template <class P>
static NOINLINE void cell_backward(Back<P>& k, const RowInputs<P>& f, const T* tape, T* slot, T* gh,
                                   T* gc) {
  const Context<P>& c = k.c;
  const Spec& s = c.s;
  const Dims& d = c.map.d;
  const Layout<P>& l = c.l;
  constexpr int W = P::W;
  const int64_t n = int64_t(d.H) * W;
  const T* h = tape + (l.before + l.h_at) * W;
  const T* memory = tape + (l.before + l.c_at) * W;
  const T* gate = tape + l.gate * W;
  const T* inner = tape + l.inner * W;
  T* to_gate = slot + k.places.gate * W;

  if (s.cell == CELL_START) {
    P::each(d.H, [&](int64_t i, int lane) {
      const V on = load<T>(f.update + lane), g = load<T>(gh + i);
      store<T>(to_gate + i, g * on);
      store<T>(gh + i, g * (1 - on));
    });
    return;
  }
  if (s.cell == CELL_ELMAN || s.cell == CELL_LSTM) {
    P::each(d.H, [&](int64_t i, int lane) {
      const V on = load<T>(f.update + lane), off = 1 - on, g = load<T>(gh + i);
      store<T>(gh + i, g * off);
      if (s.cell == CELL_ELMAN) {
        const V fresh = load<T>(gate + i);
        store<T>(to_gate + i, g * on * fma(-fresh, fresh, splat(1)));
        return;
      }
      const V forget = load<T>(gate + i), insert = load<T>(gate + n + i);
      const V node = load<T>(gate + 2 * n + i), output = load<T>(gate + 3 * n + i);
      const V squashed = load<T>(inner + i), g2 = load<T>(gc + i), new_h = g * on;
      const V to_fresh = fma(new_h * output, fma(-squashed, squashed, splat(1)), g2 * on);
      store<T>(gc + i, fma(to_fresh, forget, g2 * off));
      store<T>(to_gate + i, to_fresh * load<T>(memory + i) * forget * (1 - forget));
      store<T>(to_gate + n + i, to_fresh * node * insert * (1 - insert));
      store<T>(to_gate + 2 * n + i, to_fresh * insert * fma(-node, node, splat(1)));
      store<T>(to_gate + 3 * n + i, new_h * squashed * output * (1 - output));
    });
    k.push(M_REC, to_gate, h);
    P::template transposed<true>(c.map.m[M_REC], c.packed, c.lanes, to_gate, gh);
    return;
  }
  T* to_inner = slot + k.places.inner * W;
  T* to_reset = k.z;
  P::each(d.H, [&](int64_t i, int lane) {
    const V on = load<T>(f.update + lane), g = load<T>(gh + i), update = load<T>(gate + i);
    const V candidate = load<T>(gate + 2 * n + i), fraction = update * on;
    const V to_candidate = g * fraction * fma(-candidate, candidate, splat(1));
    store<T>(to_gate + i, g * on * (candidate - load<T>(h + i)) * update * (1 - update));
    store<T>(to_gate + 2 * n + i, to_candidate);
    store<T>(gh + i, g - g * fraction);
    if (s.reset_after) {
      const V r = load<T>(gate + n + i);
      store<T>(to_inner + i, to_candidate * r);
      store<T>(to_gate + n + i, to_candidate * load<T>(inner + i) * r * (1 - r));
    }
  });
  if (s.reset_after) {
    k.push(M_CAND, to_inner, h);
    P::template transposed<true>(c.map.m[M_CAND], c.packed, c.lanes, to_inner, gh);
  } else {
    k.push(M_CAND, to_gate + 2 * n, inner);
    P::template transposed<false>(c.map.m[M_CAND], c.packed, c.lanes, to_gate + 2 * n, to_reset);
    P::each(d.H, [&](int64_t i, int) {
      const V r = load<T>(gate + n + i), g = load<T>(to_reset + i);
      store<T>(to_gate + n + i, g * load<T>(h + i) * r * (1 - r));
      store<T>(gh + i, fma(g, r, load<T>(gh + i)));
    });
  }
  k.push(M_REC, to_gate, h);
  P::template transposed<true>(c.map.m[M_REC], c.packed, c.lanes, to_gate, gh);
}
