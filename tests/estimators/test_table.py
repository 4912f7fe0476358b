"""The table of estimators: every row builds its estimator, and the identity follows from the estimator object."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
from made_models import full_network
from reference_car import drive, make_signals, slalom, with_noise

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import Algorithm, FilterNoise
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators import table
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.base import Smoother
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.presets import OPEN_LOOP
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.signals import ALIGNED_SIGNALS, Signals
from pdhef_logtool.records.tracks import StateTrack

pytestmark = pytest.mark.slow

VEHICLE = default_vehicle()
NOISE = FilterNoise(q_std=(0.1, 0.2, 0.1), r_std={"ay_m_s2": 0.9})
#: All rows except the estimator on a self-calibrated car (``tests/model/test_car_fit.py``).
LINES = tuple(s for s in table.all_specs() if s.name != OPEN_LOOP)
every_spec = pytest.mark.parametrize("spec", LINES, ids=lambda spec: spec.name)


MODEL = full_network()
#: It has all that any estimator needs.
CAR = Car(VEHICLE, network=MODEL, noise={"phy-ukf:tuned": NOISE, "physics": NOISE}, network_gain=1.0)


@pytest.fixture(scope="module")
def signals():
    s = with_noise(drive(slalom(0.03, 0.5), 4.0, speed=22.0).signals, seed=3)
    return replace(s, friction=np.full(len(s), 0.85), ready_ns=s.stamps_ns + 10_000_000)


def run(name: str, signals: Signals, car: Car = CAR) -> StateTrack:
    return run_estimator(table.make_estimator(name, car), signals)


def same(a: StateTrack, b: StateTrack, upto: int | None = None) -> bool:
    columns = [f.name for f in fields(StateTrack) if isinstance(getattr(a, f.name), np.ndarray)]
    return all(np.array_equal(getattr(a, c)[:upto], getattr(b, c)[:upto], equal_nan=True) for c in columns)


# --- the lines -------------------------------------------------------------------------------------------------------


def test_no_two_lines_share_a_name_or_a_colour():
    for attribute in ("name", "colour", "text"):
        assert len({getattr(s, attribute) for s in table.SPECS}) == len(table.SPECS)
    assert all(0 < s.colour <= 0xFFFFFF for s in table.SPECS)


@every_spec
def test_a_line_builds_what_it_says(spec):
    estimator = table.make_estimator(spec.name, CAR)
    assert (estimator.name, estimator.causal) == (spec.name, spec.causal)
    assert isinstance(estimator, Smoother) == (not spec.causal)
    assert table.spec_of(spec.name) is spec
    assert (spec.name in table.all_names(CAR)) == (spec.group == table.ALL_ESTIMATORS)
    assert spec.needs <= frozenset(ALIGNED_SIGNALS)


@every_spec
def test_what_it_needs_is_what_it_needs(spec, signals):
    """An estimator runs with only its required signals, is skipped if one is missing, and uses every one of them."""
    dt = np.diff(signals.stamps_ns) * 1e-9
    given = spec.needs | frozenset(sorted(spec.one_of)[-1:])  # with the yaw rate, where any lateral signal will do
    bare = make_signals(dt, **{c: getattr(signals, c) for c in given})
    estimators, skipped = table.runnable((spec.name,), CAR, bare.available)
    assert ([e.name for e in estimators], skipped) == ([spec.name], [])
    track = run(spec.name, bare)
    assert track.valid[50:].all()
    assert np.isfinite(track.vx_m_s[50:]).all()
    assert np.isfinite(track.yaw_rate_rad_s[50:]).all()
    for lacking in spec.needs:
        estimators, skipped = table.runnable((spec.name,), CAR, frozenset(ALIGNED_SIGNALS) - {lacking})
        assert estimators == []
        assert [s.reason for s in skipped] == [f"the log has no {lacking}"]
        without = replace(bare, **{lacking: np.full(len(bare), np.nan)})
        assert not same(run(spec.name, without), track), lacking


@every_spec
def test_a_car_that_lacks_something_skips_it_with_the_remedy(spec):
    everything = frozenset(ALIGNED_SIGNALS)
    estimators, skipped = table.runnable((spec.name,), Car(VEHICLE), everything)
    lacks = spec.network not in ("", "optional") or spec.needs_noise
    wanted = ([], [spec.name]) if lacks else ([spec.name], [])
    assert ([e.name for e in estimators], [s.name for s in skipped]) == wanted
    if lacks:
        assert "--network" in skipped[0].reason or "fit.toml" in skipped[0].reason
        with pytest.raises(UsageError, match=spec.name):
            table.make_estimator(spec.name, Car(VEHICLE))
    assert (spec.name in table.all_names(Car(VEHICLE))) == (spec.group == table.ALL_ESTIMATORS and not lacks)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("physics-plus", r"expected estimators out of all, peers, zero, .* \(0 to 1\), got physics-plus$"),
        *((f"pd-hef:{option}", f"got pd-hef:{option}$") for option in ("trust=1", "gain", "gain=2", "gain=nan", "")),
        ("pd-hef:fixed-r=1", "got pd-hef:fixed-r=1$"),
        ("physics:tuned", "got physics:tuned$"),
        ("zero", "zero"),
    ],
)
def test_an_unknown_name_or_option_is_answered_with_those_that_exist(name, message):
    with pytest.raises(UsageError, match=message):
        table.check_names(("zero", name))


def test_a_group_names_its_estimators_and_each_runs_once():
    everything = frozenset(ALIGNED_SIGNALS)
    peers = [s.name for s in table.SPECS if s.group == table.PEERS]
    assert [e.name for e in table.runnable((table.PEERS,), CAR, everything)[0]] == peers
    table.check_names(("linear-kf", "physics", table.PEERS))
    named, _ = table.runnable(("linear-kf", "physics", table.PEERS), CAR, everything)
    assert [e.name for e in named] == ["linear-kf", "physics", *(n for n in peers if n != "linear-kf")]
    both, _ = table.runnable((table.ALL_ESTIMATORS, table.PEERS), CAR, everything)
    assert [e.name for e in both] == [*table.all_names(CAR), *peers]


def test_a_name_states_the_gain():
    assert ran("pd-hef:gain=0.5").options["trust"] == 0.5
    assert table.make_estimator("pd-hef:gain=0.5", CAR).name == "pd-hef:gain=0.5"
    _, skipped = table.runnable(("pd-hef:gain=0.5",), Car(VEHICLE), frozenset(ALIGNED_SIGNALS))
    assert [s.name for s in skipped] == ["pd-hef:gain=0.5"]


# --- algorithm of each name ------------------------------------------------------------------------------------------


def ran(name: str, car: Car = CAR, **options: Any) -> Algorithm:
    return resolve(table.make_estimator(name, car, table.Options(**options)))


# --- pd-hef without residual is physics ------------------------------------------------------------------------------

BARE = replace(CAR, network_gain=None, noise={})


def test_the_gain_decides_what_pd_hef_is():
    trusted, cautious = table.make_estimator("pd-hef", CAR), table.make_estimator("pd-hef", BARE)
    assert trusted.name == cautious.name == "pd-hef"
    assert resolve(trusted).identity != resolve(cautious).identity
    assert resolve(cautious) == ran("physics", BARE)
    without = replace(CAR, network=None)
    assert ran("pd-hef", without) == ran("physics", without)
    papers = replace(CAR, network=MODEL.paper_network)
    assert ran("pd-hef", papers) == ran("physics", papers)
