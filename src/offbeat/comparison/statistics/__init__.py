"""Statistics of scores: functions that take arrays and return records; no torch, no files.

`docs/statistics.md` lists the assumptions of each test, and which tests decide.
"""

from offbeat.comparison.statistics.bootstrap import bca
from offbeat.comparison.statistics.curves import (
    Convergence,
    Enough,
    Settling,
    convergence,
    enough_epochs,
    settling,
)
from offbeat.comparison.statistics.multiple import holm
from offbeat.comparison.statistics.paired import (
    PairedComparison,
    hedges_g,
    paired_comparison,
    paired_t,
    wilcoxon,
)
from offbeat.comparison.statistics.ranks import FriedmanResult, critical_difference, friedman
from offbeat.comparison.statistics.samples import Estimate, Outcome
from offbeat.comparison.statistics.spread import SpreadComparison, pitman_morgan, spread_comparison
from offbeat.comparison.statistics.two_samples import (
    ThesisTest,
    bartlett,
    levene,
    shapiro_wilk,
    thesis_test,
    two_sample_t,
    welch_t,
)

__all__ = [
    "Convergence",
    "Enough",
    "Estimate",
    "FriedmanResult",
    "Outcome",
    "PairedComparison",
    "Settling",
    "SpreadComparison",
    "ThesisTest",
    "bartlett",
    "bca",
    "convergence",
    "critical_difference",
    "enough_epochs",
    "friedman",
    "hedges_g",
    "holm",
    "levene",
    "paired_comparison",
    "paired_t",
    "pitman_morgan",
    "settling",
    "shapiro_wilk",
    "spread_comparison",
    "thesis_test",
    "two_sample_t",
    "welch_t",
    "wilcoxon",
]
