"""CSV and VBO files of ``../shared/cases``, against the values that their README states."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.logs.open_log import open_log

#: For each file: a column, its numbers, mean, minimum and maximum, and the losses by kind.
CASES = {
    "tables/reference.csv": ("accel_y", 1000, -0.0607, -2.134, 1.374, {}),
    "tables/vbo_reference.vbo": ("LatAccel", 1000, -0.0607, -2.134, 1.374, {}),
    "tables/vbo_titles_with_units.vbo": ("YawRate", 1000, np.rad2deg(-0.06499), -23.626, 1.497, {}),
    "tables/csv_comma_after_row_1000.csv": ("steering_angle", 2010, -0.0309, -0.356, 0.0033, {}),
    "tables/csv_nan_texts_in_truth.csv": ("lateral_velocity", 857, -0.1167, -0.670, 0.0092, {}),
    "hostile/quoted_ragged.csv": ("speed", 1350, 80.141, 75.0, 85.0, {"bad-row": 150}),
    "hostile/text_cells.csv": ("yaw", 1000, 0.1628, -5.0, 5.0, {"bad-cell": 500}),
    "hostile/thousands.csv": ("altitude_mm", 1500, 9248.76, 8734.5, 9734.5, {}),
    "hostile/dropout5s.csv": ("AccY", 1750, 0.4635, -4.131, 4.749, {}),
}


@pytest.mark.parametrize("name", CASES)
def test_the_numbers_of_a_column_are_right_and_the_rest_is_counted(name: str, shared_dir: Path) -> None:
    column, count, *figures, losses = CASES[name]
    with closing(open_log(shared_dir / "cases" / name)) as log:
        (topic,) = [t.name for t in log.topics if column in {f.path for f in log.fields(t.name)}]
        values = log.read({topic: [column]})[topic].fields[column]
        assert {x.kind: x.count for x in log.lost if x.severity == "lost"} == losses
    values = values[np.isfinite(values)]
    assert len(values) == count
    np.testing.assert_allclose([values.mean(), values.min(), values.max()], figures, rtol=2e-3, atol=1e-4)
