"""Metrics against one-line numpy formulas, known lags, calibrated Gaussians and closed-form positions."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from pdhef_logtool.evaluation.dead_reckoned import lateral_errors, position_error
from pdhef_logtool.evaluation.metrics import EvaluatedDrive, evaluate_drive
from pdhef_logtool.evaluation.metrics.errors import lag_s
from pdhef_logtool.evaluation.metrics.innovations import nees
from pdhef_logtool.records.tracks import StateTrack, make_track

T0 = 1_700_000_000_000_000_000


def stamps_of(n):
    return T0 + np.arange(n, dtype=np.int64) * 10_000_000


def track(name="x", n=4, **columns) -> StateTrack:
    stamps = columns.pop("stamps_ns", stamps_of(n))
    return make_track(
        name, stamps, **{k: np.asarray(v, dtype=bool if k == "valid" else float) for k, v in columns.items()}
    )


def score(estimate, truth, masks=None, low=3.0, dependent=()):
    drive = EvaluatedDrive("drive", {estimate.name: estimate}, truth, None, masks or {}, low, dependent=dependent)
    rows = evaluate_drive(drive)
    keys = [(r.signal, r.segment, r.metric) for r in rows]
    assert len(set(keys)) == len(keys)
    return dict(zip(keys, rows, strict=True))


#: Each formula over the errors, ground truth and 1-sigma of the scored stamps.
ORACLES = {
    "rmse": lambda e, truth, std: np.sqrt(np.mean(e**2)),
    "mae": lambda e, truth, std: np.mean(np.abs(e)),
    "bias": lambda e, truth, std: np.mean(e),
    "p95_abs": lambda e, truth, std: np.percentile(np.abs(e), 95),
    "max_abs": lambda e, truth, std: np.abs(e).max(),
    "rmse_relative": lambda e, truth, std: np.sqrt(np.mean(e**2) / np.mean(truth**2)),
    "coverage95": lambda e, truth, std: np.mean(np.abs(e) <= 1.959963984540054 * std),
}
SIGNALS = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad")


def holed(rng, values, share=0.2):
    return np.where(rng.random(len(values)) < share, np.nan, values)


@settings(derandomize=True, max_examples=40, deadline=None)
@given(seed=st.integers(0, 10**6), n=st.integers(1, 60))
def test_every_error_figure_is_its_formula_over_the_scored_stamps(seed, n):
    rng = np.random.default_rng(seed)
    motion = [rng.normal([10.0, 0.0, 0.0], 1.0, (n, 3)).T for _ in range(2)]
    truth, estimate = (
        track(name, n, **{c: holed(rng, v) for c, v in zip(SIGNALS, m, strict=False)}, valid=rng.random(n) < 0.9)
        for name, m in zip(("truth", "e"), motion, strict=True)
    )
    stds = rng.uniform(0.1, 2.0, (n, 3))
    covariance = np.array([np.diag(s**2) for s in stds])
    estimate = replace(estimate, covariance=covariance, sideslip_std_rad=stds[:, 1])
    masks = {"all": np.ones(n, bool), "part": rng.random(n) < 0.5, "empty": np.zeros(n, bool)}
    rows = score(estimate, truth, masks)
    seen = 0
    for i, signal in enumerate(SIGNALS):
        e, reference = getattr(estimate, signal) - getattr(truth, signal), getattr(truth, signal)
        known = truth.valid & np.isfinite(reference)
        scored = known & estimate.valid & np.isfinite(e)
        for segment, mask in masks.items():
            use, asked = mask & scored, int(np.sum(mask & known))
            if asked:
                row = rows[signal, segment, "availability"]
                assert (row.value, row.n) == (pytest.approx(use.sum() / asked), asked)
            for metric, formula in ORACLES.items():
                row = rows.get((signal, segment, metric))
                assert (row is None) == (not use.any())
                if row is not None:
                    expected = formula(e[use], reference[use], stds[use, 1 if signal == "sideslip_rad" else i])
                    assert (row.value, row.n) == (pytest.approx(expected, rel=1e-9), use.sum())
                    seen += 1
    assert len([r for r in rows.values() if r.metric in ORACLES]) == seen


def test_sideslip_errors_wrap():
    truth = track(vx_m_s=[-10] * 4, vy_m_s=[0.1] * 4)
    estimate = track(vx_m_s=[-10] * 4, vy_m_s=[-0.1] * 4)
    assert score(estimate, truth)["sideslip_rad", "all", "max_abs"].value == pytest.approx(2 * np.arctan(0.01))


def test_dependent_truth_is_marked_in_rows_and_in_the_file():
    truth = track(vx_m_s=[10] * 4, yaw_rate_rad_s=[0.1] * 4)
    estimate = track(vx_m_s=[10] * 4, yaw_rate_rad_s=[0.2] * 4)
    rows = score(estimate, truth, dependent=("yaw_rate_rad_s", "x_m"))
    assert rows["yaw_rate_rad_s", "all", "not_independent"].value == 1.0
    assert not any(r.independent for k, r in rows.items() if k[0] == "yaw_rate_rad_s")
    assert all(r.independent for k, r in rows.items() if k[0] != "yaw_rate_rad_s")
    assert [k for k in rows if k[2] == "not_independent"] == [("yaw_rate_rad_s", "all", "not_independent")]


# ---- lag ----


def motion(t):
    return np.sin(2.1 * t) + 0.5 * np.sin(5.3 * t + 1) + 0.3 * np.sin(9.1 * t)


@settings(derandomize=True, max_examples=20, deadline=None)
@given(lag=st.floats(-0.25, 0.25), seed=st.integers(0, 1000))
def test_a_known_lag_is_found_with_its_sign(lag, seed):
    rng = np.random.default_rng(seed)
    t = np.arange(0, 30, 0.01)
    stamps = T0 + np.round((t + rng.uniform(-2e-3, 2e-3, t.size)) * 1e9).astype(np.int64)
    at = (stamps - T0) * 1e-9
    estimate = 1.3 * motion(at - lag) + 0.2 + rng.normal(0, 0.01, t.size)
    assert lag_s(stamps, estimate, motion(at)) == pytest.approx(lag, abs=1e-3)


def test_no_lag_is_claimed_without_likeness():
    t = np.arange(0, 30, 0.01)
    stamps = T0 + np.round(t * 1e9).astype(np.int64)
    assert np.isnan(lag_s(stamps, np.zeros(t.size), motion(t)))
    assert np.isnan(lag_s(stamps, np.random.default_rng(0).normal(size=t.size), motion(t)))
    assert np.isnan(lag_s(stamps, motion(t - 0.4), motion(t)))
    assert np.isnan(lag_s(stamps, np.full(t.size, np.nan), motion(t)))


def test_the_constant_and_the_shift_of_ground_truth_are_taken_out_and_no_other_error():
    t = np.arange(0, 60, 0.01)
    stamps, bends = T0 + np.round(t * 1e9).astype(np.int64), t > 20.0
    beta = np.where(bends, 0.05 * motion(t), 0.0)
    truth = np.where(bends, 0.05 * motion(t - 0.05), 0.0) + 0.01  # late by 50 ms, its heading is turned
    mask = ~bends & (t < 19.0)

    def errors(estimate):
        moving = {"vx_m_s": np.full(t.size, 10.0)}
        a, of = (make_track(n, stamps, sideslip_rad=b, **moving) for n, b in (("a", estimate), ("truth", truth)))
        rows = evaluate_drive(EvaluatedDrive("x", {"a": a}, of, None, {"straight": mask}, 3.0))
        found = {r.metric: r.value for r in rows if (r.signal, r.segment) == ("sideslip_rad", "all")}
        return found["rmse"], found["rmse_aligned"]

    whole, aligned = errors(beta)
    assert whole > 0.011 and aligned < 0.002
    assert errors(beta + 0.02)[1] == pytest.approx(0.02, rel=0.02)  # the estimate's own constant stays


# ---- uncertainty ----


def test_truth_covariance_counts_too():
    rng, n = np.random.default_rng(0), 20000
    a = rng.normal(size=(3, 3))
    p = a @ a.T * 0.01 + 0.001 * np.eye(3)
    truth = {"vx_m_s": np.full(n, 20.0), "vy_m_s": np.zeros(n), "yaw_rate_rad_s": np.zeros(n)}
    errors = rng.multivariate_normal(np.zeros(3), p, size=n).T
    half = {"covariance": np.tile(0.5 * p, (n, 1, 1))}  # of each side
    estimate = {name: values + e for (name, values), e in zip(truth.items(), errors, strict=True)}
    rows = score(*(make_track(name, stamps_of(n), **of, **half) for name, of in (("e", estimate), ("truth", truth))))
    assert rows["state", "all", "nees"].value == pytest.approx(3.0, abs=0.07)
    assert rows["vx_m_s", "all", "coverage95"].value == pytest.approx(0.95, abs=0.006)


@pytest.mark.parametrize("spread", [1.0, 1e-3, 1e-6])
def test_nees_is_that_of_every_eigenvalue_and_solution(spread):
    rng = np.random.default_rng(0)
    turned = np.linalg.qr(rng.standard_normal((400, 3, 3)))[0]
    sizes = 10.0 ** rng.uniform(np.log10(spread), 0.0, (400, 3)) * rng.choice([1.0, 1.0, 1.0, -1.0], (400, 3))
    p = (turned * sizes[:, None, :]) @ turned.transpose(0, 2, 1)
    e = rng.standard_normal((400, 3))
    whole = np.linalg.eigvalsh(p)[:, 0] > 0
    expected = np.full(400, np.nan)
    expected[whole] = (e[whole] * np.linalg.solve(p[whole], e[whole, :, None])[:, :, 0]).sum(axis=1)
    np.testing.assert_allclose(nees(e, p), expected, rtol=1e-8)
    assert 50 < whole.sum() < 350


# ---- position ----


def circle(n, yaw0, speed=20.0, r=0.2):
    """Closed form of a circle with v_y = 0."""
    stamps = stamps_of(n)
    yaw = yaw0 + r * (stamps - T0) * 1e-9
    x = 100 + speed / r * (np.sin(yaw) - np.sin(yaw0))
    y = -50 - speed / r * (np.cos(yaw) - np.cos(yaw0))
    motion = {"vx_m_s": np.full(n, speed), "vy_m_s": np.zeros(n), "yaw_rate_rad_s": np.full(n, r)}
    return make_track("truth", stamps, **motion, x_m=x, y_m=y, yaw_rad=np.angle(np.exp(1j * yaw)))


def test_a_sideways_velocity_error_becomes_its_distance():
    """On a straight, v_y wrong by 0.1 m/s is 0.1 m after one second and 0.1 · t after t."""
    n = 1001
    stamps = stamps_of(n)
    t = (stamps - T0) * 1e-9
    z = np.zeros(n)
    north = {"x_m": z, "y_m": 10 * t, "yaw_rad": z + np.pi / 2}
    truth = make_track("truth", stamps, vx_m_s=z + 10, vy_m_s=z, yaw_rate_rad_s=z, **north)
    estimate = make_track("e", stamps, vx_m_s=z + 10, vy_m_s=z + 0.1, yaw_rate_rad_s=z)
    np.testing.assert_allclose(position_error(estimate, truth), 0.1 * t, atol=1e-9)
    np.testing.assert_allclose(lateral_errors(estimate, truth), 0.1, atol=1e-9)
    faster = make_track("e", stamps, vx_m_s=z + 11, vy_m_s=z, yaw_rate_rad_s=z)
    np.testing.assert_allclose(lateral_errors(faster, truth), 0.0, atol=1e-9)


def test_lateral_seconds_agree_with_a_plain_restart_every_second():
    truth = circle(1001, -2.0)
    rng = np.random.default_rng(0)
    vx, vy = truth.vx_m_s + rng.normal(0, 0.3, 1001), rng.normal(0, 0.3, 1001).cumsum() * 0.05
    estimate = make_track("e", truth.stamps_ns, vx_m_s=vx, vy_m_s=vy, yaw_rate_rad_s=truth.yaw_rate_rad_s + 0.02)
    expected = []
    for k in range(10):
        x, y, yaw = truth.x_m[100 * k], truth.y_m[100 * k], truth.yaw_rad[100 * k]
        for i in range(100 * k, 100 * k + 100):
            vx, vy, r = ((a[i] + a[i + 1]) / 2 for a in (estimate.vx_m_s, estimate.vy_m_s, estimate.yaw_rate_rad_s))
            heading = yaw + r * 0.005
            x += 0.01 * (vx * np.cos(heading) - vy * np.sin(heading))
            y += 0.01 * (vx * np.sin(heading) + vy * np.cos(heading))
            yaw += r * 0.01
        j = 100 * k + 100
        left = np.array([-np.sin(truth.yaw_rad[j]), np.cos(truth.yaw_rad[j])])
        expected.append(left @ [x - truth.x_m[j], y - truth.y_m[j]])
    np.testing.assert_allclose(lateral_errors(estimate, truth), expected, atol=1e-9)


N = 400
STAMPS = np.arange(N, dtype=np.int64) * 10_000_000


def _track(name, sideslip_deg, stamps=STAMPS, **columns):
    vx = np.full(N, 20.0)
    vy = vx * np.tan(np.radians(np.broadcast_to(sideslip_deg, N)))
    return make_track(name, stamps, vx_m_s=vx, vy_m_s=vy, yaw_rate_rad_s=np.zeros(N), **columns)


def _reference(independent, std_deg, stamps):
    columns = {"independent": np.full(N, independent), "sideslip_std_rad": np.full(N, np.radians(std_deg))}
    return _track("reference", 0.0, stamps, **columns)


def _rows(independent, std_deg=0.2, stamps=STAMPS):
    tracks = {name: _track(name, beta, stamps) for name, beta in (("near", 0.1), ("far", 1.0))}
    return _of(tracks | {"reference": _reference(independent, std_deg, stamps)})


def _of(tracks):
    return {(r.estimator, r.metric): r for r in evaluate_drive(EvaluatedDrive("a", tracks, None, None, {}, 3.0))}


def test_the_further_estimate_is_claimed():
    row = _rows(1.0)["near~far", "reference_further"]
    assert np.degrees(row.value) == pytest.approx(-0.9, abs=1e-6)
    assert row.n == N


@pytest.mark.parametrize(("std_deg", "claimed"), [(0.27, True), (0.29, False)])
def test_a_ranking_is_claimed_beyond_the_uncertainty_of_its_difference(std_deg, claimed):
    # 1.0² − 0.1² = 0.99 against 1.96 · 2 · 0.9 · std of one block
    rows = _rows(0.0, std_deg)
    assert (("near~far", "reference_further") in rows) == claimed
    assert rows["far", "reference_independent"].value == 0.0
    assert np.degrees(rows["far", "reference_std"].value) == pytest.approx(std_deg)


def test_errors_of_the_reference_average_out_over_blocks():
    stamps = STAMPS * 20  # eight blocks of 10 s
    assert ("near~far", "reference_further") in _rows(0.0, 0.7, stamps)
    assert ("near~far", "reference_further") not in _rows(0.0, 0.85, stamps)


def test_claims_are_right_as_often_as_they_state():
    rng = np.random.default_rng(5)
    wrong = claimed = 0
    for _ in range(200):
        error = np.repeat(rng.normal(0.0, 0.3, 8), N // 8)  # of the reference, with its standard deviation
        one, two = error + rng.normal(0.0, 0.3), error + rng.normal(0.0, 0.3)
        tracks = {"one": _track("one", one, STAMPS * 20), "two": _track("two", two, STAMPS * 20)}
        row = _of(tracks | {"reference": _reference(0.0, 0.3, STAMPS * 20)}).get(("one~two", "reference_further"))
        if row is not None:
            claimed += 1
            wrong += (abs(one - error)[0] > abs(two - error)[0]) != (row.value > 0.0)
    assert claimed > 50
    assert wrong <= 0.1 * claimed
