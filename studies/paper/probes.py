"""Quantities of Figures 10 and 19 to 21: residuals, adaptation of R, scheduling of the residual gain."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.estimators.drive_signals import calibrated_signals
from pdhef_logtool.estimators.parallel_physics import filter_of
from pdhef_logtool.evaluation.metrics.lag import lag_s
from pdhef_logtool.learning.network.residuals import residual_rows
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.residual_model.bundle import ModelBundle
from pdhef_logtool.residual_model.service import NetworkService
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

    def lag_ms(self, row: int) -> float:
        """By how much the output follows the target."""
        stamps = np.round(self.time_s * 1e9).astype(np.int64)
        return 1e3 * lag_s(stamps, self.output[:, row], self.target[:, row])

    def increments(self, row: int) -> tuple[float, float]:
        """Smallest and largest increment over one step that the network gave (Eq 18)."""
        return float(self.output[:, row].min() * self.step_s), float(self.output[:, row].max() * self.step_s)

    def noise(self, row: int) -> tuple[float, float]:
        """1-sigma of white noise in target and output, from third differences."""
        third = [np.diff(v[:, row], n=3) for v in (self.target, self.output)]
        return float(np.sqrt(np.mean(third[0] ** 2) / 20.0)), float(np.sqrt(np.mean(third[1] ** 2) / 20.0))


def residual_fit(drive: ReadDrive, car: Car) -> ResidualFit:
    """Compare the residual of a drive with the network's output, features as in service."""
    whole = drive.whole
    assert isinstance(car.network, ModelBundle)
    parallel, period_s = filter_of(car, car.network.model), whole.plan.alignment.grid_period_s
    signals = calibrated_signals(whole.signals, car) if car.residual_network is not None else whole.signals
    rows = residual_rows(signals, whole.truth, parallel, period_s=period_s)
    starts = np.concatenate([[True], np.diff(rows.segment) != 0])
    output, _ = NetworkService(car.network).run(rows.features, starts, None)
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
    """Factor on R of a scheme: median before the burst, largest within, and the largest of that time without a burst.

    The first half second, in which a filter settles, is left out.
    """

    before: float
    within: float
    without_burst: float


def inflation(experiment: Experiment, scheme: str, burst_s: tuple[float, float]) -> Inflation | None:
    """Return how R answered to the burst; None where the scheme did not run or its R stood still."""
    track, clean = experiment.tracks.get(("A-burst", scheme)), experiment.tracks.get(("A", scheme))
    if track is None or clean is None:
        return None
    time_s = (track.stamps_ns - track.stamps_ns[0]) * 1e-9
    use = track.valid & np.isfinite(track.r_scale)
    before, within = use & (time_s > 0.5) & (time_s < burst_s[0]), use & (time_s >= burst_s[0]) & (time_s < burst_s[1])
    calm = clean.valid & np.isfinite(clean.r_scale) & (time_s >= burst_s[0]) & (time_s < burst_s[1])
    if not before.any() or not within.any() or not calm.any() or np.ptp(track.r_scale[use]) < 1e-9:
        return None
    return Inflation(
        float(np.median(track.r_scale[before])), float(track.r_scale[within].max()), float(clean.r_scale[calm].max())
    )
