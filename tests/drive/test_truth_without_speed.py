"""Ground truth of sideslip alone is scored where the log's speed sensor shows that the car is fast enough."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.evaluation.track_errors import signal_error
from pdhef_logtool.records.tracks import make_track

SLOW_M_S, RATE_HZ = 1.0, 50


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write 20 s of driving: at 10 s the car stops, at 14 s the sensors fail for 2 s beside the ground truth."""
    path = tmp_path_factory.mktemp("log") / "correvit.csv"
    t = np.arange(20 * RATE_HZ) / RATE_HZ
    speed = np.where((t > 10.0) & (t < 12.0), 0.0, 20.0)
    rate = np.where(speed > 0.0, 0.2 * np.sin(2.0 * t), 0.0)
    lines = ["time [s],Speed [m/s],YawRate [rad/s],AccY [m/s2],AccX [m/s2],Sideslip [rad]"]
    for i in range(len(t)):
        sensors = f"{speed[i]},{rate[i]},{speed[i] * rate[i]},0" if not 14.0 <= t[i] < 16.0 else ",,,"
        lines.append(f"{t[i]:.2f},{sensors},{-0.1 * rate[i]:.5f}")
    path.write_text("\n".join(lines))
    return path


def test_sideslip_alone_is_scored_above_the_measured_low_speed_limit(log: Path) -> None:
    mapping = log.with_suffix(".toml")
    entry = '[{}]\ntopic = "csv"\nfield = "{}"\n'
    fields = {"speed_m_s": "Speed", "yaw_rate_rad_s": "YawRate", "ay_m_s2": "AccY", "ax_m_s2": "AccX"}
    signals = [entry.format(f"signals.{name}", field) for name, field in fields.items()]
    mapping.write_text("".join([*signals, entry.format("truth.sideslip_rad", "Sideslip")]))
    with read_drive(log, "saloon", mapping) as drive:
        whole = drive.whole()
    truth, seconds = whole.truth, (whole.signals.stamps_ns - whole.log_start_ns) * 1e-9
    assert truth is not None and not np.isfinite(truth.vx_m_s).any()
    estimate = make_track("zero", truth.stamps_ns, sideslip_rad=np.zeros(len(truth)))
    scored = np.isfinite(signal_error(estimate, truth, "sideslip_rad", SLOW_M_S))
    standing = (seconds > 10.05) & (seconds < 11.95)
    driving = (seconds > 0.1) & (seconds < 9.9) | (seconds > 12.1) & (seconds < 19.9)
    assert scored[driving].all()
    assert not scored[standing].any()
    assert not ((seconds > 14.01) & (seconds < 15.99)).any()
    np.testing.assert_allclose(whole.truth.measured_speed_m_s[driving], 20.0, atol=0.01)
