"""``SIGNAL.sign``, ``unit``, ``axis``: each signal by relations to others (:mod:`~pdhef_logtool.drive.relations`).

Where they contradict one another, the smallest mistake that explains all of them states which signals fail.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from pdhef_logtool.drive.checks.kind import CheckKind
from pdhef_logtool.drive.measured import WHEEL_SPEEDS, Measured
from pdhef_logtool.drive.relations import (
    Mistake,
    Relation,
    best_explanation,
    contradicting,
    known_mistakes,
    smallest_explanations,
)
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.signals import GNSS

_LACKS_WHEELBASE = "needs the wheelbase of a vehicle file, or speeds that only full-size vehicles reach"
_LACKS_SIDESLIP = "needs sideslip that changes fast"
#: What a drive lacks that shows the sign of a signal and not its unit.
_LACKS_FOR_UNIT = {
    **dict.fromkeys(("steer_rad", "steering_wheel_rad"), _LACKS_WHEELBASE),
    **dict.fromkeys(("truth.vy_m_s", "truth.sideslip_rad"), _LACKS_SIDESLIP),
}
_LACKS = {
    "ax_m_s2": "speeding up and braking, on straights",
    "speed_m_s": "a wheel speed, an accelerometer or ground truth to compare with, and speeding up or bends",
}
_BENDS = "bends to both sides at speed"


def explained_factors(measured: Measured, *, mounting_is_known: bool, most: int = 2) -> dict[str, tuple[float, str]]:
    """Return by signal the factor that undoes its wrong unit or sign, with the evidence, where only one explains it.

    ``most``: mistakes at once that are accepted.
    """
    relations = measured.relations
    groups = measured.groups(mounting_is_known=mounting_is_known)
    explanations = smallest_explanations(relations, known_mistakes(list(measured.columns), groups))
    chosen = best_explanation(relations, explanations)
    if chosen is None or len(chosen) > most or not all(m.is_exact for m in chosen):
        return {}
    bad = [r for r in relations if r.tells and not r.accepts()]
    if all(r.is_near for r in bad):
        return {}
    factor_by_name = {}
    for mistake in chosen:
        for name, factor in mistake.factors.items():
            evidence = next((r.evidence for r in bad if name in r.powers), "")
            factor_by_name[name] = (factor, f"{mistake.words}: {evidence}")
    return factor_by_name


def is_wrong_by(measured: Measured, name: str, factor: float) -> bool | None:
    """Return whether the relations of a signal that count are plausible after a factor and not before; None: none."""
    mine = [r for r in measured.relations if name in r.powers and r.tells]
    if not mine:
        return None
    return all(r.accepts(factor ** r.powers[name]) for r in mine) and not all(r.accepts() for r in mine)


def relation_checks(measured: Measured, *, mounting_is_known: bool) -> tuple[Check, ...]:
    """Judge sign, unit and field of every signal that a relation is about."""
    columns, relations = measured.columns, measured.relations
    groups = measured.groups(mounting_is_known=mounting_is_known)
    # The sideslip reference compares GNSS velocity with gyro and speed itself.
    names = [n for n in columns if (n in measured.topics and not n.startswith(GNSS)) or n in _JUDGED_TRUTH]
    if "truth.sideslip_rad" in names and "truth.vy_m_s" in names:  # which is v_x times its tangent
        names.remove("truth.vy_m_s")
    explanations = smallest_explanations(relations, known_mistakes(list(columns), groups))
    likeliest, others = _mistakes_by_signal(explanations)
    culprits = set() if explanations else contradicting(relations)
    explained = _Explained(likeliest, others, bool(explanations), culprits, measured.scales)
    checks: list[Check] = []
    for name in names:
        # A wheel that contradicts others does so through the mean of the wheels, which is the speed.
        blamed = culprits | likeliest.keys() | others.keys()
        through = WHEEL_SPEEDS if name in blamed and name.startswith("wheel_speed_") else name
        mine = [r for r in relations if name in r.powers or through in r.powers]
        unrelated = [r for r in mine if r.unrelated and not _is_cleared(name, r, relations)]
        judged = _judged(name, _of(name, [r for r in mine if r.tells]), explained)
        checks += [_unrelated(name, r) for r in unrelated[:1]]
        checks += judged or ([] if unrelated else [_not_excited(name, mine)])
    return tuple(checks)


def _of(name: str, relations: list[Relation]) -> list[Relation]:
    """Return the relations without those of a wheel to the mean of the wheels, if others are left."""
    others = [r for r in relations if not {name, WHEEL_SPEEDS} >= set(r.powers)]
    return others if others and any(not r.accepts() for r in others) else relations


class _Explained(NamedTuple):
    """Mistakes by signal of the likeliest explanations and of the others, and signals to blame where there is none."""

    likeliest: Mapping[str, list[Mistake]]
    others: Mapping[str, list[Mistake]]
    is_explained: bool
    culprits: set[str]
    scales: Mapping[str, float | tuple[float, ...]]

    def scale(self, name: str, factor: float) -> str:
        """Return the line of the mapping that multiplies the scale of a signal by a factor; empty if not known."""
        scale = self.scales.get(name)
        return "" if scale is None or isinstance(scale, tuple) else f"scale = {scale * factor:.6g}"


def _judged(name: str, relations: Sequence[Relation], explained: _Explained) -> list[Check]:
    """Return sign and unit checks of a signal by the relations that count; empty without any."""
    bad, good = ([r for r in relations if r.accepts() is accepted] for accepted in (False, True))
    if name in explained.likeliest or name in explained.others:
        failed = _failed(name, explained.likeliest.get(name) or explained.others[name], bad or good, explained.scale)
        is_sure = name in explained.likeliest and not (bad and all(r.is_vague for r in bad))
        return failed if is_sure else [replace(c, verdict="undecided") for c in failed]
    if name in explained.culprits and bad:
        return [_unexplained(name, bad)]
    if good or (bad and explained.is_explained):
        usable = relations if explained.is_explained else good
        best = max(usable, key=lambda r: (len(r.powers) > 1, abs(r.correlation)))
        lacks = _LACKS_FOR_UNIT.get(name)
        if explained.is_explained and lacks and not any(r.decides_unit for r in usable):
            return [SIGN.passed(best.evidence, name), UNIT.undecided(best.evidence, name, lacks)]
        return [kind.passed(best.evidence, name) for kind in (SIGN, UNIT)]
    return [_contradicted(name, bad[0], explained.culprits)] if bad else []


def _mistakes_by_signal(
    explanations: Sequence[tuple[Mistake, ...]],
) -> tuple[dict[str, list[Mistake]], dict[str, list[Mistake]]]:
    """Return by signal the mistakes of the likeliest explanations, and those of others that explain it as well."""
    least = min((_likelihood(e) for e in explanations), default=())
    blamed: dict[str, list[Mistake]] = {}
    suspected: dict[str, list[Mistake]] = {}
    for chosen in explanations:
        by_signal = blamed if _likelihood(chosen) == least else suspected
        for mistake in chosen:
            for name in mistake.factors:
                if mistake not in by_signal.setdefault(name, []):
                    by_signal[name].append(mistake)
    return blamed, suspected


def _likelihood(explanation: tuple[Mistake, ...]) -> tuple[int, int]:
    """Return how many signals an explanation has wrong, the wheels as one, and how seldom those are."""
    signals = {"wheels" if n.startswith("wheel_speed") else n for m in explanation for n in m.factors}
    seldom = max((_OFTEN_WRONG.index(n) if n in _OFTEN_WRONG else len(_OFTEN_WRONG) for n in signals), default=0)
    return len(signals), seldom


#: Of signals that explain a contradiction equally well the first is blamed: no standard states how a steering angle
#: counts, and an axis of an IMU is turned more often than the sign of a gyro that is read from the right one.
_OFTEN_WRONG = ("steering_wheel_rad", "steer_rad", "wheels", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s")


def _unexplained(name: str, bad: Sequence[Relation]) -> Check:
    """Return the check of a signal that contradicts others by what is no known unit or sign."""
    first = next((r for r in bad if not r.is_close), bad[0])
    if first.is_close:
        remedy = "no unit or sign explains it: the car may slide, or a sensor may fail for a while"
        return UNIT.undecided(first.evidence, name, remedy)
    remedy = "no single mistake explains it: look at the field, unit and sign of " + " and ".join(first.powers)
    return UNIT.failed(first.evidence, name, remedy=remedy)


def _contradicted(name: str, relation: Relation, culprits: set[str]) -> Check:
    others = " and ".join(sorted(culprits & set(relation.powers)))
    return UNIT.undecided(relation.evidence, name, f"needs {others} that is right")


_JUDGED_TRUTH = (*(f"truth.{n}" for n in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad", "ay_m_s2")),)


def _is_cleared(name: str, unrelated: Relation, relations: Sequence[Relation]) -> bool:
    """Return whether another relation shows the signal to be right, and none does so for the others of the pair."""

    def shown(signal: str) -> bool:
        return any(r.tells and r.accepts() and signal in r.powers and r.powers != unrelated.powers for r in relations)

    paces = {"speed_m_s", WHEEL_SPEEDS, "truth.vx_m_s"}
    others = [n for n in unrelated.powers if n != name and n not in paces]
    return name in paces or (shown(name) and not all(shown(n) for n in others))


def _unrelated(name: str, relation: Relation) -> Check:
    evidence = f"{relation.text}: one moves and the other does not with it, correlation {relation.correlation:.2f}"
    return AXIS.failed(evidence, name, signal_name=name)


def _failed(
    name: str, mistakes: Sequence[Mistake], relations: Sequence[Relation], scale: Callable[[str, float], str]
) -> list[Check]:
    kinds = {m.kind for m in mistakes}
    wrong = [c for a, c in (("sign", SIGN), ("unit", UNIT)) if any(a in k for k in kinds)]
    evidence = "; ".join(r.evidence for r in relations[:2])
    factors = list(dict.fromkeys(f for m in mistakes if (f := m.factors.get(name)) is not None))
    if len(factors) == 1:
        line = scale(name, factors[0])
        words = " or ".join(dict.fromkeys(m.words for m in mistakes))
        times = f"multiply its scale in the mapping by {factors[0]:.6g}"
        remedy = f"perhaps {words}: {times}" + (f", {line}" if line else "")
    else:
        lines = [f" ({line})" if (line := scale(name, m.factors[name])) else "" for m in mistakes]
        remedy = "perhaps " + " or ".join(f"{m.words}{line}" for m, line in zip(mistakes, lines, strict=True))
    return [kind.failed(evidence, name, remedy=remedy) for kind in wrong]


def _not_excited(name: str, relations: Sequence[Relation]) -> Check:
    lacks = _LACKS.get(name, _BENDS)
    if not relations:
        evidence = "no other signal of the log is related to it"
    else:
        best = max(relations, key=lambda r: abs(r.correlation))
        evidence = f"{best.text}: correlation {best.correlation:.2f} over {best.samples:.0f} independent samples"
    return SIGN.undecided(evidence, name, f"needs {lacks}")


SIGN = CheckKind(
    "SIGNAL.sign",
    compares="a_y with v r, steering with curvature, v̇ with a_x, wheel speeds, wheel differences and the ground "
    "ground truth's path with the signals that they correspond to",
    fails="they contradict the signal by its sign",
    remedy="{remedy}",
    lacks=f"needs {_BENDS}",
    function=lambda drive: drive.related,
)
UNIT = CheckKind(
    "SIGNAL.unit",
    compares="the same as `SIGNAL.sign`",
    fails="they contradict the signal by a factor",
    remedy="{remedy}",
)
AXIS = CheckKind(
    "SIGNAL.axis",
    compares="the signal with what it must go with, and an accelerometer's mean with gravity",
    fails="it does not go with it, or gravity is in it",
    remedy="map another field or axis to {signal_name}",
)
CHECKS = (SIGN, UNIT, AXIS)
