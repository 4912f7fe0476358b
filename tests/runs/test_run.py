"""The whole way on sample logs: outputs, windows, slices, failures."""

import json
import re
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from pdhef_logtool import Car, ReadOptions, RunConfig, read_drive
from pdhef_logtool.car.toml_files import part_toml, read_vehicle_file
from pdhef_logtool.cli.run_tables import render_run
from pdhef_logtool.estimators.table import all_names
from pdhef_logtool.model import fit
from pdhef_logtool.model.drive_model import DriveModel, read_driving
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.reasons import STUCK_AY
from pdhef_logtool.results.parquet_sink import list_estimators, read_track
from pdhef_logtool.results.run_report import report_markdown
from pdhef_logtool.runs import selection
from pdhef_logtool.runs.fleet import run_logs
from tests.command_line import rendered
from tests.run_report import follows

pytestmark = pytest.mark.slow

TABLES = {"estimates.parquet", "metrics.parquet", "recording.rrd", "report.html", "report.json", "model.toml"}
OUTPUTS = TABLES | {"annotated.mcap", "foxglove.json", "plotjuggler.xml"}

NO_TRUTH_MAPPING = "".join(
    f'[signals.{signal}]\ntopic = "{topic}"\nfield = "{field}"\n'
    for signal, topic, field in (
        ("steer_rad", "/vehicle/status/steering_status", "steering_tire_angle"),
        ("ax_m_s2", "/imu/data", "linear_acceleration.x"),
        ("ay_m_s2", "/imu/data", "linear_acceleration.y"),
        ("yaw_rate_rad_s", "/imu/data", "angular_velocity.z"),
        ("wheel_speed_rl_m_s", "/vehicle/wheel_speeds", "rl_m_s"),
        ("wheel_speed_rr_m_s", "/vehicle/wheel_speeds", "rr_m_s"),
    )
)


def run(log: Path, out: Path, *, summary: bool = False, ends: int | None = None, **changes: Any) -> dict[str, Any]:
    """Run a log with its folder's vehicle file, and return its report; ``ends`` is the expected exit code."""
    values: dict[str, Any] = {"car": log.parent / "vehicle.toml", "keep": "estimates", "estimators": ("phy-ukf",)}
    result = run_logs([str(log)], out, RunConfig(**{**values, **changes}), report=summary)
    assert ends in (None, result.exit_code)
    return json.loads((out / "logs" / log.stem / "report.json").read_text())


def estimates(out: Path) -> pl.DataFrame:
    """Return the estimates of phy-ukf of the only log of a run."""
    (table,) = out.glob("logs/*/estimates.parquet")
    return pl.read_parquet(table).filter(pl.col("estimator") == "phy-ukf").drop("estimator")


@pytest.fixture(scope="module")
def dlc_run(sample_logs_dir, tmp_path_factory):
    out = tmp_path_factory.mktemp("dlc")
    run(sample_logs_dir / "dlc.mcap", out, keep="full", annotate="full", estimators=("all",), summary=True, ends=0)
    return out


def test_everything_that_a_run_promises_is_there_and_nothing_else(dlc_run):
    assert {p.name for p in (dlc_run / "logs" / "dlc").iterdir()} == OUTPUTS
    assert {p.name for p in dlc_run.iterdir()} == {
        "logs", "metrics.parquet", "report.html", "report.json", "run.json", "tables",
    }  # fmt: skip


def test_documents_follow_their_schemas(dlc_run, sample_logs_dir):
    report = json.loads((dlc_run / "logs/dlc/report.json").read_text())
    of_run = json.loads((dlc_run / "run.json").read_text())
    follows(report)
    follows(of_run, "run.schema.json")
    assert of_run["logs"][0]["outcome"] == "ok"
    assert [e["name"] for e in report["estimators"]] == list(all_names(Car.load(sample_logs_dir / "vehicle.toml")))


