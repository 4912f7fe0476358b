"""Offsets and biases of the vehicle file come off the signals: what a sensor reads too much is taken away."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
from reference_car import drive, slalom

from pdhef_logtool.car.vehicle import Sensors, correct_signals, default_vehicle
from pdhef_logtool.records.signals import Signals

#: By signal, what its sensor reads too much; all different, so that none can stand in for another.
TOO_MUCH = {"steer_rad": 0.011, "ax_m_s2": 0.21, "ay_m_s2": -0.37, "yaw_rate_rad_s": 0.0053}
CAR = default_vehicle().model_copy(
    update={
        "steer_offset_rad": TOO_MUCH["steer_rad"],
        "sensors": Sensors(
            ax_bias_m_s2=TOO_MUCH["ax_m_s2"],
            ay_bias_m_s2=TOO_MUCH["ay_m_s2"],
            yaw_rate_bias_rad_s=TOO_MUCH["yaw_rate_rad_s"],
        ),
    }
)


def test_what_the_sensors_read_too_much_is_taken_off_and_nothing_else() -> None:
    true = drive(slalom(0.03, 0.5), speed=20.0, step_s=np.full(299, 0.01)).signals
    read = replace(true, **{name: getattr(true, name) + bias for name, bias in TOO_MUCH.items()})
    corrected = correct_signals(read, CAR)
    for f in fields(Signals):
        if f.name in TOO_MUCH:
            np.testing.assert_allclose(getattr(corrected, f.name), getattr(true, f.name), atol=1e-12, err_msg=f.name)
        elif f.name != "available":
            np.testing.assert_array_equal(getattr(corrected, f.name), getattr(true, f.name), err_msg=f.name)
    assert corrected.available == true.available


def test_a_missing_sample_stays_missing() -> None:
    true = drive(slalom(0.03, 0.5), speed=20.0, step_s=np.full(49, 0.01)).signals
    gone = {name: np.where(np.arange(50) == 7, np.nan, getattr(true, name)) for name in TOO_MUCH}
    corrected = correct_signals(replace(true, **gone), CAR)
    for name in TOO_MUCH:
        assert np.flatnonzero(np.isnan(getattr(corrected, name))).tolist() == [7]
