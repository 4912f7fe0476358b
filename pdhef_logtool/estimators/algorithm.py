"""The identity of an estimator: the algorithm of its class, and the differences of this instance from the default.

An estimator class has two class attributes: ``algorithm``, a permanent name, and ``version``, an integer that is
incremented whenever the class returns other estimates for the same inputs. A third attribute, ``options``, names the
fields that select a variant of the algorithm. An option is part of the identity only if it differs from the default of
its field, so that a new option with a default changes no identity. An option that is itself an algorithm is included
with its name and options.
"""

import dataclasses
from typing import Any

from pdhef_logtool.car.parts import Algorithm, physics_sha256
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.records.errors import UsageError

_NOISE = ("q_std", "r_std")
_NETWORKS = ("network", "model")


def resolve(estimator: Estimator) -> Algorithm:
    """Return the identity of an estimator, with its noise and the digests of the physics and network that it uses.

    Raises
    ------
    UsageError
        Its class does not declare algorithm and version.
    """
    kind = type(estimator).__name__
    name, version = getattr(estimator, "algorithm", None), getattr(estimator, "version", None)
    if not (isinstance(name, str) and isinstance(version, int)):
        raise UsageError(
            expected="an estimator class with the attributes algorithm (a name) and version (an integer)",
            got=f"algorithm {name!r}, version {version!r}",
            where=kind,
            remedy=f'write algorithm = "my-algorithm" and version = 1 in class {kind}',
        )
    facts: dict[str, Any] = {"options": {}, "noise": {}}
    _describe(estimator, "", facts)
    return Algorithm(algorithm=name, version=version, **facts)


def _describe(part: Any, prefix: str, facts: dict[str, Any]) -> None:
    """Add the options, noise and digests of an algorithm and of its nested algorithms."""
    for name in _NOISE:
        if hasattr(part, name):
            facts["noise"][prefix + name] = _plain(getattr(part, name))
    if (vehicle := getattr(part, "vehicle", None)) is not None:
        facts["physics_sha256"] = physics_sha256(vehicle)
    for name in _NETWORKS:
        if (network := getattr(part, name, None)) is not None:
            facts["network_sha256"] = network.sha256
    if hasattr(part, "use_speed"):
        facts["use_speed"] = part.use_speed
    defaults = {f.name: f.default for f in dataclasses.fields(part)} if dataclasses.is_dataclass(part) else {}
    for name in getattr(part, "options", ()):
        value, key = getattr(part, name), prefix + name
        if hasattr(value, "algorithm"):
            facts["options"][key] = value.algorithm
            if value.version != 1:
                facts["options"][f"{key}.version"] = value.version
            _describe(value, f"{key}.", facts)
        elif name not in defaults or value != defaults[name]:
            facts["options"][key] = _plain(value)


def _plain(value: Any) -> Any:
    return [_plain(v) for v in value] if isinstance(value, tuple) else value
