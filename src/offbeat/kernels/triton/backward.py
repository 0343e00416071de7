"""The backward kernel: rows from last to first, inner activations recomputed row by row.

It stores what the gradients of weights are products of: the gradients of the gates, and the
activations and their gradients in the vector field. `backend` multiplies them after the kernel.
"""

from __future__ import annotations

import triton
import triton.language as tl

from offbeat.kernels.triton.steps import (
    clip,
    combine,
    copy,
    corrected_gain,
    drift,
    exponent,
    gates,
    grown,
    innovate,
    inside,
    motion,
    moved_by,
    product,
    stages,
    step_of,
    stop,
    tanh,
    zeros,
)


@triton.jit
def add(source, target, units, ok, c: tl.constexpr):
    """Adds a table in global memory to one of the block."""
    for n0 in range(0, units, c.BE):
        n = n0 + tl.arange(0, c.BE)[None, :]
        total = tl.load(target + n, mask=n < units, other=0.0)
        total += tl.load(source + n, mask=ok & (n < units), other=0.0)
        tl.store(target + n, total, mask=n < units)
    tl.debug_barrier()


@triton.jit
def act_backward(h, memory, gate, inner, g, to_gate, to_inner, w, update, c: tl.constexpr):
    """Gradient of the gates; `g`, of h and the memory, becomes the one before the update."""
    on = update[:, None]
    for n0 in range(0, c.H, c.BE):
        n = n0 + tl.arange(0, c.BE)[None, :]
        m = n < c.H
        to_new = tl.load(g + n, mask=m, other=0.0)
        first = tl.load(gate + n, mask=m, other=0.0)
        old = tl.load(h + n, mask=m, other=0.0)
        if c.CELL == "gru":
            candidate = tl.load(gate + 2 * c.H + n, mask=m, other=0.0)
            fraction = first * on
            to_candidate = to_new * fraction * (1.0 - candidate * candidate)
            to_update = to_new * on * (candidate - old) * first * (1.0 - first)
            tl.store(to_gate + n, to_update, mask=m)
            tl.store(to_gate + 2 * c.H + n, to_candidate, mask=m)
            tl.store(g + n, to_new - to_new * fraction, mask=m)
            if c.RESET_AFTER:
                r = tl.load(gate + c.H + n, mask=m, other=0.0)
                value = tl.load(inner + n, mask=m, other=0.0)
                tl.store(to_inner + n, to_candidate * r, mask=m)
                tl.store(to_gate + c.H + n, to_candidate * value * r * (1.0 - r), mask=m)
        elif c.CELL == "lstm":
            insert = tl.load(gate + c.H + n, mask=m, other=0.0)
            node = tl.load(gate + 2 * c.H + n, mask=m, other=0.0)
            output = tl.load(gate + 3 * c.H + n, mask=m, other=0.0)
            cell = tl.load(memory + n, mask=m, other=0.0)
            squashed = tanh(first * cell + insert * node)
            to_cell = tl.load(g + c.H + n, mask=m, other=0.0)
            to_h = to_new * on
            to_fresh = to_h * output * (1.0 - squashed * squashed) + to_cell * on
            tl.store(g + c.H + n, to_fresh * first + to_cell * (1.0 - on), mask=m)
            tl.store(g + n, to_new * (1.0 - on), mask=m)
            tl.store(to_gate + n, to_fresh * cell * first * (1.0 - first), mask=m)
            by_insert = to_fresh * node * insert * (1.0 - insert)
            tl.store(to_gate + c.H + n, by_insert, mask=m)
            tl.store(to_gate + 2 * c.H + n, to_fresh * insert * (1.0 - node * node), mask=m)
            by_output = to_h * squashed * output * (1.0 - output)
            tl.store(to_gate + 3 * c.H + n, by_output, mask=m)
        else:
            to_gates = to_new * on
            if c.CELL == "elman":
                to_gates *= 1.0 - first * first
            tl.store(to_gate + n, to_gates, mask=m)
            tl.store(g + n, to_new * (1.0 - on), mask=m)
    tl.debug_barrier()
    if c.CELL == "gru":
        for n0 in range(0, c.H, c.BN):
            n = n0 + tl.arange(0, c.BN)
            m = (n < c.H)[None, :]
            to_h = zeros(c.BM, c.BN)
            weight = w + 2 * c.H * c.H
            if c.RESET_AFTER:
                to_h = product(to_h, to_inner, weight, c.H, c.H, n, 1, c.H, c)
            else:
                to_h = product(to_h, to_gate + 2 * c.H, weight, c.H, c.H, n, 1, c.H, c)
                r = tl.load(gate + c.H + n[None, :], mask=m, other=0.0)
                old = tl.load(h + n[None, :], mask=m, other=0.0)
                tl.store(to_gate + c.H + n[None, :], to_h * old * r * (1.0 - r), mask=m)
                to_h *= r
            to_h += tl.load(g + n[None, :], mask=m, other=0.0)
            tl.store(g + n[None, :], to_h, mask=m)
        tl.debug_barrier()
    if c.recurrent:
        for n0 in range(0, c.H, c.BN):
            n = n0 + tl.arange(0, c.BN)
            m = (n < c.H)[None, :]
            to_h = tl.load(g + n[None, :], mask=m, other=0.0)
            size: tl.constexpr = 2 * c.H if c.CELL == "gru" else c.G
            to_h = product(to_h, to_gate, w, size, c.H, n, 1, c.H, c)
            tl.store(g + n[None, :], to_h, mask=m)
        tl.debug_barrier()


