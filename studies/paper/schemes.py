"""The schemes of the comparison, the selection for the figures, and published values."""

from pathlib import Path

from studies.pages import read_toml

#: Published values, documented in their file.
PUBLISHED = read_toml(Path(__file__).with_name("published.toml"))

#: End of the names of schemes without wheel speed, the paper's sensor set.
ESP = ", esp"

#: All schemes that belong in the tables (docs/method.md#evaluation).
SCHEMES = (
    "zero", "zero:no-lateral", "kinematic", "open-loop", "linear-regression", "phy-ukf", "phy-ukf:tuned", "physics",
    "pure-lstm", "pd-hef-paper", "pd-hef:fixed-r", "pd-hef",
    *(f"{name}{ESP}" for name in ("phy-ukf", "physics", "pd-hef-paper", "pd-hef")),
)  # fmt: skip

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
