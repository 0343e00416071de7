"""What a report consists of: each table, figure and finding, made once from one record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property

from offbeat import MissingExtraError
from offbeat.comparison.statistics import FriedmanResult
from offbeat.plots.ranks import ranks_figure
from thesis.illustrations import Illustrations
from thesis.report import (
    claims,
    convergence,
    findings,
    stability,
    tables,
    tables_beyond,
    tables_tests,
)
from thesis.report import thesis_numbers as thesis
from thesis.report.circumstances import Circumstances, broken_pairs, mixing
from thesis.report.figure_boxes import boxes_figure
from thesis.report.figure_curves import curves_figure
from thesis.report.figure_robot import CHANNELS, channels_figure, frames_figure
from thesis.report.figure_states import map_figure, states_figure
from thesis.report.findings import Finding
from thesis.report.page import Picture
from thesis.report.pairing import FAMILIES, MODELS, Pair, Rule, family, ranks, thesis_rule
from thesis.report.records import Record
from thesis.report.table import Table
from thesis.report.tables import label, percent


class Contents:
    """Tables, figures and findings of a record.

    Args:
        record: finished runs.
        illustrations: recordings and hidden states, or None.
        circumstances: further files of the record's folder.
        repeats: of experiment 2 in the full protocol.
    """

    def __init__(
        self,
        record: Record,
        illustrations: Illustrations | None,
        circumstances: Circumstances,
        *,
        repeats: int,
    ) -> None:
        self.record, self.illustrations = record, illustrations
        self.circumstances, self.repeats = circumstances, repeats

    # --- tests ------------------------------------------------------------------------------------

    @cached_property
    def families(self) -> Mapping[tuple[str, str], Sequence[Pair]]:
        """All paired comparisons, by family and scoring."""
        return {
            (name, scoring): family(self.record, name, scoring)
            for name in FAMILIES
            for scoring in findings.SCORINGS
        }

    @cached_property
    def rules(self) -> Mapping[tuple[str, str], Sequence[Rule]]:
        """The thesis' rule against ODE-GRU-D, by the other predictor and scoring."""
        return {
            (other, scoring): thesis_rule(self.record, scoring, a=other)
            for other in ("ode_rnn", tables.LAST_VALUE)
            for scoring in findings.SCORINGS
        }

    @cached_property
    def ranks(self) -> Mapping[float, FriedmanResult | str]:
        """Friedman's test under scoring after the first observation, by observed fraction."""
        return ranks(self.record, "honest")

    @cached_property
    def spreads(self) -> Mapping[str, tuple[stability.Spread, ...]]:
        """The spread of ODE-GRU-D and of the other models, by scoring."""
        return {scoring: stability.spreads(self.record, scoring) for scoring in findings.SCORINGS}

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """The thesis' conclusions, then what it did not ask."""
        rules = {scoring: self.rules["ode_rnn", scoring] for scoring in findings.SCORINGS}
        return (
            *claims.of_the_thesis(
                self.families,
                rules,
                spread=stability.spread_verdicts(self.spreads),
                convergence=convergence.speed_verdicts(self.record),
                enough=convergence.enough_verdicts(self.record),
            ),
            *claims.beyond_the_thesis(self.families),
        )

    # --- tables -----------------------------------------------------------------------------------

    @cached_property
    def tables(self) -> Mapping[str, Table]:
        """By number, in the order of the page."""
        record, repeats = self.record, self.repeats
        made = [
            *(tables.curve_table(record, fraction) for fraction in thesis.FRACTIONS),
            tables.final_table(record),
            tables.repeats_table(record, repeats=repeats),
            tables_tests.normality_table(record),
            tables_tests.rule_table(record, self.rules),
            tables_beyond.distance_table(record, number="A.1"),
            tables_beyond.all_models_table(record, repeats=repeats, number="A.2"),
            *(
                tables_tests.paired_table(
                    record, self.families["ode_models", scoring], number=number, scoring=scoring
                )
                for number, scoring in (("A.3", "published"), ("A.4", "honest"))
            ),
            tables_tests.ranks_table(self.ranks, number="A.5", scoring="honest"),
            *(
                tables_tests.family_table(
                    record,
                    {
                        shown: self.families[name, scoring]
                        for scoring, shown in findings.SCORINGS.items()
                    },
                    number=number,
                    caption=caption,
                )
                for number, name, caption in _FAMILY_TABLES
            ),
            stability.spread_table(record, self.spreads, number="A.11"),
            convergence.speed_table(record, number="A.12"),
            convergence.choice_table(record, number="A.13"),
            tables_beyond.runs_table(record, repeats=repeats, number="A.14"),
            tables_beyond.cost_table(record, number="A.15"),
        ]
        return {table.number: table for table in made}

    # --- figures ----------------------------------------------------------------------------------

    @cached_property
    def _drawn(self) -> tuple[Mapping[str, Picture], tuple[str, ...]]:
        pictures, missing = list[Picture](), list[str]()
        lacking = list[str]()
        for fraction in thesis.FRACTIONS:
            number = thesis.CURVE_FIGURES[fraction]
            if self._has_curves(fraction):
                pictures.append(self._curves(number, fraction))
            else:
                lacking.append(number)
        missing += _needs(lacking, "a run of experiment 1 with its curve")
        lacking = []
        for fraction in thesis.FRACTIONS:
            number = thesis.BOX_FIGURES[fraction]
            if len(self.record.where(experiment=2, fraction=fraction)):
                pictures.append(self._boxes(number, fraction))
            else:
                lacking.append(number)
        missing += _needs(lacking, "a run of experiment 2")
        ranked = {f: r for f, r in self.ranks.items() if isinstance(r, FriedmanResult)}
        if ranked:
            pictures.append(_ranks_picture("A.1", ranked))
        else:
            missing.append("Figure A.1 needs three models with three repeats in common.")
        if self.illustrations is None:
            missing.append(
                "Figures 3.1, 3.2, 2.5 and A.2 need recordings and trained models: run "
                "'python -m thesis report' where the checkpoints of the runs are, with the extra "
                "'sim'."
            )
            return {p.number: p for p in pictures}, tuple(missing)
        illustrated, why = _illustrated(self.illustrations)
        return {p.number: p for p in (*illustrated, *pictures)}, (*missing, *why)

    @property
    def pictures(self) -> Mapping[str, Picture]:
        """By number."""
        return self._drawn[0]

    def _has_curves(self, fraction: float) -> bool:
        runs = self.record.where(experiment=1, fraction=fraction)
        names = self.record.values("run_id", runs)
        return any(len(self.record.curve(str(name))["epoch"]) for name in names)

    def _curves(self, number: str, fraction: float) -> Picture:
        ends = []
        for model in thesis.MODELS:
            runs = self.record.where(experiment=1, model=model, fraction=fraction)
            for name in self.record.values("run_id", runs)[:1]:
                curve = self.record.curve(str(name))
                if len(curve["epoch"]):
                    ends.append(
                        f"{label(model)} {curve['validation_published_mse'][-1]:.5f} and "
                        f"{curve['validation_honest_mse'][-1]:.6f}"
                    )
        at = percent(fraction)
        return Picture(
            number,
            f"Learning curves of one run per model, {at} of the rows observed; axes are "
            "logarithmic, and the first epochs may lie above them. Hollow markers: the thesis' "
            f"table {thesis.CURVE_TABLES[fraction]}.",
            f"Validation MSE by epoch at {at}, two panels: published scoring, "
            "and after the first observation. At the "
            f"last epoch: {'; '.join(ends)}.",
            curves_figure(self.record, fraction),
        )

    def _boxes(self, number: str, fraction: float) -> Picture:
        medians = []
        for model in (*MODELS, tables.LAST_VALUE):
            _, values = tables.rmse_of(self.record, model, fraction, "honest")
            if len(values):
                middle = float(sorted(values**2)[len(values) // 2])
                medians.append(f"{label(model)} {middle:.6f}")
        at = percent(fraction)
        return Picture(
            number,
            f"Test MSE of the repeats, {at} of the rows observed; the axis of the "
            "lower panel is logarithmic. Boxes: quartiles and median; whiskers: to the farthest "
            "run within 1.5 times the box; dots: runs.",
            f"Box plots of the test MSE at {at}, published scoring, and after the "
            "first observation. Medians under "
            f"scoring after the first observation: {', '.join(medians)}.",
            boxes_figure(self.record, fraction),
        )

    # --- the rest ---------------------------------------------------------------------------------

    @property
    def missing(self) -> tuple[str, ...]:
        """What is not there, and why, a sentence each."""
        there, asked = self.progress
        if there == asked:
            return self._drawn[1]
        first, second = (len(self.record.where(experiment=e)) for e in (1, 2))
        runs = (
            f"{there} of {asked} runs are there: {first} of {len(thesis.MODELS) * _SHARES} of "
            f"experiment 1 and {second} of {len(MODELS) * _SHARES * self.repeats} of experiment 2 "
            "(table A.14). What needs the others is left open, and says so where it stands."
        )
        return (runs, *self._drawn[1])

    @property
    def progress(self) -> tuple[int, int]:
        """Runs of the full protocol that are there, and how many it has."""
        there = sum(
            len(self.record.where(experiment=e, model=m, fraction=f))
            for e, models in ((1, thesis.MODELS), (2, MODELS))
            for m in models
            for f in thesis.FRACTIONS
        )
        return there, _SHARES * (len(thesis.MODELS) + len(MODELS) * self.repeats)

    @property
    def caution(self) -> str:
        """What tests of a part of the repeats can say, to follow a sentence; else nothing."""
        there = [
            len(self.record.where(experiment=2, model=m, fraction=f))
            for m in MODELS
            for f in thesis.FRACTIONS
        ]
        least, most = min(there), max(there)
        if least >= self.repeats:
            return ""
        counted = f"{least}" if least == most else f"{least} to {most}"
        return (
            f" So far a model has {counted} of {self.repeats} repeats at a fraction: so few "
            "have little power, and a verdict can still change."
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """What makes numbers hard to compare, a sentence each."""
        return (
            *self.circumstances.departures,
            *mixing(self.record),
            *broken_pairs(self.record),
        )


_SHARES = len(thesis.FRACTIONS)

_FAMILY_TABLES = (
    ("A.6", "against_plain", "ODE models against GRU and GRU-D of the thesis' rows, paired."),
    ("A.7", "against_fair", "ODE models against GRU and GRU-D without self-feeding, paired."),
    (
        "A.8",
        "self_feeding",
        "GRU and GRU-D without self-feeding against those of the thesis' rows, paired.",
    ),
    ("A.9", "anchored", "The anchored model against the others, paired."),
    ("A.10", "last_value", "Every model against the last observed value, paired."),
)


def _needs(numbers: Sequence[str], what: str) -> list[str]:
    if not numbers:
        return []
    named = ", ".join(numbers)
    verb = "Figure {} needs {} at its" if len(numbers) == 1 else "Figures {} each need {} at their"
    return [f"{verb.format(named, what)} fraction of observed rows."]


def _illustrated(shown: Illustrations) -> tuple[list[Picture], tuple[str, ...]]:
    pictures, missing = list[Picture](), list(shown.missing)
    duration = 1e3 * (shown.times[-1] - shown.times[0])
    try:
        pictures.append(
            Picture(
                "3.1",
                f"Frames of a simulated {shown.robot}, without control. The camera follows the "
                "torso.",
                f"Eight pictures of a {shown.robot} that falls, from 0 to {duration:.0f} ms.",
                frames_figure(shown),
                wide=True,
            )
        )
    except MissingExtraError as error:
        missing.append(f"Figure 3.1 cannot be drawn: {error}.")
    if all(name in shown.names for name in CHANNELS):
        count = len(shown.recordings)
        pictures.append(
            Picture(
                "3.2",
                f"Two of the {len(shown.names)} channels of the first {count} trajectories of the "
                "data: the height of the torso (rootz_qpos, from where the model file has it) "
                "and the angle of the knee (knee_qpos).",
                f"{count} lines over {duration:.0f} ms in two panels: height of the torso and "
                "angle of the knee.",
                channels_figure(shown),
                wide=True,
            )
        )
    at = percent(shown.fraction)
    if shown.trace is not None:
        names = ", ".join(map(label, shown.trace.after))
        pictures.append(
            Picture(
                "2.5",
                f"Hidden states along a trajectory that no model was trained on, {at} of the rows "
                "observed. Vertical lines: observed rows. Shown are the five units of each model "
                f"that move most. {_trained(shown)}",
                f"Hidden units over time, one panel per model: {names}.",
                states_figure(shown.trace),
                wide=True,
            )
        )
    if shown.map is not None:
        names = ", ".join(map(label, shown.map.places))
        colour = CHANNELS.get(shown.map.name, shown.map.name).lower()
        pictures.append(
            Picture(
                "A.2",
                "Hidden states on trajectories that no model was trained on, laid out by UMAP for "
                f"each model on its own; {at} of the rows observed. Colour: {colour}. "
                f"Distances between far groups mean nothing. {_trained(shown)}",
                f"One scatter plot per model: {names}.",
                map_figure(shown.map),
                wide=True,
            )
        )
    return pictures, tuple(missing)


def _trained(shown: Illustrations) -> str:
    """Which runs the models of the figures are, in a sentence."""
    by = dict[str, list[str]]()
    for model, run in shown.runs.items():
        by.setdefault(run[1:2], []).append(label(model))
    said = "; ".join(f"{', '.join(models)} of experiment {one}" for one, models in by.items())
    return f"Models of the first repeat: {said}." if said else ""


def _ranks_picture(number: str, results: Mapping[float, FriedmanResult]) -> Picture:
    said = []
    for fraction, result in results.items():
        ranked = ", ".join(f"{label(name)} {rank:.2f}" for name, rank in result.ranks.items())
        said.append(
            f"At {percent(fraction)}, best first: {ranked}; critical difference "
            f"{result.critical_difference:.2f}."
        )
    return Picture(
        number,
        "Average ranks of the models over the repeats, scoring after the first observation. A "
        "grey bar joins models whose ranks do not differ significantly by Nemenyi's test; CD is "
        "its critical difference.",
        f"Average ranks of the models. {' '.join(said)}",
        ranks_figure({percent(f): result for f, result in results.items()}),
        wide=True,
    )
