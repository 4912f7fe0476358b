"""``docs/third_party_logs.md``: the score, every log, and the wrong items by name, as in ``page.md``."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from studies.pages import template
from studies.strangers.recordings import Recording

#: Outcomes of an item, the worst first.
OUTCOMES = ("wrong, not reported", "wrong, reported", "missing", "right")
#: Groups with sound and excited logs: checks may neither fail nor stay undecided.
HELD_OUT = ("held-out", "recorders", "contact")
SOUND = ("layout", *HELD_OUT)


@dataclass(frozen=True, slots=True)
class Result:
    """Outcome of one log, or of all logs of one kind.

    Attributes
    ----------
    log : without its series. items : outcome by item, one of :data:`OUTCOMES`. wrong : source mapped by mistake.
    silent : the wrong ones that are not reported, with their sources. doubted : right ones that a sentence doubts.
    verdicts : by right item the worst verdict of its checks: ``failed``, ``undecided``, ``passed``, or ``none``.
    alarms : failed checks on right channels that are not at fault. named : whether the cause is named.
    """

    log: Recording
    items: Mapping[str, str]
    wrong: Mapping[str, str] = field(default_factory=dict)
    verdicts: Mapping[str, str] = field(default_factory=dict)
    silent: tuple[str, ...] = ()
    doubted: tuple[str, ...] = ()
    alarms: tuple[str, ...] = ()
    named: bool | None = None
    said: str = ""

    def count(self, outcome: str) -> int:
        """Return how many items ended so."""
        return sum(1 for o in self.items.values() if o == outcome)

    @property
    def undecided(self) -> list[str]:
        """Right items of which a check is undecided."""
        return [item for item, verdict in self.verdicts.items() if verdict == "undecided"]

    def as_json(self) -> dict[str, Any]:
        """Values that are stored for later comparison."""
        kept = {"items": dict(self.items), "named": self.named, "verdicts": dict(self.verdicts)}
        return {"group": self.log.group} | kept


def merged(results: Sequence[Result]) -> Result:
    """Return the logs of one kind as one: the worst of every item."""
    first = results[0]
    if len(results) == 1:
        return first
    names = list(dict.fromkeys(i for r in results for i in r.items))
    items = {n: min((r.items[n] for r in results if n in r.items), key=OUTCOMES.index) for n in names}
    named = [r.named for r in results if r.named is not None]
    log = replace(first.log, name=f"{len(results)} logs: {first.log.name.rpartition('-')[0]}")
    silent = tuple(f"{r.log.name}: {what}" for r in results for what in r.silent)
    alarms, is_named = tuple(a for r in results for a in r.alarms), all(named) if named else None
    return Result(log, items=items, silent=silent, verdicts=first.verdicts, alarms=alarms, named=is_named)


def tally(results: Iterable[Result]) -> Counter[str]:
    """Return how many items of all logs have each outcome."""
    return Counter(outcome for r in results for outcome in r.items.values())


def page(results: Sequence[Result], **context: object) -> str:
    """Return the page; ``results``: one for each kind; ``context``: the other fields of ``page.md``."""
    sound = [r for r in results if r.log.group in SOUND]
    context |= {"results": results, "held_out": HELD_OUT, "sound": SOUND, "tally": tally}
    verdicts = Counter(verdict for r in sound for verdict in r.verdicts.values())
    return template(__file__, verdicts=verdicts, doubted=sum(len(r.doubted) for r in sound), **context)
