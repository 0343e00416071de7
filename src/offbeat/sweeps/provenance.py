"""Provenance of results: commit, processor and libraries of this process.

Sums in another order differ in the last digits, and training amplifies that. So runs made
by code that adds in another order, on another processor or by another backend are marked.
"""

from __future__ import annotations

import platform
import subprocess
from pathlib import Path

PACKAGE = Path(__file__).parents[1]


def provenance(bits: str) -> dict[str, str]:
    """Returns the provenance of this process as columns of a record.

    Args:
        bits: fingerprint of small trainings; equal if the code gives the same numbers.

    Returns:
        `commit` (`git describe` of the checkout, `-dirty` with changes outside `results/`; else the
        package's version), `bits`, `cpu`, `scan_backend` and the version of `torch`.
    """
    import torch

    from offbeat.kernels import backend

    return {
        "commit": commit(),
        "bits": bits,
        "cpu": cpu(),
        "scan_backend": backend()[0],
        "torch": torch.__version__,
    }


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
    # Installed inside another project's checkout: that project's commit does not apply.
    if not top or Path(top).resolve() / "src" / "offbeat" != PACKAGE.resolve():
        return f"offbeat {__version__}"
    described = git("describe", "--always", "--abbrev=12")
    if not described:
        return f"offbeat {__version__}"
    # Runs write to results/, which must not mark later runs as made by changed code.
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
