"""The ladder of residual models: symmetry, constants, region of validity, choice of the rung, and its document."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from pdhef_logtool.residual_model.features import FEATURES, ODD_COUNT, SlowFeatures, slow_features
from pdhef_logtool.residual_model.ladder import LadderModel
from pdhef_logtool.residual_model.ladder_fit import LadderFit, TaughtDrive, fit_ladder

RATE_HZ = 50.0


def driving(seconds: float, seed: int, speed: float = 20.0) -> np.ndarray:
    """Return smooth random signals [K, 6]: four odd ones, speed and a_x."""
    rng, count = np.random.default_rng(seed), round(seconds * RATE_HZ)
    kernel = np.hanning(50)
    smooth = np.stack([np.convolve(rng.normal(size=count + 49), kernel, "valid") for _ in range(5)], axis=1) / 5.0
    odd = smooth[:, :4] * np.array([0.05, 0.3, 3.0, 0.03])
    return np.concatenate([odd, np.full((count, 1), speed), smooth[:, 4:]], axis=1)


def table(signals: np.ndarray) -> np.ndarray:
    """Return the features [K, 15] with these signals."""
    columns = dict.fromkeys(FEATURES, np.zeros(len(signals)))
    names = ("steer_rad", "physics_yaw_rate_rad_s", "ay_m_s2", "physics_vy_m_s", "vx_m_s", "ax_m_s2")
    columns |= dict(zip(names, signals.T, strict=True))
    columns["physics_vy_m_s"] = columns["physics_vy_m_s"] * np.maximum(columns["vx_m_s"], 1.0)
    return np.stack([columns[name] for name in FEATURES], axis=1)


def features(signals: np.ndarray) -> SlowFeatures:
    dt = np.full(len(signals), 1.0 / RATE_HZ)
    dt[0] = np.nan
    return slow_features(table(signals), dt, None)[0]


def taught(seconds: float, seed: int, lacking: object = None, noise_rad: float = 0.002) -> TaughtDrive:
    """Return a drive with an error that depends on its features, plus slow noise and a constant."""
    found = features(driving(seconds, seed))
    rng = np.random.default_rng(seed + 100)
    noise = np.convolve(rng.normal(size=len(found.odd) + 24), np.ones(25) / 5.0, "valid") * noise_rad
    error = np.zeros(len(found.odd)) if lacking is None else lacking(found)
    stamps = np.round(np.arange(len(noise)) * 1e9 / RATE_HZ).astype(np.int64)
    return TaughtDrive(f"drive {seed}", stamps, found, error + noise + 0.003)


def linear(found: SlowFeatures) -> np.ndarray:
    return 0.2 * found.odd[:, 4] - 0.01 * found.odd[:, 6]


@cache
def linear_fit() -> LadderFit:
    return fit_ladder([taught(600.0, 1, linear)], rungs=("linear",))


def linear_model() -> LadderModel:
    model = linear_fit().model
    assert model is not None
    return model


def test_a_linear_error_is_found_on_a_drive_that_was_not_taught():
    fit, other = linear_fit(), taught(60.0, 7, linear)
    assert fit.rung == "linear" and fit.model is not None
    correction = fit.model.evaluate(other.features)
    response = other.response((correction.gain * correction.rate[:, 0])[:, None])[:, 0]
    before, after = (np.std((other.lacking_rad - part)[other.usable]) for part in (0.0, response))
    assert after < 0.75 * before
    assert np.mean(correction.gain > 0.0) > 0.8


def test_a_product_of_odd_and_even_takes_the_random_rung():
    def product(found: SlowFeatures) -> np.ndarray:
        return 0.3 * found.odd[:, 4] * np.tanh(found.even[:, 3])

    fit = fit_ladder([taught(900.0, 2, product, noise_rad=0.0003)])
    assert fit.rung == "random"


@pytest.mark.parametrize("offset_rad", [0.02, -0.5])
def test_a_constant_of_the_ground_truth_is_not_learned(offset_rad):
    drive = taught(600.0, 1, linear)
    moved = fit_ladder([replace(drive, lacking_rad=drive.lacking_rad + offset_rad)], rungs=("linear",)).model
    found = drive.features
    expected, got = linear_model().evaluate(found), moved.evaluate(found)
    assert np.allclose(got.rate, expected.rate, atol=1e-9)
    assert np.array_equal(got.gain, expected.gain)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000), st.floats(0.1, 3.0))
def test_the_mirrored_drive_has_the_mirrored_residual(seed, size):
    found = features(driving(2.0, seed) * np.array([size] * 4 + [1.0, 1.0]))
    mirrored = SlowFeatures(-found.odd, found.even)
    for model in (linear_model(), random_model()):
        straight, turned = model.evaluate(found), model.evaluate(mirrored)
        assert np.array_equal(turned.rate, -straight.rate)
        assert np.array_equal(turned.gain, straight.gain)


@cache
def random_model() -> LadderModel:
    """Return the linear model with random features of small weight."""
    model, rng, count = linear_model(), np.random.default_rng(5), 12
    odd, even = (rng.normal(size=(count, width)).tolist() for width in (ODD_COUNT, len(model.even_mean)))
    drawn = {"odd_directions": odd, "even_directions": even, "phases": rng.uniform(size=count).tolist()}
    weights = [*model.weights, *(rng.normal(size=count) * 1e-3).tolist()]
    return LadderModel(**model.model_dump() | drawn | {"rung": "random", "weights": weights})


def test_outside_of_the_taught_driving_the_residual_is_zero_within_two_seconds():
    inside = driving(20.0, 3)
    for outside in (driving(10.0, 3, speed=60.0), inside[:500] * np.array([8.0] * 4 + [1.0, 1.0])):
        found = linear_model().evaluate(features(np.concatenate([inside, outside])))
        first = len(inside)
        assert np.mean(found.gain[first - 500 : first]) > 0.8
        assert np.mean(found.gain[first + 100 :] == 0.0) > 0.9
    fast = linear_model().evaluate(features(driving(10.0, 3, speed=60.0)))
    assert np.all(fast.gain == 0.0)


def test_unknown_features_have_gain_zero_and_the_next_ones_go_on():
    signals = driving(8.0, 3)
    signals[50:60, 2] = np.nan
    found = linear_model().evaluate(features(signals))
    assert np.all(found.gain[50:60] == 0.0) and np.all(found.rate[50:60] == 0.0)
    assert np.all(np.isfinite(found.rate)) and np.mean(found.gain[60:] > 0.0) > 0.5


def test_a_model_survives_its_document_and_damage_is_refused():
    model = random_model()
    text = model.model_dump_json()
    assert LadderModel.model_validate_json(text).sha256 == model.sha256
    for name, value in (("weights", model.weights[:-1]), ("phases", ()), ("scale", (0.0,) * ODD_COUNT)):
        with pytest.raises(ValidationError):
            LadderModel(**{**model.model_dump(), name: value})
    with pytest.raises(ValidationError):
        LadderModel(**{**model.model_dump(), "largest_m_s2": float("nan")})