@triton.jit
def anchor_backward(
    x, innovation, g, to_gate, values, mask, level, slope, w, bounds, sums, ok, c: tl.constexpr
):
    """`g` of x and v after an observation becomes the one before it; `x` is the state before."""
    for n0 in range(0, c.A, c.BN):
        n = n0 + tl.arange(0, c.BN)
        m = (n < c.A)[None, :]
        to_innovation = zeros(c.BM, c.BN)
        to_innovation = product(
            to_innovation, to_gate, w + c.w_innovation, c.G, c.A, n, 1, c.A, c
        )  # fmt: skip
        n = n[None, :]
        seen = tl.load(mask + n, mask=ok & m, other=0.0)
        old = tl.load(x + n, mask=m, other=0.0)
        to_x = tl.load(g + n, mask=m, other=0.0)
        low = zeros(1, c.BN)
        high = low
        if c.BOUNDED:
            low = tl.load(bounds + n, mask=m, other=0.0)
            high = tl.load(bounds + c.D + n, mask=m, other=0.0)
        kept = 1.0 - seen
        if c.TREND:
            value = tl.load(values + n, mask=ok & m, other=0.0)
            gain = tl.load(level + n, mask=ok & m, other=0.0)
            by = tl.load(slope + n, mask=ok & m, other=0.0)
            odds = tl.load(w + c.w_trend + c.A + n, mask=m, other=1.0)
            factor = tl.load(w + c.w_trend + 2 * c.A + n, mask=m, other=0.0)
            used, outside = corrected_gain(value, old, seen, gain, odds, low, high, c)
            whole = gain + (1.0 - gain) * odds
            by_odds = -gain * (1.0 - gain) / (whole * whole) * (value - old)
            by_odds = tl.where(outside, 0.0, by_odds) * to_x
            to_v = tl.load(g + c.A + n, mask=m, other=0.0) * by
            by_factor = to_v * tl.load(innovation + n, mask=m, other=0.0)
            at = sums + c.A + n
            total = tl.load(at, mask=ok & m, other=0.0) + by_odds
            tl.store(at, total, mask=ok & m)
            total = tl.load(at + c.A, mask=ok & m, other=0.0) + by_factor
            tl.store(at + c.A, total, mask=ok & m)
            to_innovation += to_v * factor
            kept = 1.0 - used
        by_x = seen * to_innovation
        if c.BOUNDED:
            by_x *= inside(old, low, high)
        tl.store(g + n, kept * to_x - by_x, mask=m)
    tl.debug_barrier()


@triton.jit
def evaluate_backward(acts, deltas, w, layers, bounds, c: tl.constexpr):
    """From the gradient of the derivative, at the end of `deltas`, to that of the stage."""
    for q in range(c.layers):
        layer = c.layers - 1 - q
        k_size = tl.load(layers + 4 * layer + 1)
        n_size = tl.load(layers + 4 * layer)
        weight = w + tl.load(layers + 4 * layer + 2)
        at = tl.load(layers + 4 * layer + 3)
        for n0 in range(0, n_size, c.BN):
            n = n0 + tl.arange(0, c.BN)
            m = (n < n_size)[None, :]
            z = zeros(c.BM, c.BN)
            z = product(z, deltas + at + n_size, weight, k_size, n_size, n, 1, n_size, c)
            here = at + n[None, :]
            inner = n * 0 + layer > 0
            value = tl.load(acts + here, mask=m, other=0.0)
            if c.SILU:
                by = tl.load(deltas + here, mask=m & inner[None, :], other=1.0)
            else:
                by = tl.where(inner[None, :], 1.0 - value * value, 1.0)
            if c.BOUNDED:
                low = tl.load(bounds + n, mask=(n < n_size) & (inner == 0), other=0.0)[None, :]
                high = tl.load(bounds + c.D + n, mask=(n < n_size) & (inner == 0), other=0.0)[
                    None, :
                ]
                within = inside(value, low, high)
                by = tl.where(inner[None, :], by, within)
            tl.store(deltas + here, z * by, mask=m)
        tl.debug_barrier()


