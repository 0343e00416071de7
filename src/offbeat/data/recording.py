"""Conversion of recordings to a data set, the same for all file formats.

A reader returns the contents of a file as logged: a `Recording` per file or episode, with a
`Signal` per sensor, topic or table. `assemble` cleans them by `ReaderOptions`, records the
changes in a log, and merges signals of different rates on the union of their time stamps.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from offbeat.data.arrays import hand_over
from offbeat.data.cleaning.anomalies import merge_rows
from offbeat.data.cleaning.channels import find_repeats, make_continuous, new_values, unwrap
from offbeat.data.cleaning.clocks import NANOSECONDS_PER
from offbeat.data.cleaning.described import Channels
from offbeat.data.cleaning.log import CleaningLog
from offbeat.data.cleaning.merging import Episode, cut
from offbeat.data.cleaning.options import ReaderOptions as ReaderOptions
from offbeat.data.outliers import search
from offbeat.data.signals import Recording as Recording
from offbeat.data.signals import Signal as Signal
from offbeat.data.trajectory import Dataset
from offbeat.data.transforms import lowest_of
from offbeat.errors import FileFormatError, listed


def assemble(recordings: Iterable[Recording], options: ReaderOptions | None = None) -> Dataset:
    """Makes a data set from recordings: merges their signals and cleans them.

    In this order: clock jumps, late rows and duplicates of each signal; the union of stamps;
    outages; actions, outliers, repeated values, angles and quaternions per episode; resampling.
    Outliers, and whether a channel repeats its values, are found over all recordings together.

    The arrays of a recording with one signal and nothing to clean become those of its trajectory,
    and read-only; otherwise there is at most one copy of the recordings besides the result.

    Args:
        recordings: at least one, with a row; all are read before anything is returned.
        options: how to clean; by default `ReaderOptions()`.

    Returns:
        A trajectory per recording, or several where it was split. `meta` holds `time_unit`, the log
        of the `cleaning`, `found` (options that were found or assumed, such as the unit of time),
        `labels` (where recordings have them) and `clock_start` (the recording's clock at time 0, in
        `time_unit`, where that is not 0); the last two have an entry per trajectory.

    Raises:
        FileFormatError: an option refuses an anomaly, or no row is left.
        InputError: an option names a channel that does not exist.
    """
    options = options or ReaderOptions()
    log = CleaningLog()
    waiting: list[Recording | None] = [_with_missing(r, options, log) for r in recordings]
    given = [recording for recording in waiting if recording is not None]
    channels = Channels.of(given, options)
    unit = _common([recording.time_unit for recording in given if recording.signals], "ns")
    found: dict[str, Any] = {}
    if any(recording.unit_found for recording in given):
        found["time_unit"] = unit
    if channels.degrees:
        found["units"] = {n: "deg" if yes else "rad" for n, yes in channels.degrees.items()}
    in_degrees = [name for name, yes in channels.degrees.items() if yes]
    if in_degrees:
        log.notes[f"angles without a unit are taken to be in deg: {listed(in_degrees)}"] = None
    labelled = any(recording.label for recording in given)
    del given
    log.quaternions = [list(channels.names_of(four)) for four in channels.quaternions]
    episodes: list[Episode] = []
    for i, recording in enumerate(waiting):
        assert recording is not None
        waiting[i] = None  # frees its arrays as soon as they are merged
        log.notes |= dict.fromkeys(recording.notes)
        episodes += cut(recording, channels, options, log)
    if not episodes:
        raise FileFormatError(
            "there is no row to read: every recording is empty, or was left out as too short "
            f"(min_rows {options.min_rows}); check the file, or give a smaller min_rows"
        )
    for episode in episodes:
        _extend_actions(episode, channels)
    _find_outliers(episodes, channels, options, log)
    _mask_repeats(episodes, channels, options, log)
    if options.unwrap:
        _unwrap(episodes, channels, log)
    if options.quaternions == "continuous":
        for episode in episodes:
            _make_continuous(episode, channels, log)
    if options.resample_hz is not None:
        for episode in episodes:
            _resample(episode, options.resample_hz)
            _extend_actions(episode, channels)
    for episode in episodes:
        hand_over(episode.values)
    trajectories = tuple(episode.trajectory(channels, options) for episode in episodes)
    meta: dict[str, Any] = {"time_unit": unit}
    if found:
        meta["found"] = found
    if labelled:
        meta["labels"] = [episode.label for episode in episodes]
    starts = [_clock(episode, unit) for episode in episodes]
    if options.start == "first_row" and any(starts):
        meta["clock_start"] = starts
    unclean = [{"episode": i, **e.anomalies} for i, e in enumerate(episodes) if e.anomalies]
    return Dataset(trajectories, {**meta, "cleaning": log.to_dict(options, unclean)})


def _with_missing(recording: Recording, options: ReaderOptions, log: CleaningLog) -> Recording:
    """The recording with NaN in place of the numbers that stand for missing values."""
    numbers = [number for number in options.missing if not np.isnan(number)]
    if not numbers:
        return recording
    signals = []
    for signal in recording.signals:
        missing = np.isin(signal.values, numbers)
        log.replaced += int(missing.sum())
        if missing.any():
            signal = replace(signal, values=np.where(missing, np.nan, signal.values))
        signals.append(signal)
    return replace(recording, signals=tuple(signals))


def _extend_actions(episode: Episode, channels: Channels) -> None:
    """Sets the action of each row to the last one up to it, or to the first one."""
    for c, role in enumerate(channels.roles):
        missing = np.isnan(episode.values[:, c])
        if role != "action" or not missing.any() or missing.all():
            continue
        latest = np.maximum.accumulate(np.where(missing, -1, np.arange(len(missing))))
        first = int(np.argmin(missing))
        column = episode.own()[:, c]
        column[:] = column[np.where(latest < 0, first, latest)]


def _find_outliers(
    episodes: list[Episode], channels: Channels, options: ReaderOptions, log: CleaningLog
) -> None:
    zeros = [e.stamps[0] if options.start == "first_row" else 0 for e in episodes]
    for c, name in enumerate(channels.names):
        if channels.roles[c] == "action":
            continue
        for found in search([episode.values[:, c] for episode in episodes]):
            times = [(e.stamps - zero) / 1e9 for e, zero in zip(episodes, zeros, strict=True)]
            outliers = found.described(name, times)
            log.outliers.append(outliers.to_dict())
            if options.outliers == "mask" and outliers.masked:
                for episode, rows in zip(episodes, found.rows, strict=True):
                    episode.own()[rows, c] = np.nan


def _mask_repeats(
    episodes: list[Episode], channels: Channels, options: ReaderOptions, log: CleaningLog
) -> None:
    for c, name in enumerate(channels.names):
        if channels.roles[c] == "action":
            continue
        found = find_repeats([episode.values[:, c] for episode in episodes])
        if found is None:
            continue
        log.repeated[name] = asdict(found)
        if options.repeated == "mask":
            for episode in episodes:
                column = episode.own()[:, c]
                repeats = ~np.isnan(column) & ~new_values(column, found.rows_per_value)
                column[repeats] = np.nan
                log.masked += int(repeats.sum())


def _unwrap(episodes: list[Episode], channels: Channels, log: CleaningLog) -> None:
    for c, period in channels.angles.items():
        name = channels.names[c]
        low = np.fmin.reduce([np.fmin.reduce(episode.values[:, c]) for episode in episodes])
        high = np.fmax.reduce([np.fmax.reduce(episode.values[:, c]) for episode in episodes])
        turns = sum(unwrap(episode.own()[:, c], period) for episode in episodes)
        if turns:
            log.turns[name] += turns
        lowest = lowest_of(float(low), float(high), period) if turns else None
        log.angles[name] = {"period": period, "lowest": lowest}


def _make_continuous(episode: Episode, channels: Channels, log: CleaningLog) -> None:
    for four in channels.quaternions:
        part = episode.own()[:, list(four)]
        changes = make_continuous(part)
        episode.values[:, list(four)] = part
        log.flipped += changes.flipped
        log.renormalised += changes.renormalised
        log.dropped += changes.dropped


def _resample(episode: Episode, rate_hz: float) -> None:
    """Resamples at a fixed rate from the first stamp, with the last values since each row."""
    since = episode.stamps - episode.stamps[0]
    rows = int(np.ceil(since[-1] * rate_hz / 1e9 - 1e-6)) + 1
    grid = np.rint(np.arange(rows) * (1e9 / rate_hz)).astype(np.int64)
    row = np.searchsorted(grid, since)  # the first row of the grid that is not before it
    row = np.minimum(row, rows - 1)
    starts = np.flatnonzero(np.diff(row, prepend=-1))
    values = np.full((rows, episode.values.shape[1]), np.nan, order="F")
    values[row[starts]] = merge_rows(episode.values, starts, "last")
    episode.stamps, episode.values, episode.owned = grid + episode.stamps[0], values, True


def _clock(episode: Episode, unit: str) -> int | float:
    """The recording's clock at the first row, in `unit`."""
    own = NANOSECONDS_PER[episode.recording.time_unit]
    factor = NANOSECONDS_PER[unit]
    nanoseconds = int(episode.stamps[0]) + episode.recording.clock_zero * own
    return nanoseconds // factor if nanoseconds % factor == 0 else nanoseconds / factor


def _common(values: list[str], otherwise: str) -> str:
    return values[0] if len(set(values)) == 1 else otherwise
