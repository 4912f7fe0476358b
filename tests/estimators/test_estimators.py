"""Requirements for all estimators: continuity across windows, causality, symmetry, latency compensation, robustness."""

import math
from dataclasses import fields, replace
from functools import cache, partial, reduce

import numpy as np
import pytest
import test_estimators as properties
from hypothesis import given, settings, strategies as st
from made_models import full_network, linear_residual, random_network
from physics_oracle import vehicle
from reference_car import drive, keep, on_axles, rolling_drive, rough_drive, slalom, with_noise

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.model import CarModel
from pdhef_logtool.car.parts import FilterNoise
from pdhef_logtool.car.posterior import Posterior
from pdhef_logtool.car.vehicle import PhysicsParts, VehicleParameters, default_vehicle
from pdhef_logtool.estimators import latency_compensation
from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics
from pdhef_logtool.estimators.base import Smoother
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.presets import OPEN_LOOP
from pdhef_logtool.estimators.smoothed import BLOCK_S, SmoothedPhysics
from pdhef_logtool.estimators.table import SPECS, Options, all_specs, make_estimator
from pdhef_logtool.estimators.vehicle_ukf import VehicleUkf
from pdhef_logtool.records.readings import without_impossible
from pdhef_logtool.records.signals import ALIGNED_SIGNALS, GNSS_COMPONENTS, TRUTH_UNITS, Signals
from pdhef_logtool.records.steps import MAX_PREDICTION_S
from pdhef_logtool.records.tracks import StateTrack, concatenate, make_track

pytestmark = pytest.mark.slow

#: With the noise that ``phy-ukf:tuned`` and ``physics`` look for in the car.
NOISE = FilterNoise(q_std=(0.05, 0.02, 0.02), r_std={"ay_m_s2": 0.8})
#: With all parts that the model of ``physics`` may have; the baselines do not use them.
PARTS = PhysicsParts(**dict.fromkeys(PhysicsParts.model_fields, True))
VEHICLE = default_vehicle().model_copy(update={"physics": PARTS})
#: Without the estimator on a self-calibrated car (tests/model/test_car_fit.py).
NAMES = tuple(s.name for s in all_specs() if not s.network and s.name != OPEN_LOOP)
NETWORKS = ("pd-hef", "pd-hef-paper", "pure-lstm", "linear-regression")
#: Estimators that compute the lateral velocity from a model or by integration.
FILTERS = ("phy-ukf", "physics", "phy-ukf:tuned")
CLAIMING = ("kinematic", "open-loop", *FILTERS)
MODEL = full_network()
STIFFNESS_VEHICLE = on_axles(VEHICLE, 105_000.0, 96_000.0)
SIGNS = {"steer_rad": -1, "ay_m_s2": -1, "yaw_rate_rad_s": -1}
MIRRORED = ("vy_m_s", "yaw_rate_rad_s", "sideslip_rad", "ay_m_s2")


def car_of(vehicle: VehicleParameters = VEHICLE) -> Car:
    """Return a car with all that an estimator may need."""
    return Car(vehicle, network=MODEL, noise={"phy-ukf:tuned": NOISE, "physics": NOISE}, network_gain=1.0)


def run(name: str, signals: Signals, **options) -> StateTrack:
    return run_estimator(make_estimator(name, car_of(), Options(**options)), signals)


def same_bits(a: StateTrack, b: StateTrack, upto: int | None = None) -> None:
    for f in fields(StateTrack):
        if f.name != "name":
            left, right = getattr(a, f.name)[:upto], getattr(b, f.name)[:upto]
            np.testing.assert_array_equal(left, right, err_msg=f.name, strict=True)


def worst(error: np.ndarray, mask: np.ndarray) -> float:
    assert mask.any()
    return float(np.abs(error[mask]).max())


@pytest.fixture(scope="module")
def rough():
    """A rough drive with a gap of 0.8 s and another friction for a while."""
    s = rough_drive(11, 500, 5)
    s.friction[100:350] = 0.8
    t = (s.stamps_ns - s.stamps_ns[0]) * 1e-9
    return keep(s, (t < 3.0) | (t > 3.8))


# --- pieces, causality, symmetry -------------------------------------------------------------------------------------


def _calibrated() -> Posterior:
    vehicle = VEHICLE.model_copy(update={"yaw_inertia_kg_m2": 1700.0, "steer_offset_rad": 0.003})
    return Posterior(vehicle)


