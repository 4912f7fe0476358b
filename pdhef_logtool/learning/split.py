"""Split of drives into training, network training, validation and test, with a gap wherever two of them meet."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pdhef_logtool.learning.drives import CALIBRATE, NETWORK, NOISE, STAGES
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.records.signals import FloatArray

#: Between two parts of one drive, half of it on either side of the cut: filter states and slow disturbances must have
#: forgotten the former.
GAP_S = 5.0
#: Parameters and noise; training of the network; decision after each stage whether it is kept, residual gain and
#: intervals; scored once at the end.
TRAINING, NETWORK_TRAINING, VALIDATION, TEST = "training", "network training", "validation", "test"
PARTS = (TRAINING, NETWORK_TRAINING, VALIDATION, TEST)
#: Shares of the driving that is not held out, without and with a part for the network.
SHARES = {TRAINING: 0.82, VALIDATION: 0.18}
SHARES_WITH_NETWORK = {TRAINING: 0.50, NETWORK_TRAINING: 0.32, VALIDATION: 0.18}
#: Stages that use the training part; the others use the validation part alone.
TRAINED = {CALIBRATE, NOISE, NETWORK}
#: Usable driving from which on the network has a part of its own, that physics was not fitted to, and still leaves
#: the fit enough to choose the model's parts; with less it learns from the training split.
OWN_NETWORK_PART_S = 600.0
#: One drive is cut into rounds of about this much usable driving, each with all parts but the test.
ROUND_S = 240.0
#: Least usable driving of validation and test, where there is little; a gap comes off it.
LEAST_PART_S = 10.0 + GAP_S
#: Drives shorter than this are cut together, as if they were one.
LEAST_CUT_S = 100.0
#: From so many drives on each belongs to one part whole; fewer are cut by time.
WHOLE_DRIVES = 8


@dataclass(frozen=True, slots=True, eq=False)
class DriveTimes:
    """When a drive can be used: [n] seconds from the log's start, ascending, one a step of ``period_s``."""

    log: LogInput
    usable_s: FloatArray
    period_s: float

    @property
    def seconds(self) -> float:
        """Usable driving of it."""
        return float(self.usable_s.size) * self.period_s


@dataclass(frozen=True, slots=True, eq=False)
class Split:
    """Slices of drives by part, and when they can be used.

    ``times`` is empty where whole logs are given to one stage; that stage then leaves out the share ``holdout`` itself.
    """

    parts: Mapping[str, tuple[LogInput, ...]]
    times: tuple[DriveTimes, ...] = ()
    holdout: float = 0.0

    @classmethod
    def undivided(cls, logs: Sequence[LogInput], holdout: float = 0.0) -> Split:
        """Return all logs as every part, for a stage that runs alone."""
        return cls(dict.fromkeys(PARTS, tuple(logs)), holdout=holdout)

    def usable(self, part: str) -> list[DriveTimes]:
        """Return when the slices of a part can be used."""
        return usable_in(self.times, self.parts[part])

    def seconds(self, part: str) -> float:
        """Return the usable driving of a part."""
        return sum(d.seconds for d in self.usable(part))

    def pieces(self, part: str, piece_s: float) -> tuple[LogInput, ...]:
        """Return a part in pieces of at least ``piece_s`` of usable driving, or its whole logs."""
        return pieces_of(self.usable(part), piece_s) if self.times else self.parts[part]

    def network_part(self) -> str:
        """Return the part that the network is trained on."""
        return NETWORK_TRAINING if self.parts[NETWORK_TRAINING] else TRAINING


def shares_of(usable_s: float, holdout: float, stages: Iterable[str] = STAGES) -> dict[str, float]:
    """Return the share of each part in so much usable driving; their sum is 1."""
    least = LEAST_PART_S / max(usable_s, 1e-9)
    last = min(max(holdout, least), 0.5) if holdout > 0.0 else 0.0
    stages = set(stages)
    both = NETWORK in stages and len(TRAINED & stages) > 1
    shares = SHARES_WITH_NETWORK if both and usable_s >= OWN_NETWORK_PART_S else SHARES
    if TRAINED.isdisjoint(stages):
        shares = {TRAINING: 0.0, VALIDATION: 1.0}
    shares = {part: (1.0 - last) * share for part, share in shares.items()}
    lacks = min(max(0.0, least - shares[VALIDATION]), shares[TRAINING])
    return {**shares, TRAINING: shares[TRAINING] - lacks, VALIDATION: shares[VALIDATION] + lacks, TEST: last}


def split_drives(
    drives: Sequence[DriveTimes], holdout: float, stages: Iterable[str] = STAGES
) -> dict[str, tuple[LogInput, ...]]:
    """Return the slices of each part: whole drives where there are many, else all drives are cut by time.

    Parameters
    ----------
    holdout : share of the test part: the end of each drive that is cut, or whole drives.
    """
    shares = shares_of(sum(d.seconds for d in drives), holdout, stages)
    parts: dict[str, tuple[LogInput, ...]] = dict.fromkeys(PARTS, ())
    if len(drives) >= WHOLE_DRIVES:
        return parts | deal_drives(drives, shares)
    # Short ones are cut as if they were one: each would give nothing to some parts.
    together = min(d.seconds for d in drives) < LEAST_CUT_S
    for part, piece in (x for log in ([drives] if together else [[d] for d in drives]) for x in cut_times(log, shares)):
        parts[part] += (piece,)
    return parts


