"""The answers of a record as a short Markdown document, from the results that the page shows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from offbeat.tables import DASH, markdown
from thesis.protocol import CONTROLS
from thesis.report import findings as say
from thesis.report import thesis_numbers as thesis
from thesis.report.circumstances import machine_rows, time_rows
from thesis.report.contents import Contents
from thesis.report.pairing import FAIR, FAMILIES, MODELS, ODE, PLAIN, Pair
from thesis.report.records import Record
from thesis.report.table import Table
from thesis.report.tables import PERCENTS, label, rmse_of
from thesis.report.tables_beyond import constant_of
from thesis.report.tables_tests import p_cell, signed

REPRODUCE = "python -m thesis run --out runs/thesis"
FOLDER = "runs/thesis"
REPORT = f"python -m thesis report {FOLDER} --out runs/report"
DOCUMENT = f"{REPORT} --summary docs/reproduction.md"

_OURS = "ode_gru_d"

_INFERRED = (
    "That the thesis' scores contain the observed row 0, zero where it is masked (the constant c): "
    "its code and data are not public. The evidence is that its numbers come out, and that they "
    "grow nearly linearly with the masked fraction.",
    "That its GRU and GRU-D were fed their own predictions at half of the rows "
    "(`self_feeding=0.5`): a public code base of that time does so with plain recurrent models "
    "and not with ODE models; how near the thesis' rows come out with it is table A.1, and that "
    "its random draws alone spread scores as the thesis' repeats do is measured in "
    "`docs/reproduce.md`.",
    "Which constant its own draw of initial states had: table A.1 gives the one that each cell "
    "would need; what other draws have is measured in `docs/reproduce.md`.",
    "Everything else that its text leaves open is settled in `docs/deviations.md`.",
)


def summary(contents: Contents) -> str:
    """The document, whole.

    Args:
        contents: tables, figures and findings.
    """
    parts = [
        "# The thesis, reproduced: what holds",
        _top(contents),
        *_conclusions(contents),
        *_distances(contents),
        *_constant(contents),
        *_self_feeding(contents),
        *_differences(contents),
        *_convergence(contents),
        *_stability(contents),
        *_made(contents),
    ]
    text = "\n\n".join(filter(None, parts)) + "\n"
    return text.replace(REPORT, REPORT.replace(FOLDER, contents.record.folder or FOLDER))


# --- parts ----------------------------------------------------------------------------------------


def _top(contents: Contents) -> str:
    there, asked = contents.progress
    lines = [f"**{there} of {asked} runs.**"]
    if there < asked:
        lines.append(
            f"What needs the other {asked - there} is left open: it reads '{say.MISSING}' or "
            f"'{DASH}'. {_missing(contents)}"
        )
    warnings = f"{' '.join(contents.warnings)}\n\n" if contents.warnings else ""
    return (
        f"{' '.join(lines)}\n\n{warnings}"
        f"Made by `{DOCUMENT}` from the results that `report.html` shows, and not edited. Test "
        "errors in the thesis' scaled units. *Published scoring* is the thesis' own; *scoring "
        "after the first observation* counts the rows after the first observed one of their "
        "trajectory, and columns of the record call it `honest`. Paired tests compare "
        "models within a repeat, where they share windows, masks and split; p is corrected "
        f"by Holm within a family of comparisons, and {thesis.ALPHA:g} is the level."
    )


def _missing(contents: Contents) -> str:
    """Runs that are not there, named by experiment, model and fraction."""
    record, said = contents.record, []
    for experiment, models, asked in ((1, thesis.MODELS, 1), (2, MODELS, contents.repeats)):
        lacking = dict[str, str]()
        for model in models:
            there = [
                len(record.where(experiment=experiment, model=model, fraction=f))
                for f in thesis.FRACTIONS
            ]
            if min(there) < asked:
                lacking[label(model)] = ", ".join(map(str, there)) if any(there) else "none"
        if lacking:
            said.append(f"Experiment {experiment}, of {asked} each: {_grouped(lacking)}.")
    return f"Runs that are there, at {', '.join(PERCENTS)}. {' '.join(said)}" if said else ""


def _conclusions(contents: Contents) -> Iterable[str]:
    yield "## Conclusions of the thesis"
    rows = []
    for finding in contents.findings:
        by = {name: _verdict(v) for name, v in finding.verdicts.items()}
        if set(by) == set(say.SCORINGS.values()):
            rows.append((finding.claim, finding.source, *by.values()))
            continue
        scored: dict[str, list[str]] = {shown: [] for shown in say.SCORINGS.values()}
        for name, words in by.items():
            for shown, mine in scored.items():
                if name.startswith(shown):
                    mine.append(f"{name.removeprefix(shown).strip(', ')}: {words}")
        if any(scored.values()):
            rows.append((finding.claim, finding.source, *map("; ".join, scored.values())))
        else:  # judged per model, under scoring after the first observation
            rows.append((finding.claim, finding.source, DASH, _grouped(by)))
    yield _grid(("Claim", "Source", *say.SCORINGS.values()), rows)
    yield (
        "Verdicts follow from paired tests; 'the thesis' rule' is its own choice of tests, which "
        "takes the runs to be independent. 'Not decided': no test is significant, which "
        f"does not prove equality.{contents.caution}"
    )
    yield _source("the section 'What holds' of `report.html`, with every difference and p")


def _distances(contents: Contents) -> Iterable[str]:
    yield "## How far table 3.6 is"
    yield _embedded(contents.tables["3.6"])
    yield _embedded(contents.tables["A.1"])
    yield _source("`tables/table-3-6.csv`, `tables/table-a-1.csv`")


def _constant(contents: Contents) -> Iterable[str]:
    yield "## What the constant of the first row does"
    record = contents.record
    alone, part, inferred = list[str](), list[str](), list[str]()
    ours, spread, printed = list[str](), list[str](), list[str]()
    for i, fraction in enumerate(thesis.FRACTIONS):
        mean, std = thesis.TEST_RMSE[_OURS][i]
        printed.append(f"{std:.4f}")
        c, _, parts = constant_of(record, fraction)
        inferred.append(
            _percent(float(c.mean()) * (1 - fraction) / 100 / mean**2) if len(c) else DASH
        )
        alone.append(f"{np.sqrt(parts.mean()):.4f}" if len(parts) else DASH)
        runs, rmse = rmse_of(record, _OURS, fraction, "published")
        part.append(_percent(float(np.mean(_own(record, runs) / rmse**2))) if len(runs) else DASH)
        ours.append(f"{rmse.std(ddof=1):.4f}" if len(runs) > 1 else DASH)
        alone_spread = _spread_of_constant(record, fraction)
        spread.append(DASH if alone_spread is None else f"{alone_spread:.4f}")
    name = label(_OURS)
    yield _grid(
        ("", *PERCENTS),
        [
            ("Published RMSE of a model without any other error", *alone),
            (f"Its fraction of the published MSE of {name}, ours", *part),
            (f"Its fraction of the squared RMSE of {name} in the thesis (inferred)", *inferred),
            (f"Standard deviation over repeats of the RMSE of {name}, ours", *ours),
            ("The same, if nothing but the constant varied", *spread),
            (f"Standard deviation of {name} in the thesis", *printed),
        ],
    )
    yield (
        "No causal model can change this part: row 0 is scored before anything can be known of it. "
        "It is the same for all models of a repeat: it cancels in paired differences of the MSE, "
        "and it moves ratios of errors towards 1."
    )
    yield _source("`record.csv`: `row_0_constant`, `hidden_rows_0_share`, `published_mse`")


def _own(record: Record, runs: NDArray[np.int64]) -> NDArray[np.float64]:
    """The part of the published MSE of each run that row 0 makes."""
    own: NDArray[np.float64] = record.values("row_0_constant", runs).astype(float) / 100
    own *= record.values("hidden_rows_0_share", runs).astype(float)
    return own


def _spread_of_constant(record: Record, fraction: float) -> float | None:
    """Standard deviation of the published RMSE over repeats, if only the constant varied."""
    runs, rmse = rmse_of(record, _OURS, fraction, "published")
    if len(runs) < 2:
        return None
    own = _own(record, runs)
    return float(np.sqrt(float((rmse**2 - own).mean()) + own).std(ddof=1))


def _against_the_constant(record: Record) -> str:
    """Whether the spread of the thesis' repeats leaves room for the constant, at each fraction."""
    more, less = list[str](), list[str]()
    for i, fraction in enumerate(thesis.FRACTIONS):
        spread = _spread_of_constant(record, fraction)
        if spread is not None:
            (more if spread > thesis.TEST_RMSE[_OURS][i][1] else less).append(PERCENTS[i])
    name = label(_OURS)
    said = (
        "Against it: the constant alone makes our repeats spread more than the thesis prints for "
        f"{name} at {', '.join(more)}."
        if more
        else ""
    )
    if more and less:
        said += f" At {', '.join(less)} it makes them spread less."
    return said


