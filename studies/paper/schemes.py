"""The schemes of the comparison: which there are, what each is called in the page, and which this version can run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pdhef_logtool.estimators.registry import runnable

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.residual_model.bundle import ModelBundle

#: All schemes that belong in the tables (METHOD §10), with one line each for the page.
SCHEMES: dict[str, str] = {
    "zero": "sideslip 0",
    "gyro": "sensors passed through, no lateral velocity",
    "kinematic": "leaky integral of a_y − v_x r",
    "open-loop": "nominal model without any feedback",
    "linear-regression": "linear in the features of the network",
    "phy-ukf": "the paper's baseline: nominal model, sensor-level R, Q by innovation likelihood",
    "phy-ukf-tuned": "the same, tuned for sideslip",
    "physics-plus": "lagged axle forces, load transfer, roll-corrected a_y",
    "pure-lstm": "network alone, same inputs",
    "pd-hef-paper": "the paper's filter and adaptation, to the letter",
    "pd-hef-trust0": "our hybrid filter with its network switched off",
    "pd-hef-fixed-r": "our hybrid filter, full trust, fixed R",
    "pd-hef": "our hybrid filter with its adaptive mechanism",
}


#: Our hybrid filter, and the paper's three in the order in which the time histories draw them.
HYBRID = "pd-hef"
DRAWN = ("phy-ukf", "pure-lstm", HYBRID)


@dataclass(frozen=True, slots=True)
class Scheme:
    """A scheme ready to run; ``uses_network`` where another network gives another result."""

    name: str
    estimator: Estimator
    uses_network: bool


def schemes_for(
    names: Sequence[str], vehicle: VehicleParameters, available: frozenset[str], bundle: ModelBundle
) -> tuple[list[Scheme], dict[str, str]]:
    """Return the schemes that can run, and why the others cannot."""
    ready: list[Scheme] = []
    missing: dict[str, str] = {}
    for name in names:
        estimators, skipped = runnable((name,), vehicle, available, model=bundle)
        if skipped:
            missing[name] = skipped[0].reason
            continue
        without, _ = runnable((name,), vehicle, available, model=None)
        ready.append(Scheme(name, estimators[0], uses_network=not without))
    return ready, missing
