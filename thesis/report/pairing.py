"""Which models of a record are compared with which, by the tests of `statistics`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from offbeat import InputError
from offbeat.comparison.statistics import (
    FriedmanResult,
    PairedComparison,
    ThesisTest,
    friedman,
    holm,
    paired_comparison,
    thesis_test,
)
from offbeat.comparison.statistics.samples import FEWEST
from offbeat.tables import MINUS
from thesis.protocol import CONTROLS
from thesis.report import thesis_numbers as thesis
from thesis.report.records import Record
from thesis.report.tables import LAST_VALUE, label

PLAIN = ("gru", "gru_d")
FAIR = ("gru_fair", "gru_d_fair")
ODE = ("ode_rnn", "ode_gru_d")
ANCHORED = "anchored_ode_gru_d"
RANKED = (*thesis.MODELS, *FAIR, ANCHORED)
"""Models that are ranked against each other: the controls only explain two of them."""
MODELS = (*RANKED, *CONTROLS)
"""Models of experiment 2, in the order of tables and figures."""

OURS = (("ode_gru_d", "ode_rnn"),)
"""The pair that the thesis tests."""

FAMILIES: dict[str, tuple[tuple[str, str], ...]] = {
    "ode_models": OURS,
    "against_plain": tuple((a, b) for a in ODE for b in PLAIN),
    "against_fair": tuple((a, b) for a in ODE for b in (*CONTROLS, *FAIR)),
    "self_feeding": tuple(
        pair for them in (CONTROLS, FAIR) for pair in zip(them, PLAIN, strict=True)
    ),
    "plain": (("gru_d", "gru"),),
    "anchored": tuple((ANCHORED, b) for b in (*ODE, *CONTROLS, *FAIR)),
    "last_value": tuple((m, LAST_VALUE) for m in MODELS),
}
"""Pairs that are corrected together, over all observed fractions of a scoring."""


@dataclass(frozen=True)
class Pair:
    """Two models at one observed fraction, in the repeats that both have.

    Attributes:
        a: label of the first model; a difference is the first minus the second.
        b: label of the second.
        fraction: observed fraction of the rows.
        scoring: of the RMSE.
        result: every number, or None where there is too little to compare.
        t_holm: p of the paired t test, corrected for the family.
        wilcoxon_holm: p of Wilcoxon's test, corrected for the family.
        missing: why there is no result.
        measure: `RMSE` or `epochs`; lower is better.
        tied: both are equal in every repeat, so that there is no test and no difference.
    """

    a: str
    b: str
    fraction: float
    scoring: str
    result: PairedComparison | None = None
    t_holm: float | None = None
    wilcoxon_holm: float | None = None
    missing: str = ""
    measure: str = "RMSE"
    tied: bool = False

    @property
    def better(self) -> bool:
        """Whether the first is significantly lower by the corrected paired t test."""
        return self.significant and self.result is not None and self.result.difference.value < 0

    @property
    def worse(self) -> bool:
        """Whether the first is significantly higher by the corrected paired t test."""
        return self.significant and self.result is not None and self.result.difference.value > 0

    @property
    def significant(self) -> bool:
        """The corrected paired t test is significant."""
        return self.t_holm is not None and self.t_holm <= thesis.ALPHA

    @property
    def names(self) -> str:
        """As tables have it."""
        return f"{label(self.a)} {MINUS} {label(self.b)}"


def family(record: Record, name: str, scoring: str) -> tuple[Pair, ...]:
    """Paired comparisons of a family at every observed fraction, corrected together by Holm.

    Args:
        record: its runs of experiment 2.
        name: one of `FAMILIES`.
        scoring: `published`, `honest` or `honest_hidden`.
    """
    return corrected(
        [
            _pair(record, a, b, fraction, scoring)
            for a, b in FAMILIES[name]
            for fraction in thesis.FRACTIONS
        ]
    )


def corrected(pairs: Sequence[Pair]) -> tuple[Pair, ...]:
    """Corrects the p-values of a family by Holm; pairs without a result are left as they are."""
    found = list(pairs)
    tested = [(i, pair.result) for i, pair in enumerate(found) if pair.result is not None]
    if tested:
        t = holm([result.paired_t.p for _, result in tested])
        w = holm([result.wilcoxon.p for _, result in tested])
        for (i, _), t_p, w_p in zip(tested, t, w, strict=True):
            found[i] = replace(found[i], t_holm=t_p, wilcoxon_holm=w_p)
    return tuple(found)


def _pair(record: Record, a: str, b: str, fraction: float, scoring: str) -> Pair:
    first, second = paired_rmse(record, a, b, fraction, scoring)
    pair = Pair(a, b, fraction, scoring, missing=too_few(len(first)))
    if pair.missing:
        return pair
    try:
        return replace(pair, result=paired_comparison(first, second, names=(label(a), label(b))))
    except InputError as error:
        return replace(pair, missing=str(error))


def too_few(repeats: int) -> str:
    """Why repeats that both models have are too few for a test; empty where they are not."""
    if repeats >= FEWEST:
        return ""
    there = "1 repeat has both" if repeats == 1 else f"{repeats or 'no'} repeats have both"
    return f"{there}, a test needs at least {FEWEST}"


def paired_rmse(
    record: Record, a: str, b: str, fraction: float, scoring: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Test RMSE of two models in the repeats that both have; the last value is one of them."""
    models = [m for m in (a, b) if m != LAST_VALUE]
    rows = record.shared(models, fraction=fraction)

    def scores(model: str) -> NDArray[np.float64]:
        if model == LAST_VALUE:
            return record.rmse(f"{LAST_VALUE}_{scoring}", rows[models[0]])
        return record.rmse(scoring, rows[model])

    return scores(a), scores(b)


