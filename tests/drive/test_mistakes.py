"""Mistakes of a mapping: their probabilities, and that wrong units, signs, axes and topics get the right remedy."""

import math
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from typer.testing import CliRunner

from pdhef_logtool import PdhefError, ReadOptions, RunConfig, read_drive, run
from pdhef_logtool.car.vehicle import VehicleParameters, default_vehicle
from pdhef_logtool.cli.app import app
from pdhef_logtool.drive.checks import check_drive, misread_channels
from pdhef_logtool.drive.hypotheses import Law, Relation, known_hypotheses, opened, posterior
from pdhef_logtool.drive.measured import measure
from pdhef_logtool.drive.plan import plan_drive
from pdhef_logtool.drive.survey import scaled_source
from pdhef_logtool.drive.truth import derive_truth
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import Mapping, SignalSource, auto_map
from pdhef_logtool.records.signals import Channel
from pdhef_logtool.runs.inspection.report import inspect_drive_log
from studies.mapping_mistakes import look_at, mistaken, outcomes, subjects
from studies.pages import write_toml
from tests.drive.test_checks import checks_of, drive
from truthsim.drive import simulate_drive, write_drive

VEHICLE = default_vehicle().model_copy(update={"mass_kg": default_vehicle().mass_kg + 1.0})
TEXT = "truth.vy_m_s against the rear axle of the vehicle file"


def with_truth(vehicle: VehicleParameters, vy_factor: float) -> tuple[dict[str, Channel], dict[str, Channel]]:
    """A drive on linear tyres; its ground truth is measured where the vehicle file has it."""
    signals = drive(3, wheel_radius_m=vehicle.wheel_radius_m)
    rate = signals["yaw_rate_rad_s"]
    time_s = 1e-9 * (rate.stamps_ns - rate.stamps_ns[0])
    speed = signals["speed_m_s"]
    vx = np.interp(rate.stamps_ns, speed.stamps_ns, speed.values)
    smooth = np.convolve(rate.values, np.ones(21) / 21.0, "same")
    stiffness = vehicle.cornering_stiffness_n_per_rad(False, vehicle.assumed_friction)
    compliance = vehicle.mass_kg * vehicle.cg_to_front_axle_m / (vehicle.wheelbase_m * stiffness)
    lever = vehicle.cg_to_rear_axle_m + vehicle.truth_position_m[0]
    vy = lever * smooth - compliance * smooth * vx**2 + 0.002 * np.sin(31.0 * time_s)
    values = {"vx_m_s": vx, "vy_m_s": vy * vy_factor, "yaw_rate_rad_s": smooth}
    return signals, {n: replace(rate, name=n, values=v) for n, v in values.items()}


