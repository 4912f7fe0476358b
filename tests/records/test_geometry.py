"""Geometry against scipy, known places and closed forms."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation
from scipy.special import ndtri, stdtrit

from pdhef_logtool.records import geometry
from pdhef_logtool.records.running_mean import running_mean
from pdhef_logtool.records.student import student_quantile

exact = settings(derandomize=True, deadline=None, max_examples=100)
angles = st.floats(-50.0, 50.0)


@exact
@given(angles)
def test_wrapped_angle_is_the_same_direction_in_one_turn(angle):
    wrapped = float(geometry.wrap_angle(np.array([angle]))[0])
    assert -math.pi <= wrapped < math.pi
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-12)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-12)


@exact
@given(st.lists(st.tuples(*[st.floats(-10, 10)] * 4), min_size=1, max_size=8))
def test_rotation_of_a_quaternion_agrees_with_scipy(quats):
    q = np.array([x for x in quats if np.linalg.norm(x) > 1e-3] or [(1.0, 0, 0, 0)], dtype=float)
    want = Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_matrix()  # scipy puts w last
    np.testing.assert_allclose(geometry.rotation_from_quat(q), want, atol=1e-12)


@exact
@given(st.lists(angles, min_size=1, max_size=8))
def test_quaternion_of_a_yaw_turns_about_the_vertical(yaws):
    q = geometry.quat_from_yaw(np.array(yaws))
    np.testing.assert_allclose(
        geometry.rotation_from_quat(q), Rotation.from_rotvec([[0, 0, a] for a in yaws]).as_matrix(), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-15)


WGS84_B_M = 6356752.314245


@pytest.mark.parametrize(
    ("lat", "lon", "alt", "ecef"),
    [
        (0.0, 0.0, 0.0, (6378137.0, 0.0, 0.0)),
        (0.0, 90.0, 100.0, (0.0, 6378237.0, 0.0)),
        (90.0, 0.0, 0.0, (0.0, 0.0, WGS84_B_M)),
        (-90.0, 45.0, 10.0, (0.0, 0.0, -WGS84_B_M - 10.0)),
        # latitude 45: N = a / sqrt(1 - e2 / 2), in closed form
        (45.0, 180.0, 0.0, (-4517590.878848, 0.0, 4487348.408802)),
    ],
)
def test_known_places(lat, lon, alt, ecef):
    got = geometry.ecef_from_geodetic(np.array([lat]), np.array([lon]), np.array([alt]))[0]
    np.testing.assert_allclose(got, ecef, atol=1e-4)


@exact
@given(st.floats(-89.9, 89.9), st.floats(-179.9, 179.9), st.floats(-500.0, 20_000.0))
def test_geodetic_round_trip(lat, lon, alt):
    ecef = geometry.ecef_from_geodetic(np.array([lat]), np.array([lon]), np.array([alt]))
    back = geometry.geodetic_from_ecef(ecef)[0]
    assert np.rad2deg(back[0]) == pytest.approx(lat, abs=1e-9)  # 0.1 mm
    assert np.rad2deg(back[1]) == pytest.approx(lon, abs=1e-9)
    assert back[2] == pytest.approx(alt, abs=1e-4)


@exact
@given(st.floats(-80, 80), st.floats(-179, 179), st.floats(-1.5, 1.5), st.floats(-1.5, 1.5), st.floats(-1.5, 1.5))
def test_local_frame_points_east_north_and_up(lat, lon, east, north, up):
    """Small moves of latitude, longitude and height, in metres of the ellipsoid's own radii, come back as e, n, u."""
    phi = math.radians(lat)
    a, e2 = 6378137.0, 6.69437999014e-3
    across = a / math.sqrt(1 - e2 * math.sin(phi) ** 2)
    along = a * (1 - e2) / (1 - e2 * math.sin(phi) ** 2) ** 1.5
    here = geometry.ecef_from_geodetic(np.array([lat]), np.array([lon]), np.array([50.0]))
    there = geometry.ecef_from_geodetic(
        np.array([lat + math.degrees(north / (along + 50.0))]),
        np.array([lon + math.degrees(east / ((across + 50.0) * math.cos(phi)))]),
        np.array([50.0 + up]),
    )
    R = geometry.enu_from_ecef_rotation(phi, math.radians(lon))
    np.testing.assert_allclose(R @ (there - here)[0], [east, north, up], atol=1e-5)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(R) == pytest.approx(1.0)


