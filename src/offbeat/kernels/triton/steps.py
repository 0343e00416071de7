"""What both kernels of the scan do for a block of trajectories: products, steps, cells.

Tables of a block lie in global memory, a row per trajectory, and stay in the caches. Pointers to
them are (BM, 1), to the first unit of each trajectory. A function that stores to a table ends with
a barrier, after which all threads of the program see it.
"""

from __future__ import annotations

from typing import Any

import triton
import triton.language as tl

from offbeat.kernels.triton.shape import Shape

# Annotations of these functions are of Triton: `tl.constexpr` is a constant of the kernel.
Constant: Any = tl.constexpr
_ = Shape


@triton.jit
def tanh(x):
    """tanh, without overflow, and near 0 by its series, without cancellation."""
    t = tl.exp(-2.0 * tl.abs(x))
    y = 1.0 - 2.0 * t / (1.0 + t)
    y = tl.where(x < 0, -y, y)
    z = x * x
    near = 1.0 + z * (-1.0 / 3 + z * (2.0 / 15 + z * (-17.0 / 315 + z * (62.0 / 2835))))
    return tl.where(z < 0.0625, x * near, y)


@triton.jit
def sigmoid(x):
    """1 / (1 + exp(-x)), without overflow."""
    t = tl.exp(-tl.abs(x))
    return tl.where(x < 0, t, 1.0) / (1.0 + t)


@triton.jit
def zeros(rows: tl.constexpr, columns: tl.constexpr):
    """Zeros; Triton before 3.8 takes lengths from a function's arguments, and not from a record."""
    return tl.zeros((rows, columns), tl.float32)


@triton.jit
def clip(a):
    """An exponent within its bounds."""
    return tl.minimum(tl.maximum(a, 0.0), 30.0)


@triton.jit
def inside(y, low, high):
    """1 strictly within a range, else 0."""
    return tl.where((y > low) & (y < high), 1.0, 0.0)


@triton.jit
def stop(old, moved, low, high):
    """`moved`, stopped where it leaves its range, and its kind.

    The kind is 1 for the result of the step, 0 for an end of the range, -1 for the old state.
    """
    least = tl.where(old < low, old, low)
    most = tl.where(old > high, old, high)
    kind = tl.where(moved < least, tl.where(old < low, -1.0, 0.0), 1.0)
    moved = tl.where(moved < least, least, moved)
    kind = tl.where(moved > most, tl.where(old > high, -1.0, 0.0), kind)
    moved = tl.where(moved > most, most, moved)
    return moved, kind


@triton.jit
def product(acc, x, w, k_size, k_stride, n, n_stride, n_size, c: tl.constexpr):
    """Adds x w to (BM, BN): sums over `k_size` units of a table for the outputs `n`."""
    for k0 in range(0, k_size, c.BK):
        k = k0 + tl.arange(0, c.BK)
        a = tl.load(x + k[None, :], mask=(k < k_size)[None, :], other=0.0)
        b = tl.load(
            w + k[:, None] * k_stride + n[None, :] * n_stride,
            mask=(k < k_size)[:, None] & (n < n_size)[None, :],
            other=0.0,
        )
        acc = tl.dot(a, b, acc, input_precision=c.PRECISION)
    return acc


@triton.jit
def copy(source, target, units, c: tl.constexpr):
    """Copies `units` of each trajectory from table to table."""
    for n0 in range(0, units, c.BE):
        n = n0 + tl.arange(0, c.BE)[None, :]
        tl.store(target + n, tl.load(source + n, mask=n < units, other=0.0), mask=n < units)
    tl.debug_barrier()


# --- steps over the gap ---------------------------------------------------------------------------


