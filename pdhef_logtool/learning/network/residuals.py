"""Residuals of the model of ``physics`` per step, from ground truth (docs/method.md#residual, Eq 8-10, 18).

From one stamp of the IMU to the next the residual is the increment

    Δx_net[k] = (x_true(t_k+1) − x_true(t_k)) − (step of the model from x_true(t_k) − x_true(t_k))

with the model at the *true* v_x, v_y and r (an estimated state would add the filter's own error to the residual), and
inputs of the measurement times that the filter uses. Ground truth lacks axle forces and roll; the model integrates them
along the true motion. Bank, biases and force scale are 0: with the estimates of one filter, the residual would be
specific to this filter. The row of v_x is 0 by definition and not stored.

For the paper's network and the baselines the model is the nominal one.

Recorded ground truth is noisy, and one-step differences are mostly noise. In this case the *residual* is smoothed, not
the ground truth: increments are added up to a curve, a cubic is fitted by least squares to ± half a window about each
stamp (Savitzky-Golay), and the mean of its slopes at both ends of a step gives the target. All steps are linear in the
increments, so that fast motion explained by the model is not attenuated; only the residual is. There is no target where
the window contains a gap.
"""

import math
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.drive.truth import differentiate
from pdhef_logtool.estimators import vehicle_model as ukf_model
from pdhef_logtool.estimators.filter_steps import U_AX, U_FRICTION, U_STEER
from pdhef_logtool.estimators.parallel_physics import run_features
from pdhef_logtool.estimators.vehicle_ukf import VehicleUkf
from pdhef_logtool.learning.truth import weight_of
from pdhef_logtool.records.readings import without_impossible
from pdhef_logtool.records.signals import S_PER_NS, BoolArray, FloatArray, IntArray, Signals
from pdhef_logtool.records.tracks import StateTrack

#: Steps longer than this many periods are gaps without an increment.
GAP_PERIODS = 1.5
#: Beyond this the car slides backwards, and a single-track residual is meaningless.
MAX_SIDESLIP_RAD = math.radians(45.0)
#: Half window of the smoothing for noisy ground truth: on simulated RTK drives, targets were closest to the targets
#: from perfect ground truth at 0.13 to 0.16 s (lane change, sweep).
SMOOTHING_HALF_S = 0.15
#: Noise of one-step differences of ground truth (v̇_y in m/s², ṙ in rad/s²) up to which no smoothing is needed: far
#: below the variation of training targets (0.2 and more).
NEGLIGIBLE_NOISE = (0.05, 0.05)

#: Of double precision, or single as in files.
_Numbers: TypeAlias = NDArray[Any]


@dataclass(frozen=True, slots=True, eq=False)
class ResidualRows:
    """Rows of a residual dataset on the IMU's stamps, in time order; of a drive's file in single precision.

    Attributes
    ----------
    stamps_ns : int64 [N]. features : [N, 15] at the stamp, NaN where the parallel filter has no state.
    targets : [N, 2], increments of v_y in m/s and of r in rad/s from this stamp to the next; NaN where unknown.
        Divided by the step they are the residual rates.
    step_s : float64 [N], time to the next stamp; NaN at the last row, of a file the period.
    weight : [N], 0 unless target and features are usable and the next row is in the same segment; 1 for exact ground
        truth, 1/2 if the uncertainty of its sideslip equals the error of a single track (:func:`~..truth.weight_of`).
    segment : int64 [N], changes wherever the parallel filter restarts: sequences must not cross it.
    truth_velocity : [N, 2], true v_x and v_y at the stamp, as targets of other networks; NaN where unknown.
    chosen : bool [N], rows selected for training, in addition to a weight above 0.
    truth_std_rad : [N], 1-sigma of the true sideslip.
    """

    stamps_ns: IntArray
    features: _Numbers
    targets: _Numbers
    step_s: FloatArray
    weight: _Numbers
    segment: IntArray
    truth_velocity: _Numbers
    chosen: BoolArray
    truth_std_rad: _Numbers | None = None

    def __len__(self) -> int:
        """Return the number of rows."""
        return int(self.stamps_ns.shape[0])

    @property
    def training_weight(self) -> FloatArray:
        """Weight of the chosen rows, 0 of the others, [N]."""
        return np.asarray(self.weight * self.chosen, dtype=np.float64)


@njit(cache=True)
def _run_model(stamps_ns, states, inputs, good, max_step_s, model, out):  # type: ignore[no-untyped-def]
    """Write the model's change of v_y and r [N − 1, 2] from each true state; NaN where that state is unknown."""
    layout, places, p, f = model
    run = np.zeros(5)  # carried along the ground truth: a flag, forces, roll and roll rate
    block = np.zeros((ukf_model.PLACES, ukf_model.WIDTH))
    for k in range(states.shape[0] - 1):
        out[k, 0] = math.nan
        out[k, 1] = math.nan
        dt = (stamps_ns[k + 1] - stamps_ns[k]) * S_PER_NS
        if not (good[k] and good[k + 1] and dt <= max_step_s):
            run[0] = 0.0
            continue
        x = states[k].copy()
        over = ukf_model.HeldInputs(
            0.5 * (inputs[k, U_STEER] + inputs[k + 1, U_STEER]),
            0.5 * (inputs[k, U_AX] + inputs[k + 1, U_AX]),
            True,
            0.5 * (inputs[k, U_FRICTION] + inputs[k + 1, U_FRICTION]),
        )
        if layout.forces >= 0 and run[0] == 0.0:
            ukf_model.settle_forces(x, over.steer, over.ax, over.friction, layout, p, f)
        elif layout.forces >= 0:
            x[ukf_model.FRONT], x[ukf_model.REAR] = run[1], run[2]
            if layout.roll >= 0:
                x[layout.roll], x[layout.roll + 1] = run[3], run[4]
        for i in range(x.shape[0]):
            block[places[i], : ukf_model.LANES] = x[i]
        ukf_model.advance(block.reshape(-1), ukf_model.LANES, over, dt, layout, p, f)
        out[k, 0] = block[ukf_model.VY, 0] - x[ukf_model.VY]
        out[k, 1] = block[ukf_model.YAW_RATE, 0] - x[ukf_model.YAW_RATE]
        run[0], run[1], run[2] = 1.0, block[ukf_model.FRONT, 0], block[ukf_model.REAR, 0]
        if layout.roll >= 0:
            run[3], run[4] = block[ukf_model.ROLL, 0], block[ukf_model.ROLL_RATE, 0]


