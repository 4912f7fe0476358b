"""Every file, folder and log that the Python API takes may be a text instead of a path; one log is a list of one."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import pdhef_logtool as pdhef
from pdhef_logtool.logs.definitions import read_definitions

MAPPING = '[signals.yaw_rate_rad_s]\ntopic = "/imu/data"\nfield = "angular_velocity.z"\n'


@pytest.fixture(scope="module")
def dlc(sample_logs_dir):
    return sample_logs_dir / "dlc.mcap"


@pytest.fixture
def mapping(tmp_path):
    (tmp_path / "m.toml").write_text(f"fill_recognised = true\n{MAPPING}")
    return tmp_path / "m.toml"


def test_read_drive(dlc, sample_logs_dir, mapping, tmp_path):
    (tmp_path / "Any.msg").write_text("float64 a\n")
    options = pdhef.ReadOptions(msgs=str(tmp_path))
    with pdhef.read_drive(str(dlc), str(sample_logs_dir / "vehicle.toml"), str(mapping), options=options) as drive:
        assert "yaw_rate_rad_s" in drive.available
        assert drive.mapping.origin == "file"


def test_inspect_log(dlc, mapping, tmp_path):
    (tmp_path / "Any.msg").write_text("float64 a\n")
    found = pdhef.inspect_log(str(dlc), str(mapping), pdhef.ReadOptions(msgs=str(tmp_path)))
    assert set(found.signals) > {"yaw_rate_rad_s", "ay_m_s2"}
    assert set(pdhef.load_mapping(str(mapping)).signals) < set(found.mapping.signals)
    assert read_definitions(str(tmp_path)).files == read_definitions(tmp_path).files


def test_run(dlc, mapping, sample_logs_dir, tmp_path):
    (tmp_path / "t.toml").write_text('[[requirement]]\nid = "a"\nsignal = "sideslip_rad"\nlimit = 9.0\n')
    config = pdhef.RunConfig(
        estimators=("zero",), annotate="none", keep="metrics", mapping=str(mapping),
        car=str(sample_logs_dir / "vehicle.toml"), plan=str(tmp_path / "t.toml"),
    )  # fmt: skip
    result = pdhef.run(str(dlc), str(tmp_path / "out"), config, junit=str(tmp_path / "j.xml"), report=False)
    assert result.exit_code == 0
    assert (tmp_path / "out" / "run.json").is_file()
    assert (tmp_path / "j.xml").is_file()


def _ends(call: Callable[[], Any]) -> str:
    """Return the error message of a command on a missing log."""
    with pytest.raises(pdhef.PdhefError) as ended:
        call()
    return str(ended.value)


@pytest.mark.parametrize("kind", [str, Path])
def test_what_learns_takes_texts_and_paths(kind, tmp_path):
    log, out = tmp_path / "none.mcap", kind(tmp_path / "out")
    config = pdhef.RunConfig(car=kind("saloon"), network=kind("none"))
    for call, settings in ((pdhef.learn, pdhef.LearnSettings), (pdhef.extract, pdhef.ExtractSettings)):
        for logs in (kind(log), [kind(log)]):
            assert "no such file" in _ends(partial(call, logs, out, settings(config=config))).lower()
    assert "manifest.json" in _ends(lambda: pdhef.train(kind(tmp_path / "set"), out, init=kind(tmp_path / "net")))
