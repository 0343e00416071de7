"""Converts signals to episodes: orders rows, merges signals, splits at outages."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.data.arrays import hand_over
from offbeat.data.cleaning import anomalies
from offbeat.data.cleaning.described import Channels
from offbeat.data.cleaning.log import CleaningLog
from offbeat.data.cleaning.options import ReaderOptions
from offbeat.data.signals import Recording, Signal
from offbeat.data.trajectory import Trajectory
from offbeat.errors import FileFormatError, InputError, listed

_FEW, _ONE_IN = 2, 20  # rows that may lose a value to another one of their stamp, or a fraction
_DAY = 86_400 * 10**9


@dataclass
class Episode:
    """A part of a recording, with its signals merged."""

    stamps: NDArray[np.int64]
    values: NDArray[np.float64]
    owned: bool  # whether values may be written to
    recording: Recording = field(repr=False)
    part: str = ""
    anomalies: dict[str, float] = field(default_factory=dict)  # number of each kind

    @property
    def label(self) -> str:
        """Label of the recording, with the number of the part if it was split."""
        return f"{self.recording.label}/{self.part}" if self.part else self.recording.label

    def own(self) -> NDArray[np.float64]:
        """Returns writable values; copies them first if they are shared."""
        if not self.owned:
            self.values, self.owned = self.values.copy(order="F"), True
        return self.values

    def trajectory(self, channels: Channels, options: ReaderOptions) -> Trajectory:
        """Makes a checked trajectory with times in seconds.

        Raises:
            FileFormatError: a trajectory cannot be made: two times are equal in float64.
        """
        zero = self.stamps[0] if options.start == "first_row" else 0
        part = f", part {self.part}" if self.part else ""
        origin = f"{self.recording.origin}{part}"
        try:
            return Trajectory(
                (self.stamps - zero) / 1e9,
                self.values,
                names=channels.names,
                units=channels.units,
                roles=channels.roles,
                origin=origin,
            )
        except InputError as error:
            raise FileFormatError(str(error)) from None


def cut(
    recording: Recording, channels: Channels, options: ReaderOptions, log: CleaningLog
) -> list[Episode]:
    """Splits a recording into episodes: orders its rows, merges its signals, splits at outages."""
    for signal in recording.signals:
        hand_over(signal.values)  # cleaning copies the values first
    kept = [channels.keep(signal) for signal in recording.signals if len(signal.stamps)]
    signals = [signal for signal in kept if signal is not None]
    _note_apart(signals, log)
    if not signals:
        log.empty += 1
        return []
    found: list[Episode] = []
    bare = replace(recording, signals=(), notes=())
    for piece in _pieces(signals, recording, options, log):
        ordered = [_ordered(signal, recording, options, log) for signal in piece]
        columns = [[channels.columns[s.name, c] for c in s.channels] for s in piece]
        stamps, values = anomalies.union(
            [(*o, c) for o, c in zip(ordered, columns, strict=True)], len(channels.names)
        )
        owned = values is not ordered[0][1] or values is not piece[0].values
        if any(np.isinf(column).any() for column in values.T):
            values, owned = _without_infinite(values, owned, recording, channels, options, log)
        disorders = [anomalies.disorder(signal.stamps) for signal in piece]
        limit = anomalies.longest_allowed(stamps, options.max_gap_s)
        cuts = np.zeros(0, dtype=np.int64)
        if limit is not None:
            log.limits_s.append(limit / 1e9)
            steps = np.diff(stamps)
            cuts = np.flatnonzero(steps > limit) + 1
            log.outages_s += (steps[cuts - 1] / 1e9).tolist()
        for start, end in zip([0, *cuts], [*cuts, len(stamps)], strict=True):
            episode = Episode(stamps[start:end], values[start:end], owned, bare)
            episode.anomalies = _anomalies_in(episode.stamps, disorders)
            if start:
                episode.anomalies["outage_before_s"] = (
                    float(stamps[start] - stamps[start - 1]) / 1e9
                )
            elif found:
                episode.anomalies["clock_set_before"] = 1
            found.append(episode)
    if len(found) == 1:
        return found
    long = [episode for episode in found if len(episode.stamps) >= options.min_rows]
    log.left_out += [len(e.stamps) for e in found if len(e.stamps) < options.min_rows]
    for k, episode in enumerate(long, 1):
        episode.part = str(k)
    return long


def _note_apart(signals: list[Signal], log: CleaningLog) -> None:
    """Notes signals whose clock is more than a day away from that of all others."""
    if len(signals) < 2:
        return
    spans = sorted(
        ((int(s.stamps.min()), int(s.stamps.max()), s) for s in signals), key=lambda span: span[:2]
    )
    latest = spans[0][1]
    for i, (first, last, _) in enumerate(spans[1:], 1):
        if first - latest > _DAY:
            names = [
                listed([s.name or ", ".join(s.channels[:1]) for _, _, s in part])
                for part in (spans[:i], spans[i:])
            ]
            log.notes[
                f"the clocks of {names[0]} and of {names[1]} have no time in common: they are "
                f"{(first - latest) / 1e9:.3g} s apart"
            ] = None
            return
        latest = max(latest, last)


def _anomalies_in(
    stamps: NDArray[np.int64], disorders: Iterable[anomalies.Disorder]
) -> dict[str, float]:
    """Number of rows between two stamps that are late, or repeat a stamp."""
    counts: dict[str, float] = {}
    for found in disorders:
        for name, at in (("late", found.late), ("duplicates", found.duplicates)):
            count = int(((at >= stamps[0]) & (at <= stamps[-1])).sum()) if len(at) else 0
            if count:
                counts[name] = counts.get(name, 0) + count
    return counts


def _pieces(
    signals: list[Signal], recording: Recording, options: ReaderOptions, log: CleaningLog
) -> list[list[Signal]]:
    """Splits signals where the clock was set, and groups the parts."""
    cuts = [anomalies.clock_jumps(signal.stamps) for signal in signals]
    most = max(range(len(signals)), key=lambda i: len(cuts[i]))
    log.clock_jumps += len(cuts[most])
    if not len(cuts[most]) or options.clock_jumps == "join":
        return [signals]
    if options.clock_jumps == "refuse":
        row, stamps = int(cuts[most][0]), signals[most].stamps
        raise FileFormatError(
            f"{_where(signals[most], recording)}the clock was set from {_seconds(stamps[row - 1])} "
            f"to {_seconds(stamps[row])} s at row {row}; clock_jumps=split begins a new episode"
        )
    pieces: list[list[Signal]] = [[] for _ in range(len(cuts[most]) + 1)]
    spans = [(s.min(), s.max()) for s in np.split(signals[most].stamps, cuts[most])]
    for signal, cut in zip(signals, cuts, strict=True):
        bounds = [0, *cut.tolist(), len(signal.stamps)]
        for k, (start, end) in enumerate(itertools.pairwise(bounds)):
            part = Signal(
                signal.name,
                signal.stamps[start:end],
                signal.values[start:end],
                signal.channels,
                signal.units,
                signal.kinds,
            )
            low, high = part.stamps.min(), part.stamps.max()
            # as floats: stamps may be any integers
            shared = [float(min(high, top)) - float(max(low, bottom)) for bottom, top in spans]
            at = k if len(cut) == len(cuts[most]) else int(np.argmax(shared))
            pieces[at].append(part)
    return pieces


def _ordered(
    signal: Signal, recording: Recording, options: ReaderOptions, log: CleaningLog
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    found = anomalies.disorder(signal.stamps)
    if not found.any:
        return signal.stamps, signal.values
    refused = (len(found.late) and options.order == "refuse") or (
        len(found.duplicates) and options.duplicates == "refuse"
    )
    if refused:
        stamps = signal.stamps
        if options.order != "refuse":
            stamps = np.sort(stamps)
        row = int(np.argmax(np.diff(stamps) <= 0)) + 1
        raise FileFormatError(
            f"{_where(signal, recording)}times must increase strictly, got "
            f"{_seconds(stamps[row - 1])} s at row {row - 1} and {_seconds(stamps[row])} s at row "
            f"{row}; order=sort sorts late rows in, duplicates=last merges those of one stamp"
        )
    name = signal.name or (signal.channels[0] if len(signal.channels) == 1 else "rows")
    if len(found.late):
        log.late[name] += len(found.late)
        if len(found.late) > max(_FEW, len(signal.stamps) // _ONE_IN):
            log.notes[
                f"{len(found.late)} of {len(signal.stamps)} rows are out of order, and are put in "
                "the order of their times; if they are of several logs or sensors, read those apart"
            ] = None
    stamps, values = anomalies.in_order(signal.stamps, signal.values, options.order)
    before = len(stamps)
    if options.duplicates == "auto" and len(found.duplicates) > max(_FEW, before // _ONE_IN):
        lost = anomalies.rows_that_differ(stamps, values)
        if lost > max(_FEW, before // _ONE_IN):
            raise FileFormatError(
                f"{_where(signal, recording)}{lost} of {before} rows have the time stamp of "
                "another row and other values. Name the column of the time, sensor or trajectory "
                "(time_column=, instance_column=, trajectory_column=; of a bag stamps=receive), or "
                "merge such rows with duplicates=last"
            )
    stamps, values = anomalies.one_row_per_stamp(stamps, values, options.duplicates)
    if before > len(stamps):
        log.duplicates[name] += before - len(stamps)
    return stamps, values


def _without_infinite(
    values: NDArray[np.float64],
    owned: bool,
    recording: Recording,
    channels: Channels,
    options: ReaderOptions,
    log: CleaningLog,
) -> tuple[NDArray[np.float64], bool]:
    infinite = np.isinf(values)
    if options.infinite == "refuse":
        row, channel = np.argwhere(infinite)[0]
        raise FileFormatError(
            f"{recording.origin}: values are infinite at row {row}, channel "
            f"{channels.names[channel]!r}; infinite=missing counts such values as missing"
        )
    log.infinite += int(infinite.sum())
    values = values if owned else values.copy(order="F")
    values[infinite] = np.nan
    return values, True


def _where(signal: Signal, recording: Recording) -> str:
    name = f", signal {signal.name}" if signal.name else ""
    return f"{recording.origin}{name}: " if recording.origin or name else ""


def _seconds(stamp: Any) -> str:
    """A stamp in seconds, with nanosecond precision."""
    whole, rest = divmod(abs(int(stamp)), 10**9)
    sign = "-" if stamp < 0 else ""
    return f"{sign}{whole}.{rest:09d}".rstrip("0").rstrip(".")
