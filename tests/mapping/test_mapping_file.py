"""mapping.toml: strict reading, all problems at once, and writing that loads back."""

import math
import string
from contextlib import closing
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from pdhef_logtool import mapping as mappings
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.table_file import TableSettings
from pdhef_logtool.mapping import (
    Mapping,
    QualityGate,
    SignalSource,
    auto_map,
    check_mapping,
    clock_key,
    fit_clocks,
    load_mapping,
    mapping_to_toml,
)
from pdhef_logtool.mapping.choosing import choose_mapping
from pdhef_logtool.mapping.clocks import apply_clock
from pdhef_logtool.mapping.estimates import choose_estimates, sources_of
from pdhef_logtool.mapping.records import VECTOR_COLUMNS
from pdhef_logtool.records.errors import MappingError, MappingFileError
from pdhef_logtool.records.signals import ESTIMATE_UNITS, SIGNAL_UNITS, TRUTH_UNITS, Loss
from tests.command_line import called
from tests.fake_drive_log import FakeLog, FakeTopic
from tests.runs.test_inspection_report import car, write_log

FORMATS = Path(__file__).parents[2] / "docs/formats.md"


def load_text(tmp_path: Path, text: str) -> Mapping:
    path = tmp_path / "mapping.toml"
    path.write_text(text, encoding="utf-8")
    return load_mapping(path)


def test_the_documented_example_loads(tmp_path):
    mapping = load_text(tmp_path, FORMATS.read_text("utf-8").partition("```toml\n")[2].partition("```")[0])
    assert mapping.signals["steer_rad"] == SignalSource(
        "steer_rad", "/vehicle/status/steering_status", "steering_tire_angle", "stamp", valid_min=-1.0, valid_max=1.0
    )
    assert mapping.truth["vy_m_s"].field == "twist.twist.linear.y"
    assert mapping.quality == QualityGate(topic="/ins/status", field="fix", values=(4.0,))
    assert (mapping.origin, mapping.rate_hz, [*mapping.estimates]) == ("file", 100.0, ["esc"])
    with pytest.raises(MappingError, match="no such file"):
        load_mapping(tmp_path / "none.toml")


@pytest.mark.parametrize(
    ("signal", "unit", "scale"),
    [
        ("steer_rad", "deg", math.pi / 180.0),
        ("yaw_rate_rad_s", "°/s", math.pi / 180.0),
        ("yaw_rate_rad_s", "deg/s", math.pi / 180.0),
        ("ay_m_s2", "g", 9.80665),
        ("ay_m_s2", "m/s²", 1.0),
        ("speed_m_s", "km/h", 1.0 / 3.6),
        ("wheel_speed_fl_rad_s", "rpm", math.pi / 30.0),
    ],
)
def test_a_unit_states_the_scale(tmp_path, signal, unit, scale):
    entry = f'[signals.{signal}]\ntopic = "/x"\nfield = "y"\nunit = "{unit}"\n'
    assert load_text(tmp_path, entry).signals[signal].scale == pytest.approx(scale)
    assert load_text(tmp_path, f"{entry}scale = -1.0\n").signals[signal].scale == pytest.approx(-scale)
    with pytest.raises(MappingError, match="give unit or scale, not both"):
        load_text(tmp_path, f"{entry}scale = 0.5\n")
    with pytest.raises(MappingError, match=f'{signal}: unit = "furlong" is unknown for .*, known are '):
        load_text(tmp_path, entry.replace(f'"{unit}"', '"furlong"'))


def test_all_problems_come_in_one_line(tmp_path):
    text = """
    signal.speed_m_s = {topic = "/s", field = "v"}
    [signals]
    yaw_rate_rads = {topic = "/imu", field = "z"}
    vy_m_s = {topic = "/imu", field = "y"}
    ax_m_s2 = {topic = "/imu", fields = "x", scale = "9.81"}
    ay_m_s2 = {topic = "/imu", field = "y", scale = 0.0, stamp_unit = "hours"}
    """
    with pytest.raises(MappingError) as caught:
        load_text(tmp_path, text)
    line = str(caught.value)
    assert "\n" not in line
    for part in (
        "signals.yaw_rate_rads: unknown, did you mean signals.yaw_rate_rad_s?",
        "signals.vy_m_s: belongs under [truth.vy_m_s]",
        "signals.ax_m_s2.field: is missing",
        "signals.ax_m_s2.fields: unknown, did you mean signals.ax_m_s2.field?",
        "signals.ax_m_s2.scale: ",
        "signals.ay_m_s2.stamp_unit: ",
        "signal: unknown, did you mean signals?",
    ):
        assert part in line, part


