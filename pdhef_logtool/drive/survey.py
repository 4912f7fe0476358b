"""Survey of a drive: its first minutes as the mapping reads them, with the corrections that they show.

Corrections of unit, sign, mounting, heading of ground truth and delay. A recognised mapping is corrected where that is
certain; a mapping file is only checked, and its corrections are proposals, each relative to the current mapping: the
order of their application does not matter.
"""

import math
from collections.abc import Collection, Iterator, Mapping as Mapped, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from pdhef_logtool.car.assumed_values import assumed_car
from pdhef_logtool.car.vehicle import VehicleParameters, default_vehicle
from pdhef_logtool.drive import checks
from pdhef_logtool.drive.check_table import result
from pdhef_logtool.drive.delays import LATE_GYRO_S
from pdhef_logtool.drive.measured import Measured, measure
from pdhef_logtool.drive.mounting import ACCELERATIONS, RATES, Mounting, find_mounting, find_triads
from pdhef_logtool.drive.relation_checks import CERTAIN, explained_factors
from pdhef_logtool.drive.relations import effective_wheelbase_m
from pdhef_logtool.drive.truth import TruthTrack, derive_truth
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.mapping import ClockModel, Mapping, SignalSource, read_signals
from pdhef_logtool.mapping.mapping_file import entries_of
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.signals import Channel

#: Smaller delays of a_y may be due to body roll.
LEAST_AY_DELAY_S = 0.015
#: Kinds of corrections of a recognised mapping: at most one of each, one after the other.
CORRECTIONS = ("mounting", "sign", "unit")


@dataclass(frozen=True, eq=False)
class Survey:
    """The first minutes of a log as its mapping reads them; ``corrected``: checks for changes of a recognised one."""

    mapping: Mapping
    measured: Measured
    mounting: Mounting | None = None
    corrected: tuple[Check, ...] = ()

    @property
    def mounted(self) -> tuple[Check, ...]:
        """Checks of the axes that the IMU's signals are read from."""
        return () if self.mounting is None else self.mounting.checks(self.mapping)

    @cached_property
    def checks(self) -> tuple[Check, ...]:
        """Checks of the mounting and of :func:`~pdhef_logtool.drive.checks.check_drive`."""
        drive_checks = checks.check_drive(self.measured)
        return (*self.mounted, *self.corrected, *self._of_names(drive_checks), *drive_checks)

    @cached_property
    def sensor_checks(self) -> tuple[Check, ...]:
        """Checks of the sensors without ground truth, which must not influence the inputs of the estimators."""
        if not self.measured.truth:
            return self.checks
        return (*self.mounted, *checks.check_drive(self.measured.sensors))

    @property
    def assumed_car(self) -> VehicleParameters:
        """The car that is assumed without a vehicle file, by the sensors."""
        sensed = self.measured.sensors
        return assumed_car(effective_wheelbase_m(sensed.columns, sensed.speed_name))

    def refused(self, waived: Sequence[str] = (), *, is_causal: bool = False) -> dict[str, str]:
        """Return the channels that must not be used, with the reason. Ground truth does not decide about sensors.

        Parameters
        ----------
        waived : names of checks that are ignored. is_causal : no sensor is refused because of later samples.
        """
        by_everything = checks.misread_channels(self.checks, waived)
        refused = {n: why for n, why in by_everything.items() if n.startswith("truth.")}
        return refused if is_causal else refused | checks.misread_channels(self.sensor_checks, waived)

    def with_truth(self, names: Collection[str]) -> "Survey":
        """Return the survey with the ground truth of some channels only, for its plan, track and latency."""
        truth = {n: c for n, c in self.measured.truth.items() if n in names}
        derived = _derived(truth, self.measured.vehicle or default_vehicle())
        return replace(self, measured=replace(self.measured, truth=truth, derived=derived))

    def _of_names(self, drive_checks: tuple[Check, ...]) -> Iterator[Check]:
        """Yield the mapping's undecided checks that the drive does not decide either."""
        passed = {c.name for c in drive_checks if c.verdict == "passed"} - {
            f"{c.subject}.sign" for c in drive_checks if c.verdict != "passed"
        }
        doubts = [c for c in self.mapping.checks if "unit" in c.evidence or "share" in c.evidence]
        doubted = {c.name.removesuffix(".candidate") for c in doubts}
        for check in self.mapping.checks:
            signal = check.name.removesuffix(".candidate")
            # Without a known radius, rim speeds in m/s and in rad/s look alike. v_y has the unit of its v_x.
            unit = f"{signal.replace('truth.vy', 'truth.vx')}.unit"
            is_resolved = unit in passed and not signal.startswith("wheel") and "a share" not in check.evidence
            # Values that identified a signal do not confirm it.
            is_proposed = "values alone" in check.evidence
            if f"{signal}.sign" not in passed or is_proposed or (signal in doubted and not is_resolved):
                yield check


