"""Compare the mapping and messages of the tool with the right answers by value, independent of field names."""

import re
from collections.abc import Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.table_clocks import RELATIVE_NS
from pdhef_logtool.mapping import Mapping as SignalMapping, SignalSource, fit_clocks, read_signals
from pdhef_logtool.records.errors import PdhefError
from pdhef_logtool.records.signals import POSITIONS, Channel, FloatArray
from pdhef_logtool.runs.inspection.report import inspect_drive_log
from studies.pages import ROOT, read_toml
from studies.strangers.cars import Series
from studies.strangers.page import Result
from studies.strangers.recordings import ITEMS, SCORING, Recording

#: Values are compared as means over so long: noise and a late stamp of a few milliseconds count little.
BIN_S = 0.25
#: Two channels agree when they differ by less than this share of the right one's rms, or by the floor of its unit.
SHARE = 0.04
FLOORS: dict[str, float] = {name: group["floor"] for group in SCORING["floors"] for name in group["channels"]}
WEAK_SHARE = 0.6
#: Largest constant (m/s²) that counts as accelerometer bias: it cannot be distinguished from a tilt of two degrees.
BIAS_M_S2 = 0.3
#: A share of right samples from which a channel counts as right: some logs contain invalid samples.
RIGHT_BINS = 0.95
#: Times below are those of a clock without a date.
FEWEST_WEEKS_NS = 10**15
#: The same of a course: the rest are stops.
MOVING_BINS = 0.8


@dataclass(frozen=True, slots=True)
class Told:
    """Messages of the tool for a log.

    ``checks`` as in report.json (name, subject, verdict, evidence, remedy); ``doubts`` are its other sentences:
    ambiguities, notes, missing signals; ``suspects`` are the channels of warnings, if any.
    """

    checks: tuple[Mapping[str, Any], ...]
    doubts: tuple[str, ...]
    error: str = ""
    suspects: frozenset[str] = frozenset()

    @property
    def text(self) -> str:
        """All messages about problems."""
        bad = [c for c in self.checks if c["verdict"] != "passed"]
        said = [f"{c['name']} {c['subject']}: {c.get('evidence', '')} {c.get('remedy', '')}" for c in bad]
        return "\n".join([*said, *self.doubts, self.error])


# ------------------------------------------------------------------------------------------------ messages of the tool


def look(path: Path) -> tuple[SignalMapping | None, Told, dict[str, Channel]]:
    """Let the tool read a log on its own; return its mapping, its messages, and its channels."""
    # A person gives the folder of the DBC files as --set msgs=.
    msgs = path if path.is_dir() and any(path.glob("*.dbc")) else None
    try:
        with closing(open_log(path, msgs=msgs)) as log:
            inspection = inspect_drive_log(log)
            channels = _channels(log, inspection.mapping)
    except PdhefError as error:
        return None, Told((), (), str(error)), {}
    document, refused_run = inspection.to_dict(), ""
    checks, warnings = list(document.get("checks") or ()), document.get("warnings") or []
    said = [w["message"] for w in warnings]
    said += [*map(str, inspection.ambiguities), *inspection.notes, *(f"missing: {name}" for name in inspection.missing)]
    suspects = frozenset(name for w in warnings for name in (w["suspects"] or w["signals"]))
    try:
        with read_drive(path, Car.load("saloon"), options=ReadOptions(msgs=msgs), require_sensors=False) as drive:
            more = [asdict(check) for check in drive.checks]
            checks += [check for check in more if check["name"] not in {c["name"] for c in checks}]
    except PdhefError as error:
        refused_run = str(error)
    return inspection.mapping, Told(tuple(checks), tuple(said), refused_run, suspects), channels


def _channels(log: DriveLog, mapping: SignalMapping) -> dict[str, Channel]:
    """Return the channels of a log by a mapping."""
    clocks = fit_clocks(log, mapping, log.start_ns, log.end_ns)
    read = read_signals(log, mapping, clocks, log.start_ns, log.end_ns)
    return read.signals | {f"truth.{name}": channel for name, channel in read.truth.items()}


# ------------------------------------------------------------------------------------------------ by value


