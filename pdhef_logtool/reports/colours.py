"""Colours of a page: the colours of all other outputs, darkened for a white background."""

from __future__ import annotations

from pdhef_logtool.estimators.table import all_specs
from pdhef_logtool.results.palette import colour_rgb
from pdhef_logtool.results.sink import TRUTH

INK = "#1a1a1a"
#: Colours of faults, notes and normal events, distinguishable for the colour-blind.
FAULT, NOTE, PLAIN = "#b2182b", "#7a5195", "#6b7785"
#: Minimum contrast of lines on white according to WCAG 2.1.
_LEAST_CONTRAST = 3.0


def colour(name: str) -> str:
    """Return the colour ``#rrggbb`` of an estimator or of the ground truth, which is the same on every page."""
    if name == TRUTH:
        return INK
    rgb = colour_rgb(name, {s.name: s.colour for s in all_specs()})
    while contrast(rgb) < _LEAST_CONTRAST:
        rgb = (rgb[0] * 15 // 16, rgb[1] * 15 // 16, rgb[2] * 15 // 16)
    return "#{:02x}{:02x}{:02x}".format(*rgb)


def contrast(rgb: tuple[int, int, int]) -> float:
    """Return the contrast to white by WCAG 2.1, 1 to 21."""
    red, green, blue = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in (v / 255 for v in rgb))
    return 1.05 / (0.2126 * red + 0.7152 * green + 0.0722 * blue + 0.05)