@triton.jit
def stages_backward(
    y, acts, deltas, g, moved, w, layers, tab, bounds, span, c: tl.constexpr
):  # fmt: skip
    """`g` of the state after a step of the solver becomes the one before it."""
    for n0 in range(0, c.D, c.BE):
        n = n0 + tl.arange(0, c.BE)[None, :]
        _state, kind = moved_by(y, acts, tab, bounds, span, n, c)
        all_of_it = tl.load(g + n, mask=n < c.D, other=0.0)
        tl.store(moved + n, tl.where(kind > 0, all_of_it, 0.0), mask=n < c.D)
        tl.store(g + n, tl.where(kind != 0, all_of_it, 0.0), mask=n < c.D)
    tl.debug_barrier()
    for p in range(c.STAGES):
        j = c.STAGES - 1 - p
        own = j * c.BM * c.E
        for n0 in range(0, c.D, c.BE):
            n = n0 + tl.arange(0, c.BE)[None, :]
            m = n < c.D
            total = tl.load(tab + 16 + j) * tl.load(moved + n, mask=m, other=0.0)
            for q in range(j + 1, c.STAGES):
                later = tl.load(deltas + q * c.BM * c.E + n, mask=m, other=0.0)
                total += tl.load(tab + 4 * q + j) * later
            tl.store(deltas + own + c.last + n, total * span[:, None], mask=m)
        tl.debug_barrier()
        evaluate_backward(acts + own, deltas + own, w, layers, bounds, c)
    for n0 in range(0, c.D, c.BE):
        n = n0 + tl.arange(0, c.BE)[None, :]
        total = tl.load(g + n, mask=n < c.D, other=0.0)
        for q in range(c.STAGES):
            total += tl.load(deltas + q * c.BM * c.E + n, mask=n < c.D, other=0.0)
        tl.store(g + n, total, mask=n < c.D)
    tl.debug_barrier()


