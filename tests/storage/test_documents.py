"""Every document that is read is a valid record or one line that says why not; TOML that is written is read back."""

import json
import shutil
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from hypothesis import given, settings, strategies as st

from pdhef_logtool.car.car import SHIPPED_CARS, Car
from pdhef_logtool.car.toml_files import read_vehicle_file
from pdhef_logtool.evaluation.validation_plan import load_plan
from pdhef_logtool.mapping import Mapping, SignalSource, load_mapping
from pdhef_logtool.records.errors import EXIT_USAGE, PdhefError, UsageError, VehicleError
from pdhef_logtool.residual_model.bundle import DOCUMENT_FILE, SHIPPED_FOLDERS, WEIGHTS_FILE, load_network
from pdhef_logtool.residual_model.linear_model import LinearModel, load_linear_model
from pdhef_logtool.runs.config import load_config
from pdhef_logtool.runs.journal import digest_of
from pdhef_logtool.storage import documents as sealing
from pdhef_logtool.storage.toml_text import toml_text

SHIPPED, CAR = SHIPPED_FOLDERS["default"], SHIPPED_CARS["saloon"]
VALID_CONFIG = {"estimators": ["zero"], "car": "car.toml", "start": 3, "end": "end-2s", "friction": 0.5}
VALID_CONFIG |= {"network": "none", "annotate": "full"}
VALID_MAPPING = {
    "signals": {"ax_m_s2": {"topic": "/imu", "field": "x", "scale": 9.81, "stamp": "t", "latency_s": 0.1}},
    "truth": {"ecef_position_m": {"topic": "/gnss", "field": ["x", "y", "z"], "scale": [1.0, 1.0, 1.0]}},
    "truth_quality": {"topic": "/gnss", "field": "mode", "values": [4]},
    "estimates": {"mine": {"vy_m_s": {"topic": "/filter", "field": "vy"}}},
    "can": {"dbc": ["car.dbc"], "bus": 1, "bus_field": "bus"},
    "fill_recognised": True,
}
OF_A_CAR = {"version": 1, "physics_sha256": "ab" * 32}
OF_A_CAR |= {"drives": [{"name": "lap", "sha256": "cd", "start_s": 0.0, "end_s": 9.5}]}
NOISE = {"phy-ukf:tuned": {"q_std": [0.1, 0.1, 0.1], "r_std": {"ay_m_s2": 1.0}}}
VALID_FIT = {"format": "pdhef-fit", **OF_A_CAR, "filter": NOISE}
PARAMETERS = [{"name": "yaw inertia", "value": 1500.0, "std": 0.1}]
VALID_MODEL = {"format": "pdhef-model", **OF_A_CAR, "truth": "ground truth", "parameters": PARAMETERS}
VALID_PLAN = {"requirement": [{"id": "SR-1", "signal": "sideslip_rad", "metric": "rmse", "limit_deg": 0.5}]}


class Loader(NamedTuple):
    name: str
    load: Callable[[Path], object]
    valid: dict[str, Any]


def _model(path: Path) -> object:
    if not (path.parent / WEIGHTS_FILE).is_file():
        shutil.copy(SHIPPED / WEIGHTS_FILE, path.parent)
    return load_network(path.parent, "residual_rates")


def _part(path: Path) -> object:
    """Read the car that this part stands in."""
    shutil.copy(CAR / "vehicle.toml", path.parent)
    return Car.load(path.parent, network="none")


LOADERS = [
    Loader("pdhef.toml", lambda path: load_config(path, {}), VALID_CONFIG),
    Loader("mapping.toml", load_mapping, VALID_MAPPING),
    Loader("plan.toml", load_plan, VALID_PLAN),
    Loader("vehicle.toml", read_vehicle_file, tomllib.loads((CAR / "vehicle.toml").read_text())),
    Loader("fit.toml", _part, VALID_FIT),
    Loader("model.toml", _part, VALID_MODEL),
    Loader(DOCUMENT_FILE, _model, json.loads((SHIPPED / DOCUMENT_FILE).read_text())),
    Loader(
        "regression.json", load_linear_model, json.loads((SHIPPED / "baselines" / "linear-regression.json").read_text())
    ),
]
every_loader = pytest.mark.parametrize("loader", LOADERS, ids=lambda loader: loader.name)


def write(path: Path, document: Any) -> Path:
    path.write_text(json.dumps(document) if path.suffix == ".json" else toml_text(document), encoding="utf-8")
    return path


def outcome(loader: Loader, path: Path) -> str:
    """Return the error line of a rejected document, or an empty string for an accepted one; fail on other outcomes."""
    try:
        loader.load(path)
    except PdhefError as error:
        text = str(error)
        assert text.isprintable() and error.exit_code == EXIT_USAGE
        assert path.name in text or "options" in text or "--" in text or path.name == DOCUMENT_FILE
        return text
    return ""


