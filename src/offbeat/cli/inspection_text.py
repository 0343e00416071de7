"""An inspection of a log as text: tables for a terminal."""

from __future__ import annotations

from offbeat.data.inspection import ChannelInspection, EpisodeInspection, Inspection
from offbeat.tables import plain

_MOST_EPISODES = 12
_SLOW_HZ = 0.1  # below it, a time tells more than a rate


def heading(inspection: Inspection) -> str:
    """One line on the log as a whole."""
    episodes = len(inspection.episodes)
    lasts = sum(episode.duration_s for episode in inspection.episodes)
    rate = "" if inspection.rate_hz is None else f", {_rate(inspection.rate_hz)}"
    return (
        f"{inspection.source or 'data set'} ({inspection.format}, times in "
        f"{inspection.time_unit}): {episodes} episode{'' if episodes == 1 else 's'}, "
        f"{inspection.rows} rows in {_duration(lasts)}{rate}, {len(inspection.channels)} channels, "
        f"{100 * inspection.known:.1f} % of the values known"
    )


def channel_table(inspection: Inspection) -> str:
    """A line per channel."""
    rows = []
    for c in inspection.channels:
        repeated = (
            ""
            if not c.rows_per_value
            else f"{c.rows_per_value} rows ({100 * c.repeated_fraction:.0f} %)"
        )
        rows.append(
            (
                c.name,
                c.unit,
                _number(c.rate_hz, 4),
                _number(None if c.jitter_s is None else round(1000 * c.jitter_s, 4), 3),
                f"{100 * c.missing:.1f}",
                f"{100 * c.lost:.1f}",
                _number(c.longest_gap_s, 4),
                _kind(c) or repeated,
                "never known" if not c.known else f"{_number(c.low, 4)} to {_number(c.high, 4)}",
            )
        )
    header = (
        "channel",
        "unit",
        "Hz",
        "jitter ms",
        "missing %",
        "lost %",
        "longest gap s",
        "repeated",
        "range",
    )
    return plain([header, *rows], left=(0, 1, 7, 8))


def _rate(hz: float) -> str:
    return f"{hz:.4g} Hz" if hz >= _SLOW_HZ else f"one in {_duration(1 / hz)}"


def _duration(seconds: float) -> str:
    """In seconds, and in days or hours where it is long."""
    for unit, size in (("days", 86_400), ("hours", 3_600)):
        if seconds >= 2 * size:
            return f"{seconds:.6g} s ({seconds / size:.3g} {unit})"
    return f"{seconds:.6g} s"


def _kind(channel: ChannelInspection) -> str:
    if channel.constant:
        return "constant"
    return f"copy of {channel.copy_of}" if channel.copy_of else "counter" * channel.counter


def episode_table(inspection: Inspection) -> str:
    """A line per episode; of many, those with anomalies and the first ones."""
    episodes = list(enumerate(inspection.episodes))
    shown = episodes
    if len(episodes) > _MOST_EPISODES:
        unclean = [entry for entry in episodes if not _is_clean(entry[1])]
        kept = {i for i, _ in [*unclean, *episodes][:_MOST_EPISODES]}
        shown = [entry for entry in episodes if entry[0] in kept]
    rows = [
        (
            str(i),
            e.label,
            str(e.rows),
            f"{e.duration_s:.4g}",
            f"{e.longest_step_s:.4g}",
            _before(e),
            str(e.late),
            str(e.duplicates),
        )
        for i, e in shown
    ]
    header = (
        "episode",
        "label",
        "rows",
        "lasts s",
        "longest step s",
        "before it",
        "late",
        "duplicates",
    )
    text = plain([header, *rows], left=(1, 5))
    if len(shown) == len(episodes):
        return text
    clean = sum(_is_clean(e) for _, e in episodes)
    return (
        f"{text}\n({len(episodes) - len(shown)} more; {clean} of {len(episodes)} without anomalies)"
    )


def _before(episode: EpisodeInspection) -> str:
    if episode.outage_before_s is not None:
        return f"outage of {episode.outage_before_s:.4g} s"
    return "clock set" if episode.clock_set_before else ""


def _is_clean(episode: EpisodeInspection) -> bool:
    return not (
        episode.late
        or episode.duplicates
        or episode.clock_set_before
        or episode.outage_before_s is not None
    )


def _number(value: float | None, digits: int) -> str:
    if value is None:
        return ""
    return f"{value if abs(value) >= 1e-6 else 0.0:.{digits}g}"
