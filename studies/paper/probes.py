"""Quantities of Figures 10, 19 to 21 and 23: residuals, adaptation of R, residual gain, time of a step."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.reading import WholeDrive
from pdhef_logtool.estimators.drive_signals import DriveSignals
from pdhef_logtool.estimators.parallel_physics import filter_of
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.learning.network.residuals import residual_rows
from pdhef_logtool.records.geometry import GRAVITY_M_S2
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.runs.estimating import estimate_drive
from studies.paper.experiment import Experiment, paper_network, time_s, valid

#: Bins of the gain over the lateral acceleration, and rounds of the step times.
BINS, ROUNDS = 12, 15
#: Rows of the residual, with their units.
RESIDUAL_ROWS = (("v_y", "m/s²"), ("yaw rate", "rad/s²"))


@dataclass(frozen=True, slots=True, eq=False)
class ResidualFit:
    """Residual rates of a drive, rows as in ``RESIDUAL_ROWS``, at the samples that count.

    Attributes
    ----------
    time_s : [N]. target : [N, 2], residual of the nominal model at the true state with the measured steering.
    output : [N, 2], output of the network. step_s : median step.
    """

    time_s: FloatArray
    target: FloatArray
    output: FloatArray
    step_s: float

    def explained(self, row: int) -> float:
        """Share of the target's mean square that the output explains (1 − mean square error / mean square)."""
        error = self.output[:, row] - self.target[:, row]
        return float(1.0 - np.mean(error**2) / np.mean(self.target[:, row] ** 2))

    def increments(self, row: int) -> tuple[float, float]:
        """Smallest and largest increment over one step that the network gave (Eq 18)."""
        return float(self.output[:, row].min() * self.step_s), float(self.output[:, row].max() * self.step_s)


def residual_fit(whole: WholeDrive, car: Car) -> ResidualFit:
    """Compare the residual of a drive with the output of the paper's network, features as in service."""
    assert whole.truth is not None
    network, period_s = paper_network(car), whole.plan.alignment.grid_period_s
    rows = residual_rows(whole.signals, whole.truth, filter_of(car, network.model), period_s=period_s)
    starts = np.concatenate([[True], np.diff(rows.segment) != 0])
    output, _ = network.run(rows.features, starts, None)
    use = rows.weight > 0.0
    time_s = (rows.stamps_ns[use] - rows.stamps_ns[0]) * 1e-9
    target = rows.targets[use] / rows.step_s[use, None]
    return ResidualFit(time_s, target, output[use], float(np.median(rows.step_s[use])))


@dataclass(frozen=True, slots=True, eq=False)
class TrustCurve:
    """β over |a_y|: samples, and the median with the 10 and 90 % points in bins of equal width."""

    ay_g: FloatArray
    trust: FloatArray
    centre_g: FloatArray
    median: FloatArray
    low: FloatArray
    high: FloatArray


def trust_curve(experiment: Experiment, scenario: str, scheme: str) -> TrustCurve:
    """Return β of a scheme over the true |a_y|."""
    ay = np.abs(experiment.truth(scenario)["ay_m_s2"].to_numpy()) / GRAVITY_M_S2
    trust = valid(experiment.track(scenario, scheme), "network_trust")
    use = np.isfinite(trust) & np.isfinite(ay)
    ay, trust = ay[use], trust[use]
    edges = np.linspace(0.0, ay.max(), BINS + 1)
    place = np.clip(np.digitize(ay, edges) - 1, 0, BINS - 1)
    filled = [i for i in range(BINS) if np.count_nonzero(place == i) >= 5]
    points = np.array([np.percentile(trust[place == i], [10.0, 50.0, 90.0]) for i in filled])
    centre = 0.5 * (edges[1:] + edges[:-1])[filled]
    return TrustCurve(ay, trust, centre, points[:, 1], points[:, 0], points[:, 2])


def inflation(experiment: Experiment, scheme: str, burst_s: tuple[float, float]) -> dict[str, float]:
    """Return the factor on R: median before the burst, without its first half second, and largest within."""
    track = experiment.track("A-burst", scheme)
    scale, at_s = valid(track, "r_scale"), time_s(track)
    before, within = (
        scale[(at_s > low) & (at_s < high) & np.isfinite(scale)] for low, high in ((0.5, burst_s[0]), burst_s)
    )
    return {"before": float(np.median(before)), "within": float(within.max())}


def step_times(whole: WholeDrive, car: Car, names: Sequence[str]) -> dict[str, dict[str, float]]:
    """Return median, fastest and slowest of several rounds in turns, in microseconds of processor time a step.

    The first round compiles and does not count.
    """
    schemes, corrected = [make_estimator(name, car) for name in names], DriveSignals.of(whole.signals, car)
    seconds: dict[str, list[float]] = {s.name: [] for s in schemes}
    for number in range(ROUNDS + 1):
        for scheme in schemes:
            start = time.process_time()
            estimate_drive(whole, corrected, [scheme])
            if number:
                seconds[scheme.name].append(time.process_time() - start)
    us = 1e6 / len(whole.signals)
    return {
        name: {"median_us": us * float(np.median(taken)), "low_us": us * min(taken), "high_us": us * max(taken)}
        for name, taken in seconds.items()
    }
