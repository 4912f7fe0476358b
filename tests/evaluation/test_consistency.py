"""Consistency without truth: known residuals are found, a healthy drive shows none, and gaps are left out."""

from __future__ import annotations

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
