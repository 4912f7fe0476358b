"""The schemes of the comparison, the selection for the figures, and published values."""

from pathlib import Path

from studies.pages import read_toml

#: Published values, and the names of schemes, documented in their files.
PUBLISHED, _NAMES = (read_toml(Path(__file__).with_name(f"{name}.toml")) for name in ("published", "schemes"))

#: End of the names of schemes without wheel speed, the paper's sensor set.
ESP = ", esp"
#: Our hybrid filter, and the paper's.
HYBRID, PAPER = "pd-hef", "pd-hef-paper"

#: All schemes that belong in the tables, and those of the time histories.
SCHEMES, DRAWN = tuple[str, ...](_NAMES["all"]), tuple[str, ...](_NAMES["drawn"])
#: Scheme and baseline of the improvements.
PAIRS = [(scheme, baseline) for scheme, baseline in _NAMES["pairs"]]
