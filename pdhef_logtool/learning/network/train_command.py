"""``pdhef train``: train a model bundle on a dataset, with loss history and resumption."""

import hashlib
import io
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.learning.network.dataset import SPLITS, Dataset, read_dataset
from pdhef_logtool.learning.network.residuals import ResidualRows
from pdhef_logtool.records.errors import ModelError, UsageError
from pdhef_logtool.records.signals import BoolArray, FloatArray
from pdhef_logtool.residual_model import bundle as bundles
from pdhef_logtool.residual_model.features import FEATURES, ODD_FEATURES, PAPER_FEATURES
from pdhef_logtool.residual_model.network import ResidualNetwork, State
from pdhef_logtool.storage.files import write_bytes
from pdhef_logtool.storage.outputs import OutputFolder, check_no_input, local_path

# isort: split
# After the network, which checks that PyTorch is installed.
import torch
from torch.nn.utils.rnn import pad_sequence

CHECKPOINT = "checkpoint.safetensors"


#: Maximum number of validation steps at once, with the state carried on; an hour at once would need a gigabyte.
VALIDATION_STEPS = 60_000
GRADIENT_CLIP = 1.0
#: Added to the mean square of a piece before its inverse becomes the weight.
WEIGHT_FLOOR = 0.1
#: Common entries of a recipe and the bundle trained with it.
_SHAPE = ("feature_names", "hidden", "layers", "head", "odd")


@dataclass(frozen=True, slots=True, eq=False)
class FeatureSequence:
    """One gap-free run of one drive: features [N, 15], target [N, m], weight [N].

    The target is residual rates in m/s² and rad/s² (m = 2), or v_y in m/s (m = 1).
    """

    features: FloatArray
    target: FloatArray
    weight: FloatArray


@dataclass(frozen=True, slots=True)
class Recipe:
    """Training recipe. The defaults are the recipe of docs/method.md#network; :data:`PAPER_RECIPE` is Table 1's.

    64 units per layer reach the accuracy of 96 after the same number of epochs (``docs/model_card.md``) in
    two thirds of the time, in training and in operation.

    Attributes
    ----------
    piece_steps : maximum length of a training piece; validation uses whole sequences.
    pieces_per_epoch : number of pieces that an epoch draws at random; None: all.
    """

    feature_names: tuple[str, ...] = FEATURES
    hidden: int = 64
    layers: int = 2
    head: tuple[int, ...] = (64, 32)
    dropout: float = 0.0
    epochs: int = 30
    batch: int = 16
    chunk_steps: int = 50
    piece_steps: int = 1500
    pieces_per_epoch: int | None = None
    learning_rate: float = 3e-3
    schedule: str = "one-cycle"  # or "exponential"
    patience: int = 10
    seed: int = 0
    period_s: float = 0.01
    target: str = bundles.RESIDUAL
    odd: bool = True  # mirrored pieces are as frequent as originals, and the network is made exactly odd


PAPER_RECIPE = Recipe(
    feature_names=PAPER_FEATURES,
    hidden=128,
    dropout=0.2,
    epochs=200,
    batch=64,
    learning_rate=1e-3,
    schedule="exponential",
    patience=200,
    odd=False,
)


@dataclass(frozen=True, slots=True)
class Epoch:
    """One line of the loss history; losses are mean squares of normalised targets."""

    epoch: int
    train_loss: float
    validation_loss: float
    learning_rate: float
    seconds: float


Progress = Callable[[str, float], None]


def normalisation_of(
    sequences: Iterable[FeatureSequence], names: tuple[str, ...], *, odd: bool = False
) -> bundles.Normalisation:
    """Return mean and standard deviation of features and targets over the used samples of training sequences.

    With ``odd``, features that change sign under mirroring have a mean of 0.
    """
    columns = [FEATURES.index(n) for n in names]
    parts = [(s.features[s.weight > 0][:, columns], s.target[s.weight > 0]) for s in sequences]
    # Contiguous rows are summed one by one, so that rounding does not depend on the split into sequences.
    features, target = (np.ascontiguousarray(np.concatenate(c)) for c in zip(*parts, strict=True))
    if not len(features):
        raise ModelError(expected="training sequences with usable samples", got="none", where="train")
    mean = features.mean(axis=0)
    if odd:
        mean[[n in ODD_FEATURES for n in names]] = 0.0
    std, spread = (np.maximum(np.sqrt(np.mean(v**2, axis=0)), 1e-6) for v in (features - mean, target))
    return bundles.Normalisation(*(tuple(column.tolist()) for column in (mean, std, spread)))


