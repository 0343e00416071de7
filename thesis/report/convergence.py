"""How many epochs a model takes, which the thesis judges by eye, measured on every run."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from offbeat import InputError
from offbeat.comparison.statistics import convergence, enough_epochs, paired_comparison, settling
from thesis.report import findings as say
from thesis.report import thesis_numbers as thesis
from thesis.report.findings import Verdict
from thesis.report.pairing import MODELS, Pair, corrected, too_few
from thesis.report.records import Record
from thesis.report.table import MIXED, Block, Cell, Table
from thesis.report.tables import COUNTED, by_fraction, label, percent
from thesis.report.tables_tests import signed

_OURS, _OTHER = "ode_gru_d", "ode_rnn"
TOLERANCE = 0.05
"""A run has settled when its validation MSE stays within this of its final one."""
_NEAR = f"{100 * TOLERANCE:g}\N{THIN SPACE}%"


def curves_of(
    record: Record, experiment: int, model: str, fraction: float, scoring: str
) -> dict[int, NDArray[np.float64]]:
    """(epochs,) validation MSE of each run that has a whole curve, by repeat; thesis' units."""
    rows = record.where(experiment=experiment, model=model, fraction=fraction)
    found = {}
    for name, repeat in zip(
        record.values("run_id", rows), record.values("repeat", rows), strict=True
    ):
        curve = record.curve(str(name))
        if len(curve["epoch"]) and (np.diff(curve["epoch"], prepend=0) == 1).all():
            found[int(repeat)] = curve[f"validation_{scoring}_mse"]
    return found


def speed_pairs(record: Record, scoring: str) -> tuple[Pair, ...]:
    """ODE-GRU-D against ODE-RNN, paired: epochs until a run of experiment 2 has settled."""
    pairs = []
    for fraction in thesis.FRACTIONS:
        ours, other = (curves_of(record, 2, model, fraction, scoring) for model in (_OURS, _OTHER))
        shared = sorted(ours.keys() & other.keys())
        a, b = (
            [settling(curves[r], tolerance=TOLERANCE).settled for r in shared]
            for curves in (ours, other)
        )
        pair = Pair(
            _OURS, _OTHER, fraction, scoring, measure="epochs", missing=too_few(len(shared))
        )
        if pair.missing:
            pairs.append(pair)
            continue
        if a == b:
            why = f"they need the same epochs in all {len(shared)} repeats"
            pairs.append(replace(pair, missing=why, tied=True))
            continue
        try:
            result = paired_comparison(a, b, names=(label(_OURS), label(_OTHER)))
            pairs.append(replace(pair, result=result))
        except InputError as error:
            pairs.append(replace(pair, missing=str(error)))
    return corrected(pairs)


def speed_verdicts(record: Record) -> dict[str, Verdict]:
    """Does ODE-GRU-D converge in fewer epochs than ODE-RNN?"""
    verdicts = {}
    for scoring, shown in say.SCORINGS.items():
        verdict = say.all_better(speed_pairs(record, scoring))
        once = []
        for fraction in thesis.FRACTIONS:
            curves = [curves_of(record, 1, m, fraction, scoring) for m in (_OURS, _OTHER)]
            if all(0 in mine for mine in curves):
                ours, other = (settling(c[0], tolerance=TOLERANCE).settled for c in curves)
                once.append(f"{percent(fraction)}: {ours} and {other}")
        said = [*_trends(record, scoring), *_overtaking(record, scoring)]
        if once:
            said.append(
                f"In experiment 1, one run each, {label(_OURS)} and {label(_OTHER)} settle at "
                f"these epochs: {'; '.join(once)}."
            )
        verdicts[shown] = replace(verdict, evidence=(*verdict.evidence, *said))
    return verdicts


