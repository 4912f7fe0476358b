"""Convert stamps to the log's clock: offset and drift of device clocks, and plausibility of the transport delay."""

from collections.abc import Iterable, Mapping as Mapped, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.drive_log import Columns, DriveLog, windows
from pdhef_logtool.logs.recording_span import STEP_BACK_NS, steps_back
from pdhef_logtool.logs.table_clocks import NO_TIME, TIME_UNITS_NS, scaled
from pdhef_logtool.mapping.can_frames import with_can_signals
from pdhef_logtool.mapping.checking import resolve_mapping, split_stamp
from pdhef_logtool.mapping.records import RECORDER_STAMPS, Mapping, SignalSource
from pdhef_logtool.records.errors import MappingError
from pdhef_logtool.records.signals import NS_PER_S, S_PER_NS, IntArray

#: A longer median delay is not a transport delay: the two clocks differ.
MAX_CREDIBLE_DELAY_NS = NS_PER_S

#: Logs up to this length are surveyed as a whole, longer ones in evenly spread windows.
SURVEY_WHOLE_NS = 600 * NS_PER_S
SURVEY_WINDOWS = 30
SURVEY_WINDOW_NS = 10 * NS_PER_S

#: The lower envelope is this quantile of the delays in each of at most this many bins.
ENVELOPE_BINS = 64
ENVELOPE_QUANTILE = 0.02
MIN_BIN_SAMPLES = 20

#: Longest transport delay: a stamp that differs more from log time than the other stamps is invalid.
OUTLIER_STAMP_NS = 60 * NS_PER_S
#: If at least this share of stamps has the same error, all stamps are replaced by log time.
UNUSABLE_SHARE = 0.1
#: If messages with equal stamps were recorded apart by at least this share of the usual spacing, the clock is too
#: coarse for them; otherwise they came in one packet, or one message was recorded twice.
COARSE_SPACING = 1.0 / 3.0


@dataclass(frozen=True, slots=True)
class ClockModel:
    """Relation between the stamps of one topic and the log's clock.

    ``log = reference_log_ns + (stamp - reference_stamp_ns) * (1 + drift)``; the identity for ``utc`` stamps. The
    offset of a device clock includes the smallest transport delay, to be given as ``latency_s``.

    Attributes
    ----------
    delay_known : False where log time − stamp is systematically negative or above 1 s; the stamp then is the arrival.
    median_delay_s, p95_delay_s : of log time − stamp on the log's clock; NaN without samples.
    residual_s : largest deviation of the envelope from the fitted line; large if the clock stepped.
    median_period_s : median step between stamps; NaN with fewer than two.
    samples : number of messages in the survey.
    unusable : why the stamps are replaced by log time; empty if they are usable.
    """

    reference_stamp_ns: int = 0
    reference_log_ns: int = 0
    drift: float = 0.0
    delay_known: bool = True
    median_delay_s: float = float("nan")
    p95_delay_s: float = float("nan")
    residual_s: float = 0.0
    median_period_s: float = float("nan")
    samples: int = 0
    unusable: str = ""


def clock_key(source: SignalSource) -> str:
    """Return the key of a source's clock: its topic and stamp."""
    return f"{source.read_topic}.{source.stamp}"


def sources_by_clock(mapping: Mapping) -> dict[str, SignalSource]:
    """Return the first source of each clock, by :func:`clock_key`."""
    first_sources: dict[str, SignalSource] = {}
    for source in mapping.sources():
        first_sources.setdefault(clock_key(source), source)
    return first_sources


def apply_clock(stamps_ns: IntArray, clock: ClockModel) -> IntArray:
    """Convert device stamps [N] to the log's clock [N]; the identity without offset and drift."""
    since_ns = np.asarray(stamps_ns - np.int64(clock.reference_stamp_ns), dtype=np.int64)
    shifted = np.asarray(since_ns + np.int64(clock.reference_log_ns), dtype=np.int64)
    if clock.drift == 0.0:
        return shifted
    return np.asarray(shifted + np.rint(since_ns * clock.drift).astype(np.int64), dtype=np.int64)


