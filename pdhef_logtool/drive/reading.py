"""Reading of a drive: a log is opened for a car, mapped and planned, then read as a whole."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import VehicleParameters, default_vehicle
from pdhef_logtool.drive.checks import CHANGE_SUFFIX, change_checks
from pdhef_logtool.drive.friction import FrictionFrom, FrictionSource, friction_source
from pdhef_logtool.drive.options import AS_IT_IS, AUTO, OFF, ReadOptions, time_slice
from pdhef_logtool.drive.plan import CLOCK_START_S, DrivePlan, Sensors, is_device_clock, plan_drive, with_earlier_drive
from pdhef_logtool.drive.recorded import WholeDrive as WholeDrive, read_recorded
from pdhef_logtool.logs.discovery import LogInput, Logs, check_unchanged, find_logs, identity_of, log_state
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.remote_place import LogPlace
from pdhef_logtool.mapping import (
    AutoMapping,
    ClockModel,
    Mapping,
    check_mapping,
    choose_mapping,
    clock_key,
    mapping_of,
    merge_losses,
    tables_for,
)
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.errors import EstimatorError, MappingError, UsageError
from pdhef_logtool.records.ledger import damage
from pdhef_logtool.records.signals import GNSS_POSITION, Loss
from pdhef_logtool.records.steps import MAX_PREDICTION_S

_MODEL_CAR = "no --car: the default car is scaled to {:.2g} m, the wheelbase that steering, yaw rate and speed show"
Tell = Callable[[str], None]
#: Returns the mapping to read with, from the log and the mapping in effect; may print a message.
Adjust = Callable[[DriveLog, Mapping, Tell], Mapping]


@dataclass(slots=True, eq=False)
class Drive:
    """One log, opened for one car; a context manager that closes the log.

    Attributes
    ----------
    name : of the log in tables and folders. chosen : the mapping before the drive changed it.
    plan : decisions from the first minutes; may be replaced before reading.
    friction : friction source for :meth:`whole`; may be replaced before reading.
    earlier : sensors of an earlier drive, None without.
    notes : warnings to the user about this drive. remarks : other information.
    """

    name: str
    log: DriveLog
    car: Car
    options: ReadOptions
    plan: DrivePlan
    chosen: AutoMapping
    notes: list[str]
    friction: FrictionSource
    earlier: Sensors | None
    _tell: Tell
    remarks: list[str] = field(default_factory=list)
    _recorded: WholeDrive | None = None
    _sha256: str = ""
    _state: tuple[tuple[int, int, int], ...] = ()

    def __repr__(self) -> str:
        return f"<Drive {self.name}: {self.path}, car {self.car.vehicle.name}>"

    @property
    def path(self) -> LogPlace:
        """The file, folder or object."""
        return self.log.path

    @property
    def mapping(self) -> Mapping:
        """The mapping in effect."""
        return self.plan.mapping

    @property
    def available(self) -> frozenset[str]:
        """Aligned signals that the log provides."""
        return self.plan.alignment.available

    @property
    def causal_from_s(self) -> float | None:
        """Time in the slice, s, from which the sensors depend on past samples only; None: they depend on all."""
        if self.earlier is None:
            return None
        return CLOCK_START_S if any(map(is_device_clock, self.plan.clocks.values())) else 0.0

    @property
    def not_causal(self) -> str:
        """Reason why no estimator is causal on this drive; empty if causality depends on the estimator."""
        names = [c.name for c in self.plan.alignment.channels if c.clock == "stamp" or not self._delay_known(c.name)]
        if not names:
            return ""
        shown = "all signals" if len(names) == len(self.plan.alignment.channels) else ", ".join(names)
        return f"not causal: {shown} read by stamp, not by arrival"

    def _delay_known(self, signal: str) -> bool:
        sources = self.mapping.signals
        source = sources[signal if signal in sources else GNSS_POSITION[0]]  # GNSS velocity from positions
        return self.plan.clocks.get(clock_key(source), ClockModel()).delay_known

    @property
    def checks(self) -> tuple[Check, ...]:
        """Checks of signals, ground truth and vehicle file, after reading also of changes; waived checks are marked."""
        changes = () if self._recorded is None else self._recorded.every_change
        return (*_checks_of(self.plan, self.options), *change_checks(changes, self.log.start_ns))

    @property
    def sha256(self) -> str:
        """Identity of the log (:func:`identity_of`), computed at the first access."""
        self._sha256 = self._sha256 or identity_of(LogInput(self.path, self.name))
        check_unchanged(self.path, self._state)
        return self._sha256

    @property
    def losses(self) -> tuple[Loss, ...]:
        """Data that could not be used; complete after reading. Files are named without their folder."""
        read = self._recorded
        merged = merge_losses([self.log.lost, *([] if read is None else [read.losses, damage(read.ledger)])])
        return tuple(replace(x, where=x.where.removeprefix(f"{self.path.parent}/")) for x in merged)

    def tell(self, text: str) -> None:
        """Report a note to the user, and add it to the notes of this drive."""
        self.notes.append(text)
        self._tell(f"{self.name}: {text}")

    def whole(self) -> WholeDrive:
        """Return the whole drive with its friction; it is read once per plan.

        Raises
        ------
        EstimatorError : The slice contains no stamp.
        """
        recorded = self.recorded()
        if not len(recorded.signals):
            raise no_samples(self.path)
        return replace(recorded, signals=self.friction.fill(recorded.signals, recorded.truth))

    def recorded(self) -> WholeDrive:
        """Return the drive as recorded, which may be empty."""
        if self._recorded is None or self._recorded.plan is not self.plan:
            unchanged = [n.removesuffix(CHANGE_SUFFIX) for n in self.options.waived]
            self._recorded = read_recorded(self.log, self.plan, unchanged, self.name)
            for check in change_checks(self._recorded.every_change, self.log.start_ns):
                if (text := _failed_text(check)) not in self.notes:
                    self.tell(text)
        return self._recorded

    def close(self) -> None:
        """Close the log."""
        self.log.close()

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the log."""
        self.close()


