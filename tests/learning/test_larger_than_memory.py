"""Training on a set that is larger than the memory: same bits whatever the memory, and no dearer a row."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from test_fit import SMALL, make_sequences

from pdhef_logtool.learning.network import fit
from pdhef_logtool.learning.network.fit import PieceFile, normalisation_of
from pdhef_logtool.records.errors import OutputError

SCRIPT = Path(__file__).with_name("larger_than_memory.py")


def measured(folder: Path, megabytes: float, units: int, epochs: int) -> dict[str, float]:
    """Return what the script says: a process has one limit for all its life."""
    command = [sys.executable, str(SCRIPT), str(folder), f"{megabytes:g}", str(units), str(epochs)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    found: dict[str, float] = json.loads(done.stdout)
    return found


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the limit is that of Linux")
def test_a_set_of_four_times_the_memory_is_trained_on_at_the_same_cost_a_row(tmp_path: Path) -> None:
    found = measured(tmp_path, 12.0, 4, 1)
    assert found["limit_holds"] and found["set_mb"] >= 4.0 * found["limit_mb"]
    assert found["ratio"] < 1.3


def test_pieces_come_back_from_the_disk_as_they_were(tmp_path: Path) -> None:
    sequences = make_sequences(0, 3, steps=3200)
    normalisation = normalisation_of(sequences, SMALL.feature_names)
    expected = [p for s in sequences for p in fit._pieces(s, SMALL, normalisation)]
    with PieceFile(tmp_path / "new") as pieces:
        pieces.fill(iter(sequences), lambda s: fit._pieces(s, SMALL, normalisation))
        assert (len(pieces), pieces.sequences, pieces.steps) == (9, 3, 9600)
        for number in (8, 0, 4):
            for name in ("features", "target", "weight"):
                torch.testing.assert_close(
                    getattr(pieces[number], name), getattr(expected[number], name), rtol=0.0, atol=0.0
                )
        with PieceFile(tmp_path) as others:
            others.fill(sequences[:2], lambda s: fit._pieces(s, SMALL, normalisation))
            assert others.sha256 != pieces.sha256
        assert list((tmp_path / "new").iterdir()) == [], "nothing is left, even by a process that is killed"
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError):
        PieceFile(tmp_path / "file")


def test_how_rows_come_in_sequences_changes_no_bit_of_the_normalisation() -> None:
    (whole,) = make_sequences(3, 1, steps=900)
    names = SMALL.feature_names
    for cuts in ([300], [1, 899], [7, 8, 450]):
        parts = [
            fit.FeatureSequence("d", *(np.ascontiguousarray(c) for c in columns))
            for columns in zip(*(np.split(x, cuts) for x in (whole.features, whole.target, whole.weight)), strict=True)
        ]
        assert normalisation_of(parts, names) == normalisation_of([whole], names)


def test_validation_in_parts_is_that_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    network = fit._new_network(SMALL, None)
    (sequence,) = make_sequences(1, 1, steps=1000)
    piece = fit._scaled(sequence, SMALL, normalisation_of([sequence], SMALL.feature_names))
    signs = fit._signs(SMALL)
    whole = fit._validate(network, [piece], "cpu", signs)
    monkeypatch.setattr(fit, "VALIDATION_STEPS", 300)
    assert fit._validate(network, [piece], "cpu", signs) == pytest.approx(whole, rel=1e-5)


@pytest.mark.fleet
def test_ten_hours_of_driving_are_trained_on_in_a_quarter_of_their_size(tmp_path: Path) -> None:
    found = measured(tmp_path, 110.0, 64, 1)
    assert found["limit_holds"] and found["ratio"] < 1.3
