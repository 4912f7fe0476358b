"""Verdict on one requirement: PASS, FAIL or INCONCLUSIVE by confidence bounds, with margin and exposure."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from pdhef_logtool.evaluation import statistics
from pdhef_logtool.evaluation.requirement_blocks import RequirementBlocks
from pdhef_logtool.evaluation.units import AY_NOTE
from pdhef_logtool.evaluation.validation_plan import AT_LEAST, POOLED, SQUARES, WORST_DRIVE, Requirement, shown
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.storage.templates import clauses, one_line, template

#: Driving that is missing: amount so far (None: unknown), needed amount, and its unit.
_Lacking: TypeAlias = tuple[float | None, float, str]
#: Least margin relative to an estimated reference, in standard deviations of the reference.
REFERENCE_SDS = 2.0
#: Largest factor on the driving that is recommended.
_MOST_TIMES = 30.0


@dataclass(frozen=True, slots=True)
class JudgedDrive:
    """A drive of a run: its label, and its selected estimate (None: its only recorded estimate).

    ``read_report`` returns its report.json: its blocks of time are used where too few drives are scored for a bootstrap
    over drives. ``factors``: its day, car and route, None if unknown. ``space``, ``friction``: seconds by the lower
    edges of speed and |a_y|, and the median friction, where the plan asks for exposure.
    """

    log: str
    main: str | None
    read_report: Callable[[], Mapping[str, Any] | None] = dict
    factors: Mapping[str, object] = field(default_factory=dict)
    space: Mapping[tuple[float, float], float] = field(default_factory=dict)
    friction: float = math.nan


@dataclass(frozen=True, slots=True)
class DriveValue:
    """The metric of one drive.

    Attributes
    ----------
    estimator : the scored one. n : number of stamps of ``value``; ``baseline`` None without one.
    seconds, metres : scored driving, NaN where unknown. std : root mean square of the 1-sigma of the estimated
        reference; NaN for ground truth. blocks : None if the run stored none. same : estimator and baseline are the
        same algorithm.
    """

    drive: JudgedDrive
    estimator: str
    value: float
    n: int
    baseline: float | None = None
    seconds: float = math.nan
    metres: float = math.nan
    std: float = math.nan
    blocks: RequirementBlocks | None = None
    same: bool = False


@dataclass(frozen=True, slots=True)
class Exposure:
    """Scored driving: number of drives, minutes and kilometres (None: unknown)."""

    drives: int
    minutes: float | None
    km: float | None


@dataclass(frozen=True, slots=True)
class RequirementVerdict:
    """The verdict on one requirement; values in the unit of the requirement.

    Attributes
    ----------
    value, low, high : statistic and its two-sided interval; None if not available.
    margin : distance of the value to the limit, negative beyond it. estimators : the scored ones.
    basis : units of the bootstrap, ``drives`` or ``blocks``; ``units``: their number; ``block_s``: length of a block;
        ``design_effect``: of dependent drives.
    against : ``ground truth`` or ``estimated reference``. worst : the drive with the largest error.
    reason : text of the verdict. next : next step, empty after a PASS. notes : limitations of the verdict.
    """

    requirement: Requirement
    outcome: statistics.Outcome
    value: float | None
    low: float | None
    high: float | None
    margin: float | None
    exposure: Exposure
    estimators: tuple[str, ...]
    basis: Literal["drives", "blocks"]
    units: int
    block_s: float | None
    against: Literal["ground truth", "estimated reference"]
    worst: str | None
    reason: str
    next: str = ""
    notes: tuple[str, ...] = field(default=())
    design_effect: float = 1.0

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict as JSON-able values."""
        values = asdict(self)
        del values["requirement"]
        requirement = {**asdict(self.requirement), "label": self.requirement.label, "unit": self.requirement.unit}
        requirement["title"] = self.requirement.title or self.requirement.label
        requirement["exposure_in"] = [need.model_dump() for need in requirement.pop("exposure")]
        return {
            **requirement,
            "at_least": self.requirement.metric in AT_LEAST,
            "bound": self.requirement.bound,
            **values,
        }