@triton.jit
def drift_backward(
    source, applied_in, start, end, to_start, to_end, to_applied, g, sums, w, bounds, ok,
    updated, first, later, span, active, fraction, k, untracked, last, c: tl.constexpr,
):  # fmt: skip
    """`g` of the state after `drift` becomes the one before it; `source` is that state."""
    if c.TREND:
        for n0 in range(0, c.A, c.BE):
            n = n0 + tl.arange(0, c.BE)[None, :]
            m = n < c.A
            x = tl.load(source + n, mask=m, other=0.0)
            v = tl.load(source + c.A + n, mask=m, other=0.0)
            to_x = tl.load(g + n, mask=m, other=0.0)
            to_v = tl.load(g + c.A + n, mask=m, other=0.0)
            damping = tl.load(w + c.w_trend + n, mask=m, other=1.0)
            kept, reach, bend = motion(damping, span[:, None])
            to_moved = to_x
            if c.BOUNDED:
                low = tl.load(bounds + n, mask=m, other=0.0)
                high = tl.load(bounds + c.D + n, mask=m, other=0.0)
                _moved, kind = stop(x, x + reach * v, low, high)
                to_moved = tl.where(kind > 0, to_x, 0.0)
                tl.store(g + n, tl.where(kind != 0, to_x, 0.0), mask=m)
            by = -v * (to_v * span[:, None] * kept + to_moved * bend)
            total = tl.load(sums + n, mask=ok & m, other=0.0) + by
            tl.store(sums + n, total, mask=ok & m)
            tl.store(g + c.A + n, reach * to_moved + kept * to_v, mask=m)
    if c.DECAY:
        for n0 in range(0, c.H, c.BE):
            n = n0 + tl.arange(0, c.BE)[None, :]
            m = n < c.H
            s0 = tl.load(start + n, mask=ok & m, other=0.0)
            s1 = tl.load(end + n, mask=ok & m, other=0.0)
            applied = tl.load(applied_in + n, mask=m, other=0.0)
            part = fraction[:, None]
            before, reached, began, fresh = exponent(
                s0, s1, applied, updated[:, None], first[:, None], part, k, c
            )
            on = active[:, None]
            gamma = tl.exp(-grown(before, reached, on, c))
            to_h = tl.load(g + c.X + n, mask=m, other=0.0)
            tl.store(g + c.X + n, to_h * gamma, mask=m)
            bounded = clip(reached)
            to_growth = -gamma * to_h * tl.load(source + c.X + n, mask=m, other=0.0)
            if c.clamp_growth:
                to_growth = tl.where(bounded - before >= 0, to_growth, 0.0)
            to_growth = tl.where(on, to_growth, 0.0)
            to_after = tl.load(to_applied + n, mask=m, other=0.0)
            to_after = tl.where(last, 0.0, to_after)
            # The applied exponent is the larger of the two; a tie splits the gradient.
            slope = tl.where(bounded > before, 1.0, tl.where(bounded == before, 0.5, 0.0))
            slope = tl.where(on, slope, 0.0)
            to_before = to_after * (1.0 - slope) - to_growth
            open_end = (reached >= 0) & (reached <= 30.0)
            to_reached = tl.where(open_end, to_growth + to_after * slope, 0.0)
            if not c.SEVERAL:
                part = 0.0 * part + 1.0
            by_start = (1.0 - part) * to_reached
            by_end = part * to_reached
            value = s0 + began * (s1 - s0)
            open_start = (value >= 0) & (value <= 30.0) & (later[:, None] >= untracked)
            open_start = open_start & (began * 0.0 + k == untracked)
            to_began = tl.where(fresh | (open_start == 0), 0.0, to_before)
            by_start += (1.0 - began) * to_began
            by_end += began * to_began
            by_start += tl.load(to_start + n, mask=ok & m, other=0.0)
            by_end += tl.load(to_end + n, mask=ok & m, other=0.0)
            tl.store(to_start + n, by_start, mask=ok & m)
            tl.store(to_end + n, by_end, mask=ok & m)
            tl.store(to_applied + n, to_before, mask=m)
    tl.debug_barrier()


