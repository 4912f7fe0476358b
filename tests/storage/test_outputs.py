"""A folder that one command holds, changes to it that happen whole or not at all, and outputs that are no inputs."""

import ctypes
import errno
import os
import shutil
import signal
import subprocess
import sys
from itertools import count
from pathlib import Path

import pytest

from pdhef_logtool.records.errors import OutputError, UsageError
from pdhef_logtool.records.processes import process_name
from pdhef_logtool.storage.files import PendingFile, scratch_folder, write_bytes
from pdhef_logtool.storage.outputs import LOCK_FILE, FolderLock, FolderTransaction, OutputFolder, check_no_input
from tests.failing_writes import CALLS, failing_writes

OLD = {"a.txt": "old a", "b.txt": "old b"}


def make(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def texts(folder: Path) -> dict[str, str]:
    return {p.relative_to(folder).as_posix(): p.read_text() for p in sorted(folder.rglob("*")) if p.is_file()}


def without_exchange(*_: object, **__: object) -> object:
    """Stand for a C library without renameat2."""
    return object()


@pytest.fixture(params=[True, False], ids=["exchange", "renames"])
def exchange(request, monkeypatch):
    if not request.param:
        monkeypatch.setattr(ctypes, "CDLL", without_exchange)
    return bool(request.param)


# ------------------------------------------------------------------------------------------------ transactions


@pytest.mark.parametrize("old", [{}, OLD], ids=["new", "replaced"])
def test_a_folder_appears_or_is_replaced_at_once(tmp_path, exchange, old):
    make(tmp_path / "out" / "x", old)
    with FolderTransaction(tmp_path / "out" / "x", keep=False) as change:
        write_bytes(change.file("a.txt"), b"new a")
        assert texts(tmp_path / "out" / "x") == old
    assert texts(tmp_path) == {"out/x/a.txt": "new a"}
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["x"]


def test_what_the_new_folder_has_not_is_kept_with_its_identity(tmp_path, exchange):
    notes = {"notes.txt": "mine", "pictures/1/p.png": "p", ".hidden": "h"}
    make(tmp_path / "x", {**OLD, **notes})
    (tmp_path / "x" / "link").symlink_to("../elsewhere")
    (tmp_path / "x").chmod(0o750)
    number = (tmp_path / "x" / "notes.txt").stat().st_ino
    with FolderTransaction(tmp_path / "x") as change:
        write_bytes(change.file("a.txt"), b"new a")
    assert texts(tmp_path / "x") == {"a.txt": "new a", "b.txt": "old b", **notes}
    assert (tmp_path / "x" / "notes.txt").stat().st_ino == number
    assert (tmp_path / "x" / "link").readlink() == Path("../elsewhere")
    assert (tmp_path / "x").stat().st_mode & 0o777 == 0o750
    assert [p.name for p in tmp_path.iterdir()] == ["x"]


@pytest.mark.parametrize("failure", [ValueError, KeyboardInterrupt])
def test_an_exception_leaves_the_old_folder(tmp_path, failure):
    make(tmp_path / "x", OLD)
    with pytest.raises(failure), FolderTransaction(tmp_path / "x") as change:
        write_bytes(change.file("a.txt"), b"new a")
        raise failure
    assert texts(tmp_path) == {f"x/{n}": t for n, t in OLD.items()}
    assert [p.name for p in tmp_path.iterdir()] == ["x"]


def test_a_file_in_the_way_is_one_line_and_stays(tmp_path):
    (tmp_path / "x").write_text("mine")
    with pytest.raises(OutputError, match="something else has that name"):
        FolderTransaction(tmp_path / "x")
    assert texts(tmp_path) == {"x": "mine"}


def test_whichever_call_fails_one_of_the_two_is_whole(tmp_path, exchange):
    before = {**OLD, "notes.txt": "mine"}
    for number in count(1):
        folder = tmp_path / f"{number}" / "x"
        make(folder, before)
        with failing_writes(number, errno.EIO, (*CALLS, "chmod", "open")) as failing:
            try:
                with FolderTransaction(folder) as change:
                    write_bytes(change.file("a.txt"), b"new a")
            except OutputError as error:
                assert "Input/output error" in str(error)
        found, new, done = texts(folder), {**before, "a.txt": "new a"}, failing.count < number
        assert found == new or (found == before and not done), number
        FolderTransaction(folder).discard()  # the next command removes the remains of a failed clean-up
        assert [p.name for p in folder.parent.iterdir()] == ["x"], number
        if done:
            break
    assert number > 8


def test_a_kill_between_the_two_renames_is_repaired(tmp_path, monkeypatch):
    make(tmp_path / "logs" / "x", OLD)
    child = os.fork()
    if child == 0:  # ends like a killed process, without clean-up
        ctypes.CDLL = without_exchange
        rename = Path.rename

        def dies(self: Path, target: Path) -> Path:
            if self.name == "new":
                os._exit(9)
            return rename(self, target)

        Path.rename = dies
        with FolderTransaction(tmp_path / "logs" / "x") as change:
            write_bytes(change.file("a.txt"), b"new a")
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 9
    assert not (tmp_path / "logs" / "x").exists()
    with OutputFolder(tmp_path, ("logs",)):
        assert texts(tmp_path) == {f"logs/x/{n}": t for n, t in OLD.items()}


# --------------------------------------------------------------------------------------------------- holding


HOLD = """
import sys, time, pathlib
from pdhef_logtool.storage.outputs import OutputFolder
if sys.argv[2] == "file":
    import fcntl
    def none(*_): raise OSError(22, "no lock")
    fcntl.flock = none
with OutputFolder(pathlib.Path(sys.argv[1]), ("logs",)) as held:
    change = held.begin("logs/x")
    change.file("half").write_bytes(b"half")
    print("held", flush=True)
    time.sleep(600)
"""


def _no_kernel_lock(*_: int) -> None:
    raise OSError(errno.EINVAL, "no lock")


@pytest.fixture(params=["kernel", "file"])
def kind(request, monkeypatch):
    if request.param == "file":
        monkeypatch.setattr("fcntl.flock", _no_kernel_lock)
    return str(request.param)


def test_a_held_folder_is_refused_and_free_again_when_its_holder_is_dead(tmp_path, kind):
    with subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path), kind], stdout=subprocess.PIPE) as holder:
        holder.stdout.readline()
        before = texts(tmp_path)
        with pytest.raises(OutputError, match="got one that another command is writing to") as caught:
            OutputFolder(tmp_path, ("logs",)).__enter__()
        assert caught.value.exit_code == 1
        assert texts(tmp_path) == before
        assert "logs/.pdhef/x/new/half" in before  # a living run's are not swept
        holder.kill()
    with OutputFolder(tmp_path, ("logs",)):
        assert [p for p in tmp_path.rglob("*") if p.name != LOCK_FILE] == [tmp_path / "logs"]
    assert [p.name for p in tmp_path.iterdir()] == ["logs"]


