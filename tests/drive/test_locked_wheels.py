"""A wheel that locks or spins gives no evidence for a unit or a sign."""

from __future__ import annotations

from pathlib import Path

from pdhef_logtool.drive.reading import read_drive
from truthsim.drive import simulate_drive, write_drive
from truthsim.faults import parse_fault


def test_a_wheel_that_reads_0_in_a_bend_makes_no_unit_wrong(tmp_path: Path) -> None:
    """The rear wheels slip when the car brakes to a stop: their difference is no yaw rate any more."""
    drive = simulate_drive(
        "brake-in-turn",
        speed_km_h=90.46174692977121,
        friction=0.9838833092370343,
        seed=484091166,
        duration_s=12.5,
        amplitude=1.0865356241287265,
        faults=(parse_fault("dead:wheel_fl:2.40:4.98"),),
    )
    path = tmp_path / "brake.mcap"
    write_drive(drive, path)
    with read_drive(path, Path(__file__).parents[2] / "sample_logs" / "vehicle.toml") as opened:
        assert [c.name for c in opened.checks if c.verdict == "failed"] == []
        passed = {c.name for c in opened.checks if c.verdict == "passed"}
    assert {f"wheel_speed_{w}_m_s.unit" for w in ("fl", "fr", "rl", "rr")} <= passed
