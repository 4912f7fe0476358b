"""Recorded estimates against the sideslip reference: without ground truth, beside it, and never mixed."""

from __future__ import annotations

import numpy as np
import pytest

from pdhef_logtool.records.errors import MappingError
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.recorded_estimates import score_log
from tests.runs.test_run import NO_TRUTH_MAPPING

ESTIMATE = ("/rtk/odometry",)


def _metrics(log, **settings):
    config = RunConfig(car=log.parent / "vehicle.toml", end="8", **settings)
    report = score_log(str(log), config, estimates=ESTIMATE).results[0].report
    assert report is not None
    found = {m["metric"]: m["value"] for m in report["metrics"] if m["signal"] == "sideslip_rad"}
    return report, found


def test_beside_ground_truth_both_figures_exist(sample_logs_dir):
    log = sample_logs_dir / "dlc.mcap"
    report, found = _metrics(log, reference="on")
    assert report["truth"]["available"]
    assert np.degrees(found["rmse"]) < 0.1
    assert np.degrees(found["reference_rms"]) < 3.0 * np.degrees(found["reference_std"])
    _, alone = _metrics(log)
    assert alone["rmse"] == found["rmse"]
    assert "reference_rms" not in alone


def test_without_ground_truth_no_figure_is_an_error(sample_logs_dir, tmp_path):
    mapping = tmp_path / "mapping.toml"
    mapping.write_text(NO_TRUTH_MAPPING)
    report, found = _metrics(sample_logs_dir / "dlc.mcap", mapping=mapping)
    assert not report["truth"]["available"]
    assert "rmse" not in found
    assert np.degrees(found["reference_rms"]) < 0.5
    with pytest.raises(MappingError, match="ground truth"):
        _metrics(sample_logs_dir / "dlc.mcap", mapping=mapping, reference="off")