def _trends(record: Record, scoring: str) -> list[str]:
    """How much the errors of experiment 2 still change at their end, in a sentence."""
    said = []
    for fraction in thesis.FRACTIONS:
        parts = []
        for model in (_OURS, _OTHER):
            curves = curves_of(record, 2, model, fraction, scoring).values()
            trends = [settling(curve).trend for curve in curves]
            if trends and np.isfinite(trends).all():
                parts.append(f"{label(model)} {signed(100 * float(np.mean(trends)), 2)}")
        if len(parts) == 2:
            said.append(f"{percent(fraction)}: {' and '.join(parts)}")
    if not said:
        return []
    return [
        "Percent by which the error changes per epoch over the last 10, mean over the repeats: "
        f"{'; '.join(said)}. Where it still falls, the epoch says when training was stopped, not "
        "when the model had converged."
    ]


def _overtaking(record: Record, scoring: str) -> list[str]:
    """A sentence on the epoch at which ODE-GRU-D reaches the final error of ODE-RNN."""
    said = []
    for fraction in thesis.FRACTIONS:
        ours, other = (curves_of(record, 2, model, fraction, scoring) for model in (_OURS, _OTHER))
        shared = sorted(ours.keys() & other.keys())
        there = [ours[r] <= other[r][-1] for r in shared]
        epochs = [int(one.argmax()) + 1 for one in there if one.any()]
        if shared:
            when = f", median epoch {np.median(epochs):g}" if epochs else ""
            said.append(f"{percent(fraction)}: in {len(epochs)} of {len(shared)} repeats{when}")
    if not said:
        return []
    return [
        f"{label(_OURS)} is at some epoch as good as {label(_OTHER)} at the end of the same "
        f"repeat, by validation error, at {'; '.join(said)}."
    ]


@dataclass(frozen=True)
class Choice:
    """Whether the thesis' number of epochs follows from one curve of experiment 1.

    Attributes:
        model: label.
        fraction: observed fraction of the rows.
        chosen: epochs that the thesis chose.
        epochs: length of the curve; 0 without one.
        ratio: error after the chosen epochs over the final one.
        reached: first epoch at which the curve is within the tolerance of its end.
        settled: epoch from which on it stays so.
        missing: why there is nothing to say.
    """

    model: str
    fraction: float
    chosen: int
    epochs: int = 0
    ratio: float = float("nan")
    reached: int = 0
    settled: int = 0
    missing: str = ""

    @property
    def follows(self) -> bool:
        """The curve has settled by the chosen epoch."""
        return not self.missing and self.settled <= self.chosen


def choices(record: Record, scoring: str) -> tuple[Choice, ...]:
    """Holds the thesis' 75 and 50 epochs against each curve of experiment 1."""
    found = []
    for fraction, chosen in thesis.CHOSEN_EPOCHS.items():
        for model in thesis.MODELS:
            one = Choice(model, fraction, chosen)
            curve = curves_of(record, 1, model, fraction, scoring).get(0)
            if curve is None:
                found.append(replace(one, missing="there is no curve of experiment 1"))
                continue
            try:
                enough = enough_epochs([curve], chosen, tolerance=TOLERANCE)
            except InputError as error:
                found.append(replace(one, missing=str(error)))
                continue
            found.append(
                replace(
                    one,
                    epochs=len(curve),
                    ratio=enough.ratios[0],
                    reached=settling(curve, tolerance=TOLERANCE).reached,
                    settled=enough.settled[0],
                )
            )
    return tuple(found)


def enough_verdicts(record: Record) -> dict[str, Verdict]:
    """Do 75 and 50 epochs follow from the curves of experiment 1?"""
    verdicts = {}
    for scoring, shown in say.SCORINGS.items():
        found = choices(record, scoring)
        tested = [one for one in found if not one.missing]
        right = sum(one.follows for one in tested)
        verdicts[shown] = say.judged(
            len(found), len(tested), right, len(tested) - right, [_choice(one) for one in found]
        )
    return verdicts


def _choice(one: Choice) -> str:
    at = f"At {percent(one.fraction)}, {label(one.model)}"
    if one.missing:
        return f"{at}: {one.missing}."
    return (
        f"{at}: after {one.chosen} epochs the error is {one.ratio:.2f} times that after "
        f"{one.epochs}; it is within {_NEAR} for the first time at epoch {one.reached}, and stays "
        f"so from epoch {one.settled} on."
    )


