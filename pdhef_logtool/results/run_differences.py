"""Differences of two runs besides figures: cars, mappings, signals, ground truth, configuration, versions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import partial
from typing import Any

from pdhef_logtool.records.printable import listed
from pdhef_logtool.results.opened_run import OpenedRun
from pdhef_logtool.results.pairing import Pair
from pdhef_logtool.results.selected_estimate import TEMPLATES
from pdhef_logtool.storage.templates import template

#: Of each kind of difference, how many are named.
_MOST_NAMED = 3
_DIGITS = 8


def run_differences(a: OpenedRun, b: OpenedRun, pairs: Sequence[Pair]) -> tuple[str, ...]:
    """Return other possible causes of changed figures of two runs' pairs, a line each."""

    def changed(key: str) -> list[Pair]:
        return [pair for pair in pairs if pair.same(key) is False]

    names = [p for p in pairs if p.by == "name" and p.same("signals_sha256") is not False and not p.same_file]
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
