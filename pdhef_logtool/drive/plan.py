"""Plan of a drive, decided from its first ten minutes: clocks, alignment, ground truth and checks.

In a car, mounting, delays, clocks and parameters are known from earlier drives (:mod:`pdhef_logtool.car.model`).
Offline they come from the log itself, so that estimates depend on later samples. With a model file they do not.
"""

from collections.abc import Mapping as Mapped, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from pydantic import ConfigDict
from pydantic.dataclasses import dataclass as checked_dataclass

from pdhef_logtool.car.assumed_values import assumed_car
from pdhef_logtool.car.car import Car
from pdhef_logtool.car.model import read_model
from pdhef_logtool.car.vehicle import VehicleParameters, default_vehicle
from pdhef_logtool.drive.alignment import SURVEY_S, AlignmentPlan, plan_alignment
from pdhef_logtool.drive.delays import LatencyEstimate
from pdhef_logtool.drive.survey import survey_log
from pdhef_logtool.drive.truth import TruthPlan, dependent_signals
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.mapping import ClockModel, Mapping, check_mapping, clock_key, fit_clocks
from pdhef_logtool.mapping.records import CanSettings, SignalSource
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.errors import VehicleError
from pdhef_logtool.records.signals import NS_PER_S, S_PER_NS, Channel
from pdhef_logtool.storage.documents import validated

#: The offset of a device clock changes between logs: it is estimated from the messages of this duration.
CLOCK_START_S = 1.0
_REMEDY = "give the model.toml of a run of the same car and recorder"


@checked_dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid", defer_build=True))
class Sensors:
    """How the sensors of a recorder are read.

    Attributes
    ----------
    signals, can : the mapping of the sensors, with mounting and units applied.
    clocks : relation of stamps to log time, by topic and stamp of the sensors.
    alignment : source, delay and gaps of every channel.
    decided_s : duration of the log that decided them.
    """

    signals: dict[str, SignalSource]
    clocks: dict[str, ClockModel]
    alignment: AlignmentPlan
    decided_s: float
    can: CanSettings | None = None


@dataclass(frozen=True, slots=True, eq=False)
class DrivePlan:
    """Decisions from the first ten minutes of a log that apply to all of it.

    Attributes
    ----------
    survey_truth : ground truth channels of these minutes.
    latency : of the ground truth against the sensors; None without ground truth yaw rate or gyro.
    dependent : ground truth quantities that are an input of the estimators, with the reason.
    derivation : derivation of each ground truth quantity.
    decided_s : duration that decided the sensors, of this log, or of the log of the model file.
    checks : of signals, ground truth and vehicle file.
    refused : mapped channels that must not be used, with the reason; names of ground truth begin with ``truth.``.
    """

    mapping: Mapping
    vehicle: VehicleParameters
    clocks: dict[str, ClockModel]
    alignment: AlignmentPlan
    truth: TruthPlan | None
    latency: LatencyEstimate | None
    dependent: dict[str, str]
    derivation: dict[str, str]
    survey_truth: dict[str, Channel]
    start_ns: int
    end_ns: int
    decided_s: float
    checks: tuple[Check, ...] = ()
    refused: dict[str, str] = field(default_factory=dict)

    @property
    def truth_latency_s(self) -> float:
        """Latency for all comparisons with ground truth; 0 unless it exceeds two standard errors."""
        is_significant = self.latency is not None and abs(self.latency.latency_s) > 2.0 * self.latency.std_error_s
        return self.latency.latency_s if is_significant and self.latency is not None else 0.0

    @property
    def has_truth_pose(self) -> bool:
        """Whether the ground truth has position and heading."""
        return {"position_m", "yaw_rad"} <= self.derivation.keys()

    @property
    def sensors(self) -> Sensors:
        """Mapping, clocks and alignment of the sensors, for later drives."""
        signals = self.mapping.signals
        keys = {clock_key(source) for source in signals.values()}
        clocks = {key: clock for key, clock in self.clocks.items() if key in keys}
        return Sensors(signals, clocks, self.alignment, self.decided_s, self.mapping.can)


