"""The speed benchmarks' peers do the same work as we do; the benchmarks themselves are too slow for a test."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from benchmarks import filtering, peers, writing
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators.phy_ukf import PHY_UKF_Q_STD, PhysicsUkf
from pdhef_logtool.logs.open_log import open_log


def test_the_peer_filter_has_our_posteriors() -> None:
    signals = filtering.drive(300)
    ours, _ = PhysicsUkf(default_vehicle(), q_std=PHY_UKF_Q_STD, r_std=filtering.R_STD).run(signals, None)
    np.testing.assert_allclose(ours.x, filtering.run_filterpy(signals, ours.x[0], 300), rtol=1e-6, atol=1e-6)


def test_the_peer_writer_knows_every_field_of_our_messages() -> None:
    store, count = writing._store(), 2
    values = np.zeros((count, len(writing._STATE_FIELDS)))
    messages = writing._peer_messages(store, np.arange(count), values, np.zeros((count, 9)))
    assert all(store.serialize_cdr(state, writing.STATE_TYPE) for state, _ in messages)


@pytest.mark.slow
def test_the_straightforward_pipeline_writes_what_our_reader_finds(tmp_path: Path) -> None:
    log, output = Path(__file__).parents[2] / "sample_logs" / "road.mcap", tmp_path / "out.mcap"
    with closing(open_log(log)) as source:
        start_ns = source.start_ns
    steps = peers.run_pipeline(log, output, start_ns + 500_000_000)
    with closing(open_log(output)) as result:
        written = result.read({peers.topic_of(name, "state"): ("vx_m_s",) for name in ("pd-hef", "physics")})
    assert steps > 40
    assert [len(columns) for columns in written.values()] == [steps, steps]
    assert all(np.isfinite(columns.fields["vx_m_s"]).all() for columns in written.values())
