"""Tables of the documentation that are made of the code when the site is built: a hook of MkDocs.

<!-- table: metrics -->
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Any

from pdhef_logtool.evaluation.metrics.registry import registered


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Return a page with its tables; raises KeyError for one of an unknown name."""
    return re.sub(r"<!-- table: (\w+) -->", lambda found: "\n".join(_TABLES[found[1]]()), markdown)


def _metrics() -> Iterator[str]:
    yield "| metric | label | unit | best | definition |"
    yield "| --- | --- | --- | --- | --- |"
    for m in registered().values():
        unit = "that of the signal" if m.unit is None else m.unit
        yield f"| `{m.name}` | {m.label} | {unit} | {m.direction or '–'} | {m.definition} |"


_TABLES: dict[str, Callable[[], Iterator[str]]] = {"metrics": _metrics}
