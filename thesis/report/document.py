"""The order of the page, and the sentences between its parts."""

from __future__ import annotations

from thesis.report import page
from thesis.report import thesis_numbers as thesis
from thesis.report.circumstances import machine_rows, time_rows
from thesis.report.contents import Contents
from thesis.report.tables_beyond import constant_residual

TITLE = "ODE-GRU-D on irregularly sampled robot motion: the thesis, reproduced"

_REPRODUCE = "python -m thesis run --out runs/thesis"
_REPORT = "python -m thesis report {} --out runs/report"

_ROUNDING = 1e-5
"""Scores are sums in single precision."""

_SCORINGS = (
    (
        "Published",
        "All rows of a window; the prediction of row 0 is the observed row 0, or zero "
        "where it is masked. It is what the thesis reports; that it scores so is inferred from its "
        "numbers.",
    ),
    (
        "After the first observation",
        "The rows after the first observed row of their trajectory, observed or masked. "
        "Before it nothing has been seen, and the best prediction of any model is the mean. "
        "Columns of the record call it honest.",
    ),
    ("Masked rows only", "Of these the rows that the model was not shown."),
    (
        "Last value",
        "A predictor that repeats the last observed row; before the first one, the "
        "training mean. It needs no training.",
    ),
    (
        "Units",
        "Errors are in the thesis' scaled units: (x - min) / max per channel, over all data, "
        "test part included.",
    ),
)


def document(contents: Contents) -> str:
    """The whole page as HTML.

    Args:
        contents: tables, figures and findings.
    """
    return page.page(
        TITLE,
        _lead(contents),
        [
            _findings(contents),
            _epochs(contents),
            _repeats(contents),
            _tests(contents),
            _beyond(contents),
            _pictures(contents),
            _method(contents),
        ],
        top=page.warning((*contents.warnings, *contents.missing)),
        foot="Made by python -m thesis report. The page needs no network; the files beside it hold "
        "each table as CSV, Markdown and LaTeX, and each figure as PNG and PDF.",
    )


def _lead(contents: Contents) -> str:
    shown, full = contents.progress
    return (
        f"{shown} of {full} runs. Every table of the Master's thesis beside our numbers under its "
        "own scoring and under scoring after the first observation, beside the predictor that "
        "repeats the last observed value."
    )


def _findings(contents: Contents) -> tuple[str, str, str]:
    return page.section(
        "findings",
        "What holds",
        page.paragraph(
            "Published scoring is what the thesis reports, with the constant that the first row of "
            "a window adds. Scoring after the first observation counts the rows after the first "
            "observed one."
        ),
        page.paragraph(
            "Each verdict follows from tests of this record; unfold it for the numbers. "
            f"Differences are first minus second, of the test RMSE; significance at "
            f"{thesis.ALPHA:g}. 'Not decided' means that no test is significant, which does not "
            "prove equality; 'cannot be decided yet', that runs are missing."
            f"{contents.caution}"
        ),
        *map(page.finding, contents.findings),
    )


def _epochs(contents: Contents) -> tuple[str, str, str]:
    return page.section(
        "epochs",
        "Experiment 1: epochs",
        *_tables(contents, *thesis.CURVE_TABLES.values(), "3.5"),
        _narrow(contents, *thesis.CURVE_FIGURES.values()),
    )


def _repeats(contents: Contents) -> tuple[str, str, str]:
    residual = constant_residual(contents.record)
    return page.section(
        "repeats",
        "Experiment 2: repeats",
        *_tables(contents, "3.6", "A.1"),
        page.paragraph(
            "The published MSE is 0.99 times the MSE of rows 1 to 99, plus c times the "
            "fraction of masked rows 0 over 100, which no causal model can change. In every "
            f"run of this record the two agree to a relative error of at most {residual:.0e}."
            if residual > _ROUNDING
            else "The published MSE is 0.99 times the MSE of rows 1 to 99, plus c times the "
            "fraction of masked rows 0 over 100, which no causal model can change. This holds "
            "in every run of this record, up to rounding."
        ),
        _narrow(contents, *thesis.BOX_FIGURES.values()),
        *_tables(contents, "A.2"),
    )


def _tests(contents: Contents) -> tuple[str, str, str]:
    ranked = [contents.pictures["A.1"]] if "A.1" in contents.pictures else []
    return page.section(
        "tests",
        "Tests",
        *_tables(contents, "3.7", "3.8", "A.3", "A.4", "A.5"),
        *map(page.picture, ranked),
    )


def _beyond(contents: Contents) -> tuple[str, str, str]:
    return page.section(
        "beyond",
        "Beyond the thesis",
        *_tables(contents, "A.6", "A.7", "A.8", "A.9", "A.10", "A.11", "A.12", "A.13"),
    )


def _pictures(contents: Contents) -> tuple[str, str, str]:
    there = [contents.pictures[n] for n in ("3.1", "3.2", "2.5", "A.2") if n in contents.pictures]
    return page.section(
        "states",
        "Data and hidden states",
        *map(page.picture, there),
        ""
        if there
        else page.paragraph("These figures are not there; the top of the page says why."),
    )


def _method(contents: Contents) -> tuple[str, str, str]:
    record = contents.record
    report = _REPORT.format(record.folder or "runs/thesis")
    return page.section(
        "method",
        "How it was made",
        "<h3>Scorings</h3>",
        page.definitions(_SCORINGS),
        "<h3>Commands</h3>",
        ""
        if contents.circumstances.commands
        else page.paragraph(
            "The folder of the record does not hold what was typed; the full protocol is run by:"
        ),
        page.commands((*(contents.circumstances.commands or (_REPRODUCE,)), report)),
        "<h3>Time</h3>",
        page.definitions(time_rows(record, contents.circumstances)),
        *_tables(contents, "A.14", "A.15"),
        '<h3 id="provenance">Machine and versions</h3>',
        page.definitions(machine_rows(record, contents.circumstances)),
    )


def _tables(contents: Contents, *numbers: str) -> list[str]:
    return [page.table(contents.tables[number]) for number in numbers]


def _narrow(contents: Contents, *numbers: str) -> str:
    return page.side_by_side([contents.pictures[n] for n in numbers if n in contents.pictures])
