"""The schemes of the comparison: descriptions for the page, and the selection for the figures."""

from __future__ import annotations

#: All schemes that belong in the tables (docs/method.md#evaluation), with one line each for the page.
SCHEMES: dict[str, str] = {
    "zero": "sideslip 0",
    "zero:no-lateral": "sensors passed through, no lateral velocity",
    "kinematic": "leaky integral of a_y − v_x r",
    "open-loop": "nominal model without any feedback",
    "linear-regression": "linear in the features of the network",
    "phy-ukf": "the paper's baseline: nominal model, sensor-level R, Q by innovation likelihood",
    "phy-ukf:tuned": "the same, tuned for sideslip",
    "physics": "all parts that five other minutes of driving gave evidence for",
    "pure-lstm": "network alone, same inputs",
    "pd-hef-paper": "the paper's filter and adaptation, to the letter",
    "pd-hef:fixed-r": "our hybrid filter, gain 1, fixed R",
    "pd-hef": "our hybrid filter with its adaptive mechanism",
}

#: Our hybrid filter, and the paper's three in the order in which the time histories draw them.
HYBRID = "pd-hef"
DRAWN = ("phy-ukf", "pure-lstm", HYBRID)