texts = st.text(st.characters(exclude_categories=["Cs", "Cc"]), max_size=8)
scalars = st.booleans() | st.integers() | st.floats() | texts | st.sampled_from(["none", "zero", "ay_m_s2", "1.0"])


def documents(keys: list[str]) -> st.SearchStrategy[Any]:
    names = st.sampled_from(keys) | texts

    def deeper(inner: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
        return st.lists(inner, max_size=4) | st.dictionaries(names, inner, max_size=4)

    return st.recursive(scalars, deeper, max_leaves=8)


def keys_of(document: Any) -> list[str]:
    if isinstance(document, dict):
        return [*document, *(k for v in document.values() for k in keys_of(v))]
    return [k for v in document for k in keys_of(v)] if isinstance(document, list) else []


def changed(data: st.DataObject, document: Any, anything: st.SearchStrategy[Any]) -> Any:
    """Return a copy with one place replaced, added or taken away."""
    if isinstance(document, dict) and document:
        key = data.draw(st.sampled_from(sorted(document)))
        match data.draw(st.sampled_from(["deeper", "deeper", "gone", "more"])):
            case "gone":
                return {k: v for k, v in document.items() if k != key}
            case "more":
                return {**document, data.draw(texts): data.draw(anything)}
        return {**document, key: changed(data, document[key], anything)}
    if isinstance(document, list) and document and data.draw(st.booleans()):
        return [changed(data, document[0], anything), *document[1:]]
    return data.draw(anything)


@every_loader
@settings(max_examples=15, deadline=None, derandomize=True)
@given(data=st.data())
@pytest.mark.slow
def test_any_document_is_a_record_or_one_line(loader, tmp_path_factory, data):
    folder = tmp_path_factory.getbasetemp() / loader.name
    folder.mkdir(exist_ok=True)
    anything = documents(keys_of(loader.valid))
    document = changed(data, loader.valid, anything)
    if loader.name.endswith(".toml") and not isinstance(document, dict):
        document = {"": document}
    outcome(loader, write(folder / loader.name, document))


@every_loader
def test_the_document_that_the_others_are_made_of_is_taken(loader, tmp_path):
    assert outcome(loader, write(tmp_path / loader.name, loader.valid)) == ""


@every_loader
def test_what_cannot_be_read_is_one_line(loader, tmp_path):
    path = tmp_path / loader.name
    # A car needs none of its parts.
    assert ("no such file" in outcome(loader, path)) == (loader.load is not _part)
    path.write_bytes(b"\xff\xfe\x00")
    assert "utf-8" in outcome(loader, path)
    entry = '{"format": %s}' if path.suffix == ".json" else "a = %s\n"
    endless = [entry % number for number in ("1" + "0" * 5000, "0x" + "f" * 5000, "1" + "0" * 30)]
    dates = ["name = 2026-01-01\n", "name = [{ a = 07:30:00 }]\n"]
    for text in ("= ][", "\0" * 100, "#" + "x" * sealing.MAX_BYTES, *endless, *dates):
        path.write_text(text)
        assert outcome(loader, path)
    for depth in (sealing.MAX_DEPTH + 1, 100_000):
        path.write_text(entry % ("[" * depth + "]" * depth))
        assert "too deeply" in outcome(loader, path)
    if path.suffix == ".json":
        for document in ([], [1], "text", 3, None, True):
            line = outcome(loader, write(path, document))
            assert f"a {type(document).__name__} instead of named entries" in line
    path.unlink()
    path.mkdir()
    assert any(word in outcome(loader, path) for word in ("directory", "folder"))


def test_nesting_up_to_the_limit_is_read(tmp_path):
    depth = sealing.MAX_DEPTH - 1
    nested = "[" * depth + "]" * depth
    (tmp_path / "a.toml").write_text(f"a = {nested}")
    (tmp_path / "a.json").write_text(f'{{"a": {nested}, "n": {2**64 - 1}}}')
    assert list(sealing.read_toml(tmp_path / "a.toml", "a file", UsageError)) == ["a"]
    assert sealing.read_json(tmp_path / "a.json", "a file", UsageError)["n"] == 2**64 - 1


def test_a_sealed_document_is_read_as_it_was_written_or_not_at_all(tmp_path):
    path, document = tmp_path / "own.json", {"a": [1, 0.1, None, "é"], "b": {"c": True}}
    data = json.dumps(sealing.seal(document)).encode()
    path.write_bytes(data)
    assert sealing.read_sealed(path, "ours", UsageError) == document
    for at in range(len(data)):
        for damaged in (data[:at], data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]):
            path.write_bytes(damaged)
            with pytest.raises(UsageError, match=r"own\.json: expected ours"):
                sealing.read_sealed(path, "ours", UsageError)
    path.write_text(json.dumps(document))
    with pytest.raises(UsageError, match="not as it was written"):
        sealing.read_sealed(path, "ours", UsageError)