def agrees(channel: Channel, right: Series, name: str) -> bool:
    """Return whether a channel has the values of a series, but for noise, a few milliseconds and a bias."""
    floor = FLOORS.get(name, FLOORS["rad_s" if name.endswith("rad_s") else "m_s"])
    bias = BIAS_M_S2 if name in ("ax_m_s2", "ay_m_s2") else 0.0
    if not len(channel) or not len(right.stamps_ns):
        return False
    if channel.name.endswith(("course_rad", "yaw_rad", "heading_rad")):
        channel = replace(channel, values=_on_circle(channel.values))
        right = replace(right, values=_on_circle(right.values))
    if channel.name in POSITIONS:
        place = float(np.median(right.values))
        channel, right = replace(channel, values=channel.values - place), right.times(1.0, -place)
    width = round(BIN_S * 1e9)
    start = max(int(channel.stamps_ns[0]), int(right.stamps_ns[0]))
    end = min(int(channel.stamps_ns[-1]), int(right.stamps_ns[-1]))
    count = (end - start) // width
    if count < 1:
        return False
    if np.median(np.diff(channel.stamps_ns)) > width:
        # A channel this slow contains samples, not means.
        got = channel.values.reshape(len(channel), -1)
        wanted = right.along(Series(channel.stamps_ns, channel.arrival_ns, got)).values.reshape(len(channel), -1)
        count = len(channel)
    else:
        got = _means(channel.stamps_ns - start, channel.values, width, count)
        wanted = _means(right.stamps_ns - start, right.values, width, count)
    if got.shape != wanted.shape:
        return False
    both = np.isfinite(got).all(axis=1) & np.isfinite(wanted).all(axis=1)
    if np.count_nonzero(both) < 0.5 * count:
        return False
    rms = float(np.sqrt(np.mean(wanted[both] ** 2)))
    difference = got[both] - wanted[both]
    difference -= np.clip(np.median(difference), -bias, bias)
    apart = np.sqrt(np.mean(difference**2, axis=1))
    # A few bins may contain invalid samples; the others must agree as a whole. The course of a car at rest is noise.
    share = MOVING_BINS if channel.values.ndim == 2 and "course" in channel.name else RIGHT_BINS
    kept = np.sort(apart)[: int(np.ceil(share * apart.shape[0]))]
    # Of a weak signal the floor is no more than a share: noise is accepted, another sign is not.
    return bool(np.sqrt(np.mean(kept**2)) <= max(SHARE * rms, min(floor, WEAK_SHARE * rms)))


def _on_circle(angles_rad: FloatArray) -> FloatArray:
    """Return the points [N, 2] of angles on the unit circle, so that full turns do not count."""
    return np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=1)


def _means(at_ns: Any, values: FloatArray, width: int, count: int) -> FloatArray:
    """Return the means of the bins [count, k]; NaN where a bin is empty."""
    bins = at_ns // width
    inside = (bins >= 0) & (bins < count)
    columns = values.reshape(values.shape[0], -1)
    hits = np.bincount(bins[inside], minlength=count).astype(np.float64)
    sums = [np.bincount(bins[inside], weights=column[inside], minlength=count) for column in columns.T]
    with np.errstate(invalid="ignore"):
        return np.stack(sums, axis=1) / hits[:, None]


# ------------------------------------------------------------------------------------------------ the score


