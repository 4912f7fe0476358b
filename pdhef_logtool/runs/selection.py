"""Estimator selection without ground truth: the estimators of a run by default, and the selected estimate.

See docs/method.md#selection.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import PHYSICS
from pdhef_logtool.estimators.table import all_names, spec_of
from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.records.tracks import REFERENCE
from pdhef_logtool.results.selected_estimate import NAIVE, MainFacts

#: The preferred estimator, and those that run beside it where no driving has validated the car.
PREFERRED = "pd-hef"
SIMPLE = ("open-loop", "open-loop:calibrated", "phy-ukf", "physics")
#: The two tests: lateral consistency within this factor of the lowest one of those whose yaw consistency is within the
#: other (docs/method.md#selection).
FACTOR, YAW_FACTOR = 1.2, 3.0
#: Their lateral figures are meaningless, because they integrate the residual that ``d2`` measures.
_NOT_JUDGED = ("kinematic", "slip-ukf", "washout")
#: The selected estimate is the first of these that ran, unless ``d2`` contradicts it; without any, the first other one.
_BEST_FIRST = (PREFERRED, PHYSICS, "phy-ukf:tuned", "phy-ukf", "open-loop:calibrated", "open-loop", "kinematic")
_LAST = (NAIVE, "zero:no-lateral", REFERENCE)


class Contradiction(NamedTuple):
    """An estimate that fails the test: the ``best`` one that passes both, and the warning of the report."""

    best: str
    text: str


def contradiction(rows: Iterable[MetricRow], name: str = PREFERRED) -> Contradiction | None:
    """Return the contradiction of an estimate: a lower ``d2`` of one that passes the yaw test; None without one.

    The yaw test alone contradicts nothing: at the limit of the tyres the right sideslip can fail it. A log without
    steering has no yaw test, and then no estimate to compare with.
    """
    d2, yaw = _figures(rows)
    explain = [n for n, value in yaw.items() if n in d2 and value <= YAW_FACTOR * min(yaw.values())]
    best = min((n for n in explain if n not in (name, *_NOT_JUDGED)), key=lambda n: d2[n], default=None)
    if name not in d2 or best is None or d2[name] <= FACTOR * d2[best]:
        return None
    return Contradiction(
        best,
        f"{name} contradicts the sensors: its lateral consistency is {d2[name]:.3g} m/s and its yaw consistency "
        f"{yaw.get(name, math.nan):.3g} rad/s, those of {best} {d2[best]:.3g} and {yaw[best]:.3g}; "
        "the vehicle file may be wrong",
    )


def _figures(rows: Iterable[MetricRow]) -> tuple[dict[str, float], dict[str, float]]:
    """Return lateral and yaw consistency of a whole drive by estimator."""
    of_all = [r for r in rows if r.segment == "all"]
    d2, yaw = ({r.estimator: r.value for r in of_all if r.metric == m} for m in ("d2", "yaw_consistency"))
    return d2, yaw


def default_names(car: Car, available: frozenset[str]) -> tuple[str, ...]:
    """Return the estimators of a run that names none.

    These are the preferred one, physics alone and the baseline; the simple ones for a car without validation data; and,
    where the log lacks signals that physics needs, those that need fewer.

    Parameters
    ----------
    available : signals of the log.
    """
    more = set() if car.has_evidence else set(SIMPLE)
    if "steer_rad" not in available or spec_of(PHYSICS).lacking(available):
        more |= {"open-loop", "kinematic"}
    able = {name for name in more if not spec_of(name).lacking(available)}
    return tuple(name for name in all_names(car) if name in {PREFERRED, PHYSICS, NAIVE, *able})


def choose_main(names: Sequence[str], rows: Iterable[MetricRow], *, proven: bool, named: bool) -> MainFacts:
    """Return the selected estimator of a log and why; of the figures the consistencies count, without ground truth.

    Parameters
    ----------
    names : of the estimators that ran, at least one. rows : their figures. proven : whether driving validates the car.
    named : whether a person named the estimators; all of them are then shown.
    """
    others = [n for n in names if n not in (*_BEST_FIRST, *_LAST)]
    name = next(n for n in (*_BEST_FIRST, *others, *_LAST) if n in names)
    rows = list(rows)
    against = None if proven else contradiction(rows, name)
    if against is not None:
        why = f"{name} contradicts the sensors more than {against.best} does"
        name = against.best
    elif proven:
        why = "driving with ground truth has validated this car"
    elif name not in _NOT_JUDGED and any(r.metric == "d2" and r.estimator == name for r in rows):
        why = "no simple estimator agrees better with the sensors"
    else:
        why = "the best that the log's signals allow"
    d2, _ = _figures(rows)
    # Sideslip 0 agrees better with the sensors, at their estimated positions.
    fails = not proven and name != NAIVE and d2.get(name, 0.0) > FACTOR * d2.get(NAIVE, math.inf)
    if fails:
        why = f"no estimate agrees with the sensors as well as sideslip 0 does; {name} is the least bad one"
    return MainFacts(
        name=name,
        why=why,
        distrusted=against is not None or fails,
        naive=NAIVE if NAIVE in names else None,
        shown=names if named else [n for n in dict.fromkeys((name, PHYSICS, NAIVE)) if n in names],
        named=named,
    )
