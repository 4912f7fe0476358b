"""Parts of a drive: boolean masks over the scored stamps, and the same as intervals.

Lateral acceleration, yaw rate and speed are from ground truth if it contains them, otherwise from the sensors;
longitudinal acceleration is always from the sensor. Accelerations and yaw rate are smoothed with zero phase (Gaussian,
within the gap-free run around a stamp): to 4 Hz for ``linear`` and ``nonlinear``, to 1 Hz for manoeuvres. μ is the
friction of the ground truth, otherwise of the log, otherwise of the vehicle file, otherwise 1.

====================  ==================================================================================================
``all``               every stamp
``linear``            abs a_y < 0.3 μ g
``nonlinear``         abs a_y > 0.5 μ g
``standstill``        speed below a tenth of the low-speed blend and abs yaw rate below 0.05 rad/s, for 0.5 s
``straight``          above the low-speed blend, abs a_y < 0.5 m/s², for 2 s
``cornering-left``    a_y > 1 m/s² for 1.5 s, outside slaloms
``cornering-right``   a_y < −1 m/s² for 1.5 s, outside slaloms
``braking``           a_x < −1.5 m/s² for 0.5 s, moving
``accelerating``      a_x > 1 m/s² for 0.5 s, moving
manoeuvres            :mod:`~pdhef_logtool.evaluation.manoeuvres`, from sensors alone
====================  ==================================================================================================
"""

from collections.abc import Mapping, Sequence

import numpy as np

from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters
from pdhef_logtool.evaluation.manoeuvres import MANOEUVRES, Event, Manoeuvre, find_manoeuvres, manoeuvre_masks
from pdhef_logtool.evaluation.smoothing import median_step_ns, runs, smooth
from pdhef_logtool.records.signals import NS_PER_S, BoolArray, FloatArray, IntArray, Signals
from pdhef_logtool.records.steps import last_known
from pdhef_logtool.records.tracks import StateTrack

SEGMENTS = (
    "all",
    "linear",
    "nonlinear",
    "standstill",
    "straight",
    "cornering-left",
    "cornering-right",
    "braking",
    "accelerating",
    *MANOEUVRES,
)
LINEAR_SHARE, NONLINEAR_SHARE = 0.3, 0.5
GRIP_SMOOTHING_HZ, MANOEUVRE_SMOOTHING_HZ = 4.0, 1.0
STANDSTILL_YAW_RATE_RAD_S, STANDSTILL_S = 0.05, 0.5
STRAIGHT_M_S2, STRAIGHT_S = 0.5, 2.0
CORNERING_M_S2, CORNERING_S = 1.0, 1.5
BRAKING_M_S2, ACCELERATING_M_S2, PEDAL_S = -1.5, 1.0, 0.5


def segment_masks(
    signals: Signals,
    truth: StateTrack | None,
    vehicle: VehicleParameters,
    manoeuvres: Sequence[Manoeuvre] | None = None,
) -> dict[str, BoolArray]:
    """Return the masks [N] of all segments by name, in the order of this file's table, including empty ones.

    Parameters
    ----------
    signals : at the scored stamps. truth : at the same stamps, or None.
    manoeuvres : of the drive; None detects them.
    """
    manoeuvres = find_manoeuvres(signals, vehicle) if manoeuvres is None else manoeuvres
    step_ns = median_step_ns(signals.stamps_ns)
    stamps = signals.stamps_ns
    slow = vehicle.low_speed_blend_m_s
    lateral = taken(signals, truth, "ay_m_s2")
    friction = taken(signals, truth, "friction")
    grip = np.abs(smooth(stamps, lateral, GRIP_SMOOTHING_HZ, step_ns))
    grip /= np.where(np.isfinite(friction), friction, vehicle.assumed_friction) * GRAVITY_M_S2
    ay = smooth(stamps, lateral, MANOEUVRE_SMOOTHING_HZ, step_ns)
    driven = manoeuvre_masks(stamps, manoeuvres)
    slalom = driven["slalom"]
    left = _lasting(stamps, (ay > CORNERING_M_S2) & ~slalom, CORNERING_S)
    right = _lasting(stamps, (ay < -CORNERING_M_S2) & ~slalom, CORNERING_S)
    speed = driven_speed(signals, truth)
    straight = _lasting(stamps, (speed > slow) & (np.abs(ay) < STRAIGHT_M_S2), STRAIGHT_S)
    rate = taken(signals, truth, "yaw_rate_rad_s")
    turning = np.abs(smooth(stamps, rate, MANOEUVRE_SMOOTHING_HZ, step_ns)) < STANDSTILL_YAW_RATE_RAD_S
    standing = _lasting(stamps, (speed < vehicle.standstill_m_s) & turning, STANDSTILL_S)
    moving = ~standing
    ax = smooth(stamps, signals.ax_m_s2, MANOEUVRE_SMOOTHING_HZ, step_ns)
    return {
        "all": np.ones(len(signals), dtype=np.bool_),
        "linear": grip < LINEAR_SHARE,
        "nonlinear": grip > NONLINEAR_SHARE,
        "standstill": standing,
        "straight": straight,
        "cornering-left": left,
        "cornering-right": right,
        "braking": _lasting(stamps, (ax < BRAKING_M_S2) & moving, PEDAL_S),
        "accelerating": _lasting(stamps, (ax > ACCELERATING_M_S2) & moving, PEDAL_S),
        **driven,
    }


def moving_mask(signals: Signals, truth: StateTrack | None, vehicle: VehicleParameters) -> BoolArray:
    """Return where the car is faster than the low-speed blend, [N]; True everywhere if the speed is unknown.

    ``signals``, ``truth`` as for :func:`segment_masks`.
    """
    speed = driven_speed(signals, truth)
    return np.asarray((speed > vehicle.low_speed_blend_m_s) | ~np.isfinite(speed).any())


def taken(signals: Signals, truth: StateTrack | None, column: str) -> FloatArray:
    """Return a column [N] of the ground truth if it has any finite value, else of the sensors: one source per drive."""
    of_truth = truth is not None and np.isfinite(getattr(truth, column)).any()
    return np.asarray(getattr(truth if of_truth else signals, column))


def driven_speed(signals: Signals, truth: StateTrack | None) -> FloatArray:
    """Return the speed [N] in m/s, of one source."""
    if truth is not None and np.isfinite(truth.vx_m_s).any():
        return np.abs(truth.vx_m_s)
    return last_known(signals.stamps_ns, signals.speed_m_s)


def find_intervals(stamped: Signals | StateTrack, masks: Mapping[str, BoolArray]) -> list[Event]:
    """Convert masks [N] to intervals in order of time; a step of more than ``smoothing.RUN_GAP_S`` ends an interval.

    ``end_ns`` is one past the last stamp inside.
    """
    stamps = stamped.stamps_ns
    spans = [
        Event(name, int(stamps[i]), int(stamps[j - 1]) + 1, "")
        for name, mask in masks.items()
        for i, j in runs(stamps, mask)
    ]
    return sorted(spans, key=lambda s: (s.start_ns, s.end_ns, s.name))


def _lasting(stamps_ns: IntArray, mask: BoolArray, least_s: float) -> BoolArray:
    out = np.zeros_like(mask)
    for a, b in runs(stamps_ns, mask):
        out[a:b] = stamps_ns[b - 1] - stamps_ns[a] >= least_s * NS_PER_S
    return out
