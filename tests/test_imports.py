"""Imports follow the arrow: a module imports from its own stage or from earlier ones."""

import ast
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "offbeat"

# In the order of the arrow of docs/architecture.md, so that each stage can be read, tested and
# replaced without the stages that come after it.
STAGES = (
    "errors",
    "registry",
    "files",
    "safe_yaml",
    "tables",
    "progress",
    "config",
    "data",
    "baselines",
    "ode",
    "kernels",
    "parts",
    "models",
    "devices",
    "distributed",
    "calibration",
    "metrics",
    "examples",
    "sharded",
    "run",
    "captured",
    "direct",
    "training",
    "ladder",
    "answers",
    "learning",
    "learning_shards",
    "evaluation",
    "stream",
    "export",
    "env",
    "policies",
    "comparison",
    "plots",
    "sweeps",
    "demo",
    "doctor",
    "cli",
    "__main__",
    "__init__",
)

HEAVY = ("torch", "scipy.stats", "matplotlib", "mujoco", "dm_control")
"""Slow to import; `import offbeat` and `offbeat --help` do without them."""


def violations(source: Path) -> list[str]:
    """What in the package at `source` violates the order of imports, a line per violation."""
    found = []
    for path in sorted(source.rglob("*.py")):
        name = path.relative_to(source).with_suffix("").parts[0]
        where = f"{source.name}/{path.relative_to(source).as_posix()}"
        if name not in STAGES:
            found.append(f"{where}: {name!r} belongs to no stage; add it to STAGES")
            continue
        for line, target in imports(path, source):
            if name == "plots" and target.split(".")[0] == "torch":
                found.append(f"{where}:{line}: plots imports torch; figures draw arrays")
            if target.split(".")[0] != source.name:
                continue
            stage = stage_of(target, source)
            if stage is None:
                found.append(f"{where}:{line}: {target!r} belongs to no stage")
            elif STAGES.index(stage) > STAGES.index(name):
                found.append(f"{where}:{line}: {name} imports {target} of the later stage {stage}")
    return found


def imports(path: Path, source: Path) -> Iterator[tuple[int, str]]:
    """Line and dotted name of all that a module imports, inside functions and type checks too."""
    package = path.relative_to(source.parent).parent.parts
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            base = ".".join([*above, *filter(None, [node.module])])
            yield from ((node.lineno, f"{base}.{alias.name}") for alias in node.names)
        elif isinstance(node, ast.Call) and node.args:
            function, argument = node.func, node.args[0]
            called = getattr(function, "attr", getattr(function, "id", ""))
            if called == "import_module" and isinstance(argument, ast.Constant):
                yield node.lineno, str(argument.value)


def stage_of(target: str, source: Path) -> str | None:
    """The stage that a dotted name is taken from; public names come from the last one."""
    name = [*target.split("."), "__init__"][1]
    if name == "__version__":  # it stands in `__init__` and is there before anything is imported
        return STAGES[0]
    if name in STAGES:
        return name
    is_module = (source / name).is_dir() or (source / f"{name}.py").exists()
    return None if is_module else "__init__"


def test_no_module_imports_from_a_later_stage():
    assert not violations(SOURCE), "\n" + "\n".join(violations(SOURCE))


@pytest.mark.parametrize(
    ("file", "code", "violation"),
    [
        ("errors.py", "from offbeat.files import f", "errors.py:1: errors imports offbeat.files.f"),
        ("data/masking.py", "import offbeat.models.zoo", "data imports offbeat.models.zoo of the"),
        (
            "data/masking.py",
            "def f():\n    from offbeat.training import fit",
            "data/masking.py:2: data",
        ),
        (
            "ode/fixed.py",
            "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from ..models import zoo",
            "ode/fixed.py:3: ode imports offbeat.models.zoo of the later stage models",
        ),
        ("data/__init__.py", "from ..plots import style", "of the later stage plots"),
        ("models/zoo.py", "import offbeat", "models imports offbeat of the later stage __init__"),
        ("models/zoo.py", "from offbeat import fit", "models imports offbeat.fit of the later"),
        ("models/zoo.py", "from offbeat import cli", "models imports offbeat.cli of the later"),
        (
            "models/zoo.py",
            "import importlib\nimportlib.import_module('offbeat.cli.app')",
            "zoo.py:2: models imports offbeat.cli.app",
        ),
        ("stray.py", "", "stray.py: 'stray' belongs to no stage"),
        ("stray/part.py", "", "stray/part.py: 'stray' belongs to no stage"),
        ("plots/page.py", "import torch.nn", "plots/page.py:1: plots imports torch"),
        (
            "plots/page.py",
            "def f():\n    from torch import nn",
            "plots/page.py:2: plots imports",
        ),
    ],
)
def test_the_check_finds_a_violation(tmp_path, file, code, violation):
    path = tmp_path / "offbeat" / file
    path.parent.mkdir(parents=True)
    path.write_text(code, encoding="utf-8")
    found = violations(tmp_path / "offbeat")
    assert len(found) == 1
    assert violation in found[0]


