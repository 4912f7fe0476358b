"""Angles, quaternions, lever arms, the local ENU frame and dead reckoning."""

import numpy as np

from pdhef_logtool.records.signals import S_PER_NS, FloatArray, IntArray

#: Degrees of a radian, and standard gravity.
DEGREES, GRAVITY_M_S2 = 180.0 / np.pi, 9.80665

#: Length of a degree of latitude on a sphere, m: for paths, whose shape counts. Axis and squared eccentricity of WGS84.
DEGREE_M, WGS84_A_M, WGS84_E2 = 111_200.0, 6378137.0, 6.69437999014e-3


def wrap_angle(angle_rad: FloatArray) -> FloatArray:
    """Wrap angles to [−π, π); any shape, rad."""
    turned = angle_rad + np.pi
    if ((turned < 0.0) | (turned >= 2.0 * np.pi)).any():  # the remainder is slow, and not needed within one turn
        turned = turned % (2.0 * np.pi)
    return np.asarray(turned - np.pi, dtype=np.float64)


def rotation_from_quat(quat_wxyz: FloatArray) -> FloatArray:
    """Convert Hamilton quaternions [N, 4] (w first, any norm > 0) to rotation matrices [N, 3, 3].

    The matrix rotates body vectors to the reference frame of the quaternion.
    """
    q = quat_wxyz / np.linalg.norm(quat_wxyz, axis=1, keepdims=True)
    w, x, y, z = q.T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)


def quat_from_yaw(yaw_rad: FloatArray) -> FloatArray:
    """Return quaternions [N, 4] (w, x, y, z) of rotations by ``yaw_rad`` [N] about z."""
    q = np.zeros((yaw_rad.shape[0], 4))
    q[:, 0] = np.cos(yaw_rad / 2)
    q[:, 3] = np.sin(yaw_rad / 2)
    return q


def ecef_from_geodetic(lat_deg: FloatArray, lon_deg: FloatArray, alt_m: FloatArray) -> FloatArray:
    """Convert WGS-84 latitude, longitude (deg) and ellipsoidal height (m), each [N], to ECEF [N, 3] in metres."""
    lat, lon = np.deg2rad(lat_deg), np.deg2rad(lon_deg)
    n = WGS84_A_M / np.sqrt(1.0 - WGS84_E2 * np.sin(lat) ** 2)
    to_axis = (n + alt_m) * np.cos(lat)
    z = (n * (1.0 - WGS84_E2) + alt_m) * np.sin(lat)
    return np.stack([to_axis * np.cos(lon), to_axis * np.sin(lon), z], axis=1)


def geodetic_from_ecef(ecef_m: FloatArray) -> FloatArray:
    """Convert ECEF [N, 3] in metres to latitude, longitude (rad) and height (m), [N, 3] (Bowring, then two steps)."""
    x, y, z = ecef_m.T
    lon = np.arctan2(y, x)
    p = np.hypot(x, y)
    lat = np.arctan2(z, p * (1.0 - WGS84_E2))
    for _ in range(5):
        n = WGS84_A_M / np.sqrt(1.0 - WGS84_E2 * np.sin(lat) ** 2)
        lat = np.arctan2(z + WGS84_E2 * n * np.sin(lat), p)
    n = WGS84_A_M / np.sqrt(1.0 - WGS84_E2 * np.sin(lat) ** 2)
    alt = p * np.cos(lat) + z * np.sin(lat) - n * (1.0 - WGS84_E2 * np.sin(lat) ** 2)
    return np.stack([lat, lon, alt], axis=1)


def enu_from_ecef_rotation(lat_rad: float, lon_rad: float) -> FloatArray:
    """Return the matrix [3, 3] that rotates ECEF vectors to east, north, up at a position."""
    sl, cl, so, co = np.sin(lat_rad), np.cos(lat_rad), np.sin(lon_rad), np.cos(lon_rad)
    return np.array([[-so, co, 0.0], [-sl * co, -sl * so, cl], [cl * co, cl * so, sl]])


def shift_velocity_to_cg(
    vx_m_s: FloatArray, vy_m_s: FloatArray, yaw_rate_rad_s: FloatArray, position_m: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """Move a body velocity measured at ``position_m`` (x, y from the CG, ISO 8855) to the CG.

    v_cg = v − ω × r, hence v_x + r·y and v_y − r·x.
    """
    x, y = position_m
    return vx_m_s + yaw_rate_rad_s * y, vy_m_s - yaw_rate_rad_s * x


def dead_reckon(
    stamps_ns: IntArray,
    vx_m_s: FloatArray,
    vy_m_s: FloatArray,
    yaw_rate_rad_s: FloatArray,
    start: tuple[float, float, float],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Integrate body velocity and yaw rate to a pose by the midpoint rule.

    Parameters
    ----------
    stamps_ns : int64 [N]. vx_m_s, vy_m_s, yaw_rate_rad_s : [N]; a step with a NaN end counts as no movement.
    start : x (m), y (m), yaw (rad) at the first stamp.

    Returns
    -------
    x_m, y_m, yaw_rad : [N]; yaw is not wrapped.
    """
    dt = np.diff(stamps_ns) * S_PER_NS
    ok = np.isfinite(vx_m_s + vy_m_s + yaw_rate_rad_s)
    dt = np.where(ok[1:] & ok[:-1], dt, 0.0)

    def mid(a: FloatArray) -> FloatArray:
        a = np.where(ok, a, 0.0)
        return 0.5 * (a[1:] + a[:-1])

    def accumulate(first: float, steps: FloatArray) -> FloatArray:
        return np.cumsum(np.concatenate([[first], steps]))[: len(stamps_ns)]

    yaw = accumulate(start[2], mid(yaw_rate_rad_s) * dt)
    heading = 0.5 * (yaw[1:] + yaw[:-1])
    cos, sin = np.cos(heading), np.sin(heading)
    vx, vy = mid(vx_m_s), mid(vy_m_s)
    x = accumulate(start[0], (vx * cos - vy * sin) * dt)
    y = accumulate(start[1], (vx * sin + vy * cos) * dt)
    return x, y, yaw
