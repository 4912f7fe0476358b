"""Source of the friction of a run; that of the ground truth is for datasets and segments, not for estimators."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.drive.friction import FrictionFrom, friction_source, parse_friction
from pdhef_logtool.drive.reading import Drive, friction_of, read_drive
from pdhef_logtool.evaluation.segments import segment_masks
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.runs.config import RunConfig

VEHICLE = default_vehicle().model_copy(update={"name": "golf"})
NO_FRICTION = VEHICLE.model_copy(update={"friction": None})
ALL = frozenset({"steer_rad", "ay_m_s2", "friction"})


@pytest.mark.parametrize(
    ("choice", "vehicle", "available", "label"),
    [
        ("auto", VEHICLE, ALL, "topic /road.mu"),
        ("auto", VEHICLE, ALL - {"friction"}, "vehicle file, 0.85"),
        ("auto", default_vehicle(), ALL - {"friction"}, "default sedan, 0.85"),
        ("auto", NO_FRICTION, ALL - {"friction"}, "no value given, 1"),
        ("file", VEHICLE, ALL, "vehicle file, 0.85"),
        (0.4, VEHICLE, ALL, "option, 0.4"),
    ],
)
def test_the_source_is_named(choice, vehicle, available, label):
    source = friction_source(choice, vehicle, available, "/road.mu")
    assert source.label == label
    assert bool(source.note) == label.startswith("no value given")
    assert source.is_given is not label.startswith(("no value given", "default sedan"))


def test_a_file_without_friction_is_refused():
    with pytest.raises(UsageError, match="friction"):
        friction_source("file", NO_FRICTION, ALL)


@pytest.mark.parametrize("text", ["wet", "", "nan", "-0.3", "0", "6", "inf", "estimate"])
def test_other_texts_are_refused(text):
    with pytest.raises(UsageError, match="--friction"):
        parse_friction(text)


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
