"""Tables of the documentation that are made of the code: ``python -m studies.documentation_tables`` writes them.

A table is between ``<!-- table: metrics -->`` and ``<!-- end -->``; ``documentation_tables.md`` contains all.
"""

import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, fields
from functools import cache
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
from studies.pages import DOCS, blocks, write
from truthsim.manoeuvres import MANOEUVRES
from truthsim.sensors import SensorNoise


def with_tables(markdown: str) -> str:
    """Return a page with its tables; raises KeyError for one of an unknown name."""
    pattern = re.compile(r"(<!-- table: (\w+) -->).*?(<!-- end -->)", re.DOTALL)
    return pattern.sub(lambda match: f"{match[1]}\n\n{made_tables()[match[2]]}\n\n{match[3]}", markdown)


@cache
def made_tables() -> dict[str, str]:
    """Return all tables by name."""
    return blocks(
        __file__,
        metrics=metrics.registered().values(),
        specs=SPECS,
        checks=TABLE,
        remedies={name: re.sub(r"{\w+(:[^}]*)?}", "…", entry["remedy"]) for name, entry in TABLE.items()},
        settings=_entries(RunConfig, {f.name: f.default for f in fields(RunConfig)}),
        sensors=_entries(Sensors, Sensors().model_dump()),
        sensor_errors=_entries(SensorNoise, SensorNoise()._asdict()),
        limits=_entries(ResourceLimits, asdict(ResourceLimits())),
        rules=RULES,
        manoeuvres=MANOEUVRES,
        tables=TABLES,
        schemas={name: load_schema(f"{name}.parquet.json") for name in (*TABLES, "estimates", "residuals")},
    )


def _entries(kind: type, defaults: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    """Yield a row for each attribute that the docstring of a class describes, with its default."""
    described = (kind.__doc__ or "").partition("----------")[2]
    texts = dict(re.findall(r"^    (\w+) : (.*(?:\n        .*)*)", described, re.MULTILINE))
    for key, value in defaults.items():
        text = re.sub(r" \(:func:`[^`]*`\)", "", " ".join(texts[key].split())).replace("``", "`")
        number = f"{value:,}" if type(value) is int else f"{value:.4g}" if isinstance(value, float) else ""
        yield key, "–" if value in (None, ()) else number or str(value).lower(), text


if __name__ == "__main__":
    for page in DOCS.glob("*.md"):
        text = page.read_text(encoding="utf-8")
        if (made := with_tables(text)) != text:
            write(page, made)
