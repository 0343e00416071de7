"""What is done about the faults of clocks and sensors, and the account of what it did."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from offbeat.errors import InputError, one_of


@dataclass(frozen=True)
class ReaderOptions:
    """What is done about the faults of clocks and sensors; each is an option of `read`.

    The defaults lose nothing that was measured and make nothing up. What each of them did is
    counted in `Dataset.meta["report"]`.

    Attributes:
        channels: names of the channels to keep, as a data set of all would call them, in the order
            wanted; None keeps all. Rows in which none of them was logged are not read.
        without: names of channels to leave out.
        actions: channels that are commands, beside those that the format knows as such.
        exogenous: channels that are observed and not to be predicted.
        order: rows whose stamp is lower than one before it: `sort` them in, `drop` them, or
            `refuse` the file.
        duplicates: of the known cells of a channel at one stamp the `last` or `first` one logged,
            their `mean`, or `refuse` the file.
        clock_jumps: where a clock was set back, or forth by more than a day, while it was logged:
            `split` into episodes, `join` as if the rows only lacked order, or `refuse` the file.
        max_gap_s: a longer time without any row is an outage, and splits into episodes. `auto` is
            20 times the 95th percentile of the steps between rows, and at least 1 s; None never
            splits.
        min_rows: an episode that a split leaves with fewer rows than this is left out.
        held: channels of a slower sensor that a faster log repeats: `keep` the repeated values, or
            `mask` them, so that only the first of each run of equal values counts as measured (of
            a run longer than usual, every row at which the sensor's own rate would have it).
        unwrap: whether jumps by a full turn are taken out of channels that are angles.
        angles: more channels that are angles, in radians, or in degrees where their unit is `deg`.
        quaternions: `continuous` (q and -q are one rotation: the sign that is nearer to the row
            before; length 1; one of length 0 is missing) or `keep` them as they are.
        infinite: an infinite cell counts as `missing`, or `refuse` the file.
        start: times count from the `first_row` of each episode, or are those of the recording's
            own `clock`.
        resample_hz: rows at this rate instead of at the stamps; each row holds what was measured
            last since the row before it, and NaN where nothing was. None leaves the stamps alone.

    Raises:
        InputError: a value is none of these.
    """

    channels: tuple[str, ...] | None = None
    without: tuple[str, ...] = ()
    actions: tuple[str, ...] = ()
    exogenous: tuple[str, ...] = ()
    order: Literal["sort", "drop", "refuse"] = "sort"
    duplicates: Literal["last", "first", "mean", "refuse"] = "last"
    clock_jumps: Literal["split", "join", "refuse"] = "split"
    max_gap_s: float | Literal["auto"] | None = "auto"
    min_rows: int = 2
    held: Literal["keep", "mask"] = "keep"
    unwrap: bool = True
    angles: tuple[str, ...] = ()
    quaternions: Literal["continuous", "keep"] = "continuous"
    infinite: Literal["missing", "refuse"] = "missing"
    start: Literal["first_row", "clock"] = "first_row"
    resample_hz: float | None = None

    def __post_init__(self) -> None:
        for name, choices in _CHOICES.items():
            one_of(name, getattr(self, name), choices)
        gap, rate = self.max_gap_s, self.resample_hz
        if gap not in ("auto", None) and not (_is_number(gap) and gap > 0):  # type: ignore[operator]
            raise InputError(
                f"max_gap_s must be seconds above 0, 'auto', or None to never split, got {gap!r}"
            )
        if rate is not None and not (_is_number(rate) and 0 < rate <= 1e9):
            raise InputError(
                f"resample_hz must be above 0 and at most 1e9, or None to leave the rows where "
                f"they are, got {rate!r}"
            )
        for name, names in (
            ("channels", self.channels),
            ("without", self.without),
            ("actions", self.actions),
            ("exogenous", self.exogenous),
            ("angles", self.angles),
        ):
            if names is None:
                continue
            if isinstance(names, str) or not all(isinstance(one, str) for one in names):
                raise InputError(f"{name} must be names of channels, got {names!r}")
            object.__setattr__(self, name, tuple(dict.fromkeys(names)))
        if self.channels == ():
            raise InputError("channels must name at least one channel, or be None to keep all")
        if not isinstance(self.unwrap, bool):
            raise InputError(f"unwrap must be True or False, got {self.unwrap!r}")
        if isinstance(self.min_rows, bool) or not isinstance(self.min_rows, int):
            raise InputError(f"min_rows must be an integer, got {self.min_rows!r}")
        if self.min_rows < 1:
            raise InputError(f"min_rows must be at least 1, got {self.min_rows}")


_CHOICES: Mapping[str, tuple[str, ...]] = {
    "order": ("sort", "drop", "refuse"),
    "duplicates": ("last", "first", "mean", "refuse"),
    "clock_jumps": ("split", "join", "refuse"),
    "held": ("keep", "mask"),
    "quaternions": ("continuous", "keep"),
    "infinite": ("missing", "refuse"),
    "start": ("first_row", "clock"),
}


def _is_number(value: Any) -> bool:
    return (
        isinstance(value, int | float) and not isinstance(value, bool) and bool(np.isfinite(value))
    )


@dataclass
class CleaningLog:
    """Counts what policies do while a data set is assembled; `report` gives it in JSON-like form.

    Attributes:
        late: rows out of order, by signal.
        duplicates: rows whose stamp stood there before, by signal.
        clock_jumps: times at which a clock was set.
        limits_s: what counted as an outage, one entry per recording.
        outages_s: the outages that split, in seconds.
        left_out: rows of each episode that was too short.
        empty: recordings without a row.
        infinite: infinite cells.
        held: rows per value and share of repeats of each held channel.
        masked: repeated cells that no longer count as measured.
        turns: jumps by a turn taken out of each angle.
        angles: of each channel that was unwrapped, its period and the range it was recorded in.
        quaternions: channels of each quaternion.
        flipped: rows of quaternions whose sign was turned.
        renormalised: rows of quaternions whose length was off 1 by more than 0.001.
        dropped: rows of quaternions that were none.
        notes: what readers want to be said aloud.
    """

    late: Counter[str] = field(default_factory=Counter)
    duplicates: Counter[str] = field(default_factory=Counter)
    clock_jumps: int = 0
    limits_s: list[float] = field(default_factory=list)
    outages_s: list[float] = field(default_factory=list)
    left_out: list[int] = field(default_factory=list)
    empty: int = 0
    infinite: int = 0
    held: dict[str, dict[str, float]] = field(default_factory=dict)
    masked: int = 0
    turns: Counter[str] = field(default_factory=Counter)
    angles: dict[str, dict[str, float | None]] = field(default_factory=dict)
    quaternions: list[list[str]] = field(default_factory=list)
    flipped: int = 0
    renormalised: int = 0
    dropped: int = 0
    notes: dict[str, None] = field(default_factory=dict)

    def report(self, policies: ReaderOptions, episodes: list[dict[str, float]]) -> dict[str, Any]:
        """Policy and finding of each kind of fault, JSON-like.

        Args:
            policies: that were applied.
            episodes: of the trajectories with faults, the number and what was found there.
        """
        p = policies
        limits = [min(self.limits_s), max(self.limits_s)] if self.limits_s else None
        return {
            "order": {"policy": p.order, "late": self.late.total(), "signals": dict(self.late)},
            "duplicates": {
                "policy": p.duplicates,
                "rows": self.duplicates.total(),
                "signals": dict(self.duplicates),
            },
            "clock_jumps": {"policy": p.clock_jumps, "found": self.clock_jumps},
            "outages": {
                "max_gap_s": p.max_gap_s,
                "limits_s": limits,
                "found": len(self.outages_s),
                "longest_s": max(self.outages_s, default=None),
            },
            "left_out": {
                "min_rows": p.min_rows,
                "episodes": len(self.left_out),
                "rows": sum(self.left_out),
                "without_rows": self.empty,
            },
            "infinite": {"policy": p.infinite, "cells": self.infinite},
            "held": {"policy": p.held, "channels": self.held, "masked": self.masked},
            "angles": {
                "unwrap": p.unwrap,
                "turns": dict(self.turns),
                "channels": self.angles,
            },
            "quaternions": {
                "policy": p.quaternions,
                "channels": self.quaternions,
                "flipped": self.flipped,
                "renormalised": self.renormalised,
                "dropped": self.dropped,
            },
            "resample_hz": p.resample_hz,
            "episodes": episodes,
            "notes": list(self.notes),
        }


def sentences(report: Mapping[str, Any]) -> list[str]:
    """What a report says, for people: a sentence per fault that was found, none for the others."""
    said: list[str] = list(report["notes"])
    order, duplicates, jumps = report["order"], report["duplicates"], report["clock_jumps"]
    if order["late"]:
        what = {"sort": "sorted in", "drop": "dropped"}.get(order["policy"], order["policy"])
        said.append(f"{_rows(order['late'])} came late and {_were(order['late'])} {what}")
    if duplicates["rows"]:
        how = {"mean": "the mean of the known cells"}.get(
            duplicates["policy"], f"the {duplicates['policy']} known cell"
        )
        said.append(
            f"{_rows(duplicates['rows'])} had the stamp of another row; {how} of each channel was "
            "kept"
        )
    if jumps["found"]:
        what = {"split": "each began a new episode"}.get(jumps["policy"], "they were ignored")
        said.append(f"the clock was set {jumps['found']} times; {what}")
    outages = report["outages"]
    if outages["found"]:
        count, longest = outages["found"], f"{outages['longest_s']:.3g} s"
        what = f"{count} outages, the longest of {longest}, each" if count > 1 else ""
        said.append(
            f"{what or f'1 outage of {longest}'} began a new episode "
            f"(max_gap_s {outages['max_gap_s']})"
        )
    left = report["left_out"]
    if left["episodes"]:
        said.append(
            f"{left['episodes']} episodes of fewer than {left['min_rows']} rows were left out "
            f"({_rows(left['rows'])})"
        )
    if left["without_rows"]:
        said.append(f"{left['without_rows']} recordings without a row were left out")
    if report["infinite"]["cells"]:
        said.append(f"{report['infinite']['cells']} infinite cells count as missing")
    held = report["held"]
    if held["channels"]:
        names = _listed(list(held["channels"]))
        done = (
            f"{held['masked']} repeated cells were masked"
            if held["policy"] == "mask"
            else "they were kept (held=mask masks them)"
        )
        said.append(f"held values, of a sensor slower than the log, in {names}; {done}")
    turns = report["angles"]["turns"]
    if turns:
        said.append(
            f"{sum(turns.values())} jumps by a turn were taken out of {_listed(list(turns))}"
        )
    quaternions = report["quaternions"]
    if any(quaternions[fault] for fault in ("flipped", "renormalised", "dropped")):
        said.append(
            f"quaternions {_listed(['/'.join(four) for four in quaternions['channels']])}: "
            f"{quaternions['flipped']} rows changed sign, {quaternions['renormalised']} had "
            f"another length than 1, {quaternions['dropped']} were none and are missing"
        )
    if report["resample_hz"] is not None:
        said.append(f"resampled at {report['resample_hz']:g} Hz")
    return said


def _rows(count: int) -> str:
    return "1 row" if count == 1 else f"{count} rows"


def _were(count: int) -> str:
    return "was" if count == 1 else "were"


def _listed(names: list[str], most: int = 6) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
