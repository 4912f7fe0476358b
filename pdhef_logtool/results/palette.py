"""One colour a track, the same in every plot."""

from __future__ import annotations

import zlib
from collections.abc import Mapping

_TRUTH = 0x8A8A8A
#: The sideslip reference.
REFERENCE_COLOUR = 0x999933
#: For other names, such as recorded estimates: Okabe and Ito (2008) without black and yellow.
_OTHERS = (0xD55E00, 0x0072B2, 0xE69F00, 0x009E73, 0xCC79A7, 0x56B4E9)


def colour_rgb(name: str, colours: Mapping[str, int]) -> tuple[int, int, int]:
    """Return red, green, blue (0 to 255) of a track; ``colours`` are 0xRRGGBB by estimator.

    A name that is not there always gets the same colour of the palette.
    """
    packed = {"truth": _TRUTH, **colours}.get(name, _OTHERS[zlib.crc32(name.encode()) % len(_OTHERS)])
    return packed >> 16, packed >> 8 & 0xFF, packed & 0xFF