@triton.jit
def step_of(gap, first, node, whole, k, c: tl.constexpr):
    """Step `k` of each trajectory: its length, whether it is taken, and the fraction at its end.

    Without nodes `node` is the number of steps. With nodes, trajectories end at the same step.
    """
    if c.NODES:
        later = whole - (node - first)
        reads = k >= whole
        at = tl.where(reads, node, first + (k + 1 - later))
        active = tl.where(reads, later >= 0, k >= later)
        span = tl.where(reads, gap, tl.where(active, c.MAX_STEP, 0.0))
        fraction = (at * c.MAX_STEP + tl.where(reads, gap, 0.0)) / c.SPAN
    elif c.flow:
        active = node > -1
        span = tl.where(k < node, gap / node, 0.0)
        fraction = tl.minimum((k + 1) / node, 1.0)
    else:
        active = node > -1
        span = gap
        fraction = 0.0 * gap + 1.0
    return span, active, fraction


@triton.jit
def exponent(s0, s1, applied, updated, first, fraction, k, c: tl.constexpr):
    """The exponent of a decay before and at the end of step `k`, `began` and `fresh`.

    Before the first step it is that at the fraction `began`, or 0 where `fresh`.
    """
    on = updated > 0
    if c.NODES:
        fresh = on & (first == 0)
        along = tl.where(s1 >= s0, first, tl.where(on, 1.0, 0.0)) * (c.MAX_STEP / c.SPAN)
        began = tl.where(first > 0, along, 0.0)
    elif c.CONTINUOUS:
        fresh = on & (s0 == s0)
        began = 0.0 * s0
    else:
        fresh = s0 == s0
        began = 0.0 * s0
    before = tl.where(fresh, 0.0, clip(s0 + began * (s1 - s0)))
    before = tl.where(k > 0, applied, before)
    reached = s1
    if c.SEVERAL:
        reached = s0 + fraction * (s1 - s0)
    return before, reached, began, fresh


@triton.jit
def grown(before, reached, active, c: tl.constexpr):
    """The growth of an exponent over a step."""
    growth = clip(reached) - before
    if c.clamp_growth:
        growth = tl.maximum(growth, 0.0)
    return tl.where(active, growth, 0.0)


@triton.jit
def motion(damping, span):
    """What a damped trend does in `span`: kept, reach, and minus the derivative of the reach."""
    z = damping * span
    near = z < 0.5
    small = tl.where(near, z, 0.0)
    close = small * 0.0 + 2.7557319223985893e-06  # 1 / 9!
    bend = small * 0.0 + 2.7557319223985893e-06 * 8.0
    close = close * small + -2.48015873015873e-05
    bend = bend * small + -2.48015873015873e-05 * 7.0
    close = close * small + 1.984126984126984e-04
    bend = bend * small + 1.984126984126984e-04 * 6.0
    close = close * small + -1.388888888888889e-03
    bend = bend * small + -1.388888888888889e-03 * 5.0
    close = close * small + 8.333333333333333e-03
    bend = bend * small + 8.333333333333333e-03 * 4.0
    close = close * small + -4.1666666666666664e-02
    bend = bend * small + -4.1666666666666664e-02 * 3.0
    close = close * small + 1.6666666666666666e-01
    bend = bend * small + 1.6666666666666666e-01 * 2.0
    close = close * small + -0.5
    bend = bend * small + -0.5
    close = close * small + 1.0
    kept = tl.exp(-z)
    safe = tl.where(near, 1.0, z)
    far = (1.0 - kept) / safe
    reach = span * tl.where(near, close, far)
    bend = -span * span * tl.where(near, bend, (kept - far) / safe)
    return kept, reach, bend