def test_the_same_process_is_refused_too(tmp_path, kind):
    with OutputFolder(tmp_path), pytest.raises(OutputError):
        OutputFolder(tmp_path).__enter__()
    with OutputFolder(tmp_path):
        pass


def test_a_lock_file_of_another_host_says_what_to_do(tmp_path, monkeypatch):
    monkeypatch.setattr("fcntl.flock", _no_kernel_lock)
    (tmp_path / LOCK_FILE).write_text("00000000-1-1")
    with pytest.raises(OutputError, match=f"remove {LOCK_FILE}"):
        FolderLock(tmp_path).acquire()


def test_a_lock_is_on_the_folder_that_has_the_name_now(tmp_path):
    folder = tmp_path / "x"
    one, two = FolderLock(folder), FolderLock(folder)
    one.acquire()
    folder.rename(tmp_path / "old")
    two.acquire()
    one.release()
    with pytest.raises(OutputError):
        FolderLock(folder).acquire()
    two.release()


def test_what_killed_processes_left_is_swept_and_what_others_own_is_not(tmp_path):
    host, pid, start = process_name().split("-")
    dead, foreign = f"{host}-{pid}-{int(start) + 1}", "00000000-1-1"
    mine = {"notes.partial": "mine", ".notes.partial": "mine", "logs/x/.vimrc": "mine", "logs/x/a.part": "mine"}
    alive = {f".run.json.{process_name()}.partial": "half"}
    make(tmp_path, mine | alive)
    make(tmp_path, {f".run.json.{dead}.partial": "", f"logs/x/.report.json.{foreign}.partial": ""})
    make(tmp_path / "logs" / ".pdhef" / "y" / "new", {"report.json": ""})
    with OutputFolder(tmp_path, ("logs",)):
        assert texts(tmp_path) == mine | alive
    shutil.rmtree(tmp_path / "logs")
    write_bytes(tmp_path / "other.txt", b"")  # a file alone leaves other hosts' alone
    assert texts(tmp_path) == {n: t for n, t in (mine | alive).items() if "/" not in n} | {"other.txt": ""}


def test_scratch_folders_of_killed_processes_are_swept(tmp_path, monkeypatch):
    import tempfile

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    script = "import os, signal; from pdhef_logtool.storage.files import scratch_folder as s\n"
    script += f"f = s(); open(f.name + '/copy', 'w').close(); os.kill(os.getpid(), {signal.SIGKILL:d})"
    subprocess.run([sys.executable, "-c", script], env={**os.environ, "TMPDIR": str(tmp_path)}, check=False)
    (tmp_path / "pdhef-somebody-else").mkdir()
    assert len(list(tmp_path.iterdir())) == 2
    with scratch_folder() as folder:
        assert {p.name for p in tmp_path.iterdir()} == {"pdhef-somebody-else", Path(folder).name}


