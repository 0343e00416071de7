"""Comparison of runs: reads records, tests differences; imports no torch."""

from offbeat.comparison.comparing import compare
from offbeat.comparison.results import Comparison, ConditionResult, PairResult, Summary
from offbeat.comparison.runs import Run, read_runs

__all__ = [
    "Comparison",
    "ConditionResult",
    "PairResult",
    "Run",
    "Summary",
    "compare",
    "read_runs",
]