def test_same_input_gives_the_same_bytes(sample_logs_dir, tmp_path):
    options = {"keep": "full", "annotate": "full", "estimators": ("zero", "physics"), "end": "4", "summary": True}
    for folder in ("a", "b"):
        run(sample_logs_dir / "dlc.mcap", tmp_path / folder, **options)
    for name in ("run.json", "report.html", "metrics.parquet", *(f"logs/dlc/{n}" for n in OUTPUTS - {"recording.rrd"})):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name


def test_slice_scores_the_slice_alone(sample_logs_dir, tmp_path):
    report = run(sample_logs_dir / "dlc.mcap", tmp_path, start="2", end="end-3s")
    stamps = pl.read_parquet(tmp_path / "logs/dlc/estimates.parquet")["stamp_ns"]
    assert report["log"]["duration_s"] == pytest.approx(9.5 - 5.0, abs=0.1)
    assert report["log"]["start_ns"] - 20_000_000 <= stamps.min() <= stamps.max() < report["log"]["end_ns"]


def test_estimates_do_not_depend_on_whether_truth_is_mapped(sample_logs_dir, tmp_path, dlc_run):
    (tmp_path / "m.toml").write_text(NO_TRUTH_MAPPING)
    log = sample_logs_dir / "dlc.mcap"
    options = {"mapping": tmp_path / "m.toml", "estimators": ("kinematic", "phy-ukf")}
    assert run(log, tmp_path / "a", **options)["truth"]["available"] is False
    figures = set(pl.read_parquet(tmp_path / "a/metrics.parquet")["metric"])
    assert {"nis", "disagreement_rms", "nis_autocorrelation"} <= figures and "rmse" not in figures
    truth = '[truth.vy_m_s]\ntopic = "/truth/perfect/odometry"\nfield = "twist.twist.linear.y"\n'
    truth += '[truth.vx_m_s]\ntopic = "/truth/perfect/odometry"\nfield = "twist.twist.linear.x"\n'
    (tmp_path / "m.toml").write_text(NO_TRUTH_MAPPING + truth)
    assert run(log, tmp_path / "b", **options)["truth"]["available"]
    without, with_truth, four_wheels = (
        estimates(out).drop("x_m", "y_m", "yaw_rad") for out in (tmp_path / "a", tmp_path / "b", dlc_run)
    )
    assert without.equals(with_truth, null_equal=True)
    assert not without.equals(four_wheels, null_equal=True)  # four wheels are not two


def test_all_logs_bad_is_a_failure(sample_logs_dir, tmp_path):
    for name in ("a.mcap", "b.mcap"):
        (tmp_path / name).write_bytes(b"no log")
    config = RunConfig(car=sample_logs_dir / "vehicle.toml", keep="estimates")
    assert run_logs([str(tmp_path)], tmp_path / "out", config).exit_code == 1
    with pytest.raises(LogError):
        run_logs([str(tmp_path / "a.mcap")], tmp_path / "out1", config)


def test_what_ran_under_a_name_stands_in_every_record(dlc_run):
    from mcap.reader import make_reader

    folder = dlc_run / "logs" / "dlc"
    told = {e["name"]: e["algorithm"] for e in json.loads((folder / "report.json").read_text())["estimators"]}
    assert None not in told.values()
    assert told["phy-ukf"]["algorithm"] == "vehicle-ukf"
    for metrics in (dlc_run / "metrics.parquet", folder / "metrics.parquet"):
        rows = pl.read_parquet(metrics).select("estimator", "algorithm").unique()
        of = {name: digest for name, digest in rows.iter_rows() if name in told}
        assert of == {name: told[name]["sha256"][:12] for name in of}
        assert {"phy-ukf", "pd-hef"} <= of.keys()
    with (folder / "annotated.mcap").open("rb") as stream:
        (record,) = [m.metadata for m in make_reader(stream).iter_metadata() if m.name == "pdhef.metrics"]
    assert {n: json.loads(record[f"{n}/algorithm"]) for n in told} == told


