"""Logs with odd clocks and late topics are processed and say so; the rest equals the result of the sound log."""

import json
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from mcap.writer import CompressionType

from pdhef_logtool import Car, ReadOptions, inspect_log
from pdhef_logtool.cli.app import app
from pdhef_logtool.drive.reading import Drive, WholeDrive, read_drive
from pdhef_logtool.records.ledger import DAMAGE, DAMAGED_SHARE, SampleCount, damage
from pdhef_logtool.records.signals import Signals
from studies.mcap_logs import Message, messages, stamp_ns, stamped, write_log

S = 1_000_000_000

#: Nanoseconds to add: of the number of the message on its topic, the seconds since the log's start, and the topic.
Shift = Callable[[int, float, str], int]


def rewrite(
    source: Path, target: Path, log_shift: Shift, stamp_shift: Shift | None = None, chunk: int = 1 << 20
) -> None:
    """Copy an MCAP in order of log time, with log times moved, and header stamps (None: as the log times are)."""

    def moved() -> Iterator[Message]:
        numbers: Counter[str] = Counter()
        start_ns = next(messages(source)).log_time_ns
        for m in messages(source):
            at = (numbers[m.topic], (m.log_time_ns - start_ns) * 1e-9, m.topic)
            numbers[m.topic] += 1
            by = log_shift(*at)
            log_time = min(max(m.log_time_ns + by, 0), 2**64 - 1)
            if abs(stamp_ns(m) - m.log_time_ns) < 10 * S:
                m = stamped(m, stamp_ns(m) + (by if stamp_shift is None else stamp_shift(*at)))
            yield m._replace(log_time_ns=log_time, publish_time_ns=log_time)

    write_log(target, moved(), "ros2", chunk_size=chunk, compression=CompressionType.LZ4)


YEARS = 10 * 365 * 86_400 * S
START = 1_767_225_600 * S


@pytest.fixture(scope="module")
def car():
    return Car.load(Path(__file__).resolve().parents[2] / "sample_logs/vehicle.toml", network=Path("none"))


def read(path: Path, car: Car, **options: object) -> tuple[Drive, WholeDrive]:
    with read_drive(path, car, options=ReadOptions(friction=1.0, **options)) as drive:
        whole = drive.whole()
        for s in drive.recorded().ledger:
            assert s.used + sum(s.dropped.values()) == s.total, s
            assert "not-read" not in s.dropped
        return drive, whole


def kinds(drive: Drive) -> dict[str, str]:
    return {x.kind: x.severity for x in drive.losses if x.kind != "gap"}


def dropped(drive: Drive) -> dict[str, int]:
    return dict(next(s.dropped for s in drive.recorded().ledger if s.name == "yaw_rate_rad_s" and s.role == "signal"))


def same_at_common_stamps(whole: WholeDrive, sound: WholeDrive, least: int) -> None:
    _, i, j = np.intersect1d(whole.signals.stamps_ns, sound.signals.stamps_ns, return_indices=True)
    assert len(i) >= least
    np.testing.assert_array_equal(whole.signals.yaw_rate_rad_s[i], sound.signals.yaw_rate_rad_s[j])
    known = whole.truth.valid[i] & sound.truth.valid[j]
    assert known.sum() >= least - 250
    np.testing.assert_allclose(whole.truth.vy_m_s[i][known], sound.truth.vy_m_s[j][known], atol=1e-6)


def test_a_sound_log_uses_every_sample(sample_logs_dir, car):
    drive, _ = read(sample_logs_dir / "dlc.mcap", car)
    assert drive.losses == ()
    assert all(s.used == s.total and not s.dropped for s in drive.recorded().ledger)
    drive, _ = read(sample_logs_dir / "dlc.mcap", car, start="2", end="5")
    assert drive.losses == ()
    assert {reason for s in drive.recorded().ledger for reason in s.dropped} == {"outside-slice"}


