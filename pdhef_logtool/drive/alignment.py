"""From channels on their own clocks to :class:`~pdhef_logtool.records.signals.Signals` on the IMU's stamps.

A plan is made once per log from the first ten minutes; :func:`align` applies it to the whole drive.

Rules
-----
* The grid is the union of the stamps of the IMU channels that share one clock (``AlignmentPlan.grid_channels``).
  Irregular steps are kept, and no stamp is added.
* *Inputs* (steering, a_x, friction) drive the estimator's model. They are interpolated if their rate is comparable to
  the grid's rate; otherwise the newest sample at or before the grid stamp is held.
* *Measurements* (a_y, yaw rate, speed, wheel speeds) are used once: a grid stamp has a value only if there is a new
  sample, because a filter would otherwise count one reading several times.
* No value is interpolated or held across a gap of more than ``max_gap_s``, and no value is extrapolated.
* A sample that arrives much later than its neighbours counts as missing.
* A channel is read by its stamps if all of its samples arrive too late to wait for.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.records.errors import MappingError
from pdhef_logtool.records.geometry import WGS84_A_M
from pdhef_logtool.records.signals import (
    ALIGNED_SIGNALS,
    GNSS,
    GNSS_COMPONENTS,
    GNSS_POSITION,
    LEAST_DIVISOR,
    NS_PER_S,
    S_PER_NS,
    WHEELS,
    BoolArray,
    Channel,
    FloatArray,
    IntArray,
    Signals,
    has_gnss,
    has_position,
)
from pdhef_logtool.records.steps import MAX_PREDICTION_S
from pdhef_logtool.storage.documents import jsonable

Method: TypeAlias = Literal["exact", "interpolate", "hold", "next"]
#: Time from which a sample is available: its arrival at the recorder, or its own stamp (offline, not causal).
Clock: TypeAlias = Literal["arrival", "stamp"]

#: The plan depends only on this much of the log's beginning, whichever part of the log is read.
SURVEY_S = 600.0
#: A gap is more than this many median periods, and more than ``MIN_GAP_S``.
GAP_PERIODS = 5.0
MIN_GAP_S = 0.1
#: Never bridged, however slow the channel.
LONGEST_GAP_S = 10.0
#: Assumed for a channel that shows fewer than two samples in the survey.
UNKNOWN_PERIOD_S = 0.1
#: Lateness is judged against the fastest sample of a few such intervals: a slow drift of clocks is not lateness.
LATE_NEIGHBOURHOOD_S = 1.0
#: Jitter below this is never lateness.
MIN_LATE_S = 0.05
#: How far delays may drift away from the survey's before samples count as missing.
DELAY_DRIFT_S = 2.0
#: Share of stamps that must coincide for two channels to be on one clock.
SAME_CLOCK_SHARE = 0.9


#: Longest step between positions that give a velocity; largest and least 1-sigma of a position's change, m: most of the
#: error of a position lasts longer than a step.
LONGEST_FIX_STEP_S, FIX_STD_M, LEAST_FIX_STD_M = 2.5, 0.05, 0.005
_IMU = ("yaw_rate_rad_s", "ay_m_s2", "ax_m_s2")
#: Only the sideslip reference uses these columns. It is not causal, so that no estimate waits for them.
_TILT_RATES = frozenset({"roll_rate_rad_s", "pitch_rate_rad_s"})
#: Columns that only the reference uses, with their own names.
_ALONE = ("gnss_heading_rad", *sorted(_TILT_RATES))
_INPUTS = frozenset({"steer_rad", "steering_wheel_rad", "ax_m_s2", "friction"})


@dataclass(frozen=True, slots=True)
class ChannelPlan:
    """How one channel is brought to the grid.

    Attributes
    ----------
    name : signal name as mapped. target : aligned column it fills. scale : factor from one to the other.
    method : ``exact`` (value where the stamps coincide, else missing), ``interpolate`` (linear between neighbours),
        ``hold`` (newest sample at or before the stamp) or ``next`` (a measurement slower than the grid: at the first
        grid stamp at or after its own stamp, once).
    period_s : median period; None when the survey contains fewer than two samples.
    delay_s : median of arrival − stamp. late_limit_s : a sample this much slower than the fastest one within
        ``LATE_NEIGHBOURHOOD_S`` is not waited for.
    max_gap_s : longest step between samples that is bridged, and longest age of a held sample.
    clock : ``stamp`` takes each sample as known at its own stamp, however late it arrived.
    """

    name: str
    target: str
    scale: float
    method: Method
    period_s: float | None
    delay_s: float
    late_limit_s: float
    max_gap_s: float
    clock: Clock = "arrival"


@dataclass(frozen=True, slots=True)
class AlignmentPlan:
    """How the channels of one log are brought to one grid; made once.

    Attributes
    ----------
    grid_channel : the IMU channel that sets the clock. grid_channels : those that share its stamps, itself included.
    grid_period_s : its median period.
    channels : one entry per used channel. unused : mapped channels that are not used, with the reason.
    speed_from : ``"speed_m_s"``, ``"wheel speeds"``, ``"GNSS"`` or ``"none"``.
    """

    grid_channel: str
    grid_channels: tuple[str, ...]
    grid_period_s: float
    channels: tuple[ChannelPlan, ...]
    unused: tuple[tuple[str, str], ...]
    speed_from: str

    @property
    def available(self) -> frozenset[str]:
        """Aligned columns that the mapping provides, regardless of their source (``speed_m_s`` also from wheels)."""
        names = {c.target for c in self.channels}
        return frozenset(names | ({"speed_m_s"} if self.speed_from != "none" else set()))

    def without(self, refused: Mapping[str, str]) -> "AlignmentPlan":
        """Return the plan without the channels in ``refused`` (name: reason). The grid keeps its stamps."""
        channels = tuple(c for c in self.channels if c.name not in refused)
        unused = {**dict(self.unused), **{c.name: refused[c.name] for c in self.channels if c.name in refused}}
        speed_from = _speed_source({c.target for c in channels})
        return replace(self, channels=channels, unused=tuple(sorted(unused.items())), speed_from=speed_from)

    def to_dict(self) -> dict[str, Any]:
        """Return the plan as JSON-able dictionaries and lists."""
        return {**jsonable(self), "unused": dict(self.unused)}


def plan_alignment(
    channels: Mapping[str, Channel], vehicle: VehicleParameters, *, require_imu: bool = True
) -> AlignmentPlan:
    """Decide clock, method, gaps and lateness of every channel.

    The grid channel is the first of yaw rate, a_y, a_x with a rate within a factor 2 of the fastest of them.

    Parameters
    ----------
    channels : every mapped signal by name, with its samples in the survey, if any.
    vehicle : its steering ratio and wheel radius are used.
    require_imu : False returns a plan without grid, which uses no channel, for a log without IMU.

    Raises
    ------
    MappingError : No IMU channel has two samples in the survey, so that there is no grid.
    """
    if not require_imu and all(len(channels[name]) < 2 for name in _IMU if name in channels):
        idle = tuple((name, "without an IMU there are no stamps to align it to") for name in sorted(channels))
        return AlignmentPlan("", (), math.nan, (), idle, "none")
    survey = with_gnss_velocity(channels)
    periods = {name: _median_period_s(c) for name, c in survey.items()}
    grid = _grid_channel(periods)
    grid_period = periods[grid]
    assert grid_period is not None
    chosen, unused = _choose_sources(survey, vehicle)
    plans = tuple(
        _plan_channel(survey[name], target, scale, survey[grid], grid_period)
        for name, (target, scale) in sorted(chosen.items())
    )
    return AlignmentPlan(
        grid_channel=grid,
        grid_channels=tuple(p.name for p in plans if p.name in _IMU and p.method == "exact"),
        grid_period_s=grid_period,
        channels=plans,
        unused=tuple(sorted(unused.items())),
        speed_from=_speed_source({target for target, _ in chosen.values()}),
    )


def align(channels: Mapping[str, Channel], plan: AlignmentPlan) -> tuple[Signals, dict[str, int]]:
    """Bring the channels to the stamps of the grid, and count the late samples of each channel that has some.

    Measurements are used once. ``exact``: the sample has the stamp of the grid. ``interpolate``: the value at a grid
    stamp lies between the samples before and after; it is missing if the previous grid stamp has used the same sample
    after. ``next``: the unchanged value is at the first grid stamp at or after its own stamp (time error below one grid
    step); of several samples within one step the newest counts.

    ``speed_m_s`` without a speed channel comes from the wheel speeds, see :func:`combine_wheel_speeds`.

    ``ready_ns`` is the availability time of each step: the running maximum of the stamp and of the arrivals of all
    samples used there (both neighbours of an interpolation). An estimator cannot finish step k before ``ready_ns[k]``.
    A channel without samples may be absent.
    """
    channels = with_gnss_velocity(channels)
    stamps = _grid_stamps(channels, plan)
    missing = np.broadcast_to(np.nan, stamps.shape)  # takes no memory
    columns = {p.target: missing for p in plan.channels}
    ready, gnss_ready = stamps.copy(), stamps.copy()
    late: dict[str, int] = {}
    for p in plan.channels:
        if p.name not in channels or not stamps.size:
            continue
        is_late = _is_late(channels[p.name], p)
        if is_late.any():
            late[p.name] = int(np.count_nonzero(is_late))
        values, arrival = _to_grid(channels[p.name].take(~is_late), p, stamps, _ns(_max_gap_s(plan.grid_period_s)))
        columns[p.target] = p.scale * values
        if p.name.startswith(GNSS):
            np.maximum(gnss_ready, arrival, out=gnss_ready)
        if p.name not in _TILT_RATES and (not p.name.startswith(GNSS) or plan.speed_from == "GNSS"):
            np.maximum(ready, arrival, out=ready)

    wheels = np.stack([columns.get(f"wheel_speed_{w}_m_s", missing) for w in WHEELS], axis=1)
    if plan.speed_from == "wheel speeds":
        columns["speed_m_s"] = combine_wheel_speeds(wheels)
    gnss: dict[str, Any] = {}
    if has_gnss(columns):
        velocity = gnss["gnss_velocity_m_s"] = gnss_velocity(columns)
        gnss["gnss_late_s"] = np.where(np.isfinite(velocity[:, 0]), (gnss_ready - stamps) * S_PER_NS, np.nan)
        if plan.speed_from == "GNSS":
            columns["speed_m_s"] = np.hypot(velocity[:, 0], velocity[:, 1])
    if has_position(columns):
        gnss["gnss_position_deg"] = np.stack([columns[name] for name in GNSS_POSITION], axis=1)
    signals = Signals(
        stamps_ns=stamps,
        ready_ns=np.maximum.accumulate(ready),
        wheel_speed_m_s=wheels,
        available=plan.available,
        gnss_velocity_std_m_s=columns.get("gnss_velocity_accuracy_m_s", missing),
        **{name: columns.get(name, missing) for name in (*ALIGNED_SIGNALS, *_ALONE)},
        **gnss,
    )
    return signals, late


def gnss_velocity(columns: Mapping[str, FloatArray]) -> FloatArray:
    """Return GNSS velocity [N, 2] to the east and north, NaN without position (``gnss_fix_type`` below 1)."""
    if set(columns) >= GNSS_COMPONENTS:
        velocity = np.stack([columns[name] for name in ("gnss_velocity_east_m_s", "gnss_velocity_north_m_s")], axis=1)
    else:
        speed, course = columns["gnss_speed_m_s"], columns["gnss_course_rad"]
        velocity = np.stack([speed * np.cos(course), speed * np.sin(course)], axis=1)
    velocity[columns.get("gnss_fix_type", np.ones(len(velocity))) < 1.0] = np.nan
    return velocity


def with_gnss_velocity(channels: Mapping[str, Channel]) -> Mapping[str, Channel]:
    """Return the channels with GNSS velocity from successive positions if the receiver provides no velocity."""
    if has_gnss(channels) or not has_position(channels):
        return channels
    north, east = (channels[name] for name in GNSS_POSITION)
    stamps, i, j = np.intersect1d(north.stamps_ns, east.stamps_ns, assume_unique=True, return_indices=True)
    near = np.flatnonzero(np.diff(stamps) <= _ns(LONGEST_FIX_STEP_S))
    step_s = (stamps[near + 1] - stamps[near]) * S_PER_NS
    arrival = np.maximum(north.arrival_ns[i], east.arrival_ns[j])[near + 1]
    middle = (stamps[near] + stamps[near + 1]) // 2
    std = np.full(len(near), FIX_STD_M)
    if (accuracy := channels.get("gnss_position_accuracy_m")) is not None and len(accuracy):
        stated = np.interp(middle, accuracy.stamps_ns, accuracy.values)
        std = np.clip(stated, LEAST_FIX_STD_M, FIX_STD_M)
    m_s = np.radians(1.0) * WGS84_A_M / step_s
    narrowed = np.cos(np.radians(north.values[i][near]))
    made = {
        "gnss_velocity_north_m_s": np.diff(north.values[i])[near] * m_s,
        "gnss_velocity_east_m_s": np.diff(east.values[j])[near] * narrowed * m_s,
        "gnss_velocity_accuracy_m_s": math.sqrt(2.0) * std / step_s,
    }
    return {**channels, **{n: Channel(n, "m/s", north.source, middle, arrival, v) for n, v in made.items()}}


def combine_wheel_speeds(wheel_speed_m_s: FloatArray) -> FloatArray:
    """Combine wheel speeds [N, 4] (fl, fr, rl, rr; NaN = missing) into one speed [N] in m/s.

    All four: their median, which is robust against one spinning or locked wheel. Otherwise the mean of the rear axle,
    else of the front axle, in which yaw rate × half track cancels. A single wheel gives NaN, because its speed contains
    that term.
    """
    front = 0.5 * (wheel_speed_m_s[:, 0] + wheel_speed_m_s[:, 1])
    rear = 0.5 * (wheel_speed_m_s[:, 2] + wheel_speed_m_s[:, 3])
    ordered = np.sort(wheel_speed_m_s, axis=1)
    middle = 0.5 * (ordered[:, 1] + ordered[:, 2])
    whole = np.isfinite(wheel_speed_m_s).all(axis=1)
    return np.where(whole, middle, np.where(np.isfinite(rear), rear, front))


# ---- planning ----


def _ns(seconds: float) -> int:
    return round(seconds * NS_PER_S)


def _max_gap_s(period_s: float | None) -> float:
    periods = GAP_PERIODS * (UNKNOWN_PERIOD_S if period_s is None else period_s)
    return min(max(periods, MIN_GAP_S), LONGEST_GAP_S)


def _median_period_s(channel: Channel) -> float | None:
    return float(np.median(np.diff(channel.stamps_ns))) * S_PER_NS if len(channel) >= 2 else None


def _grid_channel(periods: Mapping[str, float | None]) -> str:
    period_by_name = {name: p for name in _IMU if (p := periods.get(name)) is not None}
    if not period_by_name:
        mapped = ", ".join(sorted(name for name in _IMU if name in periods))
        raise MappingError(
            expected="samples of yaw_rate_rad_s, ay_m_s2 or ax_m_s2, which set the stamps of the grid",
            got=f"no samples of {mapped}" if mapped else "none of them mapped",
            where="alignment",
            remedy="map an IMU topic (pdhef inspect LOG shows the topics and fields)",
        )
    fastest = min(period_by_name.values())
    if fastest < 1e-5:  # no sensor of a car is so fast
        raise MappingError(
            expected="stamps of at most 100,000 samples a second",
            got=f"{1.0 / max(fastest, LEAST_DIVISOR):.3g} samples a second",
            where="alignment",
            remedy="give the unit of the times in their column's name (time_s) or as stamp_unit in a mapping file",
        )
    return next(name for name, period in period_by_name.items() if period <= 2.0 * fastest)


def _choose_sources(
    survey: Mapping[str, Channel], vehicle: VehicleParameters
) -> tuple[dict[str, tuple[str, float]], dict[str, str]]:
    """Return the aligned column and the scale of every channel used, and the reason for those unused."""
    alternatives = {"steering_wheel_rad": ("steer_rad", 1.0 / vehicle.steering_ratio)}
    for w in WHEELS:
        alternatives[f"wheel_speed_{w}_rad_s"] = (f"wheel_speed_{w}_m_s", vehicle.wheel_radius_m)
    replaced = {name: target for name, (target, _) in alternatives.items() if {name, target} <= survey.keys()}
    chosen = {name: alternatives.get(name, (name, 1.0)) for name in survey if name not in replaced}
    return chosen, {name: f"{target} is mapped too" for name, target in replaced.items()}


def _speed_source(columns: set[str]) -> str:
    """Return the source of the speed column."""
    if "speed_m_s" in columns:
        return "speed_m_s"
    whole_axle = any({f"wheel_speed_{side}_m_s" for side in axle} <= columns for axle in (("fl", "fr"), ("rl", "rr")))
    if whole_axle:
        return "wheel speeds"
    return "GNSS" if has_gnss(columns) else "none"


def _plan_channel(  # positional: one call
    channel: Channel, target: str, scale: float, grid: Channel, grid_period_s: float
) -> ChannelPlan:
    period = _median_period_s(channel)
    is_input = channel.name in _INPUTS
    method: Method
    comparable = period is not None and period <= 2.0 * grid_period_s
    if (channel.name in _IMU or not is_input) and (comparable or period is None) and _on_one_clock(channel, grid):
        method = "exact"
    elif comparable and not channel.name.startswith(GNSS):  # a course must not be interpolated across ±π
        method = "interpolate"
    else:
        method = "hold" if is_input else "next"
    delay_s, late_limit_s = _survey_delay(channel)
    clock: Clock = "stamp" if delay_s > MAX_PREDICTION_S else "arrival"
    times = (period, delay_s, late_limit_s, _max_gap_s(period))
    return ChannelPlan(channel.name, target, scale, method, *times, clock)


def _on_one_clock(channel: Channel, grid: Channel) -> bool:
    """Return whether a channel has the grid's stamps, or, without samples in the survey, its topic."""
    if len(channel) == 0:
        return channel.source.split(".")[0] == grid.source.split(".")[0]
    shared = int(np.isin(channel.stamps_ns, grid.stamps_ns, assume_unique=True).sum())
    return shared >= SAME_CLOCK_SHARE * min(len(channel), len(grid))


