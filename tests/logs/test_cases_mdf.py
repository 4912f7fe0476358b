"""MDF files of ../shared/cases, which failed once, and their right results by its README."""

from __future__ import annotations

import re
import tempfile
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.logs.open_log import open_log
from tests.command_line import called

pytest.importorskip("asammdf")


@pytest.fixture(scope="module")
def cases(shared_dir: Path) -> Path:
    if not (shared_dir / "cases").is_dir():
        pytest.skip("needs ../shared/cases")
    return shared_dir / "cases"


@pytest.mark.parametrize(
    ("name", "code", "line"),
    [
        ("mdf4_formula_sympy.mf4", 3, "speed cannot be read: its formula .* is no arithmetic of X"),
        ("mdf3_cyclic_groups.mdf", 1, "got a circle at byte"),
        ("mdf4_cyclic_channels.mf4", 1, "got a circle at byte"),
        ("mdf4_segv_convert.mf4", 0, "no columns of numbers: Txt"),
        ("left.mf4", 1, "expected a block HD at byte 64"),
        ("unfin.mf4", 0, "the recorder has not finished the file"),
    ],
)
def test_a_hostile_file_is_one_line(
    name: str, code: int, line: str, cases: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scratch = tmp_path / "t"
    scratch.mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    done = called("inspect", cases / "hostile" / name)
    assert done.returncode == code
    assert re.search(line, " ".join((done.stdout + done.stderr).split()))
    assert "internal error" not in done.stderr
    assert called("convert", cases / "hostile" / name, "-o", tmp_path / "out.mcap").returncode in (code, 0)
    assert {p.name for p in tmp_path.iterdir()} <= {"t", "out.mcap"}
    assert list(scratch.iterdir()) == []


@pytest.mark.parametrize("window", [(0.0, 100.0), (0.0, 12.0), (0.0, 15.0), (3.0, 9.0)])
def test_invalid_samples_do_not_slide(window: tuple[float, float], cases: Path) -> None:
    reference = np.genfromtxt(cases / "tables" / "reference.csv", delimiter=",", names=True)
    with closing(open_log(cases / "tables" / "mdf_invalidation_bits.mf4")) as log:
        low, high = (log.start_ns + int(t * 1e9) for t in window)
        read = log.read({"car": ["accel_y", "speed"]}, low, high)["car"]
    ay, rows = read.fields["accel_y"], np.round((read.log_time_ns - log.start_ns) / 2e7).astype(int)
    assert np.isnan(ay).sum() == len(ay) // 10
    if len(ay) == 1000:
        assert np.isfinite(ay).sum() == 900
    with closing(open_log(cases / "tables" / "mdf_reference.mf4")) as log:
        whole = log.read({"car": ["accel_y"]})["car"].fields["accel_y"]
    assert len(reference) == len(whole)
    np.testing.assert_array_equal(ay, np.where(np.isnan(ay), np.nan, whole[rows]))


def test_a_recorded_file_is_read_as_before(shared_dir: Path) -> None:
    with closing(open_log(shared_dir / "data" / "formats" / "v40_swd.mf4")) as log:
        read = log.read({"IMU_100_Hz": ["IMU_AccY"], "GNSS_10_Hz": ["GNSS_Speed"]})
        assert log.lost == ()
        assert {t.name: t.messages for t in log.topics} == {
            "CAN": 2395, "GNSS_10_Hz": 240, "IMU_100_Hz": 2395, "reference": 2395,
        }  # fmt: skip
    assert np.isfinite(read["IMU_100_Hz"].fields["IMU_AccY"]).all()
    assert read["GNSS_10_Hz"].fields["GNSS_Speed"].max() > 5.0
