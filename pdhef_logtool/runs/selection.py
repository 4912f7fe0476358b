"""Estimator selection without ground truth: the estimators of a run by default, and the selected estimate.

See docs/method.md#selection.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import PHYSICS
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.estimators.table import all_names, spec_of
from pdhef_logtool.records.tracks import REFERENCE
from pdhef_logtool.results.selected_estimate import MainFacts

if TYPE_CHECKING:
    from pdhef_logtool.evaluation.metrics import MetricRow

#: The preferred estimator, and those it is checked against: models that explain the yaw rate by the steering. ``zero``
#: agrees with an accelerometer near the rear axle, and ``kinematic`` integrates the residual that ``d2`` measures.
PREFERRED = "pd-hef"
SIMPLE = ("open-loop", "open-loop:calibrated", "phy-ukf", "physics")
#: On simulated drives with right and wrong files any estimate beyond 1.05 times the least ``d2`` had at least 1.7 times
#: its sideslip error (docs/calibration.md).
FACTOR = 1.2
#: The baseline of every score. It needs the fewest signals and cannot drift; ``kinematic`` follows the accelerometer's
#: bias and has a higher error on half of the recorded drives.
NAIVE = "zero"
#: The selected estimate is the first of these that ran, unless ``d2`` contradicts it; without any, the first other one.
_BEST_FIRST = (PREFERRED, PHYSICS, "phy-ukf:tuned", "phy-ukf", "open-loop:calibrated", "open-loop", "kinematic")
_LAST = (NAIVE, "zero:no-lateral", REFERENCE)


@dataclass(frozen=True, slots=True)
class Contradiction:
    """An estimate whose ``d2`` exceeds that of the ``best`` simple estimator by over :data:`FACTOR`; both in m/s."""

    best: str
    own_d2: float
    best_d2: float
    name: str = PREFERRED

    @property
    def text(self) -> str:
        """The warning of the report."""
        return (
            f"{self.name} contradicts the sensors: its lateral kinematic consistency is {self.own_d2:.3g} m/s, "
            f"that of {self.best} {self.best_d2:.3g}; the vehicle file may be wrong"
        )


def contradiction(rows: Iterable[MetricRow], name: str = PREFERRED) -> Contradiction | None:
    """Return how ``d2`` contradicts an estimate; None if it does not, or without a simple estimator to compare with."""
    d2 = {r.estimator: r.value for r in rows if (r.metric, r.segment) == ("d2", "all")}
    simple = {other: d2[other] for other in SIMPLE if other in d2 and other != name}
    if name not in d2 or not simple:
        return None
    best = min(simple, key=lambda other: simple[other])
    return Contradiction(best, d2[name], simple[best], name) if d2[name] > FACTOR * simple[best] else None


def _fails(rows: Iterable[MetricRow], name: str) -> bool:
    """Return whether sideslip 0 agrees better with the sensors, at their estimated positions, than an estimate."""
    d2 = {r.estimator: r.value for r in rows if (r.metric, r.segment) == ("d2", "all")}
    return name in d2 and NAIVE in d2 and name != NAIVE and d2[name] > FACTOR * d2[NAIVE]


def default_names(car: Car, available: frozenset[str]) -> tuple[str, ...]:
    """Return the estimators that run where none are named.

    These are the preferred one, physics alone and the baseline; the simple ones for a car without validation data; and,
    where the log lacks signals that physics needs, those that need fewer.

    Parameters
    ----------
    available : signals of the log.
    """
    more = set() if car.has_evidence else set(SIMPLE)
    if not spec_of(PHYSICS).needs <= available:
        more |= {"open-loop", "kinematic"}
    able = {name for name in more if spec_of(name).needs <= available}
    return tuple(name for name in all_names(car) if name in {PREFERRED, PHYSICS, NAIVE, *able})


def candidates(car: Car, available: frozenset[str]) -> tuple[str, ...]:
    """Return the estimators that the selected estimate is chosen from, whichever of them a user asks for."""
    return default_names(car, available)


def choose_main(ran: Sequence[Estimator], rows: Iterable[MetricRow], *, proven: bool, named: bool) -> MainFacts:
    """Return the selected estimator of a log and why; of the figures only ``d2`` counts, which needs no ground truth.

    Parameters
    ----------
    ran : the estimators, at least one. rows : figures of them. validated : whether the car has evidence of driving.
    named : whether a person named the estimators; all of them are then shown.
    """
    names = [e.name for e in ran]
    others = [n for n in names if n not in (*_BEST_FIRST, *_LAST)]
    name = next(n for n in (*_BEST_FIRST, *others, *_LAST) if n in names)
    rows = list(rows)
    against = None if proven else contradiction(rows, name)
    chosen_by: Literal["evidence", "d2", "order"]
    if against is not None:
        chosen_by, why = "d2", f"{name} contradicts the sensors more than {against.best} does"
        name = against.best
    elif proven:
        chosen_by, why = "evidence", "driving with ground truth has validated this car"
    elif name != "kinematic" and any(r.metric == "d2" and r.estimator == name for r in rows):
        chosen_by, why = "d2", "no simple estimator agrees better with the sensors"
    else:
        chosen_by, why = "order", "the best that the log's signals allow"
    fails = not proven and _fails(rows, name)
    if fails:
        why = f"no estimate agrees with the sensors as well as sideslip 0 does; {name} is the least bad one"
    return MainFacts(
        name=name,
        chosen_by=chosen_by,
        why=why,
        distrusted=against is not None or fails,
        naive=NAIVE if NAIVE in names else None,
        shown=names if named else [n for n in dict.fromkeys((name, PHYSICS, NAIVE)) if n in names],
        named=named,
    )
