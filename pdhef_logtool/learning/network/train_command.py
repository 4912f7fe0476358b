"""``pdhef train``: train a model bundle on a dataset, with loss history and resumption."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.learning.network.dataset import SPLITS, Dataset, read_dataset
from pdhef_logtool.learning.network.fit import CHECKPOINT, PAPER_RECIPE, Epoch, FeatureSequence, Recipe, train
from pdhef_logtool.learning.network.residuals import ResidualRows
from pdhef_logtool.records.errors import ModelError, OutputError, UsageError
from pdhef_logtool.records.signals import BoolArray, FloatArray
from pdhef_logtool.residual_model.bundle import (
    DOCUMENT_FILE,
    NOMINAL_MODEL,
    PHYSICS_MODEL,
    RESIDUAL,
    WEIGHTS_FILE,
    ModelBundle,
    load_bundle,
    network_folder,
)
from pdhef_logtool.residual_model.features import FEATURES
from pdhef_logtool.storage.files import write_bytes
from pdhef_logtool.storage.outputs import OutputFolder, check_no_input, local_path

HISTORY_FILE = "history.parquet"
#: Minimum length of a training sequence between two restarts.
MIN_SEQUENCE_STEPS = 50
#: Length of the warm-up of the recurrent state before a selected stretch.
LEAD_STEPS = 200
#: Utilisation limit of the linear tyre range, and time constant of the shrinkage of a steering offset.
CALM_UTILISATION, OFFSET_SHRINK_S = 0.4, 1.0


@dataclass(frozen=True, slots=True, eq=False)
class TrainResult:
    """Result of the command; ``test_loss`` is the loss on the test drives, None without any."""

    model: Path
    bundle: ModelBundle
    history: tuple[Epoch, ...]
    test_loss: float | None

    def to_dict(self) -> dict[str, Any]:
        """Return the result as one JSON-able document."""
        return {
            "model": str(self.model),
            "sha256": self.bundle.sha256,
            "provenance": self.bundle.provenance,
            "test_loss": self.test_loss,
            "history": [asdict(e) for e in self.history],
        }


def run_training(
    dataset: Path | str,
    output: Path | str,
    *,
    init: Path | str | None = None,
    paper: bool = False,
    seed: int = 0,
    epochs: int | None = None,
    device: str = "cpu",
    progress: Callable[[str, float], None] = lambda _text, _share: None,
) -> TrainResult:
    """Train on a residual dataset and write the bundle, ``history.parquet`` to ``output``.

    If an interrupted call (even by kill -9) is repeated, it continues after its last complete epoch.

    Parameters
    ----------
    init : bundle to fine-tune. paper : Table 1's hyper-parameters instead of the default recipe.
    epochs : None = the recipe's. device : a PyTorch device such as ``cpu`` or ``cuda``.

    Raises
    ------
    UsageError
        The device does not exist, the number of epochs is not positive, or ``output`` is ``init`` itself.
    OutputError
        The folder cannot be written, or another command is writing to it.
    ModelError
        The dataset has no usable drives, or another training's checkpoint is in the way.
    """
    dataset, output = Path(dataset), local_path(output)
    init = None if init is None else Path(init)
    recipe = make_recipe(paper=paper, seed=seed, epochs=epochs, device=device)
    data = dataset_for(dataset, NOMINAL_MODEL if paper else PHYSICS_MODEL)
    start = None if init is None else network_folder(init)
    bundle = None if start is None else load_bundle(start)
    if bundle is not None and bundle.model != data.model:
        raise ModelError(expected=f"a network for {data.model}", got=f"one for {bundle.model}", where=str(init))
    check_no_input([start], [output / name for name in (DOCUMENT_FILE, WEIGHTS_FILE)])
    with OutputFolder(output):
        return train_on(data, output, recipe, init=bundle, device=device, progress=progress)


def dataset_for(folder: Path, model: str) -> Dataset:
    """Open a dataset with the residuals of a model.

    Raises
    ------
    OutputError
        It is no dataset, or one of another model.
    """
    data = read_dataset(folder)
    if data.model != model:
        raise OutputError(
            expected=f"residuals of {model}",
            got=f"residuals of {data.model}",
            where=str(folder),
            remedy=f"pdhef extract LOG... -o DATASET --filter {model} writes them, into another folder",
        )
    return data


def make_recipe(*, paper: bool, seed: int, epochs: int | None, device: str) -> Recipe:
    """Return the recipe of a call; raises UsageError for invalid values."""
    import torch

    if device != "cpu" and not torch.cuda.is_available():
        raise UsageError(expected="cpu, or a machine with CUDA", got=device, where="--device")
    if epochs is not None and epochs < 1:
        raise UsageError(expected="at least one epoch", got=str(epochs), where="--epochs")
    recipe = replace(PAPER_RECIPE if paper else Recipe(), seed=seed)
    return recipe if epochs is None else replace(recipe, epochs=epochs)


def train_on(
    data: Dataset,
    output: Path,
    recipe: Recipe,
    *,
    init: ModelBundle | None = None,
    device: str = "cpu",
    progress: Callable[[str, float], None] = lambda _text, _share: None,
) -> TrainResult:
    """Train one network by a recipe, which contains the target; otherwise as :func:`run_training`."""
    import polars as pl

    splits = {name: SplitSequences(data, name, recipe.target, recipe.odd) for name in SPLITS}

    def tell(epoch: Epoch, of: int) -> None:
        losses = f"train {epoch.train_loss:.4f}, validation {epoch.validation_loss:.4f}"
        progress(f"epoch {epoch.epoch}: {losses}", epoch.epoch / of)

    bundle, history = train(
        splits["train"], splits["validation"], recipe, output, init=init, device=device, progress=tell
    )
    test_loss = None if next(iter(splits["test"]), None) is None else mean_square(bundle, splits["test"])
    provenance = {
        **bundle.provenance,
        "dataset_sha256": data.sha256,
        "vehicle": data.vehicle_name,
        "fine_tuned_from": None if init is None else init.sha256,
        "fine_tuned_on": None if init is None else data.vehicle_name,
        "test_loss": test_loss,
    }
    bundle = replace(bundle, provenance=provenance, model=data.model, physics_sha256=data.physics_sha256)
    table = io.BytesIO()  # polars raises errors of other types for a full disk
    pl.DataFrame([asdict(e) for e in history]).write_parquet(table)
    write_bytes(output / HISTORY_FILE, table.getvalue())
    bundle.save(output)
    (output / CHECKPOINT).unlink(missing_ok=True)
    return TrainResult(output, bundle, tuple(history), test_loss)


def mean_square(bundle: ModelBundle, sequences: Iterable[FeatureSequence]) -> float:
    """Return the weighted mean square error of the normalised targets, computed as in operation."""
    total, weight = 0.0, 0.0
    for s in sequences:
        rates, _ = bundle.run(s.features, np.zeros(len(s.weight), dtype=np.bool_), None)
        error = (rates - s.target) / np.array(bundle.normalisation.target_std)
        total += float((np.mean(error**2, axis=1) * s.weight).sum())
        weight += float(s.weight.sum())
    if weight == 0.0:
        raise ModelError(expected="usable samples to test on", got="none", where="train")
    return total / weight


def gap_free_runs(drive: ResidualRows) -> Iterable[slice]:
    """Yield the runs between restarts of the parallel filter that are long enough for training.

    With a selection of rows, runs end with a selected stretch and begin :data:`LEAD_STEPS` before it.
    """
    piece = drive.segment
    if drive.chosen is not None:
        near = _near(drive.chosen & (drive.weight > 0.0))
        piece = np.cumsum(np.diff(near, prepend=near[:1]) | (np.diff(piece, prepend=piece[:1]) != 0))
    edges = [0, *(np.flatnonzero(np.diff(piece)) + 1).tolist(), drive.stamps_ns.shape[0]]
    for a, b in pairwise(edges):
        is_complete = np.isfinite(drive.features[a:b]).all()
        if b - a >= MIN_SEQUENCE_STEPS and is_complete and weights_of(drive, slice(a, b)).sum() > 0.0:
            yield slice(a, b)


def weights_of(drive: ResidualRows, part: slice) -> FloatArray:
    """Return the weights of a part of a drive, 0 for rows that are not selected."""
    weight = drive.weight[part].astype(np.float64)
    return weight if drive.chosen is None else weight * drive.chosen[part]


def _near(chosen: BoolArray) -> BoolArray:
    """Return the rows that are selected or at most :data:`LEAD_STEPS` before a selected row."""
    index = np.arange(len(chosen))
    following = np.minimum.accumulate(np.where(chosen, index, len(chosen) + LEAD_STEPS)[::-1])[::-1]
    return np.asarray(following - index <= LEAD_STEPS, dtype=np.bool_)


def steering_offset(rows: ResidualRows, vehicle: VehicleParameters) -> FloatArray:
    """Return the residual rates [2] due to an offset of the steering angle, which no network can predict.

    The offset is constant over the drive, fitted to calm driving, and shrunk if there is little of it.
    """
    friction, used = (rows.features[:, FEATURES.index(n)].astype(np.float64) for n in ("friction", "utilisation"))
    calm = (rows.weight > 0.0) & (used < CALM_UTILISATION)
    if not calm.any():
        return np.zeros(2)
    grip = 1.0 if vehicle.tyres.front.keeps_stiffness else float(friction[calm].mean())
    force = grip * vehicle.cornering_stiffness_n_per_rad(True, 1.0) / vehicle.mass_kg
    turn = force * vehicle.mass_kg * vehicle.cg_to_front_axle_m / vehicle.yaw_inertia_kg_m2
    by_angle = np.array([force, turn])
    mean = (rows.targets[calm] / rows.step_s[calm, None]).mean(axis=0)
    seconds = float(rows.step_s[calm].sum())
    angle = float(mean @ by_angle / (by_angle @ by_angle)) * seconds / (seconds + OFFSET_SHRINK_S)
    offset: FloatArray = angle * by_angle
    return offset


@dataclass(frozen=True, slots=True)
class SplitSequences:
    """The sequences of the drives of a split, read again on each iteration.

    A sequence is a gap-free run with residual increments divided by the true step, or with the true v_y.
    """

    data: Dataset
    split: str
    target: str
    odd: bool

    def __iter__(self) -> Iterator[FeatureSequence]:
        """Yield the sequences in the order of the drives; one drive is in memory at a time."""
        for drive in (d for d in self.data.drives if d.entry["split"] == self.split):
            rows = drive.load()
            offset = steering_offset(rows, self.data.vehicle(drive)) if self.odd else np.zeros(2)
            for part in gap_free_runs(rows):
                weight = weights_of(rows, part)
                features = np.asarray(rows.features[part], dtype=np.float64)
                if self.target == RESIDUAL:
                    values = np.asarray(rows.targets[part], dtype=np.float64) / rows.step_s[part, None] - offset
                else:
                    values = np.asarray(rows.truth_velocity[part, 1:2], dtype=np.float64)
                    weight = weight * np.isfinite(values[:, 0])
                values[weight == 0.0] = 0.0
                if weight.sum() > 0.0:
                    yield FeatureSequence(drive.entry["name"], features, values, weight)
