"""What a person sees who runs one log: an error first, only the estimators that were named, no invented date."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.evaluation.largest_errors import largest_errors
from pdhef_logtool.records.tracks import make_track
from tests.command_line import called

_REPO = Path(__file__).parents[2]
_LIGHT = ("--end", "3", "--annotate", "none")


@pytest.mark.slow
def test_the_first_command_of_the_readme_answers_with_an_error_and_no_verdict(tmp_path: Path) -> None:
    line = next(s for s in (_REPO / "README.md").read_text().splitlines() if s.startswith("pdhef run"))
    _, *words = shlex.split(line, comments=True)
    words[words.index("-o") + 1] = str(tmp_path / "out")
    done = called(*words, cwd=_REPO)
    assert done.returncode == 0
    assert re.match(r"Result +Sideslip RMSE of pd-hef: 0\.\d+°", done.stdout)
    page = next((tmp_path / "out").glob("logs/*/report.html")).read_text()
    for text in (done.stdout, page):
        assert not re.search(r"INCONCLUSIVE|FAIL|more driving|s more\b", text)
    top = json.loads(next((tmp_path / "out").glob("logs/*/report.json")).read_text())["operating_space"][
        "speed_max_m_s"
    ]
    assert f"speed up to {top:.1f} m/s" in page


def test_only_the_named_estimator_runs_and_is_judged(
    sample_logs_dir: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "of 1.0 (ä)"  # characters that Rerun would warn of
    done = called("run", sample_logs_dir / "dlc.mcap", "-e", "linear-kf", *_LIGHT, "-o", out)
    assert done.stdout.startswith("Result   Sideslip RMSE of linear-kf: ")
    assert "WARN" not in capfd.readouterr().err
    assert "pd-hef" not in done.stdout
    assert "not causal" not in done.stdout
    report = json.loads((out / "logs/dlc/report.json").read_text())
    assert [e["name"] for e in report["estimators"]] == ["linear-kf"]
    assert "pd-hef" not in (out / "logs/dlc/report.html").read_text()


def test_a_table_without_a_date_is_of_no_year(tmp_path: Path) -> None:
    t = np.arange(0.0, 12.0, 0.02)
    steer, speed = 0.04 * np.sin(1.5 * t), 15.0 + 0.5 * np.sin(0.8 * t)
    rate = speed * steer / 2.7
    columns = {
        "Time [s]": t, "Steering angle [rad]": steer, "Yaw rate [rad/s]": rate, "Speed [m/s]": speed,
        "Longitudinal acceleration [m/s2]": 0.0 * t, "Lateral acceleration [m/s2]": speed * rate,
    }  # fmt: skip
    log = tmp_path / "drive.csv"
    np.savetxt(log, np.stack([*columns.values()], axis=1), "%.6f", ",", header=",".join(columns), comments="")
    done = called("run", log, "-e", "zero,open-loop", *_LIGHT, "-o", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    written = (tmp_path / "out/logs/drive/report.html").read_text()
    text = done.stdout + re.sub(r"(?s)<script.*?</script>", "", written) + called("inspect", log).stdout
    assert "1970" not in text
    assert "csv, 12.0 s without a date, 600 messages on 1 topic\n" in text
    assert json.loads((tmp_path / "out/run.json").read_text())["logs"][0]["day"] is None


def test_the_start_of_an_estimate_is_not_its_largest_error() -> None:
    stamps_ns = np.arange(1000) * 10_000_000
    still = np.zeros(1000)
    truth = make_track("truth", stamps_ns, vx_m_s=still + 10.0, vy_m_s=still, yaw_rate_rad_s=still)
    vy = np.where(np.arange(1000) < 50, 5.0, 0.0)
    vy[700] = 0.1
    estimate = make_track("physics", stamps_ns, vx_m_s=still + 10.0, vy_m_s=vy, yaw_rate_rad_s=still)
    places = largest_errors(estimate, truth, (), 1.0)
    assert [p["stamp_ns"] for p in places] == [7_000_000_000]
