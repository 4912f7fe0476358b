"""One colour an estimator, the same in every plot, tellable apart with any colour vision."""

from __future__ import annotations

import zlib

#: Okabe and Ito (2008) without black, then Tol's muted scheme; seen on light and dark ground.
_OKABE_ITO = {
    "pd-hef": 0xD55E00,
    "phy-ukf": 0x0072B2,
    "open-loop": 0xE69F00,
    "kinematic": 0x009E73,
    "gyro": 0xCC79A7,
    "phy-ukf-tuned": 0x56B4E9,
    "zero": 0xF0E442,
}
_TOL_MUTED = {
    "linear-regression": 0xDDCC77,
    "physics-plus": 0x44AA99,
    "pure-lstm": 0xAA4499,
    "pd-hef-paper": 0xCC6677,
    "pd-hef-trust0": 0x999933,
    "pd-hef-trust1": 0x882255,
    "pd-hef-fixed-r": 0x117733,
    "pd-hef-smoothed": 0x332288,
}
_FIXED = {"truth": 0x8A8A8A, **_OKABE_ITO, **_TOL_MUTED}


def colour_rgb(name: str) -> tuple[int, int, int]:
    """Return red, green, blue (0 to 255) of a track; an unknown name always gets the same colour of the palette."""
    others = [*_OKABE_ITO.values(), *_TOL_MUTED.values()]
    packed = _FIXED.get(name, others[zlib.crc32(name.encode()) % len(others)])
    return packed >> 16, packed >> 8 & 0xFF, packed & 0xFF
