"""Verdicts and sentences follow from the tests, whatever the record says."""

import re

import numpy as np
import pytest
import record_helpers as made

from thesis.report import claims, convergence, findings, pairing, stability
from thesis.report import thesis_numbers as thesis
from thesis.report.findings import FAILS, HOLDS, MISSING, NOT_CONTRADICTED, PARTLY, UNDECIDED
from thesis.report.records import Record

PERCENT = "\N{THIN SPACE}%"


@pytest.fixture(scope="module")
def record():
    return made.synthetic(repeats=6, epochs=60)


def of(**factors):
    return made.synthetic(repeats=6, epochs=60, experiments=(2,), factors=factors)


@pytest.mark.parametrize(
    ("factor", "word"),
    [(0.5, HOLDS), (2.0, FAILS), (0.00073 / 0.00066, UNDECIDED)],
    ids=["much better", "much worse", "the same but for noise"],
)
def test_one_model_is_better_if_the_tests_say_so(factor, word):
    pairs = pairing.family(of(ode_gru_d=factor), "ode_models", "honest")
    verdict = findings.all_better(pairs)
    assert verdict.word == word
    better = {HOLDS: 4, FAILS: 0, UNDECIDED: 0}[word]
    assert f"{better} find the first model better" in verdict.evidence[0]
    assert len(verdict.evidence) == 1 + len(thesis.FRACTIONS)


def test_the_sentence_of_a_comparison_has_its_numbers(record):
    pair = pairing.family(record, "ode_models", "honest")[3]
    said = findings.sentence(pair)
    estimate = pair.result.difference_t
    numbers = [f"{v:+.5f}" for v in (estimate.value, estimate.low, estimate.high)]
    shown = re.findall(r"[+−]\d\.\d{5}", said)
    assert [text.replace("−", "-") for text in shown] == numbers
    assert "6 repeats" in said
    assert findings.p_text(pair.t_holm) in said


def test_too_few_runs_give_no_verdict_and_say_why():
    few = made.synthetic(repeats=2, epochs=2, experiments=(2,))
    verdict = findings.all_better(pairing.family(few, "ode_models", "honest"))
    assert verdict.word == MISSING
    assert "4 cannot be made yet" in verdict.evidence[0]
    assert "at least 3" in verdict.evidence[1]
    rule = findings.rule_significance(pairing.thesis_rule(few, "honest"), (0.5, 0.3))
    assert rule.word == MISSING


@pytest.mark.parametrize(
    ("asked", "tested", "right", "wrong", "word"),
    [
        (4, 4, 4, 0, HOLDS),
        (4, 4, 3, 0, PARTLY),
        (4, 4, 3, 1, PARTLY),
        (4, 4, 0, 1, FAILS),
        (4, 4, 0, 0, UNDECIDED),
        (4, 3, 3, 0, MISSING),
    ],
)
def test_a_claim_of_several_parts_has_one_word(asked, tested, right, wrong, word):
    assert findings.word(asked, tested, right, wrong) == word


def test_a_claim_about_directions_counts_them(record):
    pairs = pairing.family(record, "ode_models", "honest")  # ODE-GRU-D is better everywhere
    assert findings.directions(pairs, {0.9: -1, 0.3: -1}).word == HOLDS
    assert findings.directions(pairs, {0.9: 1, 0.3: -1}).word == PARTLY
    assert findings.directions(pairs, {0.9: 1, 0.3: 1}).word == FAILS
    assert len(findings.directions(pairs, {0.9: 1}).evidence) == 1


def test_a_claim_about_significance_asks_for_it_there_and_nowhere_else(record):
    pairs = pairing.family(record, "ode_models", "honest")
    assert findings.significance(pairs, thesis.FRACTIONS).word == HOLDS
    assert findings.significance(pairs, (0.5, 0.3)).word == PARTLY
    assert findings.significance(pairs, ()).word == FAILS


def test_tests_that_find_nothing_decide_nothing_about_significance():
    # Claimed: a difference at two shares and none at two others. Nothing is found anywhere.
    same = of(ode_gru_d=0.00073 / 0.00066)
    verdict = findings.significance(pairing.family(same, "ode_models", "honest"), (0.5, 0.3))
    assert verdict.word == UNDECIDED
    assert verdict.count == "0 of 4 parts, 4 not decided"
    rule = findings.rule_significance(pairing.thesis_rule(same, "honest"), (0.5, 0.3))
    assert rule.word == UNDECIDED


@pytest.mark.parametrize(
    ("outcomes", "expected"),
    [
        ([(True, True, False), (False, False, False)], (2, 0)),  # as claimed
        ([(True, False, False), (False, False, False)], (0, 0)),  # nothing found
        ([(True, True, False), (False, True, False)], (1, 1)),  # a difference too many
        ([(True, False, True), (False, False, False)], (1, 1)),  # the other way round
    ],
)
def test_a_claim_of_where_a_difference_is_needs_a_difference(outcomes, expected):
    assert findings._exactly(outcomes) == expected


