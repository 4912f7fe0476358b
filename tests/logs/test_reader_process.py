"""The process that reads a table file: its restrictions, and the losses after a crash."""

import ctypes
import socket
import subprocess
import sys
import tempfile
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.logs import formats
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.resource_limits import DEFAULT_LIMITS, LimitError
from pdhef_logtool.records.errors import LogError
from tests.conftest import ROOT
from tests.logs import planted_reader

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="readers have a process of their own on Linux only")


@pytest.fixture(autouse=True)
def _planted(monkeypatch):
    monkeypatch.setattr(formats, "FORMATS", (planted_reader.FORMAT,))


def _file(folder: Path, deed: str, argument: object = "-") -> Path:
    path = folder / f"{deed}.planted"
    path.write_text(f"PLANTED {deed} {argument}")
    return path


@pytest.mark.parametrize(
    ("deed", "message"),
    [
        ("segv", r"got one that ends its reader \(SIGSEGV\); give the recording itself"),
        ("exit", r"got one that ends its reader \(exit code 0\)"),
        ("interrupt", r"got one that ends its reader \(exit code 0\)"),
        ("bad", "a block of it is damaged"),
        ("refuse", "expected a planted file, got a weed; plant another"),
    ],
)
def test_a_reader_that_ends_costs_its_file_only(tmp_path, deed, message):
    with pytest.raises(LogError, match=message):
        open_log(_file(tmp_path, deed))
    open_log(_file(tmp_path, "nothing")).close()


#: Version of Landlock in this kernel, below 1 without it: system call 444 with the flag that asks for the version.
LANDLOCK = ctypes.CDLL(None).syscall(444, None, 0, 1) if sys.platform == "linux" else -1


@pytest.mark.skipif(LANDLOCK < 6, reason="the kernel has no Landlock of version 6 (Linux 6.12)")
@pytest.mark.parametrize("deed", ["read", "link", "write", "run", "connect", "kill"])
def test_a_reader_reaches_no_other_file_program_or_process(tmp_path, deed):
    canary = tmp_path / "canary"
    canary.write_text("as it was")
    with socket.create_server(("127.0.0.1", 0)) as server:
        argument = server.getsockname()[1] if deed == "connect" else canary
        with pytest.raises(LogError, match="PermissionError"):
            open_log(_file(tmp_path, deed, argument))
    assert canary.read_text() == "as it was"


def test_time_and_memory_of_a_reader_are_limited_by_the_budget(tmp_path):
    with pytest.raises(LimitError, match=r"512 MiB of memory.*--set budget=FACTOR"):
        open_log(_file(tmp_path, "memory"))
    with pytest.raises(LimitError, match=r"0.05 s of processor time.*--set budget=FACTOR"):
        open_log(_file(tmp_path, "hang"), DEFAULT_LIMITS.times(0.01))


def test_a_limit_of_the_shell_on_processor_time_ends_no_reader(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time,ay\n" + "".join(f"{0.01 * i:.2f},{i}\n" for i in range(50)))
    script = "import resource, sys; resource.setrlimit(resource.RLIMIT_CPU, (900, 900))\n"
    script += "from pdhef_logtool.logs.open_log import open_log; open_log(sys.argv[1]).close()"
    subprocess.run([sys.executable, "-c", script, path], check=True, cwd=ROOT)


def test_a_column_that_ends_its_reader_is_a_loss_and_the_others_are_read(tmp_path):
    with closing(open_log(_file(tmp_path, "nothing"))) as log:
        columns = log.read({"t": ["good", "segv", "bad", "better"]})["t"].fields
    assert columns["good"].tolist() == columns["better"].tolist() == [0, 1, 2, 3, 4]
    assert np.isnan(columns["segv"]).all()
    assert np.isnan(columns["bad"]).all()
    assert [(loss.kind, loss.where) for loss in log.lost] == [("bad-column", "t")] * 2
    assert "SIGSEGV" in log.lost[0].what
    assert "a block of it is damaged" in log.lost[1].what


def test_a_reader_is_silent_and_its_folder_is_removed(tmp_path, capfd, monkeypatch):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    open_log(_file(tmp_path, "print")).close()
    with closing(open_log(_file(tmp_path, "leave"))) as log:
        assert log.read({"t": ["good"]})["t"].fields["good"][0] == 2  # the folder had this file, and its output
        assert len(list(temporary.glob("pdhef-*/left_behind"))) == 1
    assert not list(temporary.iterdir())
    assert capfd.readouterr() == ("", "")


def test_slices_of_a_column_are_those_of_the_reader(tmp_path):
    with closing(open_log(_file(tmp_path, "nothing"))) as log:
        part = log.read({"t": ["good"]}, 10**18 + 10, 10**18 + 40)["t"]
    assert part.fields["good"].tolist() == [1, 2, 3]
    assert (part.log_time_ns - 10**18).tolist() == [10, 20, 30]
