"""The filters take the measurements that there are: without a_y, without yaw rate, without both."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from pdhef_logtool import Car, read_drive
from pdhef_logtool.runs.frames import estimate, score

NAMES = ("open-loop", "phy-ukf", "physics", "pd-hef")


def sideslip_rmse(log: Path, *missing: str) -> dict[str, float]:
    """Return the RMSE by estimator of a log that lacks signals."""

    def without(_log: object, mapping: object, _tell: object) -> object:
        return replace(mapping, signals={k: v for k, v in mapping.signals.items() if k not in missing})  # type: ignore[type-var, attr-defined]

    with read_drive(log, Car.load("saloon"), adjust=without) as drive:  # type: ignore[arg-type]
        rows = score(estimate(drive, NAMES)).filter(signal="sideslip_rad", segment="all", metric="rmse")
    return dict(zip(rows["estimator"], rows["value"], strict=True))


@pytest.mark.parametrize("missing", [("ay_m_s2",), ("yaw_rate_rad_s",), ("ay_m_s2", "yaw_rate_rad_s")])
def test_physics_runs_on_what_there_is_and_what_there_is_helps(missing: tuple[str, ...], sample_logs_dir: Path) -> None:
    whole = sideslip_rmse(sample_logs_dir / "dlc.mcap")
    less = sideslip_rmse(sample_logs_dir / "dlc.mcap", *missing)
    assert less.keys() == whole.keys() == set(NAMES)
    assert whole["physics"] < less["physics"] < 1.02 * less["open-loop"]
