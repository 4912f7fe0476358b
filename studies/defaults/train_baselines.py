"""Train the baselines ``pure-lstm`` and ``linear-regression`` on a dataset of ``pdhef extract --filter phy-ukf``.

Drives, split, rows and recipe are those of the residual network; only the target differs. The regression is ordinary
least squares of the true sideslip on low-passed features (:mod:`pdhef_logtool.residual_model.linear_model`).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pdhef_logtool.learning.network.dataset import Dataset
from pdhef_logtool.learning.network.train_command import Recipe, gap_free_runs, train_on
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.residual_model.bundle import LATERAL_VELOCITY, LINEAR_REGRESSION_FILE, PURE_LSTM_FOLDER
from pdhef_logtool.residual_model.features import FEATURES
from pdhef_logtool.residual_model.linear_model import LinearModel
from pdhef_logtool.residual_model.low_pass import low_pass

#: Features of the baselines.
NOMINAL_FEATURES = FEATURES[:10]
LOW_PASS_HZ = 2.0
EPOCHS = 40
#: Relative variation below which a feature is constant, and thus redundant beside the intercept.
CONSTANT_SHARE = 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class SideslipSequence:
    """One gap-free run: features [N, f], the step that ends at each row [N] (NaN at the first), true sideslip [N].

    The sideslip is NaN on rows that are excluded from the fit.
    """

    features: FloatArray
    dt_s: FloatArray
    sideslip_rad: FloatArray


def train_baselines(data: Dataset, network: Path) -> None:
    """Train both baselines into ``network``/``baselines``."""
    file = network / LINEAR_REGRESSION_FILE
    file.parent.mkdir(parents=True, exist_ok=True)
    sequences = list(_training_sequences(data))
    about = {"dataset_sha256": data.sha256, "vehicle": data.vehicle_name, "training_sequences": len(sequences)}
    model = replace(fit_linear(sequences, NOMINAL_FEATURES), provenance=about)
    file.write_text(model.to_json(), encoding="utf-8")
    recipe = Recipe(NOMINAL_FEATURES, odd=False, target=LATERAL_VELOCITY, epochs=EPOCHS)
    train_on(data, network / PURE_LSTM_FOLDER, recipe, progress=lambda text, _: print(text, flush=True))


def fit_linear(sequences: Sequence[SideslipSequence], names: tuple[str, ...]) -> LinearModel:
    """Return the least-squares coefficients of the sideslip on the low-passed features and a constant.

    Features that do not vary, such as the friction of drives on one road, get a coefficient of 0.
    """
    columns = [FEATURES.index(n) for n in names]
    inputs, targets = [], []
    for s in sequences:
        used = np.isfinite(s.sideslip_rad)
        smooth = np.empty((len(s.dt_s), len(columns)))
        low_pass(np.ascontiguousarray(s.features[:, columns]), s.dt_s, LOW_PASS_HZ, np.zeros(len(columns)), smooth)
        inputs.append(smooth[used])
        targets.append(s.sideslip_rad[used])
    rows = np.concatenate(inputs)
    mean, std = rows.mean(axis=0), rows.std(axis=0)
    varies = std > CONSTANT_SHARE * np.maximum(np.abs(mean), 1e-3)
    scaled = (rows[:, varies] - mean[varies]) / std[varies]
    target = np.concatenate(targets)
    weights = np.linalg.lstsq(np.column_stack([scaled, np.ones(len(scaled))]), target, rcond=None)[0]
    coefficients = np.zeros(len(names))
    coefficients[varies] = weights[:-1] / std[varies]
    intercept_rad = float(weights[-1] - coefficients @ mean)
    return LinearModel(names, tuple(float(c) for c in coefficients), intercept_rad, LOW_PASS_HZ)


def _training_sequences(data: Dataset) -> Iterable[SideslipSequence]:
    """Yield the runs of the training drives; rows are the network's, with ground truth above the low-speed blend."""
    for drive in data.drives:
        if drive.entry["split"] != "train":
            continue
        slowest = data.vehicle(drive).low_speed_blend_m_s
        rows = drive.load()
        weight = rows.training_weight
        for part in gap_free_runs(rows):
            vx, vy = np.asarray(rows.truth_velocity[part], dtype=np.float64).T
            used = (weight[part] > 0.0) & (vx >= slowest) & np.isfinite(vy)
            yield SideslipSequence(
                features=np.asarray(rows.features[part], dtype=np.float64),
                dt_s=np.concatenate([[np.nan], np.diff(rows.stamps_ns[part]) * 1e-9]),
                sideslip_rad=np.where(used, np.arctan2(vy, vx), np.nan),
            )
