"""The schemes of the comparison: which there are, what each is called in the page, and which this version can run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pdhef_logtool.estimators.registry import ALIASES, DESCRIPTIONS, runnable

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


#: The paper's three, drawn in this order in the time histories; the last has a stand-in where this version lacks it.
DRAWN = ("phy-ukf", "pure-lstm", "pd-hef")
STAND_IN = "pd-hef-fixed-r"


def hybrid_of(ran: Sequence[str]) -> str:
    """Return the name of our hybrid filter among those that ran."""
    return DRAWN[-1] if DRAWN[-1] in ran else STAND_IN


def drawn(ran: Sequence[str]) -> tuple[str, ...]:
    """Return the schemes of the time histories that ran."""
    return tuple(n for n in (*DRAWN[:-1], hybrid_of(ran)) if n in ran)


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
        if name in ALIASES:
            missing[name] = f"in this version the name stands for `{ALIASES[name]}`"
            continue
        if name not in DESCRIPTIONS:
            missing[name] = "this version has no such estimator"
            continue
        estimators, skipped = runnable((name,), vehicle, available, model=bundle)
        if skipped:
            missing[name] = skipped[0].reason
            continue
        without, _ = runnable((name,), vehicle, available, model=None)
        ready.append(Scheme(name, estimators[0], uses_network=not without))
    return ready, missing
