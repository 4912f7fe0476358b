"""Consistency without truth: known residuals are found, a healthy drive shows none, and gaps are left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reference_car import signals_at

from pdhef_logtool.evaluation.metrics import EvaluatedDrive, MetricRow, evaluate_drive
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import make_track

T0 = 1_700_000_000_000_000_000
T = np.arange(0, 60, 0.01)
STAMPS = T0 + np.round(T * 1e9).astype(np.int64)


def drive() -> Signals:
    """Speed 20 + 4 sin(0.3 t), yaw rate 0.1 sin(0.5 t), no slip: a_x = v̇, a_y = v r exactly."""
    speed = 20 + 4 * np.sin(0.3 * T)
    rate = 0.1 * np.sin(0.5 * T)
    measured = np.where(np.arange(T.size) % 5 == 0, speed, np.nan)
    columns = {"ax_m_s2": 1.2 * np.cos(0.3 * T), "ay_m_s2": speed * rate, "yaw_rate_rad_s": rate}
    return signals_at(STAMPS, steer_rad=0.0, speed_m_s=measured, **columns)


def rows_of(tracks, signals=None, names=None, masks=None) -> list[MetricRow]:
    signals = drive() if signals is None else signals
    evaluated = EvaluatedDrive("drive", {t.name: t for t in tracks}, None, signals, masks or {}, 3.0)
    return evaluate_drive(evaluated, names)


def residuals(signals):
    return {(r.signal, r.metric): r for r in rows_of([], signals, ("residual_rms", "residual_bias"))}


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


def test_figures_of_a_segment_are_formulas_over_its_stamps_and_steps() -> None:
    n = T.size
    rng = np.random.default_rng(1)
    nis, dof = rng.chisquare(2, n), rng.choice([0.0, 1.0, 2.0], n)
    track = make_track("e", STAMPS, nis=nis, nis_dof=dof, diverged=rng.random(n) < 0.1)
    mask, has_nis, ratio = rng.random(n) < 0.7, dof > 0, nis / np.where(dof > 0, dof, 1.0)
    pairs = (has_nis & mask)[1:] & (has_nis & mask)[:-1]
    speed, step_s = 20 + 4 * np.sin(0.3 * T), 0.01
    held = speed[np.arange(n) // 5 * 5]
    expected = {
        "nis": (nis[mask & has_nis].mean(), (mask & has_nis).sum()),
        "nis_dof": (dof[mask & has_nis].mean(), (mask & has_nis).sum()),
        "diverged": (track.diverged[mask].mean(), mask.sum()),
        "nis_autocorrelation": (np.corrcoef(ratio[:-1][pairs], ratio[1:][pairs])[0, 1], pairs.sum()),
        "exposure_s": (mask.sum() * step_s, mask.sum()),
        "exposure_m": (held[mask].sum() * step_s, mask.sum()),
    }
    rows = {r.metric: (r.value, r.n) for r in rows_of([track], masks={"turn": mask}) if r.segment == "turn"}
    for metric, (value, count) in expected.items():
        assert rows[metric] == (pytest.approx(value, rel=1e-9), count)