def _survey_delay(channel: Channel) -> tuple[float, float]:
    if len(channel) == 0:
        return 0.0, MIN_LATE_S
    delay = channel.arrival_ns - channel.stamps_ns
    excess = delay - _fastest_nearby(channel.stamps_ns, delay)
    typical = float(np.median(excess))
    spread = float(np.median(np.abs(excess - typical)))
    return float(np.median(delay)) * S_PER_NS, (typical + max(_ns(MIN_LATE_S), 5.0 * spread)) * S_PER_NS


# ---- lateness ----


def _fastest_nearby(stamps_ns: IntArray, delay_ns: IntArray) -> IntArray:
    """Return the smallest delay in the interval of ``LATE_NEIGHBOURHOOD_S`` of each sample and those beside it, [N]."""
    starts = np.flatnonzero(np.diff((stamps_ns - stamps_ns[0]) // _ns(LATE_NEIGHBOURHOOD_S), prepend=-1))
    fastest = np.pad(np.minimum.reduceat(delay_ns, starts), 1, mode="edge")
    nearby = np.minimum(np.minimum(fastest[:-2], fastest[2:]), fastest[1:-1])
    return np.repeat(nearby, np.diff(starts, append=len(stamps_ns)))


def _is_late(channel: Channel, p: ChannelPlan) -> BoolArray:
    delay, limit = channel.arrival_ns - channel.stamps_ns, _ns(p.late_limit_s)
    if p.clock == "stamp" or not len(channel):
        return np.zeros(len(channel), dtype=np.bool_)
    late = delay > _ns(p.delay_s + p.late_limit_s + DELAY_DRIFT_S)
    if int(delay.max() - delay.min()) > limit:
        late |= delay - _fastest_nearby(channel.stamps_ns, delay) > limit
    return late


# ---- to the grid ----


def _grid_stamps(channels: Mapping[str, Channel], plan: AlignmentPlan) -> IntArray:
    """Return the union of the IMU channels' stamps, late samples included: time still passes."""
    present = [channels[name].stamps_ns for name in plan.grid_channels if name in channels]
    # Stamps are sorted in runs: a stable sort is a hundred times as fast as numpy's unique, which hashes them.
    stamps: IntArray = np.sort(np.concatenate([np.empty(0, dtype=np.int64), *present]), kind="stable")
    return np.asarray(stamps[np.append(np.ones(min(len(stamps), 1), dtype=np.bool_), np.diff(stamps) > 0)])


def _to_grid(channel: Channel, p: ChannelPlan, grid_ns: IntArray, grid_gap_ns: int) -> tuple[FloatArray, IntArray]:
    """Return values [N] at the grid stamps (NaN = missing) and the latest arrival used [N] (0 = none)."""
    values = np.full(grid_ns.shape[0], np.nan)
    arrival = np.zeros(grid_ns.shape[0], dtype=np.int64)
    stamps, n = channel.stamps_ns, len(channel)
    if n == 0:
        return values, arrival
    arrived = stamps if p.clock == "stamp" else channel.arrival_ns
    right = np.searchsorted(stamps, grid_ns, side="left")  # first sample at or after
    hit = stamps[np.minimum(right, n - 1)] == grid_ns
    left = np.where(hit, right, right - 1)  # last sample at or before
    sampled = stamps[np.maximum(left, 0)]
    if p.method == "exact":
        use = hit
    elif p.method == "interpolate":
        use = (left >= 0) & (right < n) & (stamps[np.minimum(right, n - 1)] - sampled <= _ns(p.max_gap_s))
        if p.name not in _INPUTS:
            use[1:] &= ~(use[:-1] & (right[1:] == right[:-1]))
    elif p.method == "hold":
        use = (left >= 0) & (grid_ns - sampled <= _ns(p.max_gap_s))
    else:
        use = (left >= 0) & (grid_ns - sampled <= grid_gap_ns)
        use[1:] &= sampled[1:] > grid_ns[:-1]
    i = left[use]
    j = right[use] if p.method == "interpolate" else i
    share = (grid_ns[use] - stamps[i]) / np.maximum(stamps[j] - stamps[i], 1)
    values[use] = channel.values[i] + share * (channel.values[j] - channel.values[i])
    arrival[use] = np.maximum(arrived[i], arrived[j])
    return values, arrival
