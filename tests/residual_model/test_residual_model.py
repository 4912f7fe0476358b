"""Features, bundle, and the network in service."""

import json
import shutil
from dataclasses import replace
from functools import cache, partial
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from made_models import full_network, random_network
from pydantic import ValidationError

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import physics_sha256
from pdhef_logtool.car.vehicle import PhysicsParts, default_vehicle
from pdhef_logtool.estimators.filter_steps import U_FRICTION, U_STEER, no_posterior
from pdhef_logtool.estimators.parallel_physics import make_features
from pdhef_logtool.estimators.vehicle_model import FRONT, REAR
from pdhef_logtool.estimators.vehicle_ukf import VehicleUkf
from pdhef_logtool.records.errors import ModelError
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.residual_model import bundle as bundles
from pdhef_logtool.residual_model.features import FEATURES, ODD_COUNT, SlowFeatures, slow_features
from pdhef_logtool.residual_model.interface import LIMITS
from pdhef_logtool.residual_model.ladder import LadderModel
from pdhef_logtool.residual_model.ladder_fit import LadderFit, TaughtDrive, fit_ladder
from pdhef_logtool.residual_model.linear_model import LinearModel
from pdhef_logtool.residual_model.network import ResidualNetwork

make_bundle = partial(random_network, hidden=16, layers=2, head=(8,), scales=(2.0, 0.7))


def test_features_by_hand():
    physics, stamps = (
        VehicleUkf(default_vehicle().model_copy(update={"physics": PhysicsParts(roll=True)})),
        np.arange(1),
    )
    body = {physics.layout.roll: 1.0, physics.layout.roll + 1: 2.0, FRONT: 3.0, REAR: 4.0}
    steps = no_posterior(stamps, physics.layout.size, np.zeros((1, 2)))
    steps.x[:], steps.inputs[:], steps.valid[:] = 0.0, 0.0, True
    steps.x[:, :3], steps.prior[:] = (20.0, 0.4, 0.1), 0.0
    steps.x[:, [*body]], steps.prior[:, :3] = [*body.values()], (19.0, 0.2, 0.08)
    steps.inputs[:, [U_STEER, U_FRICTION]] = 0.02, 0.8
    ay, rate, ax = (np.array([value]) for value in (1.5, 0.11, -0.5))
    nothing = np.full(1, np.nan)
    seen = Signals(stamps, stamps, nothing, ax, ay, rate, nothing, nothing, np.full((1, 4), np.nan))
    features = make_features(physics, steps, seen)
    beta = np.arctan2(0.4, 20.0) - np.arctan2(0.2, 19.0)
    used = 1.5 / (0.8 * 9.80665)
    expected = [20.0, 1.5, 0.02, 0.11, 0.03, beta, 0.4, 0.1, 0.8, -0.5, used, *body.values()]
    np.testing.assert_allclose(features, [expected], rtol=1e-12)
    assert len(FEATURES) == len(expected)


def test_an_odd_network_is_odd_to_the_last_digits():
    plain = make_bundle()
    centred = replace(plain.normalisation, feature_mean=(0.0,) * len(FEATURES))
    bundle = replace(plain, odd=True, normalisation=centred)
    rng = np.random.default_rng(5)
    features = rng.normal(size=(300, len(FEATURES)))
    starts = np.zeros(300, dtype=np.bool_)
    out, _ = bundle.run(features, starts, None)
    mirrored, _ = bundle.run(features * bundle.signs, starts, None)
    np.testing.assert_allclose(mirrored, -out, atol=1e-6)
    other, _ = replace(bundle, odd=False).run(features, starts, None)
    assert np.abs(other - out).max() > 1e-4
    first, carry = bundle.run(features[:77], starts[:77], None)
    second, _ = bundle.run(features[77:], starts[77:], carry)
    np.testing.assert_array_equal(np.concatenate([first, second]), out)


def test_bundle_round_trip_and_hash(tmp_path):
    bundle = replace(make_bundle(), provenance={"seed": 0})
    bundle.save(tmp_path / "model")
    back = bundles.load_bundle(tmp_path / "model")
    assert back.sha256 == bundle.sha256
    assert back.provenance == bundle.provenance
    assert {p.name for p in (tmp_path / "model").iterdir()} == {bundles.DOCUMENT_FILE, bundles.WEIGHTS_FILE}
    assert make_bundle(seed=1).sha256 != bundle.sha256


BASELINE = LinearModel(FEATURES[:4], (0.1, 0.2, 0.3, 0.4), 0.01, 2.0, {"dataset_sha256": "a"})


@pytest.fixture
def saved(tmp_path):
    """Return a folder with a network and its baselines."""
    network = full_network()
    network.save(tmp_path)
    network.pure_lstm.save(tmp_path / bundles.PURE_LSTM_FOLDER)
    (tmp_path / bundles.LINEAR_REGRESSION_FILE).write_text(BASELINE.to_json())
    return tmp_path


def test_baselines_come_with_the_model(saved):
    bundle = bundles.load_bundle(saved)
    assert bundle.pure_lstm.sha256 == full_network().pure_lstm.sha256
    assert (bundle.linear_regression, bundle.linear_regression.provenance) == (BASELINE, BASELINE.provenance)
    assert replace(bundle, pure_lstm=None, linear_regression=None).sha256 == bundle.sha256  # the network's own


