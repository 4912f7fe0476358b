"""The file that appears only when it is complete: the content of the folder after every way that writing can end."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.storage.files import PendingFile, write_bytes

DONE = {"out.bin": b"new"}


def folder(path: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in path.iterdir()}


def test_what_was_there_stays_until_the_new_file_is_complete(tmp_path: Path) -> None:
    (tmp_path / "out.bin").write_bytes(b"old")
    with PendingFile(tmp_path / "out.bin") as pending:
        pending.path.write_bytes(b"new")
        assert (tmp_path / "out.bin").read_bytes() == b"old"
    assert folder(tmp_path) == DONE


def test_what_a_killed_run_left_is_gone_from_the_start(tmp_path: Path) -> None:
    script = "import sys, pathlib; from pdhef_logtool.storage.files import PendingFile as P\n"
    script += "P(pathlib.Path(sys.argv[1])).path.write_bytes(b'half of an old one')"
    subprocess.run([sys.executable, "-c", script, str(tmp_path / "out.bin")], check=True)
    assert len(folder(tmp_path)) == 1
    pending = PendingFile(tmp_path / "out.bin")
    assert folder(tmp_path) == {}
    with pending, pending.path.open("ab") as file:  # a writer that appends must not continue the old one
        file.write(b"new")
    assert folder(tmp_path) == DONE


def test_the_content_is_on_the_disk_before_the_name_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
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
def test_a_commit_that_fails_says_where_and_removes_what_was_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, broken: str
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    (tmp_path / "out.bin").write_bytes(b"old")
    pending = PendingFile(tmp_path / "out.bin")
    pending.path.write_bytes(b"new")
    monkeypatch.setattr(*((os, "fsync", full) if broken == "fsync" else (Path, "replace", full)))
    with pytest.raises(OutputError, match=r"out\.bin.*No space left on device"):
        pending.commit()
    assert folder(tmp_path) == {"out.bin": b"old"}


def test_a_file_in_the_way_of_the_folder_is_an_output_error_at_once(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"")
    with pytest.raises(OutputError, match=r"a/out\.bin"):
        PendingFile(tmp_path / "a" / "out.bin")
