"""The thesis' conclusions and our questions, each put to the tests."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from thesis.protocol import CONTROLS
from thesis.report import findings as say
from thesis.report import thesis_numbers as thesis
from thesis.report.findings import Finding, Verdict
from thesis.report.pairing import ANCHORED, FAIR, MODELS, Pair, Rule
from thesis.report.tables import label

Families = Mapping[tuple[str, str], Sequence[Pair]]
"""Paired comparisons by name of the family and scoring."""

_SPARSE = (0.5, 0.3)


def of_the_thesis(
    families: Families,
    rules: Mapping[str, Sequence[Rule]],
    *,
    spread: Mapping[str, Verdict],
    convergence: Mapping[str, Verdict],
    enough: Mapping[str, Verdict],
) -> tuple[Finding, ...]:
    """A finding for each conclusion of the thesis.

    Args:
        families: of `pairing.family`.
        rules: of `pairing.thesis_rule`, by scoring.
        spread: verdicts on conclusion 4, by scoring.
        convergence: verdicts on conclusion 2, by scoring.
        enough: verdicts on the choice of 75 and 50 epochs, by scoring.
    """
    signs = {fraction: 1 if fraction == 0.9 else -1 for fraction in thesis.FRACTIONS}
    significant = {}
    for scoring, name in say.SCORINGS.items():
        pairs = families["ode_models", scoring]
        significant[f"{name}, the thesis' rule"] = say.rule_significance(rules[scoring], _SPARSE)
        significant[f"{name}, paired tests"] = say.significance(pairs, _SPARSE)
    return (
        _finding("1", _each(families, "against_plain", say.all_better)),
        _finding("2", convergence),
        _finding(
            "3",
            _each(families, "ode_models", lambda pairs: say.directions(pairs, signs)),
        ),
        _finding("4", spread),
        _finding("5", significant),
        _finding("3.2", enough),
        _finding(
            "3.2, GRU",
            _each(
                families,
                "plain",
                lambda pairs: say.no_difference([p for p in pairs if p.fraction == 0.9]),
            ),
        ),
    )


def beyond_the_thesis(families: Families) -> tuple[Finding, ...]:
    """Findings on what the thesis does not ask."""
    ours = "Not in the thesis"
    guess = f"{ours}; that its rows contain self-feeding is inferred"
    fair = f"{label('gru_fair')} and {label('gru_d_fair')}"

    def better(family: str, which: Sequence[str]) -> dict[str, Verdict]:
        return _each(
            families,
            family,
            lambda pairs: say.all_better([p for p in pairs if p.a in which or p.b in which]),
        )

    return (
        Finding(
            "Self-feeding by itself makes GRU and GRU-D of the thesis' rows worse.",
            guess,
            better("self_feeding", CONTROLS),
        ),
        Finding(
            "ODE-RNN and ODE-GRU-D are better than GRU and GRU-D that are not self-fed, and are "
            "the thesis' otherwise.",
            "Conclusion 1 of the thesis, with plain models that are not handicapped",
            better("against_fair", CONTROLS),
        ),
        Finding(
            f"ODE-RNN and ODE-GRU-D are better than {fair}, which are not self-fed either, update "
            "at every row, GRU with the time since each channel's last observation as input.",
            "Conclusion 1 of the thesis, with plain models that see more",
            better("against_fair", FAIR),
        ),
        Finding(
            f"{fair} are better than GRU and GRU-D of the thesis' rows.",
            guess,
            better("self_feeding", FAIR),
        ),
        Finding(
            f"{label(ANCHORED)} is better than the ODE models of the thesis and than GRU and GRU-D "
            f"without self-feeding, {fair} among them.",
            ours,
            _each(families, "anchored", say.all_better),
        ),
        Finding(
            "A model is better than repeating the last observed value, under scoring after the "
            "first observation.",
            ours,
            {
                label(model): say.all_better(
                    [p for p in families["last_value", "honest"] if p.a == model]
                )
                for model in MODELS
            },
        ),
    )


def _finding(number: str, verdicts: Mapping[str, Verdict]) -> Finding:
    where = f"Conclusion {number}" if number.isdigit() else "Section 3.2"
    return Finding(thesis.CONCLUSIONS[number], f"{where} of the thesis", verdicts)


def _each(
    families: Families, name: str, judge: Callable[[Sequence[Pair]], Verdict]
) -> dict[str, Verdict]:
    return {shown: judge(families[name, scoring]) for scoring, shown in say.SCORINGS.items()}
