"""Tables of the documentation that are made of the code: ``python -m studies.documentation_tables`` writes them.

A table is between ``<!-- table: metrics -->`` and ``<!-- end -->``; the names of the others are in :data:`_TABLES`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, fields
from functools import partial
from typing import Any

from pdhef_logtool.car.assumed_values import RULES
from pdhef_logtool.car.vehicle import Sensors
from pdhef_logtool.drive.check_table import TABLE
from pdhef_logtool.estimators.table import SPECS
from pdhef_logtool.evaluation.metrics import metric as metrics
from pdhef_logtool.logs.resource_limits import ResourceLimits
from pdhef_logtool.results.opened_run import TABLES
from pdhef_logtool.results.parquet_sink import load_schema
from pdhef_logtool.runs.config import RunConfig
from studies.pages import DOCS, table, write
from truthsim.manoeuvres import MANOEUVRES
from truthsim.sensors import SensorNoise


def with_tables(markdown: str) -> str:
    """Return a page with its tables; raises KeyError for one of an unknown name."""

    def made(match: re.Match[str]) -> str:
        head, rows = _TABLES[match[2]]
        body = ([cell.replace("|", "&#124;") for cell in row] for row in rows())
        return f"{match[1]}\n\n{table(head, body)}\n\n{match[3]}"

    return re.sub(r"(<!-- table: (\w+) -->).*?(<!-- end -->)", made, markdown, flags=re.DOTALL)


def _metrics() -> Iterator[tuple[str, ...]]:
    for m in metrics.registered().values():
        unit = "that of the signal" if m.unit is None else m.unit
        yield f"`{m.name}`", m.label, unit, m.direction or "–", m.definition


def _estimators() -> Iterator[tuple[str, ...]]:
    for spec in SPECS:
        needs = [*sorted(spec.needs), " or ".join(sorted(spec.one_of))]
        yield f"`{spec.name}`", spec.text, ", ".join(filter(None, needs))


def _checks() -> Iterator[tuple[str, ...]]:
    for name, entry in TABLE.items():
        remedy = re.sub(r"{\w+(:[^}]*)?}", "…", entry["remedy"])
        yield f"`{name}`", entry["compares"], entry["fails"], "–" if remedy == "…" else remedy


def _entries(kind: type, defaults: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """Yield a row for each attribute that the docstring of a class describes, with its default."""
    described = (kind.__doc__ or "").partition("----------")[2]
    texts = dict(re.findall(r"^    (\w+) : (.*(?:\n        .*)*)", described, re.MULTILINE))
    for key, value in defaults.items():
        text = re.sub(r" \(:func:`[^`]*`\)", "", " ".join(texts[key].split())).replace("``", "`")
        number = f"{value:,}" if type(value) is int else f"{value:.4g}" if isinstance(value, float) else ""
        yield f"`{key}`", "–" if value in (None, ()) else number or str(value).lower(), text


def _tables() -> Iterator[tuple[str, ...]]:
    for name in TABLES:
        schema = load_schema(f"{name}.parquet.json")
        yield f"`{name}`", schema["title"].partition(": ")[2], ", ".join(f"`{c['name']}`" for c in schema["columns"])


def _columns(name: str) -> Iterator[tuple[str, ...]]:
    for column in load_schema(f"{name}.parquet.json")["columns"]:
        yield f"`{column['name']}`", column["unit"], column["description"]


_TABLES: dict[str, tuple[str, Callable[[], Iterable[tuple[str, ...]]]]] = {
    "metrics": ("metric, label, unit, best, definition", _metrics),
    "estimators": ("name, estimate, needs", _estimators),
    "checks": ("check, compares, fails where, remedy", _checks),
    "settings": ("key, default, meaning", lambda: _entries(RunConfig, {f.name: f.default for f in fields(RunConfig)})),
    "sensors": ("key, default, meaning", lambda: _entries(Sensors, Sensors().model_dump())),
    "sensor_errors": ("name, default, meaning", lambda: _entries(SensorNoise, SensorNoise()._asdict())),
    "limits": ("limit, default, meaning", lambda: _entries(ResourceLimits, asdict(ResourceLimits()))),
    "assumed_values": (
        "entry left out, rule, spread",
        lambda: ((f"`{entry}`", rule["text"], f"{rule['spread']:.0%}") for entry, rule in RULES.items()),
    ),
    "manoeuvres": (
        "name, manoeuvre, km/h, μ",
        lambda: ((f"`{n}`", m.description, f"{m.speed_km_h:g}", f"{m.friction:g}") for n, m in MANOEUVRES.items()),
    ),
    "tables": ("table, rows, columns", _tables),
    "estimates": ("column, unit, meaning", partial(_columns, "estimates")),
    "residuals": ("column, unit, meaning", partial(_columns, "residuals")),
}  # fmt: skip


if __name__ == "__main__":
    for page in DOCS.glob("*.md"):
        text = page.read_text(encoding="utf-8")
        if (made := with_tables(text)) != text:
            write(page, made)
