"""Account of every sample of a mapped signal in a log: used, or dropped for a named reason."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal

from pdhef_logtool.records.signals import Loss

Role = Literal["signal", "truth"]

#: Reasons that mean damage: the recorder, a clock or a device failed. The others are choices of the user, or nothing
#: is gone with them: ``out-of-range`` (limits of the mapping), ``truth-quality`` (its gate), ``outside-slice``,
#: ``repeated`` (the same value under the same stamp), ``not-needed`` (another source is used).
DAMAGE = frozenset(
    {"nan", "bad-stamp", "duplicate-stamp", "late", "time-jump", "outlier", "other-epoch", "short-frame", "not-read"}
)
#: A larger share of a source's samples dropped for damage makes the exit code 3.
DAMAGED_SHARE = 0.01


@dataclass(frozen=True, slots=True)
class SampleCount:
    """The samples of one mapped source.

    Attributes
    ----------
    role, name : of the signal. source : ``/topic.field``. stamp : what gives its time, ``log_time`` where its own
        stamps cannot be used.
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
    """Return the losses of sources that lost more than ``DAMAGED_SHARE``; those of the same kind become one."""
    by_reason: dict[str, list[SampleCount]] = {}
    for s in samples:
        if s.damaged > DAMAGED_SHARE * s.total:
            why = ", ".join(f"{n} {reason}" for reason, n in sorted(s.dropped.items()) if reason in DAMAGE)
            by_reason.setdefault(f"{s.damaged} of {s.total} samples are not used ({why})", []).append(s)
    return [
        Loss("dropped-samples", what, ", ".join(dict.fromkeys(s.source for s in of)), count=sum(s.damaged for s in of))
        for what, of in by_reason.items()
    ]
