"""Quantiles of Student's t against SciPy."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import chdtri, ndtri, stdtrit

from pdhef_logtool.records.student import chi_square_quantile, student_quantile


@given(st.floats(0.6, 0.9999), st.integers(1, 3000))
def test_quantiles_are_those_of_scipy(share: float, freedom: int) -> None:
    assert student_quantile(share, freedom) == pytest.approx(stdtrit(freedom, share), rel=1e-9)
    assert student_quantile(share, math.inf) == pytest.approx(ndtri(share), rel=1e-12)


@pytest.mark.parametrize("freedom", [4, 7, 60, 298])
@pytest.mark.parametrize("share", [0.0005, 0.025, 0.5, 0.975])
def test_quantile_of_chi_square_equals_scipy(freedom: int, share: float) -> None:
    assert chi_square_quantile(share, freedom) == pytest.approx(chdtri(freedom, 1.0 - share), rel=1e-9)
