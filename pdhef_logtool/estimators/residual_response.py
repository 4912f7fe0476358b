"""Linear response of the sideslip of ``physics`` to a residual rate of v_y, with the filter in the loop.

Teaching fits a residual through this response, so that the error of the filter with the residual (Eq 18, 19) is least.
A small change δx of the state estimate follows

    δx_k = A_k δx_{k−1} + b_k f_{k−1},    A_k = P_k (P_k⁻)⁻¹ C_kᵀ P_{k−1}⁻¹,

with the covariances P, P⁻ after and before the update and the cross covariance C of consecutive states (the links of a
smoother). b is the difference to a run with a constant rate, less the share of A.
"""

from collections.abc import Callable

import numpy as np

from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics, weights_of
from pdhef_logtool.estimators.filter_steps import LinkedSteps, PosteriorSteps
from pdhef_logtool.estimators.vehicle_model import VX, VY
from pdhef_logtool.records.signals import FloatArray, IntArray, Signals

#: Constant rate of the run for b, m/s²: small against the forces of a tyre.
PROBE_M_S2 = 0.05


def residual_response(physics: AdaptivePhysics, signals: Signals, row: IntArray) -> Callable[[FloatArray], FloatArray]:
    """Return the response on a drive; ``row`` [N] is the newest step of each stamp.

    It is a function that returns the changes of the sideslip at the stamps [N, m] by residual rates of v_y at the
    steps [K, m].
    """
    checked, _ = physics.inputs(signals, None)
    probe = np.zeros((len(signals), 2))
    probe[:, 0] = PROBE_M_S2
    runs, transitions, drives = [], [], []
    for physics_filter, share in zip(physics.filters, physics.residual_shares, strict=True):
        links, _ = physics_filter.linked_steps(signals, None, None, checked.extra_r)
        moved, _ = physics_filter.run(signals, None, share * probe, checked.extra_r)
        steps, transition = links.posterior, _transition(links)
        change = np.nan_to_num((moved.x - steps.x) / PROBE_M_S2)
        drive = np.zeros_like(change)
        drive[1:] = change[1:] - np.einsum("kij,kj->ki", transition[1:], change[:-1])
        drive[~links.linked] = 0.0
        runs.append(steps)
        transitions.append(transition)
        drives.append(drive)
    weights = weights_of(runs, signals.steps_s, np.zeros(len(runs)), physics.odds)
    sideslip = np.stack([w * _sideslip_per_vy(s) for w, s in zip(weights.T, runs, strict=True)])

    def response(rates: FloatArray) -> FloatArray:
        out = np.zeros(rates.shape)
        for transition, drive, of_vy in zip(transitions, drives, sideslip, strict=True):
            state = np.zeros((drive.shape[1], rates.shape[1]))
            for k in range(1, len(rates)):
                state = transition[k] @ state + np.outer(drive[k], rates[k - 1])
                out[k] += of_vy[k] * state[VY]
        return np.asarray(out[row])

    return response


def _transition(links: LinkedSteps) -> FloatArray:
    """Return A [K, n, n], 0 where a step does not follow the one before it."""
    steps = links.posterior
    out = np.zeros_like(steps.P)
    linked = np.flatnonzero(links.linked)
    linked = linked[linked > 0]
    small = 1e-15 * np.eye(out.shape[1])  # a part that is known exactly has no variance
    forward = np.linalg.solve(steps.P[linked - 1] + small, links.cross[linked])
    update = np.linalg.solve(links.predicted_P[linked] + small, steps.P[linked])
    out[linked] = np.swapaxes(update, 1, 2) @ np.swapaxes(forward, 1, 2)
    return np.nan_to_num(out)


def _sideslip_per_vy(steps: PosteriorSteps) -> FloatArray:
    vx, vy = steps.x[:, VX], steps.x[:, VY]
    return np.where(steps.valid, vx / np.maximum(vx**2 + vy**2, 1e-6), 0.0)
