"""Recorders and runs: a folder of mappings serves several; a file of several runs needs a choice; recorded drives."""

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.table_file import TableSettings
from pdhef_logtool.mapping import Mapping, SignalSource, auto_map, clock_key, fit_clocks, load_mapping, mapping_to_toml
from pdhef_logtool.mapping.choosing import choose_mapping
from pdhef_logtool.mapping.clocks import apply_clock
from pdhef_logtool.records.errors import MappingError, MappingFileError
from tests.command_line import called
from tests.fake_drive_log import FakeLog, FakeTopic
from tests.runs.test_inspection_report import car, write_log

STAMPS = list(range(0, 10**9, 10**7))
A = '[signals.yaw_rate_rad_s]\ntopic = "/imu"\nfield = "wz"\n'
B = '[signals.yaw_rate_rad_s]\ntopic = "/gyro"\nfield = "z"\nscale = 0.01\n'
WIDE = A + '[signals.speed_m_s]\ntopic = "/speed"\nfield = "v"\n'


def log_of(**fields: tuple[str, str]) -> FakeLog:
    stamps = np.array(STAMPS, dtype=np.int64)
    return FakeLog({f"/{t}": FakeTopic(kind, stamps, {name: stamps * 1e-9}) for t, (name, kind) in fields.items()})


def folder_of(tmp_path: Path, **files: str) -> Path:
    folder = tmp_path / "mappings"
    folder.mkdir()
    for name, text in files.items():
        (folder / f"{name}.toml").write_text(text)
    return folder


def chosen(log: FakeLog, folder: Path) -> str:
    found = choose_mapping(log, load_mapping(folder), prefer_truth="perfect")
    assert found.mapping.notes == (f"mapping {found.mapping.file}: it is for this recorder",)
    return found.mapping.file


def test_the_topics_and_fields_of_a_log_choose(tmp_path):
    folder = folder_of(tmp_path, a=A, b=B, wide=WIDE)
    assert chosen(log_of(gyro=("z", "x/Gyro")), folder) == "b.toml"
    assert chosen(log_of(imu=("wz", "x/Imu")), folder) == "a.toml"
    # It contains all that another one reads, and more.
    assert chosen(log_of(imu=("wz", "x/Imu"), speed=("v", "x/Speed")), folder) == "wide.toml"


def test_none_and_several_are_one_clear_line(tmp_path):
    folder = folder_of(tmp_path, a=A, b=B)
    with pytest.raises(MappingError) as none:
        chosen(log_of(imu=("gyro_z", "x/Imu")), folder)
    assert "a.toml: yaw_rate_rad_s: /imu has no field wz" in str(none.value)
    assert "b.toml: yaw_rate_rad_s: no topic /gyro" in str(none.value)
    assert "--write-mapping" in str(none.value)
    with pytest.raises(MappingError, match=r"2 \(a\.toml, b\.toml\)") as several:
        chosen(log_of(imu=("wz", "x/Imu"), gyro=("z", "x/Gyro")), folder)
    assert "[recorder]" in str(several.value)
    assert "\n" not in str(several.value)


def test_types_decide_between_logs_of_equal_topics(tmp_path):
    old = '[recorder]\n"/imu" = "x/msg/Imu"\n' + A
    new = '[recorder]\n"/imu" = "y/Imu"\n' + A + "scale = 0.0174\n"
    folder = folder_of(tmp_path, old=old, new=new)
    assert chosen(log_of(imu=("wz", "x/Imu")), folder) == "old.toml"
    assert chosen(log_of(imu=("wz", "y/msg/Imu")), folder) == "new.toml"
    with pytest.raises(MappingError, match="/imu is z/Imu, not y/Imu"):
        chosen(log_of(imu=("wz", "z/Imu")), folder)
    # One file alone with a rule is refused on another recorder's log; it is written as it was read.
    mapping = load_mapping(folder / "old.toml")
    with pytest.raises(MappingError, match=r"a log of the recorder that old\.toml is for, got /imu is y/Imu"):
        choose_mapping(log_of(imu=("wz", "y/Imu")), mapping, prefer_truth="perfect")
    (tmp_path / "again.toml").write_text(mapping_to_toml(mapping))
    assert load_mapping(tmp_path / "again.toml") == mapping


def test_wrong_rules_and_empty_folders_are_refused(tmp_path):
    (tmp_path / "m.toml").write_text('[recorder]\n"/imu" = 3\n')
    with pytest.raises(MappingFileError, match=r"recorder\./imu: should be a valid string"):
        load_mapping(tmp_path / "m.toml")
    (tmp_path / "none").mkdir()
    with pytest.raises(MappingFileError, match="none in the folder"):
        load_mapping(tmp_path / "none")