X, Y, UNIT = '\ntopic="/a"\nfield="x"', '\ntopic="/a"\nfield="y"', '\nstamp="t"\nstamp_unit'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (f"[signals.steer_rad]{X}\n[signals.steering_wheel_rad]{Y}", ".steer_rad and signals.steering_wheel_rad"),
        ('[signals.ax_m_s2]\ntopic="/a"\nfield="x"\n[signals.ay_m_s2]\ntopic="/a"\nfield="x"', "duplicates"),
        ('[signals.ax_m_s2]\ntopic="/a"\nfield="x"\n[signals.ax_m_s2]\ntopic="/a"\nfield="y"', "ax_m_s2"),
        ('[signals.ax_m_s2]\ntopic="/a"\nfield="x"\nscale=[1.0,1.0]', "no vector"),
        ('[truth.ecef_position_m]\ntopic="/a"\nfield="x"\nscale=[1.0,1.0]', "must have 3 entries"),
        ('[signals.ax_m_s2]\ntopic="/a"\nfield="x"\nscale=nan', "finite"),
        ('[signals.ax_m_s2]\ntopic="/a"\nfield="x"\nvalid_min=2\nvalid_max=1', "valid_min must be below valid_max"),
        ('[signals.ax_m_s2]\ntopic="/a"\nfield="x"\nclock="device"\nstamp="log_time"', "needs a stamp of the device"),
        ('[truth_quality]\ntopic="/a"\nfield="x"', "give min, max or values"),
        (f'[signals.ax_m_s2]{X}{UNIT}="s"\n[signals.ay_m_s2]{Y}{UNIT}="ns"', "another stamp_unit"),
        ('[signals.speed_m_s]\ntopic="/c"\nfield="can:A.b"', "needs [can]"),
        ('[can]\ndbc="a.dbc"\n[signals.speed_m_s]\ntopic="/c"\nfield="can:A"', "can:<message>.<signal>"),
        ("[can]\ndbc = []", "can: dbc should name at least one file"),
        ('[can]\ndbcs = "a.dbc"', "did you mean can.dbc?"),
        ('[can]\ndbc = "a.dbc"\nbus = 1', "belong together"),
        ('[can]\ndbc="a.dbc"\n[truth.quat_wxyz]\ntopic="/c"\nfield="can:A.b"', "is a vector"),
        ('[estimates.a.sideslip]\ntopic="/a"\nfield="b"', "did you mean estimates.a.sideslip_rad?"),
        ('[estimates.sideslip_rad]\ntopic="/a"\nfield="b"', "[estimates.NAME.sideslip_rad]"),
        ('[estimates.truth.vx_m_s]\ntopic="/a"\nfield="b"', "may not be called 'truth'"),
        ('[estimates.a.vx_m_s]\ntopic="/a"\nfeld="b"', "feld: unknown, did you mean estimates.a.vx_m_s.field?"),
        ("estimates = 3", "estimates: should be a table, got 3"),
        ("signals = 3", "signals: should be a table, got 3"),
        ("not toml", "mapping TOML"),
    ],
)
def test_contradictions_are_named(tmp_path, text, said):
    with pytest.raises(MappingError) as caught:
        load_text(tmp_path, text)
    assert said in str(caught.value)


texts = st.text(
    st.characters(exclude_categories=["Cs"]) | st.sampled_from(string.printable + '"\\\x7f'), min_size=1, max_size=12
)
numbers = st.floats(allow_nan=False, allow_infinity=False)
nonzero = numbers.filter(lambda x: x != 0.0)


LIMITS = st.none() | numbers


