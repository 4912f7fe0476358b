"""Estimators of other packages: none that looks ahead is scored, a faulty one is named and costs only its estimates."""

import math
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass, make_dataclass, replace
from pathlib import Path
from textwrap import dedent
from typing import Any

import numpy as np
import polars as pl
import pytest
from reference_car import drive, slalom, with_noise

from pdhef_logtool import Car, RunConfig, read_drive
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators import latency_compensation, table
from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.base import Steps, make_steps
from pdhef_logtool.estimators.causality_check import CausalityCheck
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.table import SPECS, Spec, all_names, make_estimator, runnable
from pdhef_logtool.estimators.vehicle_ukf import VehicleUkf
from pdhef_logtool.evaluation.track_errors import signal_error
from pdhef_logtool.records.errors import EXIT_OK, EXIT_PARTIAL, EstimatorError, ModelError, UsageError
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.residual_model import interface
from pdhef_logtool.residual_model.interface import ENTRY_POINTS, plug_in_names
from pdhef_logtool.runs.fleet import run_logs
from tests.command_line import called
from tests.plug_in import install


def example_code() -> str:
    """Return the estimator as the docstring shows it."""
    return dedent((table.__doc__ or "").partition("Example::\n")[2])


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
    s = with_noise(drive(slalom(0.03, 0.5), 4.0, speed=22.0).signals, seed=3)
    return replace(s, ready_ns=s.stamps_ns + 16_000_000)


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


def track_of(network: str, driven: Signals, check: CausalityCheck | None = None) -> StateTrack:
    return run_estimator(make_estimator("pd-hef:gain=1", Car.load(network=network)), driven, check)


def test_the_documented_network_acts_in_the_filter_causally(tmp_path, monkeypatch, signals):
    pytest.importorskip("torch")
    code = dedent((interface.__doc__ or "").partition("into calls::\n")[2])
    name = with_model(tmp_path, code, monkeypatch, "tyre_gru")
    track = track_of(name, signals, CausalityCheck())
    physics = run_estimator(make_estimator("physics", Car.load(network="none")), signals)
    assert np.nanmax(np.abs(track.sideslip_rad - physics.sideslip_rad)) > 1e-4
    assert set(track.network_trust[track.valid]) == {1.0}
    monkeypatch.setattr(latency_compensation, "PIECE_STEPS", 150)
    assert np.array_equal(track_of(name, signals).sideslip_rad, track.sideslip_rad, equal_nan=True)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("raise KeyError('boom')", "KeyError: 'boom'"),
        ("return Residual(np.zeros(count), np.ones(count)), None", r"rate \[401, 2\]"),
        ("return Residual(np.zeros((count, 2)), np.full(count, 2.0)), None", "gain of 0 to 1"),
    ],
)
def test_a_faulty_model_is_named(tmp_path, monkeypatch, signals, line, reason):
    name = with_model(tmp_path, CONSTANT.format(line=line), monkeypatch, "faulty_model")
    with pytest.raises(EstimatorError, match=f"faulty_model.*{reason}"):
        track_of(name, signals)


def test_a_model_without_the_interface_is_refused(tmp_path, monkeypatch):
    name = with_model(tmp_path, "MODEL = 3\n", monkeypatch, "no_model")
    with pytest.raises(ModelError, match="residual model with sha256"):
        Car.load(network=name)


def test_a_model_has_no_gain_unless_the_estimator_names_one(tmp_path, monkeypatch):
    name = with_model(tmp_path, CONSTANT.format(line="pass"), monkeypatch, "constant_model")
    assert Car.load(network=name).residual_gain == 0.0


NEEDS = frozenset({"speed_m_s", "yaw_rate_rad_s"})


def peek(rate: FloatArray) -> FloatArray:
    """Return each sample's follower."""
    return np.append(rate[1:], rate[-1])


def centred(rate: FloatArray) -> FloatArray:
    """Return a centred mean of 5 samples."""
    return np.convolve(rate, np.full(5, 0.2), mode="same")


def over_window(rate: FloatArray) -> FloatArray:
    """Take off the mean of the window."""
    return rate - rate.mean()


