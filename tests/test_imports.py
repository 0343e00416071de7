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
    "calibration",
    "metrics",
    "examples",
    "run",
    "training",
    "ladder",
    "answers",
    "learning",
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
