"""What `train` chooses for a data set: cleaning, sensors, horizon, windows and split."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offbeat.config import SplitConfig
from offbeat.data.cleaning.channels import find_repeats
from offbeat.data.gaps import usual_gap
from offbeat.data.inspection import without_repeats
from offbeat.data.outliers import mask_outliers
from offbeat.data.redundant import Redundant, find_redundant, leave_out
from offbeat.data.representative import differences, unlikeness
from offbeat.data.scaler import clipped
from offbeat.data.splits import apply_split
from offbeat.data.tasks import TaskConfig
from offbeat.data.trajectory import STATE, Dataset, known_values
from offbeat.data.transforms import Angle, Transforms, full_turn, is_angle_unit, lowest_of
from offbeat.errors import InputError, listed

CHOSEN = ("outliers", "repeated", "angles")
"""Options of readers that are chosen."""

_ANGLE = re.compile(
    r"(?:^|[^a-z])(?:yaw|roll|pitch|heading|bearing|course|azimuth|theta|psi|phi|angle)(?:$|[^a-z])",
    re.IGNORECASE,
)
"""Names of channels that are angles where they jump like one."""

_ACTION = re.compile(r"actions?(?:$|[._\[/])", re.IGNORECASE)

_FEWEST_ROWS = 24
_FEWEST_EPISODES = 10  # for a split by trajectory
_LONGEST_HORIZON_S = 1.0
_FEWEST_STEPS, _SHORT_STEPS = 5, 10  # typical gaps in a horizon, and in the longest of a slow log
_WINDOW_ROWS, _MOST_ROWS = 64, 600
_SLOW_VALUES = 5  # of the slowest sensor in a window
_SILENCE = 3.0  # median steps of a sensor
_MOST_BLOCKS, _BLOCK_ROWS = 5, 20
_SAME_SENSOR = 0.9  # of the rows in which one of two channels reports, those in which both do
_SAMPLE = 20_000  # rows
_MOST_TRIES, _COMPARED = 24, 20_000_000  # splits that are compared, and values in all of them

Values = NDArray[np.float64]


@dataclass(frozen=True)
class Plan:
    """What is chosen for a data set.

    Attributes:
        reader: options that the log is read with, those given included.
        redundant: channels that nothing is learned from.
        sensors: names of the states that report together.
        typical_gap_s: s, median time between two rows.
        silence_s: s, longest usual time without a value of a sensor: the 90th percentile of its
            times of more than 3 usual steps, of the sensor with the longest; 0 without any.
        longest_silence_s: s, longest time between two values of a sensor.
        horizon_s: s, longest forecast that is trained for.
        horizons_s: s, forecasts that are scored: 0.1, 0.2, 0.5 and 1 times the horizon.
        window_s: s, length of a window.
        split: windows, masks, and the split into training, validation and test part.
        notes: sentences on each choice, and on what to beware of.
    """

    reader: Mapping[str, Any]
    redundant: Redundant
    sensors: tuple[tuple[str, ...], ...]
    typical_gap_s: float
    silence_s: float
    longest_silence_s: float
    horizon_s: float
    horizons_s: tuple[float, ...]
    window_s: float
    split: SplitConfig
    notes: tuple[str, ...]

    @property
    def tasks(self) -> TaskConfig:
        """How tasks are drawn that are like what will be asked."""
        return TaskConfig(self.horizon_s, self.typical_gap_s, self.window_s, self.sensors)

    @property
    def whole(self) -> SplitConfig:
        """The split without windows and masks, for tasks to be drawn from its parts."""
        return without_windows(self.split)

    def to_dict(self) -> dict[str, Any]:
        """JSON-like form."""
        return asdict(self)


def plan(
    dataset: Dataset,
    *,
    reader: Mapping[str, Any] | None = None,
    known: Sequence[str] = CHOSEN,
    horizon_s: float | None = None,
    split: SplitConfig | None = None,
    seed: int = 0,
) -> Plan:
    """Chooses what `train` does with a data set.

    Args:
        dataset: as read.
        reader: options that it was read with; they are kept.
        known: the options that its format has. A finished data set of ours has none: its values
            and masks are taken as they are.
        horizon_s: s, longest forecast to train for; by default found from the log.
        split: to be used as it is; by default chosen.
        seed: of the split that is chosen; of a split in blocks, others are tried from there, and
            the one whose parts are most alike is taken.

    Returns:
        The choices. `prepare` applies those of the cleaning.

    Raises:
        InputError: nothing can be learned from the data set (it has too few rows, or nothing in it
            changes), or the horizon is not above 0.
    """
    dataset = Dataset.of(dataset)
    if horizon_s is not None and not 0 < horizon_s < np.inf:
        raise InputError(f"horizon_s must be a positive number of seconds, got {horizon_s!r}")
    rows = sum(t.rows for t in dataset)
    if rows < _FEWEST_ROWS and split is None:
        raise InputError(
            f"{rows} rows are too few to train, validate and test on; give a log of at least "
            f"{_FEWEST_ROWS}, or several"
        )
    options, notes = _reader(dataset, dict(reader or {}), known)
    clean = cleaned(dataset, options)
    redundant = find_redundant(clean)
    clean = leave_out(clean, redundant)
    times = _Times.of(clean)
    horizon, why = _horizon(clean, times, horizon_s)
    window, found, for_split = _split(clean, times, horizon, seed)
    if split is None:
        split = found = _most_alike(clean, found)
    else:
        for_split = []
    never = _never_trained(clean, split)
    if never:
        redundant = replace(redundant, empty=(*redundant.empty, *never))
        clean = leave_out(clean, Redundant(empty=never))
        notes.append(
            f"without a value in the training part, so not learned: {listed(list(never))}; record "
            "more, or try another --split.seed"
        )
    sensors = find_sensors(clean)
    if len(sensors) > 1 and len({name for group in sensors for name in group}) > len(sensors):
        notes.append(
            f"{len(sensors)} sensors, each a group of channels that report together: "
            + "; ".join(listed(list(group), 3) for group in sensors[:4])
            + ("; ..." if len(sensors) > 4 else "")
        )
    ladder = [float(f"{f * horizon:.3g}") for f in (0.1, 0.2, 0.5, 1.0)]
    parts = apply_split(clean, without_windows(split))
    if split is found and split.mask == "dropout":
        split = replace(split, sensors=sensors)
    return Plan(
        reader=options,
        redundant=redundant,
        sensors=sensors,
        typical_gap_s=times.gap,
        silence_s=times.silence,
        longest_silence_s=times.longest,
        horizon_s=horizon,
        horizons_s=tuple(h for h in ladder if h >= 0.999 * min(times.gap, horizon)),
        window_s=window,
        split=split,
        notes=(*notes, *redundant.notes(), why, *for_split, *differences(*parts)),
    )


def prepare(dataset: Dataset, chosen: Plan) -> Dataset:
    """The data set as a model is trained on it: cleaned, without channels that teach nothing.

    Args:
        dataset: as read, with or without the options of the plan.
        chosen: from `plan`.
    """
    return leave_out(cleaned(Dataset.of(dataset), chosen.reader), chosen.redundant)


def cleaned(dataset: Dataset, options: Mapping[str, Any]) -> Dataset:
    """Applies reader options to a data set in memory, as if it had been read with them.

    Args:
        dataset: as read.
        options: of which `outliers`, `repeated` and `angles` are applied.
    """
    if options.get("outliers") == "mask":
        dataset = mask_outliers(dataset)
    if options.get("repeated") == "mask":
        dataset = without_repeats(dataset)
    angles = {}
    for name in options.get("angles", ()):
        if name in dataset.names:
            c = dataset.names.index(name)
            values = np.concatenate([known_values(t, c) for t in dataset])
            period = _turn_of(dataset.units[c], values)
            angles[name] = Angle(period, lowest_of(values.min(), values.max(), period))
    return Transforms(angles).apply(dataset) if angles else dataset


def find_sensors(dataset: Dataset) -> tuple[tuple[str, ...], ...]:
    """Groups of states that are observed together, in the order of the channels.

    Two channels are of one sensor if, of the rows in which one of them is observed, both are in
    90 %: a masked outlier separates none. Where all states are one group, each is a sensor.

    Args:
        dataset: recordings in which sensors report at different times.
    """
    groups = _together(dataset)
    if len(groups) == 1:
        groups = [[c] for c in groups[0]]
    return tuple(tuple(dataset.names[c] for c in group) for group in groups)


def _together(dataset: Dataset) -> list[list[int]]:
    """Groups of states that are observed together."""
    states = [c for c, role in enumerate(dataset.roles) if role == STATE]
    observed = np.concatenate([t.observed[:, states] for t in dataset])
    if len(observed) > _SAMPLE:  # blocks of rows: sensors of different rates alternate
        starts = np.linspace(0, len(observed) - 200, _SAMPLE // 200).astype(np.int64)
        observed = observed[(starts[:, None] + np.arange(200)).ravel()]
    groups: list[list[int]] = []
    for k in range(len(states)):
        for group in groups:
            one, other = observed[:, group[0]], observed[:, k]
            either = np.count_nonzero(one | other)
            if np.count_nonzero(one & other) >= _SAME_SENSOR * either:
                group.append(k)
                break
        else:
            groups.append([k])
    return [[states[k] for k in group] for group in groups]


def _turn_of(unit: str, values: Values) -> float:
    """A full turn; without a unit, of radians where values are within one turn of 0."""
    within = np.abs(values).max(initial=0.0) <= 1.001 * full_turn("rad")
    return full_turn(unit or ("rad" if within else "deg"))


def find_wrapping(dataset: Dataset) -> list[str]:
    """Channels that jump by a full turn, and otherwise move by far less.

    They are in units of angle, or state no unit and have the name of an angle, such as `yaw`.

    Args:
        dataset: as read.
    """
    found = []
    for c, (name, unit) in enumerate(zip(dataset.names, dataset.units, strict=True)):
        if not is_angle_unit(unit) and (unit or not _ANGLE.search(name)):
            continue
        columns = [known_values(t, c) for t in dataset]
        values = np.concatenate(columns)
        turn = _turn_of(unit, values)
        steps = np.concatenate([np.abs(np.diff(column)) for column in columns])
        if not len(steps) or lowest_of(values.min(), values.max(), turn) is None:
            continue
        jumps = steps > 0.75 * turn
        if jumps.any() and jumps.mean() < 0.1 and (steps[~jumps] < 0.25 * turn).all():
            found.append(name)
    return found


def _reader(
    dataset: Dataset, options: dict[str, Any], known: Sequence[str]
) -> tuple[dict[str, Any], list[str]]:
    notes: list[str] = []
    if "outliers" in known:
        options.setdefault("outliers", "mask")
        dataset = cleaned(dataset, {"outliers": options["outliers"]})
    if "repeated" in known and "repeated" not in options:
        repeated = [
            name
            for c, (name, role) in enumerate(zip(dataset.names, dataset.roles, strict=True))
            if role == STATE and _repeats([t.values[:, c] for t in dataset])
        ]
        if repeated:
            options["repeated"] = "mask"
            notes.append(
                f"repeated values of a slower sensor: {listed(repeated)}; they are masked, because "
                "they are no measurements (--reader.repeated keep keeps them)"
            )
    wrapping = find_wrapping(dataset)
    if wrapping and "angles" in known:
        options["angles"] = [*options.get("angles", ()), *wrapping]
        notes.append(
            f"angles that jump by a full turn: {listed(wrapping)}; they are unwrapped, and given "
            "back wrapped (--reader.angles=[] leaves them as they are)"
        )
    named = [
        name
        for name, role in zip(dataset.names, dataset.roles, strict=True)
        if role == STATE and _ACTION.match(name)
    ]
    if named and "actions" not in options and len(named) < dataset.channels:
        notes.append(
            f"named like actions, and learned as states: {listed(named)}; "
            f"--reader.actions=[{','.join(named[:2])}{',...' if len(named) > 2 else ''}] makes "
            "them actions, which a LeRobot data set has by themselves"
        )
    return options, notes


def _repeats(columns: list[Values]) -> bool:
    values = np.concatenate([column[~np.isnan(column)] for column in columns])
    if not len(values) or values.min() == values.max():
        return False
    return find_repeats(columns) is not None


@dataclass(frozen=True)
class _Times:
    """Times of a data set, in s; see `Plan`.

    Attributes:
        total: all episodes together.
        episode: the median one.
        rows: of all episodes together.
        gap: between two rows, see `usual_gap`.
        slowest: the largest median time between two values of a channel.
        silence: the longest usual time without a value.
        longest: the longest time without a value.
    """

    total: float
    episode: float
    rows: int
    gap: float
    slowest: float
    silence: float
    longest: float

    @classmethod
    def of(cls, dataset: Dataset) -> _Times:
        states = [c for c, role in enumerate(dataset.roles) if role == STATE]
        seen = [t.times[t.observed[:, states].any(axis=1)] for t in dataset]
        steps = np.concatenate([np.diff(times) for times in seen])
        if not len(steps):
            raise InputError(
                "no episode has two rows with a value, so there is no motion to learn; give a "
                "longer log"
            )
        slowest = silence = longest = 0.0
        fastest = np.inf
        done: set[bytes] = set()
        for c in states:
            masks = [t.observed[:, c] for t in dataset]
            key = b"".join(np.packbits(mask).tobytes() for mask in masks)
            if key in done:
                continue
            done.add(key)
            own = np.concatenate(
                [np.diff(t.times[mask]) for t, mask in zip(dataset, masks, strict=True)]
            )
            if len(own):
                usual = float(np.median(own))
                slowest, longest = max(slowest, usual), max(longest, float(own.max()))
                fastest = min(fastest, usual)
                long = own[own > _SILENCE * usual]
                if len(long):
                    silence = max(silence, float(np.quantile(long, 0.9)))
        lasts = [float(t.times[-1] - t.times[0]) for t in dataset]
        rows = sum(t.rows for t in dataset)
        return cls(
            sum(lasts),
            float(np.median(lasts)),
            rows,
            usual_gap(float(np.median(steps)), fastest if np.isfinite(fastest) else 0.0),
            slowest,
            silence,
            longest,
        )


def _horizon(dataset: Dataset, times: _Times, asked: float | None) -> tuple[float, str]:
    several = len(dataset) >= _FEWEST_EPISODES
    longest = (times.episode if several else 0.15 * times.total) / 4.4
    if asked is not None:
        said = f"forecasts up to {asked:g} s, as asked for"
        if asked > longest:
            said += f"; the log is too short to judge them at more than {longest:.2g} s"
        return asked, said
    most = max(_LONGEST_HORIZON_S, _SHORT_STEPS * times.gap)
    motion = _motion_s(dataset, most)
    found = max(motion, times.silence, 2 * times.slowest, _FEWEST_STEPS * times.gap)
    horizon = max(min(found, most, longest), times.gap)
    because = {
        motion: "the motion is correlated for about that long",
        times.silence: "sensors are silent for that long",
        2 * times.slowest: "two values of the slowest sensor",
    }.get(found, f"{_FEWEST_STEPS} rows")
    if horizon < found:
        because = "the log is short" if horizon < most else "the longest that is chosen by itself"
    horizon = float(f"{horizon:.2g}")
    return horizon, f"forecasts up to {horizon:g} s ({because}); --horizon_s asks for another time"


def _motion_s(dataset: Dataset, most: float) -> float:
    """Twice the time after which the correlation of a state with itself is 0.5, the median one.

    That is where the mean squared change reaches the variance. Above `most`, it is not exact.
    """
    found = []
    for c, role in enumerate(dataset.roles):
        if role != STATE:
            continue
        columns = [t.values[t.observed[:, c], c] for t in dataset]
        steps = np.concatenate([np.diff(t.times[t.observed[:, c]]) for t in dataset])
        values = np.concatenate(columns)
        if len(values) < 3 or not len(steps):
            continue
        inner = clipped(values)
        variance, low, high = float(inner.var()), float(inner.min()), float(inner.max())
        columns = [np.clip(column, low, high) for column in columns]
        longest, lag, step = max(len(column) for column in columns), 1, float(np.median(steps))
        while lag < longest / 3 and 2 * lag * step <= most:
            changes = [column[lag:] - column[:-lag] for column in columns if len(column) > lag]
            if np.square(np.concatenate(changes)).mean() >= variance:
                break
            lag = max(lag + 1, int(1.3 * lag))
        found.append(2 * lag * step)
    return float(np.median(found)) if found else 0.0


def _split(
    dataset: Dataset, times: _Times, horizon: float, seed: int
) -> tuple[float, SplitConfig, list[str]]:
    notes: list[str] = []
    needed = 3 * max(times.longest, horizon)
    wanted = max(needed, 4 * horizon, _WINDOW_ROWS * times.gap, _SLOW_VALUES * times.slowest)
    most = _MOST_ROWS * times.total / times.rows
    longest_episode = max(t.rows for t in dataset)
    options: dict[str, Any] = {"seed": seed, **_mask(dataset, times, horizon)}
    if len(dataset) >= _FEWEST_EPISODES and 2 * longest_episode <= times.rows:
        window = min(wanted, most, max(float(t.times[-1] - t.times[0]) for t in dataset))
        options["cut"] = "consecutive"
        notes.append(f"whole episodes validate and test, as there are {len(dataset)} of them")
    else:
        # Several places, if the windows of training may be as long as they should or not.
        places = min(int(0.15 * times.total / (2 * horizon)), int(0.15 * times.rows) // _BLOCK_ROWS)
        blocks = min(places, max(int(0.35 * times.total / wanted), 2), _MOST_BLOCKS)
        blocks = max(blocks, 1)
        window = min(wanted, most, 0.35 * times.total / blocks)
        gap = float(f"{min(horizon, 0.015 * times.total / blocks):.2g}")
        options |= {"by": "blocks", "blocks": blocks, "gap_s": gap}
        notes.append(
            f"{blocks} blocks validate and {blocks} test, spread over the log"
            if blocks > 1
            else "a block validates and another one tests: the log is short"
        )
    window = float(f"{max(window, 2 * times.gap):.3g}")
    said = f"windows of {window:g} s"
    if window < 0.99 * needed:
        which = "silence" if times.longest > horizon else "forecast"
        why = "has too many rows for more" if window > 0.98 * most else "is too short for more"
        said += (
            f", less than three times the longest {which} ({max(times.longest, horizon):.3g} s), "
            f"because the log {why}; expect little after a {which} that long"
        )
    return window, SplitConfig(window_s=window, **options), [said, *notes]


def _mask(dataset: Dataset, times: _Times, horizon: float) -> dict[str, Any]:
    """Masks like the silences of the log."""
    length = float(f"{max(min(times.silence, horizon), 3 * times.slowest):.2g}")
    if len(_together(dataset)) > 1:
        return {"observed_fraction": 0.7, "mask": "dropout", "burst_s": length}
    if times.silence:
        return {"observed_fraction": 0.7, "mask": "bursts", "burst_s": length}
    return {"observed_fraction": 0.7}


def _most_alike(dataset: Dataset, split: SplitConfig) -> SplitConfig:
    """The split in blocks, of several with other seeds, whose parts differ least.

    What a log has once, such as a single manoeuvre in a long rest, belongs into the training part
    and, where it can be, into the others.
    """
    if split.by != "blocks":
        return split
    values = sum(t.rows for t in dataset) * dataset.channels
    tries = min(max(_COMPARED // values, 4), _MOST_TRIES)
    best, least = split, None
    for k in range(tries):
        tried = replace(split, seed=(split.seed + 1000 * k) % 2**32)
        try:
            unlike = unlikeness(*apply_split(dataset, without_windows(tried)))
        except InputError:  # a part is empty
            continue
        if least is None or unlike < least:
            best, least = tried, unlike
        if not unlike:
            break
    return best


def without_windows(split: SplitConfig) -> SplitConfig:
    """The split without windows and masks."""
    return replace(
        split,
        window=None,
        window_s=None,
        window_count=None,
        cut=None,
        observed_fraction=None,
        mask="rows",
        burst_rows=None,
        burst_s=None,
        sensors=None,
    )


def _never_trained(dataset: Dataset, split: SplitConfig) -> tuple[str, ...]:
    """States that have a value, but none in the training part."""
    train, _, _ = apply_split(dataset, without_windows(split))
    seen = np.any([t.observed.any(axis=0) for t in train], axis=0)
    return tuple(
        name
        for name, role, any_seen in zip(dataset.names, dataset.roles, seen, strict=True)
        if role == STATE and not any_seen
    )
