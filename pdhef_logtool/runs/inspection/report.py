"""Inspection of a log: topics, rates, gaps, clocks, mapped and missing signals, implausible values."""

import math
import re
from collections.abc import Callable, Iterable, Mapping as MappingABC, Sequence
from contextlib import closing
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from pdhef_logtool.drive.options import AS_IT_IS, ReadOptions
from pdhef_logtool.drive.survey import Proposal, apply_proposals, mapping_proposals, survey_log
from pdhef_logtool.estimators.presets import preset_of
from pdhef_logtool.estimators.table import all_specs
from pdhef_logtool.logs.columnar_log import ColumnarLog
from pdhef_logtool.logs.constants import WHOLE_BYTES
from pdhef_logtool.logs.drive_log import Columns, DriveLog, TopicInfo
from pdhef_logtool.logs.message_schema import FieldInfo
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.remote_place import LogPlace
from pdhef_logtool.mapping import Ambiguity, Mapping, QualityGate, SignalSource, auto_map, resolve_mapping
from pdhef_logtool.mapping.candidates import Candidate
from pdhef_logtool.mapping.channels import merge_losses, read_signals
from pdhef_logtool.mapping.choosing import choose_mapping, tables_for
from pdhef_logtool.mapping.clocks import ClockModel, clock_key, fit_clocks, sources_by_clock, survey_windows
from pdhef_logtool.mapping.mapping_file import mapping_of, mapping_to_toml, missing_signals
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.errors import EXIT_OK, EXIT_PARTIAL, OutputError
from pdhef_logtool.records.printable import all_printable
from pdhef_logtool.records.signals import S_PER_NS, SIGNAL_UNITS, TRUTH_UNITS, Channel, FloatArray, IntArray, Loss
from pdhef_logtool.storage.documents import jsonable
from pdhef_logtool.storage.files import write_bytes
from pdhef_logtool.storage.templates import template

#: A gap is more than this many median steps, and more than ``MIN_GAP_S``.
GAP_PERIODS = 5.0
MIN_GAP_S = 0.1
#: If the median step differs from the mean step by more, messages come in bursts.
BURST = 0.75


