"""Sentences on which claims hold, derived from test results."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from offbeat.comparison.statistics import Estimate
from thesis.report import thesis_numbers as thesis
from thesis.report.pairing import Pair, Rule
from thesis.report.tables import label, percent
from thesis.report.tables_tests import SCORING_NAMES, signed

SCORINGS = {"published": "Published scoring", "honest": "Scoring after the first observation"}
"""Under which conclusions are judged."""

HOLDS = "holds"
PARTLY = "holds in part"
FAILS = "does not hold"
UNDECIDED = "not decided"
MISSING = "cannot be decided yet"
NOT_CONTRADICTED = "not contradicted"


@dataclass(frozen=True)
class Verdict:
    """What the tests say of a claim under one scoring.

    Attributes:
        word: `HOLDS`, `PARTLY`, `FAILS`, `UNDECIDED`, `NOT_CONTRADICTED` or `MISSING`.
        evidence: sentences, each with its numbers.
        count: how many parts of the claim hold; empty where it has but one.
    """

    word: str
    evidence: tuple[str, ...]
    count: str = ""


@dataclass(frozen=True)
class Finding:
    """A claim and its verdicts.

    Attributes:
        claim: a sentence that can be true or false.
        source: where it is claimed.
        verdicts: by what decides: a scoring, or a scoring and a test.
    """

    claim: str
    source: str
    verdicts: Mapping[str, Verdict]


def sentence(pair: Pair) -> str:
    """A paired comparison in words, with difference, interval and p."""
    a, b, at = label(pair.a), label(pair.b), percent(pair.fraction)
    scoring = SCORING_NAMES[pair.scoring]
    if pair.tied:
        return f"At {at}, {a} and {b} do not differ significantly under {scoring}: {pair.missing}."
    if pair.result is None or pair.t_holm is None:
        return f"At {at}, {a} and {b} cannot be compared under {scoring}: {pair.missing}."
    result, rmse = pair.result, pair.measure == "RMSE"
    numbers = (
        f"difference {interval(result.difference_t, 5 if rmse else 1)}, paired t "
        f"{p_text(pair.t_holm)} after Holm, Wilcoxon {p_text(pair.wilcoxon_holm)}, {result.runs} "
        "repeats"
    )
    less = result.difference.value < 0
    if not pair.significant:
        what = "" if rmse else " in the epochs that they need"
        text = f"At {at}, {a} and {b} do not differ significantly{what} under {scoring}: {numbers}."
    elif rmse:
        relation = "lower" if less else "higher"
        text = f"At {at}, {a} has a {relation} RMSE than {b} under {scoring}: {numbers}."
    else:
        relation = "fewer" if less else "more"
        text = f"At {at}, {a} settles in {relation} epochs than {b} under {scoring}: {numbers}."
    if pair.wilcoxon_holm is not None and pair.significant != (pair.wilcoxon_holm <= thesis.ALPHA):
        text += " The two tests disagree."
    return text


def interval(estimate: Estimate, digits: int) -> str:
    """A difference with its interval."""
    if estimate.low is None or estimate.high is None:
        return signed(estimate.value, digits)
    return (
        f"{signed(estimate.value, digits)} "
        f"[{signed(estimate.low, digits)}, {signed(estimate.high, digits)}] "
        f"({100 * estimate.confidence:g}\N{THIN SPACE}%)"
    )


def p_text(p: float | None) -> str:
    """A p-value in a sentence."""
    if p is None:
        return "p not known"
    return f"p = {p:.4f}" if p >= 5e-5 else "p < 0.0001"


def all_better(pairs: Sequence[Pair]) -> Verdict:
    """The first model of every pair is better: how many of the tests say so."""
    tested = [p for p in pairs if p.result is not None or p.tied]
    better = sum(p.better for p in tested)
    worse = sum(p.worse for p in tested)
    count = (
        f"Of {len(pairs)} paired tests, {better} find the first model better, {worse} find it "
        f"worse, {len(tested) - better - worse} show no significant difference"
        + (f", {len(pairs) - len(tested)} cannot be made yet." if len(tested) < len(pairs) else ".")
    )
    return judged(len(pairs), len(tested), better, worse, (count, *map(sentence, pairs)))


def judged(
    asked: int, tested: int, right: int, wrong: int, evidence: Sequence[str], parts: str = "parts"
) -> Verdict:
    """The verdict on a claim of several parts.

    Args:
        asked: number of its parts.
        tested: how many of them the record lets us test.
        right: number of tests that support it.
        wrong: how many contradict it.
        evidence: sentences.
        parts: what they are called.
    """
    if tested < asked:
        count = f"{tested} of {asked} {parts} can be tested yet"
    else:
        undecided = asked - right - wrong
        said = [f"{right} of {asked} {parts}"]
        said += [f"{wrong} against"] if wrong else []
        said += [f"{undecided} not decided"] if undecided else []
        count = ", ".join(said)
    return Verdict(word(asked, tested, right, wrong), tuple(evidence), count if asked > 1 else "")


def word(asked: int, tested: int, right: int, wrong: int) -> str:
    """The verdict on a claim of several parts, of which each is right, wrong or not decided."""
    if tested < asked:
        return MISSING
    if right == asked:
        return HOLDS
    if not right and not wrong:
        return UNDECIDED
    return PARTLY if right else FAILS


def directions(pairs: Sequence[Pair], expected: Mapping[float, int]) -> Verdict:
    """The sign of each difference is the expected one, by the paired tests.

    Args:
        pairs: at the observed fractions of `expected`.
        expected: by observed fraction, -1 where the first model is to be better, else 1.
    """
    chosen = [p for p in pairs if p.fraction in expected]
    tested = [p for p in chosen if p.result is not None]
    right = sum(p.better if expected[p.fraction] < 0 else p.worse for p in tested)
    wrong = sum(p.worse if expected[p.fraction] < 0 else p.better for p in tested)
    return judged(len(chosen), len(tested), right, wrong, tuple(map(sentence, chosen)))


def significance(pairs: Sequence[Pair], better_at: Sequence[float]) -> Verdict:
    """The first model is significantly better at exactly these fractions, by the paired tests."""
    tested = [p for p in pairs if p.result is not None]
    outcomes = [(p.fraction in better_at, p.better, p.worse) for p in tested]
    right, wrong = _exactly(outcomes)
    return judged(len(pairs), len(tested), right, wrong, tuple(map(sentence, pairs)))


def _exactly(outcomes: Sequence[tuple[bool, bool, bool]]) -> tuple[int, int]:
    """Parts borne out and contradicted of a claim that a difference is there or is not.

    A test that finds nothing contradicts no claim of a difference: it may be too weak. Nor does it
    support that there is none, unless the same tests find a difference elsewhere.

    Args:
        outcomes: per part, whether a difference is claimed, the first model is better, is worse.
    """
    right = wrong = unclaimed = 0
    for claimed, better, worse in outcomes:
        right += claimed and better
        wrong += worse or (better and not claimed)
        unclaimed += not claimed and not better and not worse
    return right + unclaimed * bool(right or wrong), wrong


def rule_significance(rules: Sequence[Rule], better_at: Sequence[float]) -> Verdict:
    """The same by the thesis' own rule, which takes the samples to be independent.

    Args:
        rules: of `pairing.thesis_rule`, ODE-RNN first.
        better_at: observed fractions at which ODE-GRU-D is to be significantly better.
    """
    said, outcomes = [], []
    names = {"two_sample_t": "the two-sample t test", "welch_t": "Welch's t test"}
    for rule in rules:
        at = percent(rule.fraction)
        if rule.result is None:
            said.append(f"At {at} the rule cannot be applied: {rule.missing}.")
            continue
        result = rule.result
        better = result.significant and result.t > 0  # ODE-RNN's mean is the higher
        worse = result.significant and not better
        outcomes.append((rule.fraction in better_at, better, worse))
        outcome = (
            "finds no significant difference of the means"
            if not result.significant
            else f"finds {label('ode_gru_d' if result.t > 0 else 'ode_rnn')} better"
        )
        normal = "" if result.normal else " Shapiro-Wilk rejects a normal distribution here."
        said.append(
            f"At {at}, Bartlett's {p_text(result.bartlett.p)} leads to "
            f"{names.get(result.test, result.test)}, which {outcome} ({p_text(result.p)})."
            f"{normal}"
        )
    return judged(len(rules), len(outcomes), *_exactly(outcomes), said)


def no_difference(pairs: Sequence[Pair]) -> Verdict:
    """The two models of each pair do not differ significantly, which proves no equality."""
    tested = [p for p in pairs if p.result is not None]
    significant = sum(p.significant for p in tested)
    if len(tested) < len(pairs):
        return Verdict(MISSING, tuple(map(sentence, pairs)))
    return Verdict(FAILS if significant else NOT_CONTRADICTED, tuple(map(sentence, pairs)))
