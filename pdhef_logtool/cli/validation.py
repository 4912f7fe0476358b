"""``pdhef plan init``: a validation plan to start from."""

from __future__ import annotations

from pathlib import Path

from pdhef_logtool.cli import console, options
from pdhef_logtool.records.errors import UsageError


@options.command()
def plan(action: str, *, output: Path) -> None:
    """Write a validation plan: requirements for run, metrics and compare."""
    from pdhef_logtool.evaluation.plan_example import EXAMPLE
    from pdhef_logtool.storage.files import write_bytes

    if action != "init":
        raise UsageError(expected="init", got=action, where="pdhef plan", remedy="pdhef plan init -o plan.toml")
    if output.exists():
        raise UsageError(expected="a new file", got="one that exists", where=str(output), remedy="choose another name")
    write_bytes(output, EXAMPLE.encode())
    console.say(f"{output} written; use it: pdhef run LOGS -o OUT --plan {output}")
