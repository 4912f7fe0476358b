"""The baselines: known coefficients come back, and damaged files are one clear error."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_models import full_network

from pdhef_logtool.records.errors import ModelError
from pdhef_logtool.residual_model.bundle import LINEAR_REGRESSION_FILE, PURE_LSTM_FOLDER, load_bundle
from pdhef_logtool.residual_model.features import FEATURES
from pdhef_logtool.residual_model.linear_model import LinearModel
from studies.defaults.train_baselines import SideslipSequence, fit_linear

pytestmark = pytest.mark.slow

NAMES = ("vx_m_s", "ay_m_s2", "steer_rad", "friction")


def smoothed(values: np.ndarray, dt: float, corner_hz: float) -> np.ndarray:
    """The textbook recursion in plain Python."""
    share = 1.0 - math.exp(-2.0 * math.pi * corner_hz * dt)
    out = [values[0]]
    for v in values[1:]:
        out.append(out[-1] + share * (v - out[-1]))
    return np.array(out)


def make_features(seed: int, steps: int = 600) -> np.ndarray:
    rng = np.random.default_rng(seed)
    walks = rng.normal(size=(steps, 28))  # more than features: another number of them draws the same
    features = np.cumsum(walks[:, : len(FEATURES)], axis=0) * 0.1
    features[:, FEATURES.index("friction")] = 0.85  # one road: no information
    return features


def make_sequence(seed: int, noise: float = 0.0) -> SideslipSequence:
    features = make_features(seed)
    n = len(features)
    raw = 0.01 + 0.002 * features[:, 0] - 0.03 * features[:, 1] + 0.5 * features[:, 2]
    beta = smoothed(raw, 0.01, 2.0) + noise * np.random.default_rng(seed).standard_normal(n)
    beta[100:120] = np.nan  # no truth there
    return SideslipSequence(features, np.array([np.nan, *[0.01] * (n - 1)]), beta)


def test_regression_recovers_known_coefficients():
    model = fit_linear([make_sequence(s) for s in range(4)], NAMES)
    assert model.coefficients == pytest.approx((0.002, -0.03, 0.5, 0.0), abs=1e-10)
    assert model.intercept_rad == pytest.approx(0.01, abs=1e-10)
    noisy = fit_linear([make_sequence(s, 0.01) for s in range(8)], NAMES)
    assert noisy.coefficients[:3] == pytest.approx((0.002, -0.03, 0.5), abs=0.004)
    assert noisy.coefficients[3] == 0.0  # a constant feature gets no weight


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network with its baselines."""
    folder, network = tmp_path_factory.mktemp("model"), full_network()
    assert network.pure_lstm is not None
    network.save(folder)
    network.pure_lstm.save(folder / PURE_LSTM_FOLDER)
    model = LinearModel(NAMES, (0.1, 0.2, 0.3, 0.4), 0.01, 2.0, {"dataset_sha256": "a"})
    (folder / LINEAR_REGRESSION_FILE).write_text(model.to_json())
    return folder


@pytest.fixture
def saved(tmp_path: Path, whole: Path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(whole, tmp_path / "model"))


def test_baselines_come_with_the_model(whole):
    bundle = load_bundle(whole)
    assert bundle.pure_lstm.sha256 == full_network().pure_lstm.sha256
    assert bundle.linear_regression == LinearModel(NAMES, (0.1, 0.2, 0.3, 0.4), 0.01, 2.0)
    assert bundle.linear_regression.provenance == {"dataset_sha256": "a"}
    alone = replace(bundle, pure_lstm=None, linear_regression=None)
    assert alone.sha256 == bundle.sha256  # the network's own


@pytest.mark.parametrize(
    ("file", "damage"),
    [
        (LINEAR_REGRESSION_FILE, {"version": 99}),
        (LINEAR_REGRESSION_FILE, {"coefficients": [0.1, 0.2, 0.3, 0.5]}),
        (LINEAR_REGRESSION_FILE, {"features": ["truth", *NAMES[1:]]}),
        (LINEAR_REGRESSION_FILE, {"coefficients": [0.1]}),
        (f"{PURE_LSTM_FOLDER}/model.json", {"target": None}),
        (f"{PURE_LSTM_FOLDER}/model.json", {"normalisation": {"target_std": []}}),
        (f"{PURE_LSTM_FOLDER}/weights.safetensors", "missing"),
        (f"{PURE_LSTM_FOLDER}/weights.safetensors", "the network's"),
    ],
)
def test_a_damaged_baseline_is_one_clear_error(saved, file, damage):
    path = saved / file
    if damage == "missing":
        path.unlink()
    elif damage == "the network's":
        shutil.copy(saved / path.name, path)
    else:
        document = json.loads(path.read_text())
        changed = {k: {**document[k], **v} if isinstance(v, dict) else v for k, v in damage.items()}
        path.write_text(json.dumps({k: v for k, v in (document | changed).items() if v is not None}))
    with pytest.raises(ModelError, match=file.partition("/")[0]) as caught:
        load_bundle(saved)
    assert len(str(caught.value).splitlines()) == 1
