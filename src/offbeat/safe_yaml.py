"""Limits on YAML from untrusted sources."""

from __future__ import annotations

from typing import Any

import yaml

MOST_CHARACTERS, MOST_VALUES, DEEPEST = 200_000, 20_000, 20
"""Limits of a text: its length, its values with expanded aliases, its nesting."""


class UnsafeYAMLError(yaml.YAMLError):
    """A text beyond the limits."""


def load(text: str) -> Any:
    """Reads plain values from a text within the limits.

    Raises:
        UnsafeYAMLError: it is beyond the limits.
        yaml.YAMLError: it is not YAML, or it names Python objects.
    """
    check(text)
    return yaml.safe_load(text)


def check(text: str) -> None:
    """Raises an error for a text that is too large, also with expanded aliases, or too deep.

    Raises:
        UnsafeYAMLError: it is.
        yaml.YAMLError: it is not YAML.
    """
    if len(text) > MOST_CHARACTERS:
        raise UnsafeYAMLError(f"it is longer than {MOST_CHARACTERS} characters")
    depth = 0
    for event in yaml.parse(text, yaml.SafeLoader):  # the only pass of PyYAML without recursion
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > DEEPEST:
            raise UnsafeYAMLError(f"it is nested more than {DEEPEST} deep")
    node = yaml.compose(text, yaml.SafeLoader)
    if node is not None:
        _count(node, {})


def check_value(value: Any) -> None:
    """Raises an error for a value with a text that `check` refuses as YAML.

    Raises:
        UnsafeYAMLError: it is.
    """
    if isinstance(value, str) and len(value) > DEEPEST:  # shorter ones can't nest deeper
        try:
            inside = load(value)
        except UnsafeYAMLError:
            raise
        except (yaml.YAMLError, ValueError):  # not YAML, but a name or a sentence
            return
        if inside != value:
            check_value(inside)
    elif isinstance(value, dict):
        for part in value.items():
            check_value(part)
    elif isinstance(value, list | tuple):
        for part in value:
            check_value(part)


def _count(node: yaml.Node, seen: dict[int, int]) -> int:
    """The number of values in a node, with expanded aliases."""
    if id(node) not in seen:
        # until it is known; remains so for an alias to a parent node
        seen[id(node)] = MOST_VALUES + 1
        inside: list[yaml.Node] = []
        if isinstance(node, yaml.SequenceNode):
            inside = node.value
        elif isinstance(node, yaml.MappingNode):
            inside = [part for pair in node.value for part in pair]
        seen[id(node)] = 1 + sum(_count(part, seen) for part in inside)
    if seen[id(node)] > MOST_VALUES:
        raise UnsafeYAMLError(f"it holds more than {MOST_VALUES} values once aliases are expanded")
    return seen[id(node)]
