"""Residual models of other packages: selected by name, causal, and contained."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest
from half_slip_package import install
from reference_car import drive, slalom, with_noise

from pdhef_logtool.car.car import Car
from pdhef_logtool.estimators import latency_compensation
from pdhef_logtool.estimators.causality_check import CausalityCheck
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.records.errors import EstimatorError, ModelError
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.residual_model import interface
from pdhef_logtool.residual_model.interface import ENTRY_POINTS, plug_in_names

CONSTANT = """
import numpy as np
from pdhef_logtool.residual_model.interface import Residual
class Constant:
    sha256 = "constant"
    def residual(self, features, dt_s, state):
        count = len(features)
        {line}
        return Residual(np.full((count, 2), 0.2), np.ones(count)), None
MODEL = Constant()
"""


@pytest.fixture(autouse=True)
def _no_cached_names() -> Iterator[None]:
    plug_in_names.cache_clear()
    yield
    plug_in_names.cache_clear()


def with_model(folder: Path, code: str, monkeypatch: pytest.MonkeyPatch, name: str) -> str:
    monkeypatch.syspath_prepend(install(folder, code, name, ENTRY_POINTS, "MODEL"))
    monkeypatch.delitem(sys.modules, name, raising=False)
    return name


def signals() -> Signals:
    return with_noise(drive(slalom(0.03, 0.5), 4.0, speed=22.0).signals, seed=3)


def track_of(network: str, signals: Signals, check: CausalityCheck | None = None) -> StateTrack:
    return run_estimator(make_estimator("pd-hef:gain=1", Car.load(network=network)), signals, check)


def test_the_documented_network_acts_in_the_filter_causally(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("torch")
    code = dedent((interface.__doc__ or "").partition("into calls::\n")[2])
    name = with_model(tmp_path, code, monkeypatch, "tyre_gru")
    whole = signals()
    track = track_of(name, whole, CausalityCheck())
    physics = run_estimator(make_estimator("physics", Car.load(network="none")), whole)
    assert np.nanmax(np.abs(track.sideslip_rad - physics.sideslip_rad)) > 1e-4
    assert set(track.network_trust[track.valid]) == {1.0}
    monkeypatch.setattr(latency_compensation, "PIECE_STEPS", 150)
    assert np.array_equal(track_of(name, whole).sideslip_rad, track.sideslip_rad, equal_nan=True)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("raise KeyError('boom')", "KeyError: 'boom'"),
        ("return Residual(np.zeros(count), np.ones(count)), None", r"rate \[401, 2\]"),
        ("return Residual(np.zeros((count, 2)), np.full(count, 2.0)), None", "gain of 0 to 1"),
    ],
)
def test_a_faulty_model_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str, reason: str) -> None:
    name = with_model(tmp_path, CONSTANT.format(line=line), monkeypatch, "faulty_model")
    with pytest.raises(EstimatorError, match=reason) as error:
        track_of(name, signals())
    assert "faulty_model" in str(error.value)


def test_a_model_without_the_interface_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = with_model(tmp_path, "MODEL = 3\n", monkeypatch, "no_model")
    with pytest.raises(ModelError, match="residual model with sha256"):
        Car.load(network=name)


def test_a_model_has_no_gain_unless_the_estimator_names_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = with_model(tmp_path, CONSTANT.format(line="pass"), monkeypatch, "constant_model")
    assert Car.load(network=name).residual_gain == 0.0
