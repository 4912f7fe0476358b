"""The commented example of a validation plan, and the conversion of earlier thresholds.toml and gate.toml."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pdhef_logtool.evaluation.metrics.registry import registered
from pdhef_logtool.evaluation.segments import SEGMENTS
from pdhef_logtool.evaluation.units import SIGNALS, share_of, typed_unit
from pdhef_logtool.evaluation.validation_plan import AT_LEAST, MEANS, SQUARES, WORST_DRIVE, comparable, plan_from_dict
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.storage.documents import read_toml

EXAMPLE = f"""\
# Validation plan of pdhef. Use: pdhef run LOGS -o OUT --plan plan.toml
# Each requirement gets PASS, FAIL or INCONCLUSIVE by the confidence interval of its value over drives
# (below five drives: over blocks of 10 s within them). Exit code 4: a requirement failed.
# signal: {", ".join(SIGNALS)}
{textwrap.fill(", ".join(SEGMENTS), 110, initial_indent="# segment: ", subsequent_indent="# ", break_on_hyphens=False)}
title = "Sideslip of the sedan"

[[requirement]]
id = "SR-1"                        # unique
title = "Sideslip in all driving"
signal = "sideslip_rad"
metric = "rmse"                    # also mae, bias, coverage95, availability, p95_abs, max_abs, ...
limit_deg = 0.5                    # or limit (SI unit), or limit_deg_s for rates
exposure_minutes = 1.0             # less scored driving is INCONCLUSIVE; also exposure_drives, exposure_km
# estimator = "pd-hef"             # default: the selected estimate
# confidence = 0.95                # of the two-sided interval that decides
# exposure = [{{ speed_m_s = [20.0, 35.0], minutes = 10.0 }}]  # conditions: also ay_m_s2, friction, car; drives

[[requirement]]
id = "SR-2"
title = "Sideslip at the limit"
signal = "sideslip_rad"
segment = "nonlinear"              # or manoeuvre = "slalom"
limit_deg = 1.0

[[requirement]]
id = "SR-3"
title = "Better than zero sideslip"
signal = "sideslip_rad"
baseline = "zero"                  # or "physics"; "run": run A of pdhef compare A B --plan; "../before": an output
max_ratio = 0.5                    # the error is at most half of the baseline's

[[requirement]]
id = "SR-4"
title = "No bad drive"
signal = "sideslip_rad"
metric = "p95_abs"
statistic = "worst drive"          # or "quantile 0.9" (of the drives), or "pooled" (default)
limit_deg = 2.0

[[requirement]]
id = "SR-5"
title = "The stated interval contains the ground truth"
signal = "sideslip_rad"
metric = "coverage95"
limit = 0.90                       # a minimum
"""


def converted(path: Path) -> str:
    """Return the plan of a thresholds.toml or gate.toml as TOML; what has no counterpart becomes a comment.

    Raises
    ------
    UsageError : The file cannot be read, or contains neither thresholds nor figures.
    """
    raw = read_toml(path, "a thresholds or gate TOML file", UsageError)
    tables = [("threshold", _threshold, t) for t in _tables(raw, "threshold")]
    tables += [("figure", _figure, t) for t in _tables(raw, "figure")]
    if not tables:
        raise UsageError(expected="[[threshold]] or [[figure]] tables", got=", ".join(raw) or "none", where=str(path))
    lines = [f"# Converted from {path.name}. Limits now apply to the selected estimate unless estimator names another."]
    for number, (kind, convert, table) in enumerate(tables, 1):
        entries, problem = convert(table)
        if problem:
            lines += ["", f"# {kind} {number} has no counterpart ({problem}): {json.dumps(table, default=str)}"]
        else:
            lines += ["", "[[requirement]]", f'id = "R{number}"', *_toml(entries)]
    text = "\n".join(lines) + "\n"
    if "[[requirement]]" not in text:
        raise UsageError(expected="a table that can be converted", got="none", where=str(path))
    return text


def _tables(raw: Mapping[str, Any], key: str) -> Sequence[Mapping[str, Any]]:
    tables = raw.get(key, [])
    return [t for t in tables if isinstance(t, dict)] if isinstance(tables, list) else []


def _toml(entries: Mapping[str, Any]) -> Iterator[str]:
    yield from (f"{key} = {json.dumps(value)}" for key, value in entries.items())


def _common(table: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    """Return the entries that both kinds share, and why the table has no counterpart."""
    metric, signal = str(table.get("metric", "rmse")), str(table.get("signal", "sideslip_rad"))
    if metric not in comparable() or signal not in SIGNALS:
        return {}, f"{signal} {metric} cannot be limited"
    entries: dict[str, Any] = {"signal": signal, "metric": metric}
    name = str(table.get("estimator", "*"))
    if not set("*?[") & set(name) and name != "main":
        entries["estimator"] = name
    if (segment := str(table.get("segment", "all"))) != "all":
        entries["segment"] = segment
    if metric not in SQUARES | MEANS:
        entries["statistic"] = WORST_DRIVE
    return entries, ""


def _threshold(table: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    entries, problem = _common(table)
    if problem:
        return entries, problem
    side, other = ("min", "max") if entries["metric"] in AT_LEAST else ("max", "min")
    if table.get(side) is None or (table.get(other) is not None and entries["metric"] != "bias"):
        return entries, f"a plan has no {other} for {entries['metric']}"
    native = registered()[entries["metric"]].unit_of(entries["signal"])
    unit = table.get("unit", native)
    keys = {"deg": "limit_deg", "deg/s": "limit_deg_s"}
    if unit in keys:
        entries[keys[unit]] = table[side]
    else:
        entries["limit"] = table[side] / (typed_unit(native)[1] if unit != native else 1.0)
    return _checked(entries)


def _figure(table: Mapping[str, Any]) -> tuple[dict[str, Any], str]:
    from pdhef_logtool.evaluation.validation_plan import RUN

    entries, problem = _common(table)
    if problem:
        return entries, problem
    share = table.get("max_regression", 0.0)
    if (value := share_of(str(share))) is None:
        return entries, f"max_regression {share!r} is no share"
    return _checked({**entries, "baseline": RUN, "max_ratio": round(1.0 + value, 9)})


def _checked(entries: dict[str, Any]) -> tuple[dict[str, Any], str]:
    try:
        plan_from_dict({"requirement": [{"id": "R", **entries}]}, where="")
    except UsageError as error:
        return entries, error.got
    return entries, ""
