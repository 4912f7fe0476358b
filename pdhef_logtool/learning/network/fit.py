"""Training of the residual network: stateful truncated back-propagation through time, resumable at every epoch.

Sequences are processed in chunks of ``chunk_steps``; the LSTM state is carried from chunk to chunk and detached
(docs/method.md#network). The loss is the weighted mean square of the normalised residual rates. Each piece is weighted
by the inverse of its mean square, so that driving at the limit does not dominate calm driving. Every epoch is a pure
function of the previous state, the seed and the epoch number, so that a resumed training gives the same result.

All pieces are in memory, 25 MB for an hour of driving at 100 Hz.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pdhef_logtool.records.errors import ModelError
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.residual_model.bundle import OUTPUT_COUNT, RESIDUAL, ModelBundle, Normalisation
from pdhef_logtool.residual_model.features import FEATURES, ODD_FEATURES, PAPER_FEATURES
from pdhef_logtool.residual_model.network import ResidualNetwork, State
from pdhef_logtool.storage.documents import is_sealed, seal
from pdhef_logtool.storage.files import write_bytes

# isort: split
# After the network, which checks that PyTorch is installed.
import torch

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

    drive: str
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
    target: str = RESIDUAL
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


Progress = Callable[[Epoch, int], None]


def normalisation_of(
    sequences: Iterable[FeatureSequence], names: tuple[str, ...], *, odd: bool = False
) -> Normalisation:
    """Return weighted mean and standard deviation of features and targets over the training sequences.

    ``sequences`` is iterated twice. With ``odd``, features that change sign under mirroring have a mean of 0.
    """
    columns = [FEATURES.index(n) for n in names]
    count, total, squares = 0, np.zeros(len(columns)), np.zeros(0)
    for s in sequences:
        use = s.weight > 0
        total = _summed(total, s.features[use][:, columns])
        squares = _summed(squares if squares.size else np.zeros(s.target.shape[1]), s.target[use] ** 2)
        count += int(np.count_nonzero(use))
    if count == 0:
        raise ModelError(expected="training sequences with usable samples", got="none", where="train")
    mean = total / count
    if odd:
        mean[[n in ODD_FEATURES for n in names]] = 0.0
    deviations = np.zeros(len(columns))
    for s in sequences:
        deviations = _summed(deviations, (s.features[s.weight > 0][:, columns] - mean) ** 2)
    std = np.maximum(np.sqrt(deviations / count), 1e-6)
    spread = np.maximum(np.sqrt(squares / count), 1e-6)
    return Normalisation(*(tuple(map(float, column)) for column in (mean, std, spread)))


def _summed(before: FloatArray, rows: FloatArray) -> FloatArray:
    """Add rows [N, k] one by one to a sum [k], so that rounding does not depend on the split into sequences."""
    total: FloatArray = np.add.reduce(np.ascontiguousarray(np.concatenate([before[None], rows])), axis=0)
    return total


def train(
    training: Iterable[FeatureSequence],
    validation: Iterable[FeatureSequence],
    recipe: Recipe,
    work: Path,
    *,
    init: ModelBundle | None = None,
    device: str = "cpu",
    progress: Progress = lambda _epoch, _of: None,
) -> tuple[ModelBundle, list[Epoch]]:
    """Train a network and return the bundle of the best validation epoch with the loss history.

    Parameters
    ----------
    training, validation : iterated up to three times before the first epoch.
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
    empty = ModelBundle(
        **{name: getattr(recipe, name) for name in (*_SHAPE, "period_s", "target")},
        normalisation=init.normalisation if init else normalisation_of(training, recipe.feature_names, odd=recipe.odd),
        weights={},
    )
    network = _new_network(recipe, init).to(device)
    optimiser = torch.optim.Adam(network.parameters(), lr=recipe.learning_rate)
    signs = torch.tensor(empty.signs, dtype=torch.float32) if recipe.odd else None
    train_pieces = Pieces(training, lambda s: _pieces(s, recipe.piece_steps, empty))
    validation_pieces = Pieces(validation, lambda s: [_balanced(_scaled(s, empty))])
    document = {"recipe": asdict(recipe), "normalisation": asdict(empty.normalisation), "init": init and init.sha256}
    document |= {"training": train_pieces.sha256, "validation": validation_pieces.sha256}
    identity = json.loads(json.dumps(document))  # as it is read from a checkpoint
    history, best, best_loss = _resume(work, identity, network, optimiser, device)
    for epoch in range(len(history), recipe.epochs):
        if len(history) - 1 - _best_epoch(history) >= recipe.patience:
            break
        began = time.perf_counter()
        train_loss, rate = _train_epoch(network, optimiser, train_pieces, recipe, epoch, signs, device)
        loss = _validate(network, validation_pieces, device, signs)
        history.append(Epoch(epoch + 1, train_loss, loss, rate, time.perf_counter() - began))
        if loss < best_loss:
            best, best_loss = _weights(network), loss
        _write_checkpoint(work, identity, history, network, optimiser, best)
        progress(history[-1], recipe.epochs)
    provenance = {
        "recipe": asdict(recipe),
        "epochs": len(history),
        "best_epoch": _best_epoch(history) + 1,
        "validation_loss": best_loss,
        "training_sequences": train_pieces.sequences,
        "validation_sequences": validation_pieces.sequences,
        "training_hours": round(train_pieces.steps * recipe.period_s / 3600.0, 3),
    }
    return replace(empty, weights=best, provenance=provenance), history


