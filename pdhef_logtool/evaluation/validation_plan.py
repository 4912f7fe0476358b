"""The validation plan: requirements on the error of an estimate, read strictly from plan.toml."""

import math
import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, model_validator

from pdhef_logtool.car.vehicle import NonNegative, Positive, Record
from pdhef_logtool.evaluation.metrics.metric import registered
from pdhef_logtool.evaluation.segments import SEGMENTS
from pdhef_logtool.evaluation.units import LABELS, SIGNALS, read_unit
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.geometry import DEGREES
from pdhef_logtool.storage.documents import checked, digest, read_toml, unknown
from pdhef_logtool.storage.object_store import is_url

#: Baseline of a requirement: run A of ``pdhef compare``. A path or URL with a slash is the output of another run; other
#: names are estimators of the same run.
RUN = "run"
POOLED, WORST_DRIVE, QUANTILE = "pooled", "worst drive", "quantile"
#: Metrics that are means over stamps. The value of several drives is their mean (root mean square), weighted by stamps.
SQUARES = frozenset({"rmse", "reference_rms"})
MEANS = frozenset({"mae", "bias", "coverage95", "availability", "reference_independent"})
#: Metrics with a minimum as the limit.
AT_LEAST = frozenset({"coverage95", "availability"})
_QUANTILE = re.compile(r"quantile (0\.\d+)")


_Name = Annotated[str, Field(min_length=1, max_length=200)]
_Range = Annotated[list[float] | None, Field(min_length=2, max_length=2)]


class ExposureNeed(Record):
    """A table ``[[requirement.exposure]]``: the least driving in conditions, over the scored drives.

    Attributes
    ----------
    speed_m_s : from, to: multiples of 5; [60, 65] is all above 60.
    ay_m_s2 : |a_y| from, to: integers; [12, 13] is all above 12.
    friction : median of the drive from, to. car : its name.
    drives, minutes : the least.
    """

    speed_m_s: _Range = None
    ay_m_s2: _Range = None
    friction: _Range = None
    car: _Name | None = None
    drives: Annotated[int, Field(ge=0)] = 0
    minutes: NonNegative = 0.0

    @model_validator(mode="after")
    def _agrees(self) -> "ExposureNeed":
        for bounds, step in ((self.speed_m_s, 5.0), (self.ay_m_s2, 1.0), (self.friction, None)):
            off_grid = bounds is not None and step is not None and any(b % step for b in bounds)
            if bounds is not None and (off_grid or not 0.0 <= bounds[0] < bounds[1]):
                raise ValueError(f"{bounds} should be [from, to]{f', multiples of {step:g}' if off_grid else ''}")
        if not self.drives and not self.minutes:
            raise ValueError("give drives or minutes")
        return self

    def seconds_of(self, space: Mapping[tuple[float, float], float], friction: float, car: object) -> float:
        """Return the duration of a drive in the conditions, of its seconds by the lower edges of speed and |a_y|."""
        if not _inside(self.friction, friction) or self.car not in (None, car):
            return 0.0
        return math.fsum(
            s for (speed, ay), s in space.items() if _inside(self.speed_m_s, speed) and _inside(self.ay_m_s2, ay)
        )

    @property
    def label(self) -> str:
        """The conditions as text, for example ``20 to 30 m/s, μ 0 to 0.4``."""
        ranges = (("", self.speed_m_s, " m/s"), ("|a_y| ", self.ay_m_s2, " m/s²"), ("μ ", self.friction, ""))
        words = [f"{name}{r[0]:g} to {r[1]:g}{unit}" for name, r, unit in ranges if r is not None]
        return ", ".join([*words, *([] if self.car is None else [f"car {self.car}"])])


def _inside(bounds: Sequence[float] | None, value: float) -> bool:
    return bounds is None or bounds[0] <= value < bounds[1]


