"""Where numbers come from: the commit, the processor and the libraries of this process.

Sums in another order end in other last digits, and training lets them grow. So runs that were made
by code that adds in another order, on another processor or by another scan backend are marked.
"""

from __future__ import annotations

import platform
import subprocess
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import offbeat

PACKAGE = Path(offbeat.__file__).parent


@dataclass(frozen=True)
class Provenance:
    """What made a run.

    Attributes:
        commit: `git describe` of the checkout, `-dirty` with changes outside `results/`; else the
            package's version.
        bits: fingerprint of small trainings; equal where the code ends in the same numbers.
        cpu: name of the processor.
        kernel_body: which body of the scan ran.
        torch: version.
    """

    commit: str
    bits: str
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

    from thesis.fingerprint import fingerprint

    return Provenance(commit(), fingerprint(), cpu(), kernel_body(), torch.__version__)


def kernel_body() -> str:
    """Which body of `kernels.scan` runs here."""
    from offbeat.kernels import backend

    return backend()[0]


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
    described = git("describe", "--always", "--abbrev=12")
    if not described:
        return f"offbeat {__version__}"
    # Runs publish under results/, which would mark the next ones as made by changed code.
    changed = git(
        "-C", top, "status", "--porcelain", "--untracked-files=no", "--", ".", ":(exclude)results"
    )
    return f"{described}-dirty" if changed else described


def cpu() -> str:
    """The processor's name."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
