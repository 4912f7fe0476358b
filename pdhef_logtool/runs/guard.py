"""Which estimators run where none are named, and which one is the answer: chosen without truth.

See docs/method.md#selection.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import PHYSICS
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.estimators.stand_in import StandIn
from pdhef_logtool.estimators.table import all_names, spec_of
from pdhef_logtool.sinks.answer import MainFacts

if TYPE_CHECKING:
    from pdhef_logtool.evaluation.metrics import MetricRow

#: What is guarded, and by what; ``kinematic`` is none of them, for it integrates what d2 holds against an estimate.
GUARDED = "pd-hef"
SIMPLE = ("zero", "open-loop", "open-loop-calibrated", "phy-ukf", "physics")
#: On simulated drives with right and wrong files every estimate beyond 1.05 times the least d2 had at least 1.7 times
#: its sideslip error (docs/calibration.md).
FACTOR = 1.2
#: What an estimate must beat to be worth anything: no estimator at all. It needs the least and cannot drift; the
#: other naive one, ``kinematic``, follows the accelerometer's bias and is worse on half of the recorded drives.
NAIVE = "zero"
#: The main estimator is the first of these that ran, unless d2 speaks against it; else the first other one.
_BEST_FIRST = (GUARDED, PHYSICS, "phy-ukf-tuned", "phy-ukf", "open-loop-calibrated", "open-loop", "kinematic")
_LAST = (NAIVE, "gyro")


@dataclass(frozen=True, slots=True)
class Distrust:
    """An estimate contradicts the sensors more than the ``best`` of the simple ones; d2 of both in m/s."""

    best: str
    own_d2: float
    best_d2: float
    name: str = GUARDED

    @property
    def text(self) -> str:
        """What is told."""
        return (
            f"{self.name} contradicts the sensors: its d2 is {self.own_d2:.3g} m/s, that of {self.best} "
            f"{self.best_d2:.3g}; the vehicle file may be wrong"
        )


def distrust(rows: Iterable[MetricRow], name: str = GUARDED) -> Distrust | None:
    """Return what speaks against an estimate; None where nothing does, or it ran alone."""
    d2 = {r.estimator: r.value for r in rows if (r.metric, r.segment) == ("d2", "all")}
    simple = {one: d2[one] for one in SIMPLE if one in d2 and one != name}
    if name not in d2 or not simple:
        return None
    best = min(simple, key=lambda one: simple[one])
    return Distrust(best, d2[name], simple[best], name) if d2[name] > FACTOR * simple[best] else None


def default_names(car: Car, available: frozenset[str]) -> tuple[str, ...]:
    """Return the estimators that run where none are named.

    They are the main one, physics alone and the naive one; those that guard a car which no driving has proven; and
    where the log lacks what physics needs, those that do with less.

    Parameters
    ----------
    available : signals of the log.
    """
    more = set() if car.has_evidence else set(SIMPLE)
    if not spec_of(PHYSICS).needs <= available:
        more |= {"open-loop", "kinematic"}
    able = {name for name in more if spec_of(name).needs <= available}
    return tuple(name for name in all_names(car) if name in {GUARDED, PHYSICS, NAIVE, *able})


def choose_main(ran: Sequence[Estimator], rows: Iterable[MetricRow], *, proven: bool, named: bool) -> MainFacts:
    """Return the main estimator of a log and why it is; of the figures only d2 counts, which needs no truth.

    Parameters
    ----------
    ran : the estimators, at least one. rows : figures of them. proven : whether the car has evidence of driving.
    named : whether a person named the estimators; all of them are then shown.
    """
    names = [e.name for e in ran]
    others = [n for n in names if n not in (*_BEST_FIRST, *_LAST)]
    name = next(n for n in (*_BEST_FIRST, *others, *_LAST) if n in names)
    against = None if proven else distrust(rows, name)
    stands_in = next((e.estimator.name for e in ran if isinstance(e, StandIn) and e.name == name), None)
    chosen_by: Literal["evidence", "d2", "order"]
    if stands_in is not None:
        chosen_by, why = "d2", f"{name} contradicts the sensors, {stands_in} stands in its place"
    elif against is not None:
        chosen_by, why = "d2", f"{name} contradicts the sensors more than {against.best} does"
        name = against.best
    elif proven:
        chosen_by, why = "evidence", "driving with truth has proven this car"
    elif name != "kinematic" and any(r.metric == "d2" and r.estimator == name for r in rows):
        chosen_by, why = "d2", "no simple estimator agrees better with the sensors"
    else:
        chosen_by, why = "order", "the best that the log's signals allow"
    return MainFacts(
        name=name,
        chosen_by=chosen_by,
        why=why,
        distrusted=stands_in is not None or against is not None,
        stands_in=stands_in,
        naive=NAIVE if NAIVE in names else None,
        shown=names if named else [n for n in dict.fromkeys((name, PHYSICS, NAIVE)) if n in names],
        named=named,
    )
