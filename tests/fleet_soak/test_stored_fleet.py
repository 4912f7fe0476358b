"""A fleet whose output is in an object store, killed and gone on with: it equals an undisturbed one in a folder."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pdhef_logtool.results.opened_run import JOURNAL_FILE, open_run
from pdhef_logtool.storage.outputs import LOCK_FILE
from tests.conftest import ROOT
from tests.s3_store import S3Store, s3_store

pytestmark = [pytest.mark.fleet, pytest.mark.slow]

#: The command line, which puts the journal more often.
COMMAND = """
import sys
from pdhef_logtool.runs import stored_output
stored_output.EVERY_S = 0.2
from pdhef_logtool.__main__ import main
sys.exit(main())
"""


def start(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", COMMAND, "run", *arguments, "--jobs", "2"]
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen(command, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=env)


def drives_in(journal: bytes) -> int:
    return sum(b'"outcome":' in line for line in journal.splitlines())


def contents(files: dict[str, bytes]) -> dict[str, bytes]:
    """Leave out the journal and the recordings, which hold times."""
    return {name: data for name, data in files.items() if name != JOURNAL_FILE and not name.endswith(".rrd")}


def put_so_far(store: S3Store) -> int:
    """Return how many drives the journal in the store has."""
    return drives_in(store.objects("day/out").get(JOURNAL_FILE, b""))


def test_a_killed_run_goes_on_on_another_machine(tmp_path: Path, sample_logs_dir: Path) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    for name in ("dlc", "fishhook", "step", "sweep"):
        shutil.copy(sample_logs_dir / f"{name}.mcap", logs)
    undisturbed = start(str(logs), "-o", str(tmp_path / "out"))
    with s3_store() as store:
        process = start(str(logs), "-o", f"{store.url}/day/out")
        ends = time.monotonic() + 300.0
        while put_so_far(store) < 1 and time.monotonic() < ends:
            time.sleep(0.05)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        done = put_so_far(store)
        assert 1 <= done < 4, "it was killed under way"
        holder = store.get(f"day/out/{LOCK_FILE}").decode()
        assert holder.split("-")[1] == str(process.pid), "it still holds the place"
        store.put(f"day/out/{LOCK_FILE}", b"00000000-17-1")
        told = start(str(logs), "-o", f"{store.url}/day/out", "--resume")
        assert f"or remove {LOCK_FILE} there if that process has ended" in told.communicate()[1]
        assert told.returncode == 1
        store.put(f"day/out/{LOCK_FILE}", holder.encode())
        again = start(str(logs), "-o", f"{store.url}/day/out", "--resume")
        said = again.communicate()
        assert again.returncode in (0, 3), said
        found = store.objects("day/out")
        assert drives_in(found[JOURNAL_FILE]) == 4, "what was put is not done again"
        undisturbed.communicate()
        folder = tmp_path / "out"
        here = {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
        assert set(found) == set(here)
        assert contents(found) == contents(here)
        run = open_run(f"{store.url}/day/out")
        assert [log.outcome for log in run.logs] == ["ok"] * 4
        assert {log["log"] for log in json.loads(found["run.json"])["logs"]} == {"dlc", "fishhook", "step", "sweep"}
        frame = run.logs[0].estimates()
        assert frame is not None and frame.collect().height > 0
