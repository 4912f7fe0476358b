"""Which drive does what in a retraining: whole drives, each in one role for good, so that none judges what it taught.

A role once dealt stays with the drive, which is known by what its mapped signals hold; new drives are dealt to the role
that lacks them most, in an order drawn by the seed. A fleet that grows moves none from the gate to training or back.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

#: Trains the network, stops it, says how far it is followed, fits intervals, and decides at the end.
TRAIN, STOP, TRUST, INTERVALS, GATE = "train", "validation", "trust", "intervals", "gate"
SHARES = {TRAIN: 0.5, STOP: 0.1, TRUST: 0.15, INTERVALS: 0.1, GATE: 0.15}
#: Drives that each has before any has more; fewer than five on the gate cannot tell, nor make an interval.
LEAST = {TRAIN: 3, STOP: 1, TRUST: 2, INTERVALS: 5, GATE: 5}
#: What the split of a set's manifest allows; any other split is kept for the gate.
BY_SPLIT = {"": tuple(SHARES), "train": (TRAIN,), "validation": (STOP, INTERVALS), "test": (TRUST, GATE)}
#: What a drive may do that the car was taught or judged by before.
OF_TAUGHT = (TRAIN, STOP)


@dataclass(frozen=True, slots=True)
class Candidate:
    """A drive by the hash of its signals, with the split that its set gives it and whether the car has learnt on it."""

    signals_sha256: str
    split: str = ""
    taught: bool = False

    @property
    def allowed(self) -> tuple[str, ...]:
        """The roles that it may have; for one that has taught the car and belongs to a test set, that of its set."""
        by_split = BY_SPLIT.get(self.split, (GATE,))
        return tuple(r for r in by_split if not self.taught or r in OF_TAUGHT) or by_split


def deal(candidates: Sequence[Candidate], before: Mapping[str, str], seed: int) -> dict[str, str]:
    """Return the role of each drive by its hash; ``before``: those of earlier calls, of drives not given too."""
    roles = dict(before)
    count = Counter(roles[c.signals_sha256] for c in candidates if c.signals_sha256 in roles)

    def lack(role: str) -> tuple[float, float]:
        return min(count[role] / LEAST[role], 1.0), count[role] / SHARES[role]

    new = {c.signals_sha256: c for c in candidates if c.signals_sha256 not in roles}
    for key in sorted(new, key=lambda k: hashlib.sha256(f"{seed}:{k}".encode()).digest()):
        roles[key] = min(new[key].allowed, key=lack)
        count[roles[key]] += 1
    return roles
