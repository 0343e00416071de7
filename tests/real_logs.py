"""Real logs that other programs wrote, where they stand beside the repository."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def shared(*parts):
    """A real log, out of OFFBEAT_DATA or the folder beside the repository; skips without it."""
    root = Path(os.environ.get("OFFBEAT_DATA") or ROOT.parent / "shared" / "data")
    path = root.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"{path} is not here")
    return path


def evo(*parts):
    """A file of the unpacked source of the package evo, at OFFBEAT_EVO; skips without it."""
    root = os.environ.get("OFFBEAT_EVO")
    found = [Path(root)] if root else sorted((ROOT.parent / "shared" / "data").glob("evo-*"))
    path = found[0].joinpath("test", *parts) if found else None
    if path is None or not path.exists():
        pytest.skip("the source of the package evo is not here, set OFFBEAT_EVO to its folder")
    return path
