"""The peers: what each is, and the function that runs it."""

from __future__ import annotations

import ast
import io
import tokenize
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from .problem import Answerer, Problem


@dataclass(frozen=True)
class Options:
    """What a run gives to every peer.

    Attributes:
        budget_s: s, limit of a training, CPU time on one thread.
        seed: of initial weights and of what is drawn.
        checkout: folder of PyOmniTS; only its models need it.
    """

    budget_s: float = 60.0
    seed: int = 0
    checkout: Path | None = None


@dataclass(frozen=True)
class Peer:
    """A peer.

    Attributes:
        title: in the tables.
        function: `module:function` of `benchmarks.peers`; takes a `Problem` and `Options`, fits,
            and returns an `Answerer`.
        packages: distributions whose versions are recorded.
        tasks: kinds it is asked: `fill`, `forecast`.
        elsewhere: whether its packages are in an environment of their own.
        settings: what was chosen, in one line.
    """

    title: str
    function: str
    packages: tuple[str, ...]
    tasks: tuple[str, ...]
    elsewhere: bool
    settings: str

    def load(self) -> Callable[[Problem, Options], Answerer]:
        """Imports the function."""
        module, _, name = self.function.partition(":")
        found: Callable[[Problem, Options], Answerer] = getattr(
            import_module(f"benchmarks.peers.{module}"), name
        )
        return found

    def lines(self) -> int:
        """Lines of code of the function, and of those of its module that it needs."""
        module, _, name = self.function.partition(":")
        return code_lines(Path(__file__).with_name(f"{module}.py").read_text("utf-8"), name)


FILL, FORECAST = "fill", "forecast"
BOTH = (FILL, FORECAST)
_MASKS = "trained on masks like those of the task; early stopping on masked validation windows"

PEERS: Mapping[str, Peer] = {
    "last_value": Peer("last value", "simple:last_value", ("numpy",), BOTH, False, ""),
    "linear": Peer("line between neighbours", "simple:linear", ("numpy",), (FILL,), False, ""),
    "pchip": Peer("scipy PCHIP", "simple:pchip", ("scipy",), (FILL,), False, ""),
    "pykalman": Peer(
        "pykalman smoother",
        "kalman:smoother",
        ("pykalman",),
        (FILL,),
        True,
        "random second or third derivative, (position, velocity) together where there are both; "
        "noise and order chosen on validation",
    ),
    "statsmodels": Peer(
        "statsmodels local linear trend",
        "kalman:local_linear_trend",
        ("statsmodels",),
        BOTH,
        True,
        "per channel, maximum likelihood on one training series of up to 1,000 rows; rows count "
        "as equal steps",
    ),
    "gp": Peer(
        "scikit-learn GP, Matern 3/2",
        "sklearn_peers:gaussian_process",
        ("scikit-learn",),
        BOTH,
        False,
        "per channel; hyperparameters by likelihood on 5 windows; the last 60 rows for forecasts",
    ),
    "ridge": Peer(
        "scikit-learn ridge",
        "sklearn_peers:ridge",
        ("scikit-learn",),
        BOTH,
        False,
        "forecasts from the last 10 rows of all channels, fills from slopes at both ends and the "
        "other channels; penalty chosen on validation",
    ),
    "kernel_ridge": Peer(
        "scikit-learn kernel ridge",
        "sklearn_peers:kernel_ridge",
        ("scikit-learn",),
        (FORECAST,),
        False,
        "the features of the ridge and 300 Gaussian kernels of them (Nystroem), about 5,000 rows; "
        "width and penalty chosen on validation",
    ),
    "darts": Peer(
        "darts, ridge on 10 lags",
        "forecasters:darts",
        ("darts", "scikit-learn"),
        (FORECAST,),
        True,
        "`SKLearnModel(Ridge())`, all channels, rows filled forward and counted as equal steps",
    ),
    "nhits": Peer(
        "neuralforecast NHITS",
        "forecasters:nhits",
        ("neuralforecast", "torch"),
        (FORECAST,),
        True,
        "defaults, input of 2 horizons, quantile loss with an interval of 90 %; early stopping",
    ),
    **{
        f"pypots_{name}": Peer(
            f"PyPOTS {title}", f"pypots_peers:{name}", ("pypots", "torch"), (FILL,), True, s
        )
        for name, title, s in (
            ("saits", "SAITS", f"2 layers, width 64, windows of 100 rows; {_MASKS}"),
            ("brits", "BRITS", f"width 64, windows of 100 rows; {_MASKS}"),
            ("grud", "GRU-D", f"width 64, windows of 100 rows; {_MASKS}"),
            ("imputeformer", "ImputeFormer", f"2 layers, windows of 100 rows; {_MASKS}"),
        )
    },
    **{
        f"pyomnits_{name.lower()}": Peer(
            f"PyOmniTS {name}",
            f"pyomnits:{name.lower()}",
            ("torch", "einops"),
            (FORECAST,),
            True,
            "width 32, the last 24 rows, output added to the last value, errors weighted by "
            "horizon; early stopping on validation",
        )
        for name in ("GraFITi", "HyperIMTS")
    },
    "offbeat": Peer(
        "**Offbeat**",
        "offbeat_peer:offbeat",
        ("offbeat", "torch"),
        BOTH,
        False,
        "what `ob.learn` does to a log, on these parts; on the hopper six baselines and 20 epochs "
        "each way of the anchored model",
    ),
}
"""Peers by name, in the order of the tables."""


def code_lines(source: str, function: str) -> int:
    """Counts lines of a function and of the functions and classes of its module that it uses.

    Args:
        source: of the module.
        function: name.

    Returns:
        Lines with code; blank lines, comments and docstrings are left out.
    """
    tree = ast.parse(source)
    kinds = (ast.FunctionDef, ast.ClassDef)
    defined = {node.name: node for node in tree.body if isinstance(node, kinds)}
    reached, waiting = set(), [function]
    while waiting:
        name = waiting.pop()
        if name in defined and name not in reached:
            reached.add(name)
            nodes = ast.walk(defined[name])
            waiting += [node.id for node in nodes if isinstance(node, ast.Name)]
    wanted: set[int] = set()
    for name in reached:
        node = defined[name]
        wanted |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
        for inner in ast.walk(node):
            if isinstance(inner, kinds) and ast.get_docstring(inner) is not None:
                text = inner.body[0]
                wanted -= set(range(text.lineno, (text.end_lineno or text.lineno) + 1))
    skipped = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)
    used: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in skipped:
            used |= set(range(token.start[0], token.end[0] + 1))
    return len(wanted & used)
