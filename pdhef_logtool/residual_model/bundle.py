"""Model bundle: ``weights.safetensors`` and ``model.json`` in one folder, without pickle."""

import hashlib
import json
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass as checked_dataclass

from pdhef_logtool.records.errors import ModelError
from pdhef_logtool.records.signals import BoolArray, FloatArray
from pdhef_logtool.residual_model.features import FEATURES, ODD_FEATURES
from pdhef_logtool.residual_model.interface import LIMITS, Residual
from pdhef_logtool.residual_model.linear_model import LinearModel, load_linear_model
from pdhef_logtool.storage.documents import one_of, read_json, validated
from pdhef_logtool.storage.files import PendingFile, open_new, writing

if TYPE_CHECKING:
    from pdhef_logtool.residual_model.forward_pass import ForwardPass, NetworkState

FORMAT = "pdhef.residual-model"
FORMAT_VERSION = 2
WEIGHTS_FILE = "weights.safetensors"
DOCUMENT_FILE = "model.json"
#: Optional baselines beside the network, trained on the same dataset.
PURE_LSTM_FOLDER = "baselines/pure-lstm"
LINEAR_REGRESSION_FILE = "baselines/linear-regression.json"
#: The paper's network (six features, size of Table 1) for the paper's filter.
PAPER_FOLDER = "baselines/paper-network"

#: Names in place of a folder: the network of the package, and no network.
SHIPPED, NO_MODEL = "default", "none"
SHIPPED_FOLDERS = {SHIPPED: Path(__file__).parents[1] / "models" / "default" / "network"}

#: Filters that provide features and the model of a residual: ``physics``, and the paper's filter for the paper's
#: network and the baselines.
PHYSICS_MODEL, NOMINAL_MODEL = "physics", "phy-ukf"
MODELS = (PHYSICS_MODEL, NOMINAL_MODEL)

#: Targets of a network with the number of outputs: residual rates of v_y and r, or v_y itself.
RESIDUAL = "residual_rates"
LATERAL_VELOCITY = "lateral_velocity"
OUTPUT_COUNT = {RESIDUAL: 2, LATERAL_VELOCITY: 1}
#: Limits of the outputs; of v_y in m/s.
_LIMITS_OF = {RESIDUAL: LIMITS, LATERAL_VELOCITY: (30.0,)}


#: Of the entries of model.json, which are checked.
_CHECKED = ConfigDict(extra="forbid", allow_inf_nan=False)


@checked_dataclass(frozen=True, config=_CHECKED)
class Normalisation:
    """x_normalised = (x − mean) / std per feature; target = output · target_std."""

    feature_mean: tuple[float, ...]
    feature_std: tuple[float, ...]
    target_std: tuple[float, ...]


@checked_dataclass(frozen=True, config=_CHECKED)
class NetworkDesign:
    """Everything but the weights that decides the outputs of a network.

    Attributes
    ----------
    feature_names : in order; a subset of :data:`~.features.FEATURES`.
    hidden, layers, head : architecture. period_s : step of the training data.
    target : predicted quantity, one of :data:`OUTPUT_COUNT`.
    model : the filter of its features and its residual, one of :data:`MODELS`.
    physics_sha256 : digest of the physics of the training car or cars.
    odd : half of the difference between outputs for the input and its mirror image is used, which is exactly odd.
    """

    feature_names: tuple[Annotated[str, one_of(FEATURES)], ...]
    hidden: int
    layers: int
    head: tuple[int, ...]
    period_s: float
    normalisation: Normalisation
    target: str = RESIDUAL
    model: Annotated[str, one_of(MODELS)] = PHYSICS_MODEL
    physics_sha256: str = ""
    odd: bool = False


