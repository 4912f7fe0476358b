"""The command line as a user meets it: help, exit codes, streams, one-line errors."""

import json
import re
import socket
import subprocess
import tomllib
from pathlib import Path

import pytest
import rerun
import typer

from pdhef_logtool import __version__
from pdhef_logtool.storage.documents import seal
from tests.command_line import called

COMMANDS = (
    *("inspect", "map", "convert", "plan", "run", "metrics", "report", "compare", "query", "events", "view"),
    *("simulate", "simulate suite"),
    *("learn", "extract", "train", "compile"),
)


def _one_line_error(result: subprocess.CompletedProcess[str]) -> str:
    lines = [line for line in result.stderr.splitlines() if not line.startswith("warning: ")]
    assert len(lines) == 1, result.stderr
    assert "Traceback" not in result.stderr
    return lines[0]


def test_help_names_every_command_with_a_whole_sentence():
    text = called("--help", env={"COLUMNS": "80"}).stdout
    commands = text[text.index("Look at logs:") : text.index("Exit codes:")]
    listed = re.split(r"\n  (?=\S)", commands.replace("\n\n", "\n"))[1:]
    assert sorted(re.split(r"  +", entry)[0] for entry in listed) == sorted(COMMANDS)
    assert all(entry.splitlines()[0] and "..." not in entry for entry in listed)
    assert all(re.search(r"\.(\n[A-Z].*:)?\s*$", entry) for entry in listed)


def test_help_says_what_each_command_does():
    for command in COMMANDS:
        for width in (80, 120):
            text = called(*command.split(), "--help", env={"COLUMNS": str(width)}).stdout
            assert f"Usage: pdhef {command} [OPTIONS]" in text
            assert all(len(line) <= width for line in text.splitlines()), command
            examples = text[text.index("Examples:") :].splitlines()[1:]
            assert f"{examples[0]} ".startswith(f"    pdhef {command} ")


def test_the_table_of_commands_describes_each_option_and_no_other():
    from pdhef_logtool.cli import app

    texts = tomllib.loads(Path(app.__file__).with_name("commands.toml").read_text())
    for name, command in typer.main.get_command(app.app).commands.items():
        described = {p.name: p.help for p in command.params}
        assert all(described.values()), name
        assert texts[name].get("options", {}).keys() <= described.keys(), name


@pytest.mark.slow
def test_run_prints_a_table_on_stdout_and_warnings_on_stderr(sample_logs_dir, tmp_path):
    run = ("run", sample_logs_dir / "dlc.mcap", "-o", tmp_path, "--keep", "estimates", "--no-report", "-e")
    document = json.loads(called(*run, "zero", "--json").stdout)
    assert document["logs"][0]["report"] == json.loads((tmp_path / "logs/dlc/report.json").read_text())
    result = called(*run, "zero", "-e", "phy-ukf")
    assert document["exit_code"] == 0
    assert result.returncode == 0
    assert "\n phy-ukf " in result.stdout and "\n zero " in result.stdout
    assert "default sedan (no car given)" in " ".join(result.stdout.split())
    assert "warning" not in result.stdout + result.stderr  # the sample log must not cause warnings
    assert "truth" in result.stdout
    assert all(len(line) <= 160 for line in result.stdout.splitlines() if "outputs in" not in line)