def _taught() -> Car:
    car = Car(default_vehicle())
    return replace(car, model=CarModel(physics_sha256=car.physics_sha256, residual=linear_residual()))


#: Every estimator with steps, and every wrapper that an option or a part of the car puts around one.
EVERY = {
    **{s.name: partial(make_estimator, s.name, car_of()) for s in all_specs() if s.causal},
    OPEN_LOOP: partial(make_estimator, OPEN_LOOP, replace(car_of(), self_calibrated=_calibrated())),
    "physics without parts": partial(make_estimator, "physics", car_of(default_vehicle())),
    "calibrated": partial(make_estimator, "physics", replace(car_of(), self_calibrated=_calibrated())),
    "taught": partial(make_estimator, "pd-hef", _taught()),
    "GNSS": partial(make_estimator, "physics", car_of(), Options(gnss=True)),
}


@pytest.fixture(scope="module")
def faulty(rough):
    """The same with GNSS, a stuck gyro, a burst, a spike, spinning wheels and a second without steering."""
    rng = np.random.default_rng(3)
    t = (rough.stamps_ns - rough.stamps_ns[0]) * 1e-9
    changed = ("ay_m_s2", "yaw_rate_rad_s", "steer_rad", "speed_m_s")
    ay, yaw_rate, steer, speed = (getattr(rough, c).copy() for c in changed)
    yaw_rate[_between(1.2, 2.2)(t)] = 0.06
    ay[_between(4.0, 4.6)(t)] += 2.4 * rng.standard_normal(int(_between(4.0, 4.6)(t).sum()))
    ay[np.searchsorted(t, 0.7)] += 8.0
    speed[_between(2.3, 2.6)(t)] += 6.0
    steer[_between(4.8, 5.8)(t)] = np.nan
    velocity = np.full((len(t), 2), np.nan)
    velocity[::10] = np.stack([np.full(len(t), 22.0), 0.8 * np.sin(t)], axis=1)[::10]
    gnss = {"gnss_velocity_m_s": velocity, "gnss_velocity_std_m_s": np.full(len(t), 0.05)}
    columns = dict(zip(changed, (ay, yaw_rate, steer, speed), strict=True))
    available = rough.available | GNSS_COMPONENTS
    return replace(rough, **columns, **gnss, gnss_late_s=np.full(len(t), 0.12), available=available)


@pytest.mark.parametrize("name", EVERY)
def test_pieces_equal_the_whole_bit_for_bit(name, faulty, monkeypatch):
    """A piece also leaves the state alone that it continues from: an estimator is immutable."""
    estimator = EVERY[name]()
    whole = run_estimator(estimator, faulty)
    assert whole.valid.any()
    for size in (37, 210):
        monkeypatch.setattr(latency_compensation, "PIECE_STEPS", size)
        same_bits(run_estimator(estimator, faulty), whole)
    if estimator.causal:
        _, state = estimator.run(faulty.rows(0, 100), None)
        again = [estimator.run(faulty.rows(100, 300), state)[0] for _ in range(2)]
        assert all(np.array_equal(*pair, equal_nan=True) for pair in zip(*(s.arrays for s in again), strict=True))


@pytest.fixture(scope="module")
def of_rough(rough):
    return cache(lambda name: run(name, rough))


@pytest.mark.parametrize("name", (*NAMES, *NETWORKS))
@settings(derandomize=True, deadline=None, max_examples=8)
@given(j=st.integers(1, 400), seed=st.integers(0, 2**32 - 1), missing=st.booleans())
def test_nothing_that_arrives_later_changes_an_output(name, rough, of_rough, j, seed, missing):
    rng = np.random.default_rng(seed)
    changed = {}
    for column in ALIGNED_SIGNALS:
        values = getattr(rough, column).copy()
        values[j:] = np.nan if missing else rng.normal(0, 5, len(rough) - j) + 10.0
        changed[column] = values
    other = replace(rough, **changed)
    before = int(np.searchsorted(rough.stamps_ns, rough.ready_ns[j], side="left"))  # stamps before sample j arrived
    assert before >= j
    same_bits(of_rough(name), run(name, other), before)


