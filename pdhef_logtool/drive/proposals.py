"""Corrections of sensors and ground truth that a drive shows and that belong in its mapping.

Corrections of unit, sign, mounting, heading of ground truth and delay. Each is relative to the current mapping, so that
the order of their application does not matter.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

from pdhef_logtool.drive.checks import ay_delay, offset_check, sensor_errors, sideslip_offset
from pdhef_logtool.drive.mounting import Survey, scaled_source, turned_signals
from pdhef_logtool.drive.relation_checks import explained_factors
from pdhef_logtool.drive.truth import LATE_GYRO_S
from pdhef_logtool.mapping.records import Mapping, SignalSource

#: Smaller delays of a_y may be due to body roll.
LEAST_AY_DELAY_S = 0.015


@dataclass(frozen=True, slots=True, eq=False)
class Proposal:
    """One correction.

    Attributes
    ----------
    subject : signal, or ``truth.QUANTITY``. evidence : one sentence with figures.
    source : corrected source of the subject, for the mapping.
    """

    subject: str
    evidence: str
    source: SignalSource


def apply_proposals(proposals: Iterable[Proposal], mapping: Mapping) -> Mapping:
    """Return the mapping with the corrections in it, each with a note."""
    for proposal in proposals:
        is_truth = proposal.subject.startswith("truth.")
        section = dict(mapping.truth if is_truth else mapping.signals)
        section[proposal.subject.removeprefix("truth.")] = proposal.source
        mapping = replace(mapping, truth=section) if is_truth else replace(mapping, signals=section)
        mapping = replace(mapping, notes=(*mapping.notes, f"{proposal.subject}: {proposal.evidence}"))
    return mapping


def mapping_proposals(survey: Survey) -> tuple[Proposal, ...]:
    """Return the certain corrections of mounting, unit, sign and delay from the first minutes of a drive."""
    mapping = survey.mapping
    proposals: list[Proposal] = []
    signals, truth = dict(mapping.signals), dict(mapping.truth)
    mounting = survey.mounting
    is_turned_imu = mounting is not None and mounting.confident and not mounting.is_as_named
    if mounting is not None and is_turned_imu:
        for name, source in turned_signals(mapping, mounting, survey.triads).items():
            if source != signals[name]:
                signals[name] = source
                proposals.append(Proposal(name, f"{mounting.text}: {mounting.evidence}", source))
    factors = {} if is_turned_imu else explained_factors(survey.measured, mounting_is_known=survey.is_mounted)
    for subject, (factor, evidence) in factors.items():
        section = truth if subject.startswith("truth.") else signals
        name = subject.removeprefix("truth.")
        if name in section:
            section[name] = scaled_source(section[name], factor)
            proposals.append(Proposal(subject, evidence, section[name]))
    if not factors and not is_turned_imu:
        proposals += _of_a_turned_truth(survey)
    for name, (delay_s, evidence) in _delays(survey).items():
        late = replace(signals[name], latency_s=round(signals[name].latency_s + delay_s, 4))
        proposals.append(Proposal(name, evidence, late))
    return tuple(proposals)


def _delays(survey: Survey) -> dict[str, tuple[float, str]]:
    """Return the delay and the evidence of each late signal, from ground truth, otherwise from another sensor."""
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
    """Return corrected ground-truth sources if the sideslip has a constant offset that a mapping can correct."""
    columns, truth = survey.measured.columns, survey.mapping.truth
    check = None if survey.truth is None else offset_check(columns)
    if check is None or check.verdict != "failed":
        return []
    (offset, _), evidence = sideslip_offset(columns), check.evidence
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
    return [Proposal(f"truth.{n}", evidence, source) for n, source in changed.items()]


def _single(value: float | tuple[float, ...]) -> float:
    return value[0] if isinstance(value, tuple) else value
