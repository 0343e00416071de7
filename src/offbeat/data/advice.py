"""Advice on the options of `train`, for a data set."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from offbeat.data.cleaning.log import listed
from offbeat.data.inspection import ChannelInspection, Inspection, inspect, without_repeats
from offbeat.data.trajectory import Dataset
from offbeat.data.transforms import full_turn, is_angle_unit, lowest_of

_ROWS = 100  # of a window, unless a slow sensor needs more
_MOST_ROWS = 1000
_SLOW_VALUES = 5  # minimum number of values of the slowest sensor in a window
_FEWEST_WINDOWS = 20
_FEWEST_EPISODES = 10  # for a split by trajectory


@dataclass(frozen=True)
class Advice:
    """A recommended command line of `train`.

    Attributes:
        command: its words, to be joined with `shlex.join`.
        reasons: a sentence for each choice in it.
    """

    command: tuple[str, ...]
    reasons: tuple[str, ...]

    def __str__(self) -> str:
        """The command line, with a line break before each option."""
        lines = [list(self.command[:4])]
        for word in self.command[4:]:
            lines[-1].append(word) if not word.startswith("--") else lines.append([word])
        return " \\\n    ".join(shlex.join(line) for line in lines)


def advise(
    dataset: Dataset,
    data: str,
    out: str = "runs/log",
    *,
    reader: Mapping[str, Any] | None = None,
    known: Sequence[str] = ("without", "repeated", "angles"),
) -> Advice:
    """Chooses options of `train` for a data set.

    Args:
        dataset: as read.
        data: its file, for the command line.
        out: folder of the run.
        reader: options that it was read with.
        known: the options that its format has.
    """
    options: dict[str, Any] = dict(reader or {})
    reasons: list[str] = []
    inspection = inspect(dataset)
    useful = _useful(inspection)
    # A quaternion needs all four channels, including constant ones.
    fours = inspection.cleaning.get("quaternions", {}).get("channels", ())
    needed = {name for four in fours for name in four} | {channel.name for channel in useful}
    useless = [channel.name for channel in inspection.channels if channel.name not in needed]
    if useless and useful and "without" in known:
        options["without"] = [*options.get("without", ()), *useless]
        reasons.append(
            f"without: {listed(useless)} never change or are never measured, so nothing can be "
            "learned about them"
        )
    repeated = [channel.name for channel in useful if channel.rows_per_value]
    if repeated and "repeated" in known and "repeated" not in options:
        options["repeated"] = "mask"
        reasons.append(
            f"repeated: {listed(repeated)} repeat their values; a masked repeat is not scored as "
            "a measurement, which the last value would predict exactly"
        )
        # The following options depend on the data as they will be read.
        inspection = inspect(without_repeats(dataset))
    wrapping = _wrapping(dataset)
    if wrapping and "angles" in known:
        options["angles"] = [*options.get("angles", ()), *wrapping]
        reasons.append(
            f"angles: there are jumps by a full turn in {listed(wrapping)}; an unwrapped angle has "
            "no jumps to predict, and a stream gives it back wrapped"
        )
    words = [f"--reader.{name}={_text(value)}" for name, value in options.items()]
    split, for_split = _split(inspection)
    words += [f"--split.{name}={chosen}" for name, chosen in split.items()]
    return Advice(("offbeat", "train", data, out, *words), (*reasons, *for_split))


def _wrapping(dataset: Dataset) -> list[str]:
    """Channels in units of angle that jump by a full turn, and otherwise move by far less."""
    found = []
    for c, (name, unit) in enumerate(zip(dataset.names, dataset.units, strict=True)):
        if not is_angle_unit(unit):
            continue
        turn = full_turn(unit)
        columns = [t.values[t.known[:, c], c] for t in dataset]
        values = np.concatenate(columns)
        steps = np.concatenate([np.abs(np.diff(column)) for column in columns])
        if not len(steps) or lowest_of(values.min(), values.max(), turn) is None:
            continue
        jumps = steps > 0.75 * turn
        if jumps.any() and jumps.mean() < 0.1 and (steps[~jumps] < 0.25 * turn).all():
            found.append(name)
    return found


def _useful(inspection: Inspection) -> list[ChannelInspection]:
    return [channel for channel in inspection.channels if channel.known and not channel.constant]


def _split(inspection: Inspection) -> tuple[dict[str, Any], list[str]]:
    useful = [channel for channel in _useful(inspection) if channel.role == "state"]
    useful = useful or list(inspection.channels)
    split: dict[str, Any] = {}
    reasons: list[str] = []
    rates = [channel.rate_hz for channel in useful if channel.rate_hz]
    density = inspection.rows / max(sum(e.duration_s for e in inspection.episodes), 1e-9)
    rows = _ROWS
    if rates:
        rows = max(rows, round(_SLOW_VALUES * density / min(rates)))
    rows = max(2, min(rows, _MOST_ROWS, inspection.rows // _FEWEST_WINDOWS))
    split["window"] = rows
    reason = f"window: {rows} rows"
    if rates:
        count = rows / density * min(rates)
        reason += f", about {count:.0f} values of the slowest channel, at {min(rates):.3g} Hz"
    reasons.append(reason)
    episodes = len(inspection.episodes)
    if episodes >= _FEWEST_EPISODES:
        split["cut"] = "consecutive"
        reasons.append(f"split by trajectory (the default): there are {episodes} episodes")
    else:
        split["by"] = "time"
        reasons.append(
            f"by time: {episodes} episode{'s are' if episodes > 1 else ' is'} too few to be split "
            "by trajectory; the last rows are the test set"
        )
    split["observed_fraction"] = 0.7
    gaps = sorted(c.longest_gap_s for c in useful if c.longest_gap_s is not None)
    gap = gaps[len(gaps) // 2] if gaps else 0.0
    usual = 1 / min(rates) if rates else 0.0
    if len({round(channel.missing, 4) for channel in useful}) > 1:
        split["mask"] = "dropout"
        split["burst_s"] = float(f"{max(min(gap, 20 * usual), 3 * usual):.2g}")
        reasons.append(
            "mask: sensors report at different times, so each drops out independently, for "
            f"{split['burst_s']:g} s (longest gap of the median channel: {gap:.3g} s)"
        )
    elif gap > 5 * usual:
        split["mask"] = "bursts"
        split["burst_s"] = float(f"{min(gap, 20 * usual):.2g}")
        reasons.append(
            f"mask: all channels are missing together for up to {gap:.3g} s, so bursts of "
            f"{split['burst_s']:g} s are masked, to be imputed and scored"
        )
    else:
        reasons.append("mask: 30 % of the rows at random, all channels together (the default)")
    return split, reasons


def _text(value: Any) -> str:
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_quoted(str(item)) for item in value) + "]"
    return "null" if value is None else str(value)


def _quoted(text: str) -> str:
    """Quotes a string for YAML."""
    plain = text.replace("_", "").replace(".", "").isalnum() and text[0].isalpha()
    return text if plain else json.dumps(text)