def train(
    training: Iterable[FeatureSequence],
    validation: Iterable[FeatureSequence],
    recipe: Recipe,
    work: Path,
    *,
    test: Iterable[FeatureSequence] = (),
    init: bundles.ModelBundle | None = None,
    device: str = "cpu",
    progress: Progress = lambda _text, _share: None,
) -> tuple[bundles.ModelBundle, list[Epoch]]:
    """Train a network and return the bundle of the best validation epoch with the loss history.

    Parameters
    ----------
    training, validation : iterated up to three times before the first epoch. test : scored by the best epoch.
    work : folder of the checkpoint; a checkpoint with the same recipe and data is resumed.
    init : bundle to start from (fine-tuning), with its features, architecture and normalisation.

    Raises
    ------
    ModelError
        There are no sequences to train or validate on, or a checkpoint of another recipe exists.
    """
    for sequences, aim in ((training, "train"), (validation, "validate")):
        if next(iter(sequences), None) is None:
            raise ModelError(
                expected="training and validation drives",
                got=f"0 sequences to {aim} on",
                where="train",
                remedy="extract more drives, so that every split has some",
            )
    if init is not None:
        recipe = replace(recipe, **{name: getattr(init, name) for name in (*_SHAPE, "target")})
    empty = bundles.ModelBundle(
        **{name: getattr(recipe, name) for name in (*_SHAPE, "period_s", "target")},
        normalisation=init.normalisation if init else normalisation_of(training, recipe.feature_names, odd=recipe.odd),
        weights={},
    )
    run = _Training.start(recipe, init, empty.signs, device)
    train_pieces = [piece for s in training for piece in _pieces(s, empty, recipe.piece_steps)]
    validation_pieces, test_pieces = (
        [p for s in x for p in _pieces(s, empty, len(s.weight))] for x in (validation, test)
    )
    identity = {"recipe": asdict(recipe), "normalisation": asdict(empty.normalisation), "init": init and init.sha256}
    used = {"training": train_pieces, "validation": validation_pieces}
    identity |= {name: _sha256(chain.from_iterable(pieces)) for name, pieces in used.items()}
    if (work / CHECKPOINT).is_file():
        run.resume(work / CHECKPOINT, identity)
    for epoch in range(len(run.history), recipe.epochs):
        if len(run.history) - 1 - run.best_epoch >= recipe.patience:
            break
        began = time.perf_counter()
        train_loss, rate = run.epoch(train_pieces, epoch)
        loss = run.validate(validation_pieces)
        run.history.append(Epoch(epoch + 1, train_loss, loss, rate, time.perf_counter() - began))
        if run.best_epoch == epoch:
            run.best = _weights(run.network)
        run.save(work / CHECKPOINT, identity)
        progress(f"epoch {epoch + 1}: train {train_loss:.4f}, validation {loss:.4f}", (epoch + 1) / recipe.epochs)
    run.network.load_state_dict(run.best)
    provenance = {
        "recipe": asdict(recipe),
        "epochs": len(run.history),
        "best_epoch": run.best_epoch + 1,
        "validation_loss": run.history[run.best_epoch].validation_loss,
        "test_loss": run.validate(test_pieces) if test_pieces else None,
    }
    return replace(empty, weights={k: v.numpy() for k, v in run.best.items()}, provenance=provenance), run.history


# ---- data ----


class _Piece(NamedTuple):
    features: torch.Tensor
    target: torch.Tensor
    weight: torch.Tensor


def _sha256(parts: Iterable[str | torch.Tensor]) -> str:
    total = hashlib.sha256()
    for part in parts:
        total.update(part.encode() if isinstance(part, str) else part.numpy().tobytes())
    return total.hexdigest()