#: The road of the drives with this vehicle file.
SLIPPERY = 0.3

TOLD = """fill_recognised = true
[signals.friction]
topic = "/truth/perfect/state"
field = "friction"
"""


@pytest.fixture(scope="module")
def files(sample_logs_dir, tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    vehicle = read_vehicle_file(sample_logs_dir / "vehicle.toml").vehicle.model_copy(update={"friction": None})
    (folder / "car.toml").write_text(part_toml(vehicle))
    (folder / "told.toml").write_text(TOLD)
    return folder


@pytest.mark.parametrize(
    ("choice", "with_topic", "car", "source", "value"),
    [
        ("auto", True, "sample", "topic", SLIPPERY),
        ("auto", False, "sample", "vehicle file", 0.85),
        ("file", True, "sample", "vehicle file", 0.85),
        (0.5, False, "car", "option", 0.5),
        ("auto", False, "car", "no value given", 1.0),
        ("auto", False, None, "default sedan", 0.85),
    ],
)
def test_what_is_asked_for_is_told_to_the_estimators(
    choice, with_topic, car, source, value, files, sample_logs_dir, tmp_path
):
    file = {"sample": sample_logs_dir / "vehicle.toml", "car": files / "car.toml", None: None}[car]
    mapping = files / "told.toml" if with_topic else None
    options = {"car": file, "mapping": mapping, "network": Path("none"), "friction": choice, "end": "+3s"}
    report = run(sample_logs_dir / "sweep.mcap", tmp_path, **options)
    assert report["friction"]["source"] == source
    assert report["friction"]["given"] is (source not in ("no value given", "default sedan"))
    assert report["friction"]["topic"] == ("/truth/perfect/state.friction" if source == "topic" else None)
    friction = estimates(tmp_path)["friction"].drop_nulls().drop_nans().to_numpy()
    assert friction.size
    np.testing.assert_allclose(friction, value, atol=1e-6)


#: Planted faults, s from the start.
FAULTS = {("yaw_rate_rad_s", "burst"): (5.0, 8.0), ("ay_m_s2", "stuck"): (12.0, 14.0)}
START_S, END_S = FAULTS["ay_m_s2", "stuck"]


@pytest.fixture(scope="module")
def result(sample_logs_dir, tmp_path_factory):
    config = RunConfig(car=Path("saloon"), estimators=("phy-ukf", "pd-hef"), keep="estimates", end="20")
    return run_logs([str(sample_logs_dir / "faults.mcap")], tmp_path_factory.mktemp("out"), config, report=False)


@pytest.fixture(scope="module")
def report(result):
    document = json.loads((Path(str(result.place)) / "logs/faults/report.json").read_text())
    follows(document)
    return dict(document)


def told(text: str) -> tuple[float, float]:
    found = re.search(r"a_y stuck (\d+\.\d)-(\d+\.\d) s", text)
    assert found, text
    return float(found[1]), float(found[2])


def test_the_report_names_the_faults_with_their_times(report):
    assert report["plan"] is None  # nobody gave one, and one drive decides little
    start_ns = report["log"]["start_ns"]
    spans = [((f["sensor"], f["kind"]), i) for f in report["faults"] for i in f["intervals"]]
    found = {name: ((i["start_ns"] - start_ns) * 1e-9, (i["end_ns"] - start_ns) * 1e-9) for name, i in spans}
    assert found == {fault: pytest.approx(times, abs=0.7) for fault, times in FAULTS.items()}
    # It is reported after it has lasted for 0.05 s.
    assert told(report_markdown(report)) == pytest.approx((START_S, END_S), abs=0.11)


def test_the_track_has_the_bit_where_the_sensor_stuck_and_nowhere_else(result, report):
    track = read_track(Path(str(result.place)) / "logs/faults/estimates.parquet", "pd-hef")
    times = (track.stamps_ns - report["log"]["start_ns"]) * 1e-9
    stuck = track.reason & STUCK_AY > 0
    assert stuck[(times > START_S + 0.1) & (times < END_S - 0.05)].all()
    assert not stuck[(times < START_S) | (times > END_S + 0.1)].any()
    assert np.isfinite(track.mixture_weight[track.valid]).all()


def test_the_terminal_says_it_in_one_line(result):
    (line,) = [one for one in rendered(render_run, result, 200).splitlines() if "a_y stuck" in one]
    assert line.strip().startswith("faults of the sensors: ")
    assert told(line) == pytest.approx((START_S, END_S), abs=0.11)


REFERENCE = Path(__file__).resolve().parents[1] / "reference"


MAPPING, CAR = (REFERENCE / folder / "revs_250lm.toml" for folder in ("mappings", "vehicles"))
RACE = {"mapping": MAPPING, "car": CAR, "model": "off", "end": "200"}


@pytest.fixture(scope="module")
def sound(shared_dir, tmp_path_factory):
    out = tmp_path_factory.mktemp("intact")
    run(shared_dir / "data/drives/revs_250lm_a.mcap", out, **RACE)
    return estimates(out)


#: First loss and end of the last gap, s from the first stamp, by file (README of the faulty drives).
FAULTY = {"revs_250lm_a_flipped_byte.mcap": (146.2, 154.8), "revs_250lm_a_disorder.mcap": (9.2, 165.0)}


@pytest.mark.parametrize("name", FAULTY)
def test_damage_costs_what_it_hit_and_nothing_else(shared_dir, tmp_path, sound, name):
    report = run(shared_dir / "data/drives/faulty" / name, tmp_path, ends=3, **RACE)
    hurt = estimates(tmp_path)
    first_loss_s, last_gap_s = FAULTY[name]
    elapsed = (pl.col("stamp_ns") - sound["stamp_ns"].min()) / 1e9
    before = elapsed < first_loss_s - 0.05
    assert hurt.filter(before).equals(sound.filter(before), null_equal=True)
    both = hurt.join(sound, on="stamp_ns").filter(elapsed >= last_gap_s + 5.0)
    # Single samples that are lost: NaN, and stamps that hide those of the samples.
    faults = json.loads((shared_dir / "data/drives/faulty/faults.json").read_text())[name]
    lost = [n["stamp_s"] for n in faults.get("nan", ())]
    lost += [row / 100.0 for row in faults.get("stamp_equals_previous", {"rows": ()})["rows"]]
    for lost_s in lost:
        both = both.filter((elapsed < lost_s) | (elapsed >= lost_s + 5.0))
    assert both.height > 2_000
    difference_deg = np.degrees(np.abs((both["sideslip_rad"] - both["sideslip_rad_right"]).to_numpy()))
    # A sample at the very edge of the 6-sigma gate may be taken in one run and refused in the other: a tail that
    # is 1e-4 degrees long by then decides it, and some hundredths of a second show it.
    assert np.mean(difference_deg >= 0.01) < 0.0005
    assert np.nanmax(difference_deg) < 0.02
    start_ns = report["log"]["start_ns"]
    lost = [x for x in report["losses"] if x["kind"] == "gap"]
    gaps = {x["where"]: (x["start_ns"] - start_ns, x["end_ns"] - start_ns) for x in lost}
    if "disorder" in name:  # its IMU is silent for half a minute
        assert np.divide(gaps["/imu/data.angular_velocity.z"], 1e9) == pytest.approx([135.0, 165.0], abs=0.05)
        assert all(where.startswith("/imu/data") for where in gaps)


#: End of the part of the road drive that suffices for a calibration.
END = "110"
NAMES = ("zero", "open-loop", "open-loop:calibrated", "phy-ukf", "physics")


@pytest.fixture(scope="module")
def wrong_car(bare_vehicle, tmp_path_factory):
    """Return a bare vehicle file of the sample logs' car with half the front axle stiffness."""
    path = tmp_path_factory.mktemp("car") / "vehicle.toml"
    path.write_text(bare_vehicle.replace("B = 11.146", "B = 5.6"))
    return path


@pytest.fixture(scope="module")
def calibrated(sample_logs_dir, wrong_car, tmp_path_factory):
    out = tmp_path_factory.mktemp("log")
    run(sample_logs_dir / "road.mcap", out, car=wrong_car, estimators=NAMES, end=END)
    return out


def causal_rows(folder: Path) -> dict[object, pl.Series]:
    """Return the column ``causal`` of estimates.parquet by estimator."""
    rows = pl.read_parquet(folder / "estimates.parquet").with_columns(pl.col("estimator").cast(pl.String))
    return {name: part["causal"] for (name,), part in rows.group_by("estimator", maintain_order=True)}


def rmse(out: Path, estimator: str) -> float:
    chosen = {"estimator": estimator, "signal": "sideslip_rad", "metric": "rmse", "segment": "all"}
    return float(pl.read_parquet(out / "metrics.parquet").filter(**chosen)["value"].item())


def test_calibrated_estimators_are_not_causal_and_say_so_and_the_others_keep_the_file(calibrated):
    report = json.loads((calibrated / "logs/road/report.json").read_text())
    follows(report)
    told = {e["name"]: e for e in report["estimators"]}
    for name in ("physics", "open-loop:calibrated"):
        assert not told[name]["causal"]
        assert any("whole log" in note for note in told[name]["notes"])
    assert all(told[name]["causal"] for name in ("zero", "open-loop", "phy-ukf"))
    assert told["phy-ukf"]["algorithm"]["physics_sha256"] == report["vehicle"]["sha256"]
    assert told["physics"]["algorithm"]["physics_sha256"] != report["vehicle"]["sha256"]
    assert "calibrated on this log without ground truth" in report["answer"]["texts"]["assumed"]
    assert told["physics"]["intervals"] == ["intervals: own, parameters and sensors"]
    assert told["open-loop:calibrated"]["intervals"] == []
    assert not causal_rows(calibrated / "logs/road")["zero"].any(), "settings and model are those of the whole log"


def test_a_wrong_file_is_mended(calibrated):
    assert rmse(calibrated, "physics") < 0.65 * rmse(calibrated, "phy-ukf")


def test_off_is_the_prior_about_the_file_and_causal(sample_logs_dir, wrong_car, tmp_path):
    options = {"car": wrong_car, "model": "off", "end": "30", "estimators": NAMES[:2]}
    report = run(sample_logs_dir / "road.mcap", tmp_path, **options)
    assert (report["self_calibration"]["parameters"], report["self_calibration"]["refused"]) == ([], None)
    assert all(e["causal"] for e in report["estimators"])


def test_a_model_of_an_earlier_drive_is_causal_and_mends_the_file(sample_logs_dir, wrong_car, calibrated, tmp_path):
    model = calibrated / "logs/road/model.toml"
    report = run(sample_logs_dir / "dlc.mcap", tmp_path, car=wrong_car, model=model, estimators=NAMES)
    follows(report)
    assert all(e["causal"] for e in report["estimators"] if e["name"] != "open-loop:calibrated")
    assert report["model"]["source"] == "file"
    causal = causal_rows(tmp_path / "logs/dlc")
    assert causal["zero"][100:].all() and causal["truth"].is_null().all()
    assert not causal["open-loop:calibrated"].any() and causal["selected"].equals(causal["physics"])
    assert "from earlier drives" in report["answer"]["texts"]["assumed"]
    assert rmse(tmp_path, "physics") < 0.65 * rmse(tmp_path, "phy-ukf")
    passed_on = tomllib.loads((tmp_path / "logs/dlc/model.toml").read_text())
    assert passed_on["parameters"] == tomllib.loads(model.read_text())["parameters"] != []


def test_no_truth_is_read(sample_logs_dir, wrong_car):
    """The same log with its truth made unreadable gives the same bits."""
    log, car, options = sample_logs_dir / "road.mcap", Car.load(wrong_car), ReadOptions(end=END)
    with read_drive(log, car, options=options) as drive:
        found = read_driving(drive)
        with_truth = DriveModel.fit(drive).posterior
    with read_drive(log, car, options=options, adjust=lambda _log, mapping, _tell: replace(mapping, truth={})) as drive:
        assert drive.plan.truth is None
        np.testing.assert_array_equal(read_driving(drive).columns, found.columns)
        alone = DriveModel.fit(drive).posterior
    assert alone.to_dict() == with_truth.to_dict()


def test_a_short_log_is_refused_and_the_file_stays(sample_logs_dir, wrong_car, tmp_path):
    report = run(sample_logs_dir / "sweep.mcap", tmp_path, car=wrong_car, estimators=NAMES, end="4")
    assert "are needed" in report["self_calibration"]["refused"]
    told = {e["name"]: e for e in report["estimators"]}
    assert told["open-loop:calibrated"]["outcome"] == "skipped"
    assert "not calibrated on this log" in report["answer"]["texts"]["assumed"]


@pytest.mark.parametrize("given", [None, 0.8])
def test_a_car_that_slides_has_the_friction_that_it_reaches_if_none_is_given(
    sample_logs_dir, wrong_car, tmp_path, monkeypatch, given
):
    monkeypatch.setattr(fit, "SLIDING_RAD", 0.001)
    car = tmp_path / "vehicle.toml"
    car.write_text("\n".join(x for x in wrong_car.read_text().splitlines() if not x.startswith("friction =")))
    options = {"car": car, "estimators": ("phy-ukf", "physics"), "end": END, "friction": given or "auto"}
    report = run(sample_logs_dir / "sweep.mcap", tmp_path, **options)
    assert "slides" in report["self_calibration"]["refused"]
    causal = {e["name"]: e["causal"] for e in report["estimators"]}
    assert (causal["phy-ukf"], causal["physics"]) == (True, given is not None)
    assert report["friction"]["source"] == ("largest lateral acceleration" if given is None else "option")
    if given is None:  # a drive has one model, however often it is fitted
        with read_drive(sample_logs_dir / "sweep.mcap", Car.load(car), options=ReadOptions(end=END)) as drive:
            first, again = DriveModel.fit(drive), DriveModel.fit(drive)
        assert first.friction == again.friction and first.friction.to_dict() == report["friction"]
        assert first.car.self_calibrated is not None and again.car.self_calibrated is not None


def test_a_car_with_evidence_is_not_calibrated(sample_logs_dir):
    with read_drive(sample_logs_dir / "road.mcap", Car.load(sample_logs_dir / "vehicle.toml")) as drive:
        assert drive.car.has_evidence
        assert DriveModel.fit(drive).posterior is None


def test_an_estimate_that_contradicts_the_sensors_is_not_selected_and_keeps_its_name(
    sample_logs_dir, wrong_car, tmp_path, monkeypatch
):
    """Whatever pd-hef is on this car, it stands for a large d2 here."""
    if Car.load().network is None:
        pytest.skip("no network is shipped, without which there is no pd-hef")
    monkeypatch.setattr(selection, "FACTOR", 0.0)
    names = ("zero", "phy-ukf", "pd-hef", "physics")
    report = run(sample_logs_dir / "sweep.mcap", tmp_path, car=wrong_car, estimators=names)
    follows(report)
    assert any(w.startswith("WARNING: pd-hef contradicts the sensors") for w in report["warnings"])
    assert report["selected_estimate"] == "physics"
    file = tmp_path / "logs" / "sweep" / "estimates.parquet"
    assert list_estimators(file) == ("truth", *names)
    selected, named, other = (read_track(file, name) for name in ("selected", "physics", "pd-hef"))
    np.testing.assert_array_equal(selected.sideslip_rad, named.sideslip_rad)
    assert (selected.sideslip_rad != other.sideslip_rad).any()
