"""Registries: names, choices, entry points of other packages."""

import importlib.metadata

import pytest
from torch import nn

from offbeat.errors import InputError
from offbeat.models.zoo import MODELS, ModelEntry
from offbeat.registry import Registry


def test_an_entry_is_found_by_its_name_and_listed_in_order():
    shapes: Registry[int] = Registry("shape")
    assert shapes.register("square", 4) == 4
    shapes.register("arc", 1)
    assert shapes["square"] == 4
    assert list(shapes) == ["square", "arc"]
    assert len(shapes) == 2
    assert "circle" not in shapes


def test_an_unknown_name_lists_the_choices_and_the_nearest():
    shapes: Registry[int] = Registry("shape")
    shapes.register("square", 4)
    with pytest.raises(InputError, match=r"unknown shape 'sqare'.*square; did you mean 'square'"):
        shapes["sqare"]


def test_a_name_that_is_taken_is_refused_unless_it_is_to_be_replaced():
    shapes: Registry[int] = Registry("shape")
    shapes.register("square", 4)
    with pytest.raises(InputError, match="there is a shape 'square' already"):
        shapes.register("square", 5)
    shapes.register("square", 5, replace=True)
    assert shapes["square"] == 5
    shapes.unregister("square")
    assert "square" not in shapes


def test_entry_points_of_other_packages_are_loaded_when_they_are_needed(monkeypatch):
    loaded = []

    class Point:
        name, value = "hexagon", "shapes:hexagon"

        def load(self):
            loaded.append(self.name)
            return lambda: 6

    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: [Point()])
    shapes: Registry[int] = Registry("shape", group="offbeat.shapes")
    shapes.register("square", 4)
    assert shapes["square"] == 4
    assert loaded == []
    assert shapes["hexagon"] == 6
    assert list(shapes) == ["square", "hexagon"]
    assert loaded == ["hexagon"]


def test_an_entry_point_that_fails_costs_a_warning_and_nothing_else(monkeypatch):
    class Point:
        name, value = "broken", "shapes:broken"

        def load(self):
            raise ImportError("no module named shapes")

    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: [Point()])
    shapes: Registry[int] = Registry("shape", group="offbeat.shapes")
    shapes.register("square", 4)
    with pytest.warns(UserWarning, match=r"shape 'broken'.*no module named shapes"):
        assert list(shapes) == ["square"]


def test_an_entry_point_of_a_module_is_a_model_and_of_anything_else_costs_a_warning(monkeypatch):
    class Point:
        def __init__(self, name, found):
            self.name, self.value, self.found = name, f"mine:{name}", found

        def load(self):
            return self.found

    points = [Point("module", nn.Linear), Point("number", 3)]
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: points)
    models: Registry[ModelEntry] = Registry("model", group="offbeat.models", adopt=MODELS._adopt)
    with pytest.warns(UserWarning, match=r"model 'number'.*expected a subclass of torch.nn.Module"):
        assert list(models) == ["module"]
    assert models["module"].factory is nn.Linear