# ---- data ----


class _Piece(NamedTuple):
    features: torch.Tensor
    target: torch.Tensor
    weight: torch.Tensor


class Pieces(list[_Piece]):
    """Pieces of sequences, single precision.

    Attributes
    ----------
    sequences, steps : number of sequences and steps. sha256 : hash of the pieces.
    """

    def __init__(
        self, sequences: Iterable[FeatureSequence], cut: Callable[[FeatureSequence], Iterable[_Piece]]
    ) -> None:
        super().__init__()
        self.sequences = self.steps = 0
        content = hashlib.sha256()
        for s in sequences:
            self.sequences += 1
            self.steps += len(s.weight)
            for piece in cut(s):
                self.append(piece)
                for column in piece:
                    content.update(column.numpy().tobytes())
        self.sha256 = content.hexdigest()


def _scaled(s: FeatureSequence, bundle: ModelBundle) -> _Piece:
    """Return a sequence as the network of a bundle receives and predicts it."""
    target = s.target / np.array(bundle.normalisation.target_std)
    return _Piece(*(torch.from_numpy(c.astype(np.float32)) for c in (bundle.normalise(s.features), target, s.weight)))


def _pieces(sequence: FeatureSequence, steps: int, bundle: ModelBundle) -> Iterator[_Piece]:
    whole = _scaled(sequence, bundle)
    for first in range(0, whole.features.shape[0], steps):
        part = _Piece(*(column[first : first + steps] for column in whole))
        if float(part.weight.sum()) > 0.0:
            yield _balanced(part)


def _balanced(piece: _Piece) -> _Piece:
    """Divide the weights of a piece by the mean square of its target."""
    square = (piece.target**2).mean(dim=1)
    mean = float((square * piece.weight).sum() / piece.weight.sum())
    return piece._replace(weight=piece.weight / (mean + WEIGHT_FLOOR))


def _padded(pieces: Sequence[_Piece], device: str) -> _Piece:
    pad = torch.nn.utils.rnn.pad_sequence
    return _Piece(*(pad(list(columns), batch_first=True).to(device) for columns in zip(*pieces, strict=True)))


# ---- one epoch ----


def _train_epoch(
    network: ResidualNetwork,
    optimiser: torch.optim.Optimizer,
    pieces: Sequence[_Piece],
    recipe: Recipe,
    epoch: int,
    signs: torch.Tensor | None,
    device: str,
) -> tuple[float, float]:
    """Train once on the pieces of an epoch in a seeded random order; return mean loss and last learning rate.

    ``signs``: of the features when left and right are exchanged, for pieces that are as often mirrored as not.
    """
    # All randomness of an epoch depends on seed and epoch number only, so that a resumed training is identical.
    torch.manual_seed(recipe.seed * 1_000_003 + epoch)
    order = torch.randperm(len(pieces)).tolist()[: recipe.pieces_per_epoch]
    batches = max(1, math.ceil(len(order) / recipe.batch))
    network.train()
    losses = []
    for b in range(batches):
        rate = _learning_rate(recipe, (epoch + b / batches) / recipe.epochs)
        for group in optimiser.param_groups:
            group["lr"] = rate
        chosen = [pieces[i] for i in order[b * recipe.batch : (b + 1) * recipe.batch]]
        if signs is not None:
            mirrored = [p._replace(features=p.features * signs, target=-p.target) for p in chosen]
            chosen = [m if torch.rand(()) < 0.5 else p for m, p in zip(mirrored, chosen, strict=True)]
        losses.append(_train_batch(network, optimiser, chosen, recipe.chunk_steps, device))
    return float(np.mean(losses)), rate


def _train_batch(
    network: ResidualNetwork, optimiser: torch.optim.Optimizer, pieces: Sequence[_Piece], chunk_steps: int, device: str
) -> float:
    batch = _padded(pieces, device)
    state: State | None = None
    losses = []
    for first in range(0, batch.features.shape[1], chunk_steps):
        part = slice(first, first + chunk_steps)
        output, after = network(batch.features[:, part], state)
        state = (after[0].detach(), after[1].detach())
        weight = batch.weight[:, part]
        total = weight.sum()
        if float(total) == 0.0:
            continue
        loss = ((output - batch.target[:, part]) ** 2).mean(dim=2).mul(weight).sum() / total
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), GRADIENT_CLIP)
        optimiser.step()
        losses.append(float(loss.detach()))
    return float(np.mean(losses)) if losses else 0.0


