"""Results of a comparison of runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from offbeat.comparison.statistics.paired import PairedComparison
from offbeat.comparison.statistics.ranks import FriedmanResult
from offbeat.comparison.statistics.samples import Outcome
from offbeat.comparison.statistics.two_samples import ThesisTest


@dataclass(frozen=True)
class Summary:
    """The scores of one model under one condition.

    Attributes:
        model: label of the model, or `last_value`.
        values: (runs,) in the order of the condition's repeats.
        mean: of the values.
        std: standard deviation with n - 1.
        median: of the values.
        minimum: of the values.
        maximum: of the values.
        shapiro: Shapiro-Wilk test of the values; None where they are all equal.
    """

    model: str
    values: tuple[float, ...]
    mean: float
    std: float
    median: float
    minimum: float
    maximum: float
    shapiro: Outcome | None


@dataclass(frozen=True)
class PairResult:
    """Two models under one condition.

    Attributes:
        first: label of the first model.
        second: label of the second, the baseline where there is one.
        paired: the tests that decide; differences are first minus second.
        paired_t_holm: p of the paired t test, adjusted for all pairs of the comparison.
        wilcoxon_holm: p of Wilcoxon's test, adjusted in the same way.
        thesis: the thesis' rule, which assumes independent runs.
        better: label of the model that is better by `paired_t_holm` at level alpha; None where no
            difference is shown.
    """

    first: str
    second: str
    paired: PairedComparison
    paired_t_holm: float
    wilcoxon_holm: float
    thesis: ThesisTest
    better: str | None


@dataclass(frozen=True)
class ConditionResult:
    """All models under one condition.

    Attributes:
        condition: name of the condition.
        repeats: those that all models have.
        summaries: per model, the lowest mean first; the last-value predictor among them.
        pairs: each with the tests of its difference.
        friedman: of the models together; None for two.
    """

    condition: str
    repeats: tuple[str, ...]
    summaries: tuple[Summary, ...]
    pairs: tuple[PairResult, ...]
    friedman: FriedmanResult | None


@dataclass(frozen=True)
class Comparison:
    """The result of `compare`.

    Attributes:
        metric: scoring of the runs.
        error: `rmse` or `mse`, in scaled units.
        baseline: model that the others are compared with; None for all pairs.
        alpha: level of significance.
        confidence: of intervals.
        resamples: of the bootstrap.
        seed: of the bootstrap.
        conditions: in order of appearance.
        notes: remarks on the runs: other commits, conditions left out, ...
    """

    metric: str
    error: str
    baseline: str | None
    alpha: float
    confidence: float
    resamples: int
    seed: int
    conditions: tuple[ConditionResult, ...]
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        return self.text()

    @property
    def family(self) -> int:
        """Number of pairs that Holm's correction covers."""
        return sum(len(condition.pairs) for condition in self.conditions)

    def text(self) -> str:
        """Tables in plain text."""
        from offbeat.comparison.text import text

        return text(self)

    def markdown(self) -> str:
        """Tables in Markdown."""
        from offbeat.comparison.text import markdown

        return markdown(self)

    def latex(self) -> str:
        """Tables in LaTeX, for the package booktabs."""
        from offbeat.comparison.text import latex

        return latex(self)

    def to_dict(self) -> dict[str, Any]:
        """JSON-like form of every number; null where there is none."""
        from offbeat.comparison.text import to_dict

        return to_dict(self)