def choice_table(record: Record, *, number: str) -> Table:
    """Whether 75 and 50 epochs follow from the curves of experiment 1."""
    blocks = []
    for scoring, shown in say.SCORINGS.items():
        by = {(one.model, one.fraction): one for one in choices(record, scoring)}
        rows = []
        for model in thesis.MODELS:
            cells = []
            for fraction in thesis.FRACTIONS:
                one = by[model, fraction]
                runs = record.where(experiment=1, model=model, fraction=fraction)
                if one.missing:
                    cells.append(Cell(n=0))
                    continue
                text = f"{one.ratio:.2f} ({one.reached}, {one.settled})"
                mark = MIXED if record.mixed(runs) else ""
                cells.append(Cell(text, one.ratio, n=1, bold=one.follows, mark=mark))
            rows.append((label(model), tuple(cells)))
        blocks.append(Block(shown, tuple(rows)))
    chosen = ", ".join(f"{n} at {percent(f)}" for f, n in thesis.CHOSEN_EPOCHS.items())
    return by_fraction(
        record,
        number,
        "Validation error of experiment 1 after the epochs that the thesis chose, over that at the "
        f"end; in brackets the epoch at which it is within {_NEAR} of its end for the first time, "
        "and from which on it stays so.",
        blocks,
        f"Chosen: {chosen}. Bold: the curve has settled by then. One run each: a last epoch "
        "that happens to be good makes all before it look worse.",
    )


def speed_table(record: Record, *, number: str) -> Table:
    """Epochs until a run has settled, over the repeats and in experiment 1."""
    blocks = []
    for experiment, models in ((2, MODELS), (1, thesis.MODELS)):
        for scoring, shown in say.SCORINGS.items():
            rows = []
            for model in models:
                cells = [_settled(record, experiment, model, f, scoring) for f in thesis.FRACTIONS]
                rows.append((label(model), tuple(cells)))
            blocks.append(Block(f"Experiment {experiment}, {shown.lower()}", tuple(rows)))
    return by_fraction(
        record,
        number,
        f"Epochs until the validation MSE stays within {100 * TOLERANCE:g}\N{THIN SPACE}% of the "
        "run's final one: mean over the repeats with a 95 % bootstrap interval, and the single run "
        "of experiment 1.",
        blocks,
        "A run of experiment 2 is compared with its own end, at 75 or 50 epochs, where its "
        "error may still be falling: then the epoch says when training was stopped.",
        _diluted(record),
        COUNTED,
    )


def _diluted(record: Record) -> str:
    """How much of the published error is the constant of row 0, which does not fall."""
    said = []
    for fraction in thesis.FRACTIONS:
        runs = record.where(experiment=2, model=_OURS, fraction=fraction)
        if len(runs):
            constant = record.values("row_0_constant", runs) / 100
            constant = constant * record.values("hidden_rows_0_share", runs)
            part = float((constant / record.values("published_mse", runs)).mean())
            said.append(f"{100 * part:.0f}\N{THIN SPACE}% at {percent(fraction)}")
    if not said:
        return ""
    return (
        f"Under published scoring {_NEAR} is a wide margin: of the test MSE of {label(_OURS)} the "
        f"constant of row 0 alone is {', '.join(said)}."
    )


def _settled(record: Record, experiment: int, model: str, fraction: float, scoring: str) -> Cell:
    curves = list(curves_of(record, experiment, model, fraction, scoring).values())
    if not curves:
        return Cell(n=0)
    mark = (
        MIXED
        if record.mixed(record.where(experiment=experiment, model=model, fraction=fraction))
        else ""
    )
    mean = convergence(curves, tolerance=TOLERANCE).settled
    if experiment == 1 and len(curves) == 1:
        return Cell(f"{mean.value:.0f}", mean.value, n=1, mark=mark)
    text = f"{mean.value:.1f}"
    if mean.low is not None and mean.high is not None:
        text += f" [{mean.low:.1f}, {mean.high:.1f}]"
    return Cell(text, mean.value, n=len(curves), mark=mark)
