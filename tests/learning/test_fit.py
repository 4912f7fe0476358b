"""Training: it learns learnable targets, resumes bit for bit, and rejects unusable data."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.learning.network.train_command import (
    CHECKPOINT,
    PAPER_RECIPE,
    FeatureSequence,
    Recipe,
    train,
)
from pdhef_logtool.records.errors import ModelError
from pdhef_logtool.residual_model.features import FEATURES

pytestmark = pytest.mark.slow

SMALL = Recipe(FEATURES[:8], hidden=12, layers=1, head=(8,), epochs=6, batch=4, learning_rate=2e-2)


class Stop(Exception):  # noqa: N818
    """Stops a training."""


def make_sequences(seed: int, count: int, steps: int = 400) -> list[FeatureSequence]:
    """Targets are a lagged, nonlinear function of two features: a network without memory cannot learn them."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(count):
        drive = np.cumsum(rng.normal(size=(steps, len(FEATURES))), axis=0) * 0.1
        lagged = np.zeros(steps)
        for k in range(1, steps):
            lagged[k] = 0.9 * lagged[k - 1] + 0.1 * np.tanh(drive[k, 1])
        target = np.stack([0.8 * lagged, -0.3 * lagged], axis=1)
        out.append(FeatureSequence(drive, target, np.ones(steps)))
    return out


def test_network_learns_a_residual_with_memory_and_serves_it(tmp_path: Path) -> None:
    training, validation = make_sequences(0, 24), make_sequences(1, 4)
    bundle, history = train(training, validation, replace(SMALL, epochs=12), tmp_path)
    assert history[-1].validation_loss < 0.15 * history[0].validation_loss or history[-1].validation_loss < 0.05
    test = make_sequences(2, 1)[0]
    rates, _ = bundle.run(test.features, np.zeros(len(test.weight), dtype=np.bool_), None)
    error = np.sqrt(np.mean((rates - test.target) ** 2, axis=0))
    assert np.all(error < 0.35 * np.sqrt(np.mean(test.target**2, axis=0)))


def test_training_that_stopped_half_way_ends_as_if_it_had_not(tmp_path: Path) -> None:
    training, validation = make_sequences(0, 6), make_sequences(1, 2)
    whole, history = train(training, validation, SMALL, tmp_path / "whole")

    def stop(text: str, _share: float) -> None:
        if text.startswith("epoch 3:"):
            raise Stop

    with pytest.raises(Stop):
        train(training, validation, SMALL, tmp_path / "cut", progress=stop)
    resumed, again = train(training, validation, SMALL, tmp_path / "cut")
    assert resumed.sha256 == whole.sha256 != train(training, validation, replace(SMALL, seed=1), tmp_path)[0].sha256
    assert [e.validation_loss for e in again] == [e.validation_loss for e in history]


def test_training_stops_when_patience_ends_and_keeps_the_best_epoch(tmp_path: Path) -> None:
    """Validation targets have the other sign, so that their error grows while the network learns."""
    training = make_sequences(0, 6)
    validation = [replace(s, target=-s.target) for s in make_sequences(1, 2)]
    bundle, history = train(training, validation, replace(SMALL, epochs=20, patience=2), tmp_path, test=validation)
    losses = [e.validation_loss for e in history]
    best = losses.index(min(losses))
    assert len(losses) == best + 3 < 20
    assert (bundle.provenance["best_epoch"], bundle.provenance["validation_loss"]) == (best + 1, losses[best])
    assert bundle.provenance["test_loss"] == pytest.approx(losses[best])


def test_checkpoint_of_other_data_and_empty_splits_are_refused(tmp_path: Path) -> None:
    training, validation = make_sequences(0, 4), make_sequences(1, 2)
    train(training, validation, replace(SMALL, epochs=1), tmp_path)
    with pytest.raises(ModelError, match="checkpoint"):
        train(training[:2], validation, replace(SMALL, epochs=1), tmp_path)
    with pytest.raises(ModelError, match="0 sequences"):
        train(training, [], SMALL, tmp_path / "none")
    sound = (tmp_path / CHECKPOINT).read_bytes()
    for at in (4, 20, 300, len(sound) // 2, len(sound) - 5):
        for damaged in (sound[:at], sound[:at] + bytes([sound[at] ^ 4]) + sound[at + 1 :]):
            (tmp_path / CHECKPOINT).write_bytes(damaged)
            with pytest.raises(ModelError, match=r"checkpoint.*remove it to train again"):
                train(training, validation, replace(SMALL, epochs=1), tmp_path)


def test_paper_recipe_is_table_1() -> None:
    r = PAPER_RECIPE
    assert (r.batch, r.epochs, r.learning_rate, r.dropout) == (64, 200, 1e-3, 0.2)
    assert (r.hidden, r.layers, r.head, len(r.feature_names)) == (128, 2, (64, 32), 6)
