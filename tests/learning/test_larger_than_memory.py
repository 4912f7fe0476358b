"""Training on a set that is larger than the memory: same bits whatever the memory, and no dearer a row."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from test_fit import SMALL, make_sequences

from pdhef_logtool.learning.network import fit
from pdhef_logtool.learning.network.fit import normalisation_of

SCRIPT = Path(__file__).with_name("larger_than_memory.py")


def measured(folder: Path, megabytes: float, units: int, epochs: int) -> dict[str, float]:
    """Run the script in a process, for the memory limit applies to a process for its whole life; return its output."""
    command = [sys.executable, str(SCRIPT), str(folder), f"{megabytes:g}", str(units), str(epochs)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    found: dict[str, float] = json.loads(done.stdout)
    return found


def test_how_rows_come_in_sequences_changes_no_bit_of_the_normalisation() -> None:
    (whole,) = make_sequences(3, 1, steps=900)
    names = SMALL.feature_names
    for cuts in ([300], [1, 899], [7, 8, 450]):
        parts = [
            fit.FeatureSequence("d", *(np.ascontiguousarray(c) for c in columns))
            for columns in zip(*(np.split(x, cuts) for x in (whole.features, whole.target, whole.weight)), strict=True)
        ]
        assert normalisation_of(parts, names) == normalisation_of([whole], names)


@pytest.mark.fleet
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the limit is that of Linux")
def test_ten_hours_of_driving_are_trained_on_in_a_quarter_of_their_size(tmp_path: Path) -> None:
    found = measured(tmp_path, 110.0, 64, 1)
    assert found["limit_holds"] and found["set_mb"] >= 4.0 * found["limit_mb"]
    assert found["ratio"] < 1.3
