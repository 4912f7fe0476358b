"""Rows of the gates without the files that they need."""

from __future__ import annotations

from pathlib import Path

import pytest

from studies.gates import __main__ as gates
from studies.gates.rows import GateRow


def test_a_row_without_its_files_is_skipped_with_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    absent = tmp_path / "drive.mcap"
    row = GateRow("recorded drives", "drive.mcap", lambda _: pytest.fail("measured"), needs=(absent,))
    monkeypatch.setattr(gates, "all_rows", lambda: [row])
    assert gates.main(["--work", str(tmp_path / "work")]) == 0
    out, err = capsys.readouterr()
    assert f"recorded drives/drive.mcap: skipped, because {absent} is absent" in err
    assert out == "no figure moved\n"