def survey_log(
    log: DriveLog,
    mapping: Mapping,
    clocks: dict[str, ClockModel],
    span_ns: tuple[int, int],
    vehicle: VehicleParameters | None = None,
    *,
    corrections: int = len(CORRECTIONS),
) -> Survey:
    """Read a span of a log and find the mounting of its IMU and a wrong unit or sign.

    A recognised mapping is corrected where that is certain, with a note; a mapping file is only checked.

    Parameters
    ----------
    vehicle : of the drive; None uses the default car. corrections : largest number of corrections of the mapping.
    """
    vehicle = vehicle or default_vehicle()
    triads = find_triads(log, mapping)
    extra = {} if triads is None else triads[0].components(ACCELERATIONS) | triads[1].components(RATES)
    channels = read_signals(log, replace(mapping, signals={**mapping.signals, **extra}), clocks, *span_ns)
    derived = _derived(channels.truth, vehicle)
    measured = measure(channels.signals, channels.truth, derived, vehicle, mapping)
    # The inputs of an estimator must not depend on ground truth: a mounting from ground truth is only checked.
    mounting = find_mounting(measured.sensors, triads, mapping)
    blind = mounting is not None and mounting.confident
    if not blind and derived is not None:
        mounting = find_mounting(measured, triads, mapping)
    is_mounted = mounting is not None and mounting.confident and mounting.is_as_named
    survey = Survey(mapping, replace(measured.without(extra), is_mounted=is_mounted), mounting)
    if corrections == 0 or mapping.origin != "auto":
        return survey
    proposals, kind = _certain_proposals(survey, is_mounting_blind=blind)
    if not proposals:
        return survey
    changed, left = apply_proposals(proposals, mapping), 0 if kind == "unit" else corrections - 1
    changed = changed if kind == "mounting" else replace(changed, open_signs=())
    again = survey_log(log, changed, clocks, span_ns, vehicle, corrections=left)
    # A failing sensor resembles a wrong unit of another one, but only a right correction leaves no contradiction.
    failed = [check.name for check in again.checks if check.verdict == "failed"]
    if kind == "unit" and any(n.endswith((".sign", ".unit", ".axis")) for n in failed):
        return survey
    documented = () if kind == "sign" else tuple(map(_corrected, proposals))
    return replace(again, corrected=(*documented, *again.corrected))


def _derived(truth: Mapped[str, Channel], vehicle: VehicleParameters) -> TruthTrack | None:
    """Return the ground truth of a car; None without any."""
    place, gradient = vehicle.truth_position_m, vehicle.roll_gradient_rad_per_m_s2
    track = derive_truth(truth, truth_position_m=place, roll_gradient_rad_per_m_s2=gradient)
    return None if track.plan is None else track


def _certain_proposals(survey: Survey, *, is_mounting_blind: bool) -> "tuple[list[Proposal], str]":
    """Return the next correction of a recognised mapping, and its kind: ``mounting``, ``sign`` or ``unit``.

    Documented units, signs and axes are corrected without ground truth.
    """
    mapping, measured, mounting = survey.mapping, survey.measured, survey.mounting
    if is_mounting_blind and mounting is not None and not mounting.is_as_named:
        return _of_mounting(mapping, mounting), "mounting"
    if signs := [n for g in measured.open_signs if measured.posterior.turned(g[0]) >= CERTAIN for n in g]:
        why = "its sign is not documented, and the drive shows that it is inverted"
        return _rescaled(mapping, dict.fromkeys(signs, (-1.0, why))), "sign"
    documented = (replace(measured, open_signs=()) if measured.open_signs else measured).sensors
    return _rescaled(mapping, explained_factors(documented, most=1)), "unit"


