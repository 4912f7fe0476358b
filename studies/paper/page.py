"""``docs/paper.md`` from ``results.json`` and ``published.toml``; its sentences and tables are in ``page.md``."""

import math
from collections.abc import Mapping
from typing import Any

from studies.pages import template
from studies.paper.schemes import HYBRID, PAPER, PUBLISHED, SCHEMES
from truthsim.sensors import SensorNoise

Document = Mapping[str, Any]


def number(value: float | None) -> str:
    """Three significant digits with a minus sign, never in powers of ten."""
    if value is None or not math.isfinite(value):
        return "unknown"
    digits = max(0, 2 - math.floor(math.log10(abs(value)))) if value else 0
    return f"{value:.{digits}f}".replace("-", "−")


def percent(share: float) -> str:
    """A share as a whole number of percent, one decimal below 10 %."""
    return f"{100.0 * share:.{0 if abs(share) >= 0.1 else 1}f} %".replace("-", "−")


def write_page(d: Document, constants: Document) -> str:
    """Return the page: the gain, the scenarios, the sideslip errors, the constants, and the figures."""
    grid = {name: [r["value"] for r in constants["rows"] if r["constant"] == name] for name in constants["chosen"]}
    speed_m_s, duration_s = d["scenarios"][0]["speed_km_h"] / 3.6, d["drives"][0]["duration_s"]
    return template(
        __file__,
        d=d,
        constants=constants,
        edges=sum(value in (grid[name][0], grid[name][-1]) for name, value in constants["chosen"].items()),
        seeds=sorted({run["noise_seed"] for run in d["runs"]}),
        gyro_drift_m=0.5 * speed_m_s * SensorNoise().yaw_rate_bias_rad_s * duration_s**2,
        number=number,
        percent=percent,
        published=PUBLISHED,
        names={"hybrid": HYBRID, "paper": PAPER, "all": SCHEMES},
    )