@triton.jit
def drift(
    source, target, applied_in, applied_out, start, end, w, bounds, ok, updated, first,
    span, active, fraction, k, c: tl.constexpr,
):  # fmt: skip
    """Decay of h and trend of x over a step, from a table of states to another, or to itself."""
    for n0 in range(0, c.H, c.BE):
        n = n0 + tl.arange(0, c.BE)[None, :]
        m = n < c.H
        h = tl.load(source + c.X + n, mask=m, other=0.0)
        if c.DECAY:
            s0 = tl.load(start + n, mask=ok & m, other=0.0)
            s1 = tl.load(end + n, mask=ok & m, other=0.0)
            applied = tl.load(applied_in + n, mask=m, other=0.0)
            before, reached, _began, _fresh = exponent(
                s0, s1, applied, updated[:, None], first[:, None], fraction[:, None], k, c
            )
            h *= tl.exp(-grown(before, reached, active[:, None], c))
            after = tl.where(active[:, None], tl.maximum(before, clip(reached)), before)
            tl.store(applied_out + n, after, mask=m)
        tl.store(target + c.X + n, h, mask=m)
    for n0 in range(0, c.A, c.BE):
        n = n0 + tl.arange(0, c.BE)[None, :]
        m = n < c.A
        x = tl.load(source + n, mask=m, other=0.0)
        if c.TREND:
            v = tl.load(source + c.A + n, mask=m, other=0.0)
            damping = tl.load(w + c.w_trend + n, mask=m, other=1.0)
            kept, reach, _bend = motion(damping, span[:, None])
            moved = x + reach * v
            if c.BOUNDED:
                low = tl.load(bounds + n, mask=m, other=0.0)
                high = tl.load(bounds + c.D + n, mask=m, other=0.0)
                moved, _kind = stop(x, moved, low, high)
            tl.store(target + c.A + n, kept * v, mask=m)
            tl.store(target + n, moved, mask=m)
        else:
            tl.store(target + n, x, mask=m)
    tl.debug_barrier()


@triton.jit
def evaluate(x, slopes, w, layers, KEEP: tl.constexpr, c: tl.constexpr):
    """Applies the vector field to the first units of a row of activations, and stores all layers.

    With `KEEP`, `slopes` gets the derivatives of SiLU; those of tanh follow from its values.
    """
    for layer in range(c.layers):
        k_size = tl.load(layers + 4 * layer)
        n_size = tl.load(layers + 4 * layer + 1)
        weight = w + tl.load(layers + 4 * layer + 2)
        at = tl.load(layers + 4 * layer + 3)
        for n0 in range(0, n_size, c.BN):
            n = n0 + tl.arange(0, c.BN)
            m = (n < n_size)[None, :]
            bias = tl.load(weight + n_size * k_size + n, mask=n < n_size, other=0.0)
            z = zeros(c.BM, c.BN) + bias[None, :]
            z = product(z, x + at, weight, k_size, 1, n, k_size, n_size, c)
            out = at + k_size + n[None, :]
            between = (n * 0 + layer < c.layers - 1)[None, :]
            if c.SILU:
                s = sigmoid(z)
                tl.store(x + out, tl.where(between, z * s, z), mask=m)
                if KEEP:
                    tl.store(slopes + out, s * (1.0 + z * (1.0 - s)), mask=m & between)
            else:
                tl.store(x + out, tl.where(between, tanh(z), z), mask=m)
        tl.debug_barrier()


@triton.jit
def stages(y, acts, slopes, w, layers, tab, bounds, span, KEEP: tl.constexpr, c: tl.constexpr):
    """Evaluates the vector field at each stage of a step; a stage has a row of activations."""
    for j in range(c.STAGES):
        own = j * c.BM * c.E
        for n0 in range(0, c.D, c.BE):
            n = n0 + tl.arange(0, c.BE)[None, :]
            m = n < c.D
            total = zeros(c.BM, c.BE)
            for q in range(j):
                slope = tl.load(acts + q * c.BM * c.E + c.last + n, mask=m, other=0.0)
                total += tl.load(tab + 4 * j + q) * slope
            value = tl.load(y + n, mask=m, other=0.0) + span[:, None] * total
            if c.BOUNDED:
                value = tl.maximum(value, tl.load(bounds + n, mask=m, other=0.0))
                value = tl.minimum(value, tl.load(bounds + c.D + n, mask=m, other=0.0))
            tl.store(acts + own + n, value, mask=m)
        tl.debug_barrier()
        evaluate(acts + own, slopes + own, w, layers, KEEP, c)


