"""``pdhef convert``: the MCAP of a log gives the same columns, the same mapping and the same estimates."""

import json
import math
import re
import shlex
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool import Car, estimate, inspect_log, read_drive
from pdhef_logtool.evaluation.largest_errors import largest_errors
from pdhef_logtool.logs.conversion import convert_log
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.records.tracks import make_track
from tests.command_line import called

COLUMNS = {
    "Lateral Acc. [g]": ("ay_m_s2", 1.0 / 9.80665),
    "Longitudinal Acc. [m/s²]": ("ax_m_s2", 1.0),
    "Yaw Rate [°/s]": ("yaw_rate_rad_s", math.degrees(1.0)),
    "Road Wheel Angle [deg]": ("steer_rad", math.degrees(1.0)),
    "Speed [km/h]": ("speed_m_s", 3.6),
}


@pytest.fixture(scope="module")
def table(sample_logs_dir, tmp_path_factory):
    """A CSV file with the signals of a sample log; the speed in every second row."""
    with read_drive(sample_logs_dir / "dlc.mcap", Car.load("saloon")) as drive:
        signals = drive.whole().signals
    cells = [[f"{s * 1e-9:.2f}" for s in signals.stamps_ns[10:-10] - signals.stamps_ns[0]]]
    for signal, scale in COLUMNS.values():
        values = getattr(signals, signal)[10:-10] * scale
        every = 2 if signal == "speed_m_s" else 1
        cells.append([f"{v:.6f}" if i % every == 0 else "" for i, v in enumerate(values)])
    rows = [";".join(row).replace(".", ",") for row in zip(*cells, strict=True)]
    path = tmp_path_factory.mktemp("table") / "drive.csv"
    path.write_bytes("\n".join([";".join(["Time [s]", *COLUMNS]), *rows, ""]).encode("latin-1"))
    return path


def _same_columns(one: DriveLog, two: DriveLog) -> None:
    assert [(t.name, t.messages) for t in one.topics] == [(t.name, t.messages) for t in two.topics]
    for topic in one.topics:
        fields = {f.path: f.unit for f in one.fields(topic.name)}
        assert {f.path: f.unit for f in two.fields(topic.name)} == fields
        first, second = (log.read({topic.name: tuple(fields)})[topic.name] for log in (one, two))
        np.testing.assert_array_equal(first.log_time_ns, second.log_time_ns)
        for path in fields:
            np.testing.assert_array_equal(first.fields[path], second.fields[path])


def test_a_converted_table_has_the_same_columns_mapping_and_estimates(table, tmp_path):
    output = tmp_path / "drive.mcap"
    done = called("convert", table, "-o", output)
    assert done.returncode == 0, done.stderr
    with closing(open_log(table)) as one, closing(open_log(output)) as two:
        _same_columns(one, two)
    mapped = [{n: (s.topic, s.paths) for n, s in inspect_log(p).mapping.signals.items()} for p in (table, output)]
    assert mapped[0] == mapped[1]
    assert set(mapped[0]) == {signal for signal, _ in COLUMNS.values()}
    tracks = []
    for path in (table, output):
        with read_drive(path, Car.load("saloon")) as drive:
            tracks.append(estimate(drive, ["phy-ukf"]).tracks["phy-ukf"])
    np.testing.assert_array_equal(*(t.sideslip_rad for t in tracks))
    assert np.nanmax(np.abs(tracks[0].sideslip_rad)) > 0.01


def test_frames_and_messages_are_converted(sample_logs_dir, tmp_path):
    can = pytest.importorskip("can")
    with can.BLFWriter(str(tmp_path / "a.blf")) as writer:
        for i in range(50):
            data = bytes(range(i % 9))
            writer.on_message_received(can.Message(timestamp=1.7e9 + i * 0.01, arbitration_id=i, data=data, channel=0))
    convert_log(tmp_path / "a.blf", tmp_path / "a.mcap")
    with closing(open_log(tmp_path / "a.blf")) as one, closing(open_log(tmp_path / "a.mcap")) as two:
        wanted = {"can": ["id", "length", "data", "is_extended"]}
        frames, copies = (log.read(wanted)["can"].fields for log in (one, two))
    for path in ("id", "length", "is_extended"):
        np.testing.assert_array_equal(frames[path], copies[path])
    np.testing.assert_array_equal(np.nan_to_num(frames["data"]), copies["data"])
    convert_log(sample_logs_dir / "dlc.mcap", tmp_path / "copy.mcap")
    with closing(open_log(sample_logs_dir / "dlc.mcap")) as one, closing(open_log(tmp_path / "copy.mcap")) as two:
        topic = next(t.name for t in one.topics if t.type_name.endswith("Imu"))
        columns = [log.read({topic: ["angular_velocity.z"]})[topic] for log in (one, two)]
    np.testing.assert_array_equal(*(c.fields["angular_velocity.z"] for c in columns))


