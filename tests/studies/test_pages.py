"""Shared parts of the pages, and the existence of the commands and files named in documents."""

from __future__ import annotations

import re
from importlib.util import find_spec

from studies.pages import DOCS, ROOT

DOCUMENTS = [*DOCS.glob("*.md"), *ROOT.glob("*.md"), ROOT / "Makefile", *ROOT.glob("sample_logs/*.toml")]
TEXTS = {p.name: p.read_text(encoding="utf-8") for p in DOCUMENTS}


def test_every_command_and_file_that_a_document_names_is_there() -> None:
    named = {(p, m) for p, t in TEXTS.items() for m in re.findall(r"-m ((?:benchmarks|studies)(?:\.\w+)*)", t)}
    assert {"studies.paper", "studies.peers", "benchmarks.performance"} <= {m for _, m in named}
    assert not {(p, m) for p, m in named if find_spec(m) is None}
    files = {(p, f) for p, t in TEXTS.items() for f in re.findall(r"(?:benchmarks|studies)/[\w/]+\.py", t)}
    assert files
    assert not {(p, f) for p, f in files if not (ROOT / f).is_file()}