def plan_drive(
    log: DriveLog,
    mapping: Mapping,
    vehicle: VehicleParameters | None,
    start_ns: int,
    end_ns: int,
    *,
    require_imu: bool = True,
    sensors: Sensors | None = None,
    waived: Sequence[str] = (),
) -> DrivePlan:
    """Read at most ten minutes of the slice [start_ns, end_ns) and decide clocks, alignment and ground truth.

    Parameters
    ----------
    vehicle : None for the default car, whose size the sensors decide.
    require_imu : False gives a plan with no alignment (``alignment.channels`` empty) where there is no IMU.
    sensors : of an earlier drive; None decides them here.
    waived : names of checks that may fail without excluding a channel.

    Raises
    ------
    MappingError : The log lacks a mapped topic or field, or an IMU.
    """
    given = vehicle or default_vehicle()
    mapping = with_gyro_delay(mapping, given)
    if sensors is not None:
        mapping = replace(mapping, signals=sensors.signals, can=sensors.can, origin="file")
    clocks = fit_clocks(log, mapping, start_ns, end_ns)
    if sensors is not None:
        clocks |= clocks_of(sensors, log, mapping, start_ns)
    span_ns = (start_ns, min(end_ns, start_ns + round(SURVEY_S * NS_PER_S)))
    survey = survey_log(log, mapping, clocks, span_ns, given)
    if sensors is not None:
        alignment = sensors.alignment
    else:
        alignment = plan_alignment(survey.measured.signals, given, require_imu=require_imu)
    # The signals of earlier sensors must not depend on later samples.
    refused = survey.refused(waived, is_causal=sensors is not None)
    mapping, sound = without_refused_truth(survey.mapping, refused), survey
    if mapping is not survey.mapping:
        sound = survey.with_truth(mapping.truth)
    measured, derived = sound.measured, sound.measured.derived
    return DrivePlan(
        mapping=mapping,
        vehicle=vehicle or survey.assumed_car,
        clocks=clocks,
        alignment=alignment.without(refused),
        truth=None if derived is None else derived.plan,
        latency=measured.latency,
        dependent=dependent_signals(measured.signals, measured.truth) if derived else {},
        derivation={} if derived is None else dict(derived.derivation),
        survey_truth=dict(measured.truth),
        start_ns=start_ns,
        end_ns=end_ns,
        decided_s=(end_ns - start_ns) * S_PER_NS if sensors is None else sensors.decided_s,
        checks=survey.checks,
        refused=refused,
    )


def without_refused_truth(mapping: Mapping, refused: Mapped[str, str]) -> Mapping:
    """Return the mapping without the refused ground truth, or without any if a quantity derived from it is refused."""
    names = {n.removeprefix("truth.") for n in refused if n.startswith("truth.")}
    if not names:
        return mapping
    kept = {n: s for n, s in mapping.truth.items() if n not in names}
    return replace(mapping, truth=kept if names <= mapping.truth.keys() else {})


def with_gyro_delay(mapping: Mapping, vehicle: VehicleParameters) -> Mapping:
    """Return the mapping with the car's gyro delay in place of the mapping's."""
    delay_s, gyro = vehicle.sensors.yaw_rate_delay_s, mapping.signals.get("yaw_rate_rad_s")
    if delay_s == 0.0 or gyro is None or gyro.latency_s == delay_s:
        return mapping
    note = f"the car's gyro is {delay_s * 1e3:.1f} ms late, in place of latency_s = {gyro.latency_s:g} of the mapping"
    signals = {**mapping.signals, gyro.name: replace(gyro, latency_s=delay_s)}
    return replace(mapping, signals=signals, notes=(*mapping.notes, note))


def with_earlier_drive(car: Car, path: Path) -> tuple[Car, Sensors]:
    """Return a car with the model of an earlier drive, and the sensors of that drive.

    Raises
    ------
    VehicleError : The file is missing, wrong, of another vehicle file, or without sensors.
    """
    model = read_model(path, "auto, off or a model.toml", _REMEDY)
    if model.wheelbase_m is not None and car.vehicle == default_vehicle():
        car = replace(car, vehicle=assumed_car(model.wheelbase_m))
    if not model.belongs_to(car.vehicle):
        raise VehicleError(
            expected=f"a model of the car {car.vehicle.name}",
            got=f"one of the vehicle file of {model.vehicle}, which differs",
            where=str(path),
            remedy="give the --car of that run, or a model of this car",
        )
    what = "the entries of a model.toml"
    sensors = validated(Sensors, model.sensors, f"{path}: sensors", VehicleError, expected=what, remedy=_REMEDY)
    return replace(car, model=model.over(car.model)), sensors


def clocks_of(sensors: Sensors, log: DriveLog, mapping: Mapping, start_ns: int) -> dict[str, ClockModel]:
    """Return the clocks of the sensors. A device clock keeps its drift; its offset is from this log's first messages.

    Parameters
    ----------
    mapping : with the sensors applied.

    Raises
    ------
    MappingError : The log lacks a topic of the sensors.
    """
    read = replace(mapping, truth={}, quality=None)
    check_mapping(read, log)
    first = fit_clocks(log, read, start_ns, start_ns + round(CLOCK_START_S * NS_PER_S))
    return {
        key: replace(clock, reference_stamp_ns=new.reference_stamp_ns, reference_log_ns=new.reference_log_ns)
        if is_device_clock(clock) and is_device_clock(new := first[key])
        else clock
        for key, clock in sensors.clocks.items()
    }


def is_device_clock(clock: ClockModel) -> bool:
    """Return whether stamps of the clock are shifted to log time."""
    return (clock.reference_stamp_ns, clock.reference_log_ns, clock.drift) != (0, 0, 0.0)
