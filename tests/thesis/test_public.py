"""The thesis is written on the library's public interface."""

import ast
from pathlib import Path

import offbeat

ROOT = Path(__file__).parents[2]
MODULES = (
    "offbeat.models.zoo",
    "offbeat.models.base",
    "offbeat.models.checkpoint",
    "offbeat.data.simulate",
    "offbeat.sweeps",
    "offbeat.comparison.statistics",
    "offbeat.metrics",
    "offbeat.tables",
    "offbeat.plots",
    "offbeat.files",
    "offbeat.errors",
    "offbeat.cli.app",
    "offbeat.cli.common",
)
"""Public beside the names of `offbeat`, as docs/architecture.md lists them."""


def test_the_thesis_imports_public_names_alone():
    for path in sorted((ROOT / "thesis").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.ImportFrom) or not str(node.module).startswith("offbeat"):
                continue
            names = [alias.name for alias in node.names]
            where = f"{path.name}: from {node.module} import {', '.join(names)}"
            assert not any(name.startswith("_") for name in names), where
            if node.module == "offbeat":
                assert {*names} <= {*offbeat.__all__, "__version__"}, where
            else:
                known = (node.module == m or node.module.startswith(f"{m}.") for m in MODULES)
                assert any(known), where


def test_the_page_lists_the_modules():
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    assert [module for module in MODULES if module not in page] == []
