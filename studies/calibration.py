"""Calibration of cars without ground truth, and their 95 % confidence intervals: ``docs/calibration.md``.

python -m studies.calibration [--out docs]
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from pdhef_logtool.estimators.calibration.calibration import LARGEST_SHARE, VARIED
from pdhef_logtool.estimators.self_calibrated import D2_SHARE
from pdhef_logtool.runs.selection import FACTOR, SIMPLE
from studies import plus_minus, self_calibration
from studies.pages import DOCS, DRIVES, options, write
from studies.self_calibration import outcome_of, say, simulate

#: Seed and number of cars.
SELF_SEED, SELF_CARS = 77_002, 50

PAGE = """# Calibration and confidence intervals

This page shows the accuracy of calibrated cars and the coverage of their confidence intervals.
Command: `python -m studies.calibration`. Sideslip RMSE in degrees. Method: [method.md](method.md).

## Self-calibration on simulated cars with wrong vehicle files

{cars} saloons, SUVs and hatchbacks with random loads, heights, tyres and sensors (`studies.drawn_cars`), seed {seed}.
No setting was chosen on these cars; settings were chosen on 24 others. The stiffness in each vehicle file is wrong by a
factor of {low:g} to {high:g} at each axle. Each car is calibrated on the scored drive, without ground truth. Figures
are medians. The last column contains the median ratio and the 10 % and 90 % quantiles.

{simulated}

A calibration is refused if it leaves more than {largest} of the yaw rate or of the lateral acceleration, if the car
slides, or, if it is written to a car, if the driving does not excite both cornering stiffnesses.

## 95 % confidence intervals of self-calibrated cars

Intervals of `physics`, calibrated from the wrong and from the right file. The variance of sideslip is the sum of
[χ² (s² + 0.15²)](method.md#intervals), the effect of the {varied} strongest directions of the posterior, and
({share:g} d)², where d is the part of the v̇_y residual that correlates with v_y, v_x r and a_y. For normal errors, an
interval with 95 % coverage is 3.92 times as wide as the RMSE.

{bands}

The same without each part of the variance, and of recorded drives ([peers](peers.md)) with published files:

{parts}

## Lateral kinematic consistency and sideslip error

The v̇_y residual (column `d2`) needs no ground truth. The table compares each estimate with the estimate of the same
drive that has the lowest residual.

{d2}

Above {factor:g} times the lowest residual of {simple}, `pdhef run` warns that `pd-hef` contradicts the sensors. For a
car without validation data it selects the fallback estimate with the lowest residual, unless `--calibrate off` requests
causal estimates.

## Coverage of every ± that is printed

{plus_cars} simulated cars of all kinds, seed {plus_seed}, with wrong vehicle files (stiffness, inertia, roll gradient,
IMU position) on five manoeuvres; command: `python -m studies.plus_minus`. A row shows how many true values are within
1.96 standard deviations. Model errors were chosen on 74 other cars. The rotation of an IMU and the bank of a road have
no printed ±.

<!-- begin plus-minus -->
<!-- end plus-minus -->
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Simulate, calibrate, and write the page."""
    parser = options("calibration", __doc__)
    parser.add_argument("--out", type=Path, default=DOCS)
    out = parser.parse_args(arguments).out
    outcomes = []
    for simulated in simulate(SELF_CARS, SELF_SEED):
        outcomes.append(outcome_of(simulated))
        say(f"car {simulated.car}, {simulated.manoeuvre}: {outcomes[-1].calibrated['physics'][0]:.3f}")
    recorded = self_calibration.recorded_bands() if DRIVES.is_dir() else {}
    write(
        out / "calibration.md",
        PAGE.format(
            **settings(),
            simulated=self_calibration.simulated_table(outcomes),
            bands=self_calibration.band_table(outcomes),
            parts=self_calibration.parts_table(outcomes, recorded),
            d2=self_calibration.d2_table(outcomes),
        ),
    )
    plus_minus.fill_page(out / "calibration.md")
    return 0


def settings() -> dict[str, object]:
    """Return the figures in the text of the page that are constants."""
    return {
        "cars": SELF_CARS,
        "seed": SELF_SEED,
        "low": self_calibration.WRONG[0],
        "high": self_calibration.WRONG[1],
        "largest": f"{100 * LARGEST_SHARE:.0f} %",
        "varied": VARIED,
        "share": D2_SHARE,
        "factor": FACTOR,
        "simple": ", ".join(f"`{name}`" for name in SIMPLE),
        "plus_cars": plus_minus.CARS,
        "plus_seed": plus_minus.SEED,
    }


if __name__ == "__main__":
    sys.exit(main())
