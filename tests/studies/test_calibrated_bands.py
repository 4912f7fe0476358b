"""The 95 % bands of simulated cars that calibrated themselves from wrong files."""

from __future__ import annotations

import numpy as np
import pytest

from studies import self_calibration as study


@pytest.mark.slow
def test_the_bands_of_calibrated_cars_hold_and_are_no_wider_than_they_must() -> None:
    """On cars that nothing was chosen on; the interval of normal errors is 3.92 times as wide as their rms."""
    bands = []
    for one in study.simulate(6, 1357, study.DRIVEN[:1]):
        wrong = one.file.with_stiffness(*one.factors)
        found = study.calibrate(one.drive.signals, wrong)
        assert not found.refused
        bands.append(study.bands_of(one.drive, study.taken(one.drive.signals, wrong, found)))
    coverage, width = np.array([b[study.ALL] for b in bands]).T
    assert np.mean(coverage) > 0.9
    assert np.min(coverage) > 0.7
    # s_car and the model error of real cars are included, which these hardly have: their errors are below 0.1°.
    assert np.median(width) < 16.0
    for band in bands:
        less = [width for name, (_, width) in band.items() if name != study.ALL]
        assert len(less) == 4
        assert max(less) <= band[study.ALL][1]