def judge(requirement: Requirement, drives: Sequence[DriveValue], missing: str = "") -> RequirementVerdict:
    """Return the verdict on a requirement.

    Parameters
    ----------
    drives : the drives with the metric; all against ground truth, or all against the estimated reference.
    missing : reason if no drive has the metric.
    """
    exposure = _exposure(drives)
    estimated = bool(drives) and math.isfinite(drives[0].std)
    bounded = _statistic(requirement, drives)
    sd = _reference_sd(requirement, drives) if estimated else 0.0
    bound, at_least = requirement.bound, requirement.metric in AT_LEAST
    words, lacking, count = _words(), _lacking(requirement, exposure, drives), len(drives)
    outcome, case = _case(requirement, bounded, exposure, lacking, sd)
    why, _, remedy = missing.partition("; ")
    share = (0.5 * (1.0 - requirement.confidence)) ** (1.0 / max(count, 1))
    times = _times(requirement, bounded) if case == "undecided" else math.inf
    reason = words.reason(case, requirement, bounded, count, lacking, why, sd, share)
    to_do = words.next(case, requirement, bounded, exposure, lacking, remedy, times)
    same = drives[0].estimator if drives and all(d.same for d in drives) else ""
    value, low, high = (x if math.isfinite(x) else None for x in (bounded.value, bounded.low, bounded.high))
    return RequirementVerdict(
        requirement,
        outcome,
        value,
        low,
        high,
        None if value is None else (value - bound if at_least else bound - abs(value)),
        exposure,
        tuple(dict.fromkeys(d.estimator for d in drives)),
        bounded.basis,
        bounded.units,
        bounded.block_s,
        "estimated reference" if estimated else "ground truth",
        _worst(requirement, drives),
        one_line(reason),
        one_line(to_do),
        tuple(clauses(words.notes(requirement, bounded, count, estimated, same))),
        bounded.effect.design_effect,
    )


def _exposure(drives: Sequence[DriveValue]) -> Exposure:
    sums = math.fsum(d.seconds for d in drives) / 60.0, math.fsum(d.metres for d in drives) / 1000.0
    return Exposure(len(drives), *(x if math.isfinite(x) else None for x in sums))


def _ratios(drives: Sequence[DriveValue]) -> FloatArray:
    """Return the values of drives, or their ratios for a requirement with a baseline."""
    values, others = _column(drives, "value"), _column(drives, "baseline")
    if not drives or drives[0].baseline is None:
        return values
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(values == others, 1.0, values / others)


def _statistic(requirement: Requirement, drives: Sequence[DriveValue]) -> statistics.Bounded:
    """Return the statistic of a requirement over drives, with bounds from drives or from blocks within them."""
    if not drives:
        return statistics.Bounded(math.nan, math.nan, math.nan, 0)
    count, factors = len(drives), {name: [d.drive.factors.get(name) for d in drives] for name in statistics.FACTORS}
    if requirement.statistic != POOLED:
        return _of_drives(requirement, _ratios(drives), factors)
    if count >= statistics.LEAST_DRIVES and requirement.other_run is not None:
        return _change(drives, requirement.confidence, factors)
    total = _pooled(requirement, drives, factors)
    if count >= statistics.LEAST_DRIVES:
        return total
    return _from_blocks(requirement, total, [d.blocks for d in drives])


def _of_drives(requirement: Requirement, values: FloatArray, factors: statistics.Factors) -> statistics.Bounded:
    """Return a quantile of the drives, or the worst drive, which has no confidence interval."""
    if requirement.quantile is not None:
        return statistics.quantile(values, requirement.quantile, requirement.confidence, factors)
    worst = np.min if requirement.metric in AT_LEAST else np.max
    largest = float(worst(np.abs(values)))
    return statistics.Bounded(largest, largest, largest, len(values))


