"""Sideslip by linear regression on the network's features with a causal low pass, in a JSON file.

β = low-pass(intercept + Σ coefficient · feature), first order, at ``low_pass_hz``. Both are linear, so that the fit
uses low-passed features; its coefficients partly compensate the delay of the low pass.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.records.errors import ModelError
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.residual_model.features import FEATURES
from pdhef_logtool.storage.documents import digest, read_json

FORMAT = "pdhef.linear-regression"
FORMAT_VERSION = 1
TARGET = "sideslip"


@dataclass(frozen=True, slots=True)
class LinearModel:
    """Coefficients of the file's equation.

    Attributes
    ----------
    feature_names : a subset of :data:`~.features.FEATURES`. coefficients : rad per unit of each feature, [k].
    intercept_rad : sideslip at features of zero. low_pass_hz : corner of the low-pass.
    provenance : training data hash, errors and other entries of the model card; JSON-able.
    """

    feature_names: tuple[str, ...]
    coefficients: tuple[float, ...]
    intercept_rad: float
    low_pass_hz: float
    provenance: dict[str, Any] = field(default_factory=dict, compare=False)

    @property
    def sha256(self) -> str:
        """Hash of everything that decides the outputs."""
        return digest(self._document())

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
        return {
            "format": FORMAT,
            "version": FORMAT_VERSION,
            "target": TARGET,
            "features": list(self.feature_names),
            "coefficients": [float(c) for c in self.coefficients],
            "intercept_rad": float(self.intercept_rad),
            "low_pass_hz": float(self.low_pass_hz),
        }

    def to_json(self) -> str:
        """Return the file's text."""
        document = {**self._document(), "sha256": self.sha256, "provenance": self.provenance}
        return json.dumps(document, indent=2) + "\n"


def load_linear_model(path: Path) -> LinearModel:
    """Read the file.

    Raises
    ------
    ModelError
        The file is missing or wrong, or its coefficients do not belong to its hash.
    """
    where = str(path)
    remedy = "remove the file, or take a complete network"
    document = read_json(path, "the coefficients of a linear regression", ModelError, remedy)
    kind = tuple(document.get(key) for key in ("format", "version", "target"))
    if kind != (FORMAT, FORMAT_VERSION, TARGET):
        wanted = f"{FORMAT} {FORMAT_VERSION} of {TARGET}"
        raise ModelError(expected=wanted, got=f"{kind[0]} {kind[1]} of {kind[2]}", where=where, remedy=remedy)
    try:
        model = LinearModel(
            feature_names=tuple(str(name) for name in document["features"]),
            coefficients=tuple(float(c) for c in document["coefficients"]),
            intercept_rad=float(document["intercept_rad"]),
            low_pass_hz=float(document["low_pass_hz"]),
            provenance=document.get("provenance", {}),
        )
    except (LookupError, TypeError, ValueError, OverflowError) as error:
        raise ModelError(expected="the entries of a linear regression", got=f"{error!r}", where=where) from None
    unknown = [f for f in model.feature_names if f not in FEATURES]
    if unknown:
        raise ModelError(expected=f"features out of {', '.join(FEATURES)}", got=", ".join(unknown), where=where)
    if len(model.coefficients) != len(model.feature_names) or document.get("sha256") != model.sha256:
        raise ModelError(expected="coefficients that belong to the file's hash", got="another hash", where=where)
    return model
