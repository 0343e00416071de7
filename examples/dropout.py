"""Draws how a dropout of a sensor is filled while it lasts, and afterwards, as a GIF.

    python examples/dropout.py LOG dropout.gif --show knee,hip --drop knee,hip

trains on the log as `offbeat train LOG OUT` does. Of the part that nothing was fitted to, the
picture shows the stretch in which the shown channels move most, with those hidden whose names
contain a word of `--drop`. While they are out, answers use what was observed before each row alone;
when they are back, fills from both sides are drawn. Bands are intervals of 90 %.
"""

from __future__ import annotations

import argparse
import io
import json
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

import offbeat as ob

INK, LIVE, AFTER, PALE = "#111111", "#0072B2", "#D55E00", "#9A9A9A"


def liveliest(test: ob.Dataset, shown: list[str], seconds: float) -> ob.Trajectory:
    """The window of a test part in which the shown channels travel farthest."""
    at = [test.names.index(name) for name in shown]
    cuts = ob.windows(test, seconds=seconds, cut="consecutive")
    scale = np.nanstd(np.concatenate([t.values[:, at] for t in cuts]), axis=0)

    def travelled(t: ob.Trajectory) -> float:
        middle = slice(t.rows // 3, 2 * t.rows // 3)
        return float(np.nansum(np.abs(np.diff(t.values[middle][:, at], axis=0)) / scale))

    longest = max(t.times[-1] - t.times[0] for t in cuts)
    whole = [t for t in cuts if t.times[-1] - t.times[0] > 0.9 * longest]
    return max(whole, key=travelled)


def hidden(whole: ob.Trajectory, dropped: list[int], start: float, stop: float) -> ob.Trajectory:
    """A trajectory in which channels are not observed from one time to another."""
    observed = whole.observed.copy()
    rows = np.flatnonzero((whole.times > start) & (whole.times < stop))
    observed[np.ix_(rows, dropped)] = False
    return replace(whole, observed=observed)


def draw(
    whole: ob.Trajectory,
    live: ob.Answer,
    after: ob.Answer,
    shown: list[str],
    span: tuple[float, float],
) -> list[Image.Image]:
    """A frame per row.

    Args:
        whole: with nothing hidden.
        live: fills from the past.
        after: fills from both sides.
        shown: channels, a panel each.
        span: s, begin and end of the dropout.
    """
    times = whole.times - whole.times[0]
    start, stop = (end - whole.times[0] for end in span)
    out = (times > start) & (times < stop)
    figure, panels = plt.subplots(
        len(shown), 1, sharex=True, figsize=(7.6, 1.7 * len(shown) + 0.6), dpi=100
    )
    legend = [
        plt.Line2D([], [], color=INK, lw=1.8, label="measured"),
        plt.Line2D([], [], color=PALE, marker=".", ls="", label="hidden from Offbeat"),
        plt.Line2D([], [], color=LIVE, lw=1.8, label="live, from the past alone"),
        plt.Line2D([], [], color=AFTER, lw=1.8, label="once the sensor is back"),
    ]
    figure.legend(handles=legend, loc="lower center", ncols=4, fontsize=8, frameon=False)
    figure.tight_layout(rect=(0, 0.09, 1, 1), h_pad=0.6)
    frames = []
    for now in times:
        for axes, name in zip(np.atleast_1d(panels), shown, strict=True):
            c = whole.names.index(name)
            values = whole.values[:, c]
            axes.clear()
            axes.axvspan(start, min(max(now, start), stop), color="#F1F1F1", lw=0)
            past = times <= now
            axes.plot(times[past & out], values[past & out], ".", ms=4, color=PALE)
            axes.plot(times, np.where(past & ~out, values, np.nan), color=INK, lw=1.8)
            back = now >= stop
            answer, colour = (after, AFTER) if back else (live, LIVE)
            low, high = (end[past & out, c] for end in answer.interval(0.9))
            axes.fill_between(times[past & out], low, high, color=colour, alpha=0.18, lw=0)
            if back:
                axes.plot(times[out], live.values[out, c], color=LIVE, lw=1.2, ls="--", alpha=0.6)
            axes.plot(times[past & out], answer.values[past & out, c], color=colour, lw=1.8)
            margin = 0.2 * np.ptp(values)
            axes.set_ylim(values.min() - margin, values.max() + margin)
            axes.set_xlim(0, times[-1])
            unit = f" [{whole.units[c]}]" if whole.units[c] else ""
            axes.set_title(name + unit, fontsize=9, loc="left", pad=3)
            axes.spines[["top", "right"]].set_visible(False)
            axes.tick_params(labelsize=8)
        np.atleast_1d(panels)[-1].set_xlabel("s", fontsize=8)
        data = io.BytesIO()
        figure.savefig(data, format="png")
        frames.append(Image.open(data).convert("RGB"))
    plt.close(figure)
    return frames


def main() -> None:
    """Reads the log, trains, hides, fills and draws."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("log")
    parser.add_argument("out")
    parser.add_argument("--show", required=True, help="channels to draw, separated by commas")
    parser.add_argument("--drop", required=True, help="words in the names of channels to hide")
    parser.add_argument("--dropout_s", type=float, default=0.8)
    parser.add_argument("--seconds", type=float, default=4.0, help="length of the stretch")
    parser.add_argument("--budget_s", type=float, default=120.0, help="of the trainings")
    parser.add_argument("--run", help="folder of the run, which is kept")
    parser.add_argument("--reader", type=json.loads, default={}, help="options of read, as JSON")
    given = parser.parse_args()
    shown, words = given.show.split(","), given.drop.split(",")

    log = ob.read(given.log, **given.reader)
    learned = ob.learn(log, given.run, horizon_s=given.dropout_s, budget_s=given.budget_s)
    whole = liveliest(learned.test, shown, given.seconds)
    middle = (whole.times[0] + whole.times[-1]) / 2
    span = (middle - given.dropout_s / 2, middle + given.dropout_s / 2)
    dropped = [i for i, name in enumerate(whole.names) if any(word in name for word in words)]
    seen = ob.Dataset((hidden(whole, dropped, *span),))
    live = ob.impute(learned, seen, mode="causal")[0]
    after = ob.impute(learned, seen)[0]
    at, rows = (
        [whole.names.index(n) for n in shown],
        (whole.times > span[0]) & (whole.times < span[1]),
    )
    truth = whole.values[np.ix_(rows, at)]
    held = whole.values[np.flatnonzero(rows)[0] - 1, at]
    for text, answer in (
        ("last value", held),
        ("live", live.values[np.ix_(rows, at)]),
        ("afterwards", after.values[np.ix_(rows, at)]),
    ):
        error = np.sqrt(np.mean((answer - truth) ** 2, axis=0))
        print(
            f"RMSE in the dropout, {text}:", dict(zip(shown, error.round(4).tolist(), strict=True))
        )
    frames = draw(whole, live, after, shown, span)
    frames[-1].save(Path(given.out).with_suffix(".png"))
    pause = [60] * (len(frames) - 1) + [2500]
    every = Image.new("RGB", (frames[0].width, 2 * frames[0].height))  # has every colour
    every.paste(frames[int(0.55 * len(frames))], (0, 0))
    every.paste(frames[-1], (0, frames[0].height))
    palette = every.quantize(128)
    small = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    small[0].save(given.out, save_all=True, append_images=small[1:], duration=pause, loop=0)


if __name__ == "__main__":
    main()
