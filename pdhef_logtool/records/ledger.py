"""Counts of the samples of each mapped signal in a log: used, or dropped for a named reason."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from pdhef_logtool.records.signals import Loss

Role = Literal["signal", "truth"]

#: Reasons that mean damage by a failed recorder, clock or device. The other reasons are choices of the user or lose no
#: information: ``out-of-range`` (limits of the mapping), ``truth-quality`` (its gate), ``outside-slice``, ``repeated``
#: (the same value at the same stamp), ``not-needed`` (another source is used).
DAMAGE = frozenset(
    {"nan", "bad-stamp", "duplicate-stamp", "late", "time-jump", "outlier", "other-epoch", "short-frame", "not-read"}
)
#: If a source loses a larger share of its samples by damage, the exit code is 3.
DAMAGED_SHARE = 0.01


@dataclass(frozen=True, slots=True)
class SampleCount:
    """The samples of one mapped source.

    Attributes
    ----------
    role, name : of the signal. source : ``/topic.field``. stamp : source of the time stamps, ``log_time`` if the
        message's stamps are unusable.
    total : messages of the topic in the log. used, dropped : samples; together they are the total.
    """

    role: Role
    name: str
    source: str
    stamp: str
    total: int
    used: int
    dropped: Mapping[str, int] = field(default_factory=dict)

    @property
    def damaged(self) -> int:
        """Samples dropped for damage."""
        return sum(n for reason, n in self.dropped.items() if reason in DAMAGE)


def damage(samples: Iterable[SampleCount]) -> list[Loss]:
    """Return the losses of sources that lost more than ``DAMAGED_SHARE``; losses of the same kind are merged."""
    by_reason: dict[str, list[SampleCount]] = {}
    for s in samples:
        if s.damaged > DAMAGED_SHARE * s.total:
            why = ", ".join(f"{n} {reason}" for reason, n in sorted(s.dropped.items()) if reason in DAMAGE)
            by_reason.setdefault(f"{s.damaged} of {s.total} samples are not used ({why})", []).append(s)
    return [
        Loss("dropped-samples", what, ", ".join(dict.fromkeys(s.source for s in of)), count=sum(s.damaged for s in of))
        for what, of in by_reason.items()
    ]
