"""The verdict of a drive, a sentence a signal: the selected estimate against the best physics.

Written from the figures of a report, like :mod:`~pdhef_logtool.results.selected_estimate`, which has the other
sentences: how the estimate was selected, its interval, what was assumed, what to do next.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeAlias

from pdhef_logtool.evaluation.bootstrap import Interval
from pdhef_logtool.evaluation.standing import JUDGED_SIGNALS, LEAST_BLOCKS, Standing
from pdhef_logtool.evaluation.units import SCORED_SIGNALS, read_unit
from pdhef_logtool.results.selected_estimate import NO_SIDESLIP_RAD, SAME

#: ``same``: the interval of the difference lies within
#: :data:`~pdhef_logtool.results.selected_estimate.SAME` of the rival's error.
#: ``undecided``: it contains 0, or there is none. ``alone``: no other physics ran.
Outcome: TypeAlias = Literal["better", "worse", "same", "undecided", "alone", "none"]


def verdicts_of(report: Mapping[str, Any], main: str, standings: Sequence[Standing]) -> list[dict[str, Any]]:
    """Return the verdicts of a report's document, one a signal, with the figures behind the words."""
    by_signal = {s.signal: s for s in standings}
    return [_verdict(report, main, signal, by_signal.get(signal)) for signal in JUDGED_SIGNALS]


def _verdict(report: Mapping[str, Any], main: str, signal: str, found: Standing | None) -> dict[str, Any]:
    outcome: Outcome = "none"
    if why := _why_none(report, main, signal, found):
        text = f"no verdict: {why}"
        found = None
    else:
        assert found is not None and found.rmse is not None
        outcome = _outcome(found)
        text = "; ".join([_error(found), _against(found, outcome)])
    return {
        "signal": signal,
        "estimator": main,
        "outcome": outcome,
        "text": text,
        "rmse": None if found is None else _figures(found.rmse),
        "rival": None if found is None else found.rival,
        "rival_rmse": None if found is None else found.rival_rmse,
        "difference": None if found is None else _figures(found.difference),
    }


def _figures(found: Interval | None) -> dict[str, Any] | None:
    if found is None:
        return None
    low, high = (x if math.isfinite(x) else None for x in (found.low, found.high))
    return {"value": found.value, "low": low, "high": high, "blocks": found.blocks}


def _why_none(report: Mapping[str, Any], main: str, signal: str, found: Standing | None) -> str:
    truth = report["truth"]
    if not truth["available"]:
        return "the log contains no ground truth"
    if signal in truth["not_independent"]:
        return "its ground truth is an input of the estimator or the estimate itself"
    if found is None or found.rmse is None:
        known = {q["name"] for q in truth["quantities"]}
        if signal not in known:
            return "the ground truth does not contain it"
        return f"its ground truth and {main} are never valid at the same time"
    if signal in ("sideslip_rad", "vy_m_s") and _without_sideslip(report):
        return "the sideslip of the ground truth is 0 throughout: it is probably not measured"
    return ""


def _without_sideslip(report: Mapping[str, Any]) -> bool:
    """Whether the estimate that is 0 throughout has no error worth the name."""
    wanted = ("zero", "sideslip_rad", "all", "rmse")
    found = [m["value"] for m in report["metrics"] if tuple(m[k] for k in _KEYS) == wanted]
    return bool(found) and found[0] is not None and found[0] < NO_SIDESLIP_RAD


_KEYS = ("estimator", "signal", "segment", "metric")


def _outcome(found: Standing) -> Outcome:
    difference = found.difference
    if found.rival is None or difference is None:
        return "alone"
    assert found.rival_rmse is not None
    if difference.value == 0.0 or max(abs(difference.low), abs(difference.high)) <= SAME * found.rival_rmse:
        return "same"
    if difference.low > 0.0:
        return "worse"
    return "better" if difference.high < 0.0 else "undecided"


def _unit(signal: str) -> tuple[str, float]:
    """Return the unit that people read as it follows a number, and the factor to it."""
    unit, factor = read_unit(SCORED_SIGNALS[signal])
    return unit if unit.startswith("°") else f" {unit}", factor


def _error(found: Standing) -> str:
    unit, factor = _unit(found.signal)
    assert found.rmse is not None
    shown = _number(found.rmse.value * factor)
    if math.isfinite(found.rmse.low):
        low, high = _number(found.rmse.low * factor), _number(found.rmse.high * factor)
        between = f" (95 % CI {low} to {high}{unit})"
    else:
        between = f" (no CI: it needs {LEAST_BLOCKS} blocks of {found.block_s:g} s)"
    return f"RMSE of {found.estimator}: {shown}{unit}{between}"


def _against(found: Standing, outcome: Outcome) -> str:
    if outcome == "alone":
        return "no filter without a network ran for comparison"
    unit, factor = _unit(found.signal)
    assert found.rival_rmse is not None and found.difference is not None and found.rmse is not None
    beside = f"{found.rival} ({_number(found.rival_rmse * factor)}{unit})"
    if outcome == "same":
        return f"{'equal to' if found.difference.value == 0.0 else 'no relevant difference to'} {beside}"
    difference = found.difference
    share = abs(difference.value) / found.rival_rmse if found.rival_rmse else math.inf
    by = f"{share:.0%} " if share < 10.0 else ""
    how = f"{by}{'lower' if difference.value < 0.0 else 'higher'} than {beside}"
    if not math.isfinite(difference.low):
        return f"{how}, difference not tested"
    low, high = (_number(x * factor, sign="+") for x in (difference.low, difference.high))
    between = f"95 % CI of the difference {low} to {high}{unit}"
    return f"{how}, difference not significant: {between}" if outcome == "undecided" else f"{how}: {between}"


def _number(value: float, sign: str = "-") -> str:
    """Return a figure with as many digits as a person reads; ``sign`` ``+`` shows it always."""
    return f"{value:{sign}.3f}" if abs(value) < 1.0 else f"{value:{sign}.2f}"