@dataclass(frozen=True)
class Rule:
    """The thesis' rule at one observed fraction; `result` is None where there is too little."""

    fraction: float
    scoring: str
    result: ThesisTest | None
    missing: str = ""


def thesis_rule(
    record: Record, scoring: str, *, a: str = "ode_rnn", b: str = "ode_gru_d"
) -> tuple[Rule, ...]:
    """Applies section 3.4 of the thesis at every observed fraction.

    Args:
        record: its runs of experiment 2.
        scoring: of the RMSE.
        a: label of the first model.
        b: label of the second, or `last_value`.
    """
    rules = []
    for fraction in thesis.FRACTIONS:
        first, second = paired_rmse(record, a, b, fraction, scoring)
        if few := too_few(len(first)):
            rules.append(Rule(fraction, scoring, None, few))
            continue
        try:
            result = thesis_test(first, second, alpha=thesis.ALPHA, names=(label(a), label(b)))
            rules.append(Rule(fraction, scoring, result))
        except InputError as error:
            rules.append(Rule(fraction, scoring, None, str(error)))
    return tuple(rules)


def ranks(
    record: Record, scoring: str, *, models: Sequence[str] = RANKED
) -> dict[float, FriedmanResult | str]:
    """Friedman's test over the repeats at each observed fraction; a reason where there is none.

    Repeats at one fraction are draws of their own, and so independent blocks. Fractions are not
    pooled: a repeat's draw may serve several of them.

    Args:
        record: its runs of experiment 2.
        scoring: of the RMSE.
        models: to rank; those without a run at a fraction are left out there.
    """
    found: dict[float, FriedmanResult | str] = {}
    for fraction in thesis.FRACTIONS:
        there = [m for m in models if len(record.where(experiment=2, model=m, fraction=fraction))]
        rows = record.shared(there, fraction=fraction)
        try:
            found[fraction] = friedman({m: record.rmse(scoring, rows[m]) for m in there})
        except InputError as error:
            found[fraction] = str(error)
    return found
