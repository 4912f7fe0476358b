"""Corrections of sensors and ground truth that a drive shows, and where each of them belongs.

Unit, sign, mounting, a turned ground truth and a recorder's delay belong in the mapping; the accelerometer's place, the
gyro's gain and what is left of its delay in the car's fit. Each is measured on what mapping and car already take off,
and a delay in the car is the whole one: applied in any order, each is taken off once.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from collections.abc import Mapping as Mapped
from dataclasses import dataclass, field, replace
from typing import Any, Literal

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.drive.checks.by_relations import explained_factors
from pdhef_logtool.drive.checks.kind import SURE
from pdhef_logtool.drive.checks.sensor_errors import LEVER_M, MOST_LEVER_M, SensorErrors, ay_delay, sensor_errors
from pdhef_logtool.drive.checks.truth_sideslip import is_turned, sideslip_offset
from pdhef_logtool.drive.measured import drive_columns
from pdhef_logtool.drive.mounting import Survey, scaled_source, turned_signals
from pdhef_logtool.drive.truth import LATE_GYRO_S, LatencyEstimate, TruthTrack
from pdhef_logtool.mapping.frames import Placement
from pdhef_logtool.mapping.records import Mapping, SignalSource
from pdhef_logtool.records.signals import Channel

#: A gain or a lever that is smaller changes no estimate by what can be seen; it stays as it is.
LEAST_GAIN = 0.01
LEAST_LEVER_M = 0.3 * LEVER_M
#: Less is within what the roll of the body does.
LEAST_AY_DELAY_S = 0.015
#: Beyond, it is no gain but a unit.
MOST_GAIN = 0.25
#: Accuracy of places in recorded frames.
FRAMES_M = 0.15


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """One correction.

    Attributes
    ----------
    home : where it goes. subject : signal, or ``truth.QUANTITY``. evidence : one sentence with figures.
    source : of the subject as it should be read, for the mapping.
    entries : of the vehicle, ``sensors.NAME`` inside it, with their standard ``error``.
    """

    home: Literal["mapping", "car"]
    subject: str
    evidence: str
    source: SignalSource | None = None
    entries: dict[str, Any] = field(default_factory=dict)
    error: float = 0.0


def apply_proposals(
    proposals: Iterable[Proposal], mapping: Mapping, vehicle: VehicleParameters
) -> tuple[Mapping, VehicleParameters]:
    """Return mapping and vehicle with the corrections in them, each with a note where the mapping has it."""
    for proposal in proposals:
        if proposal.source is not None:
            is_truth = proposal.subject.startswith("truth.")
            section = dict(mapping.truth if is_truth else mapping.signals)
            section[proposal.subject.removeprefix("truth.")] = proposal.source
            mapping = replace(mapping, truth=section) if is_truth else replace(mapping, signals=section)
            mapping = replace(mapping, notes=(*mapping.notes, f"{proposal.subject}: {proposal.evidence}"))
        for entry, value in proposal.entries.items():
            part, _, name = entry.rpartition(".")
            inner = vehicle.sensors.model_copy(update={name: value}) if part == "sensors" else value
            vehicle = vehicle.model_copy(update={part or name: inner})
    return mapping, vehicle


def mapping_proposals(survey: Survey) -> tuple[Proposal, ...]:
    """Return the mountings, units, signs and delays that the first minutes of a drive ask for; no doubtful one."""
    mapping = survey.mapping
    proposals: list[Proposal] = []
    signals, truth = dict(mapping.signals), dict(mapping.truth)
    mounting = survey.mounting
    is_turned_imu = mounting is not None and mounting.confident and not mounting.is_as_named
    if mounting is not None and is_turned_imu:
        for name, source in turned_signals(mapping, mounting, survey.triads).items():
            if source != signals[name]:
                signals[name] = source
                proposals.append(Proposal("mapping", name, f"{mounting.text}: {mounting.evidence}", source))
    factors = {} if is_turned_imu else explained_factors(survey.measured, mounting_is_known=survey.is_mounted)
    for subject, (factor, evidence) in factors.items():
        section = truth if subject.startswith("truth.") else signals
        name = subject.removeprefix("truth.")
        if name in section:
            section[name] = scaled_source(section[name], factor)
            proposals.append(Proposal("mapping", subject, evidence, section[name]))
    if not factors and not is_turned_imu:
        proposals += _of_a_turned_truth(survey)
    for name, (delay_s, evidence) in _delays(survey).items():
        late = replace(signals[name], latency_s=round(signals[name].latency_s + delay_s, 4))
        proposals.append(Proposal("mapping", name, evidence, late))
    return tuple(proposals)


def _delays(survey: Survey) -> dict[str, tuple[float, str]]:
    """Return by signal what its stamps are late by, with the evidence: by ground truth, else by another sensor."""
    delays: dict[str, tuple[float, str]] = {}
    latency = survey.latency
    if latency is not None and latency.gyro_delay_s >= LATE_GYRO_S:
        delays["yaw_rate_rad_s"] = latency.gyro_delay_s, latency.reason
    # The delay of a_y is not observable from another axis.
    is_mounted = survey.mounting is None or survey.mounting.is_as_named
    by_truth = ay_delay(sensor_errors(survey.measured.columns), latency) if is_mounted else None
    if by_truth is not None and by_truth[0] > max(LEAST_AY_DELAY_S, 3.0 * by_truth[1]):
        delays["ay_m_s2"] = by_truth[0], f"a_y is {by_truth[0] * 1e3:.1f} ms late against ground truth"
    for sensor in survey.late:
        told_by_truth = sensor.names[0] == "yaw_rate_rad_s" and latency is not None and latency.reliable
        for name in sensor.names if sensor.exact and not told_by_truth else ():
            delays.setdefault(name, (sensor.delay_s, sensor.evidence))
    return delays


def _of_a_turned_truth(survey: Survey) -> list[Proposal]:
    """Return corrected sources of ground truth whose sideslip has a constant offset, if a mapping can correct it."""
    offset_and_error = sideslip_offset(survey.measured.columns)
    if offset_and_error is None or survey.truth is None or not is_turned(*offset_and_error):
        return []
    offset, error = offset_and_error
    truth = survey.mapping.truth
    evidence = f"sideslip is {math.degrees(offset):.2f} +- {math.degrees(error):.2f} deg where the car goes straight"
    vx, vy = truth.get("vx_m_s"), truth.get("vy_m_s")
    changed: dict[str, SignalSource] = {}
    if "sideslip_rad" in truth:
        source = truth["sideslip_rad"]
        changed["sideslip_rad"] = replace(source, offset=_single(source.offset) - offset)
    elif vx is not None and vy is not None:
        if (vx.topic, vx.stamp) == (vy.topic, vy.stamp) and isinstance(vx.field, str) and isinstance(vy.field, str):
            c, s, fields = math.cos(offset), math.sin(offset), (vx.field, vy.field)
            ahead, left = _single(vx.scale), _single(vy.scale)
            changed["vx_m_s"] = replace(vx, field=fields, scale=(c * ahead, s * left))
            changed["vy_m_s"] = replace(vy, field=fields, scale=(-s * ahead, c * left))
    elif "yaw_rad" in truth:
        changed["yaw_rad"] = replace(truth["yaw_rad"], offset=_single(truth["yaw_rad"].offset) + offset)
    return [Proposal("mapping", f"truth.{n}", evidence, source, error=error) for n, source in changed.items()]


def _single(value: float | tuple[float, ...]) -> float:
    return value[0] if isinstance(value, tuple) else value


def car_proposals(
    channels: Mapped[str, Channel],
    truth: TruthTrack,
    latency: LatencyEstimate | None,
    gyro_latency_s: float,
    vehicle: VehicleParameters,
    placed: Placement | None = None,
) -> tuple[Proposal, ...]:
    """Return position, gain and delay of the sensors by regression on ground truth where they differ from the vehicle.

    Parameters
    ----------
    channels : as measured, mapped right. gyro_latency_s : what was taken off the gyro's stamps already.
    placed : where recorded frames put the IMU.
    """
    if latency is not None and "yaw_rate_rad_s" in channels:  # late, it would look smaller than it is
        gyro = channels["yaw_rate_rad_s"]
        early = replace(gyro, stamps_ns=gyro.stamps_ns - round(latency.gyro_delay_s * 1e9))
        channels = {**channels, "yaw_rate_rad_s": early}
    columns, _ = drive_columns(channels, {}, truth)
    errors = sensor_errors(columns)
    proposals: list[Proposal] = []
    x, *rest = vehicle.imu_position_m
    off_m = abs(errors.lever_m - x)
    if max(LEAST_LEVER_M, SURE * errors.lever_error_m) < off_m < MOST_LEVER_M:
        evidence = f"a_y goes with {errors.lever_m:.2f} +- {errors.lever_error_m:.2f} m of the yaw acceleration"
        place = {"imu_position_m": (round(errors.lever_m, 3), *rest)}
        proposals.append(Proposal("car", "ay_m_s2", evidence, entries=place, error=errors.lever_error_m))
    if placed is not None and errors.lever_error_m < MOST_LEVER_M:
        proposals += _of_frames(placed, errors, vehicle)
    off = abs(errors.yaw_rate_gain - vehicle.sensors.yaw_rate_gain)
    if max(LEAST_GAIN, SURE * errors.gain_error) < off < MOST_GAIN:
        evidence = f"the gyro reads {errors.yaw_rate_gain:.3f} +- {errors.gain_error:.3f} of the ground-truth yaw rate"
        gain = {"sensors.yaw_rate_gain": round(errors.yaw_rate_gain, 4)}
        proposals.append(Proposal("car", "yaw_rate_rad_s", evidence, entries=gain, error=errors.gain_error))
    if latency is not None and latency.gyro_delay_s >= LATE_GYRO_S:
        delay = {"sensors.yaw_rate_delay_s": round(gyro_latency_s + latency.gyro_delay_s, 4)}
        proposals.append(Proposal("car", "yaw_rate_rad_s", latency.reason, entries=delay, error=latency.std_error_s))
    return tuple(proposals)


def _of_frames(placed: Placement, errors: SensorErrors, vehicle: VehicleParameters) -> list[Proposal]:
    """Return the position that recorded frames give, if a_y shows which point of the car their origin is."""
    x, y = (float(v) for v in placed.position_m[:2])
    origins = {"the CG": 0.0, "the middle of the rear axle": -vehicle.cg_to_rear_axle_m}
    off = {name: abs(x + origin_x - errors.lever_m) for name, origin_x in origins.items()}
    near = [name for name, metres in off.items() if metres < max(FRAMES_M, 2.0 * errors.lever_error_m)]
    if len(near) != 1 or abs(y) > MOST_LEVER_M:
        return []
    ahead = x + origins[near[0]]
    imu_x, imu_y, imu_z = vehicle.imu_position_m
    if math.hypot(ahead - imu_x, y - imu_y) < LEAST_LEVER_M:
        return []
    evidence = (
        f"the recorded frames put {placed.frame} at {x:.2f}, {y:.2f} m of {placed.base}, which is {near[0]}: "
        f"a_y goes with {errors.lever_m:.2f} +- {errors.lever_error_m:.2f} m of the yaw acceleration"
    )
    place = {"imu_position_m": (round(ahead, 3), round(y, 3), imu_z)}
    return [Proposal("car", "ay_m_s2", evidence, entries=place, error=FRAMES_M)]


def surest(proposals: Iterable[Proposal]) -> tuple[Proposal, ...]:
    """Return of several drives' proposals for a car the best known one for each entry."""
    best: dict[tuple[str, ...], Proposal] = {}
    for proposal in proposals:
        key = tuple(proposal.entries)
        if key not in best or proposal.error < best[key].error:
            best[key] = proposal
    return tuple(best.values())