@pytest.mark.parametrize("name", NAMES)
def test_left_and_right_are_mirrored(name, rough, of_rough):
    mirrored = replace(rough, **{c: sign * getattr(rough, c) for c, sign in SIGNS.items()})
    left, right = of_rough(name), run(name, mirrored)
    for column in ("vx_m_s", "vy_std_m_s", "sideslip_std_rad", "nis", "valid", "diverged"):
        np.testing.assert_allclose(getattr(right, column), getattr(left, column), rtol=1e-6, atol=1e-9, err_msg=column)
    for column in MIRRORED:
        np.testing.assert_allclose(getattr(right, column), -getattr(left, column), rtol=1e-6, atol=1e-9, err_msg=column)


# --- delay -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["open-loop", "phy-ukf"])
def test_output_is_predicted_by_the_whole_delay_and_only_once(name):
    """Inputs are held from stamp to stamp and arrive one stamp late: the prediction can be, and must be, exact."""
    undelayed = drive(slalom(0.03, 0.6), 6.0)
    late = replace(undelayed.signals, ready_ns=undelayed.signals.stamps_ns + 10_000_000)
    track = run(name, late)
    settled = undelayed.time_s > 1.0
    stale = worst(np.diff(undelayed.sideslip), settled[1:])
    assert stale > math.radians(0.03)
    assert worst(track.sideslip_rad - undelayed.sideslip, settled) < 0.1 * stale
    stale = worst(np.diff(undelayed.r), settled[1:])
    assert worst(track.yaw_rate_rad_s - undelayed.r, settled) < 0.1 * stale


@pytest.mark.parametrize("name", ["zero", "zero:no-lateral"])
def test_pass_through_shows_the_newest_arrived_sample(name):
    made = drive(slalom(), 3.0)
    track = run(name, replace(made.signals, ready_ns=made.signals.stamps_ns + 25_000_000))
    np.testing.assert_array_equal(track.yaw_rate_rad_s[3:], made.r[:-3])
    np.testing.assert_array_equal(track.ay_m_s2[3:], made.ay[:-3])
    assert not track.valid[:3].any()
    assert track.valid[3:].all()


@pytest.mark.parametrize("name", (*NAMES, *NETWORKS))
def test_what_is_too_late_is_not_predicted(name):
    made = drive(slalom(), 3.0)
    for delay_s, valid in ((MAX_PREDICTION_S - 0.02, True), (MAX_PREDICTION_S + 0.02, False)):
        track = run(name, replace(made.signals, ready_ns=made.signals.stamps_ns + round(delay_s * 1e9)))
        assert track.valid[100:].all() == valid
        assert track.valid.any() == valid
        assert np.isfinite(track.yaw_rate_rad_s).any() == valid


# --- bad signals -----------------------------------------------------------------------------------------------------


def _replaced(column: str, mask_of_time, value):
    def fault(s: Signals) -> Signals:
        t = (s.stamps_ns - s.stamps_ns[0]) * 1e-9
        values = getattr(s, column)
        return replace(s, **{column: np.where(mask_of_time(t), value(values, t), values)})

    return fault


def _between(a: float, b: float):
    return lambda t: (t >= a) & (t < b)


def _spikes(t: np.ndarray) -> np.ndarray:
    return np.arange(len(t)) % 97 == 50


