"""Fit of the 95 % intervals of the shipped car."""

from __future__ import annotations

import numpy as np
import pytest

from pdhef_logtool.car.parts import Inflation
from pdhef_logtool.estimators.error_features import grip_share
from pdhef_logtool.estimators.intervals import SIDESLIP_TERMS, YAW_RATE_TERMS, combined, grip_factor
from pdhef_logtool.records.signals import FloatArray
from studies.defaults.interval_fit import Samples, covering_factor, fit_coefficients, fit_inflation, folds

pytestmark = pytest.mark.slow


def _sideslip(inflation: Inflation) -> tuple[float, ...]:
    return tuple(getattr(inflation.sideslip, term) for term in SIDESLIP_TERMS)


def _yaw_rate(inflation: Inflation) -> tuple[float, ...]:
    return tuple(getattr(inflation.yaw_rate, term) for term in YAW_RATE_TERMS)


def _samples(rng: np.random.Generator, std: FloatArray, terms: FloatArray, drives: int = 30) -> Samples:
    """Return samples [n] of drives with a different error size each, as in real drives."""
    n = std.shape[0]
    drive = np.arange(n) * drives // n
    size = np.exp(rng.normal(0.0, 0.2, drives))[drive]
    error = std * size * rng.standard_t(6.0, n)
    return Samples(
        terms=terms,
        yaw_rate_terms=terms[:, [0, 1, 6]],
        vy_per_sideslip=np.full(n, 20.0),
        sideslip_error=error,
        vy_error=20.0 * error,
        yaw_rate_error=2.0 * terms[:, 1] * rng.standard_normal(n),
        own_std=terms[:, 1],
        bin=np.asarray(rng.integers(0, 3, n)),
        drive=drive,
        wrong=drive % 3 == 0,
    )


def _terms(rng: np.random.Generator, n: int) -> FloatArray:
    terms = rng.lognormal(-6.0, 0.7, (n, len(SIDESLIP_TERMS)))
    terms[:, 0] = 1e-4
    terms[:, 3] = 3e-3 * rng.uniform(0.0, 0.9, n)
    return terms


def test_new_drives_are_covered_where_errors_are_small_and_where_they_are_large() -> None:
    rng = np.random.default_rng(3)
    terms = _terms(rng, 30_000)
    std = np.hypot(1.5 * terms[:, 1], 0.6 * terms[:, 2])
    fitted = fit_inflation(_samples(rng, std, terms, drives=300))
    fresh_terms = _terms(rng, 60_000)
    fresh_std = np.hypot(1.5 * fresh_terms[:, 1], 0.6 * fresh_terms[:, 2])
    fresh = _samples(rng, fresh_std, fresh_terms, drives=200)
    interval = 1.96 * combined(fresh_terms, _sideslip(fitted.inflation))
    interval *= grip_factor(grip_share(fresh_terms), fitted.inflation.grip_factors)
    order = np.argsort(fresh_std)
    for part in np.array_split(order, 4):
        covered = np.mean(np.abs(fresh.sideslip_error[part]) <= interval[part])
        assert covered == pytest.approx(0.95, abs=0.015)
    # Before, a single drive in the least favourable part was covered far less.
    assert np.mean(np.abs(fresh.sideslip_error) <= 1.96 * fresh.own_std) < 0.8
    rate = combined(fresh.yaw_rate_terms, _yaw_rate(fitted.inflation))
    assert np.mean(np.abs(fresh.yaw_rate_error) <= 1.96 * rate) == pytest.approx(0.95, abs=0.01)
    assert fitted.inflation.vy_factor == pytest.approx(1.0, abs=1e-9)


def test_the_covering_factor_is_the_least_that_covers_whatever_the_weights_add_up_to() -> None:
    rng = np.random.default_rng(8)
    error, std = 3.0 * rng.standard_normal(400), rng.uniform(0.5, 1.5, 400)
    for scale in (1.0, 7.0, 1e-3):
        weight = scale * rng.uniform(0.1, 1.0, 400)
        for covered in (0.5, 0.85):
            factor = covering_factor(error, std, weight, covered)

            def share(g: float, weight: FloatArray = weight) -> float:
                inside = np.abs(error) <= 1.959963984540054 * g * std
                return float(np.sum(weight[inside]) / np.sum(weight))

            assert share(factor * (1 - 1e-9)) < covered <= share(factor * (1 + 1e-9))


def test_the_fit_minimises_the_pinball_loss_of_the_files_head() -> None:
    rng = np.random.default_rng(9)
    terms = rng.uniform(0.5, 2.0, (500, 2))
    error = np.hypot(2.0 * terms[:, 0], 1.0) * rng.standard_normal(500)
    error[0] = 0.0
    weight = rng.uniform(0.5, 1.5, 500)
    k = np.array(fit_coefficients(terms, error, weight, 0.85))

    def loss(k: FloatArray) -> float:
        s = np.sqrt(np.square(terms) @ np.square(k))
        r = np.log(np.maximum(np.abs(error), 1e-6)) - np.log(1.959963984540054 * s)
        return float(np.sum(weight * np.where(r > 0.0, 0.85 * r, -0.15 * r)))

    assert k[0] > 0.5
    for i, factor in ((i, f) for i in range(2) for f in (0.9, 1.1)):
        aside = np.maximum(k, 0.05)
        aside[i] *= factor
        assert loss(aside) > loss(k)


def test_a_drive_is_never_on_both_sides() -> None:
    drive = np.random.default_rng(0).permutation(np.repeat([3, 8, 9, 20, 21, 40, 41], 5))
    held = np.zeros(drive.size, dtype=int)
    for seen, out in folds(drive):
        assert not set(drive[seen]) & set(drive[out])
        held += out
    assert np.all(held == 1)


def test_few_drives_are_refused() -> None:
    rng = np.random.default_rng(6)
    with pytest.raises(ValueError, match="5 drives"):
        fit_inflation(_samples(rng, np.ones(400), np.ones((400, 9)), drives=4))
