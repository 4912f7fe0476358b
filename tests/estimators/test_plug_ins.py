"""A faulty estimator of another package is named in the error; only its estimates are lost."""

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import dedent
from typing import Any

import numpy as np
import pytest
from half_slip_package import install
from reference_car import drive, slalom, with_noise

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators import latency_compensation, table
from pdhef_logtool.estimators.base import Steps, make_steps
from pdhef_logtool.estimators.causality_check import CausalityCheck
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.table import Spec, make_estimator, runnable
from pdhef_logtool.records.errors import EstimatorError, ModelError
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.residual_model import interface
from pdhef_logtool.residual_model.interface import ENTRY_POINTS, plug_in_names


@dataclass(frozen=True)
class PlugIn:
    """Passes the sensors on after a misbehaviour."""

    algorithm = "plug-in"
    version = 1

    misbehave: Callable[[Signals, Any], Any]
    name: str = "plug"
    causal: bool = True

    def run(self, signals: Signals, state: Any) -> Any:
        returned = self.misbehave(signals, state)
        return (sound(signals), 1) if returned is None else returned


def sound(signals: Signals) -> Steps:
    """Return the steps of a sound estimator."""
    rate = np.array(signals.yaw_rate_rad_s)
    return make_steps(np.full(len(rate), 20.0), 0.0 * rate, rate)


def raise_error(_signals: Signals, _state: Any) -> None:
    raise KeyError("boom")


def end_process(_signals: Signals, _state: Any) -> None:
    sys.exit(0)


def write_through_view(signals: Signals, _state: Any) -> None:
    signals.rows(0, len(signals)).yaw_rate_rad_s[::2] = 0.5


def write_by_force(signals: Signals, _state: Any) -> None:
    signals.yaw_rate_rad_s.setflags(write=True)
    signals.yaw_rate_rad_s[:] = 0.5


@pytest.fixture(scope="module")
def signals():
    return drive(slalom(0.03, 0.5), 4.0, speed=22.0).signals


@pytest.mark.parametrize(
    ("misbehave", "got"),
    [
        (raise_error, r"expected an estimator that runs, got KeyError: 'boom' \(test_plug_ins.py, line \d+\)"),
        (end_process, "expected an estimator that runs, got SystemExit: 0"),
        (write_through_view, "got ValueError: assignment destination is read-only"),
        (lambda s, _: 3, "expected a pair of steps and state, got int"),
        (lambda s, _: (sound(s).at(slice(7)), None), r"expected steps, one per sample \(401\), got 7 steps"),
        (lambda s, _: (None, None), r"expected steps, one per sample \(401\), got NoneType"),
        (lambda s, _: (replace(sound(s), values=np.zeros((len(s), 3))), None), r"shape \(401, 4\), got \(401, 3\)"),
        (lambda s, _: (replace(sound(s), rates=np.zeros((9, 4))), None), r"one per sample \(401\), got 9 steps"),
        (lambda s, _: (replace(sound(s), values=sound(s).values.astype(object)), None), "a column of type object"),
    ],
)
def test_what_a_plug_in_does_wrong_is_an_error_that_names_it(misbehave, got, signals):
    with pytest.raises(EstimatorError, match=r"^plug \(plug-in test_plug_ins\): .*" + got):
        run_estimator(PlugIn(misbehave), signals)


def test_no_plug_in_changes_the_signals_of_others(signals):
    before = signals.yaw_rate_rad_s.copy()
    track = run_estimator(PlugIn(write_by_force), signals)
    assert np.nanmax(track.yaw_rate_rad_s) == 0.5
    np.testing.assert_array_equal(signals.yaw_rate_rad_s, before)
    assert signals.yaw_rate_rad_s.flags.writeable


def test_what_a_plug_in_prints_goes_to_stderr(signals, capsys):
    run_estimator(PlugIn(lambda _signals, _state: print("hello")), signals)
    assert capsys.readouterr() == ("", "hello\n")


def test_a_plug_in_that_cannot_be_built_is_left_out_with_its_error(monkeypatch):
    unbuilt = Spec("plug", "a plug-in", lambda *_: sys.exit(0), frozenset(), 0x123456)
    monkeypatch.setattr(table, "all_specs", lambda: (*table.SPECS, unbuilt))
    available = frozenset({"speed_m_s", "yaw_rate_rad_s"})
    ready, (skipped,) = runnable(("zero", "plug"), Car(default_vehicle()), available)
    assert [e.name for e in ready] == ["zero"]
    assert skipped.is_error and "plug (plug-in test_plug_ins): expected an estimator that runs" in skipped.reason


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
def _no_cached_names():
    plug_in_names.cache_clear()
    yield
    plug_in_names.cache_clear()


def with_model(folder: Path, code: str, monkeypatch: pytest.MonkeyPatch, name: str) -> str:
    monkeypatch.syspath_prepend(install(folder, code, name, ENTRY_POINTS, "MODEL"))
    monkeypatch.delitem(sys.modules, name, raising=False)
    return name


def noisy_slalom() -> Signals:
    return with_noise(drive(slalom(0.03, 0.5), 4.0, speed=22.0).signals, seed=3)


def track_of(network: str, driven: Signals, check: CausalityCheck | None = None) -> StateTrack:
    return run_estimator(make_estimator("pd-hef:gain=1", Car.load(network=network)), driven, check)


def test_the_documented_network_acts_in_the_filter_causally(tmp_path, monkeypatch):
    pytest.importorskip("torch")
    code = dedent((interface.__doc__ or "").partition("into calls::\n")[2])
    name = with_model(tmp_path, code, monkeypatch, "tyre_gru")
    whole = noisy_slalom()
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
def test_a_faulty_model_is_named(tmp_path, monkeypatch, line, reason):
    name = with_model(tmp_path, CONSTANT.format(line=line), monkeypatch, "faulty_model")
    with pytest.raises(EstimatorError, match=reason) as error:
        track_of(name, noisy_slalom())
    assert "faulty_model" in str(error.value)


def test_a_model_without_the_interface_is_refused(tmp_path, monkeypatch):
    name = with_model(tmp_path, "MODEL = 3\n", monkeypatch, "no_model")
    with pytest.raises(ModelError, match="residual model with sha256"):
        Car.load(network=name)


def test_a_model_has_no_gain_unless_the_estimator_names_one(tmp_path, monkeypatch):
    name = with_model(tmp_path, CONSTANT.format(line="pass"), monkeypatch, "constant_model")
    assert Car.load(network=name).residual_gain == 0.0
