"""The bodies of the scan agree, in values and in gradients, and free what they record."""

import gc
import weakref
from dataclasses import replace

import pytest
import torch
from model_helpers import SMALL, dataset, draw_weights

import offbeat as ob
from offbeat.kernels import reference, scan, written_out
from offbeat.models import recurrence
from offbeat.models.zoo import ZOO

# What the written-out body claims to run: a GRU or a start value, no field or one Euler step.
COMBINATIONS = [
    ("gru", {}),
    ("gru", {"update_rows": "every", "age_input": "delta"}),
    ("rnn_decay", {}),
    ("gru_d", {}),
    ("gru_d", {"decay_rows": "every_row", "readout": "last_row"}),
    ("neural_ode", {}),
    ("neural_ode", {"activation": "silu", "field_units": ()}),
    ("ode_rnn", {"field_units": (6, 5, 4)}),
    ("ode_gru_d", {}),
    ("ode_gru_d", {"decay_rows": "observed_rows", "readout": "last_row", "activation": "silu"}),
    ("anchored_ode_gru_d", {}),
    ("anchored_ode_gru_d", {"decay": "trainable", "activation": "tanh", "field_units": (6, 5)}),
    ("anchored_ode_gru_d", {"vector_field": "none"}),
]


def made(name: str, options: dict) -> tuple[ob.RecurrentModel, ob.Batch]:
    data = dataset(5, seed=3)
    model = draw_weights(ob.make(name, data, **{**SMALL, **options}))
    return model, model.batch(data)


def values_and_gradients(model, batch, body, monkeypatch):
    ran = []

    def spy(*args):
        ran.append(body)
        return body(*args)

    monkeypatch.setattr(recurrence, "scan", spy)
    model.zero_grad()
    output = model(batch)
    loss = (output.predictions.sin() + 0.1 * output.after.square().sum(dim=2, keepdim=True)).mean()
    loss.backward()
    assert ran == [body]
    gradients = {name: p.grad.clone() for name, p in model.named_parameters()}
    return {"predictions": output.predictions.detach(), **gradients}


@pytest.mark.parametrize(("name", "options"), COMBINATIONS)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
def test_the_written_out_body_equals_the_reference(name, options, dtype, tolerance, monkeypatch):
    model, batch = made(name, options)
    model, batch = model.to(dtype), batch.to(dtype=dtype)
    expected = values_and_gradients(model, batch, reference.scan, monkeypatch)
    got = values_and_gradients(model, batch, written_out.scan, monkeypatch)
    for key, value in expected.items():
        largest = float(value.abs().max())
        assert largest > 0, key
        assert float((got[key] - value).abs().max()) <= tolerance * largest, key


@pytest.mark.parametrize("name", sorted(ZOO))
def test_the_fastest_body_that_can_is_the_one_that_runs(name, monkeypatch):
    ran = []
    for body in (written_out, reference):
        original = body.scan
        label = body.__name__.rsplit(".", 1)[-1]
        monkeypatch.setattr(body, "scan", lambda *a, o=original, w=label: (ran.append(w), o(*a))[1])
    model, batch = made(name, {})
    model(batch)
    assert ran == ["reference" if name in ("rnn", "lstm") else "written_out"]


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("rnn", {}),
        ("lstm", {}),
        ("gru", {"reset_after": True}),
        ("gru", {"self_feeding": 0.5}),
        ("ode_rnn", {"solver": "midpoint"}),
        ("ode_rnn", {"steps_per_gap": 2}),
        ("ode_rnn", {"max_step": 0.1}),
        ("ode_rnn", {"gradient": "adjoint"}),
    ],
)
def test_what_the_written_out_body_cannot_run_goes_to_the_reference(name, options, monkeypatch):
    model, batch = made(name, options)
    monkeypatch.setattr(written_out, "scan", lambda *_: pytest.fail("the wrong body ran"))
    model(batch)


def test_observed_values_that_need_a_gradient_go_to_the_reference_and_get_one():
    model, batch = made("anchored_ode_gru_d", {})
    batch = replace(batch, values=batch.values.clone().requires_grad_())
    model(batch).predictions.sum().backward()
    gradient = batch.values.grad
    assert bool((gradient[batch.mask] != 0).any())
    assert bool((gradient[~batch.mask] == 0).all()), "hidden values reach no prediction"


@pytest.mark.parametrize("name", ["gru_d", "ode_gru_d", "anchored_ode_gru_d"])
def test_what_a_step_records_is_freed_with_it(name, monkeypatch):
    """A record that its own outputs kept alive would take the memory of every step in turn."""
    records = []

    class Record(written_out._Record):
        def __init__(self, *args):
            super().__init__(*args)
            records.append(weakref.ref(self))

    monkeypatch.setattr(written_out, "_Record", Record)
    model, batch = made(name, {})
    output = model(batch)
    output.predictions.sum().backward()
    assert records[0]() is not None
    del output
    gc.collect()
    assert records[0]() is None


def test_the_public_scan_carries_states_as_documented():
    model, batch = made("gru", {})
    seen = {}

    def spy(*args):
        seen["result"] = scan(*args)
        return seen["result"]

    recurrence_scan = recurrence.scan
    try:
        recurrence.scan = spy
        output = model(batch)
    finally:
        recurrence.scan = recurrence_scan
    before, after = seen["result"]
    assert before.shape == after.shape == (batch.rows, len(batch), model.spec.state_size)
    assert torch.equal(output.before, before.transpose(0, 1))
