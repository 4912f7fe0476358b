"""The check of retired terms finds them in every area, and leaves names of contracts and code alone."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

from tests import language_check


def test_each_area_is_read(tmp_path: Path) -> None:
    for folder in ("docs", "pdhef_logtool/cli", "pdhef_logtool/reports/templates"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "README.md").write_text("The stranger is told. `stranger` and network_trust are names.\n")
    (tmp_path / "ARCHITECTURE.md").write_text("```\ntold\n```\n")
    (tmp_path / "docs/page.md").write_text("Written by `a command`: told, told, told.\n")
    (tmp_path / "pdhef_logtool/cli/run.py").write_text(
        '"""What is told."""\n@command\ndef run():\n    """A slim log."""\n'
    )
    (tmp_path / "pdhef_logtool/drive.py").write_text('found = f"{x} is told"  # a belief\n\n\ndef f(own): ...\n')
    (tmp_path / "pdhef_logtool/reports/templates/page.html").write_text(
        '<p class="told">against the ground truth, anew</p>'
    )
    counts = Counter(hit.area for hit in language_check.hits(tmp_path))
    assert counts == {"documentation": 2, "help": 1, "messages": 2, "comments": 2, "names": 2}
