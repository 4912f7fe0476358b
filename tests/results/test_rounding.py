from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from written import as_written

from pdhef_logtool.results.sink import BITS_OUT, STEPS, rounded

_COLUMNS = ("x_m", "yaw_rad", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad", "ay_m_s2", "nis", "covariance", "friction")


@settings(derandomize=True, deadline=None)
@given(st.sampled_from(_COLUMNS), hnp.arrays(np.float64, 8, elements=st.floats(-1e6, 1e6)))
def test_no_number_moves_further_than_is_said_and_none_moves_twice(column: str, values: np.ndarray) -> None:
    # Numbers below the smallest normal number of single precision have fewer bits; they are not tested here.
    values = np.where(np.abs(values) < np.finfo(np.float32).tiny, 0.0, values)
    once = rounded(column, values)
    step, share = (STEPS[column] / 2.0, 0.0) if column in STEPS else (0.0, 2.0 ** (BITS_OUT - 24))
    assert (np.abs(once - values) <= step + share * np.abs(values) * (1 + 1e-3) + 1e-37).all()
    np.testing.assert_array_equal(rounded(column, once), once)
    np.testing.assert_array_equal(once, as_written(values, column))
    assert not np.signbit(once[once == 0.0]).any() or column in ("nis", "covariance", "friction")


@pytest.mark.parametrize("column", _COLUMNS)
def test_what_is_no_number_stays_as_it_is(column: str) -> None:
    odd = np.array([0x7FFFFFFFFFFFFFFF, 0xFFF8000000000000, 0x7FF0000000000001], dtype=np.uint64).view(np.float64)
    assert np.isnan(rounded(column, odd)).all()
    infinite = np.array([np.inf, -np.inf])
    np.testing.assert_array_equal(rounded(column, infinite), infinite)
    assert rounded(column, np.empty((0, 3))).shape == (0, 3)
