"""Offsets and biases of the vehicle file are subtracted from the signals."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from reference_car import drive, slalom

from pdhef_logtool.car.vehicle import Sensors, VehicleParameters, correct_signals, corrected_anew, default_vehicle
from pdhef_logtool.records.signals import SIGNAL_COLUMNS, Signals

#: Sensor bias per signal; all values differ, so that a swapped bias is detected.
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
        elif f.name in SIGNAL_COLUMNS:
            np.testing.assert_array_equal(getattr(corrected, f.name), getattr(true, f.name), err_msg=f.name)
    assert corrected.available == true.available


def biased(offset: float, ratio: float, *biases: float) -> VehicleParameters:
    names = ("ax_bias_m_s2", "ay_bias_m_s2", "yaw_rate_bias_rad_s")
    sensors = Sensors(**dict(zip(names, biases, strict=True)))
    return default_vehicle().model_copy(
        update={"steer_offset_rad": offset, "steering_ratio": ratio, "sensors": sensors}
    )


vehicles = st.builds(
    biased, st.floats(-0.1, 0.1), st.floats(1.0, 30.0), st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(-0.1, 0.1)
)


@given(vehicles, vehicles)
def test_correction_anew_is_that_of_what_the_sensors_read(was: VehicleParameters, other: VehicleParameters) -> None:
    """``raw`` has the steering wheel's angle by the first one's ratio, as reading makes it."""
    raw = drive(slalom(0.03, 0.5), speed=20.0, step_s=np.full(9, 0.01)).signals
    raw.ay_m_s2[3] = np.nan
    by_other = replace(raw, steer_rad=raw.steer_rad * was.steering_ratio / other.steering_ratio)
    before, wanted = correct_signals(raw, was), correct_signals(by_other, other)
    found = corrected_anew(before, was, other)
    back = corrected_anew(found, other, was)
    for f in fields(Signals):
        if f.name in SIGNAL_COLUMNS:
            for one, two in ((found, wanted), (back, before)):
                np.testing.assert_allclose(getattr(one, f.name), getattr(two, f.name), rtol=1e-9, atol=1e-11)
    assert found.available == raw.available


def test_signals_that_need_no_other_correction_are_left_as_they_are() -> None:
    signals = correct_signals(drive(slalom(0.03, 0.5), step_s=np.full(9, 0.01)).signals, CAR)
    heavier = CAR.model_copy(update={"mass_kg": 1500.0, "roll_gradient_rad_per_m_s2": 0.01})
    assert corrected_anew(signals, CAR, heavier) is signals
    assert corrected_anew(signals, CAR, CAR.model_copy(update={"steering_ratio": 15.0})) is not signals