def _validate(network: ResidualNetwork, pieces: Iterable[_Piece], device: str, signs: torch.Tensor | None) -> float:
    """Return the loss as in operation, over whole sequences; with ``signs`` the network is made odd."""
    network.eval()
    total, weight = 0.0, 0.0
    with torch.inference_mode():
        for p in pieces:
            state: State | None = None
            parts = []
            for first in range(0, len(p.weight), VALIDATION_STEPS):
                features = p.features[first : first + VALIDATION_STEPS]
                sides = features[None] if signs is None else torch.stack([features, features * signs])
                output, state = network(sides.to(device), state)
                parts.append((output[0] if signs is None else 0.5 * (output[0] - output[1])).cpu())
            square = ((torch.cat(parts) - p.target) ** 2).mean(dim=1)
            total += float((square * p.weight).sum())
            weight += float(p.weight.sum())
    return total / weight if weight else math.inf


def _learning_rate(recipe: Recipe, share: float) -> float:
    """Return the learning rate at a share of the training: one cycle with 30 % warm-up, or exponential decay."""
    if recipe.schedule == "exponential":
        return recipe.learning_rate * math.exp(-3.0 * share)
    if share < 0.3:
        return recipe.learning_rate * (0.04 + 0.96 * (0.5 - 0.5 * math.cos(math.pi * share / 0.3)))
    return recipe.learning_rate * (1e-4 + (1.0 - 1e-4) * (0.5 + 0.5 * math.cos(math.pi * (share - 0.3) / 0.7)))


# ---- state ----


def _new_network(recipe: Recipe, init: ModelBundle | None) -> ResidualNetwork:
    torch.manual_seed(recipe.seed)
    sizes, outputs = (len(recipe.feature_names), recipe.hidden, recipe.layers), OUTPUT_COUNT[recipe.target]
    network = ResidualNetwork(*sizes, recipe.head, recipe.dropout, outputs=outputs)
    if init is not None:
        network.load_state_dict({k: torch.from_numpy(np.array(v)) for k, v in init.weights.items()})
    return network


def _weights(network: ResidualNetwork) -> dict[str, Any]:
    return {k: v.detach().cpu().numpy().copy() for k, v in network.state_dict().items()}


def _best_epoch(history: Sequence[Epoch]) -> int:
    return int(np.argmin([e.validation_loss for e in history])) if history else -1


def _write_checkpoint(
    work: Path,
    identity: dict[str, Any],
    history: Sequence[Epoch],
    network: ResidualNetwork,
    optimiser: torch.optim.Optimizer,
    best: dict[str, Any],
) -> None:
    from safetensors.numpy import save

    states = optimiser.state_dict()["state"]
    groups = {
        "network": _weights(network),
        "best": best,
        "optimiser": {f"{i}.{key}": value.cpu().numpy() for i, of in states.items() for key, value in of.items()},
    }
    tensors = {f"{group}.{name}": np.array(value) for group, of in groups.items() for name, value in of.items()}
    document = seal({"identity": identity, "history": [asdict(e) for e in history], "sha256": _sha256(tensors)})
    # Tensors and document are in one file, so that an interrupted write cannot leave an inconsistent pair.
    data = save(tensors, metadata={"document": json.dumps(document)})
    write_bytes(work / CHECKPOINT, data)


def _sha256(tensors: Mapping[str, Any]) -> str:
    total = hashlib.sha256()
    for name in sorted(tensors):
        total.update(name.encode() + np.ascontiguousarray(tensors[name]).tobytes())
    return total.hexdigest()


def _resume(
    work: Path, identity: dict[str, Any], network: ResidualNetwork, optimiser: torch.optim.Optimizer, device: str
) -> tuple[list[Epoch], dict[str, Any], float]:
    from safetensors import SafetensorError, safe_open

    file = work / CHECKPOINT
    if not file.is_file():
        return [], _weights(network), math.inf
    try:
        with safe_open(file, framework="numpy") as stored:
            document = json.loads(stored.metadata()["document"])
            tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118 (not a mapping)
        if not is_sealed(document) or document["sha256"] != _sha256(tensors):
            raise ValueError("content that is not as it was written")
    except (OSError, ValueError, LookupError, TypeError, SafetensorError) as error:
        raise ModelError(
            expected="a checkpoint of a training", got=str(error), where=str(file), remedy="remove it to train again"
        ) from None
    if document["identity"] != identity:
        raise ModelError(
            expected="a checkpoint of this recipe and data",
            got="one of another",
            where=str(file),
            remedy="train into another folder, or remove the checkpoint",
        )
    groups: dict[str, dict[str, Any]] = {"network": {}, "best": {}, "optimiser": {}}
    for name, value in tensors.items():
        group, _, key = name.partition(".")
        groups[group][key] = value
    network.load_state_dict({key: torch.from_numpy(value) for key, value in groups["network"].items()})
    states: dict[int, dict[str, torch.Tensor]] = {}
    for name, value in groups["optimiser"].items():
        index, _, key = name.partition(".")
        states.setdefault(int(index), {})[key] = torch.from_numpy(value).to("cpu" if key == "step" else device)
    optimiser.load_state_dict({"state": states, "param_groups": optimiser.state_dict()["param_groups"]})
    history = [Epoch(**e) for e in document["history"]]
    return history, groups["best"], min(e.validation_loss for e in history)
