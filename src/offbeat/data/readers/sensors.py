"""Tables whose rows are of several channels or sensors: the long form, and sensors in turns."""

from __future__ import annotations

import itertools

import numpy as np

from offbeat.data.cleaning.clocks import folded
from offbeat.data.readers.stamp_columns import Stamp
from offbeat.data.readers.stamps import form_of
from offbeat.data.readers.table_options import (
    INSTANCE_NAMES,
    KEY_NAMES,
    UNIT_NAMES,
    VALUE_NAMES,
    Sample,
    TableOptions,
    column_named,
)
from offbeat.errors import one_of

_MOST_INSTANCES = 64
_MOST_UNNAMED = 16  # sensors in a column of any name


def long_form(
    rest: list[str], options: TableOptions, sample: Sample
) -> tuple[str | None, str | None]:
    """The columns of channels and of values of a table in the long form; None if it is wide.

    Args:
        rest: the columns besides the stamp and the label.
        options: `channel_column` and `value_column` name them.
        sample: the first values.

    Raises:
        InputError: an option names an unknown column, or one is missing.
    """
    first_of: dict[str, str] = {}
    for name in rest:
        first_of.setdefault(folded(name), name)
    keys = [first_of[name] for name in KEY_NAMES if name in first_of]
    values = [first_of[name] for name in VALUE_NAMES if name in first_of]
    channel_column, value_column = options.channel_column, options.value_column
    if channel_column is None and value_column is None and {"_field", "_value"} <= set(rest):
        return "_field", "_value"  # of InfluxDB, beside columns about the query
    if channel_column is None and value_column is None:
        if not (len(rest) == 2 and len(keys) == len(values) == 1):
            return None, None
        # A column of numbers with such a name is a channel.
        is_key = sample.is_text(keys[0]) or not sample.numbers(keys[0]).size
        return (keys[0], values[0]) if is_key else (None, None)
    key = (
        column_named(channel_column, rest, "channel")
        if channel_column is not None
        else next(iter(keys), None)
    )
    left = [name for name in rest if name != key]
    value = (
        column_named(value_column, left, "value")
        if value_column is not None
        else next((name for name in values if name != key), None)
    )
    if key is None:
        key = one_of("channel_column", "", rest)
    if value is None:
        value = one_of("value_column", "", left)
    return key, value


def unit_column(rest: list[str], sample: Sample) -> str | None:
    """The column with the unit of each value in a table of the long form, or None.

    Args:
        rest: the columns besides the stamp and the label.
        sample: the first values.
    """
    named = [name for name in rest if folded(name) in UNIT_NAMES]
    return named[0] if len(named) == 1 and sample.is_text(named[0]) else None


def units_by_key(key: str, of_units: str, sample: Sample) -> tuple[dict[str, str], tuple[str, ...]]:
    """The unit of each channel in the first rows, and a note where one has several.

    Args:
        key: the column with the channel of each value.
        of_units: the column with its unit.
        sample: the first values.
    """
    met: dict[str, set[str]] = {}
    for channel, unit in zip(sample.texts(key), sample.texts(of_units), strict=False):
        if channel and unit.strip():
            met.setdefault(channel, set()).add(unit.strip())
    several = [channel for channel, units in met.items() if len(units) > 1]
    notes = tuple(
        f"{channel!r} has several units in column {of_units!r} ({', '.join(sorted(met[channel]))}) "
        "and is read without one; convert its values, and state the unit with units"
        for channel in several[:3]
    )
    return {channel: min(found) for channel, found in met.items() if len(found) == 1}, notes


def instance_column(
    stamp: Stamp, rest: list[str], options: TableOptions, sample: Sample
) -> str | None:
    """The column with the sensor of each row, where rows of several sensors take turns.

    By default a column of few texts that is named like a key, or of few integers that is named like
    an instance and tells apart the rows of one stamp.
    """
    if options.instance_column is not None:
        return column_named(options.instance_column, rest, "instance")
    if len(rest) < 2 or options.channels is not None:
        return None
    stamps = sample.texts(stamp.time) if stamp.time else []
    if stamp.rest is not None:
        stamps = list(map(str, zip(stamps, sample.texts(stamp.rest), strict=False)))
    times = sample.numbers(stamp.time) if stamp.time else np.zeros(0)
    # Of stamps in whole seconds, a column may count the rows of each second.
    whole = (np.diff(times[np.isfinite(times)]) % 1 == 0).all()
    coarse = stamp.rest is None and times.size and bool(whole)
    shared = 5 * (len(stamps) - len(set(stamps))) >= len(stamps)  # not by chance
    usual_first = sorted(
        rest, key=lambda n: (folded(n) not in KEY_NAMES, folded(n) not in INSTANCE_NAMES)
    )
    for name in usual_first:
        usual = folded(name)
        texts = sample.texts(name)
        different = set(texts)
        few = 1 < len(different) <= min(_MOST_INSTANCES, len(texts) // 2) and "" not in different
        if not few:
            continue
        if sample.is_text(name):
            if usual in KEY_NAMES and _take_turns(stamp, texts, sample):
                return name
        else:
            numbers = sample.numbers(name)
            if not len(numbers) or (numbers != np.floor(numbers)).any():
                continue
            if coarse and (usual == "index" or usual not in INSTANCE_NAMES):
                continue
        apart = len(set(zip(stamps, texts, strict=False))) == len(stamps) == len(texts)
        named = not sample.is_text(name) and usual in INSTANCE_NAMES
        turns = 4 * sum(a != b for a, b in itertools.pairwise(texts)) >= len(texts)
        likely = turns and (usual.endswith("_id") or len(different) <= _MOST_UNNAMED)
        if shared and apart and (named or likely):
            return name
    return None


def _take_turns(stamp: Stamp, keys: list[str], sample: Sample) -> bool:
    """Whether rows of several keys take turns, or share stamps, unlike those of a mode."""
    changes = [i for i in range(1, len(keys)) if keys[i] != keys[i - 1]]
    if 4 * len(changes) >= len(keys):
        return True
    times = sample.numbers(stamp.time) if stamp.time else np.zeros(0)
    return len(times) == len(keys) and any(times[i] <= times[i - 1] for i in changes)


def turns_of(names: list[str], sample: Sample) -> str | None:
    """A column of texts whose rows take turns, as those of several sensors may; or None."""
    for name in names:
        texts = sample.texts(name)
        few = 1 < len(set(texts)) <= min(_MOST_INSTANCES, len(texts) // 4) and "" not in texts
        turns = 4 * sum(a != b for a, b in itertools.pairwise(texts)) >= len(texts)
        if few and turns and form_of(texts[0]) is None:
            return name
    return None
