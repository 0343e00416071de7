"""`offbeat doctor`."""

from __future__ import annotations

from offbeat.cli.common import say


def doctor_command(json: bool = False) -> None:
    """Print versions, threads and what is installed.

    Args:
        json: print the findings as JSON.
    """
    from offbeat.doctor import examine

    findings = examine()
    width = max(len(name) for name in findings)
    text = "\n".join(f"{name.ljust(width)}  {value}" for name, value in findings.items())
    say(findings, text, json)
