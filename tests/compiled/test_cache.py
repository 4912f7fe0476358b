"""Location of the compiled code, and limits of the cache."""

import errno
import importlib.util
import os
import shutil
import stat
import tempfile
from pathlib import Path
from types import ModuleType

import pytest

from pdhef_logtool.compiled import cache, sources

_ROOT = Path(__file__).parents[2]
TEMPORARY_FILE = tempfile.TemporaryFile
_CODE = "from pdhef_logtool.compiled.cache import njit\n\n\n@njit(cache=True)\ndef more(x):\n    return x + 1\n"


@pytest.fixture
def module_file(tmp_path, monkeypatch):
    """A module with one compiled function, and a separate installation, user folder and temporary folder."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    monkeypatch.setattr(cache, "announced", False)
    (tmp_path / "tmp").mkdir()
    file = tmp_path / "installed" / "pdhef_logtool" / "module.py"
    file.parent.mkdir(parents=True)
    file.write_text(_CODE)
    sources.compiled_digest()  # of the real sources
    monkeypatch.setattr(sources, "ROOT", tmp_path / "installed")
    cache.kept_in.cache_clear()
    yield file
    cache.kept_in.cache_clear()


def _load(file: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("module", file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _close(monkeypatch: pytest.MonkeyPatch, *folders: Path) -> None:
    """Make these folders read-only: permissions do not restrict root."""

    def file_in(dir: Path | str) -> object:  # noqa: A002
        if any(map(Path(dir).is_relative_to, folders)):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(dir))
        return TEMPORARY_FILE(dir=dir)

    monkeypatch.setattr(tempfile, "TemporaryFile", file_in)
    cache.kept_in.cache_clear()


def _code_files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.rglob("*") if p.suffix in (".nbi", ".nbc"))


def test_the_first_folder_that_can_be_written_keeps_the_code(module_file, tmp_path, monkeypatch, capsys):
    named, installed, home, tmp = (tmp_path / name for name in ("named", "installed", "home", "tmp"))
    monkeypatch.setattr(cache.config, "CACHE_DIR", str(named))
    order = (named, installed, home, tmp)
    for closed, keeps in ((order[:i], folder) for i, folder in enumerate(order)):
        monkeypatch.setattr(cache, "announced", False)
        _close(monkeypatch, *closed)
        assert _load(module_file).more(1) == 2
        assert _code_files(keeps), keeps
        assert "compiling, once, about" in capsys.readouterr().err
        assert _load(module_file).more(1) == 2
        assert capsys.readouterr().err == ""  # warm: no compilation
        shutil.rmtree(module_file.parent / "__pycache__", ignore_errors=True)
    assert stat.S_IMODE(next(tmp.glob("pdhef-compiled*")).stat().st_mode) == 0o700


def test_without_any_folder_it_runs_and_says_so(module_file, tmp_path, monkeypatch, capsys):
    _close(monkeypatch, tmp_path)
    assert _load(module_file).more(1) == 2
    assert not _code_files(tmp_path)
    assert "in every run" in capsys.readouterr().err


def test_code_serves_the_same_sources_at_another_place_and_time(module_file, tmp_path, monkeypatch, capsys):
    assert _load(module_file).more(1) == 2
    shutil.copytree(tmp_path / "installed", tmp_path / "other")
    elsewhere = tmp_path / "other" / module_file.relative_to(tmp_path / "installed")
    os.utime(elsewhere, (1, 1))
    monkeypatch.setattr(sources, "ROOT", tmp_path / "other")
    cache.kept_in.cache_clear()
    capsys.readouterr()
    monkeypatch.setattr(cache, "announced", False)
    assert _load(elsewhere).more(1) == 2
    assert capsys.readouterr().err == ""


@pytest.mark.slow
@pytest.mark.parametrize("length", [0, 40])
def test_a_file_that_was_cut_short_is_compiled_anew(module_file, length):
    _load(module_file).more(1)
    files = _code_files(module_file.parent)
    assert {p.parents[1].name for p in files} == {sources.compiled_digest()}
    assert {p.suffix for p in files} == {".nbi", ".nbc"}
    for damaged in files:
        with damaged.open("r+b") as file:
            file.truncate(length)
        assert _load(module_file).more(1) == 2
        assert all(p.stat().st_size > 1000 for p in files)


def test_a_full_disk_ends_no_call(module_file, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "replace", full)
    assert _load(module_file).more(1) == 2
    assert not _code_files(module_file.parent)


def test_two_processes_that_save_at_once_never_take_each_others_code(module_file, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr("numba.core.caching.IndexDataCacheFile._load_index", lambda _: {})  # neither has read the other's
        patch.setattr("pdhef_logtool.compiled.cache.os.getpid", iter(range(100)).__next__)
        function = _load(module_file).more
        assert (function(1), function(1.5)) == (2, 2.5)
    assert [p.suffix for p in _code_files(module_file.parent)].count(".nbc") == 2
    again = _load(module_file).more
    assert (again(1), again(1.5)) == (2, 2.5)


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="users and permissions of POSIX")
def test_a_temporary_folder_of_somebody_else_is_not_taken(module_file, tmp_path, monkeypatch):
    def is_taken() -> bool:
        _close(monkeypatch, tmp_path / "installed", tmp_path / "home")
        kept = cache.kept_in()
        return kept is not None and kept.is_relative_to(folder)

    folder = tmp_path / "tmp" / f"pdhef-compiled-{os.getuid()}"
    folder.mkdir()
    folder.chmod(0o777)  # anybody could put code there
    assert not is_taken()
    folder.rmdir()
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    folder.symlink_to(tmp_path / "elsewhere")
    assert not is_taken()
    folder.unlink()
    assert is_taken()
    other = folder.stat().st_uid + 1
    folder = folder.with_name(f"pdhef-compiled-{other}")
    folder.mkdir(mode=0o700)
    monkeypatch.setattr(os, "getuid", lambda: other)
    assert not is_taken()


def test_the_code_of_other_sources_of_this_installation_is_removed_and_no_other(module_file, tmp_path):
    of_sources, of_processor = sources.compiled_digest().split("-")
    installed = module_file.parent / "__pycache__/compiled"
    stale = installed / f"{'0' * 16}-{of_processor}" / "a.nbi"
    others = [
        installed / f"{of_sources}-{'0' * 8}" / "a.nbi",  # another processor
        tmp_path / "home/numba" / f"pdhef_logtool_{'0' * 16}" / f"{'0' * 16}-{of_processor}" / "a.nbi",
        installed / "notes" / "a.nbi",
    ]
    for file in (stale, *others):
        file.parent.mkdir(parents=True)
        file.touch()
    assert _load(module_file).more(1) == 2
    assert not stale.exists()
    assert all(f.exists() for f in others)


def test_what_compiled_code_is_made_of():
    names = {p.relative_to(_ROOT).as_posix() for p in sources.compiled_sources()}
    assert {"pdhef_logtool/estimators/vehicle_ukf.py", "truthsim/motion.py", "truthsim/tyres.py"} <= names
    assert "pdhef_logtool/records/signals.py" in names  # constants
    assert "pdhef_logtool/compiled/cache.py" in names
    assert not names & {"pdhef_logtool/cli/app.py", "pdhef_logtool/workers/supervisor.py"}
    assert all(
        p.relative_to(_ROOT).as_posix() in names
        for package in sources.PACKAGES
        for p in (_ROOT / package).rglob("*.py")
        if "njit" in p.read_text() and p.name != "sources.py"
    )


def test_another_compiler_or_processor_is_another_digest(monkeypatch):
    def digest() -> str:
        sources.compiled_digest.cache_clear()
        return sources.compiled_digest()

    usual = digest()
    monkeypatch.setenv("NUMBA_CPU_NAME", "generic")
    assert digest().split("-")[0] == usual.split("-")[0] and digest() != usual
    monkeypatch.delenv("NUMBA_CPU_NAME")
    for changed in ("numba", "llvmlite"):
        monkeypatch.setattr(sources, "version", lambda name, c=changed: "0" if name == c else "1")
        assert digest().split("-")[0] != usual.split("-")[0]
    monkeypatch.undo()
    assert digest() == usual


def test_an_edit_of_a_callee_in_another_file_counts(tmp_path):
    for package in sources.PACKAGES:
        shutil.copytree(_ROOT / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__", "models"))
    before = sources.sources_digest(tmp_path)
    assert before == sources.sources_digest()
    for file, is_compiled in (("cli/app.py", False), ("car/nominal_model.py", True)):
        with (tmp_path / "pdhef_logtool" / file).open("a") as text:
            text.write("\nG = 1.0\n")
        assert (sources.sources_digest(tmp_path) != before) is is_compiled