def past(rate: FloatArray) -> FloatArray:
    """Return each sample's predecessor."""
    return np.append(rate[:1], rate[:-1])


@dataclass(frozen=True)
class Cheat:
    """Yaw rate passed through a function of the window, or one of this module by name (an option is a plain value)."""

    algorithm = "cheat"
    version = 1
    options = ("of",)

    of: Any
    name: str = "cheat"
    causal: bool = True

    def run(self, signals: Signals, state: None) -> tuple[Steps, None]:
        rate = (globals()[self.of] if isinstance(self.of, str) else self.of)(signals.yaw_rate_rad_s)
        return make_steps(np.full(len(rate), 20.0), 0.0 * rate, rate), None


def reason(estimator: Any, signals: Signals, *windows: tuple[int, int]) -> str:
    check, state = CausalityCheck(), None
    for first, end in windows or ((0, len(signals)),):
        part, before = signals.rows(first, end), check.state_before(estimator, state)
        steps, state = estimator.run(part, state)
        check.check(estimator, part, before, steps)
    return check.failed.get(estimator.name, "")


@pytest.mark.parametrize("of", [peek, centred, over_window])
def test_an_estimator_that_looks_ahead_fails(of, signals):
    found = reason(Cheat(of), signals)
    assert re.search(r"causality check: .* steps up to \d+ ns change .* declare causal = False", found), found


def test_looking_ahead_that_begins_late_is_found_in_a_later_window(signals):
    late = Cheat(lambda rate: peek(rate) if len(rate) == 77 else rate)
    starts = [0, 100, 110, 120]
    windows = [*zip(starts, [*starts[1:], 197], strict=True)]
    assert windows[3][1] - windows[3][0] == 77
    assert reason(late, signals, *windows)


@pytest.mark.parametrize("of", [past, lambda rate: rate, np.cumsum])
def test_a_causal_estimator_passes(of, signals):
    assert reason(Cheat(of), signals) == ""


def test_an_estimator_that_declares_that_it_is_not_causal_is_not_checked(signals):
    assert reason(Cheat(peek, causal=False), signals) == ""


def test_rounding_is_no_looking_ahead(signals):
    """Sums of another length round differently; a real dependence is larger by far."""
    assert reason(Cheat(lambda rate: rate * (1.0 + 1e-13 * len(rate))), signals) == ""
    assert reason(Cheat(lambda rate: rate * (1.0 + 1e-6 * len(rate))), signals)


# --- in a run --------------------------------------------------------------------------------------------------------


def _spec(name: str, of: str) -> Spec:
    return Spec(name, f"the test's {name}", lambda name, _car, _options: Cheat(of, name), NEEDS, 0x123456)


@pytest.fixture
def plugged(monkeypatch):
    specs = (*table.SPECS, _spec("peeks", "peek"), _spec("honest", "past"))
    monkeypatch.setattr(table, "all_specs", lambda: specs)
    yield


def _run(tmp_path: Path, sample_logs_dir: Path, *names: str) -> Any:
    config = RunConfig(car=Path("saloon"), estimators=names, keep="estimates", model="off", reference="off")
    return run_logs([str(sample_logs_dir / "dlc.mcap")], tmp_path, config, report=False)


@pytest.mark.slow
def test_a_run_leaves_out_what_looks_ahead_says_why_and_ends_with_3(plugged, tmp_path, sample_logs_dir):
    result = _run(tmp_path / "a", sample_logs_dir, "zero", "peeks", "honest")
    report = result.results[0].report
    outcomes = {e["name"]: e["outcome"] for e in report["estimators"]}
    assert outcomes == {"zero": "ran", "honest": "ran", "peeks": "failed"}
    failed = next(e for e in report["estimators"] if e["name"] == "peeks")
    assert "causality check" in failed["reason"]
    assert result.exit_code == EXIT_PARTIAL
    assert any("peeks" in text and "causality check" in text for text in result.results[0].outcome.lost)
    assert {r.estimator for r in result.results[0].rows} & {"zero", "honest", "peeks", "physics"} == {"zero", "honest"}
    rows = pl.read_parquet(tmp_path / "a/logs/dlc/estimates.parquet")
    assert set(rows["estimator"].unique()) == {"zero", "honest", "selected", "truth"}
    sound = _run(tmp_path / "b", sample_logs_dir, "zero", "honest")
    assert sound.exit_code == EXIT_OK
    assert rows.equals(pl.read_parquet(tmp_path / "b/logs/dlc/estimates.parquet"))