def test_what_is_no_log_is_one_line_and_exit_code_1(tmp_path):
    (tmp_path / "no.mcap").write_bytes(b"hello, this is no log\n")
    for arguments in ("run no.mcap -o out", "inspect no.mcap"):
        result = called(*arguments.split(), cwd=tmp_path)
        assert result.returncode == 1
        assert "no.mcap" in _one_line_error(result)
        assert result.stdout == ""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        *((words, "none") for words in (
            "run NONE.mcap -o OUT", "inspect NONE.mcap", "metrics NONE.mcap --estimate /x --car saloon", "report NONE",
            "compare NONE NONE", "events NONE --where valid", "view NONE", "learn NONE.mcap --car saloon -o OUT",
            "train NONE -o OUT", "run LOG -o OUT --plan NONE", "run LOG -o OUT --model NONE",
            "metrics LOG --estimate /rtk/odometry --plan NONE",
        )),
        ("run LOG -o OUT --estimators pd-hof", "got pd-hof"),
        ("run LOG -o OUT --start yesterday", "--start"), ("run LOG -o OUT --start 900", "--start"),
        ("metrics LOG", "--estimate"), ("metrics LOG --estimate /rtk/odometry --junit OUT", "--plan"),
        ("metrics LOG --estimate /rtk/odometry --start 900", "--start"),
        ("run LOG -o OUT --annotate half", "half"), ("run *.mcap -o OUT", "*.mcap"), ("simulate dlc", "-o"),
        ("run", "pdhef run: Missing argument"), ("run x --no-such-flag", "pdhef run: No such option: --no-such-flag"),
        ("learn x --ouptut y", "--output"),
        ("simulate suite --cuont 3", "pdhef simulate suite: No such option: --cuont"), ("insepct x", "inspect"),
        ("fly", "pdhef --help"), ("learn x -o y --seed many", "--seed"),
    ],
)  # fmt: skip
def test_a_mistake_is_one_line_and_exit_code_2(sample_logs_dir, tmp_path, arguments, said):
    places = {"NONE": tmp_path / "none", "OUT": tmp_path / "out", "LOG": sample_logs_dir / "dlc.mcap"}
    words = [re.sub("NONE|OUT|LOG", lambda m: str(places[m[0]]), word) for word in arguments.split()]
    result = called(*words, cwd=tmp_path)
    assert result.returncode == 2, result.stderr
    assert said in _one_line_error(result)
    assert result.stdout == ""


def test_the_bare_command_shows_its_help_and_the_version_is_one_line():
    assert called("--version").stdout == f"pdhef {__version__}\n"
    result = called()
    assert result.returncode == 2
    assert "Look at logs:" in result.stderr


def test_settings_are_those_of_the_file_and_options_win(tmp_path):
    from pdhef_logtool.cli.options import run_config

    file = tmp_path / "pdhef.toml"
    file.write_text('sensors = "esp"\nbudget = 2\n')
    given = {"config_file": file, "assignments": ["budget=3.5", "waived=imu.mounting", "msgs=types/", "friction=0.4"]}
    config = run_config({**given, "friction": "0.9", "estimators": "zero, phy-ukf,"})
    assert (config.sensors, config.budget, config.waived, config.msgs) == ("esp", 3.5, ("imu.mounting",), Path("types"))
    assert (config.friction, config.estimators) == (0.9, ("zero", "phy-ukf"))


def test_quiet_leaves_errors_and_results_and_verbose_shows_progress(sample_logs_dir, tmp_path):
    car, log = str(sample_logs_dir / "vehicle.toml"), str(sample_logs_dir / "no_truth.mcap")
    run = ("run", log, "--car", car, "-e", "zero", "--end", "2", "--annotate", "none", "--no-report", "-o")
    plain, quiet = called(*run, str(tmp_path / "a")), called(*run, str(tmp_path / "b"), "--quiet")
    verbose = called("--verbose", *run, str(tmp_path / "c"))
    assert quiet.returncode == plain.returncode == verbose.returncode
    assert quiet.stderr == ""
    assert quiet.stdout.replace(str(tmp_path / "b"), "") == plain.stdout.replace(str(tmp_path / "a"), "")
    assert "no_truth" in verbose.stderr
    assert called("run", str(tmp_path / "none"), "-o", str(tmp_path / "d"), "-q").stderr.startswith("pdhef: ")
    assert called("-q", "--verbose", "run", log, "-o", str(tmp_path / "e")).returncode == 2


