"""Raw columns to SI: scale and offset by column, and every sample lost where the shape is not the signal's."""

from __future__ import annotations

import numpy as np
import pytest

from pdhef_logtool.logs.drive_log import Columns
from pdhef_logtool.mapping import SignalSource
from pdhef_logtool.mapping.channels import si_values

N = 4


def columns(**fields: np.ndarray) -> Columns:
    times = np.arange(N, dtype=np.int64)
    return Columns("/a", times, times, fields)


@pytest.mark.parametrize(
    ("name", "raw", "shape"),
    [
        ("enu_velocity_m_s", np.ones((N, 2)), (N, 3)),
        ("quat_wxyz", np.ones((N, 3)), (N, 4)),
        ("enu_velocity_m_s", np.ones(N), (N, 3)),
        ("speed_m_s", np.ones((N, 3)), (N,)),
    ],
)
def test_what_is_not_the_signal_s_shape_is_missing_at_every_sample(
    name: str, raw: np.ndarray, shape: tuple[int, ...]
) -> None:
    values = si_values(columns(v=raw), SignalSource(name, "/a", "v"))
    assert values.shape == shape
    assert np.isnan(values).all()