def _self_feeding(contents: Contents) -> Iterable[str]:
    yield "## What self-feeding does, and what is left of the ODE models' advantage"
    for scoring, shown in say.SCORINGS.items():
        fed = _by_key(contents, "self_feeding", scoring)
        plain = _by_key(contents, "against_plain", scoring)
        fair = _by_key(contents, "against_fair", scoring)
        rows = []
        for a, b in FAMILIES["self_feeding"]:
            cells = [_difference(fed[a, b, f]) for f in thesis.FRACTIONS]
            rows.append((f"{label(a)} minus {label(b)} (p)", *cells))
        for ode in ODE:
            for simple, rival in zip((*PLAIN, *PLAIN), (*CONTROLS, *FAIR), strict=True):
                cells = [
                    _left(plain[ode, simple, f], fair[ode, rival, f]) for f in thesis.FRACTIONS
                ]
                rows.append(
                    (f"{label(ode)} minus {label(rival)}, of that minus {label(simple)}", *cells)
                )
        yield _grid((f"RMSE, {shown.lower()}", *PERCENTS), rows)
    yield (
        "The rows of the ODE models: the mean difference from the other model, and in brackets how "
        "much it is of the difference from the thesis' row; below zero, the other model has the "
        "lower error. Bold: significant by the paired t test after Holm. The models that are not "
        "self-fed are the thesis' rows without self-feeding, and nothing else is changed: their "
        "rows show what it does by itself. The fair models also update at every row, and GRU is "
        "given the time since each channel's last observation."
    )
    yield _source("`tables/table-a-6.csv`, `tables/table-a-7.csv`, `tables/table-a-8.csv`")