def _from_blocks(
    requirement: Requirement, total: statistics.Bounded, blocks: Sequence[RequirementBlocks | None]
) -> statistics.Bounded:
    """Return the statistic ``total`` of few drives with bounds from the blocks of time within them."""
    present = [b for b in blocks if b is not None]
    if len(present) < len(blocks):
        return statistics.Bounded(total.value, math.nan, math.nan, 0, basis="blocks")
    bounded = _pooled(requirement, present, None)
    low, high = (bounded.low, bounded.high) if bounded.units >= statistics.LEAST_BLOCKS else (math.nan, math.nan)
    longest_s = max(b.block_s for b in present)
    return statistics.Bounded(total.value, low, high, bounded.units, basis="blocks", block_s=longest_s)


def _column(units: Sequence[DriveValue | RequirementBlocks], key: str) -> FloatArray:
    """Return a value of all drives, or of all blocks of time, [N]."""
    return np.array([x for unit in units for x in np.atleast_1d(getattr(unit, key))], dtype=np.float64)


def _pooled(
    requirement: Requirement, units: Sequence[DriveValue | RequirementBlocks], factors: statistics.Factors | None
) -> statistics.Bounded:
    """Return the statistic over drives, or over the blocks of time within them."""
    metric = requirement.metric
    bounded = statistics.pooled(
        _column(units, "n"),
        _column(units, "value"),
        _column(units, "baseline") if requirement.baseline else None,
        squares=metric in SQUARES,
        positive=metric != "bias" and metric not in AT_LEAST,
        level=requirement.confidence,
        factors=factors,
    )
    if metric == "bias":  # its absolute value is limited
        low = 0.0 if bounded.low <= 0.0 <= bounded.high else min(abs(bounded.low), abs(bounded.high))
        return replace(bounded, value=abs(bounded.value), low=low, high=max(abs(bounded.low), abs(bounded.high)))
    if metric in AT_LEAST:
        return replace(bounded, low=max(bounded.low, 0.0), high=min(bounded.high, 1.0))
    return bounded


def _change(drives: Sequence[DriveValue], level: float, factors: statistics.Factors) -> statistics.Bounded:
    """Return the median of the drives' ratios to another run, which compares each drive with itself."""
    change = statistics.paired_change(
        statistics.log_ratios(_column(drives, "baseline"), _column(drives, "value")), None, factors, level
    )
    value, low, high = np.exp([change.median, change.low, change.high]).tolist()
    return statistics.Bounded(value, low, high, change.drives, change.dependence)


def _reference_sd(requirement: Requirement, drives: Sequence[DriveValue]) -> float:
    """Return the standard deviation of the estimated reference in the unit of the requirement."""
    weights = _column(drives, "n")
    std, base = (math.sqrt(np.average(_column(drives, key) ** 2, weights=weights)) for key in ("std", "baseline"))
    return std if requirement.baseline is None else std / base if base > 0.0 else math.inf


def _worst(requirement: Requirement, drives: Sequence[DriveValue]) -> str | None:
    values = np.abs(_ratios(drives))
    if not len(values) or not np.isfinite(values).any():
        return None
    return drives[int(np.nanargmin(values) if requirement.metric in AT_LEAST else np.nanargmax(values))].drive.log


def _case(
    requirement: Requirement, bounded: statistics.Bounded, exposure: Exposure, lacking: Sequence[_Lacking], sd: float
) -> tuple[statistics.Outcome, str]:
    """Return the outcome, and the case that decides the sentences of ``requirement.txt``."""
    if not exposure.drives or not math.isfinite(bounded.value):
        return "INCONCLUSIVE", "missing"
    if lacking:
        return "INCONCLUSIVE", "lacking"
    if _without_bounds(requirement, bounded):
        return "INCONCLUSIVE", "unbounded"
    outcome = _outcome(requirement, bounded)
    if outcome == "INCONCLUSIVE":
        return outcome, "undecided"
    if abs(requirement.bound - bounded.value) < REFERENCE_SDS * sd:
        return "INCONCLUSIVE", "reference"
    return outcome, "narrow" if outcome == "FAIL" and requirement.metric == "coverage95" else outcome


