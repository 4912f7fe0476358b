"""Signals of a drive for the vehicle of its posterior: the friction that the car has reached."""

from dataclasses import replace

import numpy as np
from reference_car import signals_at

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.posterior import Posterior
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, default_vehicle
from pdhef_logtool.estimators.drive_signals import calibrated_signals
from pdhef_logtool.records.signals import Signals

CAR = Car(default_vehicle(), self_calibrated=Posterior(default_vehicle()))
FILE = CAR.vehicle.assumed_friction
#: a_y of the bend over that at the peak forces of the file.
REACHED = 1.2


def bend(seconds: float = 3.0) -> Signals:
    """Return signals of straight driving with a bend beyond the friction of the file in the middle."""
    t = np.arange(0.0, 10.0, 0.01)
    gain = 1.0 + GRAVITY_M_S2 * CAR.vehicle.roll_gradient_rad_per_m_s2
    ay = REACHED * gain * CAR.vehicle.most_ay_m_s2(FILE) * (np.abs(t - 5.0) < 0.5 * seconds)
    return signals_at((t * 1e9).astype(np.int64), speed_m_s=np.full(t.size, 20.0), ay_m_s2=-ay)


def test_the_friction_is_at_least_the_reached_one_and_does_not_anticipate():
    signals = bend()
    friction = calibrated_signals(signals, CAR).friction
    assert (friction[:350] == FILE).all() and (np.diff(friction) >= 0.0).all()
    np.testing.assert_allclose(friction[-1], REACHED * FILE, rtol=1e-3)
    earlier = calibrated_signals(signals.rows(0, 400), CAR).friction
    np.testing.assert_array_equal(earlier, friction[:400])


def test_jolts_and_a_friction_of_the_log_do_not_raise_it():
    assert (calibrated_signals(bend(0.02), CAR).friction == FILE).all()
    given = replace(bend(), friction=np.full(1000, 0.3))
    assert (calibrated_signals(given, CAR).friction == 0.3).all()
    assert np.isnan(calibrated_signals(bend(), Car(CAR.vehicle)).friction).all()
