"""The shared cases of clocks, Parquet and MAT files: duration, start and samples of each."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.logs.open_log import open_log

# Topic, rows, duration in s, start in s since 1970, and kinds of the losses with their severity.
CASES = {
    "hostile/t_1hz.csv": ("csv", 1500, 1499.0, 86_400, {"clock": "note"}),
    "hostile/t_min.csv": ("csv", 1500, 29.98, 86_400, {}),
    "hostile/excel.csv": ("csv", 1500, 29.98, 1_765_238_400, {"clock": "note"}),
    "hostile/dropout5s.csv": ("csv", 2000, 39.98, 86_400, {}),
    "hostile/mat5_segv_a.mat": ("mat", 300, 5.98, 86_400, {"bad-variable": "lost", "no-numbers": "note"}),
    "hostile/mat73_19kB_15GiB.mat": ("mat", 300, 5.98, 86_400, {"bad-variable": "lost"}),
    "hostile/mat73_external_storage.mat": ("mat", 300, 5.98, 86_400, {"bad-variable": "lost"}),
    "tables/reference.csv": ("csv", 1000, 19.98, 86_400, {}),
    "tables/csv_day_first_over_midnight.csv": ("csv", 1000, 19.98, 1_710_287_990, {}),
    "tables/csv_gps_week_10_bit.csv": ("csv", 1000, 19.98, 1_714_562_382, {"clock": "note"}),
    "tables/csv_time_restarts.csv": ("csv", 3000, 59.98, 86_400, {"time-jump": "lost"}),
    "tables/mat_gnss_1hz.mat": ("gnss", 20, 19.0, 86_400, {}),
    "tables/parquet_decimal_truth.parquet": ("parquet", 1000, 19.98, 1_714_564_800, {}),
    "tables/parquet_texts.parquet": ("parquet", 1000, 19.98, 1_714_564_800, {}),
}


@pytest.mark.parametrize("case", CASES)
def test_a_shared_case_has_its_clock(case: str, shared_dir: Path) -> None:
    path = shared_dir / "cases" / case
    if not path.exists():
        pytest.skip(f"{path} is absent")
    if "mat73" in case:
        pytest.importorskip("h5py")
    topic, rows, duration_s, start_s, kinds = CASES[case]
    with closing(open_log(path)) as log:
        fields = {f.path: f for t in log.topics for f in log.fields(t.name)}
        read = log.read({topic: [f.path for f in log.fields(topic)]})[topic]
        # The first loss of each kind: notes may follow it.
        assert {loss.kind: loss.severity for loss in reversed(log.lost)} == kinds
    assert len(read) == rows
    assert np.ptp(read.log_time_ns) * 1e-9 == pytest.approx(duration_s, abs=1e-4)
    assert read.log_time_ns[0] * 1e-9 == pytest.approx(start_s, abs=1e-3)
    assert "leak" not in fields
    if case.startswith("tables/parquet"):
        assert np.mean(read.fields["accel_y"]) == pytest.approx(-0.061, abs=1e-3)
        assert np.mean(read.fields["lateral_velocity"]) == pytest.approx(-0.117, abs=1e-3)
