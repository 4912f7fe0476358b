"""``SIGNAL.sign``, ``unit``, ``axis``: each signal by relations to others (:mod:`~pdhef_logtool.drive.relations`).

The posterior of all mistakes (:mod:`~pdhef_logtool.drive.hypotheses`) decides which signals fail.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from pdhef_logtool.drive.checks.kind import CheckKind
from pdhef_logtool.drive.hypotheses import FOREIGN, MOST_ENERGY, Hypothesis, Posterior, Relation, units_of
from pdhef_logtool.drive.measured import WHEEL_SPEEDS, Measured
from pdhef_logtool.drive.relations import COURSE_RATE
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.signals import GNSS

#: Probability of a mistake at which a check fails, below which it passes, and at which the mistake is corrected; least
#: share of a mistake in all mistakes of a signal to be named.
FAILS, DOUBTED, CERTAIN, NAMED = 0.85, 0.005, 0.97, 0.05
#: Remedy of an undecided check if the drive contradicts the signal and no unit or sign explains it.
UNEXPLAINED = "no unit or sign explains it: the car may slide, a sensor may fail for a while, or the field is another"
#: Beginnings of the remedies of certain or suspected mistakes.
SUSPICIONS = ("perhaps ", "no single mistake explains it", UNEXPLAINED)
_LACKS_WHEELBASE = "the wheelbase of a vehicle file, or speeds that only full-size vehicles reach"
_LACKS_SIDESLIP = "sideslip that changes fast"
#: Missing excitation if a drive shows the sign of a signal but not its unit.
_LACKS_FOR_UNIT = {
    **dict.fromkeys(("steer_rad", "steering_wheel_rad"), _LACKS_WHEELBASE),
    **dict.fromkeys(("truth.vy_m_s", "truth.sideslip_rad"), _LACKS_SIDESLIP),
}
_LACKS = {
    "ax_m_s2": "speeding up and braking, on straights",
    "speed_m_s": "a wheel speed, an accelerometer or ground truth to compare with, and speeding up or bends",
}
_BENDS = "bends to both sides at speed"
_LACKS_FOR_SIGN = "needs a path, a course, wheel speeds or a documented sign"


def explained_factors(measured: Measured, *, mounting_is_known: bool, most: int = 2) -> dict[str, tuple[float, str]]:
    """Return by signal the certain correction factor of its wrong unit or sign, with the evidence.

    ``most``: largest number of simultaneous mistakes.
    """
    probability, chosen = measured.posterior(mounting_is_known=mounting_is_known).sets[0]
    if probability < CERTAIN or len(chosen) > most or not all(h.is_exact for h in chosen):
        return {}
    bad = [r for r in measured.relations if r.tells and not r.accepts()]
    factor_by_name = {}
    for mistake in chosen:
        for name, factor in mistake.factors.items():
            evidence = next((r.evidence for r in bad if name in r.powers), "")
            factor_by_name[name] = (factor, f"{mistake.words} (probability {probability:.3f}): {evidence}")
    return factor_by_name


def relation_checks(measured: Measured, *, mounting_is_known: bool) -> tuple[Check, ...]:
    """Check sign, unit and field of every signal with a relation."""
    columns, relations = measured.columns, measured.relations
    # GNSS velocity is excluded: the sideslip reference compares it with gyro and speed.
    names = [n for n in columns if (n in measured.topics and not n.startswith(GNSS)) or n in _JUDGED_TRUTH]
    if "truth.sideslip_rad" in names and "truth.vy_m_s" in names:  # v_y is v_x times tan(sideslip)
        names.remove("truth.vy_m_s")
    probable = measured.posterior(mounting_is_known=mounting_is_known)
    checks: list[Check] = []
    for name in names:
        # A wrong wheel contradicts other signals through the mean of the wheels, which is the speed.
        through = WHEEL_SPEEDS if probable.of(name) and name.startswith("wheel_speed_") else name
        mine = [r for r in relations if name in r.powers or through in r.powers]
        unrelated = [r for r in mine if r.unrelated and not _is_cleared(name, r, relations)]
        judged = _judged(name, [r for r in mine if r.tells], probable, measured)
        for r in unrelated[:1]:
            evidence = f"{r.text}: only one of them moves, correlation {r.correlation:.2f}"
            checks.append(AXIS.failed(evidence, name, signal_name=name))
        checks += judged or ([] if unrelated else [_not_excited(name, mine)])
    return tuple(_of_place(c, *measured.positions) if c.subject == COURSE_RATE else c for c in checks)


def _of_place(check: Check, east: str, north: str) -> Check:
    """Return the check of the path's course rate with the names of the mapped positions."""
    remedy = check.remedy.replace("truth.x_m", east).replace(COURSE_RATE, north)
    return replace(check, name=check.name.replace(COURSE_RATE, north), subject=north, remedy=remedy)


def _judged(name: str, relations: Sequence[Relation], probable: Posterior, measured: Measured) -> list[Check]:
    """Return sign and unit checks of a signal from its informative relations; empty without any."""
    if not relations:
        return []
    mistakes, chosen = probable.of(name), probable.sets[0][1]
    wrong = sum(p for p, _ in mistakes)
    if wrong > DOUBTED:
        likely = [h for p, h in mistakes if p > NAMED * wrong]
        checks = _failed(name, likely, [r for r in relations if not r.accepts()] or relations, measured)
        if wrong > FAILS:
            return checks
        words = " or ".join(dict.fromkeys(h.words + " is another field" * (h.kind == "field") for h in likely))
        weak = f"{_lacks_for(name, likely)} to rule out that {words}"
        return [replace(c, verdict="undecided", remedy=c.remedy if wrong > 0.5 else weak) for c in checks]
    factors = {r.text: math.prod(h.acts_on(r) for h in chosen) for r in relations}
    usable = [r for r in relations if not math.isnan(factors[r.text])]
    if not usable:
        others = " and ".join(sorted({n for h in chosen for n in h.factors} & set(relations[0].powers)))
        return [UNIT.undecided(relations[0].evidence, name, f"needs {others} that is right")]
    if not any(r.accepts(factors[r.text]) for r in usable):
        return [UNIT.undecided(usable[0].evidence, name, UNEXPLAINED)]
    return _passed(name, usable, factors)


