"""Where machine code is kept, and what no cache may do."""

from __future__ import annotations

import importlib.util
import os
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from pdhef_logtool.records import compiled, processes

_ROOT = Path(__file__).parents[2]
_CODE = "from pdhef_logtool.records.compiled import njit\n\n\n@njit(cache=True)\ndef more(x):\n    return x + 1\n"


@pytest.fixture
def module_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A module with one compiled function, and a user and temporary folders of its own."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    monkeypatch.setattr(compiled, "_announced", [])
    (tmp_path / "tmp").mkdir()
    (tmp_path / "package").mkdir()
    file = tmp_path / "package" / "module.py"
    file.write_text(_CODE)
    compiled.kept_in.cache_clear()
    yield file
    compiled.kept_in.cache_clear()


def _load(file: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("module", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _close(monkeypatch: pytest.MonkeyPatch, *folders: Path) -> None:
    """Let nothing be written below these folders: permissions do not hold back root."""
    monkeypatch.setattr(
        compiled, "_writable", lambda f, was=compiled._writable: not any(map(f.is_relative_to, folders)) and was(f)
    )
    compiled.kept_in.cache_clear()


def _code_files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.suffix in (".nbi", ".nbc"))


def test_the_first_folder_that_can_be_written_keeps_the_code(
    module_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    installed, home, tmp = module_file.parent, tmp_path / "home", tmp_path / "tmp"
    for closed, keeps in [((), installed), ((installed,), home), ((installed, home), tmp)]:
        _close(monkeypatch, *closed)
        assert _load(module_file).more(1) == 2
        assert _code_files(keeps), keeps
        assert "compiling, once, about" in capsys.readouterr().err
        assert _load(module_file).more(1) == 2
        assert capsys.readouterr().err == ""  # warm: nothing is compiled
        monkeypatch.undo()
        monkeypatch.setattr(compiled, "_announced", [])
        monkeypatch.setattr(tempfile, "tempdir", str(tmp))
        monkeypatch.setenv("XDG_CACHE_HOME", str(home))
        shutil.rmtree(installed / "__pycache__", ignore_errors=True)
    assert stat.S_IMODE(next(tmp.glob("pdhef-compiled*")).stat().st_mode) == 0o700


def test_without_any_folder_it_runs_and_says_so(
    module_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _close(monkeypatch, tmp_path)
    assert _load(module_file).more(1) == 2
    assert not _code_files(tmp_path)
    assert "in every run" in capsys.readouterr().err


def test_what_an_installation_brings_along_serves_where_nobody_can_write_it(
    module_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _load(module_file).more(1)
    capsys.readouterr()
    _close(monkeypatch, tmp_path)
    monkeypatch.setattr(compiled, "_announced", [])
    assert _load(module_file).more(1) == 2
    assert capsys.readouterr().err == ""


@pytest.mark.slow
@pytest.mark.parametrize("length", [0, 1, 40])
def test_a_file_that_was_cut_short_is_compiled_anew(module_file: Path, length: int) -> None:
    _load(module_file).more(1)
    files = _code_files(module_file.parent)
    assert {p.suffix for p in files} == {".nbi", ".nbc"}
    for damaged in files:
        with damaged.open("r+b") as file:
            file.truncate(length)
        assert _load(module_file).more(1) == 2
        assert all(p.stat().st_size > 1000 for p in files)


def test_a_full_disk_ends_no_call(module_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("numba.core.caching.IndexDataCacheFile.save", full)
    assert _load(module_file).more(1) == 2


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="users and permissions of POSIX")
def test_a_temporary_folder_of_somebody_else_is_not_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder = tmp_path / f"pdhef-compiled-{os.getuid()}"
    folder.mkdir()
    folder.chmod(0o777)  # anybody could put code there
    assert compiled._private_folder() is None
    folder.rmdir()
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    folder.symlink_to(tmp_path / "elsewhere")
    assert compiled._private_folder() is None
    folder.unlink()
    assert compiled._private_folder() == folder
    monkeypatch.setattr(os, "getuid", lambda: folder.stat().st_uid + 1)
    (tmp_path / f"pdhef-compiled-{os.getuid()}").mkdir(mode=0o700)
    assert compiled._private_folder() is None


def _as_nobody(python: str, *arguments: str) -> list[str]:
    """Return a command that runs as nobody, or, where nobody reaches this interpreter, as root without its powers."""
    setpriv = shutil.which("setpriv")
    if setpriv is None or os.geteuid() != 0:
        pytest.skip("only root, with setpriv, can become another user")
    for user in (
        ("--reuid=65534", "--regid=65534", "--clear-groups"),
        ("--bounding-set=-all", "--inh-caps=-all", "--clear-groups"),
    ):
        command = [setpriv, *user, python]
        if subprocess.run([*command, "-c", "import numba"], capture_output=True, cwd="/").returncode == 0:
            return [*command, *arguments]
    pytest.skip("no other user can run this interpreter")


@pytest.mark.slow
def test_a_run_works_as_nobody_with_a_read_only_installation_and_no_home(tmp_path: Path) -> None:
    # Outside of pytest's own folder, which is this user's alone.
    with tempfile.TemporaryDirectory(prefix="pdhef-nobody-") as folder:
        installed, output, tmp = (Path(folder) / name for name in ("installed", "out", "tmp"))
        ignored = shutil.ignore_patterns("__pycache__")
        for part in ("pdhef_logtool", "truthsim", "schemas"):
            shutil.copytree(_ROOT / part, installed / part, ignore=ignored)
        shutil.copy(_ROOT / "sample_logs" / "dlc.mcap", installed)
        Path(folder).chmod(0o755)
        for place in (output, tmp):
            place.mkdir()
            place.chmod(0o777)
        subprocess.run(["chmod", "-R", "a-w,a+rX", str(installed)], check=True)
        arguments = ("-m", "pdhef_logtool", "run", str(installed / "dlc.mcap"), "--car", "saloon", "-o")
        command = _as_nobody(sys.executable, *arguments, str(output / "run"), "--estimators", "zero,kinematic")
        environment = {"PATH": os.environ["PATH"], "HOME": "/proc/nonexistent", "TMPDIR": str(tmp)}
        environment["PYTHONPATH"] = os.pathsep.join([str(installed), *filter(None, sys.path)])
        first = subprocess.run(command, capture_output=True, text=True, cwd="/", env=environment)
        assert first.returncode == 0, first.stderr
        assert "compiling, once" in first.stderr
        assert str(tmp) in first.stderr
        assert (output / "run" / "run.json").is_file()
        command[-3] = str(output / "again")
        again = subprocess.run(command, capture_output=True, text=True, cwd="/", env=environment)
        assert again.returncode == 0, again.stderr
        assert "compiling" not in again.stderr


def test_kept_code_is_loaded_before_it_is_called(
    module_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    first = _load(module_file)
    assert first.more(1) == 2
    assert first.more(1.5) == 2.5
    capsys.readouterr()
    monkeypatch.setattr(compiled, "_announced", [])
    monkeypatch.setattr(compiled, "_kept", [])
    again = _load(module_file)
    assert compiled.load_kept()
    assert set(again.more.signatures) == set(first.more.signatures)
    assert capsys.readouterr().err == ""
    for file in _code_files(module_file.parent):
        file.write_bytes(b"cut")
    cut = _load(module_file)
    monkeypatch.setattr(compiled, "_kept", [cut.more])
    assert not compiled.load_kept()
    assert cut.more.signatures == []


def test_of_the_workers_only_the_first_says_that_it_compiles(
    module_file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(processes, "worker_number", 2)
    assert _load(module_file).more(1) == 2
    assert capsys.readouterr().err == ""