def read_drive(
    log: LogInput | LogPlace | str,
    car: Car | Path | str,
    mapping: Mapping | Path | str | None = None,
    options: ReadOptions = AS_IT_IS,
    *,
    tell: Tell = lambda _text: None,
    adjust: Adjust | None = None,
    require_sensors: bool = True,
) -> Drive:
    """Open a log for a car, and decide mapping, clocks, alignment and friction for all of it.

    Parameters
    ----------
    log : a file, folder or URL, or a :class:`LogInput`, which also contains the name of the drive and may contain a
        slice.
    car : a car, or an argument for :meth:`Car.load`. mapping : a mapping or its file; None recognises message types.
    tell : called with ``NAME: text`` for each note to the user; :attr:`Drive.notes` contains them too.
    adjust : changes the mapping in effect.
    require_sensors : False reads a log without an IMU, or without any recognised signal, for its ground truth alone.

    Returns
    -------
    drive : to be closed, best by ``with``.

    Raises
    ------
    PdhefError : The log is not readable, it lacks a mapped field, or the slice is outside of it.

    >>> with read_drive("sample_logs/dlc.mcap", Car.load("saloon")) as drive:
    ...     len(drive.whole().signals), drive.losses
    (951, ())
    """
    car = car if isinstance(car, Car) else Car.load(car)
    mapping = mapping_of(mapping)
    log_input = log if isinstance(log, LogInput) else one_log(log, options)
    if log_input.span_s is not None:
        start_s, end_s = log_input.span_s
        options = replace(options, start=f"{start_s:.9f}", end=f"{end_s:.9f}")
    notes: list[str] = []
    remarks: list[str] = []

    def told(text: str) -> None:
        notes.append(text)
        tell(f"{log_input.stem}: {text}")

    state = log_state(log_input.path)
    tables = tables_for(mapping, options.tables)
    opened = open_log(log_input.path, options.limits, options.msgs, tables)
    try:
        earlier = None
        if options.model not in (AUTO, OFF):
            car, earlier = with_earlier_drive(car, options.model)
        chosen = choose_mapping(opened, mapping, prefer_truth=options.prefer_truth, require_signals=require_sensors)
        for ambiguity in chosen.ambiguities:
            told(str(ambiguity))
        remarks += chosen.mapping.notes
        used = chosen.mapping
        if adjust is not None:
            used = adjust(opened, used, told)
            check_mapping(used, opened)
        if opened.end_ns <= opened.start_ns:
            raise no_samples(log_input.path)
        slice_ns = time_slice(options, opened.start_ns, opened.end_ns)
        if opened.messages is not None:
            opened.messages.prefetch({source.topic for source in used.sources()}, [slice_ns])
        given = None if options.model == AUTO and car.vehicle == default_vehicle() else car.vehicle
        plan = plan_drive(
            opened, used, given, *slice_ns, require_imu=require_sensors, sensors=earlier, waived=options.waived
        )
        if plan.vehicle != car.vehicle:
            told(_MODEL_CAR.format(plan.vehicle.wheelbase_m))
        car = replace(car, vehicle=plan.vehicle)
        _tell_doubts(plan, len(used.notes), options, told)
        friction = friction_of(plan, car.vehicle, options)
        if friction.note:
            remarks.append(friction.note)
    except BaseException as error:
        _name_damage(error, opened)
        opened.close()
        raise
    return Drive(
        log_input.stem, opened, car, options, plan, chosen, notes, friction, earlier, tell, remarks, _state=state
    )


