"""Pairs of drives of two runs: by the hash of their signals, else of their files, else by name.

Differences of the runs besides figures: cars, mappings, signals, ground truth, configuration, versions.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, TypeAlias

from pdhef_logtool.records.printable import listed
from pdhef_logtool.results.opened_run import OpenedLog, OpenedRun
from pdhef_logtool.results.selected_estimate import TEMPLATES
from pdhef_logtool.storage.templates import template

PairedBy: TypeAlias = Literal["signals", "content", "name"]

_KEYS: tuple[tuple[PairedBy, Callable[[OpenedLog], object]], ...] = (
    ("signals", lambda log: log.entry.get("signals_sha256")),
    ("content", lambda log: log.entry.get("sha256")),
    ("name", lambda log: log.label),
)

#: Of each kind of difference, how many are named.
_MOST_NAMED = 3
_DIGITS = 8


@dataclass(frozen=True, slots=True)
class Pair:
    """One drive in both runs, and how it was recognised."""

    a: OpenedLog
    b: OpenedLog
    by: PairedBy

    def same(self, key: str) -> bool | None:
        """Return whether an entry of run.json is the same on both sides; None if one side lacks it."""
        left, other = self.a.entry.get(key), self.b.entry.get(key)
        return None if left is None or other is None else bool(left == other)


def pair_logs(
    a: Sequence[OpenedLog], b: Sequence[OpenedLog]
) -> tuple[list[Pair], Sequence[OpenedLog], Sequence[OpenedLog]]:
    """Return the pairs of the logs of two runs in the order of A, and the logs of A and of B without a partner.

    A key that several logs of a side have pairs none of them.
    """
    left, right = a, b
    pairs: dict[str, Pair] = {}
    for by, key in _KEYS:
        left_by_key, other = _once(left, key), _once(right, key)
        pairs |= {log.label: Pair(log, other[k], by) for k, log in left_by_key.items() if k in other}
        paired = {pair.b.label for pair in pairs.values()}
        left = [log for log in left if log.label not in pairs]
        right = [log for log in right if log.label not in paired]
    return [pairs[log.label] for log in a if log.label in pairs], left, right


def _once(logs: Sequence[OpenedLog], key: Callable[[OpenedLog], object]) -> dict[object, OpenedLog]:
    keys = [key(log) for log in logs]
    times = Counter(keys)
    return {k: log for k, log in zip(keys, logs, strict=True) if isinstance(k, str) and times[k] == 1}


def run_differences(a: OpenedRun, b: OpenedRun, pairs: Sequence[Pair]) -> tuple[str, ...]:
    """Return other possible causes of changed figures of two runs' pairs, a line each."""

    def changed(key: str) -> list[Pair]:
        return [pair for pair in pairs if pair.same(key) is False]

    names = [p for p in pairs if p.by == "name" and p.same("signals_sha256") is not False and not p.same("sha256")]
    text = template(TEMPLATES / "differences.txt").render(
        a=a.document,
        b=b.document,
        count=len(pairs),
        cars=_cars(pairs, "sha256", named=True),
        networks=_cars(pairs, "network_sha256", named=False),
        mapping=changed("mapping_sha256"),
        signals=changed("signals_sha256"),
        unproven=names,
        truth=changed("truth_sha256"),
        mains=Counter((p.a.entry["main"], p.b.entry["main"]) for p in changed("main")),
        outcomes=[pair for pair in pairs if pair.a.outcome != pair.b.outcome],
        unknown=sum(p.same("signals_sha256") is None and p.a.outcome == p.b.outcome == "ok" for p in pairs),
        MOST_NAMED=_MOST_NAMED,
        listed=partial(listed, most=_MOST_NAMED),
    )
    return tuple(filter(None, (" ".join(line.split()) for line in text.splitlines())))


def _cars(pairs: Sequence[Pair], key: str, *, named: bool) -> Counter[tuple[str, str]]:
    """Return how many pairs have other cars or networks, as texts."""

    def text(car: dict[str, Any]) -> str:
        short = "none" if car.get(key) is None else str(car[key])[:_DIGITS]
        return f"{car.get('name', '')} {short}".strip() if named else short

    cars = ([log.entry.get("car") or {} for log in (pair.a, pair.b)] for pair in pairs)
    return Counter((text(left), text(right)) for left, right in cars if left.get(key) != right.get(key))