def test_the_check_accepts_imports_along_the_arrow(tmp_path):
    path = tmp_path / "offbeat" / "models" / "zoo.py"
    path.parent.mkdir(parents=True)
    path.write_text(
        "import torch\n"
        "from offbeat import __version__, errors\n"
        "from offbeat.data.batch import Batch\n"
        "from ..ode import fixed\n"
        "from .cell import GRUCell\n",
        encoding="utf-8",
    )
    assert violations(tmp_path / "offbeat") == []


@pytest.mark.parametrize(
    "code",
    [
        "import offbeat",
        "import runpy; sys.argv = ['offbeat', '--help']\n"
        "try: runpy.run_module('offbeat', run_name='__main__')\n"
        "except SystemExit as stop: assert not stop.code, stop.code",
    ],
    ids=["import offbeat", "offbeat --help"],
)
def test_the_front_door_imports_nothing_heavy(code):
    report = f"print(json.dumps([name for name in {HEAVY} if name in sys.modules]))"
    done = subprocess.run(
        [sys.executable, "-c", f"import json, sys\n{code}\n{report}"],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == []


ALONE = """
import importlib.metadata, re, sys

def needed(name, found):
    if name not in found:
        found.add(name)
        for text in importlib.metadata.requires(name) or []:
            other = re.match("[A-Za-z0-9_.-]+", text)[0].lower().replace("_", "-")
            if "extra ==" not in text and other in installed:
                needed(other, found)
    return found

owners = importlib.metadata.packages_distributions()
owners = {top: {n.lower().replace("_", "-") for n in names} for top, names in owners.items()}
installed = set().union(*owners.values())
kept = {"pip", "setuptools", "offbeat"}
for name in ("torch", "numpy", "safetensors"):
    kept |= needed(name, set())
hidden = {top for top, names in owners.items() if not kept & names} - {"tests", "thesis"}
assert {"pyarrow", "jsonargparse", "matplotlib", "scipy", "yaml", "tqdm"} <= hidden, hidden
assert not {"torch", "numpy", "safetensors"} & hidden

class Without:
    def __init__(self, finder): self.finder = finder
    def __getattr__(self, name): return getattr(self.finder, name)
    def find_spec(self, name, path=None, target=None):
        return None if name.split(".")[0] in hidden else self.finder.find_spec(name, path, target)

for name in [name for name in sys.modules if name.split(".")[0] in hidden]:
    del sys.modules[name]
sys.meta_path[:] = [Without(finder) for finder in sys.meta_path]
"""
"""Hides every installed package but torch, NumPy and safetensors, and what these need."""

USED_ALONE = """
import numpy as np, offbeat as ob
from offbeat.cli.app import main

times = np.cumsum(np.random.default_rng(0).uniform(0.05, 0.15, (12, 20)), axis=1)
waves = [ob.Trajectory(t, np.stack([np.sin(3 * t), np.cos(3 * t)], 1)) for t in times]
train, validation, test = ob.split(ob.mask_out(ob.Dataset(tuple(waves)), 0.7, seed=0))
for name, options in (("anchored_trend", {}), ("gru", {"head": "gaussian"})):
    model = ob.make_model(name, train, hidden_size=4, **options)
    ob.fit(model, train, validation, ob.TrainConfig(epochs=1), out=f"{sys.argv[1]}/{name}")
    model = ob.load_model(f"{sys.argv[1]}/{name}/model")
    assert "last_value" in ob.evaluate(model, test).table()
    ob.predict(model, test), ob.forecast(model, test, 0.2), ob.impute(model, test)
    stream = ob.Stream(model)
    stream.observe(0.0, [0.1, 0.2])
    stream.predict(0.1)
from offbeat.policies import Policy
assert main(["doctor"]) == 0
assert main(["models"]) == 2
"""


def test_models_are_made_fitted_and_used_with_torch_numpy_and_safetensors_alone(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", ALONE + USED_ALONE, str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=250,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "which is not installed; install it with pip install offbeat" in done.stderr