@dataclass(frozen=True, eq=False)
class Steps:
    """Steps between ascending times.

    Attributes
    ----------
    count : number of times. steps_s : float64 [N]. starts_ns : int64 [N], start of each step.
    """

    count: int
    steps_s: FloatArray
    starts_ns: IntArray

    @classmethod
    def of(cls, parts: Sequence[IntArray]) -> "Steps":
        """Return the steps within each part, int64 [K] ascending; a step from one part to the next is left out."""
        steps = [np.diff(part) * S_PER_NS for part in parts]
        starts = [part[:-1] for part in parts]
        return cls(sum(map(len, parts)), np.concatenate([np.empty(0), *steps]), np.concatenate([_NONE, *starts]))

    @cached_property
    def median_s(self) -> float:
        """Median step; NaN without a step."""
        return float(np.median(self.steps_s)) if self.steps_s.shape[0] else float("nan")

    @property
    def rate_hz(self) -> float:
        """Rate by the median step; for bursts, by the mean of the steps that are no gaps."""
        steps = self.steps_s
        if not steps.shape[0]:
            return float("nan")
        # The step that half of the time is spent in, without the longest 1 %: of bursts, that from one to the next.
        usual = np.sort(steps)[: max(1, len(steps) - max(1, len(steps) // 100))]
        half = usual[np.searchsorted(np.cumsum(usual), 0.5 * usual.sum())]
        limit = max(MIN_GAP_S, GAP_PERIODS * float(half))
        mean, median = float(steps[steps <= limit].mean()), self.median_s
        step = median if BURST * mean <= median <= mean / BURST else mean
        return 1.0 / step if step > 0.0 else float("nan")

    @property
    def jitter_p95_s(self) -> float:
        """95th percentile of |step − median|; NaN without a step."""
        steps = self.steps_s
        return float(np.quantile(np.abs(steps - self.median_s), 0.95)) if steps.shape[0] else float("nan")

    def longest(self, since_ns: int, above_s: float = MIN_GAP_S) -> dict[str, float]:
        """Return the longest step above a limit and its start since a stamp, both in s; NaN without one."""
        i = int(np.argmax(self.steps_s)) if self.steps_s.shape[0] else 0
        gap = math.nan, math.nan
        if (self.steps_s[i : i + 1] > above_s).any():
            gap = float(self.steps_s[i]), (int(self.starts_ns[i]) - since_ns) * S_PER_NS
        return dict(zip(("largest_gap_s", "largest_gap_at_s"), gap, strict=True))


_NONE = np.empty(0, dtype=np.int64)


def number_text(value: float) -> str:
    """Return a number in few digits, a dash without one."""
    if not math.isfinite(value):
        return "-"
    if value == 0.0:
        return "0"
    if 100.0 <= abs(value) < 1e5:
        return f"{value:.0f}"
    return f"{value:.3g}" if 1e-4 <= abs(value) < 1e4 else f"{value:.1e}"


WINDOW_NS = 600_000_000_000
#: Of a log with a sound index and more than ``WHOLE_BYTES``, values are looked at in a part: its first ten minutes, and
#: windows over the rest. Where that is a larger share of the chunks, the rest is read too.
MOST_SAMPLED = 0.75
#: Kinds of loss that are counted by topic and concern all its signals.
TOPIC_DROPS = frozenset({"bad-stamp", "duplicate-stamp"})
#: Topics with more number fields than this are listed in part.
MAX_LISTED_FIELDS = 40
#: Arrays that no signal comes from are in one line.
COVARIANCE = re.compile(r"cov(ariance)?(\[\d*\])?$", re.IGNORECASE)
INDEX = re.compile(r"\[\d+\]$")
#: If the envelope of a device clock leaves the fitted line by more, the clock has stepped or bent.
CLOCK_RESIDUAL_S = 0.02
#: Entries of the JSON in order; those without an attribute of the name are of the mapping.
_IN_DOCUMENT = (
    "path", "kind", "start_ns", "end_ns", "duration_s", "sample", "topics", "clocks", "mapping_origin", "signals",
    "truth", "truth_quality", "missing", "ambiguities", "notes", "checks", "proposals", "lost", "candidates",
    "estimators",
)  # fmt: skip


_TEMPLATES = Path(__file__).parents[1] / "templates"
_FIGURES: dict[str, Any] = {"mean": np.mean, "std": np.std, "minimum": np.min, "maximum": np.max}


@dataclass(frozen=True, slots=True)
class TopicReport:
    """One topic. Times in s; ``largest_gap_at_s`` is since the log's start; NaN if unknown.

    ``rate_hz`` is by the median step, for bursts by the mean; for a topic without read times, by its messages
    and the log's length.
    ``delay_*`` are of log time − publish time, which equals zero where a recorder has one time only.
    """

    name: str
    type: str
    encoding: str
    messages: int
    rate_hz: float
    jitter_p95_s: float
    largest_gap_s: float
    largest_gap_at_s: float
    delay_median_s: float
    delay_p95_s: float
    fields: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class SignalReport:
    """One mapped signal in SI units, cleaned. Statistics of vectors refer to their length.

    ``gaps`` counts steps of more than 5 median steps and 0.1 s; ``dropped`` samples by kind.
    """

    name: str
    unit: str
    topic: str
    field: str
    samples: int
    rate_hz: float
    latency_s: float
    mean: float
    std: float
    minimum: float
    maximum: float
    gaps: int
    largest_gap_s: float
    largest_gap_at_s: float
    dropped: dict[str, int]


@dataclass(frozen=True, slots=True)
class Sample:
    """The part of a log that was read, ``chunks`` of ``of_chunks``.

    ``times``: source of the topics' rates, jitter and gaps: the ``index`` of the log, or the chunks that were read
    (``sample``). Counts always come from the index; delays, signals and ground truth from the chunks.
    """

    chunks: int
    of_chunks: int
    times: Literal["index", "sample"]


@dataclass(frozen=True, slots=True)
class Inspection:
    """All that :func:`inspect_log` found.

    Attributes
    ----------
    kind : of log. start_ns, end_ns : log time, [start, end). clocks : stamps of mapped signals against log time.
    signals, truth : reports by name. missing : signals that an estimator uses and no topic provides.
    ambiguities, notes : of the mapping. candidates : fields that were weighed for it.
    checks : of signals and ground truth by physics. proposals : certain corrections of the mapping.
    lost : every loss and note of reading. sample : the part that was read; None: all.
    refused : by channel the reason why a run does not use it. estimators : that can run with the other channels.
    """

    path: str
    kind: str
    start_ns: int
    end_ns: int
    topics: tuple[TopicReport, ...]
    clocks: tuple[dict[str, Any], ...]
    mapping: Mapping
    signals: dict[str, SignalReport]
    truth: dict[str, SignalReport]
    missing: tuple[str, ...]
    ambiguities: tuple[Ambiguity, ...]
    notes: tuple[str, ...]
    checks: tuple[Check, ...]
    proposals: tuple[Proposal, ...]
    lost: tuple[Loss, ...]
    candidates: tuple[Candidate, ...] = ()
    sample: Sample | None = None
    refused: MappingABC[str, str] = field(default_factory=dict)

    @property
    def estimators(self) -> tuple[str, ...]:
        """Estimators that can run with these signals, without a network or noise parameters of the car."""
        used = replace(self.mapping, signals={n: s for n, s in self.mapping.signals.items() if n not in self.refused})
        have = frozenset(used.signals) | set(missing_signals(Mapping())).difference(missing_signals(used))
        able = (s for s in all_specs() if not (s.lacking(have) or s.network or s.needs_noise))
        return tuple(dict.fromkeys(preset_of(spec.name) for spec in able))

    @property
    def duration_s(self) -> float:
        """Length of the log."""
        return (self.end_ns - self.start_ns) * S_PER_NS

    @property
    def exit_code(self) -> int:
        """3 if data that the log should have held is gone, else 0."""
        return EXIT_PARTIAL if any(loss.severity == "lost" for loss in self.lost) else EXIT_OK

    def to_dict(self) -> dict[str, Any]:
        """Return the document of ``pdhef inspect --json``; NaN and infinities become None."""
        document = {
            **{name: getattr(self, name, None) for name in _IN_DOCUMENT},
            "mapping_origin": self.mapping.origin,
            "truth_quality": None if self.mapping.quality is None else self.mapping.quality.describe(),
            "proposals": [{"subject": p.subject, "evidence": p.evidence} for p in self.proposals],
        }
        return {key: jsonable(value) for key, value in document.items()}


def inspect_log(
    path: LogPlace | str,
    mapping: Mapping | Path | str | None = None,
    options: ReadOptions = AS_IT_IS,
    *,
    whole: bool = False,
    then: Callable[[Inspection, DriveLog], None] = lambda *_: None,
) -> Inspection:
    """Look a log through and report on it; without a mapping (or its file) the well-known types are recognised.

    Of an MCAP above 32 MB with a consistent index, only a part of the chunks is read (``sample``), unless ``whole`` is
    given, the part is damaged, or it is most of the log.

    Parameters
    ----------
    options : as for :func:`~pdhef_logtool.drive.reading.read_drive`; the whole log is read.
    then : called with the inspection before the log is closed.

    Raises
    ------
    LogError : The file is no log.
    MappingError : The mapping names a topic or field that the log does not contain.
    """
    mapping = mapping_of(mapping)
    with closing(open_log(path, options.limits, options.msgs, tables_for(mapping, options.tables))) as log:
        source = log.messages
        index = None
        if source is not None and source.size > WHOLE_BYTES and source.is_indexed and not whole:
            # Most of a shorter one is read anyway.
            index = source if source.is_remote or log.end_ns - log.start_ns > 2 * WINDOW_NS else None
        if index is None and source is not None:
            source.prefetch({topic.name for topic in log.topics}, [(log.start_ns, log.end_ns)])
        inspection = inspect_drive_log(log, mapping, prefer_truth=options.prefer_truth, index=index)
        sample, damaged = inspection.sample, any(loss.severity == "lost" for loss in log.lost)
        if sample is None or not (damaged or sample.chunks > MOST_SAMPLED * sample.of_chunks):
            then(inspection, log)
            return inspection
    return inspect_log(path, mapping, options, whole=True, then=then)


def inspect_drive_log(
    log: DriveLog,
    given: Mapping | None = None,
    *,
    prefer_truth: Literal["perfect", "rtk"] = "perfect",
    index: ColumnarLog | None = None,
) -> Inspection:
    """Inspect an open log as :func:`inspect_log` does; with its ``index`` a sample of it is read."""
    if given is None:
        chosen = auto_map(log, prefer_truth=prefer_truth)
    else:
        chosen = choose_mapping(log, given, prefer_truth=prefer_truth, require_signals=False)
    mapping = resolve_mapping(log, chosen.mapping)
    head = (log.start_ns, min(log.end_ns, log.start_ns + WINDOW_NS))
    windows, timed = [(log.start_ns, log.end_ns)], tuple(t.name for t in log.topics)
    if index is not None:
        # The windows of the clock fits, evenly over the log.
        mapped = {source.topic for source in mapping.sources()}
        windows = [*survey_windows(log.start_ns, log.end_ns)] if log.end_ns > head[1] else [head]
        index.prefetch(mapped, [head, *windows])
        timed = tuple(sorted(index.covered_topics(mapped)))
    clocks = fit_clocks(log, mapping, log.start_ns, log.end_ns)
    looked_at = survey_log(log, mapping, clocks, head)
    mapping = looked_at.mapping
    parts = [read_signals(log, mapping, clocks, start, end, stamps=timed) for start, end in windows]
    losses = merge_losses(part.losses for part in parts)
    signals, truth = (
        {n: _signal_report(s, section, [getattr(part, section)[n] for part in parts], clocks[clock_key(s)], losses, log,
                           mapping.quality)
         for n, s in getattr(mapping, section).items()}
        for section in ("signals", "truth")
    )  # fmt: skip
    return Inspection(
        path=str(log.path),
        kind=log.kind,
        start_ns=log.start_ns,
        end_ns=log.end_ns,
        topics=_topic_reports(log, index, {topic: [part.stamps[topic] for part in parts] for topic in timed}),
        clocks=tuple(_clock_report(s, clocks[key]) for key, s in sources_by_clock(mapping).items()),
        mapping=mapping,
        signals=signals,
        truth=truth,
        missing=missing_signals(mapping),
        ambiguities=chosen.ambiguities,
        notes=(*mapping.notes, *_clock_notes(mapping, clocks)),
        checks=looked_at.checks,
        proposals=mapping_proposals(looked_at),
        # Last, since a log has all its losses only after it was read through.
        lost=merge_losses([log.lost, losses]),
        candidates=chosen.candidates,
        sample=None if index is None else Sample(*index.chunks_read, "sample" if index.is_remote else "index"),
        refused=looked_at.refused(),
    )


# ------------------------------------------------------------------------------------------------ reports


def collapsed(fields: Sequence[FieldInfo]) -> list[tuple[str, str, list[str]]]:
    """Return name, type and paths of each line; a covariance is one line with all its elements."""
    lines: dict[str, tuple[str, list[str]]] = {}
    for info in fields:
        if info.kind not in ("number", "bool"):
            continue
        name = INDEX.sub("[]", info.path) if COVARIANCE.search(info.path) else info.path
        kind = np.dtype(info.code).name if info.code and info.kind == "number" else info.kind
        lines.setdefault(name, (kind, []))[1].append(info.path)
    return [(name, kind, paths) for name, (kind, paths) in lines.items()]


def _topic_reports(
    log: DriveLog, index: ColumnarLog | None, stamps: MappingABC[str, Sequence[Columns]]
) -> tuple[TopicReport, ...]:
    """Return the reports of all topics; times come from a local ``index``, else from the ``stamps`` that were read."""
    times = {topic: [c.log_time_ns for c in columns] for topic, columns in stamps.items()}
    if index is not None and not index.is_remote:
        times |= {topic: [whole] for topic, whole in index.index_times(log.start_ns, log.end_ns).items()}
    return tuple(_topic_report(t, Steps.of(times.get(t.name, ())), stamps.get(t.name, ()), log) for t in log.topics)


def _topic_report(topic: TopicInfo, steps: Steps, stamps: Sequence[Columns], log: DriveLog) -> TopicReport:
    log_s = (log.end_ns - log.start_ns) * S_PER_NS
    numbers = tuple(name for name, _, _ in collapsed(log.fields(topic.name)))
    delays = np.concatenate([np.empty(0), *((c.log_time_ns - c.publish_time_ns) * S_PER_NS for c in stamps)])
    median, late = np.quantile(delays, [0.5, 0.95]).tolist() if delays.size else (math.nan, math.nan)
    return TopicReport(
        name=topic.name,
        type=topic.type_name,
        encoding=topic.encoding,
        messages=topic.messages,
        rate_hz=steps.rate_hz if steps.count else topic.messages / log_s if log_s > 0.0 else math.nan,
        jitter_p95_s=steps.jitter_p95_s,
        **steps.longest(log.start_ns),
        delay_median_s=median,
        delay_p95_s=late,
        fields=numbers[:MAX_LISTED_FIELDS],
    )


def _signal_report(
    source: SignalSource,
    section: str,
    channels: Sequence[Channel],
    clock: ClockModel,
    losses: Iterable[Loss],
    log: DriveLog,
    quality: QualityGate | None,
) -> SignalReport:
    steps = Steps.of([c.stamps_ns for c in channels])
    gap_s = max(MIN_GAP_S, GAP_PERIODS * steps.median_s)
    lengths = (c.values if c.values.ndim == 1 else np.linalg.norm(c.values, axis=1) for c in channels)
    values = np.concatenate([np.empty(0), *lengths])
    places = {f"{source.name} ({source.label})"}
    if section == "truth" and quality is not None:
        places.add(f"{source.name} ({quality.describe()})")
    dropped = {x.kind: x.count or 0 for x in losses if x.where in places}
    # Messages that were sorted back are used.
    dropped |= {x.kind: x.count or 0 for x in losses if x.where == source.read_topic and x.kind in TOPIC_DROPS}
    with np.errstate(over="ignore", invalid="ignore"):  # values that are no measurements
        figures = {name: float(f(values)) if values.size else math.nan for name, f in _FIGURES.items()}
    return SignalReport(
        name=source.name,
        unit=(SIGNAL_UNITS if section == "signals" else TRUTH_UNITS)[source.name],
        topic=source.topic,
        field=source.field if isinstance(source.field, str) else ", ".join(source.field),
        samples=steps.count,
        rate_hz=steps.rate_hz,
        latency_s=clock.median_delay_s + source.latency_s,
        **figures,
        gaps=int(np.count_nonzero(steps.steps_s > gap_s)),
        **steps.longest(log.start_ns, gap_s),
        dropped=dropped,
    )


def _clock_report(source: SignalSource, clock: ClockModel) -> dict[str, Any]:
    return {
        "topic": source.topic,
        "stamp": "log_time" if clock.unusable else source.stamp,
        "clock": source.clock,
        "delay_median_s": clock.median_delay_s,
        "delay_p95_s": clock.p95_delay_s,
        "drift_ppm": clock.drift * 1e6,
        "residual_s": clock.residual_s,
        "delay_known": clock.delay_known,
    }


def _clock_notes(mapping: Mapping, clocks: dict[str, ClockModel]) -> list[str]:
    text = "the clock of {} leaves its fitted line by {:.0f} ms: it stepped, or its drift changed"
    devices = (key for key, source in sources_by_clock(mapping).items() if source.clock == "device")
    return [text.format(k, r * 1e3) for k in devices if (r := clocks[k].residual_s) > CLOCK_RESIDUAL_S]


def findings_of(inspection: Inspection) -> list[list[str]]:
    """Return lines of findings: a heading, its style and the text."""
    text = template(_TEMPLATES / "findings.txt").render(i=all_printable(inspection))
    return [line.split("\t") for line in text.splitlines()]


# ------------------------------------------------------------------------------------------------ mapping


def mapping_comments(inspection: Inspection) -> dict[str, str]:
    """Return comments for :func:`pdhef_logtool.mapping.mapping_to_toml` that help to edit the mapping."""
    words: Any = template(_TEMPLATES / "mapping_comments.txt", number=number_text).module
    types, mapped = {t.name: t.type for t in inspection.topics}, set(inspection.mapping.topics)
    unmapped = [t for t in inspection.topics if t.name not in mapped and t.fields and t.messages]
    comments = {"": words.head(inspection, Path(inspection.path).name, unmapped)}
    bad, done = [c for c in inspection.checks if c.verdict != "passed"], {p.subject for p in inspection.proposals}
    for section, reports in (("signals", inspection.signals), ("truth", inspection.truth)):
        for name, report in reports.items():
            subject = name if section == "signals" else f"truth.{name}"
            of = [c for c in bad if subject not in done and subject in (c.subject, c.name.removesuffix(".candidate"))]
            comments[f"{section}.{name}"] = words.signal(report, types.get(report.topic), of)
    return {key: text.strip() for key, text in comments.items()}


def mapping_text(inspection: Inspection) -> str:
    """Return the inspection's mapping, with the corrections that it proposes, as TOML that is ready to edit."""
    mapping = apply_proposals(inspection.proposals, inspection.mapping)
    return mapping_to_toml(mapping, comments=mapping_comments(inspection), alternatives=inspection.candidates)


def write_mapping(inspection: Inspection, path: Path) -> None:
    """Write :func:`mapping_text` to a new file.

    Raises
    ------
    OutputError : The file exists already (somebody may have edited it) or cannot be written.
    """
    if path.exists():
        raise OutputError(
            expected="a new file", got="one that exists", where=str(path), remedy="give another name or remove it"
        )
    write_bytes(path, mapping_text(inspection).encode())
