"""The schemes of the comparison: descriptions for the page, and the selection for the figures."""

from __future__ import annotations

#: End of the names of schemes without wheel speed, the paper's sensor set.
ESP = ", esp"

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
    **{f"{name}{ESP}": "the same with `sensors=esp`" for name in ("phy-ukf", "physics", "pd-hef-paper", "pd-hef")},
}

#: Our hybrid filter, the paper's, and the paper's three in the order in which the time histories draw them.
HYBRID, PAPER = "pd-hef", "pd-hef-paper"
DRAWN = ("phy-ukf", "pure-lstm", HYBRID)
#: Scheme and baseline of the improvements.
PAIRS = (
    *((HYBRID, b) for b in ("phy-ukf", "physics", PAPER, "phy-ukf:tuned", "linear-regression", "pure-lstm")),
    (PAPER, "phy-ukf"),
    (f"{HYBRID}{ESP}", f"phy-ukf{ESP}"),
    (f"{PAPER}{ESP}", f"phy-ukf{ESP}"),
)
