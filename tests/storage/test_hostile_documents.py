"""Configuration files that are broken, or made to break their reader: one line, exit code 2, at once."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from pdhef_logtool.car.car import SHIPPED_CARS, Car, load_intervals
from pdhef_logtool.evaluation.validation_plan import load_plan
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping.mapping_file import load_mapping
from pdhef_logtool.records.errors import EXIT_USAGE, LogError, PdhefError, UsageError
from pdhef_logtool.residual_model.bundle import load_network
from pdhef_logtool.residual_model.linear_model import load_linear_model
from pdhef_logtool.runs.config import load_config
from pdhef_logtool.storage.documents import MAX_BYTES, read_toml

_LOADERS: dict[str, Callable[[Path], Any]] = {
    "mapping.toml": load_mapping,
    "vehicle.toml": Car.load,
    "pdhef.toml": lambda path: load_config(path, {}),
    "plan.toml": load_plan,
    "intervals.json": load_intervals,
    "model.json": lambda path: load_network(path.parent, "residual"),
    "linear_regression.json": load_linear_model,
}
_TEXTS = {
    "nothing of ours": b"x = 1",
    "deep": b"a=" + b"[" * 900 + b"]" * 900,
    "deeper": b"[" * 100_000,
    "deep JSON": b'{"a":' * 900 + b"1" + b"}" * 900,
    "a list": b"[]",
    "null": b"null",
    "zeros": b"\0" * 100,
    "no UTF-8": b"\xff\xfe\x00",
    "digits": b'{"format": ' + b"9" * 5000 + b"}",
    "keys in keys": b"a." * 5000 + b"b = 1",
    "long": b"#" + b"x" * MAX_BYTES,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", _LOADERS)
@pytest.mark.parametrize("case", _TEXTS)
def test_a_broken_document_is_one_line_and_exit_code_2(tmp_path: Path, name: str, case: str) -> None:
    (tmp_path / name).write_bytes(_TEXTS[case])
    started = time.process_time()
    with pytest.raises(PdhefError) as caught:
        _LOADERS[name](tmp_path / name)
    assert time.process_time() - started < 5.0
    assert caught.value.exit_code == EXIT_USAGE
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("name", _LOADERS)
def test_a_folder_is_no_document(tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir()
    with pytest.raises(PdhefError) as caught:
        _LOADERS[name](tmp_path / name)
    assert caught.value.exit_code == EXIT_USAGE


def test_what_an_editor_puts_before_the_text_is_no_part_of_it(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_bytes(b"\xef\xbb\xbfa = 1\r\nb = 2\r\n")
    assert read_toml(tmp_path / "a.toml", "a file", UsageError) == {"a": 1, "b": 2}


_VALUE = st.recursive(
    st.sampled_from([None, True, "", "\0", "\u202e", "nan", 0, -1, 2**63, 1e308, 1e-320]) | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@pytest.mark.slow
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_a_document_with_another_value_somewhere_is_read_or_refused(tmp_path: Path, data: st.DataObject) -> None:
    document = json.loads((SHIPPED_CARS["saloon"] / "intervals.json").read_text())
    place = document
    while isinstance(place, dict | list) and place:
        keys = list(place) if isinstance(place, dict) else list(range(min(len(place), 2)))
        key = data.draw(st.sampled_from(keys))
        if not isinstance(place[key], dict | list) or data.draw(st.integers(0, 3)) == 0:
            place[key] = data.draw(_VALUE)
            break
        place = place[key]
    (tmp_path / "intervals.json").write_text(json.dumps(document))
    try:
        load_intervals(tmp_path / "intervals.json")
    except PdhefError as error:
        assert error.exit_code == EXIT_USAGE


@pytest.mark.parametrize("key", ["x", "relative_file_paths", "ros_distro", "compression_mode"])
def test_anchors_of_anchors_are_not_written_out(tmp_path: Path, key: str) -> None:
    anchors = "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 9))
    files = "" if key in ("x", "relative_file_paths") else "relative_file_paths: [x], "
    text = f"a0: &a0 [x, x]\n{anchors}rosbag2_bagfile_information: {{{files}{key}: *a8}}\n"
    (tmp_path / "metadata.yaml").write_text(text)
    started = time.process_time()
    with pytest.raises(LogError):
        open_log(tmp_path)
    assert time.process_time() - started < 3.0


def test_a_dbc_that_is_none_is_a_wrong_mapping(tmp_path: Path) -> None:
    from pdhef_logtool.logs.can_decoding import load_dbc

    (tmp_path / "folder.dbc").mkdir()
    (tmp_path / "text.dbc").write_text("no DBC")
    for name in ("folder.dbc", "text.dbc", "none.dbc"):
        with pytest.raises(PdhefError) as caught:
            load_dbc(tmp_path / name)
        assert caught.value.exit_code == EXIT_USAGE


def test_the_configurations_that_did_harm_are_wrong_ones(shared_dir: Path, tmp_path: Path) -> None:
    cases = {"mapping.toml": "cfg_mapping.toml_RecursionError_1", "model.json": "cfg_model.json_AttributeError_0"}
    for name, case in cases.items():
        file = shared_dir / "torture" / case
        if not file.is_file():
            pytest.skip("needs ../shared/torture")
        (tmp_path / name).write_bytes(file.read_bytes())
        with pytest.raises(PdhefError) as caught:
            _LOADERS[name](tmp_path / name)
        assert caught.value.exit_code == EXIT_USAGE
