"""What the subcommands share."""

from __future__ import annotations

import json
from typing import Any


def say(result: Any, text: str, as_json: bool) -> None:
    """Prints a result, for a machine or for a person."""
    print(json.dumps(result, indent=2) if as_json else text)


def plain(config: dict[str, Any]) -> dict[str, Any]:
    """The fields of a config as JSON and YAML know them."""
    return {k: list(v) if isinstance(v, tuple) else v for k, v in config.items()}
