"""Evaluate the decisions of ``pdhef compare``: false alarms and detected changes.

    python -m studies.comparing [--times 5000] [--planted 2000] [--out docs]

``--times``: relabellings without a change. ``--planted``: runs with a change. The paired log ratios of drives are drawn
from a normal and a heavy-tailed distribution (Student's t with 3 degrees of freedom, scaled to the same standard
deviation), 0.2 wide. Without a change, relabelling flips the sign of each ratio at random.
"""

import math
from collections.abc import Callable

import numpy as np

from pdhef_logtool.evaluation.statistics import paired_change
from pdhef_logtool.records.signals import FloatArray
from studies.pages import blocks, options, update

LIMIT, PLANTED, SPREAD = 0.05, 0.10, 0.2
COUNTS = (5, 10, 30, 100)
#: Drives that depend on one another, and the share of the variance of their log ratios that lies between days.
DAYS, DRIVES_A_DAY, SHARED = 6, 10, (0.0, 0.1, 0.2, 0.4, 0.8)
_TAIL_DEGREES = 3.0

#: ``draw(rng, shape)`` of log ratios.
Draw = Callable[[np.random.Generator, tuple[int, int]], FloatArray]


def normal(rng: np.random.Generator, shape: tuple[int, int]) -> FloatArray:
    """Return log ratios [times, drives] of a normal distribution."""
    return rng.normal(0.0, SPREAD, shape)


def heavy_tailed(rng: np.random.Generator, shape: tuple[int, int]) -> FloatArray:
    """Return log ratios [times, drives] with some drives that go wild."""
    scale = SPREAD / math.sqrt(_TAIL_DEGREES / (_TAIL_DEGREES - 2.0))
    return np.asarray(scale * rng.standard_t(_TAIL_DEGREES, shape))


def share_closed(draw: Draw, drives: int, times: int, planted: float, seed: int) -> float:
    """Return how often the gate closes, of drives that are all worse by ``planted`` beside their spread."""
    rng = np.random.default_rng(seed)
    signs = rng.choice((-1.0, 1.0), (times, drives))
    ratios = signs * draw(rng, (times, drives)) + math.log1p(planted)
    return float(np.mean([paired_change(drive_ratios).verdict(LIMIT) == "worse" for drive_ratios in ratios]))


def share_of_means(draw: Draw, drives: int, times: int, seed: int) -> float:
    """Return how often a ratio of mean RMSE above the limit, the naive gate, closes on a relabelling."""
    rng = np.random.default_rng(seed)
    level = np.exp(rng.normal(0.0, 0.5, (times, drives)))
    other = level * np.exp(rng.choice((-1.0, 1.0), level.shape) * draw(rng, (times, drives)))
    return float(np.mean(other.mean(axis=1) / level.mean(axis=1) > 1.0 + LIMIT))


def ratios_of_days(
    rng: np.random.Generator, days: int, drives: int, shared: float
) -> tuple[FloatArray, dict[str, list[int]]]:
    """Return log ratios without a change, with this share of their variance between days, and the day of each."""
    day = np.repeat(np.arange(days), drives)
    own, common = rng.normal(size=len(day)), rng.normal(size=days)[day]
    return SPREAD * (math.sqrt(1.0 - shared) * own + math.sqrt(shared) * common), {"day": day.tolist()}


def shares_of_days(shared: float, times: int, seed: int, drives: int = DRIVES_A_DAY) -> tuple[float, float]:
    """Return how often equal runs of :data:`DAYS` days are called worse: with independent drives, and by default."""
    rng = np.random.default_rng(seed)
    alone = together = 0
    for _ in range(times):
        ratios, factors = ratios_of_days(rng, DAYS, drives, shared)
        alone += paired_change(ratios).verdict() == "worse"
        together += paired_change(ratios, None, factors).verdict() == "worse"
    return alone / times, together / times


def tables(times: int, planted: int) -> dict[str, str]:
    """Return the tables by name."""
    draws, gate = (normal, heavy_tailed), {}
    for count in COUNTS:
        alarms = [share_closed(draw, count, times, 0.0, 1) for draw in draws]
        hits = [share_closed(draw, count, planted, PLANTED, 2) for draw in draws]
        gate[count] = (*alarms, share_of_means(normal, count, times, 3)), hits
    return blocks(__file__, gate=gate, days={shared: shares_of_days(shared, times, 4) for shared in SHARED})


def main() -> None:
    """Write the tables into docs/calibration.md."""
    given = options("comparing", __doc__, "out", times=5000, planted=2000).parse_args()
    update(given.out, "calibration.md", tables(given.times, given.planted))


if __name__ == "__main__":
    main()