# ----------------------------------------------------------------------------------------- inputs and outputs


def test_an_output_that_is_an_input_is_refused_by_whatever_name(tmp_path):
    make(tmp_path, {"d/logs/x/x.mcap": "log", "car/vehicle.toml": "car", "free/y.mcap": "log"})
    log = tmp_path / "d" / "logs" / "x" / "x.mcap"
    (tmp_path / "symlink").symlink_to(tmp_path / "d")
    os.link(log, tmp_path / "hard.mcap")
    folder = tmp_path / "d" / "logs" / "x"
    refused = [
        ([log], [log], []),
        ([log], [tmp_path / "hard.mcap"], []),
        ([tmp_path / "hard.mcap"], [log], []),
        ([tmp_path / "symlink" / "logs" / "x" / "x.mcap"], [log], []),
        ([log], [], [folder]),
        ([log], [], [tmp_path / "symlink" / "logs" / "x"]),
        ([folder], [], [folder]),
        ([folder], [], [tmp_path / "d"]),
        ([folder], [log], []),  # a storage file of a folder that is read
        ([tmp_path / "car"], [tmp_path / "car" / "vehicle.toml"], []),
    ]
    for inputs, files, folders in refused:
        with pytest.raises(UsageError, match="which would replace the input"):
            check_no_input(inputs, files, folders)
    free = [tmp_path / "free" / "x.mcap", tmp_path / "none2"]
    check_no_input([log, None, tmp_path / "none"], free, [tmp_path / "car"])
    check_no_input([folder], [folder / "out" / "report.json"], [folder / "out"])  # beside the files of a log folder
    check_no_input([log], [folder / "report.json"], [tmp_path / "d" / "logs" / "xx"])


def test_without_hard_links_what_is_kept_is_copied(tmp_path, monkeypatch):
    def no_links(*_: object, **__: object) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    make(tmp_path / "x", {**OLD, "notes.txt": "mine"})
    monkeypatch.setattr(os, "link", no_links)
    with FolderTransaction(tmp_path / "x") as change:
        write_bytes(change.file("a.txt"), b"new a")
    assert texts(tmp_path / "x") == {"a.txt": "new a", "b.txt": "old b", "notes.txt": "mine"}


DONE = {"out.bin": b"new"}


def folder(path: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in path.iterdir()}


def test_what_a_killed_run_left_is_gone_from_the_start(tmp_path):
    script = "import sys, pathlib; from pdhef_logtool.storage.files import PendingFile as P\n"
    script += "P(pathlib.Path(sys.argv[1])).path.write_bytes(b'half of an old one')"
    subprocess.run([sys.executable, "-c", script, str(tmp_path / "out.bin")], check=True)
    assert len(folder(tmp_path)) == 1
    pending = PendingFile(tmp_path / "out.bin")
    assert folder(tmp_path) == {}
    with pending, pending.path.open("ab") as file:  # a writer that appends must not continue the old one
        file.write(b"new")
    assert folder(tmp_path) == DONE


def test_the_content_is_on_the_disk_before_the_name_is(tmp_path, monkeypatch):
    events: list[str] = []
    partial = PendingFile(tmp_path / "out.bin").path
    fsync, rename = os.fsync, Path.replace

    def note_fsync(descriptor: int) -> None:
        if partial.exists() and os.path.samestat(os.fstat(descriptor), partial.stat()):
            events.append("fsync")
        elif os.path.samestat(os.fstat(descriptor), tmp_path.stat()):
            events.append("fsync of the folder")
        fsync(descriptor)

    def note_rename(self: Path, target: Path) -> Path:
        events.append(f"{self.name} -> {target.name}")
        return rename(self, target)

    monkeypatch.setattr(os, "fsync", note_fsync)
    monkeypatch.setattr(Path, "replace", note_rename)
    write_bytes(tmp_path / "out.bin", b"new")
    assert events == ["fsync", f"{partial.name} -> out.bin", "fsync of the folder"]
    assert folder(tmp_path) == DONE


@pytest.mark.parametrize("broken", ["fsync", "replace"])
def test_a_commit_that_fails_says_where_and_removes_what_was_written(tmp_path, monkeypatch, broken):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    (tmp_path / "out.bin").write_bytes(b"old")
    pending = PendingFile(tmp_path / "out.bin")
    pending.path.write_bytes(b"new")
    monkeypatch.setattr(*((os, "fsync", full) if broken == "fsync" else (Path, "replace", full)))
    with pytest.raises(OutputError, match=r"out\.bin.*No space left on device"):
        pending.commit()
    assert folder(tmp_path) == {"out.bin": b"old"}


def test_a_file_in_the_way_of_the_folder_is_an_output_error_at_once(tmp_path):
    (tmp_path / "a").write_bytes(b"")
    with pytest.raises(OutputError, match=r"a/out\.bin"):
        PendingFile(tmp_path / "a" / "out.bin")