@pytest.mark.slow
def test_a_run_of_nothing_else_fails_with_the_reason(plugged, tmp_path, sample_logs_dir):
    with pytest.raises(EstimatorError, match="causality check"):
        _run(tmp_path, sample_logs_dir, "peeks")


# --- estimators of other packages ------------------------------------------------------------------------------------


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Return a function that installs a package with an estimator for this test."""
    names: list[str] = []

    def add(code: str, name: str = "half_slip") -> None:
        names.append(name)
        monkeypatch.syspath_prepend(str(install(tmp_path, code, name)))
        table.all_specs.cache_clear()

    yield add
    for name in names:
        sys.modules.pop(name, None)
    monkeypatch.undo()
    table.all_specs.cache_clear()


@pytest.mark.slow
def test_an_estimator_of_another_package_runs_under_its_name(installed, tmp_path, sample_logs_dir):
    installed(example_code())
    result = _run(tmp_path / "out", sample_logs_dir, "zero", "half-slip")
    assert result.exit_code == EXIT_OK
    algorithms = {e["name"]: e["algorithm"]["algorithm"] for e in result.results[0].report["estimators"]}
    assert algorithms == {"zero": "pass-through", "half-slip": "half-slip"}
    rows = pl.read_parquet(tmp_path / "out/logs/dlc/estimates.parquet").filter(pl.col("estimator") == "half-slip")
    valid = rows.filter("valid")
    assert len(valid) > 900
    assert np.abs(valid["vy_m_s"].to_numpy()).max() > 0.05
    assert "half-slip" in called("run", "--list-estimators").stdout


@pytest.mark.parametrize(
    ("code", "why"),
    [
        ("raise OSError('no licence')", "OSError: no licence"),
        ("SPEC = 3", "got int, expected pdhef_logtool.estimators.table.Spec"),
        (example_code().replace('"half-slip"', '"zero"'), "an estimator named zero exists"),
    ],
)
def test_a_package_that_cannot_be_used_is_named_and_left_out(code, why, installed, capsys):
    installed(code, "broken_plugin")
    assert table.all_specs() == table.SPECS
    told = capsys.readouterr().err
    assert told.count("\n") == 1
    assert "broken_plugin" in told
    assert why in told


# ---- Frozen accuracy of the baselines and identities of the shipped presets: no flag updates the values ----

SAMPLES = Path(__file__).parents[2] / "sample_logs"
#: Sideslip RMSE in degrees on sample logs with the shipped car: friction from the file, or from the user (sweep).
STRENGTH = {
    ("dlc", None): {"kinematic": 0.7728, "open-loop": 0.2991, "phy-ukf": 0.3721, "physics": 0.0609},
    ("road", None): {"kinematic": 1.8236, "open-loop": 0.1216, "phy-ukf": 0.1218, "physics": 0.0690},
    ("sweep", 0.3): {"kinematic": 0.5005, "open-loop": 0.4858, "phy-ukf": 0.6236, "physics": 0.0634},
}


@pytest.fixture(scope="module")
def car():
    return Car.load("saloon", network="none")


@pytest.fixture(scope="module", params=STRENGTH, ids=lambda key: key[0])
def sample_drive(car, request):
    name, friction = request.param
    options = RunConfig().read_options
    with read_drive(SAMPLES / f"{name}.mcap", car, None, replace(options, friction=friction or options.friction)) as d:
        return d.whole(), STRENGTH[request.param]


@pytest.mark.slow
def test_no_baseline_is_weaker_than_it_was(car, sample_drive):
    whole, strength = sample_drive
    assert whole.truth is not None
    for name, rmse_deg in strength.items():
        track = run_estimator(make_estimator(name, car), whole.signals)
        error = signal_error(track, whole.truth, "sideslip_rad", 3.0)
        found = math.degrees(math.sqrt(float(np.nanmean(error**2))))
        assert found <= 1.005 * rmse_deg, f"{name}: {found:.4f}"


_HYBRID = "adaptive-physics 3 (physics=vehicle-ukf, residual_noise=0.5, trust=0.75)"
#: Identity and digest of the presets on the shipped car. The digest covers noise, physics and network as well.
SHIPPED = {
    "zero": ("pass-through 1 (claims_zero_sideslip=True)", "bb9a4e4a0fd4"),
    "zero:no-lateral": ("pass-through 1 (claims_zero_sideslip=False)", "103764c41c2d"),
    "kinematic": ("kinematic 1", "8208c390e51c"),
    "open-loop": ("open-loop 1", "5afc5962fabb"),
    "linear-regression": ("linear-regression 1", "9de17837d3ad"),
    "phy-ukf": ("vehicle-ukf 1 (equations=nominal)", "cead32189ec2"),
    "physics": ("adaptive-physics 3 (physics=vehicle-ukf)", "2a61d9bedc99"),
    "phy-ukf:tuned": ("vehicle-ukf 1 (equations=nominal, roll_correction=True)", "2e213229f481"),
    "pure-lstm": ("direct-network 1", "4441758f4188"),
    "pd-hef": (_HYBRID, "32c5f2999d6e"),
    "pd-hef:fixed-r": ("adaptive-physics 3 (adaptive=False, physics=vehicle-ukf, trust=1.0)", "7db611b8f5e4"),
    "pd-hef-smoothed": (
        "smoothed-physics 3 (filtered=adaptive-physics, filtered.physics=vehicle-ukf, filtered.trust=0.75, "
        "filtered.version=3)",
        "69002a15a2ab",
    ),
    "pd-hef-paper": ("paper-hybrid-ukf 2", "87a835dda35a"),
}
#: Fields that are no option: names, texts, noise, physics and network.
ROLES = {"name", "causal", "notes", "vehicle", "network", "model", "q_std", "r_std", "use_speed"}


@pytest.fixture(scope="module")
def saloon():
    return Car.load("saloon")


def test_the_identities_of_the_shipped_presets_are_frozen(saloon):
    found = {name: resolve(make_estimator(name, saloon)) for name in all_names(saloon)}
    assert {name: (a.identity, a.sha256[:12]) for name, a in found.items()} == SHIPPED


def test_a_new_option_at_its_default_changes_no_identity(saloon):
    estimator = make_estimator("pd-hef", saloon)
    assert isinstance(estimator, AdaptivePhysics)
    kind = make_dataclass("VehicleUkf", [("probe", bool, False)], bases=(VehicleUkf,), frozen=True)
    kind.options = (*VehicleUkf.options, "probe")
    values = {f.name: getattr(estimator.physics, f.name) for f in fields(VehicleUkf)}
    assert resolve(replace(estimator, physics=kind(**values))) == resolve(estimator)
    changed = resolve(replace(estimator, physics=kind(**values, probe=True)))
    assert changed.identity == _HYBRID.replace("vehicle-ukf,", "vehicle-ukf, physics.probe=True,")
    kind.version = 2
    assert "physics.version=2" in resolve(replace(estimator, physics=kind(**values))).identity


@pytest.mark.parametrize("spec", SPECS, ids=lambda s: s.name)
def test_every_field_of_an_estimator_is_an_option_or_has_a_role(spec, saloon):
    if spec.missing(saloon):
        assert spec.name == "open-loop:calibrated"  # the class of open-loop
        return
    parts: list[Any] = [make_estimator(spec.name, saloon)]
    while parts:
        part = parts.pop()
        assert {f.name for f in fields(part)} <= {*getattr(part, "options", ()), *ROLES}, type(part).__name__
        parts += [p for name in getattr(part, "options", ()) if is_dataclass(p := getattr(part, name))]


def test_a_class_without_an_identity_is_refused():
    @dataclass(frozen=True)
    class Nameless:
        name: str = "nameless"
        causal: bool = True

    with pytest.raises(UsageError, match="version = 1 in class Nameless"):
        resolve(Nameless())