@pytest.mark.parametrize(
    ("file", "damage"),
    [
        *product((bundles.WEIGHTS_FILE, f"{bundles.PURE_LSTM_FOLDER}/{bundles.WEIGHTS_FILE}"), ("missing", "other's")),
        (bundles.DOCUMENT_FILE, "cut"),
        (bundles.DOCUMENT_FILE, {"version": 99}),
        (bundles.DOCUMENT_FILE, {"features": ["truth"] * 8}),
        (f"{bundles.PURE_LSTM_FOLDER}/{bundles.DOCUMENT_FILE}", {"target": None}),
        (f"{bundles.PURE_LSTM_FOLDER}/{bundles.DOCUMENT_FILE}", {"normalisation": {"target_std": []}}),
        (bundles.LINEAR_REGRESSION_FILE, {"version": 99}),
        (bundles.LINEAR_REGRESSION_FILE, {"coefficients": [0.1, 0.2, 0.3, 0.5]}),
        (bundles.LINEAR_REGRESSION_FILE, {"features": ["truth", *FEATURES[1:4]]}),
        (bundles.LINEAR_REGRESSION_FILE, {"coefficients": [0.1]}),
    ],
)
def test_a_damaged_network_or_baseline_is_one_clear_error(saved, file, damage):
    path = saved / file
    if damage == "missing":
        path.unlink()
    elif damage == "cut":
        path.write_text("{")
    elif damage == "other's":
        random_network(9).save(saved / "other")
        shutil.copy(saved / "other" / bundles.WEIGHTS_FILE, path)
    else:
        document = json.loads(path.read_text())
        changed = {k: {**document[k], **v} if isinstance(v, dict) else v for k, v in damage.items()}
        path.write_text(json.dumps({k: v for k, v in (document | changed).items() if v is not None}))
    with pytest.raises(ModelError, match=file.partition("/")[0] if "/" in file else saved.name):
        bundles.load_bundle(saved)


def said_by_torch(bundle: bundles.ModelBundle, features: FloatArray) -> FloatArray:
    """Run PyTorch's own network, the oracle, over normalised features [N, k]; returns normalised outputs [N, o]."""
    head, outputs = bundle.head, bundles.OUTPUT_COUNT[bundle.target]
    network = ResidualNetwork(len(bundle.feature_names), bundle.hidden, bundle.layers, head, outputs=outputs)
    network.load_state_dict({k: torch.from_numpy(np.array(v)) for k, v in bundle.weights.items()})
    with torch.inference_mode():
        output, _ = network.eval()(torch.from_numpy(features.astype(np.float32))[None])
    return np.asarray(output[0].numpy(), dtype=np.float64)


@pytest.mark.parametrize("hidden", [12, 64])  # widths that fill the compiled blocks, and widths that do not
def test_service_equals_torch(hidden):
    bundle = make_bundle(hidden=hidden)
    features = np.random.default_rng(0).normal(size=(300, len(FEATURES)))
    rates, _ = bundle.run(features, np.zeros(len(features), dtype=np.bool_), None)
    expected = said_by_torch(bundle, bundle.normalise(features)) * np.array(bundle.normalisation.target_std)
    np.testing.assert_allclose(rates, expected, atol=2e-6)


def test_weights_of_another_shape_are_refused(tmp_path):
    # Compiled code would read beyond them.
    replace(make_bundle(), hidden=32).save(tmp_path)
    with pytest.raises(ModelError, match="architecture"):
        bundles.load_bundle(tmp_path)


def test_a_restart_forgets_and_unknown_rows_give_nothing():
    service = make_bundle()
    rng = np.random.default_rng(2)
    features = rng.normal(size=(300, len(FEATURES)))
    starts = np.zeros(300, dtype=np.bool_)
    starts[200] = True
    features[100] = np.nan
    rates, _ = service.run(features, starts, None)
    assert np.all(rates[100] == 0.0)
    alone, _ = service.run(features[200:], np.zeros(100, dtype=np.bool_), None)
    np.testing.assert_array_equal(rates[200:], alone)
    behind, _ = service.run(features[101:200], np.zeros(99, dtype=np.bool_), None)
    np.testing.assert_array_equal(rates[101:200], behind)


def test_causality_and_limits():
    bundle = make_bundle()
    service = bundle
    features = np.random.default_rng(3).normal(size=(400, len(FEATURES)))
    starts = np.zeros(400, dtype=np.bool_)
    before, _ = service.run(features, starts, None)
    features[250:] = 1e9
    after, _ = service.run(features, starts, None)
    np.testing.assert_array_equal(before[:250], after[:250])
    assert np.all(np.abs(after) <= LIMITS)
    assert np.isfinite(after).all()


def test_models_are_found_by_name():
    default = bundles.load_bundle(bundles.SHIPPED_FOLDERS["default"])
    assert default.feature_names == FEATURES
    assert None not in (default.pure_lstm, default.linear_regression, default.paper_network)
    folders = [bundles.network_folder(Path(name)) for name in ("default", "none", "elsewhere")]
    assert folders == [bundles.SHIPPED_FOLDERS["default"], None, Path("elsewhere")]
    with pytest.raises(ModelError):
        bundles.load_bundle(Path("elsewhere"))


def test_all_of_it_is_below_three_megabytes():
    folder = bundles.SHIPPED_FOLDERS["default"].parents[1]
    assert sum(f.stat().st_size for f in folder.rglob("*") if f.is_file()) < 3_000_000


def test_noise_evidence_and_calibration_are_of_the_shipped_network():
    model, car = bundles.load_bundle(bundles.SHIPPED_FOLDERS["default"]), Car.load("saloon")
    assert car.network is not None and car.network.sha256 == model.sha256
    assert (car.residual_gain, model.physics_sha256) == (0.75, physics_sha256(car.physics_vehicle))
    assert car.notes == ()
    assert {"phy-ukf:tuned", "physics"} == set(car.noise)


# ---- The ladder of residual models: symmetry, constants, region of validity, choice of the rung, and its document ----

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
