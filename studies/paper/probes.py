"""Quantities of Figures 10 and 19 to 21: residuals, adaptation of R, scheduling of the residual gain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.estimators.parallel_physics import filter_of
from pdhef_logtool.learning.network.residuals import residual_rows
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.residual_model.bundle import ModelBundle
from studies.paper.experiment import GRAVITY_M_S2, Experiment, ReadDrive

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


def residual_fit(drive: ReadDrive, car: Car) -> ResidualFit:
    """Compare the residual of a drive with the output of the paper's network, features as in service."""
    whole = drive.whole
    assert isinstance(car.network, ModelBundle)
    assert car.network.paper_network is not None and whole.truth is not None
    network, period_s = car.network.paper_network, whole.plan.alignment.grid_period_s
    parallel = filter_of(car, network.model)
    rows = residual_rows(whole.signals, whole.truth, parallel, period_s=period_s)
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


def trust_curve(experiment: Experiment, scenario: str, scheme: str, bins: int = 12) -> TrustCurve | None:
    """Return β of a scheme over the true |a_y|; None where the scheme did not run or has a constant gain."""
    track = experiment.tracks.get((scenario, scheme))
    if track is None:
        return None
    ay = np.abs(experiment.drives[scenario].truth.ay_m_s2) / GRAVITY_M_S2
    use = track.valid & np.isfinite(track.network_trust) & np.isfinite(ay)
    ay, trust = ay[use], track.network_trust[use]
    if not ay.size or np.ptp(trust) < 1e-9:
        return None
    edges = np.linspace(0.0, ay.max(), bins + 1)
    place = np.clip(np.digitize(ay, edges) - 1, 0, bins - 1)
    filled = [i for i in range(bins) if np.count_nonzero(place == i) >= 5]
    points = np.array([np.percentile(trust[place == i], [10.0, 50.0, 90.0]) for i in filled])
    centre = 0.5 * (edges[1:] + edges[:-1])[filled]
    return TrustCurve(ay, trust, centre, points[:, 1], points[:, 0], points[:, 2])


@dataclass(frozen=True, slots=True)
class Inflation:
    """Factor on R of a scheme: median before the burst and largest within; the first half second is left out."""

    before: float
    within: float


def inflation(experiment: Experiment, scheme: str, burst_s: tuple[float, float]) -> Inflation | None:
    """Return the response of R to the burst; None if the scheme did not run or its R is constant."""
    if (track := experiment.tracks.get(("A-burst", scheme))) is None:
        return None
    time_s = (track.stamps_ns - track.stamps_ns[0]) * 1e-9
    use = track.valid & np.isfinite(track.r_scale)
    before, within = use & (time_s > 0.5) & (time_s < burst_s[0]), use & (time_s >= burst_s[0]) & (time_s < burst_s[1])
    if not before.any() or not within.any() or np.ptp(track.r_scale[use]) < 1e-9:
        return None
    return Inflation(float(np.median(track.r_scale[before])), float(track.r_scale[within].max()))