def _corrected(proposal: "Proposal") -> Check:
    entries = entries_of(proposal.source, "field", "scale")
    return result("SIGNAL.corrected", "failed", proposal.subject, evidence=proposal.evidence, entries=entries)


def scaled_source(source: SignalSource, factor: float) -> SignalSource:
    """Return a source with scale and offset multiplied by a factor, without its valid range."""

    def times(value: float | tuple[float, ...]) -> float | tuple[float, ...]:
        return tuple(v * factor for v in value) if isinstance(value, tuple) else value * factor

    # A valid range in the wrong unit would drop correct values.
    return replace(source, scale=times(source.scale), offset=times(source.offset), valid_min=None, valid_max=None)


# ------------------------------------------------------------------------------------------------ proposals


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


def apply_proposals(proposals: Sequence[Proposal], mapping: Mapping) -> Mapping:
    """Return the mapping with the corrections in it, and a note for each reason."""
    names: dict[str, list[str]] = {}
    for proposal in proposals:
        names.setdefault(proposal.evidence, []).append(proposal.subject)
    notes = [f"{', '.join(changed)}: {reason}" for reason, changed in names.items()]
    return mapping.with_sources({p.subject: p.source for p in proposals}, notes)


def _of_mounting(mapping: Mapping, mounting: Mounting) -> list[Proposal]:
    """Return the sources of the IMU's signals that are on other axes than the mapping reads."""
    reason = f"{mounting.text}: {mounting.evidence}"
    return [Proposal(n, reason, s) for n, s in mounting.turned(mapping).items() if s != mapping.signals[n]]


def _rescaled(mapping: Mapping, factors: Mapped[str, tuple[float, str]]) -> list[Proposal]:
    """Return the correction of scales by factors, with their evidence."""
    sources = mapping.by_subject
    return [
        Proposal(n, said, scaled_source(sources[n], factor)) for n, (factor, said) in factors.items() if n in sources
    ]


def mapping_proposals(survey: Survey) -> tuple[Proposal, ...]:
    """Return the certain corrections of mounting, unit, sign and delay from the first minutes of a drive."""
    mapping, mounting = survey.mapping, survey.mounting
    if mounting is not None and mounting.confident and not mounting.is_as_named:
        proposals = _of_mounting(mapping, mounting)
    else:
        proposals = _rescaled(mapping, explained_factors(survey.measured)) or _of_a_turned_truth(survey)
    sources = mapping.by_subject | {p.subject: p.source for p in proposals}
    for name, (delay_s, evidence) in _delays(survey).items():
        late = replace(sources[name], latency_s=round(sources[name].latency_s + delay_s, 4))
        proposals.append(Proposal(name, evidence, late))
    return tuple(proposals)


def _delays(survey: Survey) -> dict[str, tuple[float, str]]:
    """Return the delay and the evidence of each late signal, from ground truth, otherwise from another sensor."""
    delays: dict[str, tuple[float, str]] = {}
    latency = survey.measured.latency
    if latency is not None and latency.gyro_delay_s >= LATE_GYRO_S:
        delays["yaw_rate_rad_s"] = latency.gyro_delay_s, latency.reason
    # The delay of a_y is not observable from another axis.
    is_mounted = survey.mounting is None or survey.mounting.is_as_named
    by_truth = checks.ay_delay(checks.sensor_errors(survey.measured.columns), latency) if is_mounted else None
    if by_truth is not None and by_truth[0] > max(LEAST_AY_DELAY_S, 3.0 * by_truth[1]):
        delays["ay_m_s2"] = by_truth[0], f"a_y is {by_truth[0] * 1e3:.1f} ms late against ground truth"
    for sensor in survey.measured.late:
        told_by_truth = sensor.names[0] == "yaw_rate_rad_s" and latency is not None and latency.reliable
        for name in sensor.names if sensor.exact and not told_by_truth else ():
            delays.setdefault(name, (sensor.delay_s, sensor.evidence))
    return delays


def _of_a_turned_truth(survey: Survey) -> list[Proposal]:
    """Return corrected ground-truth sources if the sideslip has a constant offset that a mapping can correct."""
    columns, truth = survey.measured.columns, survey.mapping.truth
    check = None if survey.measured.derived is None else checks.offset_check(columns)
    if check is None or check.verdict != "failed":
        return []
    (offset, _), evidence = checks.sideslip_offset(columns), check.evidence
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