def deal_drives(drives: Sequence[DriveTimes], shares: Mapping[str, float]) -> dict[str, tuple[LogInput, ...]]:
    """Return whole drives by part: each in its turn goes to the part that lacks most of its share."""
    parts: dict[str, list[LogInput]] = {part: [] for part in shares}
    total = sum(d.seconds for d in drives)
    lacks = {part: share * total for part, share in shares.items() if share > 0.0}
    for drive in drives:
        part = max(lacks, key=lambda p: lacks[p])
        lacks[part] -= drive.seconds
        parts[part].append(part_of_log(drive.log, (float(drive.usable_s[0]), float(drive.usable_s[-1]))))
    return {part: tuple(logs) for part, logs in parts.items()}


def cut_times(drives: Sequence[DriveTimes], shares: Mapping[str, float]) -> list[tuple[str, LogInput]]:
    """Return the slices of drives, one behind the other, by part in order of time; shares are of usable driving.

    All parts but the test come in rounds, so that each has something of all of it; the test is the end.
    """
    total = sum(d.seconds for d in drives)
    used = {part: share for part, share in shares.items() if part != TEST and share > 0.0}
    rounds = max(1, round(sum(used.values()) * total / ROUND_S))
    pieces = [(part, share / rounds) for _ in range(rounds) for part, share in used.items()]
    pieces += [(TEST, shares[TEST])] if shares.get(TEST, 0.0) > 0.0 else []
    ends = np.concatenate([[0.0], np.cumsum([share for _, share in pieces])])
    slices = []
    for (part, _), (a, b) in zip(pieces, pairwise(total * ends / ends[-1]), strict=True):
        before = 0.0
        for drive in drives:
            if (piece := _between(drive, float(a) - before, float(b) - before)) is not None:
                slices.append((part, piece))
            before += drive.seconds
    return slices


def _between(drive: DriveTimes, a: float, b: float) -> LogInput | None:
    """Return the slice from ``a`` to ``b`` seconds of a drive's usable driving, less half a gap at a cut."""
    last = drive.usable_s.size - 1
    first, end = (min(max(round(x / drive.period_s), 0), last) for x in (a, b))
    start_s = float(drive.usable_s[first]) + (0.5 * GAP_S if first > 0 else 0.0)
    end_s = float(drive.usable_s[end]) - (0.5 * GAP_S if end < last else 0.0)
    return part_of_log(drive.log, (start_s, end_s)) if end_s - start_s > drive.period_s else None


def part_of_log(log: LogInput, span_s: tuple[float, float]) -> LogInput:
    """Return a slice of a log, or of a slice of it, under a name of its own."""
    start_s, end_s = (round(s, 3) for s in span_s)
    stem = log.stem if log.span_s is None else log.stem.rpartition("_")[0]
    return LogInput(log.path, f"{stem}_{start_s:g}-{end_s:g}s", (start_s, end_s))


def usable_in(times: Iterable[DriveTimes], slices: Iterable[LogInput]) -> list[DriveTimes]:
    """Return when each slice can be used."""
    by_path = {t.log.path: t for t in times}
    usable_times = []
    for log_slice in slices:
        assert log_slice.span_s is not None
        whole = by_path[log_slice.path]
        inside = (whole.usable_s >= log_slice.span_s[0]) & (whole.usable_s <= log_slice.span_s[1])
        usable_times.append(DriveTimes(log_slice, whole.usable_s[inside], whole.period_s))
    return usable_times


def divided(drives: Sequence[DriveTimes], share: float) -> tuple[tuple[LogInput, ...], tuple[LogInput, ...]]:
    """Return the first ``share`` of the usable driving of each slice, and the rest; whole slices of many."""
    drives = [d for d in drives if d.usable_s.size > 1]
    if len(drives) >= WHOLE_DRIVES:
        first, rest = deal_drives(drives, {"first": share, "rest": 1.0 - share}).values()
        return first, rest
    halves = [(_between(d, 0.0, share * d.seconds), _between(d, share * d.seconds, d.seconds)) for d in drives]
    return tuple(a for a, _ in halves if a is not None), tuple(b for _, b in halves if b is not None)


def pieces_of(drives: Iterable[DriveTimes], piece_s: float) -> tuple[LogInput, ...]:
    """Return slices cut into pieces with at least ``piece_s`` of usable driving; a shorter one is a piece by itself."""
    pieces = []
    for drive in (d for d in drives if d.usable_s.size > 1):
        count = max(1, int(drive.seconds // piece_s))
        bounds = np.round(np.linspace(0, drive.usable_s.size - 1, count + 1)).astype(np.int64)
        pieces += [part_of_log(drive.log, (float(a), float(b))) for a, b in pairwise(drive.usable_s[bounds])]
    return tuple(pieces)
