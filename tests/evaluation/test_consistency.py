"""Consistency without truth: known residuals are found, a healthy drive shows none, and gaps are left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pdhef_logtool.evaluation.metrics import MetricRow, score_track
from pdhef_logtool.evaluation.metrics.disagreement import disagreement_rows
from pdhef_logtool.evaluation.metrics.innovations import state_rows
from pdhef_logtool.evaluation.metrics.sensor_residuals import sensor_rows
from pdhef_logtool.evaluation.metrics.whiteness import whiteness_rows
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import make_track

T0 = 1_700_000_000_000_000_000
T = np.arange(0, 60, 0.01)
STAMPS = T0 + np.round(T * 1e9).astype(np.int64)
EVERYTHING = {"all": np.ones(T.size, bool)}


def drive() -> Signals:
    """Speed 20 + 4 sin(0.3 t), yaw rate 0.1 sin(0.5 t), no slip: a_x = v̇, a_y = v r exactly."""
    speed = 20 + 4 * np.sin(0.3 * T)
    rate = 0.1 * np.sin(0.5 * T)
    return Signals(
        stamps_ns=STAMPS,
        ready_ns=STAMPS,
        steer_rad=np.zeros(T.size),
        ax_m_s2=1.2 * np.cos(0.3 * T),
        ay_m_s2=speed * rate,
        yaw_rate_rad_s=rate,
        speed_m_s=np.where(np.arange(T.size) % 5 == 0, speed, np.nan),
        friction=np.full(T.size, np.nan),
        wheel_speed_m_s=np.full((T.size, 4), np.nan),
    )


def residuals(signals):
    rows = sensor_rows(signals, EVERYTHING, log="drive", low_speed_m_s=3.0)
    return {(r.signal, r.metric): r for r in rows}


def test_consistent_sensors_leave_no_residual():
    rows = residuals(drive())
    assert rows["ay_m_s2", "residual_rms"].value < 2e-3
    assert rows["vx_m_s", "residual_rms"].value < 1e-4
    assert rows["vx_m_s", "residual_rms"].n == T.size // 5 - 20


def test_bias_bank_and_grade_are_seen_with_their_sign_and_size():
    s = drive()
    rows = residuals(replace(s, ay_m_s2=s.ay_m_s2 + 0.3, ax_m_s2=s.ax_m_s2 + 0.25))
    assert rows["ay_m_s2", "residual_bias"].value == pytest.approx(0.3, abs=2e-3)
    assert rows["vx_m_s", "residual_bias"].value == pytest.approx(-0.25, abs=1e-3)  # over one second
    assert rows["ay_m_s2", "residual_bias"].unit == "m/s^2"
    assert rows["ay_m_s2", "residual_bias"].estimator == "sensors"


def test_no_integration_across_a_dropout_and_no_rows_without_a_sensor():
    s = drive()
    ax = s.ax_m_s2.copy()
    ax[3000:3100] = np.nan
    rows = residuals(replace(s, ax_m_s2=ax))
    assert rows["vx_m_s", "residual_rms"].value < 1e-4
    assert rows["vx_m_s", "residual_rms"].n < T.size // 5 - 20
    nan = np.full(T.size, np.nan)
    assert residuals(replace(s, speed_m_s=nan)) == {}
    assert {k[0] for k in residuals(replace(s, ax_m_s2=nan))} == {"ay_m_s2"}


def test_below_the_blend_a_y_says_nothing():
    s = drive()
    assert {k[0] for k in residuals(replace(s, speed_m_s=s.speed_m_s * 0.05))} == {"vx_m_s"}


def test_white_and_coloured_innovations():
    rng = np.random.default_rng(0)
    white = rng.chisquare(2, T.size)
    noise = rng.normal(size=(T.size, 2))
    for i in range(1, T.size):  # a first-order process with correlation 0.9, unit variance
        noise[i] = 0.9 * noise[i - 1] + np.sqrt(1 - 0.81) * noise[i]
    coloured = (noise**2).sum(axis=1)
    dof = np.full(T.size, 2.0)
    for nis, expected, slack in ((white, 0.0, 2.6 / T.size**0.5), (coloured, 0.81, 0.08)):
        track = make_track("ukf", STAMPS, nis=nis, nis_dof=dof)
        (row,) = whiteness_rows(track, EVERYTHING, log="drive")
        assert row.value == pytest.approx(expected, abs=slack)
        rows = {r.metric: r.value for r in state_rows(track, EVERYTHING, log="drive")}
        assert rows["nis"] == pytest.approx(2.0, rel=0.1)
        assert rows["nis_dof"] == 2.0
    assert whiteness_rows(make_track("zero", STAMPS), EVERYTHING, log="drive") == []


def test_disagreement_is_pairwise_above_the_blend_and_wraps():
    fast = np.where(T < 30, 10.0, 1.0)

    def track(name, beta):
        return make_track(name, STAMPS, vx_m_s=fast, sideslip_rad=np.where(T < 30, beta, 3.0))

    tracks = [track("a", 0.0), track("b", 0.02), track("c", 2 * np.pi - 0.01)]
    rows = disagreement_rows(tracks, EVERYTHING, log="drive", low_speed_m_s=3.0)
    values = {r.estimator: r.value for r in rows}
    assert values == pytest.approx({"a~b": 0.02, "a~c": 0.01, "b~c": 0.03})
    assert all(r.n == 3000 for r in rows)


def test_rows_of_a_filter_are_filed_under_log_estimator_and_segment() -> None:
    n = 40
    stamps = 10**18 + np.arange(n, dtype=np.int64) * 10_000_000
    nis = np.where(np.arange(n) % 2, 1.0, 3.0)
    speed, zero, dof = np.full(n, 20.0), np.zeros(n), np.full(n, 2.0)
    track = make_track("e", stamps, vx_m_s=speed, vy_m_s=zero, nis=nis, nis_dof=dof, diverged=np.arange(n) < 4)
    other = make_track("f", stamps, vx_m_s=speed, vy_m_s=speed * np.tan(0.01))
    masks = {"turn": np.arange(n) < 20}

    def filed(rows: list[MetricRow]) -> list[tuple]:
        return [(r.log, r.estimator, r.signal, r.segment, r.metric, round(r.value, 9), r.unit, r.n) for r in rows]

    turn = ("drive", "e", "state", "turn")
    assert filed(whiteness_rows(track, masks, log="drive")) == [(*turn, "nis_autocorrelation", -1.0, "1", 19)]
    (pair,) = filed(disagreement_rows([track, other], masks, log="drive", low_speed_m_s=3.0))
    assert pair == ("drive", "e~f", "sideslip_rad", "turn", "disagreement_rms", 0.01, "rad", 20)
    state = [r for r in filed(score_track(track, other, masks, log="drive", low_speed_m_s=3.0)) if r[2] == "state"]
    of_nis = {r[4]: r for r in state if r[3] == "turn" and r[4].startswith("nis")}
    assert of_nis == {"nis": (*turn, "nis", 2.0, "1", 20), "nis_dof": (*turn, "nis_dof", 2.0, "1", 20)}
    assert [r[5] for r in state if r[3:5] == ("turn", "diverged")]