@dataclass(frozen=True, slots=True)
class Requirement:
    """One requirement; values in the unit of metrics.parquet.

    Attributes
    ----------
    estimator : None for the selected estimate of each drive, or the recorded estimate.
    limit : maximum of the metric (:data:`AT_LEAST`: minimum). None for a requirement on the ratio to ``baseline``,
        which is at most ``max_ratio`` (None: a figure that is compared without a limit).
    baseline : estimator of the same run, :data:`RUN`, or output of another run.
    statistic : of several drives: :data:`POOLED` over all their stamps, :data:`WORST_DRIVE`, or the ``quantile`` of the
        drives. confidence : of the interval that decides.
    exposure_drives, exposure_minutes, exposure_km : the least scored driving for a verdict. exposure : the least scored
        driving in conditions.
    """

    id: str
    title: str
    signal: str
    metric: str = "rmse"
    estimator: str | None = None
    segment: str = "all"
    limit: float | None = None
    baseline: str | None = None
    max_ratio: float | None = None
    statistic: str = POOLED
    quantile: float | None = None
    confidence: float = 0.95
    exposure_drives: int = 1
    exposure_minutes: float = 0.0
    exposure_km: float = 0.0
    exposure: tuple[ExposureNeed, ...] = ()

    @property
    def other_run(self) -> str | None:
        """:data:`RUN`, or the output of the run that is the baseline; None without one."""
        return self.baseline if self.baseline is not None and (self.baseline == RUN or "/" in self.baseline) else None

    @property
    def unit(self) -> str:
        """Unit of the value: the unit of the metric, 1 for a ratio, ``share`` for coverage and availability."""
        if self.baseline is not None:
            return "1"
        return "share" if self.metric in AT_LEAST else registered()[self.metric].unit_of(self.signal)

    @property
    def measured(self) -> str:
        """Description of the measurement without the limit; requirements with equal descriptions share blocks."""
        of = self.estimator or "selected"
        against = "" if self.baseline == self.other_run else f" / {self.baseline}"
        return f"{self.signal} {self.metric} {self.segment} {of}{against}"

    @property
    def bound(self) -> float:
        """The limit or the largest ratio."""
        bound = self.limit if self.baseline is None else self.max_ratio
        assert bound is not None
        return bound

    @property
    def name(self) -> str:
        """Name of the limited figure, for example ``sideslip RMSE (nonlinear)``."""
        return self._text("")

    @property
    def label(self) -> str:
        """The requirement as text, for example ``sideslip RMSE ≤ 0.5° (nonlinear)``."""
        if self.baseline is None:
            limit = f"{'≥' if self.metric in AT_LEAST else '≤'} {shown(self.bound, self.unit)}"
        else:
            baseline = self.baseline if self.other_run is None else "run A" if self.baseline == RUN else "earlier run"
            limit = f"≤ {self.bound:.4g} × {baseline}"
        return self._text(f" {limit}")

    def _text(self, limit: str) -> str:
        segment, statistic = self.segment.removeprefix("all"), self.statistic.removeprefix(POOLED)
        where = ", ".join(filter(None, (segment, statistic, self.estimator)))
        what = f"{LABELS[self.signal]} {registered()[self.metric].label}{limit}"
        return f"{what} ({where})" if where else what


@dataclass(frozen=True, slots=True)
class ValidationPlan:
    """Requirements in order. ``file``: name of the file; empty for the default plan, which sets no exit code."""

    requirements: tuple[Requirement, ...]
    title: str = ""
    file: str = ""

    @property
    def sha256(self) -> str:
        """The digest of the requirements."""
        from pdhef_logtool.storage.documents import jsonable

        return digest(jsonable(self.requirements))


def shown(value: float, unit: str) -> str:
    """Return a value with its unit for display."""
    text, factor = read_unit(unit)
    if unit == "share":
        return f"{round(100.0 * value, 1):g} %"
    if unit == "1":
        return f"{value:.3g}"
    return f"{value * factor:.3g}{'' if text.startswith('°') else ' '}{text}"