def test_a_conversion_is_complete_or_absent(table, tmp_path):
    output = tmp_path / "drive.mcap"
    output.write_bytes(b"mine")
    done = called("convert", table, "-o", output)
    assert (done.returncode, output.read_bytes()) == (1, b"mine")
    assert "one that exists" in done.stderr
    (tmp_path / "bad.csv").write_text("a,b\n1,2\n")
    assert called("convert", tmp_path / "bad.csv", "-o", tmp_path / "no.mcap").returncode == 1
    (tmp_path / "cut.csv").write_bytes(table.read_bytes()[:-30])
    done = called("convert", tmp_path / "cut.csv", "-o", tmp_path / "cut.mcap")
    assert done.returncode == 3
    assert "incomplete" in done.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bad.csv", "cut.csv", "cut.mcap", "drive.mcap"]


_REPO = Path(__file__).parents[2]
_LIGHT = ("--end", "3", "--annotate", "none")


@pytest.mark.slow
def test_the_first_command_of_the_readme_answers_with_an_error_and_no_verdict(tmp_path):
    line = next(s for s in (_REPO / "README.md").read_text().splitlines() if s.startswith("pdhef run"))
    _, *words = shlex.split(line, comments=True)
    words[words.index("-o") + 1] = str(tmp_path / "out")
    done = called(*words, cwd=_REPO)
    assert done.returncode == 0
    assert re.match(r"Result +Sideslip RMSE of pd-hef: 0\.\d+°", done.stdout)
    page = next((tmp_path / "out").glob("logs/*/report.html")).read_text()
    for text in (done.stdout, page):
        assert not re.search(r"INCONCLUSIVE|FAIL|more driving|s more\b", text)
    report = json.loads(next((tmp_path / "out").glob("logs/*/report.json")).read_text())
    assert f"speed up to {report['operating_space']['speed_max_m_s']:.1f} m/s" in page


def test_only_the_named_estimator_runs_and_is_judged(sample_logs_dir, tmp_path, capfd):
    out = tmp_path / "of 1.0 (ä)"  # characters that Rerun would warn of
    done = called("run", sample_logs_dir / "dlc.mcap", "-e", "linear-kf", *_LIGHT, "-o", out)
    assert done.stdout.startswith("Result   Sideslip RMSE of linear-kf: ")
    assert "WARN" not in capfd.readouterr().err
    assert "pd-hef" not in done.stdout
    assert "not causal" not in done.stdout
    report = json.loads((out / "logs/dlc/report.json").read_text())
    assert [e["name"] for e in report["estimators"]] == ["linear-kf"]
    assert "pd-hef" not in (out / "logs/dlc/report.html").read_text()


def test_a_table_without_a_date_is_of_no_year(tmp_path):
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


def test_the_start_of_an_estimate_is_not_its_largest_error():
    stamps_ns = np.arange(1000) * 10_000_000
    still = np.zeros(1000)
    truth = make_track("truth", stamps_ns, vx_m_s=still + 10.0, vy_m_s=still, yaw_rate_rad_s=still)
    vy = np.where(np.arange(1000) < 50, 5.0, 0.0)
    vy[700] = 0.1
    estimate = make_track("physics", stamps_ns, vx_m_s=still + 10.0, vy_m_s=vy, yaw_rate_rad_s=still)
    places = largest_errors(estimate, truth, (), 1.0)
    assert [p["stamp_ns"] for p in places] == [7_000_000_000]