def sources(names: list[str], prefix: str) -> st.SearchStrategy[dict[str, SignalSource]]:
    """Return sources by name, each of its own topic: contradictions of fields and clocks are tested above."""

    def source(name: str) -> st.SearchStrategy[SignalSource]:
        width = VECTOR_COLUMNS.get(name, 1)

        def entries(element: st.SearchStrategy[object]) -> st.SearchStrategy[object]:
            return element if width == 1 else element | st.tuples(*[element] * width)

        built = st.builds(
            SignalSource, st.just(name), texts.map(lambda text: f"/{prefix}{name}{text}"), entries(texts), texts,
            entries(nonzero), entries(numbers), numbers, LIMITS, LIMITS,
            st.sampled_from(["ros", "s", "ms", "us", "ns"]), st.sampled_from(["utc", "device"]),
        )  # fmt: skip
        return built.filter(lambda s: None in (s.valid_min, s.valid_max) or s.valid_min < s.valid_max)

    return st.fixed_dictionaries({}, optional={name: source(name) for name in names})


EXCLUSIVE = {"steering_wheel_rad"} | {n for n in SIGNAL_UNITS if n.endswith("rad_s") and n.startswith("wheel")}
GATES = st.builds(
    QualityGate, texts.map(lambda text: f"/gate{text}"), texts, min=st.sampled_from([None, -1.5]),
    max=st.sampled_from([None, 4.0]), values=st.lists(numbers, min_size=1, max_size=3).map(tuple), stamp=texts,
    latency_s=numbers,
)  # fmt: skip
SIGNALS, TRUTHS = sources(sorted(set(SIGNAL_UNITS) - EXCLUSIVE), "s"), sources(sorted(TRUTH_UNITS), "t")
REST = {"quality": st.none() | GATES, "origin": st.just("file"), "notes": st.just(())}
MAPPINGS = st.builds(Mapping, signals=SIGNALS, truth=TRUTHS, **REST)


@pytest.mark.slow
@settings(max_examples=30, deadline=None, derandomize=True)
@given(mapping=MAPPINGS, comment=texts)
def test_what_is_written_loads_back(tmp_path_factory, mapping, comment):
    text = mapping_to_toml(mapping, comments={"": comment, "ax_m_s2": comment, "vx_m_s": comment})
    path = tmp_path_factory.mktemp("toml") / "m.toml"
    path.write_text(text, encoding="utf-8", newline="")
    assert load_mapping(path) == mapping


