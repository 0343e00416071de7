"""`offbeat models`."""

from __future__ import annotations

from offbeat.cli.common import say


def models_command(name: str | None = None, json: bool = False) -> None:
    """List the trained models that come with Offbeat, or show the card of one.

    Args:
        name: name of a model whose card is printed, such as offbeat/hopper-30-ode_gru_d.
        json: print as JSON.
    """
    from offbeat.models.hub import CARD, trained_folder, trained_models
    from offbeat.tables import plain

    if name is not None:
        card = (trained_folder(name) / CARD).read_text(encoding="utf-8")
        say({"name": name, "card": card}, card.rstrip(), json)
        return
    found = trained_models()
    text = plain([("name", "what it is"), *found.items()], left=(0, 1))
    say(found, f"{text}\n\nload one with offbeat.load_model(NAME)", json)
