"""The guard of ``conftest.py`` fails a test that leaves something behind, and only this one."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import ROOT

LEAVING = """
import os, signal, subprocess, sys
from pathlib import Path

def test_signal(): signal.signal(signal.SIGUSR1, signal.SIG_IGN)
def test_variable(): os.environ["LEFT"] = "1"
def test_removed(): del os.environ["LEFT"]
def test_folder(tmp_path): os.chdir(tmp_path)
def test_process(): global p; p = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
def test_nothing(): p.communicate()
def test_interrupt():
    signal.signal(signal.SIGUSR1, signal.SIG_DFL)
    try: signal.raise_signal(signal.SIGINT)
    except KeyboardInterrupt: pass
"""


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="looks for processes in /proc")
def test_what_a_test_leaves_is_its_error_even_in_the_background_of_a_shell(tmp_path: Path) -> None:
    (tmp_path / "test_leaving.py").write_text(LEAVING)
    call = [sys.executable, "-m", "pytest", "-p", "tests.conftest", "-p", "no:randomly", "-rE", "--rootdir"]
    shell = ["sh", "-c", 'trap "" INT; exec "$@"', "sh", *call, str(tmp_path), str(tmp_path)]
    done = subprocess.run(shell, capture_output=True, text=True, cwd=ROOT, check=False)
    assert set(re.findall(r"^ERROR .*::test_(\w+)", done.stdout, re.MULTILINE)) == {
        "signal", "variable", "removed", "folder", "process", "interrupt",
    }, done.stdout  # fmt: skip
