"""The cleaning log: what was found and changed in recordings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from offbeat.data.cleaning.options import ReaderOptions
from offbeat.data.outliers import Outliers
from offbeat.errors import listed


@dataclass
class CleaningLog:
    """Counts findings and changes while a data set is assembled.

    Attributes:
        late: rows out of order, by signal.
        duplicates: rows with the time stamp of another row, by signal.
        clock_jumps: times at which a clock was set.
        limits_s: s, the shortest outage, one entry per recording.
        outages_s: s, the outages that split.
        left_out: rows of each episode that was too short.
        empty: recordings without a row.
        infinite: infinite values.
        outliers: values that are no measurements, see `offbeat.data.outliers`.
        replaced: numbers that stand for a missing value.
        repeated: of each channel with repeated values, their fraction and the rows per value.
        masked: repeated values that no longer count as measured.
        turns: jumps by a turn that were removed from each angle.
        angles: of each channel that was unwrapped, its period and the range of its recorded values.
        quaternions: channels of each quaternion.
        flipped: rows of quaternions whose sign was changed.
        renormalised: rows of quaternions whose length was off 1 by more than 0.001.
        dropped: rows that were not quaternions.
        notes: assumptions and omissions of readers.
    """

    late: Counter[str] = field(default_factory=Counter)
    duplicates: Counter[str] = field(default_factory=Counter)
    clock_jumps: int = 0
    limits_s: list[float] = field(default_factory=list)
    outages_s: list[float] = field(default_factory=list)
    left_out: list[int] = field(default_factory=list)
    empty: int = 0
    infinite: int = 0
    outliers: list[dict[str, Any]] = field(default_factory=list)
    replaced: int = 0
    repeated: dict[str, dict[str, float]] = field(default_factory=dict)
    masked: int = 0
    turns: Counter[str] = field(default_factory=Counter)
    angles: dict[str, dict[str, float | None]] = field(default_factory=dict)
    quaternions: list[list[str]] = field(default_factory=list)
    flipped: int = 0
    renormalised: int = 0
    dropped: int = 0
    notes: dict[str, None] = field(default_factory=dict)

    def to_dict(self, options: ReaderOptions, episodes: list[dict[str, float]]) -> dict[str, Any]:
        """Option and findings of each kind of anomaly, JSON-like.

        Args:
            options: that were applied.
            episodes: trajectories with anomalies, by number, and the findings.
        """
        o = options
        limits = [min(self.limits_s), max(self.limits_s)] if self.limits_s else None
        return {
            "order": {"option": o.order, "late": self.late.total(), "signals": dict(self.late)},
            "duplicates": {
                "option": o.duplicates,
                "rows": self.duplicates.total(),
                "signals": dict(self.duplicates),
            },
            "clock_jumps": {"option": o.clock_jumps, "found": self.clock_jumps},
            "outages": {
                "max_gap_s": o.max_gap_s,
                "limits_s": limits,
                "found": len(self.outages_s),
                "longest_s": max(self.outages_s, default=None),
            },
            "left_out": {
                "min_rows": o.min_rows,
                "episodes": len(self.left_out),
                "rows": sum(self.left_out),
                "without_rows": self.empty,
            },
            "infinite": {"option": o.infinite, "values": self.infinite},
            "outliers": {"option": o.outliers, "found": self.outliers},
            "missing": {"numbers": list(o.missing), "values": self.replaced},
            "repeated": {"option": o.repeated, "channels": self.repeated, "masked": self.masked},
            "angles": {
                "unwrap": o.unwrap,
                "turns": dict(self.turns),
                "channels": self.angles,
            },
            "quaternions": {
                "option": o.quaternions,
                "channels": self.quaternions,
                "flipped": self.flipped,
                "renormalised": self.renormalised,
                "dropped": self.dropped,
            },
            "resample_hz": o.resample_hz,
            "episodes": episodes,
            "notes": list(self.notes),
        }


def upgraded(report: Mapping[str, Any]) -> dict[str, Any]:
    """The cleaning log of a data set that Offbeat 0.1.0 stored, in the format of this version."""
    log = {
        key: {"option" if k == "policy" else k: v for k, v in entry.items()}
        if isinstance(entry, Mapping)
        else entry
        for key, entry in report.items()
    }
    repeated = dict(log.pop("held"))
    repeated["channels"] = {
        name: {"fraction": found["share"], "rows_per_value": found["rows_per_value"]}
        for name, found in repeated["channels"].items()
    }
    infinite = dict(log["infinite"])
    infinite["values"] = infinite.pop("cells")
    return {**log, "repeated": repeated, "infinite": infinite}


def sentences(cleaning: Mapping[str, Any]) -> list[str]:
    """A cleaning log as sentences, one per kind of anomaly found."""
    lines: list[str] = list(cleaning["notes"])
    order, duplicates, jumps = cleaning["order"], cleaning["duplicates"], cleaning["clock_jumps"]
    if order["late"]:
        what = {"sort": "sorted", "drop": "dropped"}.get(order["option"], order["option"])
        lines.append(f"{_rows(order['late'])} came late and {_were(order['late'])} {what}")
    if duplicates["rows"]:
        option = {"auto": "last"}.get(duplicates["option"], duplicates["option"])
        how = {"mean": "the mean of the known values"}.get(option, f"the {option} known value")
        lines.append(
            f"{_rows(duplicates['rows'])} had the time stamp of another row; {how} of each channel "
            "was kept"
        )
    if jumps["found"]:
        what = {"split": "each began a new episode"}.get(jumps["option"], "they were ignored")
        lines.append(f"the clock was set {jumps['found']} times; {what}")
    outages = cleaning["outages"]
    if outages["found"]:
        count, longest = outages["found"], f"{outages['longest_s']:.3g} s"
        what = f"{count} outages, the longest of {longest}, each" if count > 1 else ""
        lines.append(
            f"{what or f'1 outage of {longest}'} began a new episode "
            f"(max_gap_s {outages['max_gap_s']})"
        )
    left = cleaning["left_out"]
    if left["episodes"]:
        lines.append(
            f"{_episodes(left['episodes'])} of fewer than {left['min_rows']} rows "
            f"{_were(left['episodes'])} left out ({_rows(left['rows'])})"
        )
    if left["without_rows"]:
        what = "1 recording" if left["without_rows"] == 1 else f"{left['without_rows']} recordings"
        lines.append(f"{what} without a row {_were(left['without_rows'])} left out")
    if cleaning["infinite"]["values"]:
        lines.append(f"{cleaning['infinite']['values']} infinite values count as missing")
    outliers = cleaning.get("outliers", {"found": ()})  # data sets of 0.2.0 have none
    certain = [Outliers.from_dict(found) for found in outliers["found"]]
    certain = [found for found in certain if found.masked]
    if certain:
        values = sum(found.count for found in certain)
        done = (
            "they are missing now"
            if outliers["option"] == "mask"
            else "they were kept (outliers=mask masks them)"
        )
        names = list(dict.fromkeys(found.name for found in certain))
        lines.append(
            f"{'1 value' if values == 1 else f'{values} values'} of {listed(names)} are no "
            f"measurements; {done}"
        )
    if cleaning.get("missing", {}).get("values"):
        what = ", ".join(f"{number:g}" for number in cleaning["missing"]["numbers"])
        lines.append(f"{cleaning['missing']['values']} values of {what} count as missing")
    repeated = cleaning["repeated"]
    if repeated["channels"]:
        done = (
            f"{repeated['masked']} of them were masked"
            if repeated["option"] == "mask"
            else "they were kept (repeated=mask masks them)"
        )
        lines.append(
            f"repeated values, of a sensor slower than the log, in "
            f"{listed(list(repeated['channels']))}; {done}"
        )
    turns = cleaning["angles"]["turns"]
    if turns:
        lines.append(
            f"{sum(turns.values())} jumps by a turn were removed from {listed(list(turns))}"
        )
    quaternions = cleaning["quaternions"]
    if any(quaternions[kind] for kind in ("flipped", "renormalised", "dropped")):
        lines.append(
            f"quaternions {listed(['/'.join(four) for four in quaternions['channels']])}: "
            f"{quaternions['flipped']} rows changed sign, {quaternions['renormalised']} had "
            f"another length than 1, {quaternions['dropped']} were none and are missing"
        )
    if cleaning["resample_hz"] is not None:
        lines.append(f"resampled at {cleaning['resample_hz']:g} Hz")
    return lines


def _episodes(count: int) -> str:
    return "1 episode" if count == 1 else f"{count} episodes"


def _rows(count: int) -> str:
    return "1 row" if count == 1 else f"{count} rows"


def _were(count: int) -> str:
    return "was" if count == 1 else "were"
