"""Named signals: columns on their own clocks, and their aligned form on the IMU's stamps."""

from collections.abc import Callable, Collection
from dataclasses import dataclass, field, fields, replace
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]

S_PER_NS, NS_PER_S = 1e-9, 1_000_000_000
#: Divisors that may be 0 are at least this; km/h of 1 m/s.
LEAST_DIVISOR, KM_H = 1e-12, 3.6

WHEELS = ("fl", "fr", "rl", "rr")

#: SI units by the ending of a name; a name without any is a plain number.
_UNITS = {"_m_s2": "m/s^2", "_rad_s": "rad/s", "_m_s": "m/s", "_rad": "rad", "_deg": "deg", "_m": "m"}


def _with_units(*names: str) -> dict[str, str]:
    """Return the units of names."""
    return {name: next((unit for ending, unit in _UNITS.items() if name.endswith(ending)), "1") for name in names}


#: All signals of mappings, with their SI units (ISO 8855: x forward, y left, z up, positive left).
SIGNAL_UNITS = _with_units(
    *("steer_rad", "steering_wheel_rad"),  # the mean road-wheel angle, and the driver's
    *("ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "roll_rate_rad_s", "pitch_rate_rad_s", "speed_m_s"),
    *(f"wheel_speed_{w}_{unit}" for unit in ("m_s", "rad_s") for w in WHEELS),
    *("gnss_velocity_east_m_s", "gnss_velocity_north_m_s", "gnss_speed_m_s"),  # of the antenna, Doppler
    "gnss_course_rad",  # ENU: counter-clockwise from east
    "gnss_velocity_accuracy_m_s",  # from the receiver, 1-sigma
    "gnss_fix_type",  # below 1: no position
    *("gnss_latitude_deg", "gnss_longitude_deg"),  # of the antenna
    "gnss_position_accuracy_m",  # horizontal, from the receiver, 1-sigma
    "gnss_heading_rad",  # of two antennas, ENU: only if mapped by hand
    "friction",
)

#: All truth channels of mappings, with their units. ``*_ecef*``, ``enu_*`` have 3 columns, ``quat_wxyz`` 4.
TRUTH_UNITS = _with_units(
    *("vx_m_s", "vy_m_s", "sideslip_rad", "yaw_rate_rad_s", "ax_m_s2", "ay_m_s2"),
    *("x_m", "y_m", "lat_deg", "lon_deg", "alt_m"),
    *("ecef_position_m", "ecef_velocity_m_s", "enu_velocity_m_s", "quat_wxyz"),
    *("course_rad", "yaw_rad"),  # ENU: counter-clockwise from east
    *("position_std_m", "friction"),
)

#: All quantities of recorded estimates, with their units. ``valid`` is 0 where the estimate must not be used.
ESTIMATE_UNITS = _with_units(
    *("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad", "ay_m_s2"),
    *("vx_std_m_s", "vy_std_m_s", "yaw_rate_std_rad_s", "sideslip_std_rad"),
    *("valid", "diverged"),
)

#: Prefix of the names of all GNSS signals.
GNSS = "gnss_"
#: GNSS velocity by its components, or as speed and course.
GNSS_COMPONENTS = frozenset({"gnss_velocity_east_m_s", "gnss_velocity_north_m_s"})
#: GNSS position.
GNSS_POSITION = ("gnss_latitude_deg", "gnss_longitude_deg")
#: Signals and ground truth with a position on Earth.
POSITIONS = frozenset({*GNSS_POSITION, "lat_deg", "lon_deg", "alt_m", "x_m", "y_m", "ecef_position_m"})
#: Signals with one column each in the output of the alignment.
ALIGNED_SIGNALS = ("steer_rad", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s", "friction")


@dataclass(frozen=True, slots=True)
class Loss:
    """A part of the input that was not used, and the reason.

    ``severity`` ``"lost"`` means that data of the log are missing (exit code 3); ``"note"`` is information for the
    report.
    """

    kind: str  # short slug: "truncated", "bad-chunk", "nan", "duplicate-stamp", "gap", ...
    what: str  # one sentence for a person
    where: str  # file, topic or signal
    start_ns: int | None = None
    end_ns: int | None = None
    count: int | None = None
    severity: Literal["lost", "note"] = "lost"


@dataclass(frozen=True, slots=True, eq=False)
class Channel:
    """One mapped signal on its own clock, in SI units.

    Attributes
    ----------
    name : signal or ground truth name.
    unit : SI unit.
    source : topic and dotted field, as ``/topic.field``.
    stamps_ns : int64 [N], measurement time (stamp − latency, in the log's clock), ascending and unique.
    arrival_ns : int64 [N], arrival at the recorder (log time); never before ``stamps_ns``.
    values : float64 [N] or [N, k]; finite.
    """

    name: str
    unit: str
    source: str
    stamps_ns: IntArray
    arrival_ns: IntArray
    values: FloatArray

    def __len__(self) -> int:
        """Return the number of samples."""
        return int(self.stamps_ns.shape[0])

    def take(self, which: slice | BoolArray) -> "Channel":
        """Return the samples of a slice or of a mask [N]."""
        stamps, arrival, values = self.stamps_ns[which], self.arrival_ns[which], self.values[which]
        return Channel(self.name, self.unit, self.source, stamps, arrival, values)

    def between(self, start_ns: int, end_ns: int | None = None) -> "Channel":
        """Return the samples with stamps in [start_ns, end_ns); ``end_ns`` None includes the last one."""
        first = int(np.searchsorted(self.stamps_ns, start_ns))
        return self.take(slice(first, None if end_ns is None else int(np.searchsorted(self.stamps_ns, end_ns))))


@dataclass(frozen=True, slots=True, eq=False)
class Signals:
    """Inputs of an estimator, aligned on the IMU's stamps; contains no ground truth.

    All columns have length N and NaN where the channel has no usable sample. ``speed_m_s`` and the columns of
    ``wheel_speed_m_s`` are finite only at the first stamp after a new sample (a measurement is used once);
    ``steer_rad``, ``ax_m_s2`` are inputs and are interpolated or held within the alignment's limits.

    Attributes
    ----------
    stamps_ns : int64 [N], strictly increasing, irregular steps kept.
    ready_ns : int64 [N], non-decreasing: arrival of the last sample that is used up to this stamp.
    steer_rad, ax_m_s2, ay_m_s2, yaw_rate_rad_s, speed_m_s, friction : float64 [N].
    wheel_speed_m_s : float64 [N, 4] in the order fl, fr, rl, rr.
    available : names of the signals that the log's mapping provides.
    gnss_velocity_m_s : float64 [N, 2], east and north, of the antenna, finite only at the first stamp after a new
        sample. gnss_velocity_std_m_s : float64 [N], from the receiver. gnss_late_s : float64 [N], time from the stamp
        to the arrival of a velocity that ``ready_ns`` does not wait for.
    gnss_position_deg : float64 [N, 2], latitude and longitude; gnss_heading_rad : float64 [N].
    roll_rate_rad_s, pitch_rate_rad_s : float64 [N]. Missing columns are filled with NaN.
    extra_variance : float64 [N, 2], variance of a_y and yaw rate in excess of the usual one, m²/s⁴ and rad²/s².
    faults : float64 [N], bits of :mod:`pdhef_logtool.records.reasons`.
    before_ns : int64 [1], stamp before the first one; [0] at the start of a drive.
    """

    stamps_ns: IntArray
    ready_ns: IntArray
    steer_rad: FloatArray
    ax_m_s2: FloatArray
    ay_m_s2: FloatArray
    yaw_rate_rad_s: FloatArray
    speed_m_s: FloatArray
    friction: FloatArray
    wheel_speed_m_s: FloatArray
    available: frozenset[str] = field(default_factory=frozenset)
    gnss_velocity_m_s: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    gnss_velocity_std_m_s: FloatArray = field(default_factory=lambda: np.empty(0))
    gnss_late_s: FloatArray = field(default_factory=lambda: np.empty(0))
    gnss_position_deg: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    gnss_heading_rad: FloatArray = field(default_factory=lambda: np.empty(0))
    roll_rate_rad_s: FloatArray = field(default_factory=lambda: np.empty(0))
    pitch_rate_rad_s: FloatArray = field(default_factory=lambda: np.empty(0))
    extra_variance: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    faults: FloatArray = field(default_factory=lambda: np.empty(0))
    before_ns: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))

    def __post_init__(self) -> None:
        """Fill missing columns with NaN, which takes no memory and cannot be written."""
        for name in SIGNAL_COLUMNS:
            column = getattr(self, name)
            if len(column) != len(self):
                object.__setattr__(self, name, np.broadcast_to(np.nan, (len(self), *column.shape[1:])))

    def __len__(self) -> int:
        """Return the number of stamps."""
        return int(self.stamps_ns.shape[0])

    def __repr__(self) -> str:
        return f"<Signals: {len(self)} stamps of {', '.join(sorted(self.available))}>"

    @property
    def steps_s(self) -> FloatArray:
        """Duration before each stamp, [N]; NaN at the start of a drive."""
        return step_durations_s(np.append(self.before_ns, self.stamps_ns))[len(self.before_ns) :]

    def rows(self, start: int, end: int) -> "Signals":
        """Return the stamps [start, end)."""
        before_ns = self.stamps_ns[start - 1 : start] if start else self.before_ns
        return replace(self._with(lambda column: column[start:end]), before_ns=before_ns)

    def copy(self) -> "Signals":
        """Return the same signals in arrays that may be written."""
        return self._with(np.ndarray.copy)

    def read_only(self) -> "Signals":
        """Return the same signals in views that cannot be written."""
        signals = self._with(np.ndarray.view)
        for name in SIGNAL_COLUMNS:
            getattr(signals, name).setflags(write=False)
        return signals

    def _with(self, function: Callable[[Any], Any]) -> "Signals":
        """Return the signals with a function of each column."""
        return replace(self, **{name: function(getattr(self, name)) for name in SIGNAL_COLUMNS})


SIGNAL_COLUMNS = tuple(f.name for f in fields(Signals) if f.name not in ("available", "before_ns"))


def step_durations_s(stamps_ns: IntArray) -> FloatArray:
    """Return the duration before each step, [K]; NaN at the first one."""
    return np.append(np.full(min(len(stamps_ns), 1), np.nan), np.diff(stamps_ns) * S_PER_NS)


def has_gnss(names: Collection[str]) -> bool:
    """Return whether signals contain a GNSS velocity: its components, or speed and course."""
    return any(names_of <= set(names) for names_of in (GNSS_COMPONENTS, {"gnss_speed_m_s", "gnss_course_rad"}))


def has_position(names: Collection[str]) -> bool:
    """Return whether signals contain a GNSS position."""
    return set(GNSS_POSITION) <= set(names)


def is_dated(stamp_ns: float) -> bool:
    """Return whether a stamp in ns is a date: before 1973 it counts from another start, of a log or a simulation."""
    return stamp_ns >= 10**17