def residual_increments(
    stamps_ns: IntArray, state: FloatArray, inputs: FloatArray, physics: VehicleUkf, *, max_step_s: float
) -> FloatArray:
    """Return the motion of the ground truth minus the motion of the filter's model between stamps, [N − 1, 2].

    Parameters
    ----------
    stamps_ns : int64 [N]. state : true [v_x, v_y, r], [N, 3]; NaN where it must not be used.
    inputs : of the steps of the parallel filter, [N, 6]. max_step_s : longer steps are gaps.

    Returns
    -------
    Increments of v_y in m/s and r in rad/s; NaN across gaps, for missing values, for |β| > 45°, and below the low-speed
    limit, where the model is not dynamic.
    """
    model = physics.parameters
    forward = np.abs(np.arctan2(state[:, 1], state[:, 0])) <= MAX_SIDESLIP_RAD
    dynamic = forward & (state[:, 0] >= model.p.blend_high_m_s)
    good = dynamic & _complete(state) & _complete(inputs)
    states = np.zeros((len(state), model.layout.size))
    states[:, :3] = np.where(good[:, None], state, 1.0)
    moved = np.empty((max(len(stamps_ns) - 1, 0), 2))
    _run_model(stamps_ns, states, inputs, good, max_step_s, model, moved)
    increments: FloatArray = np.diff(state[:, 1:3], axis=0) - moved
    return increments


def smooth_increments(stamps_ns: IntArray, increments: FloatArray, half_window: int) -> FloatArray:
    """Smooth increments [N − 1, c] between stamps [N]; the same array for a half window of 0.

    The slopes of their sum (:func:`~.truth.differentiate`) at both ends of a step are averaged. NaN if a window
    contains NaN or exceeds the data.
    """
    if half_window == 0:
        return increments
    curve = np.concatenate([np.zeros_like(increments[:1]), np.cumsum(np.nan_to_num(increments), axis=0)])
    curve[:-1][np.isnan(increments)] = np.nan
    longest_ns = int(stamps_ns[-1] - stamps_ns[0])  # longer steps than usual have no increment
    slopes = np.stack([differentiate(stamps_ns, c, half_window, longest_ns) for c in curve.T], axis=1)
    return np.asarray(0.5 * (slopes[:-1] + slopes[1:]) * np.diff(stamps_ns)[:, None] * S_PER_NS)


def residual_rows(
    signals: Signals,
    truth: StateTrack,
    physics: VehicleUkf,
    *,
    period_s: float,
    half_window: int = 0,
    truth_std_m_s: float = 0.0,
) -> ResidualRows:
    """Turn a drive into residual rows, one per stamp.

    Parameters
    ----------
    signals, truth : at the same stamps [N], less biases of the vehicle file.
    physics : the parallel filter with the settings of operation; residuals refer to its model.
    period_s : of the IMU. half_window : steps on each side of the smoothing of targets.
    truth_std_m_s : 1-sigma of the true v_y for ground truth without an uncertainty.
    """
    count = len(signals)
    features, _, filtered, _ = run_features(physics, signals, None)
    complete = _complete(features)
    fresh: BoolArray = complete & ~(np.concatenate([[False], complete[:-1]]) & np.isfinite(filtered.prior[:, 0]))
    segment = np.maximum(np.cumsum(fresh) - 1, 0)
    inputs = filtered.inputs.copy()
    state = np.stack([truth.vx_m_s, truth.vy_m_s, truth.yaw_rate_rad_s], axis=1)
    state[~truth.valid] = np.nan
    # A predicted steering angle must not affect a residual.
    inputs[~np.isfinite(without_impossible(signals).steer_rad), U_STEER] = np.nan
    stamps_ns, gap_s = signals.stamps_ns, GAP_PERIODS * period_s
    increments = residual_increments(stamps_ns, state, inputs, physics, max_step_s=gap_s)
    targets, step_s = np.full((count, 2), np.nan), np.full(count, np.nan)
    targets[:-1] = smooth_increments(signals.stamps_ns, increments, half_window)
    step_s[:-1] = np.diff(signals.stamps_ns) * S_PER_NS
    usable = _complete(targets) & complete
    # If the filter restarts at the next row, the network starts without a state in operation, too.
    usable[:-1] &= complete[1:] & (segment[1:] == segment[:-1])
    truth_std = truth_std_m_s / np.maximum(np.abs(state[:, 0]), 1.0)
    truth_std = np.where(np.isfinite(truth.sideslip_std_rad), truth.sideslip_std_rad, truth_std)
    return ResidualRows(
        stamps_ns=signals.stamps_ns,
        features=features,
        targets=targets,
        step_s=step_s,
        weight=np.where(usable, weight_of(truth_std), 0.0),
        segment=segment,
        truth_velocity=state[:, :2],
        chosen=np.ones(count, dtype=np.bool_),
        truth_std_rad=truth_std,
    )


def _complete(values: FloatArray) -> BoolArray:
    return np.asarray(np.isfinite(values).all(axis=1), dtype=np.bool_)