@triton.jit
def scan_backward(
    lanes, values, mask, level, slope, projected, start, end, state, before, after,
    weights, bounds, layers, tab, steps, scratch, batch, rows,
    to_before, to_after, g_state, to_projected, to_product, to_start, to_end, sums,
    acts, deltas, slots, slot_stride, begin, stop_at, places,
    HAS_BEFORE: tl.constexpr, HAS_AFTER: tl.constexpr, c: tl.constexpr,
):  # fmt: skip
    """Gradients of the rows from `stop_at` - 1 down to `begin`.

    The arguments before `to_before` are those of `scan_forward`.

    Args:
        to_before: gradient of `before`, if there is one.
        to_after: gradient of `after`, if there is one.
        g_state: (runs, batch, S) gradient of the state after the rows, and then before them.
        to_projected: (runs, batch, rows, G) gradient of the gates, stored.
        to_product: (runs, batch, rows, H) stored: input of the candidate's product, or its gradient
            with `RESET_AFTER`.
        to_start: (runs, batch, rows, H) gradient of the exponents, added to.
        to_end: see `to_start`.
        sums: (runs, batch, 3 A) gradients of the trend's weights, added to.
        acts: (runs, slots, stages, BM, E) activations of the vector field, stored.
        deltas: their gradients, stored.
        slots: (blocks of a run, rows) int64, first slot of the tracked steps of a row.
        slot_stride: slots of a run.
        begin: first of the rows.
        stop_at: the row after the last.
        places: steps of a row whose states the scratch has room for.
        HAS_BEFORE: `to_before` is given.
        HAS_AFTER: `to_after` is given.
        c: the shape.
    """
    program = tl.program_id(0)
    blocks = tl.cdiv(batch, c.BM)
    run, block = program // blocks, program % blocks
    lane = tl.arange(0, c.BM)
    at = block * c.BM + lane
    there = at < batch
    ok = there[:, None]
    one = (run * batch + at).to(tl.int64)
    w = weights + run.to(tl.int64) * c.w_size
    size = c.BM * (c.at_tape + places * (c.D + c.H))
    own = scratch + program.to(tl.int64) * size
    lane = lane[:, None]
    y = own + c.at_y * c.BM + lane * c.S
    to_node = own + c.at_node * c.BM + lane * c.S
    applied_now = own + c.at_applied * c.BM + lane * c.H
    innovation = own + c.at_innovation * c.BM + lane * c.A
    gate = own + c.at_gate * c.BM + lane * c.G
    inner = own + c.at_inner * c.BM + lane * c.H
    redone = own + c.at_acts * c.BM + lane * c.E
    to_gate = own + c.at_to_gate * c.BM + lane * c.G
    moved = own + c.at_moved * c.BM + lane * c.D
    to_applied = own + c.at_to_applied * c.BM + lane * c.H
    tape = own + c.at_tape * c.BM + lane * c.D
    tape_applied = own + (c.at_tape + places * c.D) * c.BM + lane * c.H
    g = own + c.at_g * c.BM + lane * c.S
    own_sums = sums + one[:, None] * (3 * c.A)

    for n0 in range(0, c.S, c.BE):
        n = n0 + tl.arange(0, c.BE)[None, :]
        given = tl.load(g_state + one[:, None] * c.S + n, mask=ok & (n < c.S), other=0.0)
        tl.store(g + n, given, mask=n < c.S)
    tl.debug_barrier()

    for down in range(stop_at - begin):
        i = stop_at - 1 - down
        row = one * rows + i
        gap = tl.load(lanes + row * 8, mask=there, other=0.0)
        update = tl.load(lanes + row * 8 + 1, mask=there, other=0.0)
        updated = tl.load(lanes + row * 8 + 2, mask=there, other=0.0)
        first = tl.load(lanes + row * 8 + 3, mask=there, other=0.0)
        node = tl.load(lanes + row * 8 + 4, mask=there, other=0.0 if c.NODES else 1.0)
        commit = tl.load(lanes + row * 8 + 5, mask=there, other=0.0)
        row = row[:, None]
        whole = tl.load(steps + (block * rows + i) * 2)
        reads = tl.load(steps + (block * rows + i) * 2 + 1)
        count = whole + reads
        untracked = tl.maximum(whole - c.TRACKED, 0) if c.NODES else whole * 0
        aside = tl.minimum(untracked, 1)  # a place that the untracked steps share
        later = whole - (node - first)

        if HAS_AFTER:
            add(to_after + row * c.S, g, c.S, ok, c)
        if c.NODES:  # a state that was not kept leaves that of the node to the next row
            for n0 in range(0, c.S, c.BE):
                n = n0 + tl.arange(0, c.BE)[None, :]
                m = n < c.S
                given = tl.load(g + n, mask=m, other=0.0)
                kept = commit[:, None] > 0
                tl.store(g + n, tl.where(kept, given, 0.0), mask=m)
                tl.store(to_node + n, tl.where(kept, 0.0, given), mask=m)
            tl.debug_barrier()
        if c.G > 0:
            if c.A > 0 or tl.max(update, axis=0) > 0:
                for n0 in range(0, c.S, c.BE):
                    n = n0 + tl.arange(0, c.BE)[None, :]
                    m = n < c.S
                    arrived = tl.load(before + row * c.S + n, mask=ok & m, other=0.0)
                    tl.store(y + n, arrived, mask=m)
                tl.debug_barrier()
                if c.A > 0:
                    innovate(y, innovation, values + row * c.A, mask + row * c.A, bounds, ok, c)
                gates(y + c.X, innovation, projected + row * c.G, gate, inner, w, ok, c)
                if c.CELL == "gru" and not c.RESET_AFTER:
                    for n0 in range(0, c.H, c.BE):
                        n = n0 + tl.arange(0, c.BE)[None, :]
                        m = n < c.H
                        value = tl.load(inner + n, mask=m, other=0.0)
                        tl.store(to_product + row * c.H + n, value, mask=ok & m)
                act_backward(
                    y + c.X, y + c.D, gate, inner, g + c.X, to_gate, applied_now, w, update, c
                )
                if c.CELL == "gru" and c.RESET_AFTER:
                    for n0 in range(0, c.H, c.BE):
                        n = n0 + tl.arange(0, c.BE)[None, :]
                        m = n < c.H
                        value = tl.load(applied_now + n, mask=m, other=0.0)
                        tl.store(to_product + row * c.H + n, value, mask=ok & m)
                if c.A > 0:
                    anchor_backward(
                        y, innovation, g, to_gate, values + row * c.A, mask + row * c.A,
                        level + row * c.A, slope + row * c.A, w, bounds, own_sums, ok, c,
                    )  # fmt: skip
                for n0 in range(0, c.G, c.BE):
                    n = n0 + tl.arange(0, c.BE)[None, :]
                    m = n < c.G
                    value = tl.load(to_gate + n, mask=m, other=0.0)
                    tl.store(to_projected + row * c.G + n, value, mask=ok & m)
                tl.debug_barrier()
        if HAS_BEFORE:
            add(to_before + row * c.S, g, c.S, ok, c)

        # The states before each step, from the state after the row before.
        if c.DECAY or c.TREND or c.flow:
            later_row = (at * 0 + i > 0)[:, None]
            for n0 in range(0, c.D, c.BE):
                n = n0 + tl.arange(0, c.BE)[None, :]
                m = n < c.D
                earlier = tl.load(after + (row - 1) * c.S + n, mask=ok & m & later_row, other=0.0)
                zeroth = tl.load(
                    state + one[:, None] * c.S + n, mask=ok & m & (later_row == 0), other=0.0
                )
                tl.store(y + n, earlier + zeroth, mask=m)
            tl.debug_barrier()
            for k in range(count):
                place = tl.maximum(k - untracked + aside, 0)
                here = tape + place * c.BM * c.D
                copy(y, here, c.D, c)
                if k < count - 1:
                    span, active, fraction = step_of(gap, first, node, whole, k, c)
                    if c.DECAY or c.TREND:
                        out = tape_applied + place * c.BM * c.H
                        come = tape_applied + tl.maximum(place - 1, 0) * c.BM * c.H
                        drift(
                            y, y, come, out, start + row * c.H, end + row * c.H, w, bounds, ok,
                            updated, first, span, active, fraction, k, c,
                        )  # fmt: skip
                    if c.flow:
                        stages(y, redone, redone, w, layers, tab, bounds, span, False, c)
                        combine(y, redone, tab, bounds, span, c)

        # The steps, last first.
        if c.NODES:
            if reads == 0:
                add(to_node, g, c.S, ok, c)
        if c.DECAY or c.TREND or c.flow:
            for q in range(count - untracked):
                k = count - 1 - q
                if c.NODES:
                    if (reads > 0) & (k == whole - 1):
                        add(to_node, g, c.S, ok, c)
                place = k - untracked + aside
                here = tape + place * c.BM * c.D
                come = tape_applied + tl.maximum(place - 1, 0) * c.BM * c.H
                span, active, fraction = step_of(gap, first, node, whole, k, c)
                if c.flow:
                    moving = here
                    if c.DECAY or c.TREND:
                        drift(
                            here, y, come, applied_now, start + row * c.H, end + row * c.H, w,
                            bounds, ok, updated, first, span, active, fraction, k, c,
                        )  # fmt: skip
                        moving = y
                    slot = run * slot_stride + tl.load(slots + block * rows + i) + k - untracked
                    slot = slot.to(tl.int64) * (c.STAGES * c.BM * c.E)
                    kept_acts = acts + slot + lane * c.E
                    kept_deltas = deltas + slot + lane * c.E
                    stages(moving, kept_acts, kept_deltas, w, layers, tab, bounds, span, True, c)
                    stages_backward(
                        moving, kept_acts, kept_deltas, g, moved, w, layers, tab, bounds, span, c
                    )
                if c.DECAY or c.TREND:
                    drift_backward(
                        here, come, start + row * c.H, end + row * c.H, to_start + row * c.H,
                        to_end + row * c.H, to_applied, g, own_sums, w, bounds, ok, updated, first,
                        later, span, active, fraction, k, untracked, q == 0, c,
                    )  # fmt: skip
        if c.NODES:
            if (reads > 0) & (whole == 0):
                add(to_node, g, c.S, ok, c)
            if untracked > 0:  # no gradient reaches the state before the tracked steps
                for n0 in range(0, c.D, c.BE):
                    n = n0 + tl.arange(0, c.BE)[None, :]
                    value = tl.load(g + n, mask=n < c.D, other=0.0)
                    value = tl.where(later[:, None] < untracked, 0.0, value)
                    tl.store(g + n, value, mask=n < c.D)
                tl.debug_barrier()

    for n0 in range(0, c.S, c.BE):
        n = n0 + tl.arange(0, c.BE)[None, :]
        value = tl.load(g + n, mask=n < c.S, other=0.0)
        tl.store(g_state + one[:, None] * c.S + n, value, mask=ok & (n < c.S))
