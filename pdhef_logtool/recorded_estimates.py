"""Scores estimates that somebody else recorded in a log: which fields they are, their stamps, truth there, figures.

The scored stamps are the estimate's own. The truth is interpolated to them, its latency measured gyro to truth where
the log has an IMU; the sensors, which only cut the drive into segments, are interpolated to them too.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pdhef_logtool.config import RunConfig, time_slice
from pdhef_logtool.drive_channels import DrivePlan, DriveReader, plan_drive
from pdhef_logtool.errors import MappingError, UsageError
from pdhef_logtool.estimators.physics import sideslip_std
from pdhef_logtool.evaluation.interpolation import Bracket
from pdhef_logtool.evaluation.truth import (
    SAME_SHARE,
    TruthTrack,
    dependent_signals,
    derive_truth,
    share_equal,
    truth_at,
)
from pdhef_logtool.logs.discovery import LogInput, find_logs
from pdhef_logtool.logs.drive_log import Columns, DriveLog, TopicInfo, windows
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import (
    Mapping as SignalMapping,
)
from pdhef_logtool.mapping import (
    SignalSource,
    apply_clock,
    check_mapping,
    clock_key,
    fit_clocks,
    join_channels,
    load_mapping,
    merge_losses,
    read_signals,
    resolve_mapping,
)
from pdhef_logtool.mapping.channels import LOSS_TEXTS, si_values
from pdhef_logtool.mapping.clocks import raw_stamps, stamp_request
from pdhef_logtool.mapping.mapping_file import RESERVED_NAMES
from pdhef_logtool.mapping.recognition import TWIST_FIELDS
from pdhef_logtool.pipeline import (
    DeadReckoning,
    LogResult,
    Progress,
    RunResult,
    choose_mapping,
    first_pose,
    hash_log,
    judge,
    make_folder,
    read_thresholds,
    report_facts,
    without_whole,
    write_run,
    write_verdicts,
)
from pdhef_logtool.signals import (
    ESTIMATE_UNITS,
    TRUTH_UNITS,
    WHEELS,
    BoolArray,
    Channel,
    FloatArray,
    IntArray,
    Loss,
    Signals,
    join_signals,
)
from pdhef_logtool.sinks.base import TRUTH, Event
from pdhef_logtool.sinks.report import EstimatorFacts, LogOutcome, build_report, write_json
from pdhef_logtool.tracks import StateTrack, concatenate, make_track
from pdhef_logtool.vehicle import VehicleParameters, default_vehicle, load_vehicle

if TYPE_CHECKING:
    from pdhef_logtool.evaluation.metrics import MetricRow

STATE_TYPE = "pdhef_msgs/VehicleStateEstimate"
#: Quantities that set the estimate's stamps, best first; any other is interpolated to them.
BASE_ORDER = ("sideslip_rad", "vy_m_s", "vx_m_s", "yaw_rate_rad_s", "ay_m_s2")
#: No quantity is interpolated, and no sensor, across a step of more than this many of its median periods.
GAP_PERIODS = 3.0

_STATE_FIELDS = (*BASE_ORDER, "sideslip_std_rad", "valid", "diverged")
_STDS = ("vx_std_m_s", "vy_std_m_s", "yaw_rate_std_rad_s")
#: Twist fields below a message's twist.
_TWIST = {"vx_m_s": "linear.x", "vy_m_s": "linear.y", "yaw_rate_rad_s": "angular.z"}


@dataclass(frozen=True, slots=True)
class CovarianceSource:
    """A covariance matrix of ``size`` rows in a message; ``planar`` are its places of v_x, v_y and yaw rate."""

    topic: str
    field: str
    size: int
    planar: tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class EstimateSource:
    """Where one estimator's recorded state is: its name, its quantities (``ESTIMATE_UNITS``), its covariance if any."""

    name: str
    signals: Mapping[str, SignalSource]
    covariance: CovarianceSource | None = None

    def as_mapping(self) -> SignalMapping:
        """Return the sources as a mapping, for what works on mappings: checks, stamps, clocks."""
        return SignalMapping(signals=dict(self.signals))