def _pieces(s: FeatureSequence, bundle: bundles.ModelBundle, steps: int) -> Iterator[_Piece]:
    """Yield the pieces of a sequence as the network of a bundle receives and predicts it.

    The weights of a piece are divided by the mean square of its target.
    """
    columns = (bundle.normalise(s.features), s.target / np.array(bundle.normalisation.target_std), s.weight)
    parts = (torch.split(torch.from_numpy(column.astype(np.float32)), steps) for column in columns)
    for features, target, weight in zip(*parts, strict=True):
        if float(weight.sum()) > 0.0:
            mean = float(((target**2).mean(dim=1) * weight).sum() / weight.sum())
            yield _Piece(features, target, weight / (mean + WEIGHT_FLOOR))


# ---- one epoch ----


@dataclass(slots=True, eq=False)
class _Training:
    """A network in training. ``signs``: of its features when left and right are exchanged; None does not mirror.

    ``best`` : weights of the best epoch in ``history``.
    """

    network: ResidualNetwork
    optimiser: torch.optim.Optimizer
    recipe: Recipe
    signs: torch.Tensor | None
    device: str
    best: dict[str, torch.Tensor]
    history: list[Epoch] = field(default_factory=list)

    @classmethod
    def start(cls, recipe: Recipe, init: bundles.ModelBundle | None, signs: FloatArray, device: str) -> "_Training":
        """Return a network with random weights by the seed of a recipe, or with the weights of a bundle."""
        torch.manual_seed(recipe.seed)
        sizes, outputs = (len(recipe.feature_names), recipe.hidden, recipe.layers), bundles.OUTPUT_COUNT[recipe.target]
        network = ResidualNetwork(*sizes, recipe.head, recipe.dropout, outputs=outputs)
        if init is not None:
            network.load_state_dict({k: torch.from_numpy(np.array(v)) for k, v in init.weights.items()})
        network = network.to(device)
        optimiser = torch.optim.Adam(network.parameters(), lr=recipe.learning_rate)
        mirror = torch.tensor(signs, dtype=torch.float32) if recipe.odd else None
        return cls(network, optimiser, recipe, mirror, device, _weights(network))

    @property
    def best_epoch(self) -> int:
        """Index of the epoch with the lowest validation loss; -1 before the first."""
        return min(range(len(self.history)), key=lambda i: self.history[i].validation_loss, default=-1)

    def epoch(self, pieces: Sequence[_Piece], number: int) -> tuple[float, float]:
        """Train once on pieces in a seeded random order; return mean loss and last learning rate."""
        recipe = self.recipe
        # All randomness of an epoch depends on seed and epoch number only, so that a resumed training is identical.
        torch.manual_seed(recipe.seed * 1_000_003 + number)
        order = torch.randperm(len(pieces)).tolist()[: recipe.pieces_per_epoch]
        batches = max(1, math.ceil(len(order) / recipe.batch))
        self.network.train()
        losses = []
        for b in range(batches):
            rate = _learning_rate(recipe, (number + b / batches) / recipe.epochs)
            for group in self.optimiser.param_groups:
                group["lr"] = rate
            chosen = [pieces[i] for i in order[b * recipe.batch : (b + 1) * recipe.batch]]
            if self.signs is not None:  # pieces are as often mirrored as not
                mirrored = [p._replace(features=p.features * self.signs, target=-p.target) for p in chosen]
                chosen = [m if torch.rand(()) < 0.5 else p for m, p in zip(mirrored, chosen, strict=True)]
            padded = (pad_sequence(list(columns), batch_first=True) for columns in zip(*chosen, strict=True))
            losses.append(self._batch(_Piece(*(column.to(self.device) for column in padded))))
        return float(np.mean(losses)), rate

    def _batch(self, batch: _Piece) -> float:
        """Train on a batch chunk by chunk, with the recurrent state carried on; return the mean loss."""
        state: State | None = None
        losses = []
        chunks = (torch.split(column, self.recipe.chunk_steps, dim=1) for column in batch)
        for features, target, weight in zip(*chunks, strict=True):
            output, after = self.network(features, state)
            state = (after[0].detach(), after[1].detach())
            total = weight.sum()
            if float(total) == 0.0:
                continue
            loss = ((output - target) ** 2).mean(dim=2).mul(weight).sum() / total
            self.optimiser.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(self.network.parameters(), GRADIENT_CLIP)
            self.optimiser.step()
            losses.append(float(loss.detach()))
        return float(np.mean(losses)) if losses else 0.0

    def validate(self, pieces: Iterable[_Piece]) -> float:
        """Return the mean loss over whole sequences, with the network as it is used: a mirrored one is made odd."""
        self.network.eval()
        total, weight = 0.0, 0.0
        with torch.inference_mode():
            for p in pieces:
                state: State | None = None
                parts = []
                for features in torch.split(p.features, VALIDATION_STEPS):
                    sides = features[None] if self.signs is None else torch.stack([features, features * self.signs])
                    output, state = self.network(sides.to(self.device), state)
                    parts.append((output[0] if self.signs is None else 0.5 * (output[0] - output[1])).cpu())
                square = ((torch.cat(parts) - p.target) ** 2).mean(dim=1)
                total += float((square * p.weight).sum())
                weight += float(p.weight.sum())
        return total / weight if weight else math.inf

    def save(self, path: Path, identity: dict[str, Any]) -> None:
        """Write a checkpoint: tensors and document in one file, with their hash.

        ``identity`` of the training: its recipe and data.
        """
        from safetensors.torch import save

        states = self.optimiser.state_dict()["state"]
        optimiser = {f"{i}.{key}": value for i, of in states.items() for key, value in of.items()}
        groups = {"network": self.network.state_dict(), "best": self.best, "optimiser": optimiser}
        tensors = {f"{g}.{name}": value.cpu().contiguous() for g, of in groups.items() for name, value in of.items()}
        document = json.dumps({"identity": identity, "history": [asdict(e) for e in self.history]})
        about = {"document": document, "sha256": _sha256([document, *chain(*sorted(tensors.items()))])}
        write_bytes(path, save(tensors, metadata=about))

    def resume(self, path: Path, identity: dict[str, Any]) -> None:
        """Continue after a checkpoint; raises ModelError if it is damaged, or of another recipe or other data."""
        from safetensors import SafetensorError, safe_open

        try:
            with safe_open(path, framework="pt") as stored:
                about = stored.metadata()
                tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118 (not a mapping)
            if about["sha256"] != _sha256([about["document"], *chain(*sorted(tensors.items()))]):
                raise ValueError("another hash")
        except (OSError, ValueError, LookupError, TypeError, SafetensorError):
            expected, got = "a checkpoint of a training", "content that is not as it was written"
            raise ModelError(expected=expected, got=got, where=path, remedy="remove it to train again") from None
        document = json.loads(about["document"])
        if document["identity"] != json.loads(json.dumps(identity)):
            expected, got = "a checkpoint of this recipe and data", "one of another"
            remedy = "train into another folder, or remove the checkpoint"
            raise ModelError(expected=expected, got=got, where=path, remedy=remedy)
        groups: dict[str, dict[str, torch.Tensor]] = {"network": {}, "best": {}, "optimiser": {}}
        for name, value in tensors.items():
            group, _, key = name.partition(".")
            groups[group][key] = value
        states: dict[int, dict[str, torch.Tensor]] = {}
        for name, value in groups["optimiser"].items():
            index, _, key = name.partition(".")
            states.setdefault(int(index), {})[key] = value
        self.network.load_state_dict(groups["network"])
        self.optimiser.load_state_dict({**self.optimiser.state_dict(), "state": states})
        self.history, self.best = [Epoch(**e) for e in document["history"]], groups["best"]