@pytest.mark.slow
@pytest.mark.parametrize("at_ns", [0, 2**64 - 1])
def test_one_message_at_the_end_of_time(at_ns, sample_logs_dir, tmp_path, car):
    def shift(number: int, at_s: float, topic: str) -> int:
        return (2 * at_ns - 2**64) if (topic, number) == ("/truth/perfect/state", 250) else 0

    log = tmp_path / "stray.mcap"
    rewrite(sample_logs_dir / "dlc.mcap", log, shift, lambda *_: 0)
    drive, whole = read(log, car)
    sound = read(sample_logs_dir / "dlc.mcap", car)[1]
    assert kinds(drive) == {"outlier": "note"}
    same_at_common_stamps(whole, sound, len(sound.signals))
    assert inspect_log(log).duration_s == pytest.approx(9.51, abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize(("until_s", "kept"), [(2.0, 0.75), (7.5, 0.75)])
def test_a_clock_that_is_set(until_s, kept, sample_logs_dir, tmp_path, car):
    log = tmp_path / "boot.mcap"
    rewrite(sample_logs_dir / "dlc.mcap", log, lambda _n, at_s, _t: -YEARS if at_s < until_s else 0)
    drive, whole = read(log, car)
    assert kinds(drive) == {"other-epoch": "lost", "dropped-samples": "lost"}
    assert set(dropped(drive)) == {"other-epoch"}
    assert len(whole.signals) / 951 == pytest.approx(kept, abs=0.06)
    assert drive.plan.start_ns == drive.log.start_ns  # a slice counts from the epoch that is kept
    assert (whole.signals.stamps_ns[0] < START) == (until_s > 5.0)


@pytest.mark.slow
@pytest.mark.parametrize("chunk", [30_000, 1 << 26])
def test_a_clock_that_steps_back(chunk, sample_logs_dir, tmp_path, car):
    """Log time and header stamps fall back by 3 s: the times that come twice are left out, and a gap shows the step."""
    log = tmp_path / "back.mcap"
    rewrite(sample_logs_dir / "dlc.mcap", log, lambda _n, at_s, _t: -3 * S if at_s > 4.0 else 0, chunk=chunk)
    drive, whole = read(log, car)
    assert kinds(drive) == {"time-jump": "lost", "dropped-samples": "lost"}
    assert dropped(drive)["time-jump"] == pytest.approx(400, abs=5)
    stamps = whole.signals.stamps_ns
    assert np.diff(stamps).max() == pytest.approx(S, abs=0.1 * S)
    sound = read(sample_logs_dir / "dlc.mcap", car)[1].signals
    after = stamps > START + round(4.5 * S)
    for part, by in ((~after, 0), (after, 3 * S)):
        _, i, j = np.intersect1d(stamps[part] + by, sound.stamps_ns, return_indices=True)
        assert len(i) == part.sum() > 100
        np.testing.assert_array_equal(whole.signals.yaw_rate_rad_s[part][i], sound.yaw_rate_rad_s[j])


def test_the_share_that_is_damage():
    def count(**reasons: int) -> SampleCount:
        named = {reason.replace("_", "-"): n for reason, n in reasons.items()}
        return SampleCount("signal", "ay_m_s2", "/imu.a", "header.stamp", 10_000, 10_000 - sum(named.values()), named)

    least = round(DAMAGED_SHARE * 10_000)
    assert damage([count(nan=least), count(out_of_range=5000), count(truth_quality=9000), count(repeated=5000)]) == []
    (loss,) = damage([count(nan=1, duplicate_stamp=least), count(nan=1, duplicate_stamp=least)])
    assert (loss.severity, loss.count) == ("lost", 2 * (least + 1))
    assert "101 of 10000 samples are not used (100 duplicate-stamp, 1 nan)" in loss.what
    assert {"nan", "bad-stamp", "duplicate-stamp", "time-jump", "outlier", "other-epoch"} <= DAMAGE


STEERING = "/vehicle/status/steering_status"
INPUTS = ("steer_rad", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s")


@pytest.fixture(scope="module")
def late(sample_logs_dir, tmp_path_factory):
    """Return the double lane change with steering that arrives 0.8 s later, with its stamps as they were."""
    path = tmp_path_factory.mktemp("late") / "late.mcap"
    rewrite(
        sample_logs_dir / "dlc.mcap", path, lambda _n, _s, topic: round(0.8 * S) if topic == STEERING else 0,
        lambda _n, _s, _topic: 0,
    )  # fmt: skip
    return path


def signals_of(path: Path, **options: Any) -> tuple[Signals, list[str], str]:
    options = {"friction": 1.0, **options}
    with read_drive(path, Car.load("saloon"), options=ReadOptions(**options)) as drive:
        return drive.whole().signals, drive.notes, drive.not_causal


def run(capsys: pytest.CaptureFixture[str], out: Path, *arguments: object) -> tuple[int, dict[str, Any], str]:
    given = ["run", *map(str, arguments), "-o", str(out), "--car", "saloon", "--no-report", "--annotate", "none"]
    code = app(given, prog_name="pdhef", standalone_mode=False) or 0
    (report,) = out.glob("logs/*/report.json")
    return code, json.loads(report.read_text(encoding="utf-8")), capsys.readouterr().err


def test_only_the_late_topic_is_read_by_stamp_and_it_is_named(late, sample_logs_dir):
    found, notes, not_causal = signals_of(late)
    sound, no_notes, causal = signals_of(sample_logs_dir / "dlc.mcap")
    assert causal == ""
    assert not any("stamps" in n for n in no_notes)
    for name in INPUTS:
        np.testing.assert_array_equal(getattr(found, name), getattr(sound, name)[: len(found)])
    lag = (found.ready_ns - found.stamps_ns)[10:-10]
    assert lag.max() < 0.1 * S, "0.8 s if the late topic were waited for"
    assert not_causal == "not causal: steer_rad read by stamp, not by arrival"
    (note,) = [n for n in notes if "stamps" in n]
    assert STEERING in note
    assert "0.81 s" in note
    assert "0.3 s" in note


@pytest.mark.slow
def test_a_run_of_it_scores_and_calls_nothing_causal(late, sample_logs_dir, tmp_path, capsys):
    code, report, err = run(capsys, tmp_path / "out", late, "--estimators", "zero,phy-ukf")
    assert code == 0
    assert STEERING in err
    assert [e["causal"] for e in report["estimators"]] == [False] * 2
    assert all("steer_rad read by stamp" in " ".join(e["notes"]) for e in report["estimators"])
    rows = pl.read_parquet(tmp_path / "out/logs/late/estimates.parquet").filter(estimator="phy-ukf")
    assert rows["valid"].mean() > 0.95
    run(capsys, tmp_path / "sound", sample_logs_dir / "dlc.mcap", "--estimators", "zero,phy-ukf")
    sound = pl.read_parquet(tmp_path / "sound/logs/dlc/estimates.parquet").filter(estimator="phy-ukf")
    both = rows.join(sound, on="stamp_ns").filter("valid", "valid_right")
    assert (both["vy_m_s"] - both["vy_m_s_right"]).abs().max() < 1e-9


def test_a_pause_of_twenty_minutes_is_no_epoch(sample_logs_dir, tmp_path, car):
    log = tmp_path / "pause.mcap"
    rewrite(sample_logs_dir / "dlc.mcap", log, lambda _n, at_s, _t: 1200 * S if at_s > 4.0 else 0)
    drive, whole = read(log, car)
    assert kinds(drive) == {}
    assert all(s.used == s.total for s in drive.recorded().ledger)
    assert len(whole.signals) == 951
