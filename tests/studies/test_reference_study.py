"""The study of the sideslip reference: its cases, made receivers, faults, stored figures and page."""

import json

import numpy as np

from pdhef_logtool import inspect_log
from studies import reference as study
from studies.pages import DOCS, RESULTS, fill


def test_names_of_cases_are_unique_and_all_are_stored_and_on_the_page():
    names = [case.name for case in study.cases()]
    assert len(set(names)) == len(names)
    stored = json.loads((RESULTS / "reference" / study.STORED).read_text(encoding="utf-8"))
    assert set(names) <= set(stored)
    page = (DOCS / "reference.md").read_text(encoding="utf-8")
    assert page == fill(page, study.blocks(stored), "reference.md")


def test_added_gnss_is_read_as_a_topic_of_the_log(sample_logs_dir, tmp_path):
    log = sample_logs_dir / "step.mcap"
    start = inspect_log(log).to_dict()["start_ns"]
    stamps = start + np.arange(20, dtype=np.int64) * 100_000_000
    copy = study.add_gnss(log, tmp_path / "copy.mcap", stamps, np.full((20, 2), 3.0))
    before, after = ({t["name"]: t["messages"] for t in inspect_log(p).to_dict()["topics"]} for p in (log, copy))
    assert after == before | {study.GNSS_TOPIC: 20}
