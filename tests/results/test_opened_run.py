"""A finished run read back."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.results.opened_run import open_run
from pdhef_logtool.storage.documents import seal


def _run(folder: Path, logs: list[object], **changed: object) -> Path:
    (folder / "run.json").write_text(json.dumps(seal({"format": "pdhef.run", "logs": logs, **changed})))
    return folder


def test_logs_stand_in_the_order_of_the_run_and_failed_ones_have_no_report(tmp_path: Path) -> None:
    (tmp_path / "logs" / "b").mkdir(parents=True)
    (tmp_path / "logs" / "b" / "report.json").write_text('{"format": "pdhef.report"}')
    run = open_run(_run(tmp_path, [{"log": "b", "outcome": "ok"}, {"log": "a", "outcome": "failed: empty"}]))
    assert [(x.label, x.outcome) for x in run.logs] == [("b", "ok"), ("a", "failed: empty")]
    assert run.logs[0].report() == {"format": "pdhef.report"}
    assert run.logs[1].report() is None
    assert run.logs[0].estimates() is None


@pytest.mark.parametrize("label", ["../out", "a/b", "..", "", 3, None])
def test_a_label_that_leads_out_of_the_folder_is_refused(tmp_path: Path, label: object) -> None:
    with pytest.raises(OutputError, match="name of a log's folder"):
        open_run(_run(tmp_path, [{"log": label, "outcome": "ok"}]))


def test_a_folder_that_is_no_run_is_refused_with_what_it_lacks(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"without run\.json"):
        open_run(tmp_path)
    with pytest.raises(OutputError, match="no such folder") as missing:
        open_run(tmp_path / "none")
    assert missing.value.exit_code == 2
    with pytest.raises(OutputError, match="format 'other'"):
        open_run(_run(tmp_path, [], format="other"))
