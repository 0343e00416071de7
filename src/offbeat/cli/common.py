"""Functions that several subcommands use."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from offbeat.data.source import read_json
from offbeat.errors import FileFormatError, InputError, one_of, printable

if TYPE_CHECKING:
    from offbeat.config import SplitConfig
    from offbeat.data.plan import Plan
    from offbeat.data.trajectory import Dataset

READER_FILE = "reader.json"
"""File in a run's folder with the options that its log was read with."""

FOUND = "found"
"""Key in that file of options that nothing stated, such as the unit of time found from the numbers.

Other logs are read with them where nothing states these options there, either."""

_ASSUMED_TIME = "time is taken to be in"


def say(result: Any, text: str, as_json: bool) -> None:
    """Prints a result as JSON or as text."""
    print(json.dumps(result, indent=2) if as_json else printable(text))


def plain(config: dict[str, Any]) -> dict[str, Any]:
    """The fields of a config as types of JSON and YAML."""
    return {k: _lists(v) for k, v in config.items()}


def _lists(value: Any) -> Any:
    return [_lists(v) for v in value] if isinstance(value, tuple) else value


def read_log(data: Path, reader: dict[str, Any] | None, *, run: Path | None = None) -> Dataset:
    """Reads a log of any known format.

    Args:
        data: the file.
        reader: options of `offbeat.read`. Those that are missing are taken from the run, unless
            `format` is given, or the file is a data set of ours, which is finished.
        run: folder of a run.

    Raises:
        FileFormatError: as `read`, or the options of the run are damaged.
        InputError: as `read`.
    """
    from offbeat.data.readers import read
    from offbeat.data.store import holds_data_set

    finished = data.suffix.lower() in (".parquet", ".pq") and holds_data_set(data)
    options = reader_options(reader, None if finished else run)
    found = options.pop(FOUND, None)
    known_unit = isinstance(found, dict) and "time_unit" in found
    with without_warnings(_ASSUMED_TIME if known_unit else None):  # it was printed in training
        dataset = read(data, **options)
    if not isinstance(found, dict) or "found" not in dataset.meta:
        return dataset
    known = known_options(data, options)
    # Nothing in the log states its unit of time, or of an angle: they are those of the run.
    own = dataset.meta["found"]
    other = {}
    stated = found.get("time_unit", own.get("time_unit"))
    if stated != own.get("time_unit") and "time_unit" in known:
        other["time_unit"] = found["time_unit"]
    wrong = [n for n, unit in own.get("units", {}).items() if unit != "deg"]
    degrees = {n: "deg" for n in wrong if found.get("units", {}).get(n) == "deg"}
    if degrees and ("units" in known or "units" in options):
        other["units"] = {**(options.get("units") or {}), **degrees}
    return read(data, **{**options, **other}) if other else dataset


def read_planned(
    data: Path,
    reader: dict[str, Any] | None,
    *,
    horizon_s: float | None = None,
    split: SplitConfig | None = None,
    seed: int = 0,
) -> tuple[Dataset, Plan | None]:
    """Reads a log to train on it: chooses options that are not given, and prepares the data set.

    Args:
        data: the file.
        reader: options of `offbeat.read`, which are kept.
        horizon_s: as of `plan`.
        split: as of `plan`.
        seed: as of `plan`.

    Returns:
        The data set as a model is trained on it, and what was chosen for it; None for a data set
        of ours, which is finished and taken as it is.

    Raises:
        FileFormatError: as `read`.
        InputError: as `read` and `plan`.
    """
    from offbeat.data.plan import CHOSEN, plan, prepare

    given = dict(reader or {})
    known = [option for option in CHOSEN if option in known_options(data, given)]
    first = {"outliers": "mask", **given} if "outliers" in known else given
    dataset = read_log(data, first)
    if "cleaning" not in dataset.meta:
        return dataset, None
    chosen = plan(dataset, reader=first, known=known, horizon_s=horizon_s, split=split, seed=seed)
    if chosen.reader != first:
        with without_warnings():
            dataset = read_log(data, dict(chosen.reader))
    return prepare(dataset, chosen), chosen


def reader_options(reader: dict[str, Any] | None, run: Path | None) -> dict[str, Any]:
    """The options given, completed by those that the run was trained with.

    Where a format is given, the run's options are not used: they may be of another format.

    Raises:
        FileFormatError: those of the run are damaged.
    """
    given = dict(reader or {})
    if "format" in given or run is None or not (run / READER_FILE).is_file():
        return given
    try:
        kept = dict(read_json(run / READER_FILE))
    except (TypeError, ValueError) as error:
        raise FileFormatError(
            f"{run / READER_FILE} is damaged ({error}); give --reader.format and other options"
        ) from None
    return {**kept, **given}


@contextmanager
def without_warnings(holding: str | None = "") -> Iterator[None]:
    """While this lasts, what readers assume is not printed as warnings.

    Args:
        holding: only warnings with this text are left out; None leaves none out.
    """

    def is_printed(record: logging.LogRecord) -> bool:
        left_out = holding is not None and holding in record.getMessage()
        return record.levelno > logging.WARNING or not left_out

    logger = logging.getLogger("offbeat")
    logger.addFilter(is_printed)
    try:
        yield
    finally:
        logger.removeFilter(is_printed)