def _differences(contents: Contents) -> Iterable[str]:
    yield "## Which differences are significant"
    rows = []
    for name, keys in FAMILIES.items():
        pairs = _by_key(contents, name, "honest")
        for a, b in keys:
            cells = [_difference(pairs[a, b, f]) for f in thesis.FRACTIONS]
            rows.append((f"{label(a)} minus {label(b)}", *cells))
    yield _grid(("RMSE, scoring after the first observation", *PERCENTS), rows)
    tested = [p for name in FAMILIES for p in contents.families[name, "honest"] if p.result]
    asked = sum(len(contents.families[name, "honest"]) for name in FAMILIES)
    if len(tested) < asked:
        yield f"{len(tested)} of {asked} comparisons can be made yet; the others lack runs."
    if tested:
        significant = sum(p.significant for p in tested)
        yield (
            f"Of {len(tested)} comparisons, {significant} are significant (bold), on this robot "
            f"and protocol. The other {len(tested) - significant} are not decided."
        )
    yield (
        "The anchored model has another size, optimizer and rate than the models of the thesis, "
        "and is compared as a whole. Self-feeding acts on GRU and GRU-D alone."
    )
    yield _source("`tables/table-a-3.csv` to `tables/table-a-10.csv`, with intervals and Wilcoxon")


def _convergence(contents: Contents) -> Iterable[str]:
    yield "## Convergence"
    yield from _verdicts(contents, "2", evidence=True)
    yield _embedded(contents.tables["A.12"])
    yield from _verdicts(contents, "3.2", evidence=False)
    yield _embedded(contents.tables["A.13"])
    yield _source("`tables/table-a-12.csv`, `tables/table-a-13.csv`; curves in `curves.csv`")


def _verdicts(contents: Contents, number: str, *, evidence: bool) -> Iterable[str]:
    (finding,) = [f for f in contents.findings if f.claim == thesis.CONCLUSIONS[number]]
    yield f"### {finding.claim.rstrip('.')}?"
    for shown, verdict in finding.verdicts.items():
        yield f"{shown}: **{_verdict(verdict)}**."
        if evidence and not (verdict.word == say.MISSING and verdict.count.startswith("0 of")):
            yield "\n".join(f"- {sentence}" for sentence in verdict.evidence)


