"""Pairs of drives of two runs: by the hash of their signals, else of their files, else by name."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

from pdhef_logtool.results.opened_run import OpenedLog

PairedBy: TypeAlias = Literal["signals", "content", "name"]

_KEYS: tuple[tuple[PairedBy, Callable[[OpenedLog], object]], ...] = (
    ("signals", lambda log: log.entry.get("signals_sha256")),
    ("content", lambda log: log.entry.get("sha256")),
    ("name", lambda log: log.label),
)


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

    @property
    def same_file(self) -> bool:
        """Whether the files of both sides are known to be the same."""
        return self.same("sha256") is True


@dataclass(frozen=True, slots=True)
class Pairing:
    """The drives of two runs: pairs in the order of A, and drives without a partner."""

    pairs: tuple[Pair, ...]
    only_a: tuple[OpenedLog, ...]
    only_b: tuple[OpenedLog, ...]


def pair_logs(a: Sequence[OpenedLog], b: Sequence[OpenedLog]) -> Pairing:
    """Pair the logs of two runs; a key that several logs of a side have pairs none of them."""
    left, right = list(a), list(b)
    pairs: dict[str, Pair] = {}
    for by, key in _KEYS:
        left_by_key, other = _once(left, key), _once(right, key)
        pairs |= {log.label: Pair(log, other[k], by) for k, log in left_by_key.items() if k in other}
        paired = {pair.b.label for pair in pairs.values()}
        left = [log for log in left if log.label not in pairs]
        right = [log for log in right if log.label not in paired]
    return Pairing(tuple(pairs[log.label] for log in a if log.label in pairs), tuple(left), tuple(right))


def _once(logs: Sequence[OpenedLog], key: Callable[[OpenedLog], object]) -> dict[object, OpenedLog]:
    keys = [key(log) for log in logs]
    times = Counter(keys)
    return {k: log for k, log in zip(keys, logs, strict=True) if isinstance(k, str) and times[k] == 1}