def known_options(
    data: Path, reader: dict[str, Any] | None = None, *, run: Path | None = None
) -> list[str]:
    """The options that the reader of a log has and that neither the user nor the run gives.

    Args:
        data: the file.
        reader: options given.
        run: folder of a run, whose options apply as in `read_log`.

    Raises:
        FileFormatError: no reader supports the file, or the options of the run are damaged.
    """
    from offbeat.data.readers import READERS, reader_of
    from offbeat.data.source import require_source

    given = reader_options(reader, run)
    named = given.get("format")
    found = reader_of(require_source(data)) if named is None else READERS[named]
    return [option for option in found.options if option not in given]


def answer_columns(
    dataset: Dataset, answers: Dataset, *, masks: bool = True, level: float = 0.9
) -> dict[str, Any]:
    """The table that commands write: times, one column per channel, and its observed mask.

    Args:
        dataset: as it was read; its labels and its clock are restored.
        answers: one trajectory per trajectory of the data set.
        masks: add a column `name|observed` per channel, true where the value was measured.
        level: probability of the intervals, whose ends are `name|low` and `name|high` where the
            answers have any; `name|beyond` is true where an answer is beyond what was trained, for
            channels that have such answers.

    Raises:
        InputError: a channel has the name of another column.
    """
    import numpy as np

    from offbeat.answers.answer import Answer
    from offbeat.data.trajectory import SECONDS_PER

    each = [t.rows for t in answers]
    labels = np.asarray(dataset.meta.get("labels", range(len(answers))))
    seconds = np.concatenate([t.times for t in answers])
    columns: dict[str, Any] = {"trajectory": np.repeat(labels, each), "time": seconds}
    if "clock_start" in dataset.meta:
        # An integer clock was read relative to its first row; this restores it exactly.
        unit, start = dataset.meta["time_unit"], np.repeat(dataset.meta["clock_start"], each)
        ticks = seconds / SECONDS_PER[unit]
        columns[f"clock_{unit}"] = start + (
            ticks if SECONDS_PER[unit] >= 1 else np.rint(ticks).astype(int)
        )
    values = np.concatenate([t.values for t in answers])
    added = {name: values[:, i] for i, name in enumerate(answers.names)}
    if masks:
        observed = np.concatenate([t.observed for t in answers])
        added |= {f"{name}|observed": observed[:, i] for i, name in enumerate(answers.names)}
    each_has = answers.channels * (2 if masks else 1)
    blended = [t for t in answers if isinstance(t, Answer) and t.widths is not None]
    if len(blended) == len(answers):
        half = np.concatenate([t.half_width(level) for t in blended])
        added |= {f"{name}|low": (values - half)[:, i] for i, name in enumerate(answers.names)}
        added |= {f"{name}|high": (values + half)[:, i] for i, name in enumerate(answers.names)}
        beyond = np.concatenate([t.beyond for t in blended if t.beyond is not None])
        marked = [i for i in range(answers.channels) if beyond[:, i].any()]
        added |= {f"{answers.names[i]}|beyond": beyond[:, i] for i in marked}
        each_has += answers.channels * 2 + len(marked)
    taken = [name for name in added if name in columns]
    if taken or len(added) < each_has:
        endings = ("|observed", "|low", "|high", "|beyond")
        twice = taken[0] if taken else next(n for n in answers.names if n.endswith(endings))
        raise InputError(f"a channel has the name of another column, {twice!r}; rename it")
    return {**columns, **added}


def check_out(out: Path, data: Path) -> None:
    """Checks the file of a table before anything is computed.

    Raises:
        InputError: it is not a .csv or .parquet file, or it is the data itself.
    """
    one_of("suffix of out", out.suffix, (".csv", ".parquet"))
    if out.exists() and data.exists() and out.samefile(data):
        raise InputError(f"{out} is the data set itself; give another file")


def check_figure(figure: Path | None) -> None:
    """Checks the file of a figure before anything is computed.

    Raises:
        InputError: it is not a .png, .pdf or .svg file, or it can't be written.
    """
    from offbeat.files import writable

    if figure is not None:
        one_of("suffix of figure", figure.suffix.lower(), (".png", ".pdf", ".svg"))
        writable(figure)


def plotted_channels(names: Sequence[str], given: Sequence[str] | None) -> list[str]:
    """The channels of a figure: those given, or the first four.

    Raises:
        InputError: a channel does not exist.
    """
    if given is None:
        return list(names[:4])
    return [one_of("channel", name, names) for name in given]


def one_trajectory(dataset: Dataset, number: int) -> int:
    """Returns the number of a trajectory, counted from 0.

    Raises:
        InputError: there is no such trajectory.
    """
    if not 0 <= number < len(dataset):
        raise InputError(
            f"there is no trajectory {number}; the data has {len(dataset)}, so --trajectory goes "
            f"from 0 to {len(dataset) - 1}"
        )
    return number
