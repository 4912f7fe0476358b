"""Render a complete HTML file from a template and figures, without external resources and without content that can run.

Texts are escaped by jinja and :func:`~pdhef_logtool.records.printable.printable`; series are base64. The page's
Content-Security-Policy allows its own scripts and style by their digests and forbids everything else.
"""

import base64
import datetime as dt
import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment
from markupsafe import Markup

from pdhef_logtool.evaluation.requirement_verdicts import joint_notes
from pdhef_logtool.evaluation.units import LABELS
from pdhef_logtool.evaluation.validation_plan import shown
from pdhef_logtool.records.printable import printable
from pdhef_logtool.records.signals import NS_PER_S, FloatArray, is_dated
from pdhef_logtool.records.version import __version__
from pdhef_logtool.reports.charts import Charts
from pdhef_logtool.results import selected_estimate
from pdhef_logtool.results.selected_estimate import assumptions_of, failed_checks, result_of
from pdhef_logtool.storage.templates import environment

_HERE = Path(__file__).parent
#: Scripts in order: before.js sets the drawing resolution for uPlot.
_SCRIPTS = ("before.js", "uplot.min.js", "report.js")
_STYLES = ("uplot.min.css", "report.css")
#: Maximum length of a text in a paragraph or table cell.
_MOST_SIGNS = 600
DASH = "–"
_UNIT = re.compile(r"_(rad_s|rad|m_s2|m_s)$")
#: The interval in brackets after a value.
_BRACKETS = re.compile(r"^\((.*?)\)")


def render(template: str, charts: Charts | None = None, **texts: Any) -> bytes:
    """Return a page.

    Parameters
    ----------
    template : file of ``templates/`` that extends ``base.html``. charts : figures for its ``figure(key)`` places.
    texts : variables of the template.
    """
    charts = Charts() if charts is None else charts
    document, blocks = charts.document()
    scripts = [_asset(name) for name in _SCRIPTS]
    style = "\n".join(_asset(name) for name in _STYLES)
    page = _environment().get_template(template)
    html = page.render(
        **texts,
        figure=partial(_place, charts),
        policy=_policy(scripts, style),
        scripts=[Markup(s) for s in scripts],  # noqa: S704 (files of this package)
        style=Markup(style),  # noqa: S704
        licence=Markup(_asset("UPLOT-LICENSE")),  # noqa: S704
        document=_embedded(document),
        blocks={name: Markup(text) for name, text in blocks.items()},  # noqa: S704 (base64)
        tool=f"pdhef-logtool {__version__}",
    )
    return html.encode("utf-8", "backslashreplace")


@cache
def _environment() -> Environment:
    made = environment(_HERE / "templates")
    made.finalize = _printed
    of_results = result_of, assumptions_of, failed_checks, joint_notes, shown
    of_numbers = number, duration, degrees, percent, stamp
    made.filters |= {function.__name__: function for function in (*of_results, *of_numbers)} | {
        "reason": _reason,
        "change": partial(percent, sign="+"),
        "seconds": lambda value_s: DASH if value_s is None else f"{value_s:.3f} s",
        "minute": lambda stamp_ns: f"{stamp(stamp_ns)[:16].replace('T', ' ')} UTC" if is_dated(stamp_ns) else "",
        "range": _range,
        "signal": _signal,
        "topic_of": lambda source: str(source).partition(".")[0],
    }
    made.tests["topic"] = lambda source: str(source).startswith("/")
    return made


def _reason(requirement: Mapping[str, Any]) -> str:
    """Return the reason of a verdict without its value, which is shown beside it."""
    value = "" if requirement["value"] is None else shown(requirement["value"], str(requirement["unit"]))
    return _BRACKETS.sub(r"\1", str(requirement["reason"]).removeprefix(value).lstrip("; "))


def _signal(name: str) -> str:
    """Return the name of a sensor signal for display."""
    if name.startswith("wheel_speed_"):
        return "wheel speeds"
    return LABELS.get(name, _UNIT.sub("", name).replace("_", " ").replace("ax", "a_x"))


@cache
def _asset(name: str) -> str:
    return (_HERE / "assets" / name).read_text(encoding="utf-8").replace("\r\n", "\n")


def _place(charts: Charts, key: str) -> Markup:
    """Return the element in which the script draws a figure; empty if the page has no such figure."""
    if key not in charts.figures:
        return Markup()
    return Markup(_environment().get_template("figure.html").render(f=charts.figures[key], key=key))  # noqa: S704


def _range(values: Sequence[float] | FloatArray) -> str:
    """Return the finite range of values as text."""
    finite = np.asarray(values, dtype=np.float64)
    finite = finite[np.isfinite(finite)]
    return f"{finite.min():.3g} to {finite.max():.3g}" if finite.size else "no value"


def _policy(scripts: list[str], style: str) -> Markup:
    of_scripts = " ".join(f"'sha256-{_digest(s)}'" for s in scripts)
    return Markup(  # noqa: S704 (digests)
        f"default-src 'none'; script-src {of_scripts}; style-src 'sha256-{_digest(style)}'; img-src data:; "
        f"base-uri 'none'; form-action 'none'"
    )


def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii")


def _embedded(document: dict[str, Any]) -> Markup:
    """Return JSON for a script element, without characters that have a meaning in HTML."""
    text = json.dumps(document, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return Markup(text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026"))  # noqa: S704


def _printed(value: Any) -> Any:
    """Return the printed form of a value: a dash for None, texts in one line without control characters."""
    if value is None:
        return DASH
    if isinstance(value, str) and not isinstance(value, Markup):
        return printable(value, _MOST_SIGNS)
    return value


def number(value: float | None, factor: float = 1.0) -> str:
    """Return a figure with three significant digits, or all digits before the point; a dash for None."""
    if value is None or not math.isfinite(value):
        return DASH
    return f"{value * factor:.3g}" if abs(value * factor) < 1000.0 else f"{value * factor:.0f}"


def degrees(value_rad: float | None) -> str:
    """Return an angle in degrees as text, with digits by its size; a dash for None."""
    return DASH if value_rad is None or not math.isfinite(value_rad) else selected_estimate.degrees(value_rad)


def percent(share: float | None, sign: str = "") -> str:
    """Return a share in percent, with its sign if that is ``+``."""
    return DASH if share is None or not math.isfinite(share) else f"{share:{sign}.1%}"


def duration(seconds: float) -> str:
    """Return a duration for display."""
    if seconds < 120.0:
        return f"{seconds:.1f} s"
    hours = seconds / 3600.0
    return f"{seconds / 60.0:.1f} min" if hours < 2.0 else f"{hours:.1f} h" if hours < 100.0 else f"{hours:.0f} h"


def stamp(stamp_ns: int) -> str:
    """Return a stamp in nanoseconds as RFC 3339 in UTC, exact; without a date or out of their range as a number."""
    whole, rest = divmod(int(stamp_ns), NS_PER_S)
    if not is_dated(stamp_ns):
        return f"{whole}.{rest:09d} s"
    try:
        moment = dt.datetime.fromtimestamp(whole, dt.UTC)
    except (OverflowError, ValueError, OSError):
        return str(stamp_ns)
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{rest:09d}Z"