def logs_of(arguments: Logs, options: ReadOptions) -> list[LogInput]:
    """Return the logs that files, folders and patterns represent (:func:`find_logs`)."""
    return find_logs(arguments, private_redirects=options.allow_private_redirects, settings=options.tables)


def one_log(argument: LogPlace | str, options: ReadOptions = AS_IT_IS) -> LogInput:
    """Return the log that a file, folder or pattern represents; raises UsageError unless there is exactly one."""
    inputs = logs_of(argument, options)
    if len(inputs) != 1:
        raise UsageError(expected="one log", got=f"{len(inputs)} of them", where=str(argument))
    return inputs[0]


def lost_texts(losses: Iterable[Loss]) -> tuple[str, ...]:
    """Return the lost parts of the input as texts."""
    return tuple(f"{x.what} ({x.where})" for x in losses if x.severity == "lost")


def _name_damage(error: BaseException, log: DriveLog) -> None:
    """Add the damage of a log to an error as the probable cause: a truncated file may lack mapped fields."""
    if not isinstance(error, MappingError | EstimatorError) or not (
        lost := [x for x in log.lost if x.severity == "lost"]
    ):
        return
    error.got = f"a damaged log: {'; '.join(x.what for x in lost[:2])}. {error.got[:1].upper()}{error.got[1:]}"
    if any(x.kind == "truncated" for x in lost):
        error.remedy = f"the file is cut: copy the recording again. If it is complete, {error.remedy or 'report it'}"


def no_samples(path: LogPlace) -> EstimatorError:
    """Return the error for a slice without a stamp."""
    return EstimatorError(
        expected="IMU samples in the chosen slice",
        got="none that can be used",
        where=str(path),
        remedy="pdhef inspect LOG shows the contents of the log and the dropped samples",
    )


def _checks_of(plan: DrivePlan, options: ReadOptions) -> tuple[Check, ...]:
    return tuple(replace(c, waived=True) if c.name in options.waived else c for c in plan.checks)


def _failed_text(check: Check) -> str:
    return f"check {check.name} failed{' (waived)' if check.waived else ''}: {check.evidence}; {check.remedy}"


def _tell_doubts(plan: DrivePlan, notes: int, options: ReadOptions, tell: Tell) -> None:
    """Report the mapping's notes after the first ``notes``, failed checks, and signals that are not used."""
    for note in plan.mapping.notes[notes:]:
        tell(note)
    for check in _checks_of(plan, options):
        if check.verdict == "failed":
            tell(_failed_text(check))
    unknown = {n for n in options.waived if not n.endswith(CHANGE_SUFFIX)} - {c.name for c in plan.checks}
    for name in sorted(unknown):
        tell(f"--waive {name}: no check of this log is called that")
    for channel in (c for c in plan.alignment.channels if c.clock == "stamp"):
        mapped = plan.mapping.signals.get(channel.name)
        source = mapped.label if mapped else "from other channels"
        tell(
            f"{channel.name} ({source}) arrives {channel.delay_s:.2f} s after its stamps, expected at most "
            f"{MAX_PREDICTION_S:g} s: it is read by its stamps, and no estimate of this log is causal"
        )
    for name, reason in plan.alignment.unused:
        if name not in plan.refused:
            tell(f"{name} is not used: {reason}")
    if plan.refused:
        tell(f"not used until the failed checks are corrected or waived: {', '.join(sorted(plan.refused))}")


def friction_of(
    plan: DrivePlan, vehicle: VehicleParameters, options: ReadOptions, *, of_truth: bool = False
) -> FrictionSource:
    """Return the friction source of a drive by its options.

    With ``of_truth``, ``auto`` uses the friction of the ground truth if the log contains it.
    """
    true = plan.mapping.truth.get("friction") if of_truth and options.friction == "auto" else None
    if true is not None:
        return FrictionSource(FrictionFrom.TRUTH, topic=true.label)
    source = plan.mapping.signals.get("friction")
    return friction_source(options.friction, vehicle, plan.alignment.available, "" if source is None else source.label)