@triton.jit
def moved_by(y, acts, tab, bounds, span, n, c: tl.constexpr):
    """The state after a step for the units `n`, and its kind as of `stop`."""
    m = n < c.D
    total = zeros(c.BM, c.BE)
    for q in range(c.STAGES):
        slope = tl.load(acts + q * c.BM * c.E + c.last + n, mask=m, other=0.0)
        total += tl.load(tab + 16 + q) * slope
    old = tl.load(y + n, mask=m, other=0.0)
    moved = old + span[:, None] * total
    kind = 0.0 * moved + 1.0
    if c.BOUNDED:
        low = tl.load(bounds + n, mask=m, other=0.0)
        high = tl.load(bounds + c.D + n, mask=m, other=0.0)
        moved, kind = stop(old, moved, low, high)
    return moved, kind


@triton.jit
def combine(y, acts, tab, bounds, span, c: tl.constexpr):
    """Ends a step of the solver."""
    for n0 in range(0, c.D, c.BE):
        n = n0 + tl.arange(0, c.BE)[None, :]
        moved, _kind = moved_by(y, acts, tab, bounds, span, n, c)
        tl.store(y + n, moved, mask=n < c.D)
    tl.debug_barrier()


# --- at an observation ----------------------------------------------------------------------------


@triton.jit
def innovate(y, innovation, values, mask, bounds, ok, c: tl.constexpr):
    """Stores the innovation of anchored channels, of the state in `y`."""
    for n0 in range(0, c.A, c.BE):
        n = n0 + tl.arange(0, c.BE)[None, :]
        m = n < c.A
        value = tl.load(values + n, mask=ok & m, other=0.0)
        x = tl.load(y + n, mask=m, other=0.0)
        if c.BOUNDED:
            low = tl.load(bounds + n, mask=m, other=0.0)
            high = tl.load(bounds + c.D + n, mask=m, other=0.0)
            value = tl.minimum(tl.maximum(value, low), high)
            x = tl.minimum(tl.maximum(x, low), high)
        seen = tl.load(mask + n, mask=ok & m, other=0.0)
        tl.store(innovation + n, seen * (value - x), mask=m)
    tl.debug_barrier()


@triton.jit
def corrected_gain(value, x, seen, gain, odds, low, high, c: tl.constexpr):
    """The gain of a level, which is 1 where the value or the state is out of range."""
    corrected = gain / (gain + (1.0 - gain) * odds)
    outside = seen < 0
    if c.BOUNDED:
        outside = (value < low) | (value > high) | (x < low) | (x > high)
        outside = outside & (seen > 0)
    return tl.where(outside, 1.0, corrected), outside


@triton.jit
def anchor(y, innovation, values, mask, level, slope, w, bounds, ok, c: tl.constexpr):
    """Anchored channels take the observed values, or move by gains."""
    for n0 in range(0, c.A, c.BE):
        n = n0 + tl.arange(0, c.BE)[None, :]
        m = n < c.A
        value = tl.load(values + n, mask=ok & m, other=0.0)
        seen = tl.load(mask + n, mask=ok & m, other=0.0)
        x = tl.load(y + n, mask=m, other=0.0)
        if c.TREND:
            low = zeros(1, c.BE)
            high = low
            if c.BOUNDED:
                low = tl.load(bounds + n, mask=m, other=0.0)
                high = tl.load(bounds + c.D + n, mask=m, other=0.0)
            gain = tl.load(level + n, mask=ok & m, other=0.0)
            odds = tl.load(w + c.w_trend + c.A + n, mask=m, other=1.0)
            factor = tl.load(w + c.w_trend + 2 * c.A + n, mask=m, other=0.0)
            gain, _outside = corrected_gain(value, x, seen, gain, odds, low, high, c)
            by = tl.load(slope + n, mask=ok & m, other=0.0) * factor
            v = tl.load(y + c.A + n, mask=m, other=0.0)
            v += by * tl.load(innovation + n, mask=m, other=0.0)
            tl.store(y + c.A + n, v, mask=m)
            x = gain * value + (1.0 - gain) * x
        else:
            x = tl.where(seen > 0, value, x)
        tl.store(y + n, x, mask=m)


