"""Identification on data whose truth is known, and on a recorded drive."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import AxleTyre, PhysicsParts, Tyres, VehicleParameters
from pdhef_logtool.estimators.phy_ukf import TUNED as NAME
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.learning.car import physics_fit
from pdhef_logtool.learning.car.axle_forces import AxleCurve, axle_samples, fit_axle
from pdhef_logtool.learning.car.fit_data import GUARD_S, FitDrive, split_drive
from pdhef_logtool.learning.car.identify import _projected_levenberg_marquardt, fit_car
from pdhef_logtool.learning.stages import identify as stage
from pdhef_logtool.records.errors import EstimatorError, UsageError
from pdhef_logtool.records.reporter import Reporter
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import make_track
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs
from tests.learning.stage_run import run_stage

pytestmark = pytest.mark.slow

#: Where the choice of the parts of physics does not matter: it takes long.
STATIC = PhysicsParts()
quick_physics = pytest.mark.usefixtures("two_steps")


@pytest.fixture
def two_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let physics take two steps from one start, for tests of what else is identified."""
    quick = partial(physics_fit.fit_physics, starts=physics_fit.STARTS[:1], iterations=2)
    monkeypatch.setattr(physics_fit, "fit_physics", quick)


CAR = VehicleParameters(
    name="test car",
    mass_kg=1500.0,
    yaw_inertia_kg_m2=2500.0,
    cg_to_front_axle_m=1.2,
    cg_to_rear_axle_m=1.5,
    friction=0.9,
    tyres=Tyres(front=AxleTyre(B=10.0, C=1.35, D_n=8300.0, E=0.0), rear=AxleTyre(B=16.0, C=1.35, D_n=6700.0, E=0.0)),
)