def _stability(contents: Contents) -> Iterable[str]:
    yield "## Stability"
    for scoring, shown in say.SCORINGS.items():
        by = {(one.model, one.fraction): one for one in contents.spreads[scoring]}
        rows = []
        for model in MODELS:
            if model == _OURS:
                continue
            cells = []
            for fraction in thesis.FRACTIONS:
                one = by[model, fraction]
                if one.result is None or one.p is None:
                    cells.append(DASH)
                    continue
                ratio = one.result.ratio
                ends = "" if ratio.low is None else f" [{ratio.low:.2f}, {ratio.high:.2f}]"
                cells.append(_bold(f"{ratio.value:.2f}{ends} ({_p(one.p)})", one.p <= thesis.ALPHA))
            rows.append((label(model), *cells))
        yield _grid((f"{shown}, against", *PERCENTS), rows)
    yield (
        f"Standard deviation of the test RMSE of {label(_OURS)} over that of the other model; "
        "below 1 it is the steadier. In brackets p of Pitman and Morgan's test for pairs after "
        "Holm; bold where it is significant. Intervals are bootstrap and, from ten runs, too "
        "short."
    )
    yield _source("`tables/table-a-11.csv`")


def _made(contents: Contents) -> Iterable[str]:
    record, circumstances = contents.record, contents.circumstances
    yield "## What is inferred about the thesis"
    against = _against_the_constant(record)
    first, *others = _INFERRED
    yield "\n".join(f"- {s}" for s in (f"{first} {against}".strip(), *others))
    yield "## How it was made"
    typed = circumstances.commands or (REPRODUCE,)
    yield "```\n" + "\n".join(dict.fromkeys((*typed, DOCUMENT))) + "\n```"
    if any(line.startswith("offbeat reproduce") for line in typed):
        yield "`offbeat reproduce` is the name that `python -m thesis run` had in version 0.1.0."
    yield (
        "One run again: `python -m thesis run --out runs/again --only "
        "experiment=2,model=ode_rnn,fraction=0.3,repeat=0`; its seeds are in the record "
        "(`seed_draw`, `seed_weights`)."
    )
    yield _grid(
        ("", ""),
        [*time_rows(record, circumstances), *machine_rows(record, circumstances)],
    )


# --- words ----------------------------------------------------------------------------------------


def _verdict(verdict: say.Verdict) -> str:
    return f"{verdict.word} ({verdict.count})" if verdict.count else verdict.word


def _grouped(words: Mapping[str, str]) -> str:
    """Names with the same text, joined."""
    names = dict[str, list[str]]()
    for name, said in words.items():
        names.setdefault(said, []).append(name)
    return "; ".join(f"{', '.join(each)}: {said}" for said, each in names.items())


def _by_key(contents: Contents, name: str, scoring: str) -> dict[tuple[str, str, float], Pair]:
    return {(p.a, p.b, p.fraction): p for p in contents.families[name, scoring]}


def _difference(pair: Pair) -> str:
    if pair.result is None or pair.t_holm is None:
        return DASH
    value = signed(pair.result.difference.value)
    return _bold(f"{value} ({_p(pair.t_holm)})", pair.significant)


def _left(plain: Pair, fair: Pair) -> str:
    """The difference from the fair model, and how much of that from the thesis' row it is."""
    if plain.result is None or fair.result is None:
        return DASH
    value = fair.result.difference.value
    part = _percent(value / plain.result.difference.value) if plain.better else DASH
    return _bold(f"{signed(value)} ({part})", fair.significant)


def _percent(value: float) -> str:
    return f"{100 * value:.0f}\N{THIN SPACE}%".replace("-", "\N{MINUS SIGN}")


def _p(p: float) -> str:
    return p_cell(p).text


def _bold(text: str, bold: bool) -> str:
    return f"**{text}**" if bold else text


def _grid(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    rows = list(rows)
    if all(cell == DASH for row in rows for cell in row[1:]):
        return f"{head[0]}: {say.MISSING}, runs are missing."
    return markdown(head, rows)


def _embedded(table: Table) -> str:
    if all(c.value is None for block in table.blocks for _, cells in block.rows for c in cells):
        return f"Table {table.number}: {say.MISSING}, runs are missing."
    return table.to_markdown().strip()


def _source(what: str) -> str:
    return f"*`{REPORT}`: {what}.*"
