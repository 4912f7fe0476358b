"""The verdict of a drive, a sentence a signal: the selected estimate against the best physics.

Written from the figures of a report, like :mod:`~pdhef_logtool.results.selected_estimate`, which has the other
sentences: how the estimate was selected, its interval, assumptions, and next steps.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, Literal, TypeAlias

from pdhef_logtool.evaluation.bootstrap import Interval
from pdhef_logtool.evaluation.requirement_bounds import LEAST_BLOCKS
from pdhef_logtool.evaluation.standing import JUDGED_SIGNALS, Standing
from pdhef_logtool.evaluation.units import SCORED_SIGNALS
from pdhef_logtool.evaluation.validation_plan import shown
from pdhef_logtool.results.selected_estimate import NO_SIDESLIP_RAD, SAME, TEMPLATES
from pdhef_logtool.storage.templates import one_line, template

#: ``same``: the interval of the difference lies within
#: :data:`~pdhef_logtool.results.selected_estimate.SAME` of the rival's error.
#: ``undecided``: it contains 0, or is unknown. ``alone``: no other physics ran.
Outcome: TypeAlias = Literal["better", "worse", "same", "undecided", "alone", "none"]


def verdicts_of(report: Mapping[str, Any], main: str, standings: Sequence[Standing]) -> list[dict[str, Any]]:
    """Return the verdicts of a report's document, one a signal, with the figures behind the words."""
    by_signal = {s.signal: s for s in standings}
    return [_verdict(report, main, signal, by_signal.get(signal)) for signal in JUDGED_SIGNALS]


def _verdict(report: Mapping[str, Any], main: str, signal: str, standing: Standing | None) -> dict[str, Any]:
    outcome: Outcome = "none"
    if why := _why_none(report, main, signal, standing):
        text = f"no verdict: {why}"
        standing = None
    else:
        assert standing is not None and standing.rmse is not None
        outcome = _outcome(standing)
        text = _text(standing, outcome)
    return {
        "signal": signal,
        "estimator": main,
        "outcome": outcome,
        "text": text,
        "rmse": None if standing is None else _figures(standing.rmse),
        "rival": None if standing is None else standing.rival,
        "rival_rmse": None if standing is None else standing.rival_rmse,
        "difference": None if standing is None else _figures(standing.difference),
    }


def _figures(interval: Interval | None) -> dict[str, Any] | None:
    if interval is None:
        return None
    low, high = (x if math.isfinite(x) else None for x in (interval.low, interval.high))
    return {"value": interval.value, "low": low, "high": high, "blocks": interval.blocks}


def _why_none(report: Mapping[str, Any], main: str, signal: str, standing: Standing | None) -> str:
    truth = report["truth"]
    if not truth["available"]:
        return "the log contains no ground truth"
    if signal in truth["not_independent"]:
        return "its ground truth is an input of the estimator or the estimate itself"
    if standing is None or standing.rmse is None:
        quantities = {q["name"] for q in truth["quantities"]}
        if signal not in quantities:
            return "the ground truth does not contain it"
        above = " above the low-speed limit" if signal == "sideslip_rad" else ""
        return f"its ground truth and {main} are never valid at the same time{above}"
    if signal in ("sideslip_rad", "vy_m_s") and _without_sideslip(report):
        return "the sideslip of the ground truth is 0 throughout: it is probably not measured"
    return ""


def _without_sideslip(report: Mapping[str, Any]) -> bool:
    """Whether the estimate that is 0 throughout has no error worth the name."""
    wanted = ("zero", "sideslip_rad", "all", "rmse")
    values = [m["value"] for m in report["metrics"] if tuple(m[k] for k in _KEYS) == wanted]
    return bool(values) and values[0] is not None and values[0] < NO_SIDESLIP_RAD


_KEYS = ("estimator", "signal", "segment", "metric")


def _outcome(standing: Standing) -> Outcome:
    difference = standing.difference
    if standing.rival is None or difference is None:
        return "alone"
    assert standing.rival_rmse is not None
    if difference.value == 0.0 or max(abs(difference.low), abs(difference.high)) <= SAME * standing.rival_rmse:
        return "same"
    if difference.low > 0.0:
        return "worse"
    return "better" if difference.high < 0.0 else "undecided"


@cache
def _words() -> Any:
    """Return the sentences of ``verdict.txt`` as functions."""
    context = {"shown": shown, "isfinite": math.isfinite, "LEAST_BLOCKS": LEAST_BLOCKS}
    return template(TEMPLATES / "verdict.txt", **context).module


def _text(standing: Standing, outcome: Outcome) -> str:
    """Return the error of the selected estimate and the comparison with its rival in a sentence."""
    unit, share = SCORED_SIGNALS[standing.signal], math.inf
    if standing.rival_rmse and standing.difference is not None:
        share = abs(standing.difference.value) / standing.rival_rmse
    error, against = _words().error(standing, unit), _words().against(standing, outcome, unit, share)
    return f"{one_line(error)}; {one_line(against)}"