@exact
@given(*[st.floats(-20, 20)] * 3, st.floats(-2, 2), st.floats(-1, 1))
def test_lever_arm_is_the_cross_product(vx, vy, r, x, y):
    """A sensor at p on a rigid body moves with v + w x p; taking that off gives the centre's velocity back."""
    at_sensor = np.array([vx, vy, 0.0]) + np.cross([0, 0, r], [x, y, 0.0])
    got = geometry.shift_velocity_to_cg(np.array([at_sensor[0]]), np.array([at_sensor[1]]), np.array([r]), (x, y))
    assert got[0][0] == pytest.approx(vx, abs=1e-10)
    assert got[1][0] == pytest.approx(vy, abs=1e-10)


def circle_error(steps: int, start=(3.0, -2.0, 0.7)) -> float:
    """Largest position error over a turn with a growing rate, where the pose is known in closed form."""
    t = np.linspace(0.0, 6.0, steps + 1)
    r = 0.2 + 0.1 * t
    yaw = start[2] + 0.2 * t + 0.05 * t**2
    # course chi = yaw + beta with beta = 0.1 t, speed r_total * radius, so that the path is a circle of 30 m
    chi = yaw + 0.1 * t
    speed = 30.0 * (r + 0.1)
    vx, vy = speed * np.cos(0.1 * t), speed * np.sin(0.1 * t)
    x, y, got_yaw = geometry.dead_reckon(np.round(t * 1e9).astype(np.int64), vx, vy, r, start)
    want_x = start[0] + 30.0 * (np.sin(chi) - math.sin(start[2]))
    want_y = start[1] - 30.0 * (np.cos(chi) - math.cos(start[2]))
    np.testing.assert_allclose(got_yaw, yaw, atol=1e-7)
    return float(np.hypot(x - want_x, y - want_y).max())


def test_dead_reckoning_of_a_circle_converges_with_the_square_of_the_step():
    errors = [circle_error(n) for n in (50, 100, 200, 400)]
    assert errors[-1] < 2e-3
    for coarse, fine in pairwise(errors):
        assert math.log2(coarse / fine) == pytest.approx(2.0, abs=0.1)


def test_dead_reckoning_stands_still_where_an_end_of_a_step_is_unknown():
    vx = np.array([2.0, 2.0, np.nan, 2.0, 2.0])
    x, _, _ = geometry.dead_reckon(np.arange(5) * 10**9, vx, np.zeros(5), np.zeros(5), (1.0, 0.0, 0.0))
    assert x.tolist() == [1.0, 3.0, 3.0, 3.0, 5.0]


def test_angles_beyond_a_turn_change_none_beside_them():
    within = np.array([-np.pi, -1e-300, -0.0, 0.0, 3.0, np.nextafter(np.pi, 0.0), np.nan])
    alone, beside = geometry.wrap_angle(within), geometry.wrap_angle(np.append(within, [7.0, -9.0]))
    assert alone.tobytes() == beside[:-2].tobytes()
    assert ((beside[:-1] >= -np.pi) & (beside[:-1] < np.pi))[:-2][:6].all()


@given(st.floats(0.6, 0.9999), st.integers(1, 3000))
def test_quantiles_are_those_of_scipy(share, freedom):
    assert student_quantile(share, freedom) == pytest.approx(stdtrit(freedom, share), rel=1e-9)
    assert student_quantile(share, math.inf) == pytest.approx(ndtri(share), rel=1e-12)


def test_a_running_mean_is_of_the_finite_rows_around_by_their_weights():
    mean = running_mean(np.array([1.0, 2.0, np.nan, 6.0]), 1, np.array([1.0, 3.0, 1.0, 1.0]))
    np.testing.assert_allclose(mean, [1.75, 1.75, 3.0, 6.0])
