"""The sideslip reference of a drive: conditions, inputs, and its entry in the report."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pdhef_logtool.car.vehicle import GRAVITY_M_S2
from pdhef_logtool.drive.reading import Drive
from pdhef_logtool.model.drive_model import DriveModel
from pdhef_logtool.model.priors import AY_BIAS, AY_GAIN, IMU_X, IMU_X_REACH, RATE_BIAS
from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.signals import NS_PER_S, BoolArray, FloatArray, IntArray
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.runs.config import RunConfig

if TYPE_CHECKING:
    from pdhef_logtool.estimators.reference.drive import ReferenceEstimator, ReferencePrior, SideslipReference

#: A drive is smoothed in spans of this length, which overlap by twice the margin: memory does not grow with the drive.
SPAN_S, MARGIN_S = 600.0, 30.0
#: A fitted position of the accelerometer replaces the file's if it differs by this number of 1-sigmas.
SIGNIFICANT = 2.0
_FILE_STD_M, _FITTED_STD_M, _LEAST_GAIN_STD = 0.05, 0.1, 0.02
_NEEDS = ("ay_m_s2", "yaw_rate_rad_s", "speed_m_s")


@dataclass(frozen=True, slots=True, eq=False)
class DriveReference:
    """Result of the reference: ``estimator``, None if refused, and the entry of the report (``document``)."""

    estimator: "ReferenceEstimator | None"
    document: dict[str, Any]


def reference_of(drive: Drive, model: DriveModel, config: RunConfig) -> DriveReference | None:
    """Return the sideslip reference of a drive; None if not requested.

    With ``reference = auto`` it is made where the log has no ground truth of sideslip.
    """
    scored = drive.plan.truth is not None and "sideslip_rad" in drive.plan.derivation
    if config.reference == "off" or (config.reference == "auto" and scored):
        return None
    from pdhef_logtool.estimators.reference.drive import ReferenceEstimator

    missing = [name for name in _NEEDS if name not in drive.available]
    if missing:
        return DriveReference(None, _document([], f"the log has no {', '.join(missing)}"))
    speed = drive.mapping.signals.get("speed_m_s")
    is_length = drive.plan.alignment.speed_from == "GNSS" or (speed is not None and speed.combine == "norm")
    prior = replace(prior_of(model), speed_over_ground=is_length)
    spans = list(_spans(drive, prior, use_gnss=config.gnss != "off"))
    used = [span for span in spans if not span.refused]
    refused = "" if used else next((span.refused for span in spans), "the log has no samples")
    if refused and config.reference == "on":
        drive.tell(f"no sideslip reference: {refused}")
    note = "estimated from the IMU and GNSS, without tyre data: not causal"
    estimator = ReferenceEstimator(tuple(used), (note,)) if used else None
    return DriveReference(estimator, _document(spans, refused))


def prior_of(model: DriveModel) -> "ReferencePrior":
    """Return the prior of the reference: the geometry of the car's file, sensors as the log calibrated them.

    Without calibration or ground truth, the position of the accelerometer is not verified if no file gives one.
    """
    from pdhef_logtool.estimators.reference.drive import ReferencePrior

    car, calibration = model.car, model.posterior
    vehicle = car.vehicle
    prior: dict[str, Any] = {
        "imu_x_m": vehicle.imu_position_m[0],
        "imu_x_std_m": _FILE_STD_M,
        "ay_gain": 1.0 + GRAVITY_M_S2 * vehicle.roll_gradient_rad_per_m_s2,
        "friction": vehicle.assumed_friction,
    }
    if calibration is not None and calibration.parameters:
        fitted = {p.name: p for p in calibration.parameters}
        if abs(fitted[IMU_X].value - vehicle.imu_position_m[0]) > SIGNIFICANT * fitted[IMU_X].sd:
            prior |= {"imu_x_m": fitted[IMU_X].value, "imu_x_std_m": _FITTED_STD_M}
        prior |= {
            "ay_gain": fitted[AY_GAIN].value,
            "ay_gain_std": max(_LEAST_GAIN_STD, fitted[AY_GAIN].sd),
            "ay_bias_m_s2": fitted[AY_BIAS].value - vehicle.sensors.ay_bias_m_s2,
            "yaw_rate_bias_rad_s": fitted[RATE_BIAS].value - vehicle.sensors.yaw_rate_bias_rad_s,
        }
        if not calibration.refused:
            prior["friction"] = calibration.vehicle.assumed_friction
    elif not car.has_evidence and vehicle.imu_position_m[0] == 0.0:
        prior["unknown_imu_x_m"] = IMU_X_REACH * vehicle.wheelbase_m
    antenna = vehicle.gnss_antenna_position_m
    if antenna is not None:
        prior["antenna_m"] = antenna[:2]
    return ReferencePrior(vehicle.cg_to_rear_axle_m, vehicle.wheelbase_m, **prior)


def _spans(drive: Drive, prior: "ReferencePrior", *, use_gnss: bool) -> "Iterator[SideslipReference]":
    """Yield the reference of a drive span by span; of two that overlap the earlier one ends in the middle."""
    from pdhef_logtool.estimators.reference.drive import refer

    signals = drive.whole().signals
    starts_ns = np.arange(signals.stamps_ns[0], signals.stamps_ns[-1] + 1, round(SPAN_S * NS_PER_S))
    edges = [*np.searchsorted(signals.stamps_ns, starts_ns).tolist(), len(signals)]
    margin_ns = round(MARGIN_S * NS_PER_S)
    for number, end in enumerate(edges[1:]):
        before_ns = int(signals.stamps_ns[edges[number] - 1]) - 2 * margin_ns if number else None
        lead = 0 if before_ns is None else int(np.searchsorted(signals.stamps_ns, before_ns))
        part = signals.rows(lead, end)
        if len(part) < 2:
            continue
        yield refer(part, prior, use_gnss=use_gnss).between(
            None if before_ns is None else int(part.stamps_ns[0]) + margin_ns,
            int(part.stamps_ns[-1]) - margin_ns if end < len(signals) else None,
        )


def _document(spans: "Sequence[SideslipReference]", refused: str) -> dict[str, Any]:
    """Return the entry of report.json, with the parameters of the longest span."""
    longest = max(spans, key=lambda span: len(span.stamps_ns), default=None)
    knots = sum(len(span.stamps_ns) for span in spans)
    valid = sum(int(span.valid.sum()) for span in spans)
    return {
        "refused": refused or None,
        "gnss": any(span.with_gnss for span in spans),
        "valid_share": valid / knots if knots else 0.0,
        "spans_refused": sum(bool(span.refused) for span in spans),
        "spans": len(spans),
        "parameters": [asdict(p) for p in (longest.parameters if longest else ())],
    }


#: Duration of blocks over which differences are averaged, s; number of successive blocks, and of 1-sigmas, that make a
#: contradiction.
BLOCK_S, LEAST_BLOCKS, BEYOND_STD = 1.0, 3, 3.0
#: Share of equal neighbours that makes ground truth held; correlation with time that makes it drift.
HELD_SHARE, DRIFT_CORRELATION = 0.8, 0.8


def audit_truth(truth: StateTrack, reference: StateTrack, low_speed_m_s: float) -> tuple[str, ...]:
    """Return contradictions between ground truth [N] and the reference, as sentences."""
    seconds, difference, std, held = _blocks(truth, reference, low_speed_m_s)
    if len(seconds) < LEAST_BLOCKS:
        return ()
    beyond = np.abs(difference) > BEYOND_STD * std
    beyond &= _runs(beyond, seconds) >= LEAST_BLOCKS
    if not beyond.any():
        return ()
    difference = np.degrees(difference)
    where = f"from {seconds[beyond][0]:.0f} to {seconds[beyond][-1] + BLOCK_S:.0f} s of the log"
    uncertain = f"reference ± {np.degrees(np.sqrt(np.mean(std[beyond] ** 2))):.2f}°"
    share = f"{beyond.sum() * BLOCK_S:.0f} of {len(beyond) * BLOCK_S:.0f} s"
    contradiction = f"ground truth contradicts the estimated sideslip reference ({share}, {where}, {uncertain})"
    mean, spread, how = float(np.mean(difference)), float(np.std(difference)), ""
    if np.median(held[beyond]) > HELD_SHARE:
        how = "it repeats its values there"
    elif spread > 0.0 and abs(np.corrcoef(seconds, difference)[0, 1]) > DRIFT_CORRELATION:
        how = f"it drifts by {60.0 * np.polyfit(seconds, difference, 1)[0]:+.2f}° per minute"
    elif spread < abs(mean) and beyond.mean() > 0.5:
        how = f"it is turned by {mean:+.2f}°"
    return (f"{contradiction}: {how or f'mean difference {np.mean(difference[beyond]):+.2f}° there'}",)


def _blocks(truth: StateTrack, reference: StateTrack, low_speed_m_s: float) -> FloatArray:
    """Return by block [4, B]: start in s, mean difference and mean 1-sigma in rad, share of repeated ground truth."""
    if not len(reference):
        return np.empty((4, 0))
    used = truth.valid & reference.valid & (truth.vx_m_s > low_speed_m_s) & (reference.vx_m_s > low_speed_m_s)
    used &= np.isfinite(truth.sideslip_rad) & np.isfinite(reference.sideslip_std_rad)
    same = (np.diff(truth.vy_m_s, prepend=np.nan) == 0.0).astype(np.float64)
    columns = wrap_angle(truth.sideslip_rad - reference.sideslip_rad), reference.sideslip_std_rad, same
    number = (reference.stamps_ns[used] - reference.stamps_ns[0]) // round(BLOCK_S * NS_PER_S)
    ids, inverse, counts = np.unique(number, return_inverse=True, return_counts=True)
    sums = np.zeros((len(ids), 3))
    np.add.at(sums, inverse, np.stack([c[used] for c in columns], axis=1))
    return np.vstack([ids * BLOCK_S, sums.T / counts])


def _runs(flags: BoolArray, start_s: FloatArray) -> IntArray:
    """Return the length of the run of true blocks, without a gap in time, that each block [B] is part of."""
    breaks = np.flatnonzero((np.diff(flags.astype(np.int64)) != 0) | (np.diff(start_s) > 1.5 * BLOCK_S)) + 1
    lengths = np.diff([0, *breaks, len(flags)])
    return np.asarray(np.repeat(lengths, lengths), dtype=np.int64)