def fit_clock_line(stamps_ns: IntArray, log_time_ns: IntArray) -> tuple[int, int, float, float]:
    """Fit offset and drift of a device clock to the lower envelope of log time − stamp.

    Delays of messages are never negative, so that the fastest messages show the relation of the clocks. A low quantile
    in each bin limits the influence of single early messages. The slope is the median over pairs of bins (Theil–Sen),
    which a bin without a fast message does not distort.

    Parameters
    ----------
    stamps_ns, log_time_ns : int64 [N], N ≥ 1, any order.

    Returns
    -------
    reference stamp in ns, reference log time in ns, drift, and the largest residual of the bins in seconds.
    """
    order = np.lexsort((log_time_ns, stamps_ns))
    stamps, delays = stamps_ns[order], (log_time_ns - stamps_ns)[order]
    reference = int(stamps[0])
    base = int(delays.min())
    bins = min(ENVELOPE_BINS, max(1, stamps.shape[0] // MIN_BIN_SAMPLES))
    at_s, low_s = np.empty(bins), np.empty(bins)
    for i, chunk in enumerate(np.array_split(np.arange(stamps.shape[0]), bins)):
        in_bin = (delays[chunk] - base) * S_PER_NS
        low = np.quantile(in_bin, ENVELOPE_QUANTILE, method="lower")
        low_s[i] = low
        at_s[i] = float((stamps[chunk[np.argmin(np.abs(in_bin - low))]] - reference) * S_PER_NS)
    first, second = np.triu_indices(bins, 1)
    apart = at_s[second] - at_s[first]
    usable = apart > 0.0
    drift = 0.0
    if np.any(usable):
        drift = float(np.median((low_s[second] - low_s[first])[usable] / apart[usable]))
    residual_s = low_s - drift * at_s
    offset_s = float(np.median(residual_s))
    worst_s = float(np.abs(residual_s - offset_s).max())
    return reference, reference + base + round(offset_s * NS_PER_S), drift, worst_s


def fit_clocks(log: DriveLog, mapping: Mapping, start_ns: int, end_ns: int) -> dict[str, ClockModel]:
    """Fit the clock of every mapped topic once, so that all windows of a log use the same clocks.

    Parameters
    ----------
    start_ns, end_ns : the whole span that will be read, [start, end) in log time.

    Returns
    -------
    dict
        by :func:`clock_key`; one entry for each topic and stamp in use.

    Raises
    ------
    MappingError : A device clock has no usable stamp in the span.
    """
    resolved = resolve_mapping(log, mapping)
    log = with_can_signals(log, resolved)
    wanted = sources_by_clock(resolved)
    parts = _survey(log, wanted, survey_windows(start_ns, end_ns))
    # A clock may have stepped between the parts of a survey: read all of its stamps.
    stepped = {key: source for key, source in wanted.items() if _offset_changes(parts[key])}
    if stepped and end_ns - start_ns > SURVEY_WHOLE_NS:
        parts |= _survey(log, stepped, windows(start_ns, end_ns, SURVEY_WHOLE_NS, log.recording_span))
    stamps = {key: _Stamps(*map(np.concatenate, zip(*its, strict=True))) for key, its in parts.items()}
    clocks = {key: _clock_of(source, stamps[key], _why_replaced(source, stamps[key])) for key, source in wanted.items()}
    others = _of_other_clocks(clocks)
    return clocks | {key: _clock_of(wanted[key], stamps[key], why) for key, why in others.items()}


class _Stamps(NamedTuple):
    """Usable stamps of a clock, their log times, and the log times of all messages."""

    stamps_ns: IntArray
    log_time_ns: IntArray
    recorded_ns: IntArray


def _why_replaced(source: SignalSource, stamps: _Stamps) -> str:
    """Return why log time replaces the stamps of a source; empty if they are used."""
    if source.stamp == "log_time":
        return ""
    recorded = stamps.recorded_ns.shape[0]
    missing = 1.0 - stamps.stamps_ns.shape[0] / recorded if recorded and source.clock != "device" else 0.0
    if missing > UNUSABLE_SHARE:
        return f"{missing:.0%} of its stamps are zero or no time"
    return why_unusable(stamps.stamps_ns, stamps.log_time_ns)


def _of_other_clocks(clocks: Mapped[str, ClockModel]) -> dict[str, str]:
    """Return why clocks disagree with the others, by key; an offset that all clocks share is accepted."""
    delays_s = {key: clock.median_delay_s for key, clock in clocks.items() if clock.samples}
    if not delays_s or max(delays_s.values()) - min(delays_s.values()) <= MAX_CREDIBLE_DELAY_NS * S_PER_NS:
        return {}
    return {
        key: f"it is {abs(delay_s):.1f} s {'behind' if delay_s > 0.0 else 'ahead of'} log time, other topics are not"
        for key, delay_s in delays_s.items()
        if delay_s * NS_PER_S < -MAX_CREDIBLE_DELAY_NS or delay_s * NS_PER_S > OUTLIER_STAMP_NS
    }


def _survey(
    log: DriveLog, wanted: Mapped[str, SignalSource], spans: Iterable[tuple[int, int]]
) -> dict[str, list[_Stamps]]:
    """Read the stamps of each clock, window by window."""
    requests = requests_of(log, wanted.values(), values=False)
    parts: dict[str, list[_Stamps]] = {key: [_Stamps(*[np.empty(0, np.int64)] * 3)] for key in wanted}
    for start_ns, end_ns in spans:
        columns = log.read(requests, start_ns, end_ns)
        for key, source in wanted.items():
            if (topic := columns.get(source.read_topic)) is not None:
                raw, usable = raw_stamps(log, topic, source)
                parts[key].append(_Stamps(raw[usable], topic.log_time_ns[usable], topic.log_time_ns))
    return parts


def _offset_changes(parts: Sequence[_Stamps]) -> bool:
    """Return whether the smallest delays of successive parts differ by more than clock drift explains."""
    least = np.array([float((p.log_time_ns - p.stamps_ns).min()) for p in parts if p.stamps_ns.shape[0]])
    return bool((np.abs(np.diff(least)) > STEP_BACK_NS).any())


def why_unusable(stamps_ns: IntArray, log_time_ns: IntArray) -> str:
    """Return why stamps are unusable; empty if they are usable.

    Parameters
    ----------
    stamps_ns, log_time_ns : int64 [N], in order of log time.
    """
    n = stamps_ns.shape[0]
    if n < MIN_BIN_SAMPLES:
        return ""
    back = steps_back(stamps_ns)
    if back.size:
        by_s = float(stamps_ns[back[0] - 1] - stamps_ns[back[0]]) * S_PER_NS
        return f"its stamps step back by {by_s:.1f} s while log time continues"
    order = np.argsort(stamps_ns, kind="stable")
    repeats = np.flatnonzero(np.diff(stamps_ns[order]) == 0)
    if repeats.size > UNUSABLE_SHARE * n:
        apart = log_time_ns[order[repeats + 1]] - log_time_ns[order[repeats]]
        usual = float(np.quantile(np.diff(log_time_ns), 0.95))
        if usual > 0.0 and float(np.median(apart)) >= COARSE_SPACING * usual:
            return f"{repeats.size / n:.0%} of its stamps repeat another although the messages were recorded apart"
    delay_ns = (log_time_ns - stamps_ns).astype(np.float64)
    median_ns = float(np.median(delay_ns))
    far = np.abs(delay_ns - median_ns) > OUTLIER_STAMP_NS
    if 0.0 <= median_ns <= MAX_CREDIBLE_DELAY_NS:
        far |= delay_ns < -MAX_CREDIBLE_DELAY_NS  # no message arrives before it is measured
    share = float(far.mean())
    return f"{share:.0%} of its stamps are far off from log time, the others are not" if share > UNUSABLE_SHARE else ""


def stamps_on_log_clock(
    log: DriveLog, columns: Columns, source: SignalSource, clock: ClockModel
) -> tuple[IntArray, NDArray[np.bool_]]:
    """Return a topic's stamps on the log's clock [N], and a mask of usable stamps [N]."""
    if clock.unusable:
        return columns.log_time_ns, columns.log_time_ns > 0
    raw, usable = raw_stamps(log, columns, source)
    stamps = apply_clock(raw, clock)
    if source.stamp != "log_time" and clock.samples:
        delay_ns = (columns.log_time_ns - stamps).astype(np.float64)
        usable = usable & (np.abs(delay_ns - clock.median_delay_s * NS_PER_S) <= OUTLIER_STAMP_NS)
    return stamps, usable


def stamp_request(log: DriveLog, source: SignalSource) -> tuple[str, ...]:
    """Return the field paths of a source's stamp; empty for the recorder's times."""
    if source.stamp in RECORDER_STAMPS:
        return ()
    if source.stamp_unit == "ros":
        fields = log.fields(source.topic)
        if not any(f.path == source.stamp and f.kind == "time" for f in fields):
            pair = split_stamp(source.stamp, {f.path for f in fields})
            if pair is not None:
                return pair
    return (source.stamp,)


def requests_of(log: DriveLog, sources: Iterable[SignalSource], *, values: bool = True) -> dict[str, list[str]]:
    """Return the paths of the stamps of sources by topic, with ``values`` also those of their values."""
    requests: dict[str, list[str]] = {}
    for source in sources:
        paths = requests.setdefault(source.read_topic, [])
        wanted = (*stamp_request(log, source), *(source.paths if values else ()))
        paths += [p for p in wanted if p not in paths]
    return requests


def raw_stamps(log: DriveLog, columns: Columns, source: SignalSource) -> tuple[IntArray, NDArray[np.bool_]]:
    """Return a topic's stamps in nanoseconds [N] and a mask of usable stamps [N] (finite and positive)."""
    if source.stamp == "log_time":
        return columns.log_time_ns, columns.log_time_ns > 0
    if source.stamp == "publish_time":
        return columns.publish_time_ns, columns.publish_time_ns > 0
    paths = stamp_request(log, source)
    parts = [np.asarray(columns.fields[p]) for p in paths]
    if len(parts) == 2:
        return _to_nanoseconds(parts, ("s", "ns"))
    return _to_nanoseconds(parts, ("ns" if source.stamp_unit == "ros" else source.stamp_unit,))


def _to_nanoseconds(parts: list[NDArray[np.generic]], units: tuple[str, ...]) -> tuple[IntArray, NDArray[np.bool_]]:
    stamps = [scaled(p, TIME_UNITS_NS[unit], 0, np.isfinite(p)) for p, unit in zip(parts, units, strict=True)]
    usable = np.logical_and.reduce([ns != NO_TIME for ns in stamps])
    total = np.where(usable, sum(stamps), 0)
    return total, usable & (total > 0)


def survey_windows(start_ns: int, end_ns: int) -> list[tuple[int, int]]:
    """Return the windows for :func:`fit_clocks`: all of a short log, windows of 10 s spread over a longer one."""
    if end_ns - start_ns <= SURVEY_WHOLE_NS:
        return [(start_ns, end_ns)] if start_ns < end_ns else []
    starts = np.linspace(start_ns, end_ns - SURVEY_WINDOW_NS, SURVEY_WINDOWS).astype(np.int64)
    return [(int(s), int(s) + SURVEY_WINDOW_NS) for s in starts]


def _clock_of(source: SignalSource, stamps: _Stamps, unusable: str) -> ClockModel:
    stamps_ns, log_time_ns, recorded_ns = stamps
    if unusable:  # log time replaces the stamps; they do not show the period either
        source, stamps_ns, log_time_ns = replace(source, clock="utc"), recorded_ns, recorded_ns
    n = int(stamps_ns.shape[0])
    steps_ns = np.diff(np.sort(stamps_ns))
    # Larger steps are between the windows of a survey.
    steps_ns = steps_ns[(steps_ns > 0) & (steps_ns <= SURVEY_WINDOW_NS)]
    period_s = float(np.median(steps_ns)) * S_PER_NS if steps_ns.shape[0] else float("nan")
    if n == 0:
        if source.clock == "device":
            expected, got = "stamps of the device clock", "no usable stamp in the span that is read"
            where = f"{source.topic}.{source.stamp}"
            raise MappingError(expected=expected, got=got, where=where, remedy='use stamp = "log_time"')
        return ClockModel()
    line = ClockModel()
    if source.clock == "device":
        reference, reference_log, drift, residual_s = fit_clock_line(stamps_ns, log_time_ns)
        line = ClockModel(reference, reference_log, drift, residual_s=residual_s)
    delays_ns = log_time_ns - apply_clock(stamps_ns, line)
    median_ns = float(np.median(delays_ns))
    is_known = source.clock == "device" or 0.0 <= median_ns <= MAX_CREDIBLE_DELAY_NS
    return replace(
        line,
        delay_known=is_known,
        median_delay_s=median_ns * S_PER_NS,
        p95_delay_s=float(np.quantile(delays_ns, 0.95)) * S_PER_NS,
        median_period_s=period_s,
        samples=n,
        unusable=unusable,
    )
