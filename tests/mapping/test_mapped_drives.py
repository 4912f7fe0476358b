"""The recorded drives, read through their mappings and compared with their descriptions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import (
    MappedChannels,
    Mapping,
    SignalSource,
    auto_map,
    check_mapping,
    clock_key,
    fit_clocks,
    load_mapping,
    read_signals,
)
from pdhef_logtool.mapping.choosing import choose_mapping
from pdhef_logtool.mapping.clocks import apply_clock

MAPPINGS = Path(__file__).parents[1] / "reference" / "mappings"


def read_drive(path: Path, mapping: Mapping) -> MappedChannels:
    log = open_log(path)
    check_mapping(mapping, log)
    clocks = fit_clocks(log, mapping, log.start_ns, log.end_ns)
    got = read_signals(log, mapping, clocks, log.start_ns, log.end_ns)
    log.close()
    return got


def test_race_car(shared_dir: Path) -> None:
    mapping = load_mapping(MAPPINGS / "revs_250lm.toml")
    whole = read_drive(shared_dir / "data" / "drives" / "revs_250lm_a.mcap", mapping)
    assert {n: len(c) for n, c in {**whole.signals, **whole.truth}.items()} == dict.fromkeys(
        [*mapping.signals, *mapping.truth], 30_000
    )
    assert whole.losses == ()
    assert set(np.unique(whole.signals["steer_rad"].arrival_ns - whole.signals["steer_rad"].stamps_ns)) == {6_000_000}
    vy, vx = whole.truth["vy_m_s"].values, whole.truth["vx_m_s"].values
    assert np.rad2deg([np.arctan2(vy, vx).min(), np.arctan2(vy, vx).max()]) == pytest.approx([-5.3, 3.5], abs=0.05)


def test_phone_clock_is_found_from_log_times(shared_dir: Path) -> None:
    path = shared_dir / "data" / "drives" / "comma2k19_segment.mcap"
    log = open_log(path)
    source = SignalSource(
        "yaw_rate_rad_s", "/imu", "gyro[2]", stamp="t", stamp_unit="s", clock="device", latency_s=0.002
    )
    clock = fit_clocks(log, Mapping(signals={source.name: source}), log.start_ns, log.end_ns)[clock_key(source)]
    columns = log.read({"/imu": ["t"]})["/imu"]
    found = apply_clock(np.rint(columns.fields["t"] * 1e9).astype(np.int64), clock) - 2_000_000
    # The publish time is the sample's time in UTC, which the fit has not seen.
    assert np.abs(found - columns.publish_time_ns).max() < 200_000
    log.close()


def test_instrument_units_and_invalid_steering(shared_dir: Path) -> None:
    got = read_drive(shared_dir / "data" / "drives" / "lunda_v40", load_mapping(MAPPINGS / "lunda_v40.toml"))
    steering = got.signals["steering_wheel_rad"]
    assert [(x.kind, x.count) for x in got.losses] == [("out-of-range", 4)]
    assert np.rad2deg([steering.values.min(), steering.values.max()]) == pytest.approx([-109, 117], abs=1)
    vx, vy = got.truth["vx_m_s"].values, got.truth["vy_m_s"].values
    assert [vx.min(), vx.max()] == pytest.approx([8.1, 23.2], abs=0.1)
    # Course − heading is the sideslip; the course over 0.2 s, since positions are quantised.
    lat, lon = np.deg2rad(got.truth["lat_deg"].values[:2394]), np.deg2rad(got.truth["lon_deg"].values[:2394])
    course = np.arctan2(lat[20:] - lat[:-20], (lon[20:] - lon[:-20]) * np.cos(lat[:-20]))
    slip = np.angle(np.exp(1j * (course - got.truth["yaw_rad"].values[10:2384])))
    assert np.corrcoef(slip, np.arctan2(vy, vx)[10:2384])[0, 1] > 0.85


def test_a_file_may_name_one_signal_and_leave_the_rest_to_recognised_types(tmp_path: Path) -> None:
    text = '[signals.friction]\ntopic = "/truth/perfect/state"\nfield = "friction"\n'
    log_path = next(Path("sample_logs").glob("dlc*.mcap"))
    log = open_log(log_path)
    recognised = auto_map(log).mapping
    for filled in (False, True):
        (tmp_path / "mapping.toml").write_text(("fill_recognised = true\n" if filled else "") + text)
        chosen = choose_mapping(log, load_mapping(tmp_path / "mapping.toml"), prefer_truth="perfect")
        mapping, missing = chosen.mapping, chosen.missing
        assert len(chosen.mapping.notes) == filled  # which truth it is
        assert chosen.ambiguities == ()
        assert mapping.signals["friction"].topic == "/truth/perfect/state"
        others = {n: s for n, s in mapping.signals.items() if n != "friction"}
        assert others == ({n: s for n, s in recognised.signals.items() if n != "friction"} if filled else {})
        assert mapping.truth == (recognised.truth if filled else {})
        assert ("yaw_rate_rad_s" in missing) is not filled
    log.close()
