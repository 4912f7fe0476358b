"""The state track, the record of estimates and ground truth."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray

#: Name of the sideslip reference in tables, files and recordings.
REFERENCE = "reference"
#: Quantities that a filter may estimate in addition to the motion.
ESTIMATED_COLUMNS = (
    "roll_rad", "bank_rad", "force_scale", "steer_bias_rad", "ay_bias_m_s2", "yaw_rate_bias_rad_s",
)  # fmt: skip
#: Shares of the information on v_y of the sideslip reference, and whether (1, 0) estimators with the same IMU may be
#: ranked by it.
SHARE_COLUMNS = ("share_law", "share_kinematics", "share_gnss", "independent")
#: Columns that only files contain, which round them to less than single precision.
FILED_COLUMNS = ("r_scale", "mixture_weight", *ESTIMATED_COLUMNS)
#: Columns of estimates.parquet in order, without ``estimator`` (the name of the track).
TRACK_COLUMNS = (
    *("stamp_ns", "vx_m_s", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad", "ay_m_s2"),
    *("x_m", "y_m", "yaw_rad"),
    *("vx_std_m_s", "vy_std_m_s", "yaw_rate_std_rad_s", "sideslip_std_rad"),
    *("network_trust", "r_scale", "nis", "friction", "valid", "diverged", "mixture_weight", "reason"),
    *ESTIMATED_COLUMNS,
    *SHARE_COLUMNS,
    "steer_rad",
)
#: Above this share of GNSS in its information the reference is independent of estimators that use the same IMU.
INDEPENDENT_SHARE = 0.5
#: Columns that a source may lack.
OPTIONAL_COLUMNS = ("mixture_weight", "reason", *ESTIMATED_COLUMNS, *SHARE_COLUMNS, "measured_speed_m_s", "steer_rad")


@dataclass(frozen=True, slots=True, eq=False)
class StateTrack:
    """Planar vehicle state over time, at the CG, ISO 8855, SI; an estimate or the ground truth.

    Every float column has shape [N]; NaN means unknown. ``covariance`` is [N, 3, 3] over [v_x, v_y, r], or empty if the
    source provides none. ``x_m``, ``y_m``, ``yaw_rad`` are in a local ENU frame. ``valid`` is False where the source
    marks its state as invalid. ``diverged`` marks the stamps at which the estimator reports divergence. ``nis`` has the
    degrees of freedom ``nis_dof`` at each stamp. ``mixture_weight`` (of all filters of an adaptive estimator except the
    first) and ``reason`` (bits of :mod:`pdhef_logtool.records.reasons`, faults of a_y and yaw rate) are [N], or empty
    if the source provides none; the same applies to roll and bank, the relative excess of all lateral forces, the
    sensor biases, and the shares of axle law, kinematics and GNSS in the sideslip reference. ``measured_speed_m_s`` of
    the ground truth is the speed of the log's sensors; it decides where sideslip is scored if v_x is unknown.
    ``steer_rad`` is the road-wheel angle that an estimator received.
    """

    name: str
    stamps_ns: IntArray
    vx_m_s: FloatArray
    vy_m_s: FloatArray
    yaw_rate_rad_s: FloatArray
    sideslip_rad: FloatArray
    ay_m_s2: FloatArray
    x_m: FloatArray
    y_m: FloatArray
    yaw_rad: FloatArray
    covariance: FloatArray
    sideslip_std_rad: FloatArray
    network_trust: FloatArray
    r_scale: FloatArray
    nis: FloatArray
    nis_dof: FloatArray
    friction: FloatArray
    valid: BoolArray
    diverged: BoolArray
    mixture_weight: FloatArray = field(default_factory=lambda: np.empty(0))
    reason: IntArray = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    roll_rad: FloatArray = field(default_factory=lambda: np.empty(0))
    bank_rad: FloatArray = field(default_factory=lambda: np.empty(0))
    force_scale: FloatArray = field(default_factory=lambda: np.empty(0))
    steer_bias_rad: FloatArray = field(default_factory=lambda: np.empty(0))
    ay_bias_m_s2: FloatArray = field(default_factory=lambda: np.empty(0))
    yaw_rate_bias_rad_s: FloatArray = field(default_factory=lambda: np.empty(0))
    share_law: FloatArray = field(default_factory=lambda: np.empty(0))
    share_kinematics: FloatArray = field(default_factory=lambda: np.empty(0))
    share_gnss: FloatArray = field(default_factory=lambda: np.empty(0))
    independent: FloatArray = field(default_factory=lambda: np.empty(0))
    measured_speed_m_s: FloatArray = field(default_factory=lambda: np.empty(0))
    steer_rad: FloatArray = field(default_factory=lambda: np.empty(0))

    def __len__(self) -> int:
        """Return the number of stamps."""
        return int(self.stamps_ns.shape[0])

    def __repr__(self) -> str:
        return f"<StateTrack {self.name}: {len(self)} stamps, {np.count_nonzero(self.valid)} valid>"

    @property
    def vx_std_m_s(self) -> FloatArray:
        """Standard deviation of v_x, [N]; NaN without covariance."""
        return self._std(0)

    @property
    def vy_std_m_s(self) -> FloatArray:
        """Standard deviation of v_y, [N]; NaN without covariance."""
        return self._std(1)

    @property
    def yaw_rate_std_rad_s(self) -> FloatArray:
        """Standard deviation of r, [N]; NaN without covariance."""
        return self._std(2)

    def _std(self, i: int) -> FloatArray:
        covariance = self.covariance
        return np.full(len(self), np.nan) if covariance.shape[0] == 0 else np.sqrt(covariance[:, i, i])

    def columns(self) -> dict[str, FloatArray | IntArray | BoolArray]:
        """Return the columns of estimates.parquet by name, in order, without missing ones."""
        return {
            c: getattr(self, "stamps_ns" if c == "stamp_ns" else c)
            for c in TRACK_COLUMNS
            if c not in OPTIONAL_COLUMNS or len(getattr(self, c)) == len(self)
        }

    def rows(self, start: int, end: int) -> "StateTrack":
        """Return the rows [start, end)."""
        n = len(self)
        columns = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "name"}
        return StateTrack(name=self.name, **{c: v[start:end] if len(v) == n else v for c, v in columns.items()})

    def between(self, start_ns: int, end_ns: int) -> "StateTrack":
        """Return the stamps in [start_ns, end_ns)."""
        return self.rows(*np.searchsorted(self.stamps_ns, (start_ns, end_ns)).tolist())

    def without_sideslip_below(self, speed_m_s: float) -> "StateTrack":
        """Return the track with sideslip NaN where its speed is lower and has no direction."""
        vy = np.where(np.isfinite(self.vy_m_s), self.vy_m_s, 0.0)
        slow = np.hypot(self.vx_m_s, vy) < speed_m_s
        if not slow.any():
            return self
        beta, std = (np.where(slow, np.nan, c) for c in (self.sideslip_rad, self.sideslip_std_rad))
        return replace(self, sideslip_rad=beta, sideslip_std_rad=std)

    @property
    def something_known(self) -> BoolArray:
        """Mask of the stamps with any finite quantity, [N]."""
        finite = np.isfinite(self.vx_m_s) | np.isfinite(self.vy_m_s) | np.isfinite(self.yaw_rate_rad_s)
        return np.asarray(finite | np.isfinite(self.sideslip_rad) | np.isfinite(self.ay_m_s2), dtype=np.bool_)


def make_track(name: str, stamps_ns: IntArray, **columns: FloatArray | IntArray | BoolArray) -> StateTrack:
    """Build a track from some columns; the others are NaN (``valid`` True, ``diverged`` False).

    ``sideslip_rad`` is atan2(v_y, v_x) by default.
    """
    n = int(stamps_ns.shape[0])
    needed = [f.name for f in fields(StateTrack) if f.name not in OPTIONAL_COLUMNS]
    values: dict[str, Any] = {c: np.broadcast_to(np.nan, n) for c in needed if c not in columns}
    values |= {"covariance": np.empty((0, 3, 3)), "valid": np.ones(n, np.bool_), "diverged": np.zeros(n, np.bool_)}
    values |= {"name": name, "stamps_ns": stamps_ns, **columns}
    if "sideslip_rad" not in columns and "vx_m_s" in columns and "vy_m_s" in columns:
        values["sideslip_rad"] = np.arctan2(columns["vy_m_s"], columns["vx_m_s"])
    return StateTrack(**values)


def diagonal_covariance(stds: Sequence[FloatArray]) -> FloatArray:
    """Return [N, 3, 3] with the variances of v_x, v_y, r and NaN off the diagonal; [0, 3, 3] if all are unknown."""
    std = np.stack(stds, axis=1)
    if not np.isfinite(std).any():
        return np.empty((0, 3, 3))
    covariance = np.full((std.shape[0], 3, 3), np.nan)
    covariance[:, range(3), range(3)] = std**2
    return covariance


def concatenate(pieces: Iterable[StateTrack], rows: int, *, single: Collection[str] = ()) -> StateTrack:
    """Join the pieces of one track of ``rows`` stamps in time order, as they are made: each column is in memory once.

    All pieces have the same columns; a missing one (:func:`make_track`) takes no memory. ``single`` : columns that are
    joined in single precision.

    Raises
    ------
    ValueError : the pieces have another number of stamps in all.
    """
    columns: dict[str, Any] = {}
    end = 0
    for piece in pieces:
        start, end, columns["name"] = end, end + len(piece), piece.name
        for name, part in ((f.name, getattr(piece, f.name)) for f in fields(piece) if f.name != "name"):
            shape = (rows if len(part) else 0, *part.shape[1:])
            if part.strides == (0,):
                columns.setdefault(name, np.broadcast_to(part[:1], shape))
                continue
            if name not in columns:
                columns[name] = np.empty(shape, np.float32 if name in single else part.dtype)
            columns[name][start:end] = part
    if end != rows:
        raise ValueError(f"expected pieces with {rows} stamps in all, got {end}")
    return StateTrack(**columns)


def scaled_covariance(covariance: FloatArray, of_vy: FloatArray) -> FloatArray:
    """Return covariances [N, 3, 3] with factors [N] on the 1-sigma of v_y; correlations stay."""
    scaled = covariance.copy()
    scaled[:, 1] *= of_vy[:, None]
    scaled[:, :, 1] *= of_vy[:, None]
    return scaled
