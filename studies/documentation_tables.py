"""Tables of the documentation that are made of the code when the site is built: a hook of MkDocs.

In a page, ``<!-- table: metrics -->`` becomes the table of all metrics; ``checks``, ``settings``, ``sensors`` and
``assumed_values`` are the others.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields
from typing import Any

from pdhef_logtool.car.assumed_values import RULES
from pdhef_logtool.car.vehicle import Sensors
from pdhef_logtool.drive.check_table import TABLE
from pdhef_logtool.evaluation.metrics import registry as metrics
from pdhef_logtool.runs.config import RunConfig


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Return a page with its tables; raises KeyError for one of an unknown name."""
    return re.sub(r"<!-- table: (\w+) -->", lambda match: "\n".join(_TABLES[match[1]]()), markdown)


def _metrics() -> Iterator[str]:
    yield "| metric | label | unit | best | definition |"
    yield "| --- | --- | --- | --- | --- |"
    for m in metrics.registered().values():
        unit = "that of the signal" if m.unit is None else m.unit
        yield f"| `{m.name}` | {m.label} | {unit} | {m.direction or '–'} | {m.definition} |"


def _checks() -> Iterator[str]:
    yield "| check | compares | fails where | remedy |"
    yield "| --- | --- | --- | --- |"
    for name, entry in TABLE.items():
        remedy = re.sub(r"{\w+(:[^}]*)?}", "…", entry["remedy"])
        yield f"| `{name}` | {entry['compares']} | {entry['fails']} | {'–' if remedy == '…' else remedy} |"


def _settings() -> Iterator[str]:
    yield from _entries(RunConfig, {key.name: key.default for key in fields(RunConfig)})


def _sensors() -> Iterator[str]:
    yield from _entries(Sensors, Sensors().model_dump())


def _entries(kind: type, defaults: Mapping[str, Any]) -> Iterator[str]:
    """Yield the table of the attributes that the docstring of a class describes, with their defaults."""
    yield "| key | default | meaning |"
    yield "| --- | --- | --- |"
    described = (kind.__doc__ or "").partition("----------")[2]
    texts = dict(re.findall(r"^    (\w+) : (.*(?:\n        .*)*)", described, re.MULTILINE))
    for key, value in defaults.items():
        text = re.sub(r" \(:func:`[^`]*`\)", "", " ".join(texts[key].split())).replace("``", "`")
        default = "–" if value in (None, ()) else str(value).lower()
        yield f"| `{key}` | {default} | {text} |"


def _assumed_values() -> Iterator[str]:
    yield "| entry left out | rule | spread |"
    yield "| --- | --- | --- |"
    for rule in RULES:
        yield f"| `{rule.entry}` | {rule.text} | {rule.spread:.0%} |"


_TABLES: dict[str, Callable[[], Iterator[str]]] = {
    "metrics": _metrics,
    "checks": _checks,
    "settings": _settings,
    "sensors": _sensors,
    "assumed_values": _assumed_values,
}