@dataclass(frozen=True, slots=True, eq=False)
class RecordedEstimate:
    """A recorded estimate on its own stamps.

    ``channels`` are its quantities on their own stamps, NaN left out; ``samples`` counts the messages by source.
    """

    track: StateTrack
    channels: Mapping[str, Channel]
    tells_divergence: bool
    samples: Mapping[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


def score_log(
    argument: str,
    config: RunConfig,
    *,
    estimates: Sequence[str] = (),
    truth: Sequence[str] = (),
    name: str | None = None,
    output: Path | None = None,
    junit: Path | None = None,
    progress: Progress = lambda _text, _share: None,
    warn: Callable[[str], None] = lambda _text: None,
) -> RunResult:
    """Score recorded estimates of one log against its truth; same figures, tables and report as a run.

    Parameters
    ----------
    argument : the log. config : of it count vehicle, mapping, slice, truth choice and thresholds.
    estimates : ``[SIGNAL=]TOPIC[.FIELD]``, together one estimator called ``name`` (default: its topic); without any,
        the mapping's ``[estimates.NAME.SIGNAL]`` tables, all or the one called ``name``.
    truth : likewise; without any, the mapping's or the recognised truth.
    output : folder for the files, None to write none. junit : as for :func:`pdhef_logtool.pipeline.run_logs`.

    Raises
    ------
    PdhefError
        There is no estimate, no truth, or nothing of the log can be used.
    """
    inputs = find_logs([argument])
    if len(inputs) != 1:
        raise UsageError(expected="one log", got=f"{len(inputs)} of them", where=argument)
    vehicle = default_vehicle() if config.vehicle is None else load_vehicle(config.vehicle)
    mapping = None if config.mapping is None else load_mapping(config.mapping)
    thresholds = read_thresholds(config, junit)
    if config.vehicle is None:
        slow = vehicle.low_speed_blend_m_s
        warn(
            f"no --vehicle: the truth is taken to be measured at the centre of gravity, sideslip is scored above "
            f"{slow:g} m/s, and segments are cut at friction {vehicle.assumed_friction:g}"
        )
    log = open_log(inputs[0].path)
    try:
        scoring = _Scoring(log, inputs[0], config, vehicle, warn)
        scoring.choose(mapping, estimates, truth, name)
        result = judge(scoring.score(output, progress), thresholds)
    finally:
        log.close()
    if output is not None:
        document = _config_document(config, scoring)
        write_run(output, document, [result])
    write_verdicts(junit, [result])
    return RunResult(output, (result,))


def _config_document(config: RunConfig, scoring: _Scoring) -> dict[str, Any]:
    document = config.to_dict()
    for key in ("estimators", "annotate", "sensors"):
        del document[key]
    document["estimates"] = {
        e.name: {name: source.label for name, source in e.signals.items()} for e in scoring.estimates
    }
    document["truth"] = {name: source.label for name, source in scoring.mapping.truth.items()}
    return document


class _Scoring:
    """One log being scored: what was chosen for it, and what the reader of the report must know."""

    def __init__(
        self,
        log: DriveLog,
        log_input: LogInput,
        config: RunConfig,
        vehicle: VehicleParameters,
        warn: Callable[[str], None],
    ) -> None:
        self.log, self.log_input, self.config, self.vehicle = log, log_input, config, vehicle
        self.mapping = SignalMapping()
        self.missing: tuple[str, ...] = ()
        self.estimates: tuple[EstimateSource, ...] = ()
        self.warnings: list[str] = []
        self._warn = warn

    def tell(self, text: str) -> None:
        """Say it now, and in the report."""
        self.warnings.append(text)
        self._warn(f"{self.log_input.stem}: {text}")

    def choose(
        self, mapping: SignalMapping | None, estimates: Sequence[str], truth: Sequence[str], name: str | None
    ) -> None:
        """Decide which fields are estimate, truth and sensors."""
        tables = {} if mapping is None else mapping.estimates
        self.estimates = choose_estimates(self.log, estimates, tables, name)
        named = sources_of(self.log, truth, TRUTH_UNITS, "--truth")[0] if truth else None
        if mapping is not None and not mapping.signals and not mapping.truth:
            mapping = None  # a file of estimates alone leaves the rest to recognition
        if mapping is not None and named is not None:
            mapping = self._with_truth(mapping, named)
        chosen, self.missing = choose_mapping(self.log, mapping, self.config, self.tell, require_signals=False)
        if mapping is None and named is not None:
            chosen = self._with_truth(chosen, named)
            check_mapping(chosen, self.log)
        self.mapping = chosen
        for estimate in self.estimates:
            check_mapping(estimate.as_mapping(), self.log)
        if not chosen.truth:
            raise MappingError(
                expected="a truth to score against",
                got="none mapped and none recognised",
                where=str(self.log.path),
                remedy="name it with --truth SIGNAL=TOPIC.FIELD or in a mapping file",
            )

    def _with_truth(self, mapping: SignalMapping, truth: dict[str, SignalSource]) -> SignalMapping:
        if mapping.quality is not None:
            self.tell(f"--truth replaces the mapped truth and its gate on {mapping.quality.describe()}")
        return replace(mapping, truth=truth, quality=None)

    def score(self, output: Path | None, progress: Progress) -> LogResult:
        """Read, compare and, with a folder, write."""
        log, stem = self.log, self.log_input.stem
        start_ns, end_ns = time_slice(self.config, log.start_ns, log.end_ns)
        sha256 = hash_log(self.log_input.path)
        progress(stem, 0.1)
        plan = plan_drive(log, self.mapping, self.vehicle, start_ns, end_ns, require_imu=False)
        recorded, losses = self._read_estimates(start_ns, end_ns)
        progress(stem, 0.3)
        truth, truth_losses, samples = read_truth(log, plan, self.config.window_s)
        progress(stem, 0.6)
        signals, sensor_losses, counts = self._read_sensors(plan)
        progress(stem, 0.8)
        samples |= counts
        scored_ns = np.unique(np.concatenate([r.track.stamps_ns for r in recorded]))
        plan = self._with_dependence(plan, recorded)
        rows, dependent = self._figures(plan, recorded, truth, signals)
        plan = replace(plan, dependent={**dependent, **plan.dependent})
        truth_track = truth_at(truth, scored_ns, plan.truth_latency_s)
        events = self._events(truth_track, signals_at(signals, scored_ns), recorded)
        for r in recorded:
            samples |= r.samples
        all_losses = merge_losses([log.lost, losses, truth_losses, sensor_losses])
        facts = report_facts(
            log, self.log_input, sha256, plan, self.missing, self.vehicle,
            [EstimatorFacts(r.track.name, causal=True, notes=r.notes) for r in recorded],
            rows, events, all_losses, self.warnings, samples,
        )  # fmt: skip
        read = {s.topic for e in self.estimates for s in e.signals.values()}
        topics = [replace(t, mapped=t.mapped or t.name in read) for t in facts.log.topics]
        latency = [] if plan.latency is not None else ["no gyro to measure the truth's latency with: taken as 0"]
        facts = replace(
            facts,
            log=replace(facts.log, topics=topics),
            truth=replace(facts.truth, notes=[*latency, *facts.truth.notes]),
        )
        report = build_report(facts)
        folder = None
        if output is not None:
            make_folder(output)
            folder = output / "logs" / stem
            _write(folder, report, rows, [truth_track, *(r.track for r in recorded)], plan)
        lost = tuple(f"{x.what} ({x.where})" for x in all_losses if x.severity == "lost")
        outcome = LogOutcome(log=stem, file=self.log_input.path.name, sha256=sha256, lost=lost)
        progress(stem, 1.0)
        return LogResult(outcome, folder, report, tuple(rows))

    def _read_estimates(self, start_ns: int, end_ns: int) -> tuple[list[RecordedEstimate], list[Loss]]:
        losses: list[Loss] = []
        recorded = []
        for estimate in self.estimates:
            found, lost = read_estimate(self.log, estimate, start_ns, end_ns, self.config.window_s)
            for note in found.notes:
                self.tell(f"{estimate.name}: {note}")
            recorded.append(found)
            losses += lost
        return recorded, losses

    def _read_sensors(self, plan: DrivePlan) -> tuple[Signals | None, tuple[Loss, ...], dict[str, int]]:
        if not plan.alignment.channels:
            self.tell("no IMU in the mapping: segments come from the truth alone")
            return None, (), {}
        sensors_alone = replace(plan, truth=None, mapping=replace(plan.mapping, truth={}, quality=None))
        reader = DriveReader(self.log, sensors_alone, self.config.window_s)
        seen = [w.signals for w in reader.windows() if len(w.signals)]
        return (join_signals(seen) if seen else None), reader.losses, reader.samples or {}

    def _with_dependence(self, plan: DrivePlan, recorded: Sequence[RecordedEstimate]) -> DrivePlan:
        """Add the truth channels that one of the estimates is, as a recorded channel."""
        found = dict(plan.dependent)
        for r in recorded:
            same = dependent_signals(r.channels, plan.survey_truth, role=f"estimate {r.track.name}'s")
            found |= {name: reason for name, reason in same.items() if name not in found}
        return replace(plan, dependent=found)

    def _figures(
        self,
        plan: DrivePlan,
        recorded: Sequence[RecordedEstimate],
        truth: TruthTrack,
        signals: Signals | None,
    ) -> tuple[list[MetricRow], dict[str, str]]:
        """Score each estimate at its own stamps; return what of the derived truth equals an estimate besides."""
        from pdhef_logtool.evaluation.metrics import SCORED_SIGNALS, score_track
        from pdhef_logtool.evaluation.segments import segment_masks

        rows: list[MetricRow] = []
        dependent: dict[str, str] = {}
        for r in recorded:
            at_stamps = truth_at(truth, r.track.stamps_ns, plan.truth_latency_s)
            masks = segment_masks(signals_at(signals, r.track.stamps_ns), at_stamps, self.vehicle)
            same = {
                name: f"the truth's {name} equals that of the estimate {r.track.name}"
                for name in SCORED_SIGNALS
                if _same_column(getattr(r.track, name), getattr(at_stamps, name))
            }
            dependent |= same
            figures = score_track(
                r.track,
                at_stamps,
                masks,
                log=self.log_input.stem,
                low_speed_m_s=self.vehicle.low_speed_blend_m_s,
                not_independent={**plan.dependent, **same},
            )
            if not any(row.metric == "rmse" for row in figures):
                self.tell(f"{r.track.name}: nowhere are estimate and truth known together, so there are no errors")
            rows += [row for row in figures if row.metric != "diverged" or r.tells_divergence]
        return rows, dependent

    def _events(self, truth: StateTrack, signals: Signals, recorded: Sequence[RecordedEstimate]) -> list[Event]:
        from pdhef_logtool.evaluation.segments import find_intervals, segment_masks

        masks = without_whole(segment_masks(signals, truth, self.vehicle))
        events = [Event(s.name, s.start_ns, s.end_ns, "") for s in find_intervals(truth.stamps_ns, masks)]
        for r in recorded:
            events += [
                Event(f"{r.track.name} diverged", s.start_ns, s.end_ns, "the estimator reports its own divergence")
                for s in find_intervals(r.track.stamps_ns, {"diverged": r.track.diverged})
            ]
        return sorted(events, key=lambda e: (e.start_ns, e.end_ns, e.name))


def _same_column(estimate: FloatArray, truth: FloatArray) -> bool:
    known = np.isfinite(estimate) & np.isfinite(truth)
    return int(np.count_nonzero(known)) >= 10 and share_equal(estimate[known], truth[known]) >= SAME_SHARE


def _write(
    folder: Path, report: dict[str, Any], rows: Sequence[MetricRow], tracks: Sequence[StateTrack], plan: DrivePlan
) -> None:
    from pdhef_logtool.sinks.parquet import EstimatesSink, write_metrics

    start = first_pose(tracks[0])
    sink = EstimatesSink(folder / "estimates.parquet")
    try:
        for track in tracks:
            has_pose = track.name == TRUTH and plan.has_truth_pose
            sink.append(track if has_pose else DeadReckoning().add(track, start))
        sink.finish(report)
    except BaseException:
        sink.abort()
        raise
    write_metrics(folder / "metrics.parquet", rows)
    write_json(folder / "report.json", report)


# ---- which fields ----


def choose_estimates(
    log: DriveLog, flags: Sequence[str], tables: Mapping[str, Mapping[str, SignalSource]], name: str | None
) -> tuple[EstimateSource, ...]:
    """Return the estimates to score: those of the flags, else of the mapping file's tables.

    Raises
    ------
    UsageError
        There is none, or none called ``name``, or the flags contradict one another.
    MappingError
        The log has no such topic.
    """
    if name is not None and (not name or name in RESERVED_NAMES):
        raise UsageError(expected="a name of an estimator", got=repr(name), where="--name")
    if flags:
        signals, covariance = sources_of(log, flags, ESTIMATE_UNITS, "--estimate")
        if not set(signals) & set(BASE_ORDER):
            raise UsageError(expected=f"one of {', '.join(BASE_ORDER)}", got=", ".join(signals), where="--estimate")
        base = next(signals[s] for s in BASE_ORDER if s in signals)
        if covariance is not None and (base.topic != covariance.topic or set(_STDS) & set(signals)):
            covariance = None  # it belongs to other stamps, or named deviations win over it
        return (EstimateSource(name or _name_of(base.topic), signals, covariance),)
    chosen = {n: dict(t) for n, t in tables.items() if name is None or n == name}
    if not chosen:
        got = "none" if name is None else f"none called {name!r}" + (f" but {', '.join(tables)}" if tables else "")
        raise UsageError(
            expected="an estimate to score",
            got=got,
            where="pdhef metrics",
            remedy="give --estimate [SIGNAL=]TOPIC.FIELD, or [estimates.NAME.SIGNAL] tables in a mapping file",
        )
    for n, signals in chosen.items():
        if not set(signals) & set(BASE_ORDER):
            raise UsageError(
                expected=f"one of {', '.join(BASE_ORDER)}", got=", ".join(signals) or "none", where=f"estimates.{n}"
            )
    return tuple(EstimateSource(n, signals) for n, signals in chosen.items())


def _name_of(topic: str) -> str:
    words = [w for w in re.split(r"[^A-Za-z0-9]+", topic) if w]
    if words[:1] == ["pdhef"] and len(words) > 2:
        words = words[1:-1]  # our own /pdhef/<estimator>/state
        return "-".join(words)
    name = "_".join(words) or "estimate"
    return f"{name}_" if name in RESERVED_NAMES else name


def sources_of(
    log: DriveLog, texts: Sequence[str], units: Mapping[str, str], option: str
) -> tuple[dict[str, SignalSource], CovarianceSource | None]:
    """Turn ``[SIGNAL=]TOPIC[.FIELD]`` texts into sources by name, and the covariance of a topic named as a whole.

    Raises
    ------
    UsageError
        The signal is not known or cannot be told from the topic's type, or one is named twice.
    MappingError
        The log has no such topic.
    """
    sources: dict[str, SignalSource] = {}
    covariances: list[CovarianceSource] = []
    for text in texts:
        signal, rest = _split_signal(text, units, option)
        topic, path = _split_topic(log, rest, option)
        if signal is not None:
            if not path:
                raise UsageError(expected=f"{signal}={topic.name}.FIELD", got=text, where=option)
            found = {signal: path}
        else:
            found, covariance = _recognise(topic, path, units, text, option)
            covariances += covariance
        for name, field_path in found.items():
            if name in sources:
                raise UsageError(
                    expected="each signal once",
                    got=f"{name} from {sources[name].label} and from {topic.name}.{field_path}",
                    where=option,
                    remedy="several estimators stand in a mapping file, one [estimates.NAME.SIGNAL] table a signal",
                )
            sources[name] = SignalSource(name=name, topic=topic.name, field=field_path)
    return sources, covariances[0] if len(covariances) == 1 else None


def _split_signal(text: str, units: Mapping[str, str], option: str) -> tuple[str | None, str]:
    head, equals, rest = text.partition("=")
    if not equals or not re.fullmatch(r"\s*\w*\s*", head):
        return None, text.strip()
    signal = head.strip()
    if signal not in units:
        close = get_close_matches(signal, list(units), n=1, cutoff=0.5)
        raise UsageError(
            expected=f"SIGNAL out of {', '.join(units)}",
            got=repr(signal),
            where=f"{option} {text}",
            remedy=f"did you mean {close[0]}?" if close else "",
        )
    return signal, rest.strip()


def _split_topic(log: DriveLog, text: str, option: str) -> tuple[TopicInfo, str]:
    """Split TOPIC.FIELD at the longest topic of the log that fits: outside of ROS 2, topics may hold dots."""
    fitting = [t for t in log.topics if text == t.name or text.startswith(f"{t.name}.")]
    if fitting:
        topic = max(fitting, key=lambda t: len(t.name))
        return topic, text[len(topic.name) + 1 :]
    names = [t.name for t in log.topics]
    close = get_close_matches(text, names, n=1, cutoff=0.5) or get_close_matches(text.split(".")[0], names, n=1)
    raise MappingError(
        expected="TOPIC.FIELD with a topic of this log",
        got=text,
        where=f"{log.path} {option}",
        remedy=f"did you mean {close[0]}?" if close else "pdhef inspect lists the topics",
    )


def _recognise(
    topic: TopicInfo, path: str, units: Mapping[str, str], text: str, option: str
) -> tuple[dict[str, str], list[CovarianceSource]]:
    """Return the fields by signal that a topic's type tells, all of them or the one that was named."""
    kind = topic.type_name.replace("/msg/", "/")
    known: dict[str, str] = {}
    covariance: list[CovarianceSource] = []
    if kind == STATE_TYPE:
        known = {name: name for name in _STATE_FIELDS}
        covariance = [CovarianceSource(topic.name, "covariance", 3, (0, 1, 2))]
    elif kind in TWIST_FIELDS:
        base = TWIST_FIELDS[kind]
        known = {name: f"{base}.{below}" if base else below for name, below in _TWIST.items()}
        if base == "twist.twist":
            covariance = [CovarianceSource(topic.name, "twist.covariance", 6, (0, 1, 5))]
    found = {name: field_path for name, field_path in known.items() if name in units and path in ("", field_path)}
    if not found:
        raise UsageError(
            expected="SIGNAL=TOPIC.FIELD, as the type does not tell which signal this is",
            got=f"{text} ({topic.type_name or 'no type'})",
            where=option,
            remedy=f"SIGNAL is one of {', '.join(units)}",
        )
    return found, covariance if path == "" else []


# ---- reading ----


def read_estimate(
    log: DriveLog, source: EstimateSource, start_ns: int, end_ns: int, window_s: float
) -> tuple[RecordedEstimate, list[Loss]]:
    """Read one recorded estimate with log time in [start, end) onto the stamps of its first quantity of BASE_ORDER.

    NaN stays: where an estimator says nothing it is not available, which is a figure and no loss.

    Raises
    ------
    MappingError
        The slice holds no message of it, or not one number.
    """
    mapping = resolve_mapping(log, source.as_mapping())
    clocks = fit_clocks(log, mapping, start_ns, end_ns)
    requests: dict[str, list[str]] = {}
    for s in mapping.signals.values():
        paths = requests.setdefault(s.topic, [])
        paths += [p for p in (*stamp_request(log, s), *s.paths) if p not in paths]
    if source.covariance is not None:
        requests[source.covariance.topic].append(source.covariance.field)
    parts: dict[str, list[tuple[IntArray, IntArray, FloatArray]]] = {name: [] for name in mapping.signals}
    matrices: list[FloatArray] = []
    losses: list[Loss] = []
    base = next(name for name in BASE_ORDER if name in mapping.signals)
    for a, b in windows(start_ns, end_ns, round(window_s * 1e9)):
        columns = log.read(requests, a, b)
        for name, s in mapping.signals.items():
            topic = columns.get(s.topic)
            if topic is None or len(topic) == 0:
                continue
            raw, usable = raw_stamps(log, topic, s)
            stamps = apply_clock(raw, clocks[clock_key(s)]) - np.int64(round(s.latency_s * 1e9))
            values = _in_range(si_values(topic, s), s)
            parts[name].append((stamps[usable], topic.log_time_ns[usable], values[usable]))
            if name == base:
                losses += _stamp_losses(topic, usable, s)
                if source.covariance is not None:
                    matrices.append(_planar_covariance(topic, source.covariance)[usable])
    channels, kept = {}, {}
    for name, s in mapping.signals.items():
        channels[name], kept[name] = _ordered(name, s, parts[name])
    stamps_ns = channels[base].stamps_ns
    if not any(np.isfinite(channels[name].values).any() for name in BASE_ORDER if name in channels):
        wanted = ", ".join(s.label for n, s in mapping.signals.items() if n in BASE_ORDER)
        raise MappingError(
            expected="numbers in the recorded estimate",
            got="none in the chosen slice",
            where=f"{log.path} {wanted}",
            remedy="check topic, field and slice",
        )
    repeated = sum(p[0].shape[0] for p in parts[base]) - len(channels[base])
    if repeated:
        where = mapping.signals[base].topic
        losses.append(Loss("duplicate-stamp", LOSS_TEXTS["duplicate-stamp"], where, count=repeated, severity="note"))
    covariance = np.concatenate(matrices)[kept[base]] if matrices else None
    track, notes = _track(source.name, stamps_ns, channels, covariance)
    finite = {n: without_nan(c) for n, c in channels.items() if n in BASE_ORDER}
    samples = {s.label: len(channels[n]) for n, s in mapping.signals.items()}
    return RecordedEstimate(track, finite, "diverged" in channels, samples, notes), losses


def without_nan(channel: Channel) -> Channel:
    """Return the channel without the samples that are not numbers."""
    known = np.isfinite(channel.values)
    return replace(
        channel,
        stamps_ns=channel.stamps_ns[known],
        arrival_ns=channel.arrival_ns[known],
        values=channel.values[known],
    )


def _in_range(values: FloatArray, source: SignalSource) -> FloatArray:
    with np.errstate(invalid="ignore"):
        outside = np.zeros(values.shape[0], dtype=np.bool_)
        if source.valid_min is not None:
            outside |= values < source.valid_min
        if source.valid_max is not None:
            outside |= values > source.valid_max
    return np.where(outside | ~np.isfinite(values), np.nan, values)


def _stamp_losses(topic: Columns, usable: BoolArray, source: SignalSource) -> list[Loss]:
    bad = topic.log_time_ns[~usable]
    if not bad.shape[0]:
        return []
    span = (int(bad.min()), int(bad.max()) + 1)
    return [Loss("bad-stamp", LOSS_TEXTS["bad-stamp"], source.topic, *span, int(bad.shape[0]))]


def _ordered(
    name: str, source: SignalSource, parts: Sequence[tuple[IntArray, IntArray, FloatArray]]
) -> tuple[Channel, IntArray]:
    """Return the samples in order of unique stamps, the first arrival of each kept, and their places in the parts."""
    empty = np.empty(0, dtype=np.int64)
    stamps, arrival = (np.concatenate([p[i] for p in parts]) if parts else empty for i in (0, 1))
    values = np.concatenate([p[2] for p in parts]) if parts else np.empty(0)
    order = np.lexsort((arrival, stamps))
    ordered = stamps[order]
    first = np.concatenate([[True], ordered[1:] > ordered[:-1]]) if len(ordered) else np.empty(0, dtype=np.bool_)
    kept = order[first]
    return Channel(name, ESTIMATE_UNITS[name], source.label, stamps[kept], arrival[kept], values[kept]), kept


def _planar_covariance(topic: Columns, source: CovarianceSource) -> FloatArray:
    """Return [N, 3, 3] over v_x, v_y, yaw rate; NaN where it is unknown (all zero, or −1 first, as ROS says)."""
    raw = np.asarray(topic.fields[source.field], dtype=np.float64)
    n = raw.shape[0]
    if raw.ndim != 2 or raw.shape[1] != source.size**2:
        return np.full((n, 3, 3), np.nan)
    places = np.array(source.planar)
    planar = raw.reshape(n, source.size, source.size)[:, places[:, None], places]
    unknown = (planar == 0.0).all(axis=(1, 2)) | (raw[:, 0] < 0.0)
    return np.where(unknown[:, None, None], np.nan, planar)


def _track(
    name: str, stamps_ns: IntArray, channels: Mapping[str, Channel], covariance: FloatArray | None
) -> tuple[StateTrack, tuple[str, ...]]:
    notes: list[str] = []
    columns: dict[str, FloatArray] = {}
    for quantity, channel in channels.items():
        same = np.array_equal(channel.stamps_ns, stamps_ns)
        columns[quantity] = channel.values if same else _interpolated(channel, stamps_ns)
        if not same and quantity in BASE_ORDER:
            notes.append(f"{quantity} has other stamps than the estimate and is interpolated to them")
    if "sideslip_rad" in columns:
        columns["sideslip_rad"] = np.arctan2(np.sin(columns["sideslip_rad"]), np.cos(columns["sideslip_rad"]))
        if "vx_m_s" in columns and "vy_m_s" not in columns:
            columns["vy_m_s"] = columns["vx_m_s"] * np.tan(columns["sideslip_rad"])
            notes.append("v_y is v_x times tan of the sideslip")
    if covariance is None or not np.isfinite(covariance).any():
        covariance = _diagonal([columns.get(s, np.full(stamps_ns.shape[0], np.nan)) for s in _STDS])
    flags = {flag: columns[flag] >= 0.5 for flag in ("valid", "diverged") if flag in columns}
    if covariance.shape[0] and "sideslip_std_rad" not in columns and {"vx_m_s", "vy_m_s"} <= columns.keys():
        # Where only deviations are known the correlation of the two velocities counts as 0.
        completed = np.where(np.eye(3, dtype=np.bool_), covariance, np.nan_to_num(covariance, nan=0.0))
        columns["sideslip_std_rad"] = sideslip_std(columns["vx_m_s"], columns["vy_m_s"], completed)
    state = {n: c for n, c in columns.items() if n not in (*_STDS, "valid", "diverged")}
    return make_track(name, stamps_ns, covariance=covariance, **state, **flags), tuple(notes)


def _diagonal(stds: Sequence[FloatArray]) -> FloatArray:
    std = np.stack(stds, axis=1)
    if not np.isfinite(std).any():
        return np.empty((0, 3, 3))
    covariance = np.full((std.shape[0], 3, 3), np.nan)
    for i in range(3):
        covariance[:, i, i] = std[:, i] ** 2
    return covariance


def _interpolated(channel: Channel, stamps_ns: IntArray) -> FloatArray:
    known = without_nan(channel)
    bracket = Bracket(known.stamps_ns, stamps_ns, _gap_ns(known.stamps_ns))
    return bracket.angle(known.values) if channel.name == "sideslip_rad" else bracket.linear(known.values)


def _gap_ns(stamps_ns: IntArray) -> int:
    return round(GAP_PERIODS * float(np.median(np.diff(stamps_ns)))) if stamps_ns.shape[0] > 1 else 0


def read_truth(log: DriveLog, plan: DrivePlan, window_s: float) -> tuple[TruthTrack, tuple[Loss, ...], dict[str, int]]:
    """Read and derive the whole truth on its own clock, window by window, with losses and samples by source.

    Raises
    ------
    MappingError
        The slice holds no truth.
    """
    alone = replace(plan.mapping, signals={})
    channels: dict[str, Channel] = {}
    tracks: list[StateTrack] = []
    losses: tuple[Loss, ...] = ()
    samples: dict[str, int] = {}
    done_ns: int | None = None
    for a, b in windows(plan.start_ns, plan.end_ns, round(window_s * 1e9)):
        if plan.truth is None:
            break
        part = read_signals(log, alone, plan.clocks, a, b)
        losses = merge_losses([losses, part.losses])
        for name, channel in part.truth.items():
            samples[channel.source] = samples.get(channel.source, 0) + len(channel)
            channels[name] = join_channels([channels[name], channel]) if name in channels else channel
        stamps = [c.stamps_ns for c in channels.values() if len(c)]
        if not stamps:
            continue
        newest = max(int(s[-1]) for s in stamps) + 1
        until = newest if b >= plan.end_ns else min(newest, b) - plan.truth.margin_ns
        if done_ns is not None and until <= done_ns:
            continue
        derived = derive_truth(channels, plan=plan.truth)
        tracks.append(_rows(derived.track, done_ns, until))
        done_ns = until
        channels = {n: _since(c, until - plan.truth.margin_ns) for n, c in channels.items()}
    if plan.truth is None or not sum(len(t) for t in tracks):
        raise MappingError(
            expected="truth in the chosen slice",
            got="no samples that can be used",
            where=f"{log.path} {', '.join(s.label for s in plan.mapping.truth.values())}",
            remedy="pdhef inspect LOG shows what the log holds and what was dropped",
        )
    gap_s = plan.truth.max_gap_s[plan.truth.base]
    return TruthTrack(concatenate(tracks), gap_s, plan.derivation), losses, samples


def _rows(track: StateTrack, start_ns: int | None, end_ns: int) -> StateTrack:
    lo = 0 if start_ns is None else int(np.searchsorted(track.stamps_ns, start_ns))
    part = slice(lo, int(np.searchsorted(track.stamps_ns, end_ns)))
    columns = {n: getattr(track, n)[part] for n in _TRUTH_COLUMNS}
    return make_track(track.name, track.stamps_ns[part], **columns)


_TRUTH_COLUMNS = (
    "vx_m_s",
    "vy_m_s",
    "yaw_rate_rad_s",
    "sideslip_rad",
    "ay_m_s2",
    "x_m",
    "y_m",
    "yaw_rad",
)


def _since(channel: Channel, stamp_ns: int) -> Channel:
    first = int(np.searchsorted(channel.stamps_ns, stamp_ns))
    return replace(
        channel,
        stamps_ns=channel.stamps_ns[first:],
        arrival_ns=channel.arrival_ns[first:],
        values=channel.values[first:],
    )


def signals_at(signals: Signals | None, stamps_ns: IntArray) -> Signals:
    """Return the sensors at other stamps [N], interpolated between samples, never across gaps; all NaN without any."""
    n = stamps_ns.shape[0]

    def column(name: str) -> FloatArray:
        if signals is None:
            return np.full(n, np.nan)
        values: FloatArray = getattr(signals, name)
        known = np.isfinite(values)
        at = signals.stamps_ns[known]
        return Bracket(at, stamps_ns, _gap_ns(at)).linear(values[known])

    names = ("steer_rad", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s", "friction")
    return Signals(
        stamps_ns=stamps_ns,
        ready_ns=stamps_ns,
        wheel_speed_m_s=np.full((n, len(WHEELS)), np.nan),
        available=frozenset() if signals is None else signals.available,
        **{name: column(name) for name in names},
    )
