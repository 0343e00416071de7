"""What to pass to `train`, by what a log holds."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from offbeat.data.inspection import ChannelFacts, Inspection

_ROWS = 100  # of a window, unless a slow sensor needs more
_MOST_ROWS = 1000
_SLOW_CELLS = 5  # cells of the slowest sensor that a window holds at least
_FEWEST_WINDOWS = 20
_FEWEST_EPISODES = 10  # for a split by episode


@dataclass(frozen=True)
class Advice:
    """What to pass to `train`.

    Attributes:
        command: words of a command line, to be joined with `shlex.join`.
        reasons: a sentence for each choice in it.
    """

    command: tuple[str, ...]
    reasons: tuple[str, ...]

    def __str__(self) -> str:
        """The command line, broken at its options."""
        lines = [list(self.command[:4])]
        for word in self.command[4:]:
            lines[-1].append(word) if not word.startswith("--") else lines.append([word])
        return " \\\n    ".join(shlex.join(line) for line in lines)


def advise(
    inspection: Inspection,
    data: str,
    out: str = "runs/log",
    *,
    reader: Mapping[str, Any] | None = None,
    known: Sequence[str] = ("without", "held"),
) -> Advice:
    """Says what to pass to `train`.

    Args:
        inspection: of the log.
        data: the log, as the command line names it.
        out: folder of the run.
        reader: options that the log was read with.
        known: the options that its format has.
    """
    options: dict[str, Any] = dict(reader or {})
    reasons: list[str] = []
    useful = [channel for channel in inspection.channels if channel.cells and not channel.constant]
    # A quaternion is mended whole or not at all: its resting parts stay.
    fours = inspection.report.get("quaternions", {}).get("channels", ())
    turned = {name for four in fours for name in four}
    useless = [
        channel.name
        for channel in inspection.channels
        if channel not in useful and channel.name not in turned
    ]
    if useless and useful and "without" in known:
        options["without"] = [*options.get("without", ()), *useless]
        reasons.append(
            f"without: {_listed(useless)} never change or are never measured, so there is nothing "
            "to learn of them"
        )
    useful = useful or list(inspection.channels)
    held = [channel.name for channel in useful if channel.rows_per_value]
    if held and "held" in known and "held" not in options:
        options["held"] = "mask"
        reasons.append(
            f"held: {_listed(held)} repeat their values; masked, a repeat is not scored as if it "
            "had been measured, and is not an easy hit for the last value"
        )
    words = [f"--reader.{name}={_text(value)}" for name, value in options.items()]
    parts, for_parts = _parts(inspection, useful, options.get("held") == "mask" and bool(held))
    reasons += for_parts
    words += [f"--split.{name}={chosen}" for name, chosen in parts.items()]
    words.append("--model.name=anchored_ode_gru_d")
    return Advice(("offbeat", "train", data, out, *words), tuple(reasons))


def _parts(
    inspection: Inspection, useful: Sequence[ChannelFacts], masked: bool
) -> tuple[dict[str, Any], list[str]]:
    parts: dict[str, Any] = {}
    reasons: list[str] = []
    rows = _window(inspection, useful)
    parts["window"] = rows
    rates = [channel.rate_hz for channel in useful if channel.rate_hz]
    slowest = f" of the slowest channel, at {min(rates):.3g} Hz" if rates else ""
    cells = f", about {_cells(inspection, rows, rates):.0f} cells{slowest}" if rates else ""
    reasons.append(f"window: {rows} rows{cells}")
    episodes = len(inspection.episodes)
    if episodes >= _FEWEST_EPISODES:
        parts["cut"] = "consecutive"
        reasons.append(f"split by episode (the default), for there are {episodes}")
    else:
        parts["by"] = "time"
        reasons.append(
            f"by time: {episodes} episode{'s are' if episodes > 1 else ' is'} too few to "
            "share out whole; the last rows are the test"
        )
    parts["observed_fraction"] = 0.7
    gaps = sorted(c.longest_gap_s for c in useful if c.longest_gap_s is not None)
    gap = gaps[len(gaps) // 2] if gaps else 0.0
    usual = 1 / min(rates) if rates else 0.0
    uneven = masked or len({round(channel.missing, 4) for channel in useful}) > 1
    if uneven:
        parts["mask"] = "dropout"
        silence = max(min(gap, 20 * usual), 3 * usual)
        parts["burst_s"] = float(f"{silence:.2g}")
        reasons.append(
            f"mask: sensors speak at times of their own, so each falls silent on its own, for "
            f"{parts['burst_s']:g} s (longest gap of the median channel: {gap:.3g} s)"
        )
    elif gap > 5 * usual:
        parts["mask"] = "bursts"
        parts["burst_s"] = float(f"{min(gap, 20 * usual):.2g}")
        reasons.append(
            f"mask: all channels stop together for up to {gap:.3g} s, so bursts of "
            f"{parts['burst_s']:g} s are hidden to be filled and scored"
        )
    else:
        reasons.append("mask: 30 % of the rows at random, all channels together (the default)")
    return parts, reasons


def _window(inspection: Inspection, useful: Sequence[ChannelFacts]) -> int:
    rates = [channel.rate_hz for channel in useful if channel.rate_hz]
    rows = _ROWS
    if rates and inspection.rate_hz:
        density = inspection.rows / max(sum(e.duration_s for e in inspection.episodes), 1e-9)
        rows = max(rows, round(_SLOW_CELLS * density / min(rates)))
    return max(2, min(rows, _MOST_ROWS, inspection.rows // _FEWEST_WINDOWS))


def _cells(inspection: Inspection, rows: int, rates: Sequence[float]) -> float:
    density = inspection.rows / max(sum(e.duration_s for e in inspection.episodes), 1e-9)
    return rows / density * min(rates)


def _text(value: Any) -> str:
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_quoted(str(item)) for item in value) + "]"
    return "null" if value is None else str(value)


def _quoted(text: str) -> str:
    """As YAML reads it."""
    plain = text.replace("_", "").replace(".", "").isalnum() and text[0].isalpha()
    return text if plain else json.dumps(text)


def _listed(names: Sequence[str], most: int = 6) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
