"""Friction of the ground truth: datasets and segments use it; the estimators of a run do not receive it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.drive.friction import FrictionFrom
from pdhef_logtool.drive.reading import Drive, friction_of, read_drive
from pdhef_logtool.evaluation.segments import segment_masks
from pdhef_logtool.runs.config import RunConfig


def _read(logs: Path, **options: object) -> Drive:
    """Open a drive on a road with friction 0.3; the vehicle file states 0.85."""
    return read_drive(logs / "sweep.mcap", logs / "vehicle.toml", options=RunConfig(end="4", **options).read_options)  # type: ignore[arg-type]


def test_a_dataset_takes_the_friction_of_the_ground_truth(sample_logs_dir: Path) -> None:
    with _read(sample_logs_dir) as drive:
        frictions = []
        for of_truth in (True, False):
            drive.friction = friction_of(drive.plan, drive.car.vehicle, drive.options, of_truth=of_truth)
            frictions.append(drive.whole().signals.friction)
        known = np.isfinite(frictions[0])
        np.testing.assert_allclose(frictions[0][known], 0.3, atol=1e-6)
        assert known.mean() > 0.9
        assert not np.isfinite(frictions[1]).any()  # friction of the vehicle file
        assert drive.friction.label == "vehicle file, 0.85"


@pytest.mark.parametrize("options", [{"friction": 0.5}, {"prefer_truth": "rtk"}])
def test_a_friction_of_the_options_and_another_ground_truth_go_before(
    sample_logs_dir: Path, options: dict[str, object]
) -> None:
    with _read(sample_logs_dir, **options) as drive:
        source = friction_of(drive.plan, drive.car.vehicle, drive.options, of_truth=True)
        assert source.source is not FrictionFrom.TRUTH


def test_segments_take_the_friction_of_the_ground_truth_and_estimators_do_not(sample_logs_dir: Path) -> None:
    with _read(sample_logs_dir) as drive:
        whole, vehicle = drive.whole(), drive.car.vehicle
    assert whole.truth is not None and "friction" not in whole.signals.available
    assert not np.isfinite(whole.signals.friction).any()
    nonlinear = segment_masks(whole.signals, whole.truth, vehicle)["nonlinear"]
    assert nonlinear.any()
    assert np.abs(whole.truth.ay_m_s2[nonlinear]).max() < 0.5 * 0.85 * 9.81
