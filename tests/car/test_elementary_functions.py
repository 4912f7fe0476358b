"""Arctangent and sine of inner loops against those of the C library."""

from __future__ import annotations

import math

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numba import njit

from pdhef_logtool.car.elementary_functions import arctangent, sine

pytestmark = pytest.mark.slow

random_numbers = settings(derandomize=True, deadline=None, max_examples=60)


@njit
def _arctangent(y: float, x: float) -> float:
    return arctangent(y, x)  # type: ignore[no-any-return]


@njit
def _sine(x: float) -> float:
    return sine(x)  # type: ignore[no-any-return]


@random_numbers
@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e3))
@example(math.tan(math.pi / 8.0), 1.0)
@example(-math.tan(3.0 * math.pi / 8.0), 1.0)
@example(0.0, 1.0)
@example(math.inf, 1.0)
@example(-1e-300, 1.0)
def test_arctangent(y: float, x: float) -> None:
    assert _arctangent(y, x) == pytest.approx(math.atan2(y, x), rel=2e-15, abs=0.0)


@random_numbers
@given(st.floats(-100.0, 100.0))
@example(math.pi)
@example(-0.5 * math.pi)
@example(1.5 * math.pi)
@example(1e4)
def test_sine(x: float) -> None:
    assert _sine(x) == pytest.approx(math.sin(x), rel=0.0, abs=4e-16)
    assert _sine(-x) == -_sine(x)


def test_nan_propagates() -> None:
    assert all(map(math.isnan, (_arctangent(math.nan, 1.0), _sine(math.nan), _sine(math.inf))))
