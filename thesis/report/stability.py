"""How far a model's errors spread between repeats, which the thesis judges by eye, measured."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from offbeat import InputError
from offbeat.comparison.statistics import SpreadComparison, holm, spread_comparison
from thesis.report import findings as say
from thesis.report import thesis_numbers as thesis
from thesis.report.findings import Verdict
from thesis.report.pairing import MODELS, paired_rmse, too_few
from thesis.report.records import Record
from thesis.report.table import MIXED, Block, Cell, Table
from thesis.report.tables import COUNTED, HEADINGS, by_fraction, label, percent, rmse_of

_OURS = "ode_gru_d"


@dataclass(frozen=True)
class Spread:
    """The spread of ODE-GRU-D and of another model at one observed fraction.

    Attributes:
        model: the other one.
        fraction: observed fraction of the rows.
        scoring: of the RMSE.
        result: with a ratio below 1, ODE-GRU-D varies less; None where it cannot be tested.
        p: of Pitman and Morgan's test, corrected by Holm over the observed fractions and the models
            of the thesis, or those that it does not have.
        missing: why there is no result.
    """

    model: str
    fraction: float
    scoring: str
    result: SpreadComparison | None = None
    p: float | None = None
    missing: str = ""


def spreads(record: Record, scoring: str) -> tuple[Spread, ...]:
    """Compares the spread of ODE-GRU-D with that of every other model, paired.

    Args:
        record: its runs of experiment 2.
        scoring: of the RMSE.
    """
    found = list[Spread]()
    for models in (thesis.MODELS, [m for m in MODELS if m not in thesis.MODELS]):
        mine = []
        for model in models:
            if model != _OURS:
                mine += [_spread(record, model, f, scoring) for f in thesis.FRACTIONS]
        tested = [i for i, one in enumerate(mine) if _p(one) is not None]
        if tested:
            for i, p in zip(tested, holm([_p(mine[i]) or 0.0 for i in tested]), strict=True):
                mine[i] = replace(mine[i], p=p)
        found += mine
    return tuple(found)


def _p(one: Spread) -> float | None:
    if one.result is None or one.result.pitman_morgan is None:
        return None
    return one.result.pitman_morgan.p


def _spread(record: Record, model: str, fraction: float, scoring: str) -> Spread:
    ours, other = paired_rmse(record, _OURS, model, fraction, scoring)
    one = Spread(model, fraction, scoring, missing=too_few(len(ours)))
    if one.missing:
        return one
    try:
        return replace(
            one, result=spread_comparison(ours, other, names=(label(_OURS), label(model)))
        )
    except InputError as error:
        return replace(one, missing=str(error))


def spread_verdicts(found: Mapping[str, tuple[Spread, ...]]) -> dict[str, Verdict]:
    """Is ODE-GRU-D the steadiest of the thesis' models?

    Args:
        found: of `spreads`, by scoring.
    """
    verdicts = {}
    for scoring, shown in say.SCORINGS.items():
        mine = [one for one in found[scoring] if one.model in thesis.MODELS]
        tested = [one for one in mine if one.result is not None and one.p is not None]
        significant = [one for one in tested if (one.p or 0.0) <= thesis.ALPHA]
        right = sum(one.result.ratio.value < 1 for one in significant if one.result)
        lower = sum(one.result.ratio.value < 1 for one in tested if one.result)
        count = (
            f"{label(_OURS)} spreads less in {lower} of {len(mine)} comparisons; in {right} of "
            f"them significantly; in {len(significant) - right} it spreads significantly more."
        )
        verdicts[shown] = say.judged(
            len(mine),
            len(tested),
            right,
            len(significant) - right,
            (count, *map(_spread_sentence, mine)),
            "comparisons",
        )
    return verdicts


def _spread_sentence(one: Spread) -> str:
    at = f"At {percent(one.fraction)}"
    if one.result is None or one.p is None:
        return f"{at}, {label(_OURS)} and {label(one.model)}: {one.missing}."
    ratio = one.result.ratio
    ends = "" if ratio.low is None else f" [{ratio.low:.2f}, {ratio.high:.2f}]"
    return (
        f"{at}, the standard deviation of {label(_OURS)} is {ratio.value:.2f}{ends} times that of "
        f"{label(one.model)}: Pitman-Morgan {say.p_text(one.p)} after Holm, Levene "
        f"{say.p_text(one.result.levene.p)}."
    )


def spread_table(record: Record, found: Mapping[str, tuple[Spread, ...]], *, number: str) -> Table:
    """Standard deviation of the test RMSE over repeats, and the ratio of ODE-GRU-D's to each.

    Args:
        record: its runs of experiment 2.
        found: of `spreads`, by scoring.
        number: of the table.
    """
    blocks = []
    for scoring in say.SCORINGS:
        by_key = {(one.model, one.fraction): one for one in found[scoring]}
        rows = []
        for model in MODELS:
            cells = []
            for fraction in thesis.FRACTIONS:
                runs, values = rmse_of(record, model, fraction, scoring)
                if len(values) < 2:
                    cells.append(Cell(n=len(values)))
                    continue
                spread = float(values.std(ddof=1))
                one = by_key.get((model, fraction))
                text, bold = f"{spread:.5f}", False
                if one is not None and one.result is not None:
                    text += f" ({one.result.ratio.value:.2f})"
                    bold = one.p is not None and one.p <= thesis.ALPHA
                mark = MIXED if record.mixed(runs) else ""
                cells.append(Cell(text, spread, n=len(values), bold=bold, mark=mark))
            rows.append((label(model), tuple(cells)))
        blocks.append(Block(HEADINGS[scoring], tuple(rows)))
    return by_fraction(
        record,
        number,
        "Standard deviation of the test RMSE over the repeats; in brackets that of "
        f"{label(_OURS)} over it, in the repeats that both have.",
        blocks,
        f"Below 1: {label(_OURS)} is steadier. Bold: significant by Pitman and Morgan's test "
        f"for pairs (p ≤ {thesis.ALPHA:g} after Holm).",
        COUNTED,
    )