def _weights(network: ResidualNetwork) -> dict[str, torch.Tensor]:
    return {k: v.detach().cpu().clone() for k, v in network.state_dict().items()}


def _learning_rate(recipe: Recipe, share: float) -> float:
    """Return the learning rate at a share of the training: one cycle with 30 % warm-up, or exponential decay."""
    if recipe.schedule == "exponential":
        return recipe.learning_rate * math.exp(-3.0 * share)
    if share < 0.3:
        return recipe.learning_rate * (0.04 + 0.96 * (0.5 - 0.5 * math.cos(math.pi * share / 0.3)))
    return recipe.learning_rate * (1e-4 + (1.0 - 1e-4) * (0.5 + 0.5 * math.cos(math.pi * (share - 0.3) / 0.7)))


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
    bundle: bundles.ModelBundle
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
    progress: Progress = lambda _text, _share: None,
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
    recipe = make_recipe(paper=paper, seed=seed, epochs=epochs, device=device)
    data = read_dataset(dataset, bundles.NOMINAL_MODEL if paper else bundles.PHYSICS_MODEL)
    start = bundles.network_folder(bundles.NO_MODEL if init is None else init)
    bundle = None if start is None else bundles.load_bundle(start)
    if bundle is not None and bundle.model != data.model:
        raise ModelError(expected=f"a network for {data.model}", got=f"one for {bundle.model}", where=init)
    check_no_input([start], [output / name for name in (bundles.DOCUMENT_FILE, bundles.WEIGHTS_FILE)])
    with OutputFolder(output):
        return train_on(data, output, recipe, init=bundle, device=device, progress=progress)