class RequirementTable(Record):
    """A table ``[[requirement]]`` of plan.toml.

    Attributes
    ----------
    title : one line for reports; default: the requirement in words.
    signal, metric : of metrics.parquet, for example sideslip_rad and rmse.
    estimator : default: the selected estimate; with pdhef metrics the recorded estimate.
    segment : of the drives; default: all. manoeuvre : in place of segment.
    limit : in the SI unit of the metric, a minimum for coverage95; limit_deg, limit_deg_s : in degrees (per second).
    baseline : in place of a limit: an estimator of the same run (physics, zero), run (run A of compare), or the output
        of another run: a path with a slash, relative to the plan, or a URL.
    max_ratio : largest ratio of the metric to the baseline's.
    statistic : over drives: pooled (all stamps together), worst drive, or for example quantile 0.9.
    confidence : level of the two-sided interval that decides.
    exposure_drives, exposure_minutes, exposure_km : least scored driving. exposure : least driving in conditions.
    """

    id: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
    title: _Name | None = None
    signal: _Name
    metric: _Name = "rmse"
    estimator: _Name | None = None
    segment: _Name | None = None
    manoeuvre: _Name | None = None
    limit: float | None = None
    limit_deg: float | None = None
    limit_deg_s: float | None = None
    baseline: _Name | None = None
    max_ratio: Positive | None = None
    statistic: Annotated[str, Field(pattern=r"^(pooled|worst drive|quantile 0\.\d+)$")] = POOLED
    confidence: Annotated[float, Field(ge=0.5, lt=1.0)] = 0.95
    exposure_drives: Annotated[int, Field(ge=1)] = 1
    exposure_minutes: NonNegative = 0.0
    exposure_km: NonNegative = 0.0
    exposure: Annotated[list[ExposureNeed], Field(max_length=50)] = []  # noqa: RUF012


class PlanTable(Record):
    """The file plan.toml; its title is for reports."""

    title: Annotated[str, Field(max_length=200)] = ""
    requirement: Annotated[list[RequirementTable], Field(min_length=1)]


def load_plan(path: Path) -> ValidationPlan:
    """Read plan.toml.

    Raises
    ------
    UsageError
        The file is missing, is not TOML, or contains wrong, unknown, missing or contradicting entries; the error lists
        all of them.
    """
    raw = read_toml(path, "a validation plan (TOML)", UsageError, "pdhef plan init -o plan.toml writes an example")
    plan = plan_from_dict(raw, where=str(path), file=path.name)
    return replace(plan, requirements=tuple(_placed(r, path.parent) for r in plan.requirements))


def _placed(requirement: Requirement, folder: Path) -> Requirement:
    """Return a requirement with a baseline path relative to the working folder."""
    baseline = requirement.other_run
    if baseline is None or baseline == RUN or is_url(baseline):
        return requirement
    return replace(requirement, baseline=f"{(folder / baseline).as_posix()}/")


def plan_from_dict(raw: dict[str, Any], *, where: str, file: str = "") -> ValidationPlan:
    """Return the plan of parsed TOML; raises UsageError with all problems in one line."""
    problems: list[str] = []
    plan = checked(PlanTable, raw, "", problems)
    tables = [] if plan is None else plan.requirement
    requirements = [_read(table, f"requirement.{i}", problems) for i, table in enumerate(tables)]
    ids = [r.id for r in requirements if r is not None]
    problems += [f"id {name!r} is used {ids.count(name)} times" for name in dict.fromkeys(ids) if ids.count(name) > 1]
    if plan is None or problems:
        raise UsageError(
            expected="the entries of a validation plan",
            got="; ".join(problems),
            where=where,
            remedy="docs/formats.md#plantoml describes every entry",
        )
    return ValidationPlan(tuple(r for r in requirements if r is not None), plan.title, file)


#: Signals by their symbols, which have no letters in common with the names.
_SYMBOLS = {"beta": "sideslip_rad", "β": "sideslip_rad", "psi_dot": "yaw_rate_rad_s", "r": "yaw_rate_rad_s"}