def _drive(
    car: VehicleParameters, *, seed: int, seconds: float, amplitude: float = 0.05, steer_offset: float = 0.0
) -> FitDrive:
    """Integrate the single-track equations in plain numpy, with sensors that see them through noise."""
    rng = np.random.default_rng(seed)
    n = round(seconds * 100)
    t = np.arange(n) * 0.01
    steer = np.zeros(n)
    for _ in range(6):
        steer += amplitude / 3 * np.sin(2 * np.pi * rng.uniform(0.05, 0.8) * t + rng.uniform(0, 2 * np.pi))
    lf, lr, m, iz = car.cg_to_front_axle_m, car.cg_to_rear_axle_m, car.mass_kg, car.yaw_inertia_kg_m2
    mu, v = 0.9, 22.0

    def forces(vy: float, r: float, d: float) -> tuple[float, float]:
        def one(tyre: AxleTyre, alpha: float) -> float:
            assert tyre.B is not None and tyre.C is not None and tyre.D_n is not None
            return mu * tyre.D_n * math.sin(tyre.C * math.atan(tyre.B * alpha))

        return (
            one(car.tyres.front, d - math.atan((vy + lf * r) / v)) * math.cos(d),
            one(car.tyres.rear, -math.atan((vy - lr * r) / v)),
        )

    vy, r = 0.0, 0.0
    state = np.empty((n, 2))
    ay = np.empty(n)
    for k in range(n):
        state[k] = vy, r
        ff, fr = forces(vy, r, steer[k])
        ay[k] = (ff + fr) / m
        for _ in range(5):
            ff, fr = forces(vy, r, steer[k])
            vy, r = vy + 0.002 * ((ff + fr) / m - v * r), r + 0.002 * (lf * ff - lr * fr) / iz
    stamps = (1_700_000_000_000_000_000 + np.round(t * 1e9)).astype(np.int64)
    signals = Signals(
        stamps_ns=stamps,
        ready_ns=stamps,
        steer_rad=steer + steer_offset + rng.normal(0, 2e-4, n),
        ax_m_s2=-state[:, 0] * state[:, 1] + rng.normal(0, 0.05, n),
        ay_m_s2=ay + rng.normal(0, 0.1, n),
        yaw_rate_rad_s=state[:, 1] + rng.normal(0, 0.002, n),
        speed_m_s=v + rng.normal(0, 0.03, n),
        friction=np.full(n, np.nan),
        wheel_speed_m_s=np.full((n, 4), np.nan),
        available=frozenset({"steer_rad", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s"}),
    )
    truth = make_track(
        "truth", stamps, vx_m_s=np.full(n, v), vy_m_s=state[:, 0], yaw_rate_rad_s=state[:, 1], ay_m_s2=ay
    )
    return FitDrive("made", signals, truth, True, int(stamps[0]))


def _wrong_start(front: float, rear: float) -> VehicleParameters:
    tyres = Tyres(
        front=AxleTyre(cornering_stiffness_n_per_rad=front), rear=AxleTyre(cornering_stiffness_n_per_rad=rear)
    )
    return CAR.model_copy(update={"name": "guess", "tyres": tyres})


@pytest.fixture(scope="module")
def drives() -> tuple[FitDrive, FitDrive]:
    return _drive(CAR, seed=1, seconds=60.0, steer_offset=0.003), _drive(CAR, seed=2, seconds=30.0, steer_offset=0.003)


def test_axle_forces_of_made_data_lie_on_its_tyres(drives: tuple[FitDrive, FitDrive]) -> None:
    clean = replace(drives[0], signals=replace(drives[0].signals, steer_rad=drives[0].signals.steer_rad - 0.003))
    samples = axle_samples([clean], CAR)
    for slip, force, tyre in (
        (samples.front_slip_rad, samples.front_force_n, CAR.tyres.front),
        (samples.rear_slip_rad, samples.rear_force_n, CAR.tyres.rear),
    ):
        assert tyre.B is not None and tyre.C is not None and tyre.D_n is not None
        expected = 0.9 * tyre.D_n * np.sin(tyre.C * np.arctan(tyre.B * slip))
        assert float(np.sqrt(np.mean((force - expected) ** 2))) < 0.03 * float(np.sqrt(np.mean(expected**2)))


def test_axle_fit_recovers_a_curve_from_samples_of_it() -> None:
    true = AxleCurve(90_000.0, 6000.0, 1.3)
    slip = np.linspace(-0.15, 0.15, 3000)
    prior = AxleCurve(70_000.0, 6500.0, 1.35)
    found = fit_axle(slip, true.force_n(slip), prior=prior, mass_kg=1500.0, independent=3000.0)
    assert found.stiffness_n_per_rad == pytest.approx(true.stiffness_n_per_rad, rel=0.05)
    # A peak that was only just reached is not believed to be the peak.
    assert found.peak_n >= 1.1 * 0.99 * float(np.max(np.abs(true.force_n(slip))))


def test_axle_fit_stays_at_its_prior_without_data() -> None:
    prior = AxleCurve(70_000.0, 6500.0, 1.35)
    assert fit_axle(np.empty(0), np.empty(0), prior=prior, mass_kg=1500.0, independent=0.0) == prior


def test_stiffness_and_steering_offset_are_found_from_a_wrong_start(drives: tuple[FitDrive, FitDrive]) -> None:
    found = fit_car([drives[0]], [drives[1]], _wrong_start(75_000.0, 180_000.0), parts=STATIC)
    by_name = {p.name: p for p in found.parameters}
    assert by_name["front cornering stiffness"].value == pytest.approx(10.0 * 1.35 * 8300 * 0.9, rel=0.10)
    assert by_name["rear cornering stiffness"].value == pytest.approx(16.0 * 1.35 * 6700 * 0.9, rel=0.10)
    assert by_name["steering offset"].value == pytest.approx(0.003, abs=0.0008)
    assert by_name["steering offset"].excited
    fit, held_out = found.scores
    assert held_out.identified_deg < 0.5 * held_out.start_file_deg
    assert held_out.physics_deg < 1.1 * held_out.identified_deg
    assert fit.seconds == pytest.approx(60.0, abs=0.1)
    assert len(found.noise.q_std) == 4
    assert found.noise.physics_sha256 is None  # whose it is, is for the car to say


@quick_physics
def test_what_straight_driving_does_not_excite_is_said_and_kept() -> None:
    straight = _drive(CAR, seed=5, seconds=40.0, amplitude=0.0003)
    found = fit_car([straight], [], CAR, parts=STATIC)
    by_name = {p.name: p for p in found.parameters}
    for name in ("front peak force", "rear peak force", "front shape", "rear shape", "yaw inertia"):
        assert not by_name[name].excited, name
        assert by_name[name].value == pytest.approx(by_name[name].prior), name
    assert any("front peak force" in note for note in found.notes)


def test_too_little_driving_is_one_clear_error() -> None:
    with pytest.raises(EstimatorError, match=r"20 s.*holdout"):
        fit_car([_drive(CAR, seed=1, seconds=12.0)], [], CAR)


def test_fit_and_held_out_parts_share_no_stamp_and_keep_a_guard(drives: tuple[FitDrive, FitDrive]) -> None:
    fit, held_out = split_drive(drives[0], 0.25)
    assert held_out is not None
    gap = int(held_out.signals.stamps_ns[0]) - int(fit.signals.stamps_ns[-1])
    assert gap >= GUARD_S * 1e9
    assert fit.duration_s == pytest.approx(45.0, abs=0.05)
    assert split_drive(drives[0], 0.0) == (drives[0], None)


@quick_physics
def test_held_out_part_changes_nothing_in_the_fit(drives: tuple[FitDrive, FitDrive]) -> None:
    start = _wrong_start(90_000.0, 140_000.0)
    fit, held_out = split_drive(drives[0], 0.3)
    assert held_out is not None
    spoiled = replace(held_out, truth=replace(held_out.truth, sideslip_rad=held_out.truth.sideslip_rad + 0.1))
    one, other = (fit_car([fit], [part], start, parts=STATIC) for part in (held_out, spoiled))
    assert (one.vehicle, one.noise, one.physics) == (other.vehicle, other.noise, other.physics)
    assert one.scores[1] != other.scores[1]


@quick_physics
def test_the_stage_writes_a_part_that_runs_and_says_where_its_numbers_come_from(
    sample_logs_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    identifications = []

    def fit(*args: Any, **named: Any) -> Any:
        identifications.append(fit_car(*args, parts=STATIC, **named))
        return identifications[-1]

    monkeypatch.setattr(stage, "fit_car", fit)
    guess, out = tmp_path / "guess.toml", tmp_path / "mycar"
    text = (sample_logs_dir / "vehicle.toml").read_text()
    assert "trust_cap = 1.0" in text  # found with other tyres
    guess.write_text(text)
    log = [str(sample_logs_dir / "road.mcap")]
    result = run_stage("identify", log, out, RunConfig(car=guess, end="80"), holdout=0.25)
    car, (found,) = Car.load(out), identifications
    assert car.vehicle == found.vehicle.model_copy(update={"name": car.vehicle.name})
    assert car.noise[NAME].model_copy(update={"physics_sha256": None}) == found.noise
    assert car.noise["physics"].q_std == found.physics.noise.q_std
    assert car.fitted_physics == found.physics
    physics = car.physics_vehicle
    assert (physics.tyres, physics.physics) == (found.physics.values.tyres, STATIC)
    assert car.allowed_trust.cap == 0.0 and "no evidence" in car.allowed_trust.reason
    (drive,) = car.learnt_on
    assert (drive.name, drive.start_s) == ("road", 0.0)
    assert (out / "vehicle.toml").read_text() == text
    assert "95 %" in (out / "fit.toml").read_text()
    assert [s["part"] for s in result.figures["sideslip_rmse_deg"]] == ["fit", "held out"]
    json.dumps(result.to_dict(), allow_nan=False)
    make_estimator(NAME, car)
    make_estimator("physics", car)


def test_command_refuses_what_it_cannot_use(sample_logs_dir: Path, tmp_path: Path) -> None:
    log = [str(sample_logs_dir / "dlc.mcap")]
    with pytest.raises(UsageError, match="holdout"):
        run_stage("identify", log, tmp_path / "mycar", RunConfig(), holdout=1.0)
    (tmp_path / "notes").write_text("{}")
    with pytest.raises(UsageError, match="a car's folder"):
        run_stage("identify", log, tmp_path / "notes", RunConfig())
    for suffix in (".json", ".toml"):
        with pytest.raises(UsageError, match="a car's folder"):
            run_stage("identify", log, tmp_path / f"car{suffix}", RunConfig())
    with pytest.raises(EstimatorError, match="20 s"):
        run_stage("identify", log, tmp_path / "mycar", RunConfig())
    assert [p.name for p in tmp_path.iterdir()] == ["notes"]


@quick_physics
def test_250_lm_identified_on_its_first_half_is_good_on_its_second(
    shared_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An identified filter has 0.30 to 0.34° on 155 to 300 s."""
    reference = Path(__file__).resolve().parents[1] / "reference"
    mapping = reference / "mappings" / "revs_250lm.toml"
    log = [str(shared_dir / "data/drives/revs_250lm_a.mcap")]
    first = RunConfig(car=reference / "vehicles" / "revs_250lm.toml", mapping=mapping, end="150")
    monkeypatch.setattr(stage, "fit_car", partial(fit_car, parts=STATIC))
    run_stage("identify", log, tmp_path / "car", first, holdout=0.0)
    second = RunConfig(
        car=tmp_path / "car", mapping=mapping, start="155", estimators=("zero", "phy-ukf:tuned"), annotate="none"
    )
    result = run_logs(log, tmp_path / "out", second)
    rmse = {
        row.estimator: math.degrees(row.value)
        for row in result.results[0].rows
        if (row.signal, row.metric, row.segment) == ("sideslip_rad", "rmse", "all")
    }
    assert rmse["phy-ukf:tuned"] < 0.34 < rmse["zero"]


def test_projected_steps_find_the_bounded_minimum_also_from_a_start_at_the_bound() -> None:
    from scipy.optimize import lsq_linear

    rng = np.random.default_rng(4)
    for _ in range(20):
        a, b = rng.normal(size=(12, 4)), 3.0 * rng.normal(size=12)
        low = rng.normal(size=4)
        found, _ = _projected_levenberg_marquardt(lambda x, a=a, b=b: a @ x - b, lambda _x, a=a: a, low, low)
        expected = lsq_linear(a, b, bounds=(low, np.full(4, np.inf)), tol=1e-12).x
        cost, best = np.sum((a @ found - b) ** 2), np.sum((a @ expected - b) ** 2)
        assert cost <= best * (1 + 1e-3) + 1e-9
        assert np.all(found >= low)


def test_command_says_which_truth_it_took(sample_logs_dir: Path, tmp_path: Path) -> None:
    said: list[str] = []
    with pytest.raises(EstimatorError):
        run_stage(
            "identify",
            [str(sample_logs_dir / "dlc.mcap")],
            tmp_path / "car",
            RunConfig(),
            reporter=Reporter(warn=said.append),
        )
    assert any(text.startswith("dlc: ") and "/rtk/odometry" in text for text in said)