def score_log(path: Path, expected: Recording, start_ns: int | None = None) -> Result:
    """Let the tool map a log and compare the mapping with the right answers.

    A channel of :data:`ITEMS` that is neither right nor allowed is wrong.

    Parameters
    ----------
    start_ns : zero of the clock of a log with times relative to its start.
    """
    right = expected.right
    mapping, messages, channels = look(path)
    sides = {} if mapping is None else mapping.signals | {f"truth.{n}": s for n, s in mapping.truth.items()}
    sources = {name: source.label for name, source in sides.items()}
    fitting = {**expected.allowed, **right}
    first = min((int(c.arrival_ns[0]) for c in channels.values() if len(c)), default=None)
    if start_ns is not None and first is not None and first < RELATIVE_NS + FEWEST_WEEKS_NS:
        # A clock without a date counts from its own zero, such as the start of a GPS week.
        shift = (RELATIVE_NS if first < RELATIVE_NS + 10**12 else first) - start_ns
        fitting = {n: [s.late(shift * 1e-9) for s in series] for n, series in fitting.items()}
    is_right = {
        name: any(agrees(channel, series, name) for series in fitting.get(name, ()))
        for name, channel in channels.items()
    }
    items, wrong, verdicts, doubted, silent = dict[str, str](), dict[str, str](), dict[str, str](), [], []
    for item, names in ITEMS.items():
        mapped = [n for n in names if n in channels]
        present = any(n in right for n in names)
        if item in SCORING["only_if_named"] and not present:
            continue
        bad = [n for n in mapped if not is_right[n]]
        if bad:
            is_told = all(_is_told(n, sources, messages) for n in bad)
            items[item] = "wrong, reported" if is_told else "wrong, not reported"
            wrong[item] = ", ".join(f"{n} = {sources[n]}" for n in bad if n in sources)
            silent += [] if is_told else [f"{item} ({wrong[item]})"]
        elif present and mapped:
            items[item] = "right"
            checked = {c["verdict"] for c in messages.checks if c["subject"] in mapped}
            verdicts[item] = next((v for v in ("failed", "undecided", "passed") if v in checked), "none")
            doubted += [item] if any(_is_doubted(n, sources.get(n, ""), messages) for n in mapped) else []
        elif present:
            items[item] = "missing"
    alarms = tuple(
        f"{c['name']} ({c['subject']}): {c.get('evidence', '')}"
        for c in messages.checks
        if c["verdict"] == "failed"
        and is_right.get(c["subject"], False)
        and c["subject"] not in expected.at_fault
        and not c["name"].endswith(".corrected")  # the correction made it right
    )
    named = bool(re.search(expected.cause, messages.text, re.IGNORECASE)) if expected.cause else None
    found = tuple(silent), tuple(doubted), alarms, named, messages.text
    return Result(replace(expected, right={}, allowed={}, topics=()), items, wrong, verdicts, *found)


def _is_told(name: str, sources: Mapping[str, str], messages: Told) -> bool:
    """Return whether a check that did not pass is on the channel, or a doubt names it or its source."""
    subject = name.removeprefix("truth.")
    bad = {check["subject"] for check in messages.checks if check["verdict"] != "passed"} | messages.suspects
    return bool({name, subject} & bad) or _is_doubted(name, sources.get(name, ""), messages)


#: Words of a sentence that expresses doubt.
_DOUBT = re.compile(r"doubt|took|is taken, but|waive|suspect|contradict|not sure|ambig|disagree|may be|might|perhaps")


def _is_doubted(name: str, source: str, messages: Told) -> bool:
    """Return whether a sentence doubts a channel, by its name or the field or topic that it comes from."""
    topic = source.partition(".")[0]
    named = [part for part in (name.removeprefix("truth."), source, topic) if part]
    return any(_DOUBT.search(d) and any(part in d for part in named) for d in messages.doubts)


# ------------------------------------------------------------------------------------------------ recordings of others

SHARED = ROOT.parent / "shared"
#: Right sources of recordings by channel (alternatives), sources that are also ``allowed``, and channels ``at_fault``.
ANSWERS = read_toml(Path(__file__).with_name("answers.toml"))


def other_recording(file: str) -> Recording:
    """Read a recording of others: its right and its allowed channels."""
    table = dict(ANSWERS[file])
    sources, at_fault = table.pop("allowed", {}), frozenset(table.pop("at_fault", ()))
    right, allowed = (_read(SHARED / file, given) for given in (table, sources))
    return Recording(file, "recording", "", right, allowed, at_fault=at_fault)


def _source(name: str, topic: str, field: str, scale: str = "1", offset: str = "0") -> SignalSource:
    return SignalSource(name, topic, field, scale=float(scale), offset=float(offset))


def _read(path: Path, table: Mapping[str, str | list[str]]) -> dict[str, tuple[Series, ...]]:
    """Return the channels of a recording, several where a channel has alternative sources."""
    alternatives = {name: given if isinstance(given, list) else [given] for name, given in table.items()}
    series: dict[str, tuple[Series, ...]] = {}
    with closing(open_log(path)) as log:
        for turn in range(max(map(len, alternatives.values()), default=0)):
            signals, truth = dict[str, SignalSource](), dict[str, SignalSource]()
            for name, texts in alternatives.items():
                if turn < len(texts):
                    bare = name.removeprefix("truth.")
                    (signals if bare == name else truth)[bare] = _source(bare, *texts[turn].split())
            for name, c in _channels(log, SignalMapping(signals=signals, truth=truth)).items():
                if len(c):
                    series[name] = (*series.get(name, ()), Series(c.stamps_ns, c.arrival_ns, c.values))
    return series
