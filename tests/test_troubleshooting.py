"""Messages quoted in docs/troubleshooting.md match the tool's messages word for word."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
HEADS = re.findall(r"^\*\*(.*)\*\*$", PAGE, re.MULTILINE)


@pytest.fixture(scope="module")
def sources() -> str:
    """All of the package with texts that stand in several literals joined to one."""
    package = ROOT / "pdhef_logtool"
    files = (p for kind in ("*.py", "templates/*.txt") for p in sorted(package.rglob(kind)))
    text = "\n".join(p.read_text(encoding="utf-8") for p in files)
    return re.sub(r"[\"']\s*\n\s*f?[\"']", "", text)


def test_the_page_has_what_people_meet_most() -> None:
    assert len(HEADS) > 15


@pytest.mark.parametrize("head", HEADS)
def test_a_quoted_message_is_one_of_ours(head: str, sources: str) -> None:
    for quoted in re.findall("`([^`]*)`", head):
        for words in quoted.split("…"):
            assert words.strip().removeprefix("expected ").strip(" ,:") in sources
