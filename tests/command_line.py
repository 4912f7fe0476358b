"""The command line, called in this process."""

from __future__ import annotations

import json
from typing import Any

import pytest

from pdhef_logtool.cli.app import app


def pdhef(*arguments: object) -> None:
    """Run a command that ends well."""
    assert not app([str(a) for a in arguments], prog_name="pdhef", standalone_mode=False)


def said(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    """Run a command and return what it says with ``--json``."""
    capsys.readouterr()
    pdhef(*arguments, "--json")
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found