def test_errors_say_what_was_wanted_where_and_what_to_do(tmp_path):
    with pytest.raises(VehicleError, match=r"none\.toml: expected a car, got no such file; write one"):
        sealing.read_toml(tmp_path / "none.toml", "a car", VehicleError, "write one")


def test_the_nearest_name_is_told():
    known = ("ay_m_s2", "yaw_rate_rad_s", "speed_m_s")
    assert sealing.unknown("ay", known, "r_std") == "r_std.ay: unknown, did you mean r_std.ay_m_s2?"
    assert sealing.unknown("yaw_rate_rads", known) == "yaw_rate_rads: unknown, did you mean yaw_rate_rad_s?"
    assert sealing.unknown("", known, "r_std") == "r_std: unknown, known are ay_m_s2, yaw_rate_rad_s, speed_m_s"
    assert sealing.unknown("zzz", known).endswith("known are ay_m_s2, yaw_rate_rad_s, speed_m_s")


@pytest.mark.parametrize(
    ("loader", "line", "wrong", "right"),
    [
        (LOADERS[0], 'estimater = ["zero"]', "estimater", "estimators"),
        (LOADERS[1], "truth_quallity = {}", "truth_quallity", "truth_quality"),
        (LOADERS[1], "truth_quality = {tropic = 3}", "truth_quality.tropic", "truth_quality.topic"),
        (LOADERS[1], "[estimates.a.vy_ms]\ntopic = '/a'", "estimates.a.vy_ms", "estimates.a.vy_m_s"),
        (LOADERS[2], "[[requirement]]\nlimits = 3", "requirement.0.limits", "requirement.0.limit"),
        (LOADERS[3], "[sensors]\nay_std = 1.0", "sensors.ay_std", "sensors.ay_std_m_s2"),
        (LOADERS[4], "[filter.physics]\nq_sdt = [0.1, 0.1, 0.1]", "filter.physics.q_sdt", "filter.physics.q_std"),
    ],
)
def test_misspelt_entries_are_told_with_the_nearest_name(loader, line, wrong, right, tmp_path):
    (tmp_path / loader.name).write_text(line)
    assert f"{wrong}: unknown, did you mean {right}?" in outcome(loader, tmp_path / loader.name)


def test_hashes_that_stand_in_files_stay_what_they_were():
    """Hashes of version 0.2.0. Journals, caches, datasets and cars identify their sources by these hashes."""
    document = {"b": [1, 2.5, None, True], "a": {"ü\udc80": "/", "": (1e-9, 1e22)}}
    assert sealing.digest(document) == "67b92e78790c0c9feafdf6c5b26ff7e18525bc442921e21ed792a5d1dbcc28d6"
    assert digest_of(document) == "67b92e78790c0c9f"
    mapping = Mapping({"speed_m_s": SignalSource("speed_m_s", "/can", "speed", scale=0.5)})
    assert mapping.sha256 == "95bc15effd8048a668853de7ce24f1e84c771acd8e1692d120c193d57d689937"
    linear = LinearModel(("ay_m_s2",), (0.5,), 0.25, 2.0)
    assert linear.sha256 == "47076088d4172941685a059bf407bb89750dff940ccc307b7ca6278cb1868aed"


_TEXTS = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
_PLAIN = st.one_of(st.booleans(), st.integers(-(2**63), 2**63 - 1), st.floats(allow_nan=False), _TEXTS)
_TABLES: Any = st.recursive(
    st.dictionaries(_TEXTS, st.one_of(_PLAIN, st.lists(_PLAIN, max_size=3))),
    lambda inner: st.dictionaries(_TEXTS, st.one_of(_PLAIN, st.lists(inner, max_size=2), inner), max_size=4),
    max_leaves=8,
)


@given(_TABLES)
def test_a_document_is_read_back(entries):
    assert tomllib.loads(toml_text(entries, "A head\nof two lines")) == entries


def test_the_layout_is_for_readers():
    entries = {"t": {"n": [1, 2.0], "u": {"x": True}}, "names": ["a", 'b"'], "rows": [{"k v": 1e-9}], "v": 1}
    text = """# Head
v = 1
names = [
    "a",
    "b\\"",
]
rows = [
    {"k v" = 1e-09},
]

[t]
n = [1, 2.0]

[t.u]
x = true
"""
    assert toml_text(entries, "Head") == text
    with pytest.raises(TypeError, match="NoneType"):
        toml_text({"a": None})
