"""The recorded drives, read through their mappings and compared with their descriptions."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import (
    Mapping,
    SignalSource,
    auto_map,
    clock_key,
    fit_clocks,
    load_mapping,
)
from pdhef_logtool.mapping.choosing import choose_mapping
from pdhef_logtool.mapping.clocks import apply_clock


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
