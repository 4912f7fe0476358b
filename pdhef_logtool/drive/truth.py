"""Ground truth on its own clock: quantities, their derivations from the mapped channels.

Derivations (``TruthTrack.derivation`` contains the ones in use):

* body velocity from v_x and v_y; v_x and sideslip; ENU or ECEF velocity and heading (quaternion or yaw); position and
  heading; v_x, course and yaw; ground speed and sideslip; ground speed alone (then v_x only);
* velocity moved to the CG by v_cg = v − ω × p; position and a_y likewise;
* yaw rate from heading when it is not mapped;
* a_y, the lateral specific force in the road plane: mapped, or (v̇_y + v_x r + g sin φ) / (1 + g K_φ) with the roll φ of
  the attitude, to which body roll adds K_φ a_y. It is unknown without roll: v̇_y + v_x r lacks g sin(bank);
* derivatives by Savitzky–Golay over the true stamps: a cubic by least squares over ± ``DIFFERENTIATION_HALF_S``, its
  slope at the centre; NaN where the window crosses a gap or the end of the data.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from pdhef_logtool.car.vehicle import GRAVITY_M_S2
from pdhef_logtool.drive.columns import median_known
from pdhef_logtool.drive.correlation import GAP_PERIODS
from pdhef_logtool.mapping.records import VECTOR_COLUMNS
from pdhef_logtool.records import geometry
from pdhef_logtool.records.interpolation import Bracket
from pdhef_logtool.records.signals import NS_PER_S, S_PER_NS, TRUTH_UNITS, Channel, FloatArray, IntArray
from pdhef_logtool.records.tracks import StateTrack, make_track

#: Half window of the smoothing derivative. A cubic over ±0.2 s passes 1 Hz with 1 % loss.
DIFFERENTIATION_HALF_S = 0.2
#: Two channels are the same if this share of their samples agrees to ``SAME_RELATIVE``.
SAME_SHARE = 0.99
SAME_RELATIVE = 1e-6

#: Columns of a track by the names of derivations.
_COLUMNS = {
    **{name: (name,) for name in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "ay_m_s2", "yaw_rad")},
    "position_m": ("x_m", "y_m"),
}
_SCORED = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "ay_m_s2")
#: Friction is a condition of the drive, not a state to score.
_FRICTION = "friction"
_AY_DERIVED = "smoothing derivative of v_y plus v_x times yaw rate plus g sin(roll), without body roll"
_AY_UNKNOWN = "not scored: needs a mapped a_y, or an attitude with roll and the car's roll gradient"
_MOVED = "moved to the CG"
_CHUNK = 4096
_ANGLES = frozenset({"yaw_rad", "course_rad", "sideslip_rad"})
_NED_TO_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_FRD_TO_FLU = np.diag([1.0, -1.0, -1.0])


@dataclass(frozen=True, slots=True)
class Attitude:
    """Convention of a quaternion: it rotates ``body`` axes (FLU or FRD) to ``frame`` (ENU, NED or ECEF).

    ``has_roll``: it contains roll, not only a heading.
    """

    frame: Literal["ENU", "NED", "ECEF"]
    body: Literal["FLU", "FRD"]
    has_roll: bool = False


@dataclass(frozen=True, slots=True)
class TruthPlan:
    """Derivation of one log's ground truth, decided once from the first ten minutes.

    Attributes
    ----------
    base : channel that provides the stamps of the ground truth.
    velocity : derivation of the body velocity. origin : of the local ENU frame, ECEF in m.
    max_gap_s : longest step that is bridged, by used channel. half_window : samples on each side of a derivative.
    position_m : measurement point of the ground truth from the CG, ISO 8855. roll_gradient_rad_per_m_s2 : of the car.
    """

    base: str
    velocity: str
    max_gap_s: Mapping[str, float]
    half_window: int
    origin: tuple[float, float, float] | None
    attitude: Attitude | None
    position_m: tuple[float, float, float]
    roll_gradient_rad_per_m_s2: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class TruthTrack:
    """Ground truth at the CG on its own clock. ``derivation`` describes the source of each quantity.

    ``max_gap_s``: values are not interpolated across longer steps. ``plan``: how it was derived.
    """

    track: StateTrack
    max_gap_s: float
    derivation: Mapping[str, str] = field(default_factory=dict)
    plan: TruthPlan | None = None


def derive_truth(
    channels: Mapping[str, Channel],
    *,
    truth_position_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    roll_gradient_rad_per_m_s2: float = 0.0,
    plan: TruthPlan | None = None,
) -> TruthTrack:
    """Derive body velocity, yaw rate, sideslip, a_y and pose at the CG from the mapped truth channels.

    Parameters
    ----------
    channels : truth channels by name, quality gate applied (samples that failed are absent).
    truth_position_m : measurement point from the CG.
    roll_gradient_rad_per_m_s2 : of the car; separates body roll from the bank of the road.
    plan : from the log's beginning; None decides clock, derivation, local frame and the convention of the quaternion
        from these channels, with the two values above.

    Returns
    -------
    TruthTrack
        With the stamps of the plan's base channel; empty and without a plan when no channel has two samples. Sideslip
        is the atan2 of the velocities at the CG, or the mapped sideslip without velocities. ``yaw_rad`` is wrapped.
    """
    plan = plan or _plan(channels, truth_position_m, roll_gradient_rad_per_m_s2)
    if plan is None:
        return TruthTrack(track=make_track("truth", np.empty(0, dtype=np.int64)), max_gap_s=0.0)
    source = _Source(channels, plan)
    if "quat_wxyz" in source and plan.attitude is None:
        source.plan = replace(plan, attitude=_find_attitude(source))
    columns = dict(zip(("x_m", "y_m", "yaw_rad"), _pose(source), strict=True))
    rate = columns["yaw_rate_rad_s"] = _yaw_rate(source, columns["yaw_rad"])
    vx, vy = _velocity_at_cg(source, *_body_velocity(source), rate)
    columns |= {"vx_m_s": vx, "vy_m_s": vy, "sideslip_rad": _sideslip(source, vx, vy)}
    columns |= {"ay_m_s2": _lateral_acceleration(source, vx, vy, rate), _FRICTION: source.column(_FRICTION)}
    if _FRICTION in source:
        source.says[_FRICTION] = source.name(_FRICTION)
    track = make_track("truth", source.stamps_ns, **columns)
    return TruthTrack(track, plan.max_gap_s[plan.base], source.says, source.plan)


def _plan(
    channels: Mapping[str, Channel], truth_position_m: tuple[float, float, float], roll_gradient_rad_per_m_s2: float
) -> TruthPlan | None:
    """Decide clock, derivation and local frame; None when no channel has two samples."""
    survey = {name: c for name, c in channels.items() if len(c) > 1}
    if not survey.keys() - {_FRICTION}:
        return None
    origin = _find_origin(survey)
    kind, base = _velocity_source(survey, origin)
    periods = {name: float(np.median(np.diff(c.stamps_ns))) * S_PER_NS for name, c in survey.items()}
    gaps = {name: GAP_PERIODS * p for name, p in periods.items()}
    half_window = max(2, round(DIFFERENTIATION_HALF_S / periods[base]))
    return TruthPlan(base, kind, gaps, half_window, origin, None, truth_position_m, roll_gradient_rad_per_m_s2)


def truth_at(
    truth: TruthTrack, stamps_ns: IntArray, latency_s: float = 0.0, *, standstill_m_s: float = 0.0
) -> StateTrack:
    """Bring ground truth to other stamps by linear interpolation, angles along the shorter way.

    Parameters
    ----------
    stamps_ns : int64 [N], the stamps to score at, on the sensors' clock.
    latency_s : delay of the ground truth; its value at t + latency belongs to the sensors' values at t.
    standstill_m_s : below this speed, sideslip is undefined.

    Returns
    -------
    StateTrack ``truth`` with ``stamps_ns``; NaN and ``valid`` False outside the data and across steps of more than
    ``truth.max_gap_s``. Sideslip is recomputed from the interpolated velocities where both are known.
    """
    track = truth.track
    bracket = Bracket(track.stamps_ns, stamps_ns + round(latency_s * NS_PER_S), round(truth.max_gap_s * NS_PER_S))
    columns = {name: bracket.linear(getattr(track, name)) for name in (*_SCORED, "x_m", "y_m", _FRICTION)}
    columns |= {name: bracket.angle(getattr(track, name)) for name in ("sideslip_rad", "yaw_rad")}
    vx, vy = columns["vx_m_s"], columns["vy_m_s"]
    finite = np.isfinite(vx) & np.isfinite(vy)
    columns["sideslip_rad"][finite] = np.arctan2(vy[finite], vx[finite])
    scored = np.stack([columns[name] for name in (*_SCORED, "sideslip_rad")])
    valid = bracket.inside & np.isfinite(scored).any(axis=0)
    return make_track("truth", stamps_ns, valid=valid, **columns).without_sideslip_below(standstill_m_s)


def valid_as_a_whole(truth: StateTrack, derivation: Mapping[str, str], standstill_m_s: float) -> StateTrack:
    """Return the ground truth [N] for output, with ``valid`` True where all of its derived quantities are finite.

    Sideslip is not required at standstill. An a_y from the derivative of the velocities is never required, because it
    ends before them. Metrics use each quantity wherever it is finite.
    """
    standing = np.hypot(truth.vx_m_s, truth.vy_m_s) < standstill_m_s
    complete = truth.valid & (np.isfinite(truth.sideslip_rad) | standing | ("sideslip_rad" not in derivation))
    for name, how in derivation.items():
        for column in () if how in (_AY_DERIVED, _AY_UNKNOWN) else _COLUMNS.get(name, ()):
            complete &= np.isfinite(getattr(truth, column))
    return replace(truth, valid=complete)


def channel_of(truth: TruthTrack, name: str) -> Channel:
    """Return a column of ground truth as a channel without NaN."""
    values = getattr(truth.track, name)
    finite = np.isfinite(values)
    stamps = truth.track.stamps_ns[finite]
    source = truth.derivation.get(name, "none")
    return Channel(name, TRUTH_UNITS.get(name, ""), source, stamps, stamps, values[finite])


def dependent_signals(
    signals_channels: Mapping[str, Channel], truth_channels: Mapping[str, Channel], *, role: str = "input"
) -> dict[str, str]:
    """Return the truth channels that equal an input channel, by name with a sentence.

    Equal means: at the same stamps (or, for channels of the same length, sample by sample) values agree to 1e-6
    relative, more than the rounding of float32, on at least 99 % of the samples, and the channel is not constant.

    Parameters
    ----------
    role : name of the channels of ``signals_channels`` in the sentences.

    Returns
    -------
    One sentence for the report per truth channel. Metrics of these channels are marked ``not independent``.
    """
    dependent: dict[str, str] = {}
    for name, truth in sorted(truth_channels.items()):
        for signal in sorted(signals_channels):
            channel = signals_channels[signal]
            if truth.values.ndim != 1 or channel.values.ndim != 1 or channel.unit != truth.unit:
                continue
            share = same_share(channel, truth)
            if share >= SAME_SHARE:
                dependent[name] = (
                    f"{truth.source} equals the {role} {signal} ({channel.source}) on {share:.1%} of its samples"
                )
                break
    if "sideslip_rad" not in truth_channels and {"vx_m_s", "vy_m_s"} <= dependent.keys():
        dependent["sideslip_rad"] = "v_x and v_y are not"
    return dependent


# ---- planning ----


def _velocity_source(survey: Mapping[str, Channel], origin: object) -> tuple[str, str]:
    has = survey.keys()

    def first(*names: str) -> str | None:
        return next((n for n in names if n in has), None)

    # Without a position on Earth, east and north of an ECEF velocity are unknown.
    velocity = first("enu_velocity_m_s", *(["ecef_velocity_m_s"] if origin is not None else []))
    heading = first("yaw_rad", "quat_wxyz")
    position = "x_m" if {"x_m", "y_m"} <= has else first("ecef_position_m", *(["lat_deg"] if "lon_deg" in has else []))
    ground = velocity or position
    choices: tuple[tuple[object, str, str | None], ...] = (
        ({"vx_m_s", "vy_m_s"} <= has, "body velocity", "vx_m_s"),
        ({"vx_m_s", "sideslip_rad"} <= has, "v_x and sideslip", "vx_m_s"),
        (heading, "velocity and heading", velocity),
        (heading, "position and heading", position),
        ({"vx_m_s", "course_rad", "yaw_rad"} <= has, "v_x, course and yaw", "vx_m_s"),
        ("vx_m_s" in has, "v_x alone", "vx_m_s"),
        ("sideslip_rad" in has, "ground speed and sideslip", ground),
        (True, "ground speed alone", ground),
    )
    longest = max(sorted(has - {_FRICTION}), key=lambda n: len(survey[n]))
    return next(((source, base) for applies, source, base in choices if applies and base), ("none", longest))


def _find_origin(survey: Mapping[str, Channel]) -> tuple[float, float, float] | None:
    """Return the first position on Earth, ECEF in m; None without positions."""
    if "ecef_position_m" in survey:
        ecef = survey["ecef_position_m"].values[:1]
    elif {"lat_deg", "lon_deg"} <= set(survey):
        alt = survey["alt_m"].values[:1] if "alt_m" in survey else np.zeros(1)
        ecef = geometry.ecef_from_geodetic(survey["lat_deg"].values[:1], survey["lon_deg"].values[:1], alt)
    else:
        return None
    x, y, z = map(float, ecef[0])
    return x, y, z


def _find_attitude(source: "_Source") -> Attitude:
    """Choose frame and body axes such that z points up and the car moves along x; ENU and FLU when in doubt."""
    velocity = source.velocity
    frames: tuple[Literal["ENU", "ECEF", "NED"], ...]
    frames = ("ENU", "NED") if source.plan.origin is None else ("ENU", "ECEF", "NED")
    best, best_score = Attitude(frames[0], "FLU"), -np.inf
    speed = np.linalg.norm(velocity, axis=1)
    moving = speed > 1.0  # NaN compares False
    direction = velocity[moving] / speed[moving, None]
    for frame in frames:
        rotation = source.rotation(Attitude(frame, "FLU"))
        up, forward = median_known(rotation[:, 2, 2]), median_known((rotation[moving, :, 0] * direction).sum(axis=1))
        score = (1.0 if abs(up) > 0.5 else -1.0) + forward
        if score > best_score + 0.05:  # FRD axes have the same x, and the opposite z
            best, best_score = Attitude(frame, "FRD" if up < -0.5 else "FLU"), score
    left_up = source.rotation(best)[:, 2, 1]
    rolls = np.abs(left_up - median_known(left_up)) > 1e-6  # otherwise only a heading; NaN compares False
    return replace(best, has_roll=bool(rolls.any()))


# ---- columns on the ground-truth clock ----


class _Source:
    """The truth channels as columns on the base channel's stamps. ``says``: the derivation of each quantity so far."""

    def __init__(self, channels: Mapping[str, Channel], plan: TruthPlan) -> None:
        self.plan = plan
        self._channels = channels
        self.says: dict[str, str] = {}
        base = channels.get(plan.base)
        self.stamps_ns: IntArray = np.empty(0, dtype=np.int64) if base is None else base.stamps_ns

    def __contains__(self, name: str) -> bool:
        return name in self.plan.max_gap_s

    def name(self, channel: str) -> str:
        """Topic and field of a channel, for the report."""
        return self._channels[channel].source if channel in self._channels else channel

    @property
    def unknown(self) -> FloatArray:
        """A column [N] of NaN."""
        return np.full(self.stamps_ns.shape[0], np.nan)

    def column(self, name: str) -> FloatArray:
        """Return a channel at the base stamps, [N] or [N, k]; NaN in gaps."""
        channel = self._channels.get(name)
        if channel is None or name not in self:
            n, k = self.stamps_ns.shape[0], VECTOR_COLUMNS.get(name, 1)
            return np.full((n, k) if k > 1 else n, np.nan)
        if np.array_equal(channel.stamps_ns, self.stamps_ns):
            return (
                geometry.wrap_angle(channel.values) if name in _ANGLES else channel.values + 0.0
            )  # a copy, without -0
        bracket = Bracket(channel.stamps_ns, self.stamps_ns, round(self.plan.max_gap_s[name] * NS_PER_S))
        if name in _ANGLES:
            return bracket.angle(channel.values)
        if name == "quat_wxyz":
            return bracket.quaternion(channel.values)
        return bracket.linear(channel.values)

    def _from_ecef(self) -> FloatArray:
        assert self.plan.origin is not None
        lat_rad, lon_rad, _ = map(float, geometry.geodetic_from_ecef(np.array([self.plan.origin]))[0])
        return geometry.enu_from_ecef_rotation(lat_rad, lon_rad)

    @cached_property
    def position(self) -> FloatArray:
        """Position [N, 3] in the local ENU frame; an unknown height is 0."""
        if "x_m" in self and "y_m" in self:
            x, y = self.column("x_m"), self.column("y_m")
            return np.stack([x, y, np.zeros_like(x)], axis=1)
        if self.plan.origin is None:
            return np.full((self.stamps_ns.shape[0], 3), np.nan)
        if "ecef_position_m" in self:
            ecef = self.column("ecef_position_m")
        else:
            lat, lon = self.column("lat_deg"), self.column("lon_deg")
            ecef = geometry.ecef_from_geodetic(
                lat, lon, self.column("alt_m") if "alt_m" in self else np.zeros_like(lat)
            )
        return _turn(self._from_ecef(), ecef - np.array(self.plan.origin))

    @cached_property
    def velocity(self) -> FloatArray:
        """Velocity [N, 3] in the local ENU frame, differentiated from the position if there is no velocity."""
        if "enu_velocity_m_s" in self:
            return self.column("enu_velocity_m_s")
        if "ecef_velocity_m_s" in self and self.plan.origin is not None:
            return _turn(self._from_ecef(), self.column("ecef_velocity_m_s"))
        east, north, up = self.position.T
        return np.stack([*map(self.derivative, (east, north)), self.derivative(up) if up.any() else up], axis=1)

    @cached_property
    def _rotation(self) -> FloatArray:
        """Matrices [N, 3, 3] of the quaternion as mapped."""
        quat = self.column("quat_wxyz")
        return geometry.rotation_from_quat(np.where(np.linalg.norm(quat, axis=1, keepdims=True) > 1e-6, quat, np.nan))

    def rotation(self, attitude: Attitude) -> FloatArray:
        """Return matrices [N, 3, 3] that turn forward-left-up body vectors into the local ENU frame."""
        matrix = self._rotation
        if attitude.body == "FRD":
            matrix = matrix @ _FRD_TO_FLU
        if attitude.frame == "NED":
            matrix = _NED_TO_ENU @ matrix
        elif attitude.frame == "ECEF":
            matrix = self._from_ecef() @ matrix
        return np.asarray(matrix, dtype=np.float64)

    @property
    def attitude_text(self) -> str:
        """The quaternion with its convention, for the report."""
        attitude = self.plan.attitude
        return self.name("quat_wxyz") + (f", read as {attitude.body} to {attitude.frame}" if attitude else "")

    def derivative(self, values: FloatArray, *, angle: bool = False) -> FloatArray:
        """Differentiate a column [N] by time."""
        gap_ns = round(self.plan.max_gap_s[self.plan.base] * NS_PER_S)
        return differentiate(self.stamps_ns, values, self.plan.half_window, gap_ns, angle=angle)


