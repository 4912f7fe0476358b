"""``SIGNAL.sign``, ``unit``, ``axis``: each signal by relations to others (:mod:`~pdhef_logtool.drive.relations`).

The posterior of all mistakes (:mod:`~pdhef_logtool.drive.hypotheses`) decides which signals fail.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

from pdhef_logtool.drive.check_table import NEEDS, TEXTS, result
from pdhef_logtool.drive.hypotheses import FOREIGN, MOST_ENERGY, Hypothesis, Posterior, Relation, units_of
from pdhef_logtool.drive.measured import WHEEL_SPEEDS, Measured
from pdhef_logtool.drive.relations import COURSE_RATE
from pdhef_logtool.records.checks import Check, Verdict
from pdhef_logtool.records.signals import GNSS

#: Probability of a mistake at which a check fails, below which it passes, and at which the mistake is corrected; least
#: share of a mistake in all mistakes of a signal to be named.
FAILS, DOUBTED, CERTAIN, NAMED = 0.85, 0.005, 0.97, 0.05
_JUDGED = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "yaw_rad", "sideslip_rad", "ay_m_s2", "y_m")
_JUDGED_TRUTH = {f"truth.{name}" for name in _JUDGED}
SIGN, UNIT = "SIGNAL.sign", "SIGNAL.unit"


def explained_factors(measured: Measured, *, most: int = 2) -> dict[str, tuple[float, str]]:
    """Return by signal the certain correction factor of its wrong unit or sign, with the evidence.

    ``most``: largest number of simultaneous mistakes.
    """
    probability, chosen = measured.posterior.sets[0]
    if probability < CERTAIN or len(chosen) > most or not all(h.is_exact for h in chosen):
        return {}
    bad = [r for r in measured.relations if r.tells and not r.accepts()]
    factor_by_name = {}
    for mistake in chosen:
        for name, factor in mistake.factors.items():
            evidence = next((r.evidence for r in bad if name in r.powers), "")
            factor_by_name[name] = (factor, f"{mistake.words} (probability {probability:.3f}): {evidence}")
    return factor_by_name


def relation_checks(measured: Measured) -> tuple[Check, ...]:
    """Check sign, unit and field of every signal with a relation."""
    columns, relations = measured.columns, measured.relations
    # GNSS velocity is excluded: the sideslip reference compares it with gyro and speed.
    names = [n for n in columns if (n in measured.topics and not n.startswith(GNSS)) or n in _JUDGED_TRUTH]
    if "truth.sideslip_rad" in names and "truth.vy_m_s" in names:  # v_y is v_x times tan(sideslip)
        names.remove("truth.vy_m_s")
    probable = measured.posterior
    checks: list[Check] = []
    for name in names:
        # A wrong wheel contradicts other signals through the mean of the wheels, which is the speed.
        through = WHEEL_SPEEDS if probable.of(name) and name.startswith("wheel_speed_") else name
        mine = [r for r in relations if name in r.powers or through in r.powers]
        unrelated = [r for r in mine if r.unrelated and not _is_cleared(name, r, relations)]
        judged = _judged(name, [r for r in mine if r.tells], probable, measured)
        for r in unrelated[:1]:
            evidence = TEXTS["unrelated"].format(pair=r.law.text, correlation=r.correlation)
            checks.append(result("SIGNAL.axis", "failed", name, evidence=evidence))
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
        contradicted = [r for r in relations if not r.accepts()] or relations
        return _wrong(name, likely, contradicted, measured, wrong)
    factors = {r.law.text: math.prod(h.acts_on(r) for h in chosen) for r in relations}
    usable = [r for r in relations if not math.isnan(factors[r.law.text])]
    if not usable:
        others = " and ".join(sorted({n for h in chosen for n in h.factors} & set(relations[0].powers)))
        remedy = TEXTS["rest"].format(others=others)
        return [result(UNIT, "undecided", name, evidence=relations[0].evidence, remedy=remedy)]
    if not any(r.accepts(factors[r.law.text]) for r in usable):
        return [result(UNIT, "undecided", name, evidence=usable[0].evidence, remedy=TEXTS["unexplained"])]
    return _passed(name, usable, factors, measured.speed_name)


def _passed(name: str, usable: Sequence[Relation], factors: dict[str, float], pace: str | None) -> list[Check]:
    best = max(usable, key=lambda r: (len(r.powers) > 1, abs(r.correlation)))
    # Wheel radii and wheelbases vary by more; a speed separates mph from km/h, tyres do not.
    foreign = () if name.startswith(("steer", "wheel")) else FOREIGN
    units = {f for f, said in units_of(name.removeprefix("truth.")) if said not in ("is in m/s", "is in rad/s")}
    units |= {f**p for f in foreign for p in (1.0, -1.0)}
    units = {f for f in units if name not in NEEDS["units"] or max(f, 1.0 / f) > 3.0}
    is_open = any(all(r.accepts(factors[r.law.text] * f ** r.powers.get(name, 0)) for r in usable) for f in units)
    # Wheels of 0.28 m turn with as many rad/s as the car has km/h.
    is_open |= name.startswith("wheel") and name.endswith("rad_s") and pace == WHEEL_SPEEDS
    return [
        result(SIGN, "passed", name, evidence=best.evidence),
        result(UNIT, "undecided" if is_open else "passed", name, evidence=best.evidence, remedy=_needs(name, "unit")),
    ]


def _is_cleared(name: str, unrelated: Relation, relations: Sequence[Relation]) -> bool:
    """Return whether another relation confirms the signal but not the other signals of the pair."""

    def shown(signal: str) -> bool:
        return any(r.tells and r.accepts() and signal in r.powers and r.powers != unrelated.powers for r in relations)

    paces = {"speed_m_s", WHEEL_SPEEDS, "truth.vx_m_s"}
    others = [n for n in unrelated.powers if n != name and n not in paces]
    return name in paces or (shown(name) and not all(shown(n) for n in others))


def _wrong(
    name: str, likely: Sequence[Hypothesis], relations: Sequence[Relation], measured: Measured, probability: float
) -> list[Check]:
    """Return the failed or undecided checks of a signal with likely mistakes."""
    counts = TEXTS["counts"] if relations[0].law.most_energy > MOST_ENERGY else ""
    mistakes = [h for h in likely if not math.isnan(h.factors[name])]
    if math.isnan(likely[0].factors[name]):
        names, evidence = [UNIT], relations[0].evidence
        remedy = TEXTS["several"].format(signals=" and ".join(relations[0].powers))
    else:
        kinds = {h.kind for h in mistakes}
        of_kinds = {
            SIGN: {"sign", "open sign", "sign and unit"},
            UNIT: {"unit", "open unit", "foreign", "sign and unit"},
        }
        names = [n for n, of in of_kinds.items() if kinds & of]
        evidence = "; ".join(r.evidence for r in relations[:2])
        remedy = TEXTS["perhaps"].format(mistakes=_corrections(name, mistakes, measured.scales.get(name)))
    remedy += counts
    verdict: Verdict = "failed" if probability > FAILS else "undecided"
    if probability <= 0.5:
        words = " or ".join(dict.fromkeys(h.words + " is another field" * (h.kind == "field") for h in likely))
        aspect = "sign" if any(h.kind == "sign" for h in likely) else "unit"
        needs = NEEDS["open_sign"] if likely[0].kind == "open sign" else _needs(name, aspect)
        remedy = TEXTS["rule_out"].format(needs=needs, mistakes=words)
    return [result(n, verdict, name, evidence=evidence, remedy=remedy) for n in names]


def _corrections(name: str, mistakes: Sequence[Hypothesis], scale: object) -> str:
    """Return the words of the mistakes with the scales that undo them."""
    factors = dict.fromkeys(h.factors[name] for h in mistakes)
    lines = {f: f"scale = {scale * f:.6g}" if isinstance(scale, float | int) else "" for f in factors}
    if len(lines) == 1:
        ((factor, line),) = lines.items()
        words = " or ".join(dict.fromkeys(h.words for h in mistakes))
        return f"{words}: multiply its scale in the mapping by {factor:.6g}" + (f", {line}" if line else "")
    return " or ".join(f"{h.words} ({line})" if (line := lines[h.factors[name]]) else h.words for h in mistakes)


def _not_excited(name: str, relations: Sequence[Relation]) -> Check:
    evidence = TEXTS["alone"]
    if relations:
        best = max(relations, key=lambda r: abs(r.correlation))
        evidence = TEXTS["quiet"].format(pair=best.law.text, correlation=best.correlation, samples=best.samples)
    return result(SIGN, "undecided", name, evidence=evidence, remedy=_needs(name, "sign"))


def _needs(name: str, aspect: str) -> str:
    """Return the driving that shows the sign or the unit of a signal."""
    shows = NEEDS["signals"].get(name, NEEDS["bends"])
    return str(NEEDS["units"].get(name, shows) if aspect == "unit" else shows)