def make_recipe(*, paper: bool, seed: int, epochs: int | None, device: str) -> Recipe:
    """Return the recipe of a call; raises UsageError for invalid values."""
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
    init: bundles.ModelBundle | None = None,
    device: str = "cpu",
    progress: Progress = lambda _text, _share: None,
) -> TrainResult:
    """Train one network by a recipe, which contains the target; otherwise as :func:`run_training`."""
    import polars as pl

    training, validation, test = (SplitSequences(data, split, recipe.target, recipe.odd) for split in SPLITS)
    bundle, history = train(
        training, validation, recipe, output, test=test, init=init, device=device, progress=progress
    )
    provenance = {
        **bundle.provenance,
        "dataset_sha256": data.sha256,
        "vehicle": data.vehicle_name,
        "fine_tuned_from": None if init is None else init.sha256,
        "fine_tuned_on": None if init is None else data.vehicle_name,
    }
    bundle = replace(bundle, provenance=provenance, model=data.model, physics_sha256=data.physics_sha256)
    table = io.BytesIO()  # polars raises errors of other types for a full disk
    pl.DataFrame([asdict(e) for e in history]).write_parquet(table)
    write_bytes(output / HISTORY_FILE, table.getvalue())
    bundle.save(output)
    (output / CHECKPOINT).unlink(missing_ok=True)
    return TrainResult(output, bundle, tuple(history), bundle.provenance["test_loss"])


def gap_free_runs(drive: ResidualRows) -> Iterable[slice]:
    """Yield the runs between restarts of the parallel filter that are long enough for training.

    With a selection of rows, runs end with a selected stretch and begin :data:`LEAD_STEPS` before it.
    """
    piece, weight = drive.segment, drive.training_weight
    if not drive.chosen.all():
        near = _near(weight > 0.0)
        piece = np.cumsum(np.diff(near, prepend=near[:1]) | (np.diff(piece, prepend=piece[:1]) != 0))
    edges = [0, *(np.flatnonzero(np.diff(piece)) + 1).tolist(), drive.stamps_ns.shape[0]]
    for a, b in pairwise(edges):
        is_complete = np.isfinite(drive.features[a:b]).all()
        if b - a >= MIN_SEQUENCE_STEPS and is_complete and weight[a:b].sum() > 0.0:
            yield slice(a, b)


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
            weights = rows.training_weight
            for part in gap_free_runs(rows):
                weight = weights[part]
                features = np.asarray(rows.features[part], dtype=np.float64)
                if self.target == bundles.RESIDUAL:
                    values = np.asarray(rows.targets[part], dtype=np.float64) / rows.step_s[part, None] - offset
                else:
                    values = np.asarray(rows.truth_velocity[part, 1:2], dtype=np.float64)
                    weight = weight * np.isfinite(values[:, 0])
                values[weight == 0.0] = 0.0
                if weight.sum() > 0.0:
                    yield FeatureSequence(features, values, weight)
