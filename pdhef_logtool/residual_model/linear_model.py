"""Sideslip by linear regression on the network's features with a causal low pass, in a JSON file.

β = low-pass(intercept + Σ coefficient · feature), first order, at ``low_pass_hz``. Both are linear, so that the fit
uses low-passed features; its coefficients partly compensate the delay of the low pass.
"""

import json
from dataclasses import asdict, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from pdhef_logtool.records.errors import ModelError
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.residual_model.features import FEATURES
from pdhef_logtool.storage.documents import digest, one_of, read_json, validated

FORMAT = "pdhef.linear-regression"
FORMAT_VERSION = 1
TARGET = "sideslip"


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid", allow_inf_nan=False))
class LinearModel:
    """Coefficients of the file's equation.

    Attributes
    ----------
    feature_names : a subset of :data:`~.features.FEATURES`. coefficients : rad per unit of each feature, [k].
    intercept_rad : sideslip at features of zero. low_pass_hz : corner of the low-pass.
    provenance : training data hash, errors and other entries of the model card; JSON-able.
    """

    feature_names: tuple[Annotated[str, one_of(FEATURES)], ...]
    coefficients: tuple[float, ...]
    intercept_rad: float
    low_pass_hz: float
    provenance: dict[str, Any] = field(default_factory=dict, compare=False)

    @property
    def sha256(self) -> str:
        """Hash of everything that decides the outputs."""
        return digest({k: v for k, v in self._document().items() if k != "provenance"})

    def sideslip_rad(self, features: FloatArray) -> FloatArray:
        """Return the sideslip before the low-pass, [N], of the full feature array."""
        columns = [FEATURES.index(name) for name in self.feature_names]
        weighted = features[:, columns] * np.array(self.coefficients)
        # numpy's sum of a row may depend on the number of rows; windows must not change the result
        total = np.full(features.shape[0], self.intercept_rad)
        for i in range(weighted.shape[1]):
            total += weighted[:, i]
        return total

    def lateral_velocity(
        self, features: FloatArray, dt_s: FloatArray, state: FloatArray | None
    ) -> tuple[FloatArray, FloatArray]:
        """Return v_y [N] and the state after; ``dt_s`` [N] is NaN where a sequence starts."""
        from pdhef_logtool.residual_model.low_pass import low_pass  # compiled

        memory = np.zeros(1) if state is None else state.copy()
        beta = self.sideslip_rad(features)[:, None]
        low_pass(beta, dt_s, self.low_pass_hz, memory, beta)
        # Sideslip is the direction of the velocity: beyond 80 degrees the linear model is out of its range.
        return features[:, 0] * np.tan(np.clip(beta[:, 0], -1.4, 1.4)), memory

    def _document(self) -> dict[str, Any]:
        entries = asdict(self)
        kind = {"format": FORMAT, "version": FORMAT_VERSION, "target": TARGET}
        return {**kind, "features": entries.pop("feature_names"), **entries}

    def to_json(self) -> str:
        """Return the file's text."""
        return json.dumps({**self._document(), "sha256": self.sha256}, indent=2) + "\n"


def load_linear_model(path: Path) -> LinearModel:
    """Read the file.

    Raises
    ------
    ModelError
        The file is missing or wrong, or its coefficients do not belong to its hash.
    """
    remedy = "remove the file, or take a complete network"
    document = read_json(path, "the coefficients of a linear regression", ModelError, remedy)
    kind = tuple(document.pop(key, None) for key in ("format", "version", "target"))
    if kind != (FORMAT, FORMAT_VERSION, TARGET):
        wanted = f"{FORMAT} {FORMAT_VERSION} of {TARGET}"
        raise ModelError(expected=wanted, got=f"{kind[0]} {kind[1]} of {kind[2]}", where=path, remedy=remedy)
    sha256, names = document.pop("sha256", None), document.pop("features", None)
    entries, expected = {"feature_names": names, **document}, "the entries of a linear regression"
    model = validated(LinearModel, entries, path, ModelError, expected=expected)
    if len(model.coefficients) != len(model.feature_names) or sha256 != model.sha256:
        raise ModelError(expected="coefficients that belong to the file's hash", got="another hash", where=path)
    return model
