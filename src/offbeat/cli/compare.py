"""`offbeat compare`."""

from __future__ import annotations

from pathlib import Path

from offbeat.cli.common import say
from offbeat.errors import one_of


def compare_command(
    runs: list[str],
    metric: str = "after_first_observation",
    error: str = "rmse",
    baseline: str | None = None,
    models: list[str] | None = None,
    only: str | None = None,
    shared_repeats: bool = False,
    alpha: float = 0.05,
    confidence: float = 0.95,
    resamples: int = 9999,
    seed: int = 0,
    form: str = "text",
    out: Path | None = None,
    figure: Path | None = None,
    json: bool = False,
) -> None:
    """Compare trained models over repeats: which differences are significant, and how large.

    For example: offbeat compare runs/gru-* runs/ode_rnn-* --baseline last_value. Runs are paired
    by repeat: train every model on the same splits of the data (--split.seed 0, 1, 2, ...), each
    run in a folder of its own. At least three repeats are needed; ten are better.

    Args:
        runs: folders of runs, folders that hold such folders, or tables with a row per run (.csv,
            .parquet).
        metric: after_first_observation, masked, after_first_row, or published, the thesis' scoring.
        error: rmse or mse.
        baseline: compare every model with this one, last_value for example; by default every
            model with every other.
        models: compare only these, as in --models ode_rnn,ode_gru_d.
        only: keep runs with these values, as in --only experiment=2,observed_fraction=0.3.
        shared_repeats: leave out repeats that are missing for some model; without it, a missing
            repeat is an error.
        alpha: significance level.
        confidence: level of the confidence intervals.
        resamples: number of bootstrap samples.
        seed: seed of the bootstrap.
        form: form of what is printed: text, markdown or latex.
        out: file for the comparison: .txt, .md, .tex or .json.
        figure: file for the critical-difference diagram of three or more models: .png, .pdf or
            .svg.
        json: print the comparison as JSON.
    """
    from offbeat.comparison import compare, read_runs
    from offbeat.comparison.runs import parse_only
    from offbeat.errors import InputError
    from offbeat.files import writable, write_json, write_text

    one_of("form", form, ("text", "markdown", "latex"))
    if out is not None:
        one_of("suffix of out", writable(out).suffix, (".txt", ".md", ".tex", ".json"))
    if figure is not None:
        one_of("suffix of figure", writable(figure).suffix, (".png", ".pdf", ".svg"))
    comparison = compare(
        read_runs(runs, only=parse_only(only)),
        metric=metric,
        error=error,  # type: ignore[arg-type]  # checked there
        baseline=baseline,
        models=models,
        alpha=alpha,
        confidence=confidence,
        resamples=resamples,
        seed=seed,
        shared_repeats=shared_repeats,
    )
    ranked = {c.condition: c.friedman for c in comparison.conditions if c.friedman is not None}
    if figure is not None and not ranked:
        raise InputError(
            "a critical-difference diagram needs three or more models; leave out --figure"
        )
    forms = {".txt": "text", ".md": "markdown", ".tex": "latex"}
    if out is not None and out.suffix == ".json":
        write_json(out, comparison.to_dict())
    elif out is not None:
        write_text(out, getattr(comparison, forms[out.suffix])().rstrip("\n") + "\n")
    if figure is not None:
        from offbeat.plots.figures import save
        from offbeat.plots.ranks import ranks_figure

        save(ranks_figure(ranked), figure)
    say(comparison.to_dict(), getattr(comparison, form)().rstrip("\n"), json)
