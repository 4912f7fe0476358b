"""Training on a set that is larger than the memory: same bits whatever the memory, and no dearer a row."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import weakref
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from larger_than_memory import write_set
from test_fit import SMALL, make_sequences

from pdhef_logtool.learning.network import fit, train_command
from pdhef_logtool.learning.network.dataset import read_dataset
from pdhef_logtool.learning.network.fit import FeatureSequence, PieceFile, normalisation_of
from pdhef_logtool.learning.network.train_command import SplitSequences
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.records.signals import FloatArray

SCRIPT = Path(__file__).with_name("larger_than_memory.py")


def measured(folder: Path, megabytes: float, units: int, epochs: int) -> dict[str, float]:
    """Return what the script says: a process has one limit for all its life."""
    command = [sys.executable, str(SCRIPT), str(folder), f"{megabytes:g}", str(units), str(epochs)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    found: dict[str, float] = json.loads(done.stdout)
    return found


class Held:
    """Counts arrays that are there at the same time."""

    def __init__(self) -> None:
        self.now = self.most = self.all = 0

    def count(self, array: Any) -> None:
        self.now, self.all = self.now + 1, self.all + 1
        self.most = max(self.most, self.now)
        weakref.finalize(array, self._gone)

    def _gone(self) -> None:
        self.now -= 1


@pytest.mark.slow
def test_a_training_holds_one_drive_and_its_pieces_of_two_batches(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drives, pieces = Held(), Held()

    def sequence(name: str, features: FloatArray, *others: FloatArray) -> FeatureSequence:
        drives.count(features)
        return FeatureSequence(name, features, *others)

    def read(file: PieceFile, number: int) -> fit._Piece:
        piece = of_file(file, number)
        pieces.count(piece.weight)
        return piece

    of_file = PieceFile.__getitem__
    monkeypatch.setattr(PieceFile, "__getitem__", read)
    monkeypatch.setattr(train_command, "FeatureSequence", sequence)
    data = read_dataset(write_set(tmp_path / "set", 20, steps=100))
    training, validation = (
        SplitSequences(
            tuple(d for d in data.drives if d.split == split), "residual", odd=False, vehicle_of=data.vehicle
        )
        for split in ("train", "validation")
    )
    recipe = replace(SMALL, epochs=1)
    fit.train(training, validation, recipe, tmp_path / "work")
    assert drives.all >= 2 * len(data.drives) and drives.most <= 2
    assert pieces.all == len(data.drives) and pieces.most <= 2 * recipe.batch


@pytest.mark.slow
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
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the limit is that of Linux")
def test_ten_hours_of_driving_are_trained_on_in_a_quarter_of_their_size(tmp_path: Path) -> None:
    found = measured(tmp_path, 110.0, 64, 1)
    assert found["limit_holds"] and found["set_mb"] >= 4.0 * found["limit_mb"]
    assert found["ratio"] < 1.3
