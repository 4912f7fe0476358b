"""A faulty estimator of another package is named in the error; only its estimates are lost."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from reference_car import drive, slalom

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators import table
from pdhef_logtool.estimators.base import Steps, make_steps
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.table import Spec, runnable
from pdhef_logtool.records.errors import EstimatorError
from pdhef_logtool.records.signals import Signals


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
def signals() -> Signals:
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
def test_what_a_plug_in_does_wrong_is_an_error_that_names_it(
    misbehave: Callable[..., Any], got: str, signals: Signals
) -> None:
    with pytest.raises(EstimatorError, match=r"^plug \(plug-in test_plug_ins\): .*" + got):
        run_estimator(PlugIn(misbehave), signals)


def test_no_plug_in_changes_the_signals_of_others(signals: Signals) -> None:
    before = signals.yaw_rate_rad_s.copy()
    track = run_estimator(PlugIn(write_by_force), signals)
    assert np.nanmax(track.yaw_rate_rad_s) == 0.5
    np.testing.assert_array_equal(signals.yaw_rate_rad_s, before)
    assert signals.yaw_rate_rad_s.flags.writeable


def test_what_a_plug_in_prints_goes_to_stderr(signals: Signals, capsys: pytest.CaptureFixture[str]) -> None:
    run_estimator(PlugIn(lambda _signals, _state: print("hello")), signals)
    assert capsys.readouterr() == ("", "hello\n")


def test_a_plug_in_that_cannot_be_built_is_left_out_with_its_error(monkeypatch: pytest.MonkeyPatch) -> None:
    unbuilt = Spec("plug", "a plug-in", lambda *_: sys.exit(0), frozenset(), 0x123456)
    monkeypatch.setattr(table, "all_specs", lambda: (*table.SPECS, unbuilt))
    available = frozenset({"speed_m_s", "yaw_rate_rad_s"})
    ready, (skipped,) = runnable(("zero", "plug"), Car(default_vehicle()), available)
    assert [e.name for e in ready] == ["zero"]
    assert skipped.is_error and "plug (plug-in test_plug_ins): expected an estimator that runs" in skipped.reason
