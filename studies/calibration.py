"""Calibration of cars with and without ground truth, and their 95 % confidence intervals: ``docs/calibration.md``.

python -m studies.calibration [--out docs]
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from pdhef_logtool.estimators.calibration.calibration import LARGEST_SHARE, VARIED
from pdhef_logtool.estimators.posterior_band import OWN_SHARE as IDENTIFIED_SHARE
from pdhef_logtool.estimators.self_calibrated import D2_SHARE
from pdhef_logtool.runs.selection import FACTOR, SIMPLE
from studies import identified_bands, plus_minus, self_calibration
from studies.pages import DOCS, DRIVES, options, write
from studies.self_calibration import outcome_of, say, simulate

#: Seeds and numbers of cars of the two parts.
SELF_SEED, SELF_CARS, IDENTIFIED_SEED, IDENTIFIED_CARS = 77_002, 50, 88_003, 12

PAGE = """# Calibration and confidence intervals

This page shows the accuracy of calibrated and identified cars and the coverage of their confidence intervals.
Command: `python -m studies.calibration`. Sideslip RMSE in degrees. Method: [method.md](method.md).

## Self-calibration on simulated cars with wrong vehicle files

{cars} saloons, SUVs and hatchbacks with random loads, heights, tyres and sensors (`studies.many_cars`), seed {seed}. No
setting was chosen on these cars; settings were chosen on 24 others. The stiffness in each vehicle file is wrong by a
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

## Lateral kinematic consistency and sideslip error

The v̇_y residual (column `d2`) needs no ground truth. The table compares each estimate with the estimate of the same
drive that has the lowest residual.

{d2}

Above {factor:g} times the lowest residual of {simple}, `pdhef run` warns that `pd-hef` contradicts the sensors. For a
car without validation data it selects the fallback estimate with the lowest residual, unless `--calibrate off` requests
causal estimates.

## Published vehicle files of real cars

Ground truth is used for these figures only; v̇_y residual in brackets. These drives were scored {looked} times with a
self-calibrated car. The speed of the 250 LM, the GTI and the V40 comes from the ground truth or nearly so.

{published}

{said}

## 95 % confidence intervals of identified cars

{identified_cars} simulated cars, seed {identified_seed}; vehicle files with a stiffness error of up to a factor 1.4 at
each axle. `physics` of each car is identified on one drive with ground truth, a wide sine sweep or a road of 120 s, and
evaluated on other drives of the car. The variance of sideslip is the sum of ({identified_own:g} s)² and the effect of
the {varied} strongest directions of the posterior. The factors were chosen on 8 other cars.

{identified}

The identification assumes an error of at least 0.05° (`FLOOR_RAD`). On driving like that of the identification, where a
simulated car has lower errors, the intervals are therefore too wide.

## Coverage of every ± that is printed

{plus_cars} simulated cars of all kinds, seed {plus_seed}, with wrong vehicle files (stiffness, inertia, roll gradient,
IMU position) on five manoeuvres; command: `python -m studies.plus_minus`. A row shows how many true values are within
1.96 standard deviations. Model errors were chosen on 44 other cars. The rotation of an IMU and the bank of a road have
no printed ±.

<!-- begin plus-minus -->
<!-- end plus-minus -->
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Simulate, calibrate, identify, and write the page."""
    parser = options("calibration", __doc__)
    parser.add_argument("--out", type=Path, default=DOCS)
    out = parser.parse_args(arguments).out
    outcomes = []
    for simulated in simulate(SELF_CARS, SELF_SEED):
        outcomes.append(outcome_of(simulated))
        say(f"car {simulated.car}, {simulated.manoeuvre}: {outcomes[-1].calibrated['physics'][0]:.3f}")
    published, said = "Not done: needs ../shared beside the repository.", list[str]()
    if DRIVES.is_dir():
        published, said = self_calibration.published_table()
    judged = identified_bands.judge(IDENTIFIED_CARS, IDENTIFIED_SEED)
    write(
        out / "calibration.md",
        PAGE.format(
            **settings(),
            simulated=self_calibration.simulated_table(outcomes),
            bands=self_calibration.band_table(outcomes),
            d2=self_calibration.d2_table(outcomes),
            published=published,
            said="\n".join(said),
            identified=identified_bands.bands_table(judged),
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
        "looked": self_calibration.LOOKED_AT,
        "plus_cars": plus_minus.CARS,
        "plus_seed": plus_minus.SEED,
        "identified_cars": IDENTIFIED_CARS,
        "identified_seed": IDENTIFIED_SEED,
        "identified_own": IDENTIFIED_SHARE,
    }


if __name__ == "__main__":
    sys.exit(main())
