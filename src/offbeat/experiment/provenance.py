"""Where numbers come from: the commit, the code, the processor and the libraries of this process.

Sums in another order end in other last digits, and training lets them grow. So runs that were made
by other code, on another kind of processor or by another kernel body are told apart.
"""

from __future__ import annotations

import hashlib
import platform
import subprocess
from dataclasses import dataclass
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parents[1]

NUMBERS_FROM = (
    "config.py",
    "data/batch.py",
    "data/prepare.py",
    "data/thin.py",
    "data/trajectory.py",
    "solvers",
    "kernels",
    "models",
    "scores.py",
    "run_state.py",
    "training.py",
    "evaluation.py",
    "experiment/protocol.py",
    "experiment/execute.py",
)
"""Files and folders of the package that a run's numbers depend on, given the recorded data."""

_LIVE_ONLY = ("live.hpp", "stream.hpp")
"""C++ that runs streams and no training."""


@dataclass(frozen=True)
class Provenance:
    """What made a run.

    Attributes:
        commit: `git describe` of the checkout, `-dirty` with changes; else the package's version.
        code: hash of the source that numbers depend on; equal at commits that don't touch it.
        cpu: name of the processor.
        kernel_body: which body of the scan ran.
        torch: version.
    """

    commit: str
    code: str
    cpu: str
    kernel_body: str
    torch: str

    @classmethod
    def here(cls) -> Provenance:
        """Of this process, as it stood when it was first asked."""
        return _here()


@cache
def _here() -> Provenance:
    import torch

    return Provenance(commit(), code(), cpu(), kernel_body(), torch.__version__)


def kernel_body() -> str:
    """Which body of `kernels.scan` runs here."""
    from offbeat.kernels import body

    return body()[0]


def commit() -> str:
    """The commit of the checkout that this package runs from, or the package's version."""
    from offbeat import __version__

    def git(*arguments: str) -> str:
        try:
            command = ["git", "-C", str(PACKAGE), *arguments]
            done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
        except (OSError, subprocess.SubprocessError):
            return ""
        return done.stdout.strip() if done.returncode == 0 else ""

    top = git("rev-parse", "--show-toplevel")
    # Installed into a folder of another project's checkout, that one's commit would say nothing.
    if not top or Path(top).resolve() / "src" / "offbeat" != PACKAGE.resolve():
        return f"offbeat {__version__}"
    return git("describe", "--always", "--dirty", "--abbrev=12") or f"offbeat {__version__}"


def code(package: Path = PACKAGE) -> str:
    """A hash of the source that numbers depend on, of the C++ source too where it is at hand.

    Args:
        package: folder of the package.
    """
    files: list[Path] = []
    for name in NUMBERS_FROM:
        path = package / name
        files += sorted(path.rglob("*.py")) if path.is_dir() else [path]
    root = package.parents[1]
    if (root / "src" / package.name) == package:
        files += sorted(p for p in (root / "csrc").rglob("*") if p.name not in _LIVE_ONLY)
    digest = hashlib.sha256()
    for path in files:
        digest.update(f"{path.relative_to(root).as_posix()}\0".encode())
        digest.update(path.read_bytes() + b"\0")
    return digest.hexdigest()[:12]


def cpu() -> str:
    """The processor's name."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
