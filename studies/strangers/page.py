"""Write ``docs/third_party_logs.md``: the score, every log, and the wrong items by name."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from studies.pages import table, template
from studies.strangers.recordings import Recording

#: Outcomes of an item, the worst first.
OUTCOMES = ("wrong, not reported", "wrong, reported", "missing", "right")
GROUPS = {
    "fault": "logs with a fault",
    "layout": "published layouts",
    "held-out": "held-out layouts",
    "recorders": "layouts of recorders, first contact",
    "contact": "layouts of recorders, second contact",
    "recording": "third-party recordings",
}
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


def page(results: Sequence[Result], remark: str) -> str:
    """Return the page.

    Parameters
    ----------
    results : one a kind. remark : text below the score.
    """
    others = sum(r.log.group == "recording" for r in results)
    counts = f"{len(results) - others} generated logs and {others} third-party recordings"
    parts = [template(__file__, counts=counts), "## Score\n", _score(results), _remarks(results), remark]
    for group, title in GROUPS.items():
        rows = [r for r in results if r.log.group == group]
        if rows:
            parts += [f"## {title[0].upper()}{title[1:]}\n", _logs(rows)]
    parts += ["## Wrong and questionable results\n", _wrong(results)]
    return "\n".join(parts).rstrip() + "\n"


def _score(results: Sequence[Result]) -> str:
    counted = {title: [r for r in results if r.log.group == group] for group, title in GROUPS.items()}
    counted["all except held-out layouts"] = [r for r in results if r.log.group not in HELD_OUT]
    rows = []
    for title, of in counted.items():
        outcomes = Counter(outcome for r in of for outcome in r.items.values())
        planted = [r.named for r in of if r.named is not None]
        cells = [str(len(of)), str(outcomes.total())]
        cells += [f"{outcomes['right']} ({100.0 * outcomes['right'] / max(outcomes.total(), 1):.0f} %)"]
        cells += [str(outcomes[outcome]) for outcome in ("missing", "wrong, reported", "wrong, not reported")]
        cells += [f"{sum(planted)} of {len(planted)}" if planted else "–"]
        rows += [[title, *cells]] if of else []
    head = ["logs", "count", "items", "right", "missing", "wrong, reported", "wrong, not reported", "causes named"]
    return table(head, rows, right_from=1) + "\n"


def _remarks(results: Sequence[Result]) -> str:
    sound = [r for r in results if r.log.group in SOUND]
    right = [v for r in sound for v in r.verdicts.values()]
    counts = {verdict: right.count(verdict) for verdict in ("passed", "undecided", "failed", "none")}
    doubted = sum(len(r.doubted) for r in sound)
    return (
        f"In the logs of published layouts (no fault, sufficient excitation) {len(right)} items are right. Checks of "
        f"these items: all passed for {counts['passed']}, some undecided for {counts['undecided']}, some failed for "
        f"{counts['failed']}, no check for {counts['none']}. A remark questions {doubted} of them.\n"
    )


def _logs(rows: Sequence[Result]) -> str:
    def cells(r: Result) -> list[str]:
        other = [f"{item}: {outcome}" for item, outcome in r.items.items() if outcome != "right"]
        named = {None: "", True: "yes", False: "**no**"}[r.named]
        what = f"[{r.log.what}]({r.log.page})" if r.log.page else r.log.what
        return [r.log.name, what, f"{r.count('right')} of {len(r.items)}", "; ".join(other), named]

    return table(["log", "content", "right", "other", "cause named"], map(cells, rows)) + "\n"


def _wrong(results: Sequence[Result]) -> str:
    lines = []
    checks: dict[str, Callable[[Result], Iterable[str]]] = {
        "wrong, not reported": lambda r: r.silent,
        "failed check on a right channel": lambda r: r.alarms,
        "undecided check on a right channel": lambda r: r.undecided if r.log.group in SOUND else (),
        "cause not named": lambda r: ("",) if r.named is False else (),
    }
    for title, of in checks.items():
        for r in results:
            lines += [f"- {r.log.name}: {title}{': ' + what if what else ''}" for what in of(r)]
    return "\n".join(lines) + "\n" if lines else "None.\n"