def _turn(matrix: FloatArray, vectors: FloatArray) -> FloatArray:
    # Explicit sums, because the rounding of a matrix product may depend on the number of rows.
    return np.stack([(matrix[i] * vectors).sum(axis=1) for i in range(3)], axis=1)


def differentiate(
    stamps_ns: IntArray, values: FloatArray, half_window: int, max_gap_ns: int, *, angle: bool = False
) -> FloatArray:
    """Differentiate [N] by time: slope at the centre of a cubic fitted to 2 · half_window + 1 samples (Savitzky–Golay).

    The true stamps are used, so that jitter does not turn into noise. NaN where the window contains NaN, a step longer
    than ``max_gap_ns``, or the end of the data. ``angle``: differences to the centre are wrapped.
    """
    n, h = int(stamps_ns.shape[0]), half_window
    slope = np.full(n, np.nan)
    if n < 2 * h + 1:
        return slope
    gaps = np.concatenate([[0], np.cumsum(np.diff(stamps_ns) > max_gap_ns)])
    missing_before = np.concatenate([[0], np.cumsum(~np.isfinite(values))])
    whole = (gaps[2 * h :] == gaps[: n - 2 * h]) & (missing_before[2 * h + 1 :] == missing_before[: n - 2 * h])
    firsts = np.flatnonzero(whole)
    times, samples = (sliding_window_view(column, 2 * h + 1) for column in (stamps_ns, values))
    for start in range(0, firsts.shape[0], _CHUNK):
        first = firsts[start : start + _CHUNK]
        centre = first + h
        t = (times[first] - stamps_ns[centre][:, None]) * S_PER_NS
        span = np.maximum(t[:, -1], -t[:, 0])
        y = np.asarray(samples[first] - values[centre][:, None], np.float64)
        if angle:
            y = geometry.wrap_angle(y)
        u = t / span[:, None]
        powers = [np.ones_like(u), u, u * u, u * u * u]
        moments = [np.einsum("nk,nk->n", powers[i // 2], powers[i - i // 2]) for i in range(7)]
        normal = np.stack([np.stack(moments[i : i + 4], axis=1) for i in range(4)], axis=1)
        right = np.stack([np.einsum("nk,nk->n", power, y) for power in powers], axis=1)
        slope[centre] = np.linalg.solve(normal, right[:, :, None])[:, 1, 0] / span
    return slope


# ---- derivation ----


def _pose(source: _Source) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return x, y and yaw at the CG; without yaw, at the measurement point."""
    position, plan, says = source.position, source.plan, source.says
    if "x_m" in source and "y_m" in source:
        says["position_m"] = f"{source.name('x_m')} and {source.name('y_m')}"
    elif plan.origin is not None:
        name = "ecef_position_m" if "ecef_position_m" in source else "lat_deg"
        says["position_m"] = f"{source.name(name)} in a local ENU frame at its first sample"
    yaw = source.unknown
    if "yaw_rad" in source:
        yaw = source.column("yaw_rad")
        says["yaw_rad"] = source.name("yaw_rad")
    elif plan.attitude is not None:
        rotation = source.rotation(plan.attitude)
        yaw = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
        says["yaw_rad"] = source.attitude_text
    x_m, y_m, (px, py, _) = position[:, 0], position[:, 1], plan.position_m
    if (px, py) != (0.0, 0.0) and np.isfinite(yaw).any():
        x_m = x_m - (np.cos(yaw) * px - np.sin(yaw) * py)
        y_m = y_m - (np.sin(yaw) * px + np.cos(yaw) * py)
    return x_m, y_m, yaw


def _yaw_rate(source: _Source, yaw: FloatArray) -> FloatArray:
    if "yaw_rate_rad_s" in source:
        source.says["yaw_rate_rad_s"] = source.name("yaw_rate_rad_s")
        return source.column("yaw_rate_rad_s")
    if "yaw_rad" not in source.says:
        return source.unknown
    source.says["yaw_rate_rad_s"] = "smoothing derivative of yaw"
    return source.derivative(yaw, angle=True)


def _body_velocity(source: _Source) -> tuple[FloatArray, FloatArray]:
    """Return v_x, v_y at the measurement point of the ground truth."""
    kind, name, column, says = source.plan.velocity, source.name, source.column, source.says
    if kind in ("velocity and heading", "position and heading"):
        return _velocity_by_heading(source)
    if kind in ("ground speed and sideslip", "ground speed alone"):
        velocity, ground = source.velocity, f"ground speed of {name(source.plan.base)}"
        speed = np.hypot(velocity[:, 0], velocity[:, 1])
        if kind == "ground speed alone":
            says["vx_m_s"] = f"{ground} taken as v_x, no heading known"
            return speed, source.unknown
        says |= {"vx_m_s": f"{ground} times cos sideslip", "vy_m_s": f"{ground} times sin sideslip"}
        return speed * np.cos(column("sideslip_rad")), speed * np.sin(column("sideslip_rad"))
    if kind == "none":
        return source.unknown, source.unknown
    vx, vy = column("vx_m_s"), source.unknown
    says["vx_m_s"] = name("vx_m_s")
    if kind == "body velocity":
        says["vy_m_s"], vy = name("vy_m_s"), column("vy_m_s")
    elif kind == "v_x and sideslip":
        says["vy_m_s"] = f"v_x times tan of {name('sideslip_rad')}"
        vy = vx * np.tan(column("sideslip_rad"))
    elif kind == "v_x, course and yaw":
        says["vy_m_s"] = f"v_x times tan of {name('course_rad')} minus {name('yaw_rad')}"
        vy = vx * np.tan(geometry.wrap_angle(column("course_rad") - column("yaw_rad")))
    return vx, vy


def _velocity_by_heading(source: _Source) -> tuple[FloatArray, FloatArray]:
    velocity, attitude = source.velocity, source.plan.attitude
    if "yaw_rad" in source or attitude is None:
        yaw, by = source.column("yaw_rad"), source.name("yaw_rad")
        vx = np.cos(yaw) * velocity[:, 0] + np.sin(yaw) * velocity[:, 1]
        vy = -np.sin(yaw) * velocity[:, 0] + np.cos(yaw) * velocity[:, 1]
    else:
        rotation, by = source.rotation(attitude), source.attitude_text
        vx, vy = ((rotation[:, :, i] * velocity).sum(axis=1) for i in range(2))
    how = "smoothing derivative of " if source.plan.velocity == "position and heading" else ""
    source.says |= dict.fromkeys(
        ("vx_m_s", "vy_m_s"), f"{how}{source.name(source.plan.base)} turned into the body by {by}"
    )
    return vx, vy


def _velocity_at_cg(source: _Source, vx: FloatArray, vy: FloatArray, rate: FloatArray) -> tuple[FloatArray, FloatArray]:
    x, y, _ = source.plan.position_m
    if (x, y) == (0.0, 0.0):
        return vx, vy
    if "yaw_rate_rad_s" not in source.says:
        source.says["cg"] = f"velocities left at ({x:g}, {y:g}) m from the CG: no yaw rate to move them by"
        return vx, vy
    source.says["cg"] = f"velocities {_MOVED} from ({x:g}, {y:g}) m"
    return geometry.shift_velocity_to_cg(vx, vy, rate, (x, y))


def _sideslip(source: _Source, vx: FloatArray, vy: FloatArray) -> FloatArray:
    if "vy_m_s" in source.says:
        is_moved = _MOVED in source.says.get("cg", "")
        source.says["sideslip_rad"] = "atan2(v_y, v_x)" + (" at the CG" if is_moved else "")
        return np.arctan2(vy, vx)
    if "sideslip_rad" in source:
        source.says["sideslip_rad"] = source.name("sideslip_rad")
    return source.column("sideslip_rad")


def _lateral_acceleration(source: _Source, vx: FloatArray, vy: FloatArray, rate: FloatArray) -> FloatArray:
    says, attitude, gradient = source.says, source.plan.attitude, source.plan.roll_gradient_rad_per_m_s2
    if "ay_m_s2" in source:
        ay, (x, y, _) = source.column("ay_m_s2"), source.plan.position_m
        says["ay_m_s2"] = source.name("ay_m_s2")
        if (x, y) != (0.0, 0.0) and "yaw_rate_rad_s" in says:
            says["ay_m_s2"] += f", {_MOVED}"
            ay = ay - source.derivative(rate) * x + rate * rate * y
        return ay
    if not {"vy_m_s", "yaw_rate_rad_s"} <= says.keys():
        return source.unknown
    if attitude is None or not attitude.has_roll or gradient == 0.0:
        says["ay_m_s2"] = _AY_UNKNOWN
        return source.unknown
    says["ay_m_s2"] = _AY_DERIVED
    gravity = GRAVITY_M_S2 * source.rotation(attitude)[:, 2, 1]
    return (source.derivative(vy) + vx * rate + gravity) / (1.0 + GRAVITY_M_S2 * gradient)


# ---- dependence ----


def same_share(a: Channel, b: Channel) -> float:
    """Return the share of equal values at common stamps, or by index for equal lengths; 0 with too few samples."""
    _, i, j = np.intersect1d(a.stamps_ns, b.stamps_ns, assume_unique=True, return_indices=True)
    shares = [0.0]
    if i.size >= max(10, 0.5 * min(len(a), len(b))):
        shares.append(share_equal(a.values[i], b.values[j]))
    if len(a) == len(b) >= 10:
        shares.append(share_equal(a.values, b.values))
    return max(shares)


def share_equal(x: FloatArray, y: FloatArray) -> float:
    """Return the share of samples [N], N ≥ 1, that agree to ``SAME_RELATIVE``; 0 for a constant."""
    if np.ptp(x) == 0.0:
        return 0.0
    return float(np.mean(np.abs(x - y) <= SAME_RELATIVE * np.maximum(np.abs(x), np.abs(y))))
