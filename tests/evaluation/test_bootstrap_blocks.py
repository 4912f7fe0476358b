"""The blocks of the bootstrap: they begin at the first sample that counts, wherever the clock's seconds fall."""

from __future__ import annotations

import numpy as np
import pytest

from pdhef_logtool.evaluation.bootstrap import block_bootstrap_difference

RATE = 10


@pytest.mark.parametrize("start_s", [0.0, 3.0, 7.5])
@pytest.mark.parametrize(("duration_s", "blocks"), [(9.9, 1), (20.0, 2), (20.2, 3)])
def test_blocks_are_counted_from_the_first_known_error(start_s: float, duration_s: float, blocks: int) -> None:
    stamps = np.round((1_700_000_000 + start_s + np.arange(round(duration_s * RATE)) / RATE) * 1e9).astype(np.int64)
    errors = np.random.default_rng(1).normal(size=stamps.size)
    assert block_bootstrap_difference(errors, np.zeros(stamps.size), stamps, block_s=10.0, n=10).blocks == blocks
    before = np.concatenate([stamps[0] - 4_000_000_000 + np.arange(5), stamps])  # not known, so no start of a block
    padded = np.concatenate([np.full(5, np.nan), errors])
    assert block_bootstrap_difference(padded, np.zeros(before.size), before, block_s=10.0, n=10).blocks == blocks