@triton.jit
def gate_of(h, innovation, projected, w, ok, g: tl.constexpr, n, c: tl.constexpr):
    """Gate `g` for the units `n` before its activation, without a product of the reset gate."""
    m = (n < c.H)[None, :]
    z = tl.load(projected + g * c.H + n[None, :], mask=ok & m, other=0.0)
    if c.A > 0:
        weight = w + c.w_innovation + g * c.H * c.A
        z = product(z, innovation, weight, c.A, 1, n, c.A, c.H, c)
    if c.recurrent and (c.CELL != "gru" or g < 2):
        z = product(z, h, w + c.w_recurrent + g * c.H * c.H, c.H, 1, n, c.H, c.H, c)
    return z


@triton.jit
def gates(h, innovation, projected, gate, inner, w, ok, c: tl.constexpr):
    """Stores the activated gates of the cell, and the table of the reset gate's product.

    That is r h, or with `RESET_AFTER` the product.
    """
    if c.CELL == "gru":
        for n0 in range(0, c.H, c.BN):
            n = n0 + tl.arange(0, c.BN)
            m = (n < c.H)[None, :]
            z = gate_of(h, innovation, projected, w, ok, 0, n, c)
            tl.store(gate + n[None, :], sigmoid(z), mask=m)
            r = sigmoid(gate_of(h, innovation, projected, w, ok, 1, n, c))
            tl.store(gate + c.H + n[None, :], r, mask=m)
            if c.RESET_AFTER:
                bias = tl.load(w + c.w_reset + n, mask=n < c.H, other=0.0)
                z = zeros(c.BM, c.BN) + bias[None, :]
                z = product(z, h, w + 2 * c.H * c.H, c.H, 1, n, c.H, c.H, c)
                tl.store(inner + n[None, :], z, mask=m)
            else:
                tl.store(inner + n[None, :], r * tl.load(h + n[None, :], mask=m, other=0.0), mask=m)
        tl.debug_barrier()
        for n0 in range(0, c.H, c.BN):
            n = n0 + tl.arange(0, c.BN)
            m = (n < c.H)[None, :]
            z = gate_of(h, innovation, projected, w, ok, 2, n, c)
            if c.RESET_AFTER:
                r = tl.load(gate + c.H + n[None, :], mask=m, other=0.0)
                z += r * tl.load(inner + n[None, :], mask=m, other=0.0)
            else:
                z = product(z, inner, w + 2 * c.H * c.H, c.H, 1, n, c.H, c.H, c)
            tl.store(gate + 2 * c.H + n[None, :], tanh(z), mask=m)
        tl.debug_barrier()
    else:
        for g in tl.static_range(0, c.gates):
            for n0 in range(0, c.H, c.BN):
                n = n0 + tl.arange(0, c.BN)
                z = gate_of(h, innovation, projected, w, ok, g, n, c)
                if c.CELL == "elman" or (c.CELL == "lstm" and g == 2):
                    z = tanh(z)
                elif c.CELL == "lstm":
                    z = sigmoid(z)
                tl.store(gate + g * c.H + n[None, :], z, mask=(n < c.H)[None, :])
        tl.debug_barrier()


@triton.jit
def act(h, memory, gate, update, c: tl.constexpr):
    """The new h and memory from activated gates, where `update` is 1."""
    for n0 in range(0, c.H, c.BE):
        n = n0 + tl.arange(0, c.BE)[None, :]
        m = n < c.H
        on = update[:, None]
        old = tl.load(h + n, mask=m, other=0.0)
        first = tl.load(gate + n, mask=m, other=0.0)
        if c.CELL == "gru":
            candidate = tl.load(gate + 2 * c.H + n, mask=m, other=0.0)
            new = old + first * on * (candidate - old)
        elif c.CELL == "lstm":
            cell = tl.load(memory + n, mask=m, other=0.0)
            fresh = first * cell + tl.load(gate + c.H + n, mask=m, other=0.0) * tl.load(
                gate + 2 * c.H + n, mask=m, other=0.0
            )
            tl.store(memory + n, tl.where(on > 0, fresh, cell), mask=m)
            output = tl.load(gate + 3 * c.H + n, mask=m, other=0.0)
            new = tl.where(on > 0, output * tanh(fresh), old)
        else:
            new = tl.where(on > 0, first, old)
        tl.store(h + n, new, mask=m)
