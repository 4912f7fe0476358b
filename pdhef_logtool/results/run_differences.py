"""Differences of two runs besides figures: cars, mappings, signals, ground truth, configuration, versions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.records.printable import listed
from pdhef_logtool.results.opened_run import OpenedRun
from pdhef_logtool.results.pairing import Pair

#: Of each kind of difference, how many are named.
_MOST_NAMED = 3
_DIGITS = 8


def run_differences(a: OpenedRun, b: OpenedRun, pairs: Sequence[Pair]) -> tuple[str, ...]:
    """Return other possible causes of changed figures of two runs' pairs, a line each."""
    return (
        *_car(pairs),
        *_changed(pairs, "mapping_sha256", "mapping", "sources, scales, stamps, latencies or limits"),
        *_sources(pairs),
        *_changed(pairs, "truth_sha256", "truth", "what it held"),
        *_main(pairs),
        *_entries("configuration", a.document.get("config"), b.document.get("config")),
        *_entries("versions", a.document.get("versions"), b.document.get("versions")),
        *_outcomes(pairs),
        *_unknown(pairs),
    )


def _car(pairs: Sequence[Pair]) -> Iterator[str]:
    for what, key in (("car", "sha256"), ("network", "network_sha256")):
        changes: Counter[tuple[str, str]] = Counter()
        for pair in pairs:
            left, other = (log.entry.get("car") or {} for log in (pair.a, pair.b))
            if left.get(key) != other.get(key):
                named = what == "car"
                changes[_car_text(left, key, named), _car_text(other, key, named)] += 1
        for (one_text, other_text), count in changes.most_common(_MOST_NAMED):
            yield f"{what}: {one_text} → {other_text}{_of(count, len(pairs))}"
        if len(changes) > _MOST_NAMED:
            yield f"{what}: {len(changes) - _MOST_NAMED} more changes of this kind"


def _car_text(car: Mapping[str, Any], key: str, named: bool) -> str:
    digest = car.get(key)
    short = "none" if digest is None else str(digest)[:_DIGITS]
    return f"{car.get('name', '')} {short}".strip() if named else short


def _changed(pairs: Sequence[Pair], key: str, what: str, may_be: str) -> Iterator[str]:
    changed = [pair for pair in pairs if pair.same(key) is False]
    if changed:
        where = f"{_of(len(changed), len(pairs))}: {_names(changed)}"
        yield f"{what}: another one ({may_be}){where}{_example(changed[0], what)}"


def _sources(pairs: Sequence[Pair]) -> Iterator[str]:
    changed = [pair for pair in pairs if pair.same("signals_sha256") is False]
    if changed:
        by_name = sum(pair.by == "name" and pair.same("sha256") is not True for pair in changed)
        only = f"; {by_name} of them are one drive by their name alone" if by_name else ""
        yield f"signals: they held something else{_of(len(changed), len(pairs))}: {_names(changed)}{only}"
    blind = [pair for pair in pairs if pair.by == "name" and pair.same("signals_sha256") is not False]
    if unproven := [pair for pair in blind if pair.same("sha256") is not True]:
        where = f"{_of(len(unproven), len(pairs))}: {_names(unproven)}"
        yield f"drives: only their names indicate that they are equal{where}"


def _example(pair: Pair, what: str) -> str:
    """Return how the first changed source of a pair changed, empty where the reports do not state."""
    if what not in ("mapping", "truth"):
        return ""
    key = "signals" if what == "mapping" else "quantities"
    try:
        with pair.a.reading(), pair.b.reading():
            reports = pair.a.report(), pair.b.report()
            left, other = ({s["name"]: s["source"] for s in (r or {}).get(what, {}).get(key, ())} for r in reports)
    except OutputError as error:
        return f"; {error}"
    if None in reports:
        return ""
    for name in sorted({*left, *other}):
        if left.get(name) != other.get(name):
            return f"; {pair.a.label}: {name} of {left.get(name, 'nothing')} → {other.get(name, 'nothing')}"
    return ""


def _main(pairs: Sequence[Pair]) -> Iterator[str]:
    changes = Counter((p.a.entry["main"], p.b.entry["main"]) for p in pairs if p.same("main") is False)
    for (before, other), count in changes.most_common(_MOST_NAMED):
        yield f"selected estimate: {before} → {other}{_of(count, len(pairs))}; the one of A is compared on both sides"


def _entries(what: str, before: object, other: object) -> Iterator[str]:
    a = before if isinstance(before, dict) else {}
    b = other if isinstance(other, dict) else {}
    changed = [key for key in sorted({*a, *b}) if a.get(key) != b.get(key)]
    if changed:
        yield f"{what}: " + ", ".join(f"{key} {_value(a, key)} → {_value(b, key)}" for key in changed)


def _value(entries: Mapping[str, Any], key: str) -> str:
    value = entries.get(key)
    if value is None:
        return "not set" if key in entries else "absent"
    return ",".join(map(str, value)) or "none" if isinstance(value, list) else str(value)


def _outcomes(pairs: Sequence[Pair]) -> Iterator[str]:
    changed = [pair for pair in pairs if pair.a.outcome != pair.b.outcome]
    for pair in changed[:_MOST_NAMED]:
        yield f"outcome of {pair.a.label}: {pair.a.outcome} → {pair.b.outcome}"
    if len(changed) > _MOST_NAMED:
        yield f"outcome: {len(changed) - _MOST_NAMED} more drives ended otherwise"


def _unknown(pairs: Sequence[Pair]) -> Iterator[str]:
    unstated = sum(pair.same("signals_sha256") is None and pair.a.outcome == pair.b.outcome == "ok" for pair in pairs)
    if unstated:
        yield f"signals, ground truth, mapping: not recorded whether they are the same{_of(unstated, len(pairs))}"


def _of(count: int, pairs: int) -> str:
    return f", all {pairs} drives" if count == pairs and pairs > 1 else f", {count} of {pairs} drives"


def _names(pairs: Sequence[Pair]) -> str:
    return listed([pair.a.label for pair in pairs], _MOST_NAMED)