@cache
def _words() -> Any:
    """Return the sentences of ``requirement.txt`` as functions."""
    limits: dict[str, Any] = {
        "LEAST_BLOCKS": statistics.LEAST_BLOCKS,
        "LEAST_DRIVES": statistics.LEAST_DRIVES,
        "MOST_TIMES": _MOST_TIMES,
    }
    limits |= {"REFERENCE_SDS": REFERENCE_SDS, "AY_NOTE": AY_NOTE, "POOLED": POOLED, "WORST_DRIVE": WORST_DRIVE}
    path = Path(__file__).parent / "templates" / "requirement.txt"
    return template(path, **limits, shown=shown, least_drives=statistics.least_drives).module


def _without_bounds(requirement: Requirement, bounded: statistics.Bounded) -> bool:
    """Return whether the bound that decides is missing, because there are too few units."""
    if requirement.quantile is not None and math.isinf(bounded.high):
        return bounded.low <= requirement.bound
    return not (math.isfinite(bounded.low) or math.isfinite(bounded.high))


def _outcome(requirement: Requirement, bounded: statistics.Bounded) -> statistics.Outcome:
    low, value, high, bound = bounded.low, bounded.value, bounded.high, requirement.bound
    if requirement.metric in AT_LEAST:
        return statistics.decided(-high, -value, -low, -bound)
    # Another run as the baseline: a significant regression fails if it is larger than the accepted one.
    regression = requirement.other_run is not None and requirement.statistic == POOLED
    return statistics.decided(low, value, high, bound, least=min(1.0, bound) if regression else bound)


def _lacking(requirement: Requirement, exposure: Exposure, drives: Sequence[DriveValue]) -> list[_Lacking]:
    """Return the required driving that is missing."""
    needs: list[_Lacking] = [
        (float(exposure.drives), float(requirement.exposure_drives), "drives"),
        (exposure.minutes, requirement.exposure_minutes, "minutes"),
        (exposure.km, requirement.exposure_km, "km"),
    ]
    for need in requirement.exposure:
        seconds = [need.seconds_of(d.space, d.friction, d.factors.get("car")) for d in (v.drive for v in drives)]
        needs.append((float(sum(s > 0.0 for s in seconds)), float(need.drives), f"drives at {need.label}"))
        needs.append((math.fsum(seconds) / 60.0, need.minutes, f"minutes at {need.label}"))
    return [(has, needed, what) for has, needed, what in needs if needed > 0.0 and (has is None or has < needed)]


def _times(requirement: Requirement, bounded: statistics.Bounded) -> float:
    """Return how many times as much driving gives a verdict if value and spread do not change, rounded up to tenths.

    The interval narrows with the square root of the amount of driving; that of a positive value is taken in its
    logarithm, as in the bootstrap.
    """
    near, value = requirement.bound, bounded.value
    end = bounded.low if value > near else bounded.high
    if min(near, bounded.low) > 0.0 and requirement.metric not in AT_LEAST:
        near, value, end = math.log(near), math.log(value), math.log(end)
    times = (abs(end - value) / abs(near - value)) ** 2 if near != value and math.isfinite(end) else math.inf
    return times if times > _MOST_TIMES else math.ceil(10.0 * times) / 10.0


def joint_notes(plan: Mapping[str, Any]) -> list[str]:
    """Return each note of a document's requirements once, with the ids of its requirements unless it applies to all."""
    of_all = plan["requirements"]
    ids = statistics.gathered((note.rstrip("."), str(r["id"])) for r in of_all for note in r.get("notes") or ())
    return [note if len(names) == len(of_all) else f"{', '.join(names)}: {note}" for note, names in ids.items()]


def next_steps(plan: Mapping[str, Any] | None, more: Sequence[str] = ()) -> list[str]:
    """Return the next steps of a document: failed requirements, inconclusive ones, ``more``."""
    requirements = sorted((plan or {}).get("requirements") or (), key=lambda r: r["outcome"] != "FAIL")
    ids = statistics.gathered(
        (str(r["next"]), str(r["id"])) for r in requirements if r["next"] and r["outcome"] != "PASS"
    )
    asked = [f"{', '.join(names)}: {text}" for text, names in ids.items()]
    return [*asked, *filter(None, more)]
