"""Tables of the experiment on passive robots, from errors whose differences are known."""

from __future__ import annotations

import json

import numpy as np
import pytest
from scipy import stats

from examples import experiment_3_report as report

ANCHORED, RIDGE = np.array([0.08, 0.09, 0.10, 0.07]), np.array([0.10, 0.13, 0.12, 0.11])


@pytest.fixture
def found(tmp_path):
    for name, each in (("anchored", ANCHORED), ("ridge", RIDGE)):
        for repeat, rmse in enumerate(each):
            record = {"predictor": name, "robot": "walker", "rows": 100, "fraction": 0.3}
            record |= {"repeat": repeat, "rmse": rmse, "trajectories": 500, "epochs": 4}
            record |= {"curve": [0.3, 0.2, 0.1, 0.1]} if name == "anchored" else {}
            path = tmp_path / f"{name}-{repeat}.json"
            path.write_text(json.dumps({**record, "seconds": 2.0}))
    return report.read(tmp_path)


def entries(table: str) -> dict[str, str]:
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.split("\n")]
    assert len(lines) == 3
    return dict(zip(lines[0], lines[2], strict=True))


def test_errors_are_means_and_spreads_of_the_repeats_and_the_lowest_is_bold(found):
    row = entries(report.errors(found))
    assert row["RMSE"] == "walker, 100 rows, 30 %"
    assert row["anchored"] == f"**0.0850** ± {ANCHORED.std(ddof=1):.4f}"
    assert row["ridge"] == f"0.1150 ± {RIDGE.std(ddof=1):.4f}"
    assert row["ODE-RNN"] == "not run"
    assert (row["trajectories"], row["epochs"], row["repeats"]) == ("500", "4", "4")


def test_repeats_are_pairs_and_a_difference_is_in_percent_of_the_second(found):
    row = entries(report.tests(found))
    p = stats.ttest_rel(ANCHORED, RIDGE).pvalue
    assert row["anchored − ridge"] == f"−26.1 % ({p:.2g})"
    assert row["anchored − GRU"] == "not run"


def test_a_cost_is_that_of_an_epoch_of_a_thousand_windows(found):
    row = entries(report.costs(found))
    assert row["anchored"] == "1"  # 2 s, 4 epochs, 500 windows
    assert row["ridge"] == "4"
