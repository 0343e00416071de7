"""The forward kernel: a program takes a block of trajectories through all rows."""

from __future__ import annotations

import triton
import triton.language as tl

from offbeat.kernels.triton.steps import (
    act,
    anchor,
    combine,
    copy,
    drift,
    gates,
    innovate,
    stages,
    step_of,
)


@triton.jit
def scan_forward(
    lanes, values, mask, level, slope, projected, start, end, state, before, after,
    weights, bounds, layers, tab, steps, scratch, batch, rows, c: tl.constexpr,
):  # fmt: skip
    """Stores the states before and after each row.

    All numbers are float32 and contiguous. `runs` models with weights of their own have a batch of
    trajectories each; a program has trajectories of one of them.

    Args:
        lanes: (runs, batch, rows, 8) gap, update, updated, first node, node or steps, commit.
        values: (runs, batch, rows, A), as are mask, level and slope.
        mask: see above.
        level: see above; with a trend only.
        slope: see above; with a trend only.
        projected: (runs, batch, rows, G) input projection of the cell.
        start: (runs, batch, rows, H) exponents of the decay at the start of the gap.
        end: the same at its end.
        state: (runs, batch, S) before the first row.
        before: (runs, batch, rows, S), stored.
        after: (runs, batch, rows, S), stored.
        weights: (runs, w_size).
        bounds: (2, D) low and high.
        layers: (layers, 4) int32, `Shape.table`.
        tab: (20,) weights of the stages before each stage, 4 by 4, then of the result.
        steps: (blocks of a run, rows, 2) int32, steps to the last node or in all, and 1 where a
            further one reads the row.
        scratch: (programs, `Shape.scratch`).
        batch: trajectories of a run.
        rows: of each.
        c: the shape.
    """
    program = tl.program_id(0)
    blocks = tl.cdiv(batch, c.BM)
    run, block = program // blocks, program % blocks
    lane = tl.arange(0, c.BM)
    at = block * c.BM + lane
    ok = (at < batch)[:, None]
    one = (run * batch + at).to(tl.int64)
    w = weights + run.to(tl.int64) * c.w_size
    own = scratch + program.to(tl.int64) * c.BM * c.at_to_gate
    lane = lane[:, None]
    y = own + c.at_y * c.BM + lane * c.S
    node_state = own + c.at_node * c.BM + lane * c.S
    applied = own + c.at_applied * c.BM + lane * c.H
    innovation = own + c.at_innovation * c.BM + lane * c.A
    gate = own + c.at_gate * c.BM + lane * c.G
    inner = own + c.at_inner * c.BM + lane * c.H
    acts = own + c.at_acts * c.BM + lane * c.E

    for n0 in range(0, c.S, c.BE):
        n = n0 + tl.arange(0, c.BE)[None, :]
        first_state = tl.load(state + one[:, None] * c.S + n, mask=ok & (n < c.S), other=0.0)
        tl.store(y + n, first_state, mask=n < c.S)
    tl.debug_barrier()

    for i in range(rows):
        row = one * rows + i
        there = at < batch
        gap = tl.load(lanes + row * 8, mask=there, other=0.0)
        update = tl.load(lanes + row * 8 + 1, mask=there, other=0.0)
        updated = tl.load(lanes + row * 8 + 2, mask=there, other=0.0)
        first = tl.load(lanes + row * 8 + 3, mask=there, other=0.0)
        node = tl.load(lanes + row * 8 + 4, mask=there, other=0.0 if c.NODES else 1.0)
        commit = tl.load(lanes + row * 8 + 5, mask=there, other=0.0)
        row = row[:, None]
        whole = tl.load(steps + (block * rows + i) * 2)
        reads = tl.load(steps + (block * rows + i) * 2 + 1)
        for k in range(whole + reads):
            if c.NODES:
                if k == whole:
                    copy(y, node_state, c.S, c)
            span, active, fraction = step_of(gap, first, node, whole, k, c)
            if c.DECAY or c.TREND:
                drift(
                    y, y, applied, applied, start + row * c.H, end + row * c.H, w, bounds, ok,
                    updated, first, span, active, fraction, k, c,
                )  # fmt: skip
            if c.flow:
                stages(y, acts, acts, w, layers, tab, bounds, span, False, c)
                combine(y, acts, tab, bounds, span, c)
        if c.NODES:
            if reads == 0:
                copy(y, node_state, c.S, c)
        for n0 in range(0, c.S, c.BE):
            n = n0 + tl.arange(0, c.BE)[None, :]
            arrived = tl.load(y + n, mask=n < c.S, other=0.0)
            tl.store(before + row * c.S + n, arrived, mask=ok & (n < c.S))
        if c.G > 0:
            if c.A > 0 or tl.max(update, axis=0) > 0:
                if c.A > 0:
                    innovate(y, innovation, values + row * c.A, mask + row * c.A, bounds, ok, c)
                    anchor(
                        y, innovation, values + row * c.A, mask + row * c.A, level + row * c.A,
                        slope + row * c.A, w, bounds, ok, c,
                    )  # fmt: skip
                gates(y + c.X, innovation, projected + row * c.G, gate, inner, w, ok, c)
                act(y + c.X, y + c.D, gate, update, c)
                tl.debug_barrier()
        for n0 in range(0, c.S, c.BE):
            n = n0 + tl.arange(0, c.BE)[None, :]
            new = tl.load(y + n, mask=n < c.S, other=0.0)
            if c.NODES:
                kept = tl.load(node_state + n, mask=n < c.S, other=0.0)
                new = tl.where(commit[:, None] > 0, new, kept)
                tl.store(y + n, new, mask=n < c.S)
            tl.store(after + row * c.S + n, new, mask=ok & (n < c.S))
        tl.debug_barrier()
