"""``yaw_consistency``: yaw rate of the car's tyres at the estimated v_y and the measured steering, against the gyro."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from pdhef_logtool.car.nominal_model import model_parameters, yaw_rates_at
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.evaluation.blocks import SegmentSums, blocks_with_halo, packed
from pdhef_logtool.evaluation.metrics.metric import EvaluatedDrive, Metric, MetricRow, OfDrive, SensorErrors
from pdhef_logtool.evaluation.metrics.sensor_residuals import MAX_STEP_S, carried_speed
from pdhef_logtool.records.signals import BoolArray, FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack

#: The yaw rate forgets its start within this time.
SETTLE_S = 2.0


def _rows(drive: EvaluatedDrive) -> list[MetricRow]:
    return yaw_rows([*drive.tracks.values()], drive.signals, drive.masks, log=drive.log, sensors=drive.sensors)


def yaw_rows(
    tracks: Sequence[StateTrack], signals: Signals, masks: Mapping[str, BoolArray], *, log: str, sensors: SensorErrors
) -> list[MetricRow]:
    """Return the figure of estimators at the same stamps as the signals [N], one row per segment."""
    if sensors.vehicle is None:
        return []
    masks = packed(masks, len(signals))
    sums_by_track = [SegmentSums() for _ in tracks]
    for first, a, b, end in blocks_with_halo(signals, SETTLE_S, 1):
        core, inside = slice(a - first, b - first), dict(masks.rows(a, b))
        part = Signals.rows(signals, first, end)  # in memory
        for track, sums in zip(tracks, sums_by_track, strict=True):
            residual = yaw_residual(track.rows(first, end), part, sensors.vehicle, sensors)[core]
            sums.add(inside, residual, residual**2)
    return [
        MetricRow(
            log, track.name, "yaw_rate_rad_s", segment, "yaw_consistency", float(np.sqrt(squares / n)), "rad/s", n
        )
        for track, sums in zip(tracks, sums_by_track, strict=True)
        for segment, (n, (_, squares)) in sums.totals().items()
    ]


def yaw_residual(track: StateTrack, signals: Signals, vehicle: VehicleParameters, sensors: SensorErrors) -> FloatArray:
    """Return the modelled minus the measured yaw rate [N]; NaN across gaps, at low speed, and without steering.

    The steering, its delay, the gyro's bias and the tyres are those of the calibrated ``vehicle``.
    """
    friction = signals.friction if sensors.friction is None else np.full(len(signals), sensors.friction)
    was = sensors.read_with or vehicle
    before, after, t = was.sensors, vehicle.sensors, signals.stamps_ns
    angle = (signals.steer_rad + was.steer_offset_rad) * (was.steering_ratio / vehicle.steering_ratio)
    rate = signals.yaw_rate_rad_s * before.yaw_rate_gain + before.yaw_rate_bias_rad_s
    rate = (rate - after.yaw_rate_bias_rad_s) / after.yaw_rate_gain
    steer = np.interp(t - round(sensors.steer_delay_s * 1e9), t, angle - vehicle.steer_offset_rad)
    friction = np.where(np.isfinite(friction), friction, vehicle.assumed_friction)
    dt = np.diff(t, prepend=t[:1]) * 1e-9
    dt[dt > MAX_STEP_S] = np.nan
    vy = np.where(track.valid, track.vy_m_s, np.nan)
    modelled = np.full(len(t), np.nan)
    inputs = (dt, carried_speed(signals), vy, steer, friction, rate)
    yaw_rates_at(inputs, max(vehicle.relaxation_length_m, 0.01), model_parameters(vehicle), modelled)
    return modelled - rate


METRICS = (
    Metric(
        "yaw_consistency",
        "yaw consistency",
        "signal `yaw_rate_rad_s`: RMS of the gyro minus the yaw rate that the car's tyres have at the estimated v_y "
        "and the measured steering, above the low-speed blend; tyres, steering and gyro "
        "bias as the log calibrated them",
        OfDrive(_rows),
        best="lower",
        unit="rad/s",
        brief=("yaw_rate_rad_s",),
    ),
)
