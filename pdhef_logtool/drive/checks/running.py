"""Execution of all registered checks of a drive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from pdhef_logtool.car.vehicle import VehicleParameters, default_vehicle
from pdhef_logtool.drive.checks.by_relations import explained_factors, relation_checks
from pdhef_logtool.drive.checks.kind import CheckedDrive
from pdhef_logtool.drive.checks.mounting import FAULT, FAULTY_SHARE
from pdhef_logtool.drive.checks.registry import registered
from pdhef_logtool.drive.delays import LateSensor
from pdhef_logtool.drive.faulty_samples import without_faulty_samples
from pdhef_logtool.drive.measured import Measured, measure
from pdhef_logtool.drive.truth import LatencyEstimate, TruthTrack
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.signals import Channel

#: If a check of one of these aspects fails, the channel is not the signal that it is mapped to.
_MISREAD = frozenset({"sign", "unit", "scale", "axis", "mounting"})
_BADNESS = {"passed": 0, "undecided": 1, "failed": 2}


def check_drive(
    signals: Mapping[str, Channel],
    truth: Mapping[str, Channel] | None = None,
    derived: TruthTrack | None = None,
    vehicle: VehicleParameters | None = None,
    *,
    latency: LatencyEstimate | None = None,
    late: Sequence[LateSensor] = (),
    mounting_is_known: bool = False,
    measured: Measured | None = None,
) -> tuple[Check, ...]:
    """Return the checks of mapped signals, of ground truth and of the vehicle file.

    If a check fails, the checks are repeated without faulty samples.

    Parameters
    ----------
    signals, truth : by name, SI, as mapped. derived : ground truth at the CG.
    vehicle : from a file; None or the default car without a file.
    latency : of ground truth against the gyro, or of the gyro. late : late sensors, detected without ground truth.
    mounting_is_known : the mounting of the IMU is confirmed.
    measured : result of :func:`~pdhef_logtool.drive.measured.measure` for the channels; computed by default.
    """

    def checks_of(measured: Measured) -> tuple[Check, ...]:
        drive = CheckedDrive(
            measured=measured,
            vehicle=vehicle or default_vehicle(),
            has_file=vehicle not in (None, default_vehicle()),
            latency=latency,
            late=tuple(late),
            has_truth=derived is not None,
            related=relation_checks(measured, mounting_is_known=mounting_is_known),
        )
        return _all_checks(drive)

    whole = measure(signals, truth, derived, vehicle) if measured is None else measured
    checks = checks_of(whole)
    if all(check.verdict != "failed" for check in checks):
        return checks
    sound, shares = without_faulty_samples(signals, vehicle or default_vehicle())
    # The fault detector cannot distinguish a dead channel from a channel in another unit; the whole drive can.
    if not shares or not shares.keys() - explained_factors(whole, mounting_is_known=mounting_is_known).keys():
        return checks
    evidence = "{:.0%} of the car's motion is during its stuck or dead samples"
    faults = [FAULT.failed(evidence.format(share), n) for n, share in shares.items() if share > FAULTY_SHARE]
    again = replace(measure(sound, truth, derived, vehicle), scales=whole.scales, open_signs=whole.open_signs)
    # A check of a faulty sensor that passes only without the faulty samples is undecided.
    doubted = {c.name: c.remedy for c in checks if c.verdict == "failed" and c.subject in shares}
    checks = checks_of(again)
    for n in (c.name for c in checks if c.verdict == "passed" and c.name in doubted):
        remedy = f"needs a drive without faults of it: {doubted[n]}"
        checks = tuple(replace(c, verdict="undecided", remedy=remedy) if c.name == n else c for c in checks)
    return (*faults, *checks)


def misread_channels(checks: Sequence[Check], waived: Sequence[str] = ()) -> dict[str, str]:
    """Return the subjects that must not be used, with the reason: a failed check that is not waived, and its remedy."""
    misread: dict[str, str] = {}
    for check in checks:
        subject, _, aspect = check.name.rpartition(".")
        if check.verdict == "failed" and aspect in _MISREAD and check.name not in waived:
            misread.setdefault(subject, f"check {check.name} failed: {check.remedy}")
    return misread


def _all_checks(drive: CheckedDrive) -> tuple[Check, ...]:
    for kind in registered().values():
        if kind.function is not None:
            drive.judged.extend(kind.function(drive))
    unique: dict[str, Check] = {}
    for check in drive.judged:  # the worse of two checks with one name counts
        if check.name not in unique or _BADNESS[check.verdict] > _BADNESS[unique[check.name].verdict]:
            unique[check.name] = check
    return tuple(unique.values())