@pytest.mark.slow
def test_inspect_writes_a_mapping_that_run_takes(sample_logs_dir, tmp_path):
    log = str(sample_logs_dir / "dlc.mcap")
    mapping = tmp_path / "mapping.toml"
    result = called("inspect", log, "--write-mapping", str(mapping), "--json")
    assert result.returncode == 0
    document = json.loads(result.stdout)
    assert {"topics", "signals", "lost"} <= document.keys()
    assert document["lost"] == []
    assert {"name", "type", "encoding", "messages"} <= document["topics"][0].keys()
    auto = called("run", log, "-o", str(tmp_path / "a"), "--annotate", "none", "-e", "phy-ukf")
    mapped = called("run", log, "-o", str(tmp_path / "b"), "--annotate", "none", "-e", "phy-ukf", "-m", str(mapping))
    assert auto.returncode == mapped.returncode == 0
    name = "logs/dlc/estimates.parquet"
    assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def _run_of(folder: Path, *names: str) -> Path:
    """Write a run; every log except the last, which failed, has a recording with only a footer."""
    for name in names[:-1]:
        (folder / "logs" / name).mkdir(parents=True)
        (folder / "logs" / name / "recording.rrd").write_bytes(b"RRF2FOOT")
    logs = [{"log": name, "outcome": "ok"} for name in names]
    (folder / "run.json").write_text(json.dumps(seal({"format": "pdhef.run", "version": 1, "logs": logs})))
    (folder / "metrics.parquet").touch()
    return folder


@pytest.mark.slow
def test_view_says_what_is_missing(tmp_path):
    result = called("view", str(tmp_path))
    assert result.returncode == 1
    assert "run.json" in _one_line_error(result)
    result = called("view", str(_run_of(tmp_path / "out", "b", "a", "failed")), "--log", "failed")
    assert "expected a log named failed, got b, a" in _one_line_error(result)


def test_view_takes_all_recordings_of_a_run_or_the_named_ones(tmp_path, monkeypatch):
    from pdhef_logtool.cli import running

    out = _run_of(tmp_path, "b", "a", "failed")
    of = {name: out / "logs" / name / "recording.rrd" for name in ("a", "b")}
    assert running.find_recordings(out, []) == [of["b"], of["a"]]
    assert running.find_recordings(out, ["a", "a"]) == [of["a"]]
    assert running.find_recordings(out / "logs" / "b", []) == running.find_recordings(of["b"], []) == [of["b"]]
    called: list[list[str]] = []
    monkeypatch.setattr(running.subprocess, "call", lambda command: called.append(command) or 0)
    running.open_viewer([of["b"], of["a"]], web=True)
    assert called[0][1:] == ["-m", "rerun", "--bind", "127.0.0.1", "--new", "--web-viewer", str(of["b"]), str(of["a"])]


def test_view_serves_a_catalog_of_the_recordings(tmp_path, monkeypatch):
    from pdhef_logtool.cli import running

    recording = tmp_path / "recording.rrd"
    stream = rerun.RecordingStream("pdhef-x", recording_id="a")
    stream.save(recording)
    stream.flush()
    opened: list[str] = []

    def call(command: list[str]) -> int:
        host, _, port = command[-1].removeprefix("rerun+http://").partition(":")
        socket.create_connection((host, int(port)), timeout=5.0).close()  # the server is up while the viewer is
        opened.append(command[-1])
        return 0

    monkeypatch.setattr(running.subprocess, "call", call)
    done = called("view", str(recording), "--catalog", "--web")
    assert done.returncode == 0
    assert opened[0].startswith("rerun+http://127.0.0.1:")
    assert f"catalog at {opened[0]}, dataset recording" in done.stdout


def test_a_bug_of_ours_is_one_line_too(sample_logs_dir, tmp_path, monkeypatch):
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("on purpose")

    monkeypatch.setattr("pdhef_logtool.drive.reading.plan_drive", broken)
    words = ("run", sample_logs_dir / "dlc.mcap", "-o", tmp_path)
    plain = called(*words)
    assert plain.returncode == 1
    assert "internal error, RuntimeError: on purpose" in _one_line_error(plain)
    with pytest.raises(RuntimeError, match="on purpose"):
        called(*words, env={"PDHEF_TRACEBACK": "1"})


@pytest.mark.slow
def test_map_without_a_terminal_writes_what_was_found(sample_logs_dir, tmp_path):
    result = called("map", str(sample_logs_dir / "dlc.mcap"), "-o", "m.toml", cwd=tmp_path)
    assert result.returncode == 0
    assert "[signals.steer" in (tmp_path / "m.toml").read_text()
    again = called("map", str(sample_logs_dir / "dlc.mcap"), "-o", "m.toml", cwd=tmp_path)
    assert "one that exists" in _one_line_error(again)
