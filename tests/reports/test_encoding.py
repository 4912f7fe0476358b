import base64
import zlib

import numpy as np
import pytest

from pdhef_logtool.reports.charts import Span, joined
from pdhef_logtool.reports.encoding import GAP, MOST_CELLS, encode, envelope, grid_of


def decode(encoded):
    """Decode a text to values [M] like the page does; gaps are NaN."""
    text, scale = encoded
    planes = np.frombuffer(zlib.decompress(base64.b64decode(text)), dtype=np.uint8).astype(np.uint16)
    folded = planes[: scale["count"]] | planes[scale["count"] :] << 8
    steps = (folded >> 1) ^ -(folded & 1)
    q = np.cumsum(steps, dtype=np.uint16)
    return np.where(q == GAP, np.nan, scale["low"] + scale["step"] * q)


def stamps(n, step_ns=10_000_000, start=1_700_000_000_000_000_000):
    return start + np.arange(n, dtype=np.int64) * step_ns


def test_what_is_encoded_is_decoded_to_a_level_and_gaps_stay_gaps():
    values = np.random.default_rng(0).normal(size=5000) * 7 - 3
    values[100:200] = np.nan
    values[-1] = np.inf
    back = decode(encode(values))
    assert np.array_equal(np.isnan(back), ~np.isfinite(values))
    known = np.isfinite(values)
    assert np.abs(back - values)[known].max() <= np.ptp(values[known]) / 65_534


@pytest.mark.parametrize("values", [[], [np.nan, np.nan], [4.0, 4.0], [0.0], [-1e300, 1e300]])
def test_odd_series_are_encoded(values):
    values = np.array(values, dtype=float)
    back = decode(encode(values))
    assert np.allclose(back, values, rtol=1e-4, equal_nan=True)


def test_an_envelope_has_the_extremes_of_each_cell_in_the_order_in_which_they_came():
    at = stamps(1000)
    values = np.random.default_rng(1).normal(size=1000)
    values[300:420] = np.nan
    values[505] = np.nan
    grid = grid_of(at)
    made = envelope(grid, at, values)
    cell = (at - grid.start_ns) // grid.cell_ns
    for i in range(grid.cells):
        inside = values[(cell == i)]
        known = inside[np.isfinite(inside)]
        if not known.size:
            assert np.isnan(made[i]).all()
            continue
        low, high = known.min(), known.max()
        falls = np.flatnonzero(inside == high)[0] < np.flatnonzero(inside == low)[0]
        assert made[i].tolist() == ([high, low] if falls else [low, high])


@pytest.mark.parametrize(
    ("n", "step_ns", "cell_s"),
    [(360_001, 10_000_000, 0.1), (30_001, 10_000_000, 0.05), (1001, 10_000_000, 0.025), (4000, 200_000_000, 0.5)],
)
def test_cells_are_a_tenth_of_a_second_finer_for_short_drives_and_never_emptied_by_the_rate(n, step_ns, cell_s):
    at = stamps(n, step_ns) + np.random.default_rng(0).integers(-step_ns // 5, step_ns // 5, n)
    grid = grid_of(at)
    assert grid.cell_ns * 1e-9 == pytest.approx(cell_s, rel=0.02)
    assert grid.cells <= MOST_CELLS
    assert np.isfinite(envelope(grid, at, np.ones(n))).all()


def test_of_many_spans_the_closest_are_joined_and_all_time_is_covered():
    edges = np.cumsum(np.random.default_rng(0).uniform(0.1, 1.0, 8000))
    spans = [Span(a, b) for a, b in edges.reshape(-1, 2)]
    few = joined(spans)
    assert joined(few) == few and len(few) <= 1500 < len(spans)
    assert all(any(f.start_s <= s.start_s and s.end_s <= f.end_s for f in few) for s in spans[::50])
    assert joined(spans[100::-1]) == spans[:101]