def _passed(name: str, usable: Sequence[Relation], factors: dict[str, float]) -> list[Check]:
    best = max(usable, key=lambda r: (len(r.powers) > 1, abs(r.correlation)))
    # Wheel radii and wheelbases vary by more; a speed separates mph from km/h, tyres do not.
    foreign = () if name.startswith(("steer", "wheel")) else FOREIGN
    units = {f for f, said in units_of(name.removeprefix("truth.")) if said not in ("is in m/s", "is in rad/s")}
    units |= {f**p for f in foreign for p in (1.0, -1.0)}
    units = {f for f in units if name not in _LACKS_FOR_UNIT or max(f, 1.0 / f) > 3.0}
    if any(all(r.accepts(factors[r.text] * f ** r.powers.get(name, 0)) for r in usable) for f in units):
        lacks = _lacks(name, for_unit=True)
        return [SIGN.passed(best.evidence, name), UNIT.undecided(best.evidence, name, lacks)]
    return [kind.passed(best.evidence, name) for kind in (SIGN, UNIT)]


_JUDGED = "vx_m_s vy_m_s yaw_rate_rad_s yaw_rad sideslip_rad ay_m_s2 y_m"
_JUDGED_TRUTH = (*(f"truth.{n}" for n in _JUDGED.split()),)


def _is_cleared(name: str, unrelated: Relation, relations: Sequence[Relation]) -> bool:
    """Return whether another relation confirms the signal but not the other signals of the pair."""

    def shown(signal: str) -> bool:
        return any(r.tells and r.accepts() and signal in r.powers and r.powers != unrelated.powers for r in relations)

    paces = {"speed_m_s", WHEEL_SPEEDS, "truth.vx_m_s"}
    others = [n for n in unrelated.powers if n != name and n not in paces]
    return name in paces or (shown(name) and not all(shown(n) for n in others))


def _failed(
    name: str, mistakes: Sequence[Hypothesis], relations: Sequence[Relation], measured: Measured
) -> list[Check]:
    counts = "; raw counts of a converter need its resolution" if relations[0].most_energy > MOST_ENERGY else ""
    if math.isnan(mistakes[0].factors[name]):
        look_at = " and ".join(relations[0].powers)
        remedy = f"{SUSPICIONS[1]}: look at the field, unit and sign of {look_at}{counts}"
        return [UNIT.failed(relations[0].evidence, name, remedy=remedy)]
    mistakes = [h for h in mistakes if not math.isnan(h.factors[name])]
    wrong = [c for a, c in (("sign", SIGN), ("unit", UNIT)) if any(a in _ASPECTS[h.kind] for h in mistakes)]
    evidence = "; ".join(r.evidence for r in relations[:2])
    scale = measured.scales.get(name)
    lines = {
        f: f"scale = {scale * f:.6g}" if isinstance(scale, float | int) else ""
        for f in (h.factors[name] for h in mistakes)
    }
    if len(lines) == 1:
        ((factor, line),) = lines.items()
        words = " or ".join(dict.fromkeys(h.words for h in mistakes))
        times = f"multiply its scale in the mapping by {factor:.6g}"
        remedy = f"{SUSPICIONS[0]}{words}: {times}" + (f", {line}" if line else "")
    else:
        shown = [f"{h.words} ({line})" if (line := lines[h.factors[name]]) else h.words for h in mistakes]
        remedy = SUSPICIONS[0] + " or ".join(shown)
    return [kind.failed(evidence, name, remedy=remedy + counts) for kind in wrong]


_ASPECTS = {
    "sign": ("sign",),
    "open sign": ("sign",),
    "unit": ("unit",),
    "foreign": ("unit",),
    "sign and unit": ("sign", "unit"),
}


def _not_excited(name: str, relations: Sequence[Relation]) -> Check:
    if not relations:
        evidence = "no other signal of the log is related to it"
    else:
        best = max(relations, key=lambda r: abs(r.correlation))
        evidence = f"{best.text}: correlation {best.correlation:.2f} over {best.samples:.0f} independent samples"
    return SIGN.undecided(evidence, name, _lacks(name))


def _lacks_for(name: str, mistakes: Sequence[Hypothesis]) -> str:
    if mistakes[0].kind == "open sign":
        return _LACKS_FOR_SIGN
    return _lacks(name, for_unit=not any(h.kind == "sign" for h in mistakes))


def _lacks(name: str, *, for_unit: bool = False) -> str:
    lacks = _LACKS.get(name, _BENDS)
    return f"needs {_LACKS_FOR_UNIT.get(name, lacks) if for_unit else lacks}"


SIGN = CheckKind(
    "SIGNAL.sign",
    compares="a_y with v r, steering with curvature, v̇ with a_x, wheel speeds, wheel differences and the ground "
    "ground truth's path with the signals that they correspond to, and values with the limits of all vehicles",
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
    compares="the signal with correlated signals, and an accelerometer's mean with gravity",
    fails="it does not correlate, or it contains gravity",
    remedy="map another field or axis to {signal_name}",
)
CHECKS = (SIGN, UNIT, AXIS)
