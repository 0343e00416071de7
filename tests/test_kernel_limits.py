"""The compiled module checks every size and value before it allocates or computes.

Each case here is a shape or a value that an array library can produce. The module must raise
`InputError` with one line, or compute; it must never read or write outside of its arrays.
`make sanitize` runs these tests with the address and undefined-behaviour sanitizers.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import offbeat as ob
from offbeat.kernels import cpu

compiled: Any = cpu.compiled
pytestmark = pytest.mark.skipif(compiled is None, reason="the compiled backend was not built")
every_set = pytest.mark.parametrize("name", cpu.instruction_sets() or ["none"])

EULER: dict[str, Any] = {"a": [[]], "b": [1.0]}
RK4: dict[str, Any] = {
    "a": [[], [0.5], [0.0, 0.5], [0.0, 0.0, 1.0]],
    "b": [1 / 6, 1 / 3, 1 / 3, 1 / 6],
}
GRU, LSTM = 4, 3
TANH, SILU = 0, 1
QUANTITIES = ("gap", "update", "updated", "values", "mask", "time_input", "decay_start",
              "decay_end", "delta", "last", "first_node", "node", "commit", "level_gain",
              "slope_gain")  # fmt: skip


def make_spec(**changes: Any) -> Any:
    """A spec of a GRU with an Euler step; `units` are the inner layers of its vector field."""
    channels, hidden = changes.get("channels", 2), changes.get("hidden", 3)
    units = changes.pop("units", (4,))
    driven = hidden + changes.get("anchored", 0) * (2 if changes.get("trend") else 1)
    options: dict[str, Any] = {
        "channels": channels, "hidden": hidden, "anchored": 0, "time_inputs": 0, "cell": GRU,
        "reset_after": False, "field": [driven, *units, driven], "activation": TANH, **EULER,
        "steps": 1, "max_step": 0.0, "decay_features": 0, "decay_rows": 0, "input_decay": False,
        "decoder": [],
    }  # fmt: skip
    return compiled.Spec(**{**options, **changes})


def arrays(spec_options: dict[str, Any], batch: int, rows: int) -> dict[str, Any]:
    """Step inputs of random values that fit a spec."""
    generator = np.random.default_rng(0)
    channels = spec_options.get("channels", 2)

    def normal(*shape: int) -> NDArray[np.float32]:
        return generator.normal(size=shape).astype(np.float32)

    found: dict[str, Any] = dict.fromkeys((*QUANTITIES, "mean", "use_prediction", "length"))
    found["gap"] = np.abs(normal(batch, rows))
    found["update"] = np.ones((batch, rows), np.float32)
    found["values"] = normal(batch, rows, channels)
    found["mask"] = np.ones((batch, rows, channels), np.float32)
    if spec_options.get("time_inputs"):
        found["time_input"] = np.abs(normal(batch, rows, spec_options["time_inputs"]))
    if spec_options.get("decay_features"):
        found["updated"] = found["update"]
        found["decay_start"] = np.abs(normal(batch, rows, spec_options["decay_features"]))
        found["decay_end"] = found["decay_start"] + 1
    if spec_options.get("input_decay"):
        found["delta"], found["last"] = np.abs(found["values"]), found["values"]
        found["mean"] = normal(channels)
    if spec_options.get("decoder"):
        found["use_prediction"] = (np.arange(rows) % 2).astype(np.uint8)
    return found


def run(
    options: dict[str, Any],
    name: str,
    *,
    batch: int = 2,
    rows: int = 3,
    changes: dict[str, Any] | None = None,
    weights: NDArray[np.float32] | None = None,
    inputs: Any = None,
    threads: int = 1,
    keep: bool = True,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """A scan and its gradients; (batch, rows, state) before each row, and (weights,) gradient."""
    spec = make_spec(**options)
    if weights is None:
        weights = np.random.default_rng(1).normal(size=spec.flat_size).astype(np.float32) / 10
    if inputs is None:
        given = {**arrays(options, batch, rows), **(changes or {})}
        inputs = compiled.StepInputs_f32(**given)
    state = np.full((batch, spec.state_size), 0.5, np.float32)
    before = np.empty((batch, rows, spec.state_size), np.float32)
    after = np.empty_like(before)
    tape = np.empty(compiled.tape_size(spec, name, inputs, state), np.float32) if keep else None
    compiled.scan_forward(spec, name, weights, inputs, state, before, after, tape, threads)
    to_weights, to_state = np.empty_like(weights), np.empty_like(state)
    compiled.scan_backward(spec, name, weights, inputs, state, after, tape, np.ones_like(before),
                           np.ones_like(before), to_weights, to_state, threads)  # fmt: skip
    return before, to_weights


# --- sizes ----------------------------------------------------------------------------------------

SPECS: dict[str, tuple[dict[str, Any], str]] = {
    "steps of 0": ({"steps": 0}, "steps_per_gap is 0, expected 1 to 1000000"),
    "steps of -1": ({"steps": -1}, "steps_per_gap is -1"),
    "steps of 2^27": ({"steps": 2**27}, "steps_per_gap is 134217728, expected 1 to 1000000"),
    "steps of 2^31 - 1": ({"steps": 2**31 - 1}, "steps_per_gap is 2147483647"),
    "steps of 2^40": ({"steps": 2**40}, "steps_per_gap is 1099511627776"),
    "negative max_step": ({"max_step": -1.0}, "max_step is -1, expected a finite number"),
    "infinite max_step": ({"max_step": math.inf}, "max_step is inf"),
    "NaN max_step": ({"max_step": math.nan}, "max_step is nan"),
    "no channels": ({"channels": 0}, "channels is 0, expected 1 to 1048576"),
    "2^40 channels": ({"channels": 2**40}, "channels is 1099511627776"),
    "no hidden units": ({"hidden": 0, "field": []}, "hidden_size is 0, expected 1 to 1048576"),
    "negative hidden units": ({"hidden": -3, "field": []}, "hidden_size is -3"),
    "2^31 hidden units": ({"hidden": 2**31, "field": []}, "hidden_size is 2147483648"),
    "anchors that are no channels": ({"anchored": 1}, "anchored channels is 1, expected 0 or 2"),
    "negative time inputs": ({"time_inputs": -1}, "time_inputs is -1"),
    "negative decay": ({"decay_features": -1}, "decay is -1"),
    "unknown cell": ({"cell": 9}, "cell is 9"),
    "unknown activation": ({"activation": 2}, "activation is 2"),
    "unknown decay rows": ({"decay_rows": 3}, "decay_rows is 3"),
    "reset_after of an LSTM": ({"cell": LSTM, "reset_after": True}, "the cell is not a GRU"),
    "17 layers": ({"units": (3,) * 16}, "number of layers is 17, expected 1 to 16"),
    "a layer of no units": ({"units": (0,)}, "size of a layer is 0"),
    "a layer of 2^33 units": ({"units": (2**33,)}, "size of a layer is 8589934592"),
    "a field of another width": ({"field": [3, 4]}, "maps 3 units to 4, expected 3 to 3"),
    "a decoder of another width": ({"decoder": [3, 5]}, "maps 3 units to 5, expected 3 to 2"),
    "a decoder of one size": ({"decoder": [3]}, "number of layers is 0"),
    "9 stages": ({"a": [[0.0] * i for i in range(9)], "b": [0.0] * 9}, "stages is 9"),
    "a tableau that is not lower": ({"a": [[1.0]], "b": [1.0]}, "row 0 of the tableau has 1"),
    "no stages": ({"a": [], "b": []}, "stages is 0"),
}


@pytest.mark.parametrize("case", list(SPECS))
def test_a_spec_that_no_scan_has_is_refused(case: str) -> None:
    options, message = SPECS[case]
    with pytest.raises(ob.InputError, match=message) as error:
        make_spec(**options)
    assert "\n" not in str(error.value)


@every_set
def test_scratch_memory_that_no_machine_has_is_refused(name: str) -> None:
    """Seven layers of 2^16 units, in 4 stages of a million steps: over 1e13 numbers for one row."""
    options = {"units": (2**14,) + (1, 2**16) * 7, "steps": 10**6, "activation": SILU, **RK4}
    spec = make_spec(**options)
    inputs = compiled.StepInputs_f32(**arrays(options, 2, 3))
    state = np.zeros((2, 3), np.float32)
    assert compiled.tape_size(spec, name, inputs, state) > 10**12
    before = np.empty((2, 3, 3), np.float32)
    weights = np.zeros(spec.flat_size, np.float32)
    with pytest.raises(ob.InputError, match="of memory; use fewer solver steps"):
        compiled.scan_forward(spec, name, weights, inputs, state, before, before.copy(), None, 1)
    with pytest.raises(ob.InputError, match="scratch memory would need"):
        compiled.scan_backward(spec, name, weights, inputs, state, before, None, before, None,
                               weights.copy(), state.copy(), 1)  # fmt: skip


@every_set
def test_a_tape_of_more_than_64_bits_has_the_largest_size(name: str) -> None:
    """2^31 - 1 rows of one place in memory, a million steps each: the product ends at 2^63 - 1."""
    rows = 2**31 - 1
    options = {"units": (2**20,) * 15, "steps": 10**6, "activation": SILU, **RK4}
    table = np.broadcast_to(np.zeros((1, 1, 6), np.float32), (1, rows, 6))
    inputs = from_table(table, [0], rows)
    state = np.zeros((1, 3), np.float32)
    assert compiled.tape_size(make_spec(**options), name, inputs, state) == 2**63 - 1


def from_table(table: NDArray[np.float32], index: list[int], rows: int, **changes: Any) -> Any:
    """Gap, update, two values and two mask entries as columns of a table."""
    places = [(0, 1), (1, 1), (0, 0), (2, 2), (4, 2), *[(0, 0)] * 8]
    options = {"places": places, "mean": None, "use_prediction": None, "length": None, **changes}
    return compiled.StepInputs_f32(
        table=table, index=np.array(index, np.int64), rows=rows, **options
    )


COLUMNS = {
    "a negative column": (1, (-1, 1), "update has 1 columns from column -1 on"),
    "a column beyond the last": (1, (6, 1), "update has 1 columns from column 6 on"),
    "a column beyond any": (1, (2**31 - 1, 1), "from column 2147483647 on"),
    "a column beyond 64 bits": (3, (2**63 - 2, 2), "from column 9223372036854775806 on"),
    "columns that end outside": (4, (5, 2), "mask has 2 columns from column 5 on"),
    "too many columns": (4, (0, 6), "mask has 6 columns from column 0 on, expected 2"),
    "a negative number of columns": (3, (4, -2), "values has -2 columns"),
    "a missing quantity": (3, (0, 0), "values is missing"),
}


@pytest.mark.parametrize("case", list(COLUMNS))
def test_columns_outside_of_a_table_are_refused(case: str) -> None:
    which, place, message = COLUMNS[case]
    places = [(0, 1), (1, 1), (0, 0), (2, 2), (4, 2), *[(0, 0)] * 8]
    places[which] = place
    inputs = from_table(np.ones((2, 3, 6), np.float32), [0, 1], 3, places=places)
    with pytest.raises(ob.InputError, match=message):
        run({}, "baseline", inputs=inputs)


TABLES: dict[str, tuple[dict[str, Any], str]] = {
    "an index beyond the table": ({"index": [0, 2]}, "index 2 is not in the table of 2"),
    "a negative index": ({"index": [-1, 0]}, "index -1 is not in the table"),
    "a huge index": ({"index": [2**62, 0]}, "is not in the table"),
    "an index of another batch": ({"index": [0, 1, 1]}, r"index has shape \(3\), expected \(2\)"),
    "more rows than there are": ({"rows": 4}, "expected at least 4 rows"),
    "2^40 rows": ({"rows": 2**40}, "number of rows is 1099511627776"),
    "no rows": ({"rows": 0}, "number of rows is 0"),
    "negative rows": ({"rows": -1}, "number of rows is -1"),
    "columns with gaps": ({"table": np.ones((2, 3, 12), np.float32)[..., ::2]}, "contiguous col"),
    "two axes": ({"table": np.ones((2, 18), np.float32)}, r"table has shape \(2, 18\)"),
    "no trajectory": ({"table": np.ones((0, 3, 6), np.float32)}, "not in the table of 0"),
    "a short list of places": ({"places": [(0, 1)]}, "number of places is 1, expected 10 to 15"),
}


@pytest.mark.parametrize("case", list(TABLES))
def test_a_table_that_does_not_have_the_rows_is_refused(case: str) -> None:
    changes, message = TABLES[case]
    options = {"table": np.ones((2, 3, 6), np.float32), "index": [0, 1], "rows": 3, **changes}
    with pytest.raises(ob.InputError, match=message):
        run({}, "baseline", inputs=from_table(**options))


INPUTS: dict[str, tuple[dict[str, Any], str]] = {
    "no gap": ({"gap": None}, "gap has shape None"),
    "no rows": ({"gap": np.ones((2, 0), np.float32)}, "number of rows is 0"),
    "another batch": ({"gap": np.ones((3, 3), np.float32)}, "gap has shape"),
    "no mask": ({"mask": None}, "mask is missing"),
    "values of another width": ({"values": np.ones((2, 3, 3), np.float32)}, "values has shape"),
    "lengths of another batch": ({"length": np.array([1])}, "length has shape"),
}


@pytest.mark.parametrize("case", list(INPUTS))
def test_step_inputs_that_do_not_fit_are_refused(case: str) -> None:
    changes, message = INPUTS[case]
    with pytest.raises(ob.InputError, match=message):
        run({}, "baseline", changes=changes)


def test_a_batch_of_no_trajectories_is_refused() -> None:
    with pytest.raises(ob.InputError, match="number of trajectories is 0, expected 1 to"):
        run({}, "baseline", batch=0)


def broadcast(*shape: int, kind: type = np.float32) -> NDArray[Any]:
    """Ones of any shape in the memory of one."""
    return np.broadcast_to(np.ones(1, kind), shape)


@pytest.mark.parametrize("rows", [2**31, 2**32, 2**32 + 3, 2**40])
def test_more_rows_than_32_bits_count_are_refused(rows: int) -> None:
    changes = {"gap": broadcast(2, rows), "update": broadcast(2, rows),
               "values": broadcast(2, rows, 2), "mask": broadcast(2, rows, 2)}  # fmt: skip
    with pytest.raises(ob.InputError, match=f"number of rows is {rows}, expected 1 to 2147483647"):
        run({}, "baseline", changes=changes)


@pytest.mark.parametrize("batch", [2**31, 2**32, 2**32 + 2])
def test_more_trajectories_than_32_bits_count_are_refused(batch: int) -> None:
    """A state of that many would need memory, so it is one row of them, which is refused, too."""
    inputs = compiled.StepInputs_f32(**{
        **dict.fromkeys((*QUANTITIES, "mean", "use_prediction", "length")),
        "gap": broadcast(batch, 3), "update": broadcast(batch, 3),
        "values": broadcast(batch, 3, 2), "mask": broadcast(batch, 3, 2),
    })  # fmt: skip
    for state in (broadcast(batch, 3), np.ones((2, 3), np.float32)):
        with pytest.raises(ob.InputError, match=r"has stride 0|has shape"):
            compiled.tape_size(make_spec(), "baseline", inputs, state)


@every_set
def test_a_tape_of_more_numbers_than_32_bits_count_is_measured_and_not_made(name: str) -> None:
    """Its size is known in 64 bits; an array of another size is refused before it is touched."""
    rows, ones = 2**18, np.ones((1, 2**18, 2), np.float32)
    spec = make_spec(units=(10_000,), steps=1000)
    inputs = compiled.StepInputs_f32(**{
        **dict.fromkeys((*QUANTITIES, "mean", "use_prediction", "length")),
        "gap": ones[:, :, 0].copy(), "update": ones[:, :, 0].copy(), "values": ones, "mask": ones,
    })  # fmt: skip
    state = np.ones((1, 3), np.float32)
    size = compiled.tape_size(spec, name, inputs, state)
    assert size > rows * 10_000 > 2**31
    with pytest.raises(ob.InputError, match="has shape"):
        compiled.scan_forward(spec, name, np.zeros(spec.flat_size, np.float32), inputs, state,
                              np.empty((1, 2, 3), np.float32), np.empty((1, 2, 3), np.float32),
                              None, 1)  # fmt: skip


@pytest.mark.parametrize("size", [0, 1, 80, 10**6])
def test_weights_of_the_wrong_size_are_refused(size: int) -> None:
    with pytest.raises(ob.InputError, match="weights has shape"):
        run({}, "baseline", weights=np.zeros(size, np.float32))


@pytest.mark.parametrize(
    ("option", "message"),
    [
        (
            {"steps_per_gap": 2**27, "nodes": "rows"},
            "steps_per_gap is 134217728, expected 1 to 1000000",
        ),
        ({"steps_per_gap": 2**31 - 1, "nodes": "rows"}, "steps_per_gap is 2147483647"),
        ({"steps_per_gap": 2**40, "nodes": "rows"}, "steps_per_gap is 1099511627776"),
        (
            {"max_step": 1e-300, "nodes": "rows"},
            "needs more than 1000000 steps of at most max_step",
        ),
    ],
)
def test_models_and_streams_refuse_more_steps_than_there_can_be(
    option: dict[str, Any], message: str
) -> None:
    times = np.arange(5) / 10
    data = ob.Dataset((ob.Trajectory(times, np.sin(times)[:, None] * [1.0, 2.0]),))
    model = ob.make_model("ode_rnn", data, **option)
    with pytest.raises(ob.InputError, match=message):
        ob.predict(model, data)

    def stream() -> None:
        live = ob.Stream(model)
        for t in times:
            live.step(float(t), np.ones(2))

    with pytest.raises(ob.InputError, match=message):
        stream()


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_model_of_weights_that_are_not_finite_ends_in_one_line(value: float) -> None:
    import torch

    times = np.arange(5) / 10
    data = ob.Dataset((ob.Trajectory(times, np.sin(times)[:, None] * [1.0, 2.0]),))
    model = ob.make_model("ode_rnn", data)
    with torch.no_grad():
        for weight in model.parameters():
            weight.fill_(value)
    with pytest.raises(ob.OffbeatError, match="finite"):
        ob.Stream(model).predict(0.0)
    with pytest.raises(ob.DivergenceError, match="the loss is nan in epoch 1, step 1"):
        ob.fit(model, data, config=ob.TrainConfig(epochs=1), progress=False)


@pytest.mark.parametrize("time", [math.inf, -math.inf, math.nan, 1e308])
def test_times_that_are_not_finite_never_reach_the_module(time: float) -> None:
    values = np.ones((3, 1))
    if not math.isfinite(time):
        with pytest.raises(ob.InputError, match="finite"):
            ob.Trajectory([0.0, 1.0, time], values)
        return
    far = ob.Dataset((ob.Trajectory([0.0, 1.0, time], values),))
    model = ob.make_model("ode_rnn", far)
    with pytest.raises(ob.InputError, match=r"decay_span is (inf|-?nan), expected a finite number"):
        ob.predict(model, far)


# --- shapes and values that compute ---------------------------------------------------------------

SHAPES: dict[str, tuple[dict[str, Any], int, int]] = {
    "1,000 channels": ({"channels": 1000, "time_inputs": 1000, "decay_features": 1000,
                        "input_decay": True, "units": (5,)}, 3, 2),
    "1,000 anchored channels": ({"channels": 1000, "anchored": 1000, "units": (9,)}, 2, 2),
    "20,000 rows": ({}, 2, 20_000),
    "more trajectories than lanes": ({"units": (2,)}, 4099, 2),
    "one hidden unit": ({"hidden": 1, "units": (1,), "channels": 1}, 67, 3),
    "16 layers": ({"units": (1, 7) * 7 + (33,), "activation": SILU}, 37, 2),
    "16 layers of a decoder": ({"decoder": [3, *(5, 1) * 7, 9, 2]}, 5, 4),
    "many steps": ({"steps": 300, **RK4}, 3, 2),
    "an LSTM of one unit that anchors": ({"cell": LSTM, "anchored": 2, "hidden": 1}, 19, 3),
}  # fmt: skip


@every_set
@pytest.mark.parametrize("keep", [True, False], ids=["with a tape", "without a tape"])
@pytest.mark.parametrize("case", list(SHAPES))
def test_unusual_shapes_give_finite_numbers(case: str, keep: bool, name: str) -> None:
    options, batch, rows = SHAPES[case]
    for threads in (1, 3):
        found = run(options, name, batch=batch, rows=rows, keep=keep, threads=threads)
        assert all(bool(np.isfinite(each).all()) for each in found)


@every_set
def test_lengths_count_as_if_they_were_cut_to_the_rows(name: str) -> None:
    lengths = np.array([5, -7, 0, 3, 2**40, -(2**62), 1], np.int64)
    within = np.clip(lengths, 0, 5)
    for keep in (True, False):
        found = [
            run({}, name, batch=7, rows=5, changes={"length": each}, keep=keep)
            for each in (lengths, within)
        ]
        for got, expected in zip(*found, strict=True):
            assert np.array_equal(got, expected)
        assert np.array_equal(found[0][0][1], np.full((5, 3), 0.5, np.float32))


@every_set
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 3e38, 1e-45])
@pytest.mark.parametrize("quantity", ["gap", "values", "update", "weights", "delta", "decay_end"])
def test_values_that_are_no_numbers_stay_in_their_trajectory(
    quantity: str, value: float, name: str
) -> None:
    options = {"input_decay": True, "decay_features": 1, "activation": SILU, "steps": 2}
    given = arrays(options, 35, 3)
    if quantity == "weights":
        size = make_spec(**options).flat_size
        run(options, name, batch=35, weights=np.full(size, value, np.float32))
        return
    wild = given[quantity].copy()
    wild[1] = value
    before, _ = run(options, name, batch=35, changes={quantity: wild})
    expected, _ = run(options, name, batch=35)
    others = np.arange(35) != 1
    assert np.array_equal(before[others], expected[others])


@every_set
@pytest.mark.parametrize(
    ("gap", "max_step"), [(1e30, 0.1), (math.inf, 0.1), (1.0, 1e-300), (1.0, 1e-44), (1e-3, 1e-10)]
)
def test_a_gap_of_too_many_steps_is_refused(gap: float, max_step: float, name: str) -> None:
    changes = {"gap": np.full((2, 3), gap, np.float32)}
    with pytest.raises(ob.InputError, match="needs more than 1000000 steps of at most max_step"):
        run({"max_step": max_step}, name, changes=changes)


NODES = {
    "NaN": (math.nan, 1.0),
    "an infinite node": (0.0, math.inf),
    "a negative first node": (-1.0, 1.0),
    "a node before the first": (2.0, 1.0),
    "a node beyond the last": (0.0, 2049.0),
}


@every_set
@pytest.mark.parametrize("case", list(NODES))
def test_nodes_that_are_not_there_are_refused(case: str, name: str) -> None:
    first, node = (np.full((2, 3), value, np.float32) for value in NODES[case])
    changes = {"first_node": first, "node": node, "commit": np.ones((2, 3), np.float32)}
    with pytest.raises(ob.InputError, match="expected 0 <= first_node <= node <= 2048"):
        run({"max_step": 0.1, "nodes": True}, name, changes=changes)


@every_set
def test_as_many_nodes_as_there_are_give_finite_numbers(name: str) -> None:
    options = {"max_step": 0.1, "nodes": True, "bounded": True, "anchored": 2, "decay_features": 1}
    node = np.full((2, 3), 2048, np.float32)
    changes = {"first_node": 0 * node, "node": node, "commit": np.ones((2, 3), np.float32),
               "low": np.full(2, -1, np.float32), "high": np.ones(2, np.float32)}  # fmt: skip
    for keep in (True, False):
        found = run(options, name, changes=changes, keep=keep)
        assert all(bool(np.isfinite(each).all()) for each in found)
    with pytest.raises(ob.InputError, match="low or high is missing"):
        run(options, name, changes={**changes, "low": None})


@every_set
def test_gaps_after_the_last_row_take_no_steps(name: str) -> None:
    gap = np.full((2, 3), 0.5, np.float32)
    gap[:, 2] = np.inf
    changes = {"gap": gap, "length": np.array([2, 1])}
    before, gradient = run({"max_step": 0.2}, name, changes=changes)
    assert bool(np.isfinite(before).all())
    assert bool(np.isfinite(gradient).all())


@every_set
def test_gaps_of_zero_and_nan_take_no_steps_of_any_length(name: str) -> None:
    gap = np.array([[0, 0, 0], [math.nan, -1, 0]], np.float32)
    before, _ = run({"max_step": 1e-300}, name, changes={"gap": gap})
    assert np.isfinite(before[0]).all()


@every_set
def test_a_table_may_be_reversed_or_have_one_row_many_times(name: str) -> None:
    table = np.abs(np.random.default_rng(0).normal(size=(4, 5, 6))).astype(np.float32)
    turned = table[::-1, ::-1]
    for each in (turned, np.broadcast_to(table[:, :1], (4, 5, 6))):
        got = run({}, name, rows=5, inputs=from_table(each, [3, 1], 5))
        expected = run({}, name, rows=5, inputs=from_table(each.copy(), [3, 1], 5))
        for a, b in zip(got, expected, strict=True):
            assert np.array_equal(a, b)


# --- perceptrons ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sizes", "activation", "message"),
    [
        ([], TANH, "number of sizes is 0, expected 2 to 17"),
        ([3], TANH, "number of sizes is 1"),
        ([3, 2**40], TANH, "size of a layer is 1099511627776"),
        ([3, -1], TANH, "size of a layer is -1"),
        ([2] * 18, TANH, "number of sizes is 18"),
        ([3, 2], 7, "activation is 7"),
    ],
)
def test_a_perceptron_that_none_is_is_refused(
    sizes: list[int], activation: int, message: str
) -> None:
    with pytest.raises(ob.InputError, match=message):
        compiled.Perceptron(sizes, activation)


@every_set
def test_a_perceptron_of_many_rows_or_none(name: str) -> None:
    shape = compiled.Perceptron([3, 2], TANH)
    for rows in (-1, 2**31, 2**62):
        with pytest.raises(ob.InputError, match=f"number of rows is {rows}"):
            compiled.perceptron_tape_f32(shape, name, rows)
    assert compiled.perceptron_tape_f32(shape, name, 0) == 0
    x, y, tape = (np.empty(s, np.float32) for s in ((0, 3), (0, 2), 0))
    weights, to_weights = np.ones(8, np.float32), np.ones(8, np.float32)
    compiled.perceptron_forward(shape, name, weights, x, y, tape, 1)
    compiled.perceptron_backward(shape, name, weights, x, tape, y, to_weights, None, 1)
    assert np.array_equal(to_weights, np.zeros(8))
    with pytest.raises(ob.InputError, match="weights has shape"):
        compiled.perceptron_forward(shape, name, np.ones(7, np.float32), x, y, tape, 1)


# --- streams --------------------------------------------------------------------------------------


def make_stream(name: str = "baseline", **changes: Any) -> Any:
    """A stream of an anchored GRU of two channels."""
    spec = make_spec(**{"anchored": 2, **changes.pop("spec", {})})
    options: dict[str, Any] = {
        "spec": spec, "instruction_set": name, "weights": np.full(spec.flat_size, 0.1, np.float32),
        "mean": np.zeros(2, np.float32), "std": np.ones(2, np.float32), "decoder": [],
        "decoder_weights": None, "first_state": np.zeros(spec.state_size, np.float32), "unit": 1.0,
        "time_input_unit": 1.0, "elapsed_limit": 1e300, "longest_delta": 1.0, "time_input": 0,
        "from_first_row": False, "last_row": False, "every_row": False, "starts_only": False,
        "exponential": False,
    }  # fmt: skip
    return compiled.StreamEngine_f32(**{**options, **changes})


STREAMS: dict[str, tuple[dict[str, Any], str]] = {
    "an unknown time input": ({"time_input": 4}, "time_input is 4"),
    "a time input that the cell has not": ({"time_input": 1}, "time_inputs is 0, expected 1 to 1"),
    "too few time inputs": (
        {"time_input": 3, "spec": {"time_inputs": 1}}, "time_inputs is 1, expected 2"),
    "a decay of too many features": (
        {"spec": {"decay_features": 9}}, "decay is 9, expected 2 to 2"),
    "an exponential decay of two features": (
        {"spec": {"decay_features": 2}, "exponential": True}, "decay is 2, expected 1"),
    "neither anchors nor decoder": ({"spec": {"anchored": 0}}, "anchored channels or a decoder"),
    "anchors and a decoder": ({"decoder": [3, 2]}, "anchored channels or a decoder"),
    "a decoder of another width": (
        {"spec": {"anchored": 0}, "decoder": [4, 2], "decoder_weights": np.ones(10, np.float32)},
        "decoder maps 4 units to 2, expected 3 to 2"),
    "a decoder without weights": ({"spec": {"anchored": 0}, "decoder": [3, 2]}, "is None"),
    "a decoder with too few weights": (
        {"spec": {"anchored": 0}, "decoder": [3, 2], "decoder_weights": np.ones(7, np.float32)},
        "decoder_weights has shape"),
    "weights of the wrong size": ({"weights": np.ones(3, np.float32)}, "weights has shape"),
    "a first state of the wrong size": (
        {"first_state": np.ones(4, np.float32)}, "first_state has shape"),
    "a trend without filters": ({"spec": {"trend": True}}, "filters or prior is None"),
    "filters of other channels": (
        {"spec": {"trend": True}, "filters": np.ones((4, 3)), "prior": np.ones((2, 3))},
        r"filters has shape \(4, 3\), expected \(4, 2\)"),
    "a clock of 0": (
        {"spec": {"trend": True}, "filters": np.zeros((4, 2)), "prior": np.ones((2, 3))},
        "filters has the entry 0"),
    "filters without end": (
        {"spec": {"trend": True}, "filters": np.full((4, 2), math.inf), "prior": np.ones((2, 3))},
        "filters has the entry inf"),
    "a prior of other channels": (
        {"spec": {"trend": True}, "filters": np.ones((4, 2)), "prior": np.ones((3, 3))},
        "prior has shape"),
    "a mean of the wrong size": ({"mean": np.ones(1, np.float32)}, "mean has shape"),
    "an unknown instruction set": ({"name": "mmx"}, "does not run the instruction set 'mmx'"),
}  # fmt: skip


@pytest.mark.parametrize("case", list(STREAMS))
def test_a_stream_that_does_not_fit_its_model_is_refused(case: str) -> None:
    changes, message = STREAMS[case]
    with pytest.raises(ob.InputError, match=message):
        make_stream(**changes)


GAINS: dict[str, tuple[dict[str, Any], str]] = {
    "two axes": ({"delta": np.ones((2, 3))}, r"delta has shape \(2, 3\)"),
    "a mask of other rows": ({"mask": np.ones((2, 4, 2), bool)}, "mask has shape"),
    "columns with gaps": (
        {"delta": np.ones((2, 3, 4))[..., ::2]}, "delta is not contiguous"),
    "started of another batch": ({"started": np.ones((3, 2), bool)}, "started has shape"),
    "a covariance of two": ({"covariance": np.ones((2, 2, 2))}, "covariance has shape"),
    "gains of other channels": ({"level": np.ones((2, 3, 1), np.float32)}, "level has shape"),
    "a negative damping": ({"filters": -np.ones((4, 2))}, "filters has the entry -1"),
}  # fmt: skip


@pytest.mark.parametrize("case", list(GAINS))
def test_gains_of_arrays_that_do_not_fit_are_refused(case: str) -> None:
    changes, message = GAINS[case]
    given: dict[str, Any] = {
        "filters": np.ones((4, 2)), "delta": np.ones((2, 3, 2)), "mask": np.ones((2, 3, 2), bool),
        "started": np.ones((2, 2), bool), "covariance": np.ones((2, 2, 3)),
        "level": np.ones((2, 3, 2), np.float32), "slope": np.ones((2, 3, 2), np.float32),
        "unit": 1.0,
    }  # fmt: skip
    with pytest.raises(ob.InputError, match=message):
        compiled.filter_gains(**{**given, **changes})


@every_set
@pytest.mark.parametrize("trend", [False, True])
def test_a_stream_takes_any_time_and_value(name: str, trend: bool) -> None:
    further: dict[str, Any] = {}
    if trend:
        further = {"filters": np.ones((4, 2)), "prior": np.ones((2, 3)), "spec": {"trend": True}}
    wild = (0.0, math.inf, -math.inf, math.nan, 3e38, -3e38, 1e-45)
    mask, out = np.ones(2, bool), np.empty((len(wild), 2))
    for first, second in itertools.product(wild, wild):
        stream = make_stream(name, every_row=True, **further)
        for time in (first, second, first):
            stream.observe(time, np.array([second, first], np.float32), mask, True)
            stream.predict(np.array(wild), out)
        assert stream.rows == 3


@every_set
def test_a_stream_of_1000_channels_and_16_layers_runs(name: str) -> None:
    channels = 1000
    decoder = [5, *(3, 40) * 7, 7, channels]
    spec = make_spec(channels=channels, hidden=5, time_inputs=channels, decay_features=channels,
                     input_decay=True, decoder=decoder, units=(1, 50) * 7 + (3,))  # fmt: skip
    shape = sum((a + 1) * b for a, b in itertools.pairwise(decoder))
    stream = compiled.StreamEngine_f32(
        spec=spec, instruction_set=name, weights=np.full(spec.flat_size, 0.01, np.float32),
        mean=np.zeros(channels, np.float32), std=np.ones(channels, np.float32), decoder=decoder,
        decoder_weights=np.full(shape, 0.01, np.float32), first_state=np.zeros(5, np.float32),
        unit=1.0, time_input_unit=1.0, elapsed_limit=10.0, longest_delta=10.0, time_input=3,
        from_first_row=False, last_row=False, every_row=False, starts_only=False,
        exponential=False,
    )  # fmt: skip
    out = np.empty((3, channels))
    for row in range(4):
        stream.observe(float(row), np.ones(channels, np.float32), np.ones(channels, bool), row > 1)
        stream.predict(np.array([row, row + 0.5, row + 100.0]), out)
        assert np.isfinite(out).all()


@every_set
@pytest.mark.parametrize("max_step", [1e-300, 1e-44, 1e-9])
def test_a_stream_refuses_a_gap_of_too_many_steps_and_goes_on(name: str, max_step: float) -> None:
    stream = make_stream(name, spec={"max_step": max_step})
    values, mask, out = np.ones(2, np.float32), np.ones(2, bool), np.empty((1, 2))
    stream.observe(0.0, values, mask, False)
    with pytest.raises(ob.InputError, match="needs more than 1000000 steps"):
        stream.observe(1.0, values, mask, False)
    with pytest.raises(ob.InputError, match="needs more than 1000000 steps"):
        stream.predict(np.array([1.0]), out)
    stream.observe(0.0, values, mask, False)
    assert stream.rows == 2


def test_states_and_slots_that_are_not_there_are_refused() -> None:
    stream = make_stream()
    flat = np.zeros(stream.size)
    for rows in (math.nan, math.inf, -1.0, 1e300):
        flat[-1] = rows
        with pytest.raises(ob.InputError, match="the state has"):
            stream.restore(flat)
    with pytest.raises(ob.InputError, match="state has shape"):
        stream.restore(np.zeros(3))
    for slots in (-1, 2**62):
        with pytest.raises(ob.InputError, match=f"slots is {slots}"):
            stream.reserve(slots)
    stream.reserve(1)
    for slot in (-1, 1, 2**31 - 1):
        with pytest.raises(IndexError):
            stream.save(slot)
        with pytest.raises(IndexError):
            stream.load(slot)
    with pytest.raises(ob.InputError, match="values has shape"):
        stream.observe(0.0, np.ones(3, np.float32), np.ones(2, bool), False)
    with pytest.raises(ob.InputError, match="out has shape"):
        stream.predict(np.zeros(2), np.empty((1, 2)))


@every_set
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"index": np.array([0, 5])}, "an entry of index is 5, expected 0 to 4"),
        ({"index": np.array([0, -1])}, "an entry of index is -1, expected 0 to 4"),
        ({"column": 3}, "the first column of the inputs is 3, expected 0 to 2"),
        ({"targets": (5, 2, 2)}, "rows of the targets is 2, expected 3 to"),
        ({"targets": (5, 3, 3)}, "targets has shape"),
        ({"first": (2, 4)}, "first has shape"),
        ({"states": (2, 1, 5)}, "the number of rows is 1, expected 2 to"),
        ({"to_states": (2, 4, 3)}, "to_states has shape"),
        ({"squares": (2, 4, 2)}, "squares has shape"),
    ],
)
def test_squares_refuse_what_does_not_fit(name: str, change: dict[str, Any], message: str) -> None:
    shape = compiled.Perceptron([3, 2], 0)
    given: dict[str, Any] = {
        "weights": (8,), "states": (2, 4, 5), "first": (2, 5), "column": 2, "targets": (5, 3, 2),
        "index": np.array([4, 0]), "norm": 1.0, "scale": 1.0, "squares": (2, 3, 2),
        "to_weights": (8,), "to_states": (2, 4, 5),
    }  # fmt: skip

    def call(**given: Any) -> None:
        made = {k: np.ones(v, np.float32) if isinstance(v, tuple) else v for k, v in given.items()}
        compiled.perceptron_squares(shape, name, **made, threads=1)

    call(**given)
    with pytest.raises(ob.InputError, match=message):
        call(**given | change)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"index": np.array([0, 5])}, "an entry of index is 5, expected 0 to 4"),
        ({"targets": (5, 2, 2)}, "rows of the targets is 2, expected 3 to"),
        ({"unit": (3,)}, "unit has shape"),
        ({"squares": (2, 3, 6)}, "number of outputs is 6, expected 0 to 5"),
        ({"to_states": (2, 4, 3)}, "to_states has shape"),
    ],
)
def test_squares_of_states_refuse_what_does_not_fit(change: dict[str, Any], message: str) -> None:
    given: dict[str, Any] = {
        "states": (2, 4, 5), "unit": (2,), "zero": (2,), "targets": (5, 3, 2),
        "index": np.array([4, 0]), "norm": 1.0, "scale": 1.0, "squares": (2, 3, 2),
        "to_states": (2, 4, 5),
    }  # fmt: skip

    def call(**given: Any) -> None:
        made = {k: np.ones(v, np.float32) if isinstance(v, tuple) else v for k, v in given.items()}
        compiled.state_squares(**made)

    call(**given)
    with pytest.raises(ob.InputError, match=message):
        call(**given | change)
