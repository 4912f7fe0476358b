"""Quantiles of Student's t against SciPy."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtri, stdtrit

from pdhef_logtool.records.student import student_quantile


@given(st.floats(0.6, 0.9999), st.integers(1, 3000))
def test_quantiles_are_those_of_scipy(share: float, freedom: int) -> None:
    assert student_quantile(share, freedom) == pytest.approx(stdtrit(freedom, share), rel=1e-9)
    assert student_quantile(share, math.inf) == pytest.approx(ndtri(share), rel=1e-12)
