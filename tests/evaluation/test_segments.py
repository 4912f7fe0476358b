"""Segments: a drive staged from known manoeuvres, mirror symmetry, gaps, and intervals that give the masks back."""

from __future__ import annotations

import numpy as np
import pytest
from reference_car import signals_at

from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.evaluation.segments import driven_speed, find_intervals, moving_mask, segment_masks
from pdhef_logtool.evaluation.smoothing import smooth
from pdhef_logtool.records.tracks import make_track

T0 = 1_700_000_000_000_000_000
VEHICLE = default_vehicle()  # friction 0.85, blend 3 m/s


def staged():
    """0–10 stand, 10–15 accelerate, 15–25 straight, 25–30 left, 35–40 right, 45–51 slalom, 55–58 brake, to 65."""
    t = np.arange(0, 65, 0.01)
    speed = np.interp(t, [0, 10, 15, 55, 58, 65], [0, 0, 20, 20, 8, 8])
    ax = np.select([(t >= 10) & (t < 15), (t >= 55) & (t < 58)], [4.0, -4.0], 0.0)
    ay = np.select([(t >= 25) & (t < 30), (t >= 35) & (t < 40)], [3.0, -6.0], 0.0)
    ay = np.where((t >= 45) & (t < 51), 3.0 * np.sin(2 * np.pi * 0.5 * (t - 45)), ay)
    return t, speed, ax, ay


def signals(t, speed, ax, ay, noise=0.0, friction=np.nan):
    rng = np.random.default_rng(0)
    n = t.size
    measured = np.where(np.arange(n) % 5 == 0, speed, np.nan)  # a measurement every 50 ms
    rate = np.where(speed > 1, ay / np.maximum(speed, 1), 0.0)
    return signals_at(
        T0 + np.round(t * 1e9).astype(np.int64),
        steer_rad=ay * (2.87 / np.maximum(speed, 1.0) ** 2 + 0.003),
        ax_m_s2=ax + rng.normal(0, noise, n),
        ay_m_s2=ay + rng.normal(0, noise, n),
        yaw_rate_rad_s=rate,
        speed_m_s=measured,
        friction=friction,
    )


def spans(masks, stamped, name):
    return [((s.start_ns - T0) * 1e-9, (s.end_ns - T0) * 1e-9) for s in find_intervals(stamped, {name: masks[name]})]


EXPECTED = {
    "standstill": [(0, 10)],
    "accelerating": [(10, 15)],
    "cornering-left": [(25, 30)],
    "cornering-right": [(35, 40)],
    "slalom": [(45, 51)],
    "braking": [(55, 58)],
    "straight": [(11, 25), (30, 35), (40, 45), (51, 65)],
}


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_staged_manoeuvres_are_found_where_they_are(noise):
    s = signals(*staged(), noise=noise)
    masks = segment_masks(s, None, VEHICLE)
    assert masks["all"].all()
    for name, expected in EXPECTED.items():
        found = spans(masks, s, name)
        assert len(found) == len(expected), (name, found)
        np.testing.assert_allclose(found, expected, atol=0.35, err_msg=name)


def test_mirror():
    t, speed, ax, ay = staged()
    a = segment_masks(signals(t, speed, ax, ay), None, VEHICLE)
    b = segment_masks(signals(t, speed, ax, -ay), None, VEHICLE)
    swap = {"cornering-left": "cornering-right", "cornering-right": "cornering-left"}
    for name, mask in a.items():
        np.testing.assert_array_equal(mask, b[swap.get(name, name)], err_msg=name)


def test_grip_use_follows_friction():
    s = signals(*staged())
    t = (s.stamps_ns - T0) * 1e-9
    left, right = (t > 26) & (t < 29), (t > 36) & (t < 39)
    masks = segment_masks(s, None, VEHICLE)  # 3 m/s² is 0.36 of 0.85 g, 6 m/s² is 0.72 of it
    assert not masks["linear"][left].any()
    assert not masks["nonlinear"][left].any()
    assert masks["nonlinear"][right].all()
    slippery = segment_masks(signals(*staged(), friction=0.5), None, VEHICLE)  # 3 m/s² is 0.61 of 0.5 g
    assert slippery["nonlinear"][left].all()
    unknown = segment_masks(s, None, VEHICLE.model_copy(update={"friction": None}))  # 3 m/s² is 0.31 of g
    assert not unknown["linear"][left].any()
    assert not (masks["linear"] & masks["nonlinear"]).any()


def test_the_truth_is_preferred_and_its_gaps_are_in_no_segment():
    t, speed, ax, ay = staged()
    s = signals(t, speed, ax, 0 * ay)
    hole = (t > 27) & (t < 27.3)
    truth = make_track(
        "truth", s.stamps_ns, vx_m_s=speed, yaw_rate_rad_s=s.yaw_rate_rad_s, ay_m_s2=np.where(hole, np.nan, ay)
    )
    masks = segment_masks(s, truth, VEHICLE)
    assert not masks["straight"][(t > 26) & (t < 29)].any()
    for name in ("linear", "nonlinear", "cornering-left"):
        assert not masks[name][hole].any()
    assert masks["cornering-left"][(t > 25.3) & (t < 27)].all()


def test_a_gap_in_the_stamps_ends_an_interval_and_is_not_smoothed_across():
    t, speed, ax, ay = staged()
    keep = (t < 27) | (t > 28)
    s = signals(t[keep], speed[keep], ax[keep], ay[keep])
    found = spans(segment_masks(s, None, VEHICLE), s, "cornering-left")
    np.testing.assert_allclose(found, [(25, 27), (28, 30)], atol=0.1)
    step = np.where(t[keep] < 27.5, 0.0, 5.0)
    np.testing.assert_allclose(smooth(s.stamps_ns, step, 1.0), step, atol=1e-12)


def test_a_car_moves_in_reverse_too_and_may_move_where_its_speed_is_unknown():
    t, speed, ax, ay = staged()
    s = signals(t, speed, ax, ay)
    truth = make_track("truth", s.stamps_ns, vx_m_s=-speed)
    np.testing.assert_array_equal(driven_speed(s, truth), speed)
    assert moving_mask(s, truth, VEHICLE)[speed > 5.0].all()
    assert moving_mask(signals(t, np.nan * speed, ax, ay), None, VEHICLE).all()


def test_an_interval_ends_behind_its_last_stamp_and_a_car_at_rest_does_not_brake():
    t, speed, ax, ay = staged()
    s = signals(t, speed, np.where(t < 8, -4.0, ax), ay)
    masks = segment_masks(s, None, VEHICLE)
    (whole,) = find_intervals(s, {"all": masks["all"]})
    assert whole.end_ns == s.stamps_ns[-1] + 1
    assert not masks["braking"][t < 8].any()