@dataclass(frozen=True, eq=False)
class ModelBundle(NetworkDesign):
    """A trained network, which predicts step by step.

    Attributes
    ----------
    weights : by name, float32, as PyTorch names them.
    provenance : training data hash, seeds, metrics and other entries of the model card; JSON-able.
    pure_lstm, linear_regression, paper_network : the baselines beside it, None without.
    """

    weights: dict[str, np.ndarray[Any, np.dtype[np.float32]]] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)
    pure_lstm: "ModelBundle | None" = None
    linear_regression: LinearModel | None = None
    paper_network: "ModelBundle | None" = None

    @cached_property
    def sha256(self) -> str:
        """Hash of everything that decides the outputs."""
        total = hashlib.sha256(json.dumps(self._document(), sort_keys=True).encode())
        for name in sorted(self.weights):
            total.update(name.encode() + b"\0" + np.ascontiguousarray(self.weights[name]).tobytes())
        return total.hexdigest()

    @property
    def columns(self) -> list[int]:
        """Indices of the bundle's features in the full feature array."""
        return [FEATURES.index(name) for name in self.feature_names]

    @property
    def signs(self) -> FloatArray:
        """Signs of the bundle's features for an exchange of left and right, [k]."""
        return np.array([-1.0 if name in ODD_FEATURES else 1.0 for name in self.feature_names])

    @property
    def weight_shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the weights of the architecture, by name."""
        shapes: dict[str, tuple[int, ...]] = {}
        for layer in range(self.layers):
            rows, columns = 4 * self.hidden, self.hidden if layer else len(self.feature_names)
            shapes |= {f"lstm.weight_ih_l{layer}": (rows, columns), f"lstm.weight_hh_l{layer}": (rows, self.hidden)}
            shapes |= {f"lstm.bias_ih_l{layer}": (rows,), f"lstm.bias_hh_l{layer}": (rows,)}
        for n, (columns, rows) in enumerate(pairwise((self.hidden, *self.head, OUTPUT_COUNT[self.target]))):
            # A ReLU and a dropout follow each layer of the head except the last; they have numbers too.
            shapes |= {f"head.{3 * n}.weight": (rows, columns), f"head.{3 * n}.bias": (rows,)}
        return shapes

    def normalise(self, features: FloatArray) -> FloatArray:
        """Return the chosen features [N, k] of the full array [N, 15], normalised and limited to ±8."""
        n = self.normalisation
        scaled = (features[:, self.columns] - np.array(n.feature_mean)) / np.array(n.feature_std)
        limited: FloatArray = np.clip(scaled, -8.0, 8.0)
        return limited

    @cached_property
    def _network(self) -> "ForwardPass":
        from pdhef_logtool.residual_model.forward_pass import ForwardPass  # compiled code is imported on demand

        return ForwardPass.of(self.weights, self.layers, self.head)

    def run(
        self, features: FloatArray, starts: BoolArray, carry: "NetworkState | None"
    ) -> "tuple[FloatArray, NetworkState | None]":
        """Return residual rates [N, 2] in m/s² and rad/s² after each step, or v_y [N, 1] in m/s; and the state.

        The state is None at the start of a sequence (docs/method.md#network).

        Parameters
        ----------
        features : [N, 15] over :data:`~.features.FEATURES`; rows with NaN give 0 and end the sequence.
        starts : [N], True at the start of a sequence.
        """
        out = np.zeros((features.shape[0], OUTPUT_COUNT[self.target]))
        usable = np.asarray(np.isfinite(features).all(axis=1), dtype=np.bool_)
        breaks = np.logical_or(starts, ~usable).astype(np.bool_)
        breaks[1:] |= ~usable[:-1]
        edges = [0, *(np.flatnonzero(breaks[1:]) + 1).tolist(), features.shape[0]]
        for a, b in pairwise(edges):
            if a == b:
                continue
            if breaks[a]:
                carry = None
            if usable[a]:
                out[a:b], carry = self._sequence(self.normalise(features[a:b]), carry)
        limits = np.array(_LIMITS_OF[self.target])
        return np.clip(out * np.array(self.normalisation.target_std), -limits, limits), carry

    def residual(
        self, features: FloatArray, dt_s: FloatArray, state: "NetworkState | None"
    ) -> "tuple[Residual, NetworkState | None]":
        """Return the residual of consecutive steps (see :class:`~.interface.ResidualModel`)."""
        rate, after = self.run(features, np.isnan(dt_s), state)
        return Residual(rate, np.ones(len(rate))), after

    def lateral_velocity(
        self, features: FloatArray, dt_s: FloatArray, state: "NetworkState | None"
    ) -> "tuple[FloatArray, NetworkState | None]":
        """Return v_y [N] of such a network and the state after; ``dt_s`` [N] is NaN where a sequence starts."""
        output, after = self.run(features, np.isnan(dt_s), state)
        return output[:, 0], after

    def _sequence(self, scaled: FloatArray, carry: "NetworkState | None") -> "tuple[FloatArray, NetworkState]":
        """Run a sequence of normalised features [N, k] and, for an ``odd`` network, its mirror image."""
        # Features that change their sign have a mean of 0, so that normalised values change it too.
        mirror = scaled * self.signs if self.odd else np.zeros_like(scaled)
        both = np.stack([scaled, mirror], axis=1).astype(np.float32)
        said, after = self._network.run(both, carry)
        straight, mirrored = said[:, 0].astype(np.float64), said[:, 1]
        return 0.5 * (straight - mirrored) if self.odd else straight, after

    def _document(self) -> dict[str, Any]:
        return {
            **({} if self.target == RESIDUAL else {"target": self.target}),
            "format": FORMAT,
            "version": FORMAT_VERSION,
            **{name: getattr(self, name) for name in ("model", "physics_sha256", "odd")},
            "features": self.feature_names,
            "architecture": {name: getattr(self, name) for name in ("hidden", "layers", "head")},
            "period_s": self.period_s,
            "normalisation": asdict(self.normalisation),
        }

    def save(self, folder: Path) -> None:
        """Write the bundle; both files are complete before they are renamed, the document last.

        Raises
        ------
        OutputError
            The folder cannot be written.
        """
        from safetensors.numpy import save

        document = json.dumps({**self._document(), "sha256": self.sha256, "provenance": self.provenance}, indent=2)
        # The inner file is renamed first.
        with PendingFile(folder / DOCUMENT_FILE) as described, PendingFile(folder / WEIGHTS_FILE) as weights:
            for pending, data in ((described, (document + "\n").encode()), (weights, save(self.weights))):
                with writing(pending.target), open_new(pending.path) as file:
                    file.write(data)


def network_folder(network: Path | str) -> Path | None:
    """Return the folder of a network: of a shipped one by name, or the folder itself; None for ``none``."""
    return None if str(network) == NO_MODEL else SHIPPED_FOLDERS.get(str(network), Path(network))


def load_bundle(folder: Path) -> ModelBundle:
    """Read a residual network with the baselines beside it.

    Raises
    ------
    ModelError
        A file is missing or wrong, or the weights do not belong to the document.
    """
    lstm, regression, paper = folder / PURE_LSTM_FOLDER, folder / LINEAR_REGRESSION_FILE, folder / PAPER_FOLDER
    return replace(
        load_network(folder, RESIDUAL),
        pure_lstm=load_network(lstm, LATERAL_VELOCITY) if lstm.is_dir() else None,
        linear_regression=load_linear_model(regression) if regression.is_file() else None,
        paper_network=load_network(paper, RESIDUAL) if paper.is_dir() else None,
    )


def load_network(folder: Path, target: str) -> ModelBundle:
    """Read one network.

    Parameters
    ----------
    target : required target.

    Raises
    ------
    ModelError
        A file is missing or wrong, or the weights do not belong to the document.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    where = str(folder)
    expected = f"a model bundle ({DOCUMENT_FILE}, {WEIGHTS_FILE})"
    document = read_json(folder / DOCUMENT_FILE, expected, ModelError)
    try:
        weights = load((folder / WEIGHTS_FILE).read_bytes())
    except (OSError, ValueError, LookupError, TypeError, SafetensorError) as error:
        raise ModelError(expected=expected, got=str(error), where=where) from None
    if document.get("format") != FORMAT or document.get("version") != FORMAT_VERSION:
        got = f"{document.get('format')} {document.get('version')}"
        raise ModelError(
            expected=f"{FORMAT} {FORMAT_VERSION}, which names the physics that a network completes",
            got=got,
            where=where,
            remedy=f"pdhef extract LOG... -o DATASET and pdhef train DATASET -o {folder.name} create it again",
        )
    if (learnt := document.get("target", RESIDUAL)) != target:
        raise ModelError(expected=f"a network for {target}", got=f"one for {learnt}", where=where)
    architecture = document.get("architecture")
    stated = {**document, **(architecture if isinstance(architecture, dict) else {})}
    stated = {"feature_names": document.get("features"), **stated}
    entries = {f.name: stated[f.name] for f in fields(NetworkDesign) if f.name in stated}
    design = validated(NetworkDesign, entries, where, ModelError, expected="the entries of model.json")
    bundle = ModelBundle(**vars(design), weights=weights, provenance=document.get("provenance", {}))
    shapes = {name: w.shape for name, w in weights.items()}
    if shapes != bundle.weight_shapes or any(w.dtype != np.float32 for w in weights.values()):
        raise ModelError(expected="float32 weights of the architecture of model.json", got=f"{shapes}", where=where)
    sizes, inputs = [len(values) for values in vars(bundle.normalisation).values()], len(bundle.feature_names)
    if sizes != [inputs, inputs, OUTPUT_COUNT[target]]:
        raise ModelError(expected="a normalisation of all features and targets", got=f"{sizes} values", where=where)
    if document.get("sha256") != bundle.sha256:
        raise ModelError(expected="weights that belong to model.json", got="another hash", where=where)
    return bundle