def _read(table: RequirementTable, where: str, problems: list[str]) -> Requirement | None:
    before = len(problems)
    segment = table.manoeuvre or table.segment or "all"
    if table.manoeuvre is not None and table.segment is not None:
        problems.append(f"{where}: give segment or manoeuvre, not both")
    for key, value, allowed in (
        ("signal", table.signal, tuple(SIGNALS)),
        ("metric", table.metric, comparable()),
        ("manoeuvre" if table.manoeuvre else "segment", segment, SEGMENTS),
    ):
        if value not in allowed:
            problem = unknown(_SYMBOLS.get(value, value), allowed).partition(": ")[2]
            problems.append(f"{where}.{key} = {value}: {problem}")
    if len(problems) > before:
        return None
    limit = _limit(table, where, problems)
    if table.statistic == POOLED and table.metric not in SQUARES | MEANS:
        problems.append(
            f"{where}.statistic: {table.metric} of several drives cannot be pooled; use 'worst drive' or 'quantile 0.9'"
        )
    if len(problems) > before:
        return None
    matches = _QUANTILE.fullmatch(table.statistic)
    rest = {"title", "segment", "manoeuvre", "limit", "limit_deg", "limit_deg_s", "exposure"}
    return Requirement(
        title=table.title or "",
        segment=segment,
        limit=limit,
        quantile=None if matches is None else float(matches[1]),
        exposure=tuple(table.exposure),
        **table.model_dump(exclude=rest),
    )


def comparable() -> tuple[str, ...]:
    """Return the metrics that a requirement can limit: metrics with a better direction."""
    return tuple(
        name for name, m in registered().items() if m.best == "lower" or name in AT_LEAST or name in ("bias", "lag_s")
    )


def _limit(table: RequirementTable, where: str, problems: list[str]) -> float | None:
    """Return the limit in the unit of metrics.parquet, None for a ratio; append its errors to ``problems``."""
    metric, ratio, is_limit = registered()[table.metric], table.max_ratio, table.baseline is None
    unit = metric.unit_of(table.signal)
    units = {"limit": (unit, 1.0), "limit_deg": ("rad", 1.0 / DEGREES), "limit_deg_s": ("rad/s", 1.0 / DEGREES)}
    given: dict[str, float] = {key: value for key in units if (value := getattr(table, key)) is not None}
    others = [(key, units[key][0]) for key in given if units[key][0] != unit]
    wrong = {
        ".max_ratio: needs a baseline, for example baseline = 'zero'": is_limit and ratio is not None,
        ": give one of limit, limit_deg, limit_deg_s, or baseline with max_ratio": (
            is_limit and ratio is None and len(given) != 1
        ),
        f": give {next(iter(given), '')} or baseline, not both": not is_limit and given,
        ".max_ratio: is missing, for example 1.0": not is_limit and ratio is None,
        f".baseline: {table.metric} has no ratio; use a metric such as rmse": not is_limit and metric.best != "lower",
    }
    problems += [f"{where}{text}" for text, is_wrong in wrong.items() if is_wrong]
    problems += [f"{where}.{key}: {table.signal} {table.metric} is in {unit}, not in {of}" for key, of in others]
    return next((value * units[key][1] for key, value in given.items()), None) if is_limit else None


#: The requirement on sideslip of the default plan.
SIDESLIP = Requirement(
    "sideslip", "Sideslip is accurate enough for stability control", "sideslip_rad", limit=1.0 / DEGREES
)


def default_plan() -> ValidationPlan:
    """Return the plan of reports without ``--plan``: an orientation, not a standard."""
    beta, degree = "sideslip_rad", 1.0 / DEGREES
    return ValidationPlan(
        (
            SIDESLIP,
            Requirement("use", "Sideslip is 10 % better than zero sideslip", beta, baseline="zero", max_ratio=0.9),
            Requirement("interval", "The 95 % interval of sideslip is wide enough", beta, "coverage95", limit=0.9),
            Requirement("yaw-rate", "Yaw rate is accurate", "yaw_rate_rad_s", limit=degree),
            Requirement("speed", "Longitudinal speed is accurate", "vx_m_s", limit=0.3),
        ),
        title="Default plan (orientation only)",
    )


def names_of(requirements: Sequence[Requirement]) -> frozenset[str]:
    """Return the estimators of the run that requirements use, as subject or baseline."""
    named = {r.estimator for r in requirements} | {r.baseline for r in requirements}
    return frozenset(name for name in named if name is not None and name != RUN and "/" not in name)


def example_plan() -> str:
    """Return the commented example of a plan.toml."""
    segments = textwrap.fill(", ".join(SEGMENTS), 99, subsequent_indent="# ", break_on_hyphens=False)
    text = (Path(__file__).parent / "plan_example.toml").read_text(encoding="utf-8")
    return text.replace("SIGNALS", ", ".join(SIGNALS)).replace("SEGMENTS", segments)
