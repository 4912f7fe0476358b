"""The whole inspection of a log, as record, as JSON, as tables and as a mapping to edit."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from fake_drive_log import FakeLog, FakeTopic

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.mapping import Mapping, SignalSource, load_mapping
from pdhef_logtool.records.errors import MappingError
from pdhef_logtool.records.signals import Loss
from pdhef_logtool.runs.inspection import inspect_drive_log, inspect_log, render_inspection, write_mapping
from tests.command_line import rendered
from tests.runs.wrong_mapping import wrong_sign

T0 = 1_700_000_000_000_000_000


def small_log(n: int = 3000, period_ms: int = 10) -> FakeLog:
    """An IMU with a gap of 1.51 s after 10 s, a late publisher, and a vendor topic that nobody recognises."""
    stamps = T0 + np.arange(n, dtype=np.int64) * period_ms * 1_000_000
    stamps[1001:] += 1_500_000_000
    rng = np.random.default_rng(0)
    imu = FakeTopic(
        "sensor_msgs/msg/Imu",
        stamps + 3_000_000,
        {
            "header.stamp": stamps,
            "linear_acceleration.x": rng.normal(size=n),
            "linear_acceleration.y": rng.normal(2.0, 3.0, size=n),
            "angular_velocity.z": rng.normal(size=n),
        },
        publish_time_ns=stamps + 1_000_000,
    )
    imu.fields["linear_acceleration.y"][5] = np.nan
    vendor = FakeTopic("vendor_msgs/msg/Box", stamps[::10] + 3_000_000, {"speed_kmh": np.zeros(len(stamps[::10]))})
    lost = (Loss("truncated", "the file ends early", "memory.mcap", start_ns=int(stamps[-1])),)
    return FakeLog({"/imu": imu, "/vendor": vendor}, lost=lost)


def test_topics_are_measured() -> None:
    log = small_log()
    found = inspect_drive_log(log)
    imu = next(t for t in found.topics if t.name == "/imu")
    assert (imu.messages, imu.type, imu.encoding) == (3000, "sensor_msgs/msg/Imu", "cdr")
    assert imu.rate_hz == pytest.approx(100.0)
    assert imu.jitter_p95_s == pytest.approx(0.0, abs=1e-9)
    assert imu.largest_gap_s == pytest.approx(1.51)
    assert imu.largest_gap_at_s == pytest.approx(10.0)
    assert imu.delay_median_s == pytest.approx(0.002)
    assert found.duration_s == pytest.approx(31.49, abs=1e-6)


def test_signals_are_measured() -> None:
    log = small_log()
    found = inspect_drive_log(log)
    ay = found.signals["ay_m_s2"]
    values = log.contents["/imu"].fields["linear_acceleration.y"]
    good = values[np.isfinite(values)]
    assert (ay.topic, ay.field, ay.samples, ay.gaps, ay.dropped) == (
        "/imu",
        "linear_acceleration.y",
        2999,
        1,
        {"nan": 1},
    )
    assert [ay.mean, ay.std, ay.minimum, ay.maximum] == pytest.approx([good.mean(), good.std(), good.min(), good.max()])
    assert ay.latency_s == pytest.approx(0.003)
    assert found.signals["ax_m_s2"].dropped == {}
    assert found.missing == ("steer_rad", "speed_m_s")
    assert [(x.kind, x.severity) for x in found.lost] == [("truncated", "lost"), ("nan", "lost")]
    assert found.is_partial


def test_a_mapping_that_does_not_fit_is_an_error() -> None:
    mapping = Mapping(signals={"speed_m_s": SignalSource("speed_m_s", "/vendor", "speed_kph")})
    with pytest.raises(MappingError, match="speed_kmh"):
        inspect_drive_log(small_log(), mapping)


def test_an_empty_log_is_reported() -> None:
    found = inspect_drive_log(FakeLog({}))
    assert found.topics == ()
    json.dumps(found.to_dict(), allow_nan=False)
    assert "missing" in rendered(render_inspection, found, 80)


@pytest.mark.parametrize("width", [80, 120])
def test_tables_fit_and_say_what_matters(width: int) -> None:
    text = rendered(render_inspection, inspect_drive_log(small_log()), width)
    assert max(len(line) for line in text.splitlines()) <= width
    for part in (
        "/imu",
        "sensor_msgs/Imu",
        "/vendor",
        "1.51 @ 10.0",
        "yaw_rate_rad_s",
        "linear_acceleration.y",
        "steer_rad",
    ):
        assert part in text, part
    assert "lost" in text
    assert "the file ends early" in text


def test_the_written_mapping_loads_and_names_the_candidates(tmp_path: Path) -> None:
    found = inspect_drive_log(small_log())
    path = tmp_path / "m.toml"
    write_mapping(found, path)
    again = load_mapping(path)
    assert again.signals == found.mapping.signals
    text = path.read_text()
    assert "# [signals.speed_m_s]" in text
    assert "/vendor (vendor_msgs/msg/Box): speed_kmh" in text
    assert "# sensor_msgs/msg/Imu, 100 Hz, " in text
    assert [p.name for p in tmp_path.iterdir()] == ["m.toml"]


def test_a_drive_has_its_checks_and_tells_the_failed_ones(sample_logs_dir: Path, tmp_path: Path) -> None:
    told: list[str] = []
    log, car = sample_logs_dir / "sweep.mcap", Car.load(sample_logs_dir / "vehicle.toml")
    mapping = load_mapping(wrong_sign(log, tmp_path))
    options = ReadOptions(waived=("steer_rad.sign", "steer.sign"))
    with read_drive(log, car, mapping, options, tell=told.append) as drive:
        (failed,) = (c for c in drive.checks if c.verdict == "failed")
    assert (failed.name, failed.waived) == ("steer_rad.sign", True)
    assert any("check steer_rad.sign failed (waived)" in text for text in told)
    assert any("--waive steer.sign: no check of this log is called that" in text for text in told)


def test_inspecting_shows_checks_of_the_same_names(sample_logs_dir: Path, tmp_path: Path) -> None:
    log = sample_logs_dir / "sweep.mcap"
    found = inspect_log(log, load_mapping(wrong_sign(log, tmp_path)))
    assert [c.name for c in found.checks if c.verdict == "failed"] == ["steer_rad.sign"]
    assert not found.is_partial
    (check,) = (c for c in json.loads(json.dumps(found.to_dict()))["checks"] if c["verdict"] == "failed")
    assert check["subject"] == "steer_rad"


# --------------------------------------------------------------------------------------------- real drives


@pytest.mark.slow
def test_a_log_with_a_dropout_and_losses(shared_dir: Path) -> None:
    found = inspect_log(shared_dir / "data" / "drives" / "faulty" / "revs_250lm_a_disorder.mcap")
    imu = next(t for t in found.topics if t.name == "/imu/data")
    assert imu.largest_gap_s == pytest.approx(30.01, abs=0.02)
    assert imu.largest_gap_at_s == pytest.approx(135.0, abs=0.1)
    counts = {(x.kind, x.where.split(" ")[0]): x.count for x in found.lost if x.kind in ("nan", "duplicate-stamp")}
    assert counts == {
        ("nan", "ay_m_s2"): 2,
        ("nan", "yaw_rate_rad_s"): 1,
        ("nan", "steer_rad"): 2,
        ("duplicate-stamp", "/imu/data"): 20,
    }
    assert found.signals["ay_m_s2"].dropped == {"nan": 2, "duplicate-stamp": 20}
    # The ground truth of the same name has lost no sample.
    assert found.truth["yaw_rate_rad_s"].dropped == {}
    assert found.is_partial
