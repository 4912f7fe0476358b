"""Readers that go, terminals that are full, streams that are closed, and requests to end."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

PDHEF = [sys.executable, "-m", "pdhef_logtool"]
FULL = Path("/dev/full")


@pytest.mark.slow
def test_a_reader_that_has_had_enough_hears_nothing(sample_logs_dir):
    read, write = os.pipe()
    os.close(read)
    command = ["inspect", str(sample_logs_dir / "dlc.mcap")]
    done = subprocess.run([*PDHEF, *command], stdout=write, stderr=subprocess.PIPE, text=True, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (141, "")


@pytest.mark.slow
@pytest.mark.skipif(not FULL.exists(), reason="needs /dev/full")
def test_an_output_that_takes_nothing_is_one_line():
    with FULL.open("w") as full:
        done = subprocess.run([*PDHEF, "--version"], stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr == (
        "pdhef: standard output: expected a place to write to, got No space left on device; "
        "free some space or choose another place\n"
    )


@pytest.mark.slow
def test_closed_streams_are_no_error_and_no_output_gets_their_numbers(tmp_path):
    log = tmp_path / "x.mcap"
    shell = " ".join([*PDHEF, "simulate", "dlc", "--duration", "5", "-o", str(log), "0>&- 1>&- 2>&-"])
    done = subprocess.run(["sh", "-c", shell], capture_output=True, check=False)
    assert done.returncode == 0
    assert log.read_bytes().endswith(b"\x89MCAP0\r\n")


STOP = """
import os, signal, sys
import pdhef_logtool.runs.fleet as p
def run(*a, **k):
    try:
        os.kill(os.getpid(), signal.{name})
    except BaseException as error:
        if "{way}" == "swallowed":
            k["progress"]("", 0.5)
        if "{way}" == "changed":
            raise ImportError("what a module makes of it")
        raise
p.run_logs = run
sys.argv = ["pdhef", "run", "x", "-o", "y"]
from pdhef_logtool.__main__ import main
main()
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "way", "code", "said"),
    [("SIGINT", "changed", 130, "interrupted"), ("SIGTERM", "swallowed", 143, "terminated")],
)
def test_a_request_to_end_is_one_line_whatever_becomes_of_it(name, way, code, said):
    script = STOP.format(name=name, way=way)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (code, "")
    assert done.stderr == f"pdhef: {said}; no output file was left incomplete\n"


def test_the_second_request_ends_at_once_and_what_is_ignored_stays_so():
    script = "import signal; from pdhef_logtool.cli import stopping\n"
    script += "signal.signal(signal.SIGTERM, signal.SIG_IGN)\nstopping.watch()\n"
    script += "signal.raise_signal(signal.SIGTERM)\n"
    script += "try: signal.raise_signal(signal.SIGINT)\nexcept BaseException: pass\n"
    script += "signal.raise_signal(signal.SIGINT)\nprint('still here')"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (-signal.SIGINT, "")


def test_without_a_terminal_progress_is_a_line_every_half_minute(monkeypatch, capsys):
    from pdhef_logtool.cli import console

    now = [0.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: now[0])
    with console.reporter() as reporter:
        for second in range(0, 100, 5):
            now[0] = float(second)
            reporter.progress(f"drive {second}", second / 100.0)
    assert capsys.readouterr().err.splitlines() == [" 30%  drive 30", " 60%  drive 60", " 90%  drive 90"]
