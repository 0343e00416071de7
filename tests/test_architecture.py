"""The architecture page names what there is."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")


def test_every_top_level_module_and_package_is_on_the_page():
    source = ROOT / "src" / "offbeat"
    names = [p.name for p in source.iterdir() if p.suffix == ".py" and not p.name.startswith("__")]
    names += [f"{p.name}/" for p in source.iterdir() if (p / "__init__.py").is_file()]
    missing = [name for name in sorted(names) if f"`{name}`" not in PAGE]
    assert missing == []


def test_every_file_that_the_page_names_is_there():
    named = re.findall(
        r"`((?:tests|src|docs|kernels|models|parts|data|ode)/[\w/]+\.(?:py|md))", PAGE
    )
    assert len(named) > 10
    found = {
        name for name in named if any((r / name).is_file() for r in (ROOT, ROOT / "src/offbeat"))
    }
    assert sorted(set(named) - found) == []
