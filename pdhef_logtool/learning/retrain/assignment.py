"""Split assignment of a retraining: a drive has one split for good, so that none evaluates a network trained on it.

A drive is identified by the hash of its mapped signals and keeps its split; new drives go to the split that lacks them
most, in an order drawn by the seed. A fleet that grows moves none from the gate to training or back.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

#: Training of the network, its stopping, its residual gain, the intervals, and the decision at the end.
TRAIN, STOP, TRUST, INTERVALS, GATE = "train", "validation", "trust", "intervals", "gate"
SHARES = {TRAIN: 0.5, STOP: 0.1, TRUST: 0.15, INTERVALS: 0.1, GATE: 0.15}
#: Drives that each split has before any has more; fewer than five on the gate cannot decide, nor give an interval.
LEAST = {TRAIN: 3, STOP: 1, TRUST: 2, INTERVALS: 5, GATE: 5}
#: What the split of a set's manifest allows; any other split is kept for the gate.
BY_SPLIT = {"": tuple(SHARES), "train": (TRAIN,), "validation": (STOP, INTERVALS), "test": (TRUST, GATE)}
#: Splits of a drive that the car was trained or evaluated on before.
OF_TAUGHT = (TRAIN, STOP)


@dataclass(frozen=True, slots=True)
class Candidate:
    """A drive by the hash of its signals, the split of its set, and whether the car was trained on it."""

    signals_sha256: str
    split: str = ""
    taught: bool = False

    @property
    def allowed(self) -> tuple[str, ...]:
        """Splits that it may have; for a drive that trained the car and belongs to a test set, those of its set."""
        by_split = BY_SPLIT.get(self.split, (GATE,))
        return tuple(r for r in by_split if not self.taught or r in OF_TAUGHT) or by_split


def deal(candidates: Sequence[Candidate], before: Mapping[str, str], seed: int) -> dict[str, str]:
    """Return the split of each drive by its hash; ``before``: those of earlier calls, of drives not given too."""
    roles = dict(before)
    count = Counter(roles[c.signals_sha256] for c in candidates if c.signals_sha256 in roles)

    def lack(role: str) -> tuple[float, float]:
        return min(count[role] / LEAST[role], 1.0), count[role] / SHARES[role]

    new = {c.signals_sha256: c for c in candidates if c.signals_sha256 not in roles}
    for key in sorted(new, key=lambda k: hashlib.sha256(f"{seed}:{k}".encode()).digest()):
        roles[key] = min(new[key].allowed, key=lack)
        count[roles[key]] += 1
    return roles
