"""What an estimator really is, read from the object that runs: nothing that it was asked to be can differ from it."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

from pdhef_logtool.car.parts import Algorithm, physics_sha256
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.residual_model.linear_model import LinearModel
from pdhef_logtool.residual_model.service import NetworkService

#: Fields of an estimator that are no option: what it is called and told of it, what its signals come back from, and
#: what it shares with others.
_TOLD = {"name", "causal", "notes", "read_with", "calibration", "reason"}
_NOISE = {"q_std", "r_std"}


def resolve(estimator: Estimator) -> Algorithm:
    """Return the algorithm, options, noise and digests of an estimator; parts that are records are looked into."""
    found: dict[str, Any] = {"options": {}, "noise": {}}
    _gather(estimator, "", found)
    return Algorithm(algorithm=_kind(estimator), **found)


def _gather(part: Any, prefix: str, found: dict[str, Any]) -> None:
    for entry in dataclasses.fields(part):
        value, name = getattr(part, entry.name), prefix + entry.name
        if entry.name in _TOLD:
            continue
        if isinstance(value, VehicleParameters):
            found["physics_sha256"] = physics_sha256(value)
        elif isinstance(value, NetworkService | LinearModel):
            found["network_sha256"] = value.bundle.sha256 if isinstance(value, NetworkService) else value.sha256
        elif entry.name == "use_speed":
            found["use_speed"] = value
        elif dataclasses.is_dataclass(value) and not isinstance(value, type):
            found["options"][name] = _kind(value)
            _gather(value, f"{name}.", found)
        else:
            found["noise" if entry.name in _NOISE else "options"][name] = (
                list(value) if isinstance(value, tuple) else value
            )


def _kind(part: Any) -> str:
    """Return the name of an algorithm: that of its class, in lower case with hyphens."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "-", type(part).__name__).lower()