def test_models_that_need_the_same_epochs_do_not_differ_significantly():
    record = made.synthetic(repeats=4, epochs=2, fractions=thesis.FRACTIONS, experiments=(2,))
    flat = {**record.curves, "validation_honest_mse": np.ones(len(record.curves["epoch"]))}
    record = Record(record.runs, flat, "flat")
    verdict = convergence.speed_verdicts(record)["Scoring after the first observation"]
    assert verdict.word == UNDECIDED
    assert "they need the same epochs in all 4 repeats" in verdict.evidence[1]


def test_the_thesis_rule_is_told_step_by_step(record):
    rules = pairing.thesis_rule(record, "honest")
    verdict = findings.rule_significance(rules, thesis.FRACTIONS)
    right = [r.result.significant and r.result.t > 0 for r in rules]
    assert verdict.word == (HOLDS if all(right) else PARTLY)
    for rule, said in zip(rules, verdict.evidence, strict=True):
        assert findings.p_text(rule.result.bartlett.p) in said
        assert findings.p_text(rule.result.p) in said
        test = "the two-sample t test" if rule.result.bartlett.p > 0.05 else "Welch's t test"
        assert test in said


def test_the_thesis_rule_names_the_better_model():
    rules = pairing.thesis_rule(of(ode_gru_d=2.0), "honest")
    verdict = findings.rule_significance(rules, (0.5, 0.3))
    assert verdict.word == FAILS
    assert all("finds ODE-RNN better" in said for said in verdict.evidence)


def test_no_significant_difference_is_no_proof():
    same = made.HONEST["gru"] / made.HONEST["gru_d"]
    verdict = findings.no_difference(pairing.family(of(gru_d=same), "plain", "honest"))
    assert verdict.word == NOT_CONTRADICTED
    assert findings.no_difference(pairing.family(of(gru_d=0.5), "plain", "honest")).word == FAILS


def test_the_faster_model_is_found_from_the_curves(record):
    # Half of what is left to learn takes ODE-GRU-D 12 epochs and ODE-RNN 30.
    verdict = convergence.speed_verdicts(record)["Published scoring"]
    assert verdict.word == HOLDS
    assert "ODE-GRU-D settles in fewer epochs than ODE-RNN" in verdict.evidence[1]
    assert "In experiment 1" in verdict.evidence[-1]
    slower = {**made.HALVING, "ode_gru_d": 30, "ode_rnn": 12}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(made, "HALVING", slower)
        other = made.synthetic(repeats=6, epochs=60)
    assert convergence.speed_verdicts(other)["Published scoring"].word == FAILS


def test_whether_the_chosen_epochs_are_enough_is_read_from_longer_runs():
    record = made.synthetic(repeats=1, epochs=300)
    verdict = convergence.enough_verdicts(record)["Scoring after the first observation"]
    assert len(verdict.evidence) == 16
    ours = record.curve("e1-ode_gru_d-90-r00")["validation_honest_mse"]
    (said,) = [e for e in verdict.evidence if e.startswith(f"At 90{PERCENT}, ODE-GRU-D")]
    assert f"the error is {ours[74] / ours[-1]:.2f} times that after 300" in said
    assert verdict.word == FAILS  # GRU halves what is left in 40 epochs, ODE-RNN in 30
    short = convergence.enough_verdicts(made.synthetic(repeats=1, epochs=20))[
        "Scoring after the first observation"
    ]
    assert short.word == MISSING


def test_the_steadiest_model_is_found_from_the_spread():
    record = made.synthetic(repeats=10, epochs=2, experiments=(2,))
    found = {scoring: stability.spreads(record, scoring) for scoring in findings.SCORINGS}
    verdict = stability.spread_verdicts(found)["Scoring after the first observation"]
    assert len(verdict.evidence) == 1 + 3 * 4
    told = [s for s in found["honest"] if s.model in thesis.MODELS and s.p <= 0.05]
    right = sum(s.result.ratio.value < 1 for s in told)
    assert verdict.word == findings.word(12, 12, right, len(told) - right)
    one = found["honest"][0]
    assert f"is {one.result.ratio.value:.2f} [" in verdict.evidence[1]


def test_every_conclusion_of_the_thesis_gets_a_finding(record):
    families = {
        (name, scoring): pairing.family(record, name, scoring)
        for name in pairing.FAMILIES
        for scoring in findings.SCORINGS
    }
    rules = {scoring: pairing.thesis_rule(record, scoring) for scoring in findings.SCORINGS}
    none = {"Published scoring": findings.Verdict(MISSING, ())}
    found = claims.of_the_thesis(families, rules, spread=none, convergence=none, enough=none)
    assert [f.claim for f in found] == list(thesis.CONCLUSIONS.values())
    assert len(found[4].verdicts) == 4  # both scorings, the thesis' rule and the paired tests
    beyond = claims.beyond_the_thesis(families)
    # Self-feeding makes GRU and GRU-D worse than the last value in this record, the others win.
    words = {name: verdict.word for name, verdict in beyond[-1].verdicts.items()}
    assert {name for name, word in words.items() if word == FAILS} == {"GRU", "GRU-D"}
    assert {name for name, word in words.items() if word == HOLDS} == {
        "ODE-RNN",
        "ODE-GRU-D",
        "Fair GRU",
        "Fair GRU-D",
        "Anchored ODE-GRU-D",
        "GRU, not self-fed",
        "GRU-D, not self-fed",
    }
