"""Quantiles of chi-square against SciPy."""

from __future__ import annotations

import pytest
from scipy.special import chdtri

from pdhef_logtool.evaluation.chi_square import chi_square_quantile


@pytest.mark.parametrize("freedom", [4, 7, 60, 298])
@pytest.mark.parametrize("share", [0.0005, 0.025, 0.5, 0.975])
def test_quantile_of_chi_square_equals_scipy(freedom: int, share: float) -> None:
    assert chi_square_quantile(share, freedom) == pytest.approx(chdtri(freedom, 1.0 - share), rel=1e-9)