def test_missing_signals_stand_ready_as_comments(tmp_path):
    text = mapping_to_toml(Mapping(notes=("first\nsecond = 3\r[signals]",)), comments={"speed_m_s": "perhaps /can.v"})
    assert load_text(tmp_path, text) == Mapping()
    for name in ("steer_rad", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s"):
        assert f"# [signals.{name}]" in text
    assert "# perhaps /can.v" in text
    # Taking the comment marks away from one example must give a file that loads.
    lines = text.splitlines()
    at = next(i for i, line in enumerate(lines) if line.startswith("# [signals.yaw_rate_rad_s]"))
    edited = "\n".join(line[2:] for line in lines[at : at + 4])
    assert set(load_text(tmp_path, edited).signals) == {"yaw_rate_rad_s"}


T = np.arange(5, dtype=np.int64) + 1_000_000_000


def log() -> FakeLog:
    zeros = np.zeros(5)
    numbers = ("linear_acceleration.x", "linear_acceleration.y", "angular_velocity.z", "seconds")
    header = {"header.stamp": T, "header.frame_id": np.array(["a"] * 5, dtype=object)}
    imu = FakeTopic("sensor_msgs/msg/Imu", T, header | dict.fromkeys(numbers, zeros))
    steer = FakeTopic("x/Steer", T, {"stamp": T, "angle": zeros, "gyro": np.zeros((5, 3)), "data[]": zeros})
    return FakeLog({"/imu/data": imu, "/steer": steer, "/bare": FakeTopic("std_msgs/msg/Float32", T, {"data": zeros})})


def mapping(**sources: SignalSource) -> Mapping:
    return Mapping(signals=sources)


def test_what_is_there_passes():
    sources = (
        SignalSource("ax_m_s2", "/imu/data", "linear_acceleration.x"),
        SignalSource("ay_m_s2", "/steer", "gyro[1]", stamp="stamp"),
        SignalSource("speed_m_s", "/steer", "data[4]"),
        SignalSource("steer_rad", "/imu/data", "seconds", stamp="seconds", stamp_unit="s"),
    )
    vectors = (
        SignalSource("enu_velocity_m_s", "/steer", "gyro"),
        SignalSource("ecef_position_m", "/steer", ("angle", "gyro[0]", "gyro[1]")),
    )
    gate = QualityGate("/steer", "angle", min=0.0)
    check_mapping(Mapping({s.name: s for s in sources}, {s.name: s for s in vectors}, quality=gate), log())


def test_everything_that_lacks_is_named_with_the_nearest():
    bad = Mapping(
        signals={
            "ax_m_s2": SignalSource("ax_m_s2", "/imu/dat", "linear_acceleration.x"),
            "ay_m_s2": SignalSource("ay_m_s2", "/imu/data", "linear_accel.y"),
            "yaw_rate_rad_s": SignalSource("yaw_rate_rad_s", "/imu/data", "angular_velocity"),
            "steer_rad": SignalSource("steer_rad", "/steer", "angle", stamp="header.stamp"),
            "friction": SignalSource("friction", "/imu/data", "header.frame_id"),
            "speed_m_s": SignalSource("speed_m_s", "/steer", "gyro[3]"),
        },
        truth={"quat_wxyz": SignalSource("quat_wxyz", "/steer", "angle")},
        quality=QualityGate("/state", "mode", values=(1.0,)),
    )
    with pytest.raises(MappingError) as caught:
        check_mapping(bad, log())
    line = str(caught.value)
    for part in (
        "ax_m_s2: no topic /imu/dat (did you mean /imu/data?)",
        "ay_m_s2: /imu/data has no field linear_accel.y (did you mean linear_acceleration.y?)",
        "yaw_rate_rad_s: /imu/data.angular_velocity contains several numbers: name one, such as angular_velocity.z",
        "steer_rad: /steer has no stamp header.stamp (did you mean stamp?)",
        "friction: /imu/data.header.frame_id is a string, not a number",
        "speed_m_s: /steer has no field gyro[3]",
        "quat_wxyz: /steer.angle is one number, quat_wxyz needs 4",
        "truth_quality: no topic /state",
    ):
        assert part in line, part
    assert "\n" not in line


@pytest.mark.parametrize(
    ("stamp", "unit", "said"),
    [("seconds", "ros", "give stamp_unit"), ("header.stamp", "s", "stamp_unit = "), ("header", "ros", "is no time")],
)
def test_the_kind_of_the_stamp_is_checked(stamp, unit, said):
    source = SignalSource("ax_m_s2", "/imu/data", "linear_acceleration.x", stamp=stamp, stamp_unit=unit)
    with pytest.raises(MappingError, match=said):
        check_mapping(mapping(ax_m_s2=source), log())


def test_stamps_that_the_file_leaves_open_come_from_the_schema():
    open_ = (("ax_m_s2", "/imu/data", "linear_acceleration.x"), ("steer_rad", "/steer", "angle"))
    sources = {n: SignalSource(n, *where) for n, *where in (*open_, ("speed_m_s", "/bare", "data"))}
    stated = SignalSource("ay_m_s2", "/imu/data", "linear_acceleration.y", stamp="publish_time")
    gate = QualityGate("/steer", "angle", min=0.0)
    got = mappings.resolve_mapping(log(), Mapping({**sources, "ay_m_s2": stated}, quality=gate))
    assert {n: s.stamp for n, s in got.signals.items()} == {
        "ax_m_s2": "header.stamp",
        "steer_rad": "stamp",
        "speed_m_s": "log_time",
        "ay_m_s2": "publish_time",
    }
    assert got.quality.stamp == "stamp"


TABLES = """
[signals.yaw_rate_rad_s]
topic = "/imu"
field = "gyro.z"
[estimates.esc.sideslip_rad]
topic = "/esc"
field = "beta"
scale = 0.017453292519943295
latency_s = 0.02
[estimates.esc.vx_m_s]
topic = "/esc"
field = "speed"
[estimates."my ekf 2.1".vy_m_s]
topic = "/ekf"
field = "vy"
"""


BETA = {"beta": np.zeros(10)}


def _log(**topics: dict[str, np.ndarray]) -> FakeLog:
    times = np.arange(10, dtype=np.int64) * 10_000_000 + 1_700_000_000_000_000_000
    return FakeLog({name: FakeTopic("custom/Type", times, fields) for name, fields in topics.items()})


def test_tables_are_read_and_written_back(tmp_path):
    (tmp_path / "m.toml").write_text(TABLES)
    mapping = load_mapping(tmp_path / "m.toml")
    assert list(mapping.estimates) == ["esc", "my ekf 2.1"]
    assert mapping.estimates["esc"]["sideslip_rad"].latency_s == 0.02
    assert "/esc" not in mapping.topics  # a run reads no estimates
    (tmp_path / "again.toml").write_text(mapping_to_toml(mapping))
    assert load_mapping(tmp_path / "again.toml").estimates == mapping.estimates


def test_topics_with_dots_are_found_by_the_longest_that_fits():
    values = {"c": np.zeros(10), "b.c": np.zeros(10)}
    log = _log(**{"a": values, "a.b": values})
    sources, _ = sources_of(log, ["vx_m_s=a.b.c", "vy_m_s=a.c"], ESTIMATE_UNITS, "--estimate")
    assert {n: (s.topic, s.field) for n, s in sources.items()} == {"vx_m_s": ("a.b", "c"), "vy_m_s": ("a", "c")}


@pytest.mark.parametrize(
    ("flag", "scale"),
    [("sideslip_rad=/esc.beta_deg", np.pi / 180.0), ("vx_m_s=/esc.v_kmh", 1.0 / 3.6), ("vy_m_s=/esc.vy", 1.0)],
)
def test_a_flag_has_the_unit_of_its_field(flag, scale):
    name, _, label = flag.partition("=")
    log = _log(**{"/esc": {label.partition(".")[2]: np.zeros(10)}})
    sources, _ = sources_of(log, [flag], ESTIMATE_UNITS, "--estimate")
    assert sources[name].scale == pytest.approx(scale)


def test_flags_win_over_tables(tmp_path):
    (tmp_path / "m.toml").write_text(TABLES)
    mapping = load_mapping(tmp_path / "m.toml")
    log = _log(**{"/esc": BETA})
    (flag,) = choose_estimates(log, ["sideslip_rad=/esc.beta"], mapping, None)
    assert flag.name == "esc"
    assert flag.signals["sideslip_rad"].scale == 1.0
    tables = choose_estimates(log, [], mapping, None)
    assert [e.name for e in tables] == ["esc", "my ekf 2.1"]


def test_a_topic_named_as_a_whole_brings_its_covariance_and_a_field_does_not(sample_logs_dir):
    log = open_log(sample_logs_dir / "step.mcap")
    sources, covariance = sources_of(log, ["/rtk/odometry"], ESTIMATE_UNITS, "--estimate")
    assert {"vx_m_s", "vy_m_s"} <= sources.keys()
    assert covariance.topic == "/rtk/odometry"
    _, none = sources_of(log, ["vx_m_s=/rtk/odometry.twist.twist.linear.x"], ESTIMATE_UNITS, "--estimate")
    assert none is None
    log.close()


def test_losses_of_one_kind_at_one_place_become_one_that_spans_and_counts_all():
    first, second = Loss("nan", "w", "/a.x", 40, 50, 3), Loss("nan", "w", "/a.x", 10, 20, 4)
    whole = Loss("nan", "w", "/a.x")  # uncounted: adds no bound and no count
    for order in permutations((first, second, whole)):
        assert mappings.merge_losses([order[:1], order[1:]]) == (Loss("nan", "w", "/a.x", 10, 50, 7),)


@pytest.mark.parametrize(
    "other",
    [
        Loss("gap", "w", "/a", 1, 2, 1),
        Loss("nan", "v", "/a", 1, 2, 1),
        Loss("nan", "w", "/b", 1, 2, 1),
        Loss("nan", "w", "/a", 1, 2, 1, "note"),
    ],
)
def test_losses_that_differ_in_kind_words_place_or_weight_stay_apart(other):
    loss = Loss("nan", "w", "/a", 1, 2, 1)
    assert mappings.merge_losses([[loss, other], [loss]]) == (Loss("nan", "w", "/a", 1, 2, 2), other)


# ---- recorders and runs: a folder of mappings serves several; a file of several runs needs a choice ----

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
