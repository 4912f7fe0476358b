"""The speed benchmarks' peers do the same work as we do; the benchmarks themselves are too slow for a test."""

from __future__ import annotations

import numpy as np

from benchmarks import filtering, writing
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators.physics import PHY_UKF_Q_STD, PhysicsUkf


def test_the_peer_filter_has_our_posteriors() -> None:
    signals = filtering.drive(300)
    ours, _ = PhysicsUkf(default_vehicle(), q_std=PHY_UKF_Q_STD, r_std=filtering.R_STD).filter_steps(signals, None)
    np.testing.assert_allclose(ours.x, filtering.run_filterpy(signals, ours.x[0], 300), rtol=1e-6, atol=1e-6)


def test_the_peer_writer_knows_every_field_of_our_messages() -> None:
    store, count = writing._store(), 2
    values = np.zeros((count, len(writing._STATE_FIELDS)))
    messages = writing._peer_messages(store, np.arange(count), values, np.zeros((count, 9)))
    assert all(store.serialize_cdr(state, writing.STATE_TYPE) for state, _ in messages)
