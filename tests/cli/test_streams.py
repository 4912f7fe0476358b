"""Processes: what a command imports, readers that go, terminals that are full, closed streams and requests to end."""

import json
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


ROOT = Path(__file__).parents[2]
_CODE = """
import sys
def loaded(*heavy):
    print("ended:", *(name for name in heavy if name in sys.modules))
import pdhef_logtool
loaded("numpy", "pydantic")
import pdhef_logtool.cli.inspecting, pdhef_logtool.runs.config, pdhef_logtool.runs.inspection.report
import truthsim.manoeuvres
loaded("numba", "torch", "scipy", "rerun", "polars", "pyarrow")
from pdhef_logtool.cli.app import main
sys.argv = ["pdhef", *sys.argv[1:]]
try:
    main()
except SystemExit as done:
    assert not done.code, done.code
loaded("torch", "rerun", "scipy.linalg", "scipy.special", "scipy.ndimage", "matplotlib", "polars")
"""


def ended_of(script: str, *arguments: str) -> list[str]:
    """Run a script in a separate process; return its lines that begin with ``ended:``, without that."""
    command, env = [sys.executable, "-c", script, *arguments], {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=True)
    return [line.removeprefix("ended:").strip() for line in done.stdout.splitlines() if line.startswith("ended:")]


@pytest.mark.slow
def test_the_package_an_inspection_and_a_light_run_load_no_large_library_that_they_do_not_need(tmp_path):
    words = ("run", "sample_logs/dlc.mcap", "--car", "saloon", "-o", str(tmp_path / "out"), "--end", "2")
    assert ended_of(_CODE, *words, "--keep", "metrics", "--no-report") == [""] * 3


_COMMANDS = """
import json, sys
sys.modules["torch"] = None  # as if it were not installed
from tests.command_line import called
for words in json.loads(sys.argv[1]):
    done = called(*words)
    print("ended:", words[0], done.returncode, *done.stderr.split())
"""


@pytest.mark.slow
def test_what_trains_no_network_works_without_it_and_what_trains_one_ends_with_one_line(tmp_path):
    out, drive = str(tmp_path), ("sample_logs/dlc.mcap", "--car", "saloon", "--set", "end=3")
    commands = (
        ("run", *drive, "-e", "pd-hef,physics", "--annotate", "none", "-o", f"{out}/out"),
        ("extract", *drive, "-o", f"{out}/residuals"),
        ("train", out, "-o", f"{out}/network"),
    )
    ran, extracted, refused = ended_of(_COMMANDS, json.dumps(commands))
    assert ran.startswith("run 0") and extracted.startswith("extract 0")
    assert (tmp_path / "out/logs/dlc/report.html").is_file()
    assert refused.startswith("train 2 ")
    assert "got an installation without it; pip install 'pdhef-logtool[train]'" in refused
    assert not (tmp_path / "network").exists()