MAPPED = ("steer_rad", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s")
FAULTS = {
    **{f"nan {c}": _replaced(c, _between(2, 4), lambda v, _: np.nan) for c in (*MAPPED, "friction")},
    **{f"infinite {c}": _replaced(c, _between(2, 2.5), lambda v, _: np.inf) for c in ("steer_rad", "friction")},
    **{f"spikes of 1e6 in {c}": _replaced(c, _spikes, lambda v, _: 1e6) for c in ("ay_m_s2", "speed_m_s")},
    **{f"1e300 in {c}": _replaced(c, _between(2, 3), lambda v, _: 1e300) for c in ("yaw_rate_rad_s", "friction")},
    **{f"{c} turned around": _replaced(c, _between(2, 6), lambda v, _: -v) for c in MAPPED},
    **{f"{c} stuck": _replaced(c, _between(2, 6), lambda v, t: v[np.searchsorted(t, 2.0) // 2 * 2]) for c in MAPPED},
    "no friction at all": _replaced("friction", _between(2, 3), lambda v, _: 0.0),
    "negative friction": _replaced("friction", _between(2, 3), lambda v, _: -0.5),
    "everything missing": lambda s: reduce(lambda of, c: FAULTS[f"nan {c}"](of), MAPPED, s),
    "noise x20": lambda s: with_noise(s, 3, 20.0),
    "gap of 0.4 s": lambda s: keep(s, ~_between(2, 2.4)((s.stamps_ns - s.stamps_ns[0]) * 1e-9)),
    "gap of 1.5 s": lambda s: keep(s, ~_between(2, 3.5)((s.stamps_ns - s.stamps_ns[0]) * 1e-9)),
    "one stamp": lambda s: s.rows(0, 1),
    "nothing": lambda s: s.rows(0, 0),
}


def check_sane(track: StateTrack, name: str, signals: Signals) -> None:
    ok = track.valid
    columns = ["vx_m_s", "yaw_rate_rad_s"]
    if name != "zero:no-lateral":
        columns += ["vy_m_s", "sideslip_rad"]
    if name in (*CLAIMING, *NETWORKS):
        columns += ["ay_m_s2"]
    for column in columns:
        assert np.isfinite(getattr(track, column)[ok]).all(), (name, column)
        assert np.isnan(getattr(track, column)[~ok]).all(), f"{name} claims {column} where it is not valid"
    if name in FILTERS:
        P = track.covariance[ok]
        np.testing.assert_array_equal(P, np.swapaxes(P, 1, 2))
        assert (np.linalg.eigvalsh(P) > 0).all()
        assert np.isfinite(track.sideslip_std_rad[ok]).all()
        estimator = make_estimator(name, car_of())
        one = estimator.physics if isinstance(estimator, AdaptivePhysics) else estimator
        steps, _ = one.run(signals, None)
        full = steps.P[steps.valid]
        np.testing.assert_array_equal(full, np.swapaxes(full, 1, 2))
        # scaled to correlations, so that 1e6 m/s beside 1 mrad/s is no matter of rounding
        std = np.sqrt(np.einsum("kii->ki", full))
        assert (std > 0).all()
        assert (np.linalg.eigvalsh(full / std[:, :, None] / std[:, None, :]) > 0).all()


@pytest.fixture(scope="module")
def plain():
    s = with_noise(drive(slalom(0.035, 0.5), 8.0, speed=22.0).signals, seed=9)
    s.friction[:] = 0.85
    return replace(s, ready_ns=s.stamps_ns + 10_000_000)


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.filterwarnings("error", "ignore::ResourceWarning")
def test_no_fault_breaks_an_estimator(fault, plain):
    faulty = FAULTS[fault](plain)
    cars = [(name, VEHICLE) for name in (*NAMES, *NETWORKS)]
    cars += [(name, STIFFNESS_VEHICLE) for name in FILTERS if "friction" in fault]
    for name, of_car in cars:
        track = run_estimator(make_estimator(name, car_of(of_car)), faulty)
        assert len(track) == len(faulty)
        check_sane(track, name, faulty)
        assert len(faulty) < 2 or track.valid[-50:].all(), f"{name} must run again after the fault"


#: Spikes, and faults that end by 6 s at the latest.
PASSING = [f for f in FAULTS if f not in ("one stamp", "nothing", "noise x20")]


@pytest.mark.parametrize("fault", PASSING)
def test_the_filter_recovers_from_every_fault(fault, plain):
    """Two seconds after the last bad sample, and between spikes, the estimate equals the estimate without the fault."""
    faulty = FAULTS[fault](plain)
    reference, track = run("phy-ukf", plain), run("phy-ukf", faulty)
    at = np.searchsorted(plain.stamps_ns, faulty.stamps_ns)
    late = faulty.stamps_ns - plain.stamps_ns[0] > (1e9 if "spikes" in fault else 7.9e9)
    most_deg = 0.2 if "spikes" in fault else 0.1
    assert worst(track.sideslip_rad - reference.sideslip_rad[at], late) < math.radians(most_deg)


@pytest.mark.parametrize("name", ["open-loop", "phy-ukf"])
@pytest.mark.parametrize("delay_s", [0.0, 0.1])
@pytest.mark.filterwarnings("error", "ignore::ResourceWarning")
def test_a_vehicle_that_no_step_can_follow_claims_nothing_infinite(name, delay_s, plain):
    """A yaw inertia in the wrong unit makes the model faster than any step: the state runs away, and is dropped."""
    toy = VEHICLE.model_copy(update={"yaw_inertia_kg_m2": 0.001})
    sparse = keep(plain, np.arange(len(plain)) % 20 == 0)
    late = replace(sparse, ready_ns=sparse.stamps_ns + round(delay_s * 1e9))
    track = run_estimator(make_estimator(name, car_of(toy)), late)
    assert not track.valid[5:].all()
    for column in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad", "ay_m_s2"):
        assert np.isfinite(getattr(track, column)[track.valid]).all()
        assert np.isnan(getattr(track, column)[~track.valid]).all()
    if name in FILTERS:
        assert np.isfinite(track.covariance[track.valid]).all()


@pytest.mark.parametrize("limit", ["steer_rad", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s"])
def test_only_what_no_vehicle_can_do_is_dropped(limit, plain):
    hard = {"steer_rad": 0.6, "ax_m_s2": 60.0, "ay_m_s2": 45.0, "yaw_rate_rad_s": 8.0, "speed_m_s": 110.0}[limit]
    column = getattr(plain, limit).copy()
    column[[10, 20, 30, 40]] = hard, -hard, 1e4, -np.inf
    before = column.copy()
    signals = replace(plain, **{limit: column})
    kept = getattr(without_impossible(signals), limit)
    np.testing.assert_array_equal(kept[[10, 20]], [hard, -hard])
    assert np.isnan(kept[[30, 40]]).all()
    np.testing.assert_array_equal(column, before)  # the caller's arrays stay as they are
    others = np.delete(np.arange(len(column)), [10, 20, 30, 40])
    np.testing.assert_array_equal(kept[others], getattr(plain, limit)[others])
    assert without_impossible(plain) is plain


@pytest.mark.parametrize("name", NAMES)
def test_reverse_and_manoeuvring_are_finite_and_signed(name):
    made = rolling_drive(lambda t: -2.0 * np.sin(0.8 * t), lambda t: 0.3 * np.cos(0.5 * t), 12.0)
    signals = with_noise(made.signals, 2)
    track = run(name, signals)
    check_sane(track, name, signals)
    moving = made.time_s > 1.0
    assert worst(track.vx_m_s - made.vx, moving) < 0.5
    assert worst(track.yaw_rate_rad_s - made.r, moving) < 0.15
    if name in ("open-loop", *FILTERS):
        assert worst(track.vy_m_s - made.vy, moving & (np.abs(made.vx) < 1.4)) < 0.3


# --- what they are ----------------------------------------------------------------------------------------------------


def test_signals_hold_no_truth():
    sensor_fields = {f.name for f in fields(Signals)}
    only_truth = set(TRUTH_UNITS) - set(ALIGNED_SIGNALS)
    assert not sensor_fields & only_truth


@settings(derandomize=True, deadline=None, max_examples=10)
@given(seed=st.integers(0, 2**32 - 1), log_low=st.floats(-4, -1), speed=st.floats(4.0, 50.0))
def test_covariance_is_definite_on_any_clock(seed, log_low, speed):
    """Steps from 0.1 ms to 0.3 s, in any order."""
    rng = np.random.default_rng(seed)
    dt = 10 ** rng.uniform(log_low, math.log10(0.3), 120)
    made = drive(slalom(min(0.3, 8.0 / speed**2), 0.5), speed=speed, step_s=dt)
    signals = with_noise(made.signals, seed % 1000)
    check_sane(run("phy-ukf", signals), "phy-ukf", signals)


def test_pieces_of_a_track_have_its_stamps_in_all():
    piece = make_track("a", np.arange(3), vx_m_s=np.ones(3))
    assert len(concatenate([piece, piece], 6)) == 6
    with pytest.raises(ValueError, match="7 stamps in all, got 6"):
        concatenate([piece, piece], 7)


# ---- The smoother: against an independent one, better than its filter, and bounded in look-ahead and memory ----

SEDAN = default_vehicle()
ALL = 10**6  # seconds: a block that holds every drive
BUNDLE = random_network(2)


def smoother(block_s: float = ALL, *, trust: float = 1.0, parts: tuple[str, ...] = ("lag", "biases")):
    return SmoothedPhysics(AdaptivePhysics(VehicleUkf(vehicle(*parts)), BUNDLE, trust), block_s=block_s)


def flat_smoother(*parts: str) -> SmoothedPhysics:
    """For the reference car, which does not roll, without network."""
    return SmoothedPhysics(AdaptivePhysics(VehicleUkf(vehicle(*parts, roll_gradient_rad_per_m_s2=0.0))))


def on_time(signals: Signals) -> Signals:
    """Without latency, for the filter, which then has each step at its own stamp."""
    return replace(signals, ready_ns=signals.stamps_ns)


# --- the estimator ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def jumping():
    """A rough drive with a gap that restarts the filter and a gyro that jumps."""
    s = rough_drive(12, 700, 6)
    t = (s.stamps_ns - s.stamps_ns[0]) * 1e-9
    s.yaw_rate_rad_s[(t > 5.0) & (t < 5.6)] += 0.5
    return keep(s, (t < 3.0) | (t > 3.8))


def test_it_sees_one_to_two_blocks_ahead_and_no_further(jumping):
    estimator, j = smoother(0.5), 150
    ay = jumping.ay_m_s2.copy()
    ay[j] = 1.0
    a, b = estimator.smooth(jumping), estimator.smooth(replace(jumping, ay_m_s2=ay))
    differs = np.flatnonzero(a.vy_m_s != b.vy_m_s)
    assert 0.5 <= (jumping.stamps_ns[j] - jumping.stamps_ns[differs.min()]) * 1e-9 < 1.0


@pytest.mark.parametrize(("block_s", "parts", "tolerance_m_s"), [(4.0, (), 1e-5), (BLOCK_S, ("lag", "biases"), 5e-3)])
def test_blocks_are_as_good_as_the_whole_drive(block_s, parts, tolerance_m_s):
    """Without sensor biases four seconds are enough. The biases of a drive at 20 Hz take minutes: 0.01° of sideslip."""
    signals = with_noise(drive(slalom(0.02, 0.3), 200.0, step_s=0.05).signals, seed=1)
    a, b = (smoother(s, parts=parts).smooth(signals) for s in (block_s, ALL))
    assert not np.array_equal(a.vy_m_s, b.vy_m_s)
    np.testing.assert_allclose(a.vy_m_s, b.vy_m_s, atol=tolerance_m_s)


def test_an_empty_drive_has_an_empty_track(jumping):
    assert len(smoother().smooth(jumping.rows(0, 0))) == 0


def test_nothing_behind_a_gap_tells_of_before(jumping):
    gap = int(np.argmax(np.diff(jumping.stamps_ns))) + 1
    first = jumping.rows(0, gap)
    whole, before = smoother().smooth(jumping), smoother().smooth(first)
    properties.same_bits(whole, before, gap)
    filtered = run_estimator(smoother().filtered, on_time(first))
    assert before.vy_m_s[-1] == filtered.vy_m_s[-1], "at the end of a stretch it is the filter"


@pytest.mark.parametrize("parts", [(), ("biases",)])
def test_it_is_nearer_to_the_truth_than_its_filter(parts):
    errors = []
    for seed in range(6):
        made = drive(slalom(0.03, 0.4 + 0.1 * seed), 10.0, 20.0 + seed, step_s=0.01)
        signals = on_time(with_noise(made.signals, seed=seed))
        estimator = flat_smoother(*parts)
        track, filtered = (run_estimator(e, signals) for e in (estimator, estimator.filtered))
        both = filtered.valid & track.valid
        errors.append([np.mean((e.sideslip_rad - made.sideslip)[both] ** 2) for e in (track, filtered)])
        assert (np.abs(track.vy_m_s - made.vy) < 1.96 * track.vy_std_m_s).mean() > 0.8
    ours, theirs = np.array(errors).T
    assert (ours < theirs).sum() >= 5
    assert np.mean(ours) < 0.93**2 * np.mean(theirs)


# --- the detector ----------------------------------------------------------------------------------------------------


def test_what_it_says_of_itself(jumping):
    trusted = Car(SEDAN, network=BUNDLE, network_gain=0.6)
    estimator = make_estimator("pd-hef-smoothed", trusted)
    assert isinstance(estimator, SmoothedPhysics) and isinstance(estimator, Smoother)
    assert (estimator.name, estimator.causal, estimator.filtered.trust) == ("pd-hef-smoothed", False, 0.6)
    assert "not causal" in estimator.notes[0]
    assert "residual gain 0.6" in estimator.notes[1]
    assert [s.name for s in SPECS if not s.causal] == ["open-loop:calibrated", "pd-hef-smoothed"]
    track = run_estimator(estimator, jumping)
    assert track.valid[0], "it needs no arrival"
    assert np.isnan(track.nis).all()
    assert not track.nis_dof.any()
    assert set(track.network_trust[track.valid]) == {0.6}
    assert np.array_equal(track.stamps_ns, jumping.stamps_ns)