def test_a_fleet_of_two_recorders_is_run_with_one_folder(tmp_path):
    folder, logs = tmp_path / "mappings", tmp_path / "logs"
    folder.mkdir()
    logs.mkdir()
    for name, topic in (("first", "/car"), ("second", "/vehicle")):
        log = write_log(logs / f"{name}.mcap", {topic: car()})
        assert called("inspect", log, "--write-mapping", folder / f"{name}.toml").returncode == 0
    options = ("-e", "kinematic", "--model", "off", "--annotate", "none")
    result = called("run", logs, "-o", tmp_path / "out", "--mapping", folder, *options)
    assert result.returncode == 0, result.stderr
    for name in ("first", "second"):
        report = (tmp_path / "out" / "logs" / name / "report.json").read_text()
        assert f"mapping {name}.toml: it is for this recorder" in report
    failed = called("run", logs / "first.mcap", "-o", tmp_path / "other", "--mapping", folder / "second.toml")
    assert failed.returncode == 1
    assert "no topic /vehicle" in failed.stderr


S = np.arange(0.0, 30.0, 0.01)


def write(path: Path, *runs: str) -> Path:
    scipy_io = pytest.importorskip("scipy.io")
    rate = 0.2 * np.sin(S)
    imu = {"time": S, "ax": np.cos(S), "ay": 15.0 * rate, "yaw_rate": rate}
    car = {"time": S, "steering_angle": 0.1 * np.sin(S), "vehicle_speed": 15.0 + 0.0 * S}
    scipy_io.savemat(path, {run: {"imu": imu, "car": car} for run in runs})
    return path


def test_a_choice_between_runs_is_asked_for(tmp_path):
    path = write(tmp_path / "runs.mat", "run_1", "run_2")
    with closing(open_log(path)) as log:
        with pytest.raises(MappingError, match=r"2 runs: run_1, run_2.*--set group=run_1"):
            choose_mapping(log, None, prefer_truth="perfect")
        auto = auto_map(log)
    assert {s.topic for s in auto.mapping.sources()} == {"run_1_imu", "run_1_car"}
    assert [(a.subject, a.candidates) for a in auto.ambiguities] == [("run", ("run_1", "run_2"))]
    with closing(open_log(path, settings=TableSettings(group="run_2"))) as log:
        chosen = choose_mapping(log, None, prefer_truth="perfect")
        assert {s.topic for s in chosen.mapping.sources()} == {"run_2_imu", "run_2_car"}


@pytest.mark.parametrize("start_s", [0.0, 100.0])
def test_repeated_channel_groups_of_an_mdf_are_runs_if_one_follows_the_other(start_s, tmp_path):
    asammdf = pytest.importorskip("asammdf")
    mdf = asammdf.MDF(version="4.10")
    rate = 0.2 * np.sin(S)
    columns = {
        "ax": np.cos(S), "ay": 15.0 * rate, "yaw_rate": rate, "steering_angle": 0.1 * np.sin(S), "speed": 15.0 + S,
    }  # fmt: skip
    for start in (0.0, start_s):
        mdf.append([asammdf.Signal(v, S + start, name=n) for n, v in columns.items()], acq_name="Fast", comment="Fast")
    path = mdf.save(tmp_path / "a.mf4")
    mdf.close()
    with closing(open_log(path)) as log:
        assert [t.name for t in log.topics] == ["Fast", "Fast_2"]
        runs = [a.candidates for a in auto_map(log).ambiguities if a.subject == "run"]
    assert runs == ([("1", "2")] if start_s else [])
    for group, name in (("1", "Fast"), ("2", "Fast_2")):
        with closing(open_log(path, settings=TableSettings(group=group))) as log:
            assert [t.name for t in log.topics] == [name]


def test_phone_clock_is_found_from_log_times(shared_dir):
    path = shared_dir / "data" / "drives" / "comma2k19_segment.mcap"
    log = open_log(path)
    source = SignalSource(
        "yaw_rate_rad_s", "/imu", "gyro[2]", stamp="t", stamp_unit="s", clock="device", latency_s=0.002
    )
    clock = fit_clocks(log, Mapping(signals={source.name: source}), log.start_ns, log.end_ns)[clock_key(source)]
    columns = log.read({"/imu": ["t"]})["/imu"]
    found = apply_clock(np.rint(columns.fields["t"] * 1e9).astype(np.int64), clock) - 2_000_000
    # The publish time is the sample's time in UTC, which the fit has not seen.
    assert np.abs(found - columns.publish_time_ns).max() < 200_000
    log.close()


def test_a_file_may_name_one_signal_and_leave_the_rest_to_recognised_types(tmp_path):
    text = '[signals.friction]\ntopic = "/truth/perfect/state"\nfield = "friction"\n'
    log_path = next(Path("sample_logs").glob("dlc*.mcap"))
    log = open_log(log_path)
    recognised = auto_map(log).mapping
    for filled in (False, True):
        (tmp_path / "mapping.toml").write_text(("fill_recognised = true\n" if filled else "") + text)
        chosen = choose_mapping(log, load_mapping(tmp_path / "mapping.toml"), prefer_truth="perfect")
        mapping, missing = chosen.mapping, chosen.missing
        assert len(chosen.mapping.notes) == filled  # which truth it is
        assert chosen.ambiguities == ()
        assert mapping.signals["friction"].topic == "/truth/perfect/state"
        others = {n: s for n, s in mapping.signals.items() if n != "friction"}
        assert others == ({n: s for n, s in recognised.signals.items() if n != "friction"} if filled else {})
        assert mapping.truth == (recognised.truth if filled else {})
        assert ("yaw_rate_rad_s" in missing) is not filled
    log.close()
