"""Tables of tests: 3.7 and 3.8 of the thesis, and the paired tests that decide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from offbeat import InputError
from offbeat.comparison.statistics import FriedmanResult, shapiro_wilk
from offbeat.tables import MINUS
from thesis.protocol import CONTROLS
from thesis.report import thesis_numbers as thesis
from thesis.report.pairing import FAIR, Pair, Rule
from thesis.report.records import Record
from thesis.report.table import MIXED, Block, Cell, Table
from thesis.report.tables import (
    HEADINGS,
    LAST_VALUE,
    PERCENTS,
    by_fraction,
    label,
    notes,
    percent,
    rmse_of,
)

SCORING_NAMES = {
    "published": "published scoring",
    "honest": "scoring after the first observation",
    "honest_hidden": "masked rows only",
}

_SIGNIFICANT = f"Bold: below the level of significance, {thesis.ALPHA:g}."
_FAIR = (
    "Not self-fed: the thesis' rows without self-feeding, and nothing else changed. Fair: not "
    "self-fed either; they also update at every row, and GRU is "
    "given the time since each channel's last observation."
)
_CAVEAT = (
    "The rule takes the two samples to be independent. The runs share windows and masks within a "
    "repeat, so the paired tests of tables A.3 and A.4 decide."
)


def p_cell(p: float | None, *, n: int | None = None, mark: str = "") -> Cell:
    """A p-value: four digits, or less than the least of them; bold where significant."""
    if p is None:
        return Cell(n=n)
    text = f"{p:.4f}" if p >= 5e-5 else "< 0.0001"
    return Cell(text, p, None, n, bold=p <= thesis.ALPHA, mark=mark)


def normality_table(record: Record) -> Table:
    """Shapiro-Wilk on the test RMSE of each model: table 3.7.

    Args:
        record: its runs of experiment 2.
    """
    blocks = [
        Block(
            HEADINGS["thesis"],
            tuple((label(m), tuple(p_cell(p) for p in ps)) for m, ps in thesis.SHAPIRO_P.items()),
        )
    ]
    for scoring in ("published", "honest"):
        rows = []
        for model in (*thesis.SHAPIRO_P, LAST_VALUE):
            cells = []
            for fraction in thesis.FRACTIONS:
                runs, values = rmse_of(record, model, fraction, scoring)
                try:
                    outcome = shapiro_wilk(values, name=label(model))
                except InputError:
                    cells.append(Cell(n=len(values)))
                    continue
                mark = MIXED if record.mixed(runs) else ""
                cells.append(p_cell(outcome.p, n=len(values), mark=mark))
            rows.append((label(model), tuple(cells)))
        blocks.append(Block(HEADINGS[scoring], tuple(rows)))
    return by_fraction(
        record,
        "3.7",
        "Shapiro-Wilk test of the test RMSE over the repeats: p-values.",
        blocks,
        f"{_SIGNIFICANT} There a normal distribution is rejected.",
    )


def rule_table(record: Record, rules: Mapping[tuple[str, str], Sequence[Rule]]) -> Table:
    """Bartlett, two-sample t and Welch as the thesis chooses them: table 3.8.

    Args:
        record: for the provenance of the runs.
        rules: results of `pairing.thesis_rule`, by first model and scoring.
    """
    names = {"bartlett": "Bartlett", "two_sample_t": "Two-sample t", "welch": "Welch's t"}
    blocks = [
        Block(
            f"{HEADINGS['thesis']}: {label('ode_rnn')} and {label('ode_gru_d')}",
            tuple(
                (names[test], tuple(p_cell(p) for p in ps)) for test, ps in thesis.TEST_P.items()
            ),
        )
    ]
    missing = []
    for (first, scoring), results in rules.items():
        columns = []
        for rule in results:
            if rule.result is None:
                columns.append((Cell(), Cell(), Cell()))
                missing.append(f"{percent(rule.fraction)}: {rule.missing}.")
                continue
            mark = _mixed(record, (first, "ode_gru_d"), rule.fraction)
            chosen = p_cell(rule.result.p, mark=mark)
            pooled = rule.result.test == "two_sample_t"
            columns.append(
                (
                    p_cell(rule.result.bartlett.p, mark=mark),
                    chosen if pooled else Cell(),
                    Cell() if pooled else chosen,
                )
            )
        heading = f"{HEADINGS[scoring]}: {label(first)} and {label('ode_gru_d')}"
        rows = zip(names.values(), zip(*columns, strict=True), strict=True)
        blocks.append(Block(heading, tuple(rows)))
    return by_fraction(
        record,
        "3.8",
        "The thesis' rule on the test RMSE: p-values of Bartlett's test, then of the two-sample t "
        "test where Bartlett's p is above 0.05, else of Welch's.",
        blocks,
        _SIGNIFICANT,
        _CAVEAT,
        thesis.SLIPS["3.8"],
        " ".join(dict.fromkeys(missing)),
        head="Test",
    )


def _mixed(record: Record, models: Sequence[str], fraction: float) -> str:
    runs = [rmse_of(record, m, fraction, "honest")[0] for m in models if m != LAST_VALUE]
    return MIXED if any(record.mixed(rows) for rows in runs) or _differ(record, runs) else ""


def _differ(record: Record, runs: Sequence[object]) -> bool:
    import numpy as np

    return bool(record.mixed(np.concatenate([np.asarray(rows, dtype=np.int64) for rows in runs])))


def paired_table(record: Record, pairs: Sequence[Pair], *, number: str, scoring: str) -> Table:
    """Every number of the paired comparisons of one pair of models.

    Args:
        record: for the provenance of the runs.
        pairs: of one pair of models, at every observed fraction.
        number: of the table.
        scoring: for the caption.
    """
    names = pairs[0].names
    columns: list[tuple[Cell, ...]] = []
    for pair in pairs:
        result = pair.result
        if result is None:
            columns.append((Cell(),) * 8)
            continue
        mark = _mixed(record, (pair.a, pair.b), pair.fraction)
        d, t, g = result.difference, result.difference_t, result.hedges_g
        columns.append(
            (
                Cell(f"{result.runs}", result.runs, n=result.runs),
                Cell(signed(d.value), d.value, n=result.runs, bold=pair.significant, mark=mark),
                _interval(t.low, t.high),
                _interval(d.low, d.high),
                p_cell(pair.t_holm, n=result.runs, mark=mark),
                p_cell(pair.wilcoxon_holm, n=result.runs, mark=mark),
                Cell(signed(g.value, 2), g.value, n=result.runs),
                _interval(g.low, g.high, digits=2),
            )
        )
    labels = (
        "Repeats",
        "Mean difference",
        "95 % interval, Student",
        "95 % interval, bootstrap",
        "Paired t, p (Holm)",
        "Wilcoxon, p (Holm)",
        "Hedges' g",
        "95 % interval of g",
    )
    block = Block(names, tuple(zip(labels, zip(*columns, strict=True), strict=True)))
    missing = [f"{percent(p.fraction)}: {p.missing}." for p in pairs if p.missing]
    return Table(
        number,
        f"{names}, paired: difference of the test RMSE within a repeat, {SCORING_NAMES[scoring]}.",
        "",
        tuple(percent(p.fraction) for p in pairs),
        (block,),
        notes(
            record,
            [block],
            f"{_SIGNIFICANT} Negative: {label(pairs[0].a)} is better. p-values are corrected over "
            "the observed fractions.",
            " ".join(missing),
        ),
    )


def family_table(
    record: Record, families: Mapping[str, Sequence[Pair]], *, number: str, caption: str
) -> Table:
    """Mean paired differences with corrected p, one row per pair of models.

    Args:
        record: for the provenance of the runs.
        families: by heading; each corrected on its own.
        number: of the table.
        caption: of the table.
    """
    blocks, missing = [], []
    for heading, pairs in families.items():
        rows = []
        for key in dict.fromkeys((p.a, p.b) for p in pairs):
            mine = {p.fraction: p for p in pairs if (p.a, p.b) == key}
            rows.append(
                (
                    next(iter(mine.values())).names,
                    tuple(_pair_cell(record, mine[f]) for f in thesis.FRACTIONS),
                )
            )
        missing += [p.missing for p in pairs if p.missing]
        blocks.append(Block(heading, tuple(rows)))
    return by_fraction(
        record,
        number,
        caption,
        blocks,
        f"In brackets p of the paired t test, corrected by Holm within a block. Bold: p ≤ "
        f"{thesis.ALPHA:g}. Negative: the first is better.",
        _FAIR
        if all({p.a, p.b} & {*CONTROLS, *FAIR} for ps in families.values() for p in ps)
        else "",
        f"Pairs without a number lack runs ({len(missing)})." if missing else "",
        head=f"First {MINUS} second",
    )


def _pair_cell(record: Record, pair: Pair) -> Cell:
    if pair.result is None or pair.t_holm is None:
        return Cell(n=0)
    value = pair.result.difference.value
    text = f"{signed(value)} ({p_cell(pair.t_holm).text})"
    mark = _mixed(record, (pair.a, pair.b), pair.fraction)
    return Cell(text, value, None, pair.result.runs, bold=pair.significant, mark=mark)


def ranks_table(
    results: Mapping[float, FriedmanResult | str], *, number: str, scoring: str
) -> Table:
    """Average ranks over the repeats, Friedman's test and Nemenyi's critical difference.

    Args:
        results: of `pairing.ranks`.
        number: of the table.
        scoring: for the caption.
    """
    tested = {f: r for f, r in results.items() if isinstance(r, FriedmanResult)}
    models = list(dict.fromkeys(name for r in tested.values() for name in r.names))
    rows = []
    for model in models:
        cells = []
        for fraction in thesis.FRACTIONS:
            result = tested.get(fraction)
            if result is None or model not in result.names:
                cells.append(Cell())
                continue
            rank = result.average_ranks[result.names.index(model)]
            best = rank == min(result.average_ranks)
            cells.append(Cell(f"{rank:.2f}", rank, n=result.blocks, bold=best))
        rows.append((label(model), tuple(cells)))
    friedman_row, difference_row = [], []
    for fraction in thesis.FRACTIONS:
        result = tested.get(fraction)
        friedman_row.append(
            Cell() if result is None else p_cell(result.friedman.p, n=result.blocks)
        )
        cd = None if result is None else result.critical_difference
        difference_row.append(Cell() if cd is None else Cell(f"{cd:.2f}", cd))
    blocks = [
        *([Block("Average rank", tuple(rows))] if rows else []),
        Block(
            "Test",
            (
                ("Friedman, p", tuple(friedman_row)),
                ("Critical difference, Nemenyi", tuple(difference_row)),
            ),
        ),
    ]
    reasons = [f"{percent(f)}: {r}." for f, r in results.items() if isinstance(r, str)]
    return Table(
        number,
        f"Ranks of the models over the repeats by test RMSE, {SCORING_NAMES[scoring]}.",
        "Model",
        PERCENTS,
        tuple(blocks),
        tuple(
            filter(
                None,
                [
                    "Rank 1 is the lowest error of a repeat. Bold: the best rank, and p-values "
                    f"below {thesis.ALPHA:g}. Ranks that differ by less than the critical "
                    "difference do not differ significantly.",
                    " ".join(reasons),
                ],
            )
        ),
    )


def signed(value: float, digits: int = 5) -> str:
    """A difference with its sign."""
    return f"{value:+.{digits}f}".replace("-", MINUS)


def _interval(low: float | None, high: float | None, digits: int = 5) -> Cell:
    if low is None or high is None:
        return Cell()
    return Cell(f"[{signed(low, digits)}, {signed(high, digits)}]")
