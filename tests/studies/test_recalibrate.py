"""Stages of ``make recalibrate`` with small commands: order, skipping, continuing after a failure, changed inputs."""

import pytest

from studies.recalibrate import Recalibration, Stage

#: Joins its inputs into its output and logs the call; fails while a file ``broken`` exists.
JOIN = """
import sys
from pathlib import Path
output, *inputs = sys.argv[1:]
with Path("calls").open("a") as calls:
    calls.write(output + " ")
Path("work").mkdir(exist_ok=True)
if output == "b" and Path("broken").exists():
    sys.exit(7)
Path(output).write_text("".join(Path(i).read_text().split("#")[0].strip() for i in inputs))
"""


@pytest.fixture
def project(tmp_path):
    (tmp_path / "join.py").write_text(JOIN)
    (tmp_path / "source.py").write_text("x = 1\n")
    (tmp_path / "other").write_text("o")
    stages = (
        Stage("first", "python join.py a source.py", ("source.py",), ("a",)),
        Stage("second", "python join.py b a other", ("a", "other"), ("b",), work=("work",)),
        Stage("third", "python join.py c b", ("b",), ("c",)),
    )
    return Recalibration(tmp_path, stages)


def calls(project: Recalibration) -> str:
    file = project.root / "calls"
    text = file.read_text() if file.is_file() else ""
    file.unlink(missing_ok=True)
    return text.strip()


def test_stages_run_in_order_once(project):
    assert project.run() == 0
    assert calls(project) == "a b c"
    assert project.run() == 0
    assert calls(project) == ""


def test_a_failed_stage_ends_the_run_and_the_next_run_continues_with_it(project):
    (project.root / "broken").touch()
    assert project.run() == 7
    assert calls(project) == "a b"
    kept = project.root / "work" / "kept"
    kept.touch()
    (project.root / "broken").unlink()
    assert project.run() == 0
    assert calls(project) == "b c"
    assert kept.exists()  # same inputs: the work of the failed stage is continued


def test_a_changed_input_runs_the_dependents_again_and_deletes_their_work(project):
    project.run()
    calls(project)
    stale = project.root / "work" / "stale"
    stale.touch()
    (project.root / "other").write_text("p")
    project.run()
    assert calls(project) == "b c"
    assert not stale.exists()
    (project.root / "source.py").write_text('"""About."""\nx = 1  # a comment\n')
    project.run()
    assert calls(project) == ""
    (project.root / "c").unlink()
    project.run()
    assert calls(project) == "c"