def pose_of(truth: dict[str, Channel]) -> dict[str, np.ndarray]:
    """Return the position and the heading of a velocity."""
    vx, vy, rate = (truth[n].values for n in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s"))
    yaw = np.cumsum(rate) * 0.01
    x, y = vx * np.cos(yaw) - vy * np.sin(yaw), vx * np.sin(yaw) + vy * np.cos(yaw)
    return {"x_m": np.cumsum(x) * 0.01, "y_m": np.cumsum(y) * 0.01, "yaw_rad": yaw}


@pytest.mark.parametrize("place_m", [-1.1, 0.0])
@pytest.mark.parametrize("factor", [1.0, 57.2958, 1.0 / 57.2958, 9.80665, 1.0 / 9.80665])
def test_a_wrong_unit_of_v_y_passes_at_no_lever(place_m, factor):
    vehicle = VEHICLE.model_copy(update={"truth_position_m": (place_m, 0.0, 0.0)})
    signals, truth = with_truth(vehicle, factor)
    derived = derive_truth(truth, truth_position_m=vehicle.truth_position_m)
    checks = {c.name: c for c in checks_of(signals, truth, derived, vehicle)}
    if factor == 1.0:
        assert not [n for n, c in checks.items() if c.verdict == "failed" and n.startswith("truth.vy_m_s.")]
    else:
        assert checks["truth.vy_m_s.unit"].verdict != "passed"


@pytest.mark.parametrize(
    ("factor", "mirrored", "antenna_m", "is_short"),
    [
        *((factor, *at, False) for factor in (1.0, 3.6, 1 / 3.6, -1.0) for at in [(False, 0), (True, 0), (False, 1.5)]),
        (1.0, False, 1.5, True),  # yaw times the lever is most of v_y
    ],
)
def test_positions_and_heading_show_the_unit_and_the_sign_of_v_y(factor, mirrored, antenna_m, is_short):
    """A rigid-body identity: a pose with y to the right, or from an antenna further ahead, fails no check."""
    vehicle = default_vehicle().model_copy(update={"truth_position_m": (1.3, 0.0, 0.0)})
    signals, truth = with_truth(vehicle, 1.0)
    pose, side, vy = pose_of(truth), -1.0 if mirrored else 1.0, truth["vy_m_s"].values
    pose["x_m"] += antenna_m * np.cos(pose["yaw_rad"])
    pose["y_m"] = side * (pose["y_m"] + antenna_m * np.sin(pose["yaw_rad"]))
    pose["yaw_rad"] = side * pose["yaw_rad"]
    truth |= {n: replace(truth["vx_m_s"], name=n, source=f"/ins.{n}", values=v) for n, v in pose.items()}
    truth["vy_m_s"] = replace(truth["vy_m_s"], values=factor * vy)
    truth["y_m"] = truth["y_m"].take(np.arange(vy.size) % 1000 != 500)  # a sample of one axis is missing
    end_ns = truth["vx_m_s"].stamps_ns[400 if is_short else -1]
    signals, truth = ({n: c.take(c.stamps_ns <= end_ns) for n, c in some.items()} for some in (signals, truth))
    derived = derive_truth(truth, truth_position_m=vehicle.truth_position_m)
    checks = {c.name: c for c in checks_of(signals, truth, derived, vehicle) if c.subject == "truth.vy_m_s"}
    failed = [n for n, c in checks.items() if c.verdict == "failed"]
    assert failed == ([] if factor == 1.0 else ["truth.vy_m_s.sign" if factor < 0.0 else "truth.vy_m_s.unit"])
    assert factor == 1.0 or f"by {1.0 / factor:.6g}" in checks[failed[0]].remedy


@pytest.mark.parametrize("share", [0.1, 1.0])
@pytest.mark.parametrize("is_over_ground", [False, True])
def test_a_velocity_in_the_axes_of_the_positions_is_named(share, is_over_ground):
    """Also on a road along x, where v_x is the same in both axes."""
    signals, truth = with_truth(VEHICLE, 1.0)
    vx, vy, rate = (truth[n].values for n in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s"))
    yaw = np.cumsum(rate) * 0.01
    yaw = share * (yaw - yaw.mean())
    east, north = vx * np.cos(yaw) - vy * np.sin(yaw), vx * np.sin(yaw) + vy * np.cos(yaw)
    pose = {"x_m": np.cumsum(east) * 0.01, "y_m": np.cumsum(north) * 0.01, "yaw_rad": yaw}
    pose |= {"vx_m_s": east, "vy_m_s": north} if is_over_ground else {}
    truth |= {n: replace(truth["vx_m_s"], name=n, source=f"/ins.{n}", values=v) for n, v in pose.items()}
    checks = {c.name: c for c in checks_of(signals, truth, derive_truth(truth), VEHICLE)}
    named = checks.get("truth.vy_m_s.axis")
    assert (named is not None) == is_over_ground
    assert named is None or "enu_velocity_m_s" in named.remedy


def test_exchanged_velocities_of_ground_truth_are_named():
    signals, truth = with_truth(VEHICLE, 1.0)
    ahead, across = truth["vx_m_s"], truth["vy_m_s"]
    truth |= {"vx_m_s": replace(ahead, values=across.values), "vy_m_s": replace(across, values=ahead.values)}
    found = checks_of(signals, truth, derive_truth(truth), VEHICLE)
    named = {c.subject for c in found if c.name.endswith(".axis") and c.remedy.startswith("exchange the fields")}
    assert named == {"truth.vx_m_s", "truth.vy_m_s"}
    assert {c.subject for c in found if c.verdict == "failed"} <= {*named, "truth.sideslip_rad"}


def test_an_impossible_yaw_rate_of_ground_truth_does_not_blame_the_gyro():
    signals, truth = with_truth(VEHICLE, 1.0)
    rate = truth["yaw_rate_rad_s"]
    truth["yaw_rate_rad_s"] = replace(rate, values=2000.0 * rate.values)
    found = checks_of(signals, truth, derive_truth(truth), VEHICLE)
    assert {c.subject for c in found if c.verdict == "failed"} == {"truth.yaw_rate_rad_s"}


def test_ground_truth_may_be_at_any_axle_of_a_car_whose_cg_is_far_back():
    """A file without the place of ground truth means the CG; the lever of its front axle is no other unit."""
    back = VEHICLE.model_copy(update={"cg_to_rear_axle_m": 0.8, "cg_to_front_axle_m": 1.8})
    signals, truth = with_truth(back, 1.0)
    (axle,) = (r for r in measure(signals, truth, derive_truth(truth), back).relations if r.law.text == TEXT)
    assert axle.law.gains[1] > (0.8 + 1.8) / 0.8


def test_a_unit_that_the_drive_leaves_open_is_not_checkable():
    """At a low correlation both regressions reach far: 3.6 times as much would be plausible too."""
    signals = drive(3)
    ay = signals["ay_m_s2"]
    noise = np.random.default_rng(1).standard_normal(ay.values.size // 100 + 1).repeat(100)[: ay.values.size]
    loud = replace(ay, values=0.4 * ay.values + 0.55 * noise)
    kept = {n: signals[n] for n in ("yaw_rate_rad_s", "speed_m_s")} | {"ay_m_s2": loud}
    checks = {c.name: c for c in checks_of(kept)}
    unit = checks.get("ay_m_s2.unit", checks.get("ay_m_s2.sign"))
    assert unit.verdict == "undecided"
    assert unit.remedy.startswith("needs ")


def test_a_car_that_reverses_fast_has_a_wrong_sign_of_its_speed():
    """Without ground truth, four wheel speeds with reversed sign contradict no other signal."""
    signals = {n: c for n, c in drive(3, calm=True).items() if n in ("wheel_speed_rl_m_s", "yaw_rate_rad_s", "ay_m_s2")}
    wheel = signals["wheel_speed_rl_m_s"]
    wheels = {f"wheel_speed_{w}_m_s": replace(wheel, name=f"wheel_speed_{w}_m_s") for w in ("fl", "fr", "rl", "rr")}
    assert not [c for c in checks_of(signals | wheels) if c.verdict == "failed"]
    turned = {n: replace(c, values=-c.values) for n, c in wheels.items()}
    assert {c.name for c in checks_of(signals | turned) if c.verdict == "failed"} == {f"{n}.sign" for n in wheels}


@pytest.mark.parametrize(("name", "factor"), [("x_m", 1e-3), ("y_m", 3.2808), ("x_m", -1.0), ("y_m", -1.0), ("", 1.0)])
def test_a_wrong_scale_or_sign_of_a_position_is_named_and_the_position_not_used(name, factor):
    signals, truth = with_truth(VEHICLE, 1.0)
    pose, scales = pose_of(truth), {name: factor}
    truth |= {n: replace(truth["vx_m_s"], name=n, values=scales.get(n, 1.0) * pose[n]) for n in ("x_m", "y_m")}
    checks = checks_of(signals, truth, derive_truth(truth), VEHICLE)
    failed = {c.name: c.remedy for c in checks if c.verdict == "failed" and c.subject.startswith("truth.")}
    expected = "" if not name else "truth.y_m.sign" if factor < 0.0 else f"truth.{name}.scale"
    assert list(failed) == [n for n in [expected] if n]
    if expected:
        named = float(failed[expected].partition(" by ")[2].partition(",")[0])
        assert named == pytest.approx(1.0 / factor, rel=0.05)
        assert factor > 0.0 or "truth.x_m or truth.y_m" in failed[expected]
        assert set(misread_channels(checks)) == {expected.rpartition(".")[0]}


def test_exchanged_degrees_of_a_place_are_named_as_such():
    signals, truth = with_truth(VEHICLE, 1.0)
    yaw = np.cumsum(truth["yaw_rate_rad_s"].values) * 0.01
    north, east = (np.cumsum(truth["vx_m_s"].values * way) * 0.01 / 111_320.0 for way in (np.sin(yaw), np.cos(yaw)))
    degrees = {"lat_deg": east, "lon_deg": north}
    truth |= {n: replace(truth["vx_m_s"], name=n, values=v) for n, v in degrees.items()}
    mapping = Mapping({}, {n: SignalSource(n, "/fix", n) for n in degrees})
    derived = derive_truth(truth)
    measured = measure(signals, truth, derived, VEHICLE, mapping)
    checks = check_drive(measured)
    (sign,) = (c for c in checks if c.subject == "truth.lat_deg" and c.verdict == "failed")
    assert sign.name == "truth.lat_deg.sign" and "exchanged" in sign.remedy and "lon_deg" in sign.remedy
    both = replace(measured, scales=measured.scales | {"truth.x_m": 1.0, "truth.y_m": 1.0})
    found = check_drive(both)  # positions in metres go before degrees
    assert {c.subject for c in found if c.verdict == "failed" and c.subject != "ay_m_s2"} == {"truth.y_m"}


@pytest.mark.parametrize(
    ("fields", "scale", "is_named"),
    [
        (("twist.linear.x", "twist.linear.y"), 1.0 / 3.6, True),
        (("v_long", "v_lat"), 9.80665, True),
        (("velocity[0]", "velocity[1]"), -1.02, False),
        (("v_long_kmh", "v_lat_mps"), 1.0 / 3.6, False),
    ],
)
def test_components_of_one_vector_have_one_unit(fields, scale, is_named):
    """Nothing else shows the unit of a lateral velocity without a gyro and an accelerometer."""
    signals, truth = with_truth(VEHICLE, scale)
    signals = {"speed_m_s": signals["speed_m_s"]}
    del truth["yaw_rate_rad_s"]
    sources = zip(truth, fields, (1.0, scale), strict=True)
    mapping = Mapping({}, {n: SignalSource(n, "/truth", field, scale=s) for n, field, s in sources})
    checks = check_drive(measure(signals, truth, derive_truth(truth), VEHICLE, mapping))
    failed = {c.name: c.remedy for c in checks if c.verdict == "failed"}
    assert list(failed) == ["truth.vy_m_s.unit"] * is_named
    assert all("scale = 1" in remedy for remedy in failed.values())


@pytest.mark.parametrize("factor", [1.0, np.pi / 180.0, 180.0 / np.pi, -1.0])
def test_a_heading_turns_as_the_gyro_does(factor):
    signals, truth = with_truth(VEHICLE, 1.0)
    yaw = 1.0 + np.cumsum(truth["yaw_rate_rad_s"].values) * 0.01
    truth["yaw_rad"] = replace(truth["vx_m_s"], name="yaw_rad", values=factor * np.angle(np.exp(1j * yaw)))
    checks = checks_of(signals, truth, derive_truth(truth), VEHICLE)
    failed = {c.name: c.remedy for c in checks if c.verdict == "failed" and c.subject == "truth.yaw_rad"}
    kind = {1.0: [], -1.0: ["truth.yaw_rad.sign"]}.get(factor, ["truth.yaw_rad.unit"])
    assert list(failed) == kind
    assert all(f"by {1.0 / factor:.6g}" in remedy for remedy in failed.values())


pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


@pytest.fixture(scope="module")
def mapping_of(tmp_path_factory):
    """Return the mapping file that is recognised of a log."""

    def recognise(path: Path) -> dict[str, Any]:
        file = tmp_path_factory.mktemp("mapping") / "m.toml"
        assert CliRunner().invoke(app, ["inspect", str(path), "--write-mapping", str(file)]).exit_code == 0
        return tomllib.loads(file.read_text(encoding="utf-8"))

    return recognise


def test_every_mistake_in_a_double_lane_change_is_named(sample_logs_dir, tmp_path, mapping_of):
    """A wrong unit, sign and axis of each signal; the speed and the tyres of the default car may leave one open."""
    path = sample_logs_dir / "dlc.mcap"
    mapping = mapping_of(path)
    kinds = [(subject, kind) for subject in subjects(mapping) for kind in ("x57.3", "/9.81", "sign", "axis")]
    found = list(outcomes(look_at, path, mapping, tmp_path, kinds))
    assert len(found) == len(kinds)
    assert not {f"{o.signal} {o.kind}": o.verdict for o in found if o.verdict not in ("named", "refused")}


@pytest.mark.parametrize(
    ("name", "factor", "remedy"),
    [
        ("yaw_rate_rad_s", 2000.0, "raw counts"),
        ("ax_m_s2", 2000.0, "raw counts"),
        ("yaw_rate_rad_s", 300.0, "degrees"),
        ("roll_rate_rad_s", 300.0, "degrees"),
    ],
)
def test_impossible_magnitudes_need_no_second_signal(name, factor, remedy):
    channel = drive(3)[name.replace("roll", "yaw")]
    checks = checks_of({name: replace(channel, name=name, values=channel.values * factor)})
    (check,) = (c for c in checks if c.name == f"{name}.unit")
    assert check.verdict == "failed"
    assert remedy in check.remedy
    assert misread_channels([check]).keys() == {name}
    assert misread_channels([check], [check.name]) == {}


def run_with(path: Path, mapping: Path, out: Path) -> int:
    config = RunConfig(car=path.parent / "vehicle.toml", mapping=mapping, annotate="none", keep="metrics")
    return run([str(path)], out, config).exit_code


@pytest.mark.parametrize(("subject", "kind", "code"), [("steer_rad", "x57.3", 3), ("wheel_speed", "/57.3", 1)])
def test_what_uses_a_signal_with_a_wrong_unit_is_stopped(sample_logs_dir, tmp_path, mapping_of, subject, kind, code):
    path = sample_logs_dir / "fishhook.mcap"
    wrong = write_toml(tmp_path / "wrong.toml", mistaken(mapping_of(path), subject, kind))
    if code == 1:
        with pytest.raises(PdhefError, match=r"multiply its scale in the mapping by 57\.2958"):
            run_with(path, wrong, tmp_path / "out")
    else:
        assert run_with(path, wrong, tmp_path / "out") == code


@pytest.mark.parametrize(("kind", "factor"), [("x3.6", "0.277778"), ("/3.6", "3.6")])
def test_a_vehicle_file_decides_the_scale_of_the_steering(sample_logs_dir, tmp_path, mapping_of, kind, factor):
    path = sample_logs_dir / "dlc.mcap"
    wrong = write_toml(tmp_path / "wrong.toml", mistaken(mapping_of(path), "steer_rad", kind))
    with read_drive(path, sample_logs_dir / "vehicle.toml", wrong) as drive:
        (check,) = (c for c in drive.plan.checks if c.name == "steer_rad.unit")
        assert check.verdict == "failed" and f"multiply its scale in the mapping by {factor}" in check.remedy


def test_a_model_car_with_a_wrong_speed_is_no_full_size_car():
    signals, truth = (
        {n: c if n.startswith(("yaw", "steer")) else replace(c, values=0.1 * c.values) for n, c in its.items()}
        for its in with_truth(VEHICLE, 1.0)
    )
    signals = {n: c for n, c in signals.items() if not n.startswith("wheel")}
    fast = signals | {"speed_m_s": replace(signals["speed_m_s"], values=9.80665 * signals["speed_m_s"].values)}
    (wrong,) = (c for c in checks_of(fast, truth, derive_truth(truth)) if c.verdict == "failed")
    assert wrong.name == "speed_m_s.unit" and "by 0.101972" in wrong.remedy


@pytest.mark.parametrize(("has_file", "friction", "seed"), [(True, 0.15, 11), (False, 0.25, 202)])
def test_sliding_on_ice_is_no_wrong_scale_of_the_steering(sample_logs_dir, tmp_path, has_file, friction, seed):
    write_drive(simulate_drive("dlc-3888-2", friction=friction, seed=seed, keep_spins=True), tmp_path / "ice.mcap")
    with read_drive(tmp_path / "ice.mcap", sample_logs_dir / "vehicle.toml" if has_file else None) as drive:
        assert not [c.name for c in drive.plan.checks if c.verdict == "failed"]


def test_a_waived_check_stops_nothing(sample_logs_dir, tmp_path, mapping_of):
    path = sample_logs_dir / "fishhook.mcap"
    wrong = write_toml(tmp_path / "wrong.toml", mistaken(mapping_of(path), "steer_rad", "x57.3"))
    car = sample_logs_dir / "vehicle.toml"
    for waived in ((), ("steer_rad.unit",)):
        with read_drive(path, car, wrong, ReadOptions(waived=waived)) as drive:
            assert ("steer_rad" in drive.available) == bool(waived)


NAMES = ["ay_m_s2", "yaw_rate_rad_s", "speed_m_s"]
TURN = {"ay_m_s2": 1, "yaw_rate_rad_s": -1, "speed_m_s": -1}


def relation(*gains: float, powers: dict[str, int] = TURN, text: str = "a_y") -> Relation:
    size = math.exp(float(np.mean(np.log(np.abs(gains)))))
    return Relation(Law(text, powers, (0.55, 1.8)), 0.99, math.copysign(size, gains[0]), 200.0, blocks=gains)


def probabilities(*relations: Relation) -> dict[str, float]:
    found = posterior(relations, known_hypotheses((*NAMES,)))
    assert sum(p for p, _ in found.sets) == pytest.approx(1.0)
    return {n: sum(p for p, _ in found.of(n)) for n in NAMES}


@settings(max_examples=50, deadline=None, derandomize=True)
@given(gains=st.lists(st.floats(0.7, 1.5), min_size=3, max_size=8))
def test_plausible_gains_blame_nobody(gains):
    assert max(probabilities(relation(*gains)).values()) < 0.05


def test_a_unit_is_wrong_in_every_block_and_a_slide_in_some():
    sound = relation(1.0, 1.05, 0.95, 1.0, powers={"speed_m_s": 1}, text="another speed")
    degrees = np.pi / 180.0
    wrong = probabilities(sound, *(relation(*(g * degrees for g in (1.0, 1.1, 0.9, 1.0)), text=t) for t in "ab"))
    assert wrong["yaw_rate_rad_s"] > 0.85 and wrong["speed_m_s"] < 0.1
    assert max(probabilities(sound, relation(1.0, 0.6, 0.35, 0.2)).values()) < 0.05


def test_two_mistakes_are_found_that_are_worse_than_none_alone():
    """All that turns counts to the right, and only the path over ground shows it: IMU and steering are two mistakes."""
    steady, steer = (1.0, 1.1, 0.9, 1.0), {"steer_rad": 1}
    relations = [
        relation(*steady),
        relation(*steady, powers=steer | {"yaw_rate_rad_s": -1}, text="steering"),
        relation(*steady, powers=steer | {"ay_m_s2": -1}, text="steering and a_y"),
        relation(*(-g for g in steady), powers={"yaw_rate_rad_s": 1}, text="path"),
    ]
    imu = ("ay_m_s2", "yaw_rate_rad_s")
    found = posterior(relations, known_hypotheses((*NAMES, "steer_rad"), (imu,), (("steer_rad",),)))
    probability, chosen = found.sets[0]
    assert probability > 0.97 and {n for h in chosen for n in h.factors} == {*imu, "steer_rad"}


def test_an_assumed_unit_is_wrong_before_one_that_is_given():
    names = ("speed_m_s", "steering_wheel_rad")
    km_h = [relation(3.6, 3.7, 3.5, powers=dict.fromkeys(names, 1), text=text) for text in "ab"]
    mistakes = known_hypotheses(names)
    given, assumed = (posterior(km_h, [opened(m, frozenset(of)) for m in mistakes]) for of in ((), names[:1]))
    assert given.sets[0][1][0].factors.keys() == {names[1]}
    assert assumed.sets[0][1][0].factors == {names[0]: 1.0 / 3.6} and assumed.sets[0][0] > 0.9


def test_scales_of_right_mappings_are_those_of_units():
    """A gain between km/h and mph fits both; only one of them corrects the mapping to the scale of a unit."""
    between = relation(2.8, 2.9, 2.85, powers={"speed_m_s": 1}, text="another speed")
    likeliest = {
        scale: posterior([between], known_hypotheses(("speed_m_s",)), {"speed_m_s": scale}).of("speed_m_s")[0]
        for scale in (3.6, 1.0 / 0.44704)
    }
    assert [h.factors["speed_m_s"] for _, h in likeliest.values()] == pytest.approx([1.0 / 3.6, 0.44704])
    assert all(p > 0.75 for p, _ in likeliest.values())
    counts = posterior([between], known_hypotheses(("speed_m_s",)), {"speed_m_s": 0.0123})
    assert counts == posterior([between], known_hypotheses(("speed_m_s",)))


def test_inspect_and_run_refuse_the_same_channels(sample_logs_dir):
    log = open_log(sample_logs_dir / "dlc.mcap")
    right = auto_map(log).mapping
    degrees = {"yaw_rate_rad_s": scaled_source(right.truth["yaw_rate_rad_s"], 180.0 / np.pi)}
    wrong = replace(right, truth={**right.truth, **degrees}, origin="file")
    inspection = inspect_drive_log(log, wrong)
    plan = plan_drive(log, wrong, default_vehicle(), log.start_ns, log.end_ns)
    log.close()
    assert inspection.refused == plan.refused
    assert set(plan.refused) == {"truth.yaw_rate_rad_s"}
    assert "physics" in inspection.estimators
