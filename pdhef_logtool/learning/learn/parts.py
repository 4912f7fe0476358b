"""Which driving teaches what: parts of drives that do not mix, with a gap wherever two of them meet."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pdhef_logtool.learning.car.fit_data import GUARD_S
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.records.signals import FloatArray

#: What fits parameters and noise (and chooses the model's parts, by folds of its own), what trains the network, what
#: says after each step whether it stays, and what is scored once.
FIT, NETWORK, CHECK, LAST = "fit", "network", "check", "last"
PARTS = (FIT, NETWORK, CHECK, LAST)
#: Shares of what is not held out, without and with a part for the network.
SHARES = {FIT: 0.82, CHECK: 0.18}
SHARES_WITH_NETWORK = {FIT: 0.50, NETWORK: 0.32, CHECK: 0.18}
#: Usable driving from which on the network has a part of its own, that physics was not fitted to, and still leaves
#: the fit enough to choose the model's parts; with less it learns from the fit part.
OWN_NETWORK_PART_S = 600.0
#: One drive is cut into rounds of about this much usable driving, each with all parts but the last.
ROUND_S = 240.0
#: What check and last have at least of usable driving, where there is little; a gap comes off it.
LEAST_PART_S = 10.0 + GUARD_S
#: Drives shorter than this are not cut each for itself.
LEAST_CUT_S = 100.0
#: From so many drives on each belongs to one part whole; fewer are cut by time.
WHOLE_DRIVES = 8
#: Between two parts of one drive, half of it on either side of the cut.
GAP_S = GUARD_S


@dataclass(frozen=True, slots=True, eq=False)
class DriveTimes:
    """When a drive can be learnt from: [n] seconds from the log's start, ascending, one a step of ``period_s``."""

    log: LogInput
    usable_s: FloatArray
    period_s: float

    @property
    def seconds(self) -> float:
        """How much of it can be learnt from."""
        return float(self.usable_s.size) * self.period_s


def shares_of(usable_s: float, holdout: float) -> dict[str, float]:
    """Return the share of each part in so much usable driving; their sum is 1."""
    least = LEAST_PART_S / max(usable_s, 1e-9)
    last = min(max(holdout, least), 0.5) if holdout > 0.0 else 0.0
    shares = SHARES if usable_s < OWN_NETWORK_PART_S else SHARES_WITH_NETWORK
    shares = {part: (1.0 - last) * share for part, share in shares.items()}
    lacks = min(max(0.0, least - shares[CHECK]), shares[FIT])
    return {**shares, FIT: shares[FIT] - lacks, CHECK: shares[CHECK] + lacks, LAST: last}


def split_drives(drives: Sequence[DriveTimes], holdout: float) -> dict[str, tuple[LogInput, ...]]:
    """Return the slices of each part: whole drives where there are many, else all drives are cut by time.

    Parameters
    ----------
    holdout : share of the last part: the end of each drive that is cut, or whole drives.
    """
    shares = shares_of(sum(d.seconds for d in drives), holdout)
    found: dict[str, tuple[LogInput, ...]] = dict.fromkeys(PARTS, ())
    if len(drives) >= WHOLE_DRIVES:
        return found | deal_drives(drives, shares)
    # Short ones are cut as if they were one: each would give nothing to some parts.
    together = min(d.seconds for d in drives) < LEAST_CUT_S
    for part, piece in (x for one in ([drives] if together else [[d] for d in drives]) for x in cut_times(one, shares)):
        found[part] += (piece,)
    return found


def deal_drives(drives: Sequence[DriveTimes], shares: Mapping[str, float]) -> dict[str, tuple[LogInput, ...]]:
    """Return whole drives by part: each in its turn goes to the part that lacks most of its share."""
    found: dict[str, list[LogInput]] = {part: [] for part in shares}
    total = sum(d.seconds for d in drives)
    lacks = {part: share * total for part, share in shares.items() if share > 0.0}
    for drive in drives:
        part = max(lacks, key=lambda p: lacks[p])
        lacks[part] -= drive.seconds
        found[part].append(part_of_log(drive.log, (float(drive.usable_s[0]), float(drive.usable_s[-1]))))
    return {part: tuple(logs) for part, logs in found.items()}


def cut_times(drives: Sequence[DriveTimes], shares: Mapping[str, float]) -> list[tuple[str, LogInput]]:
    """Return the slices of drives, one behind the other, by part in order of time; shares are of usable driving.

    All parts but the last come in rounds, so that each has something of all of it; the last is the end.
    """
    total = sum(d.seconds for d in drives)
    learnt = {part: share for part, share in shares.items() if part != LAST and share > 0.0}
    rounds = max(1, round(sum(learnt.values()) * total / ROUND_S))
    pieces = [(part, share / rounds) for _ in range(rounds) for part, share in learnt.items()]
    pieces += [(LAST, shares[LAST])] if shares.get(LAST, 0.0) > 0.0 else []
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
    """Return when each slice can be learnt from."""
    by_path = {t.log.path: t for t in times}
    found = []
    for one in slices:
        assert one.span_s is not None
        whole = by_path[one.path]
        inside = (whole.usable_s >= one.span_s[0]) & (whole.usable_s <= one.span_s[1])
        found.append(DriveTimes(one, whole.usable_s[inside], whole.period_s))
    return found


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
        at = np.round(np.linspace(0, drive.usable_s.size - 1, count + 1)).astype(np.int64)
        pieces += [part_of_log(drive.log, (float(a), float(b))) for a, b in pairwise(drive.usable_s[at])]
    return tuple(pieces)
