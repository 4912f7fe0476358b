"""Regenerate everything that is derived from the sources: shipped vehicle files, cars, networks, evidence pages.

    python -m studies.recalibrate [--only STAGE ...] [--evidence]

The stages run in the order of ``recalibrate.toml``. A stage is skipped if its outputs exist and its command and
the digest of its inputs have not changed since its last completion. After a failure or an interruption, the same
command continues with the stage that was not completed; if its inputs have changed since, its work folders are deleted
first. Comments, docstrings and the layout of pages (``studies.pages``, ``studies.pictures``) do not count as inputs.
The stamp files are in ``out/recalibrate``. ``--evidence``: only the stages that write pages of ``docs``.
"""

import ast
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from pdhef_logtool.storage.documents import digest
from studies.pages import ROOT, options, read_json, read_toml, write_json

STAMPS = Path("out") / "recalibrate"
TABLE = Path(__file__).with_suffix(".toml")


@dataclass(frozen=True, slots=True)
class Stage:
    """One command, with paths as in the table (``recalibrate.toml``)."""

    name: str
    command: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    duration: str = "not measured"
    work: tuple[str, ...] = ()


def load_stages() -> tuple[Stage, ...]:
    """Return the stages of the table, with the sets of its inputs expanded."""
    document = read_toml(TABLE)
    sets = document.pop("sets", {})

    def expanded(patterns: Sequence[str]) -> Iterator[str]:
        for pattern in patterns:
            yield from expanded(sets[pattern[1:]]) if pattern.startswith("@") else (pattern,)

    def entries(table: dict[str, Any]) -> dict[str, Any]:
        return {key: v if isinstance(v, str) else tuple(expanded(v)) for key, v in table.items()}

    return tuple(Stage(name, **entries(table)) for name, table in document.items())


def input_digest(root: Path, inputs: Sequence[str]) -> str:
    """Return the digest of all input files; one that is missing counts as such."""
    return digest([[pattern, [list(entry) for entry in _entries(root, pattern)]] for pattern in inputs])


def _entries(root: Path, pattern: str) -> Iterator[tuple[str, str]]:
    """Yield the files of a pattern with their digests; files outside the repository with their sizes."""
    for path in sorted(root.glob(pattern)):
        for file in sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]:
            if "__pycache__" not in file.parts:
                state, is_inside = file.stat(), file.resolve().is_relative_to(root.resolve())
                content = _file_digest(file, state.st_mtime_ns, state.st_size) if is_inside else str(state.st_size)
                yield os.path.relpath(file, root), content


@cache
def _file_digest(file: Path, _mtime_ns: int, _size: int) -> str:
    if file.suffix != ".py":
        return digest(file.read_bytes().hex())
    tree = ast.parse(file.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(node) is not None:
            node.body = node.body[1:]
    return digest(ast.dump(tree))


class Recalibration:
    """Stages of a repository with their stamps."""

    def __init__(self, root: Path, stages: Sequence[Stage]) -> None:
        self.root, self.stages = root, stages

    def stamp(self, stage: Stage) -> dict[str, Any]:
        """Return command, inputs and duration of the last start of a stage; empty before the first."""
        file = self.root / STAMPS / f"{stage.name}.json"
        return read_json(file) if file.is_file() else {}

    def inputs(self, stage: Stage) -> dict[str, str]:
        """Return what decides the outputs of a stage: its command and the digest of its inputs."""
        return {"command": stage.command, "inputs": input_digest(self.root, stage.inputs)}

    def is_complete(self, stage: Stage) -> bool:
        """Return whether the stage is unchanged since its last completion."""
        stamp = self.stamp(stage)
        is_same = "duration_s" in stamp and stamp | self.inputs(stage) == stamp
        return is_same and all((self.root / o).exists() for o in stage.outputs)

    def run(self, only: Sequence[str] = ()) -> int:
        """Run the stages that are not complete, up to the first that fails; return its exit code, or 0."""
        for stage in self.stages:
            if only and stage.name not in only:
                continue
            if self.is_complete(stage):
                print(f"{stage.name}: unchanged", flush=True)
            elif code := self._run(stage):
                print(f"{stage.name} failed with exit code {code}; the same command continues here", file=sys.stderr)
                return code
        return 0

    def _run(self, stage: Stage) -> int:
        begun, before, start = self.inputs(stage), self.stamp(stage), time.monotonic()
        if before | begun != before:
            for folder in stage.work:
                shutil.rmtree(self.root / folder, ignore_errors=True)
        write_json(self.root / STAMPS / f"{stage.name}.json", begun)
        print(f"{stage.name}: {stage.command}", flush=True)
        words = [sys.executable if word == "python" else word for word in shlex.split(stage.command)]
        ended = subprocess.run(words, cwd=self.root, env={**os.environ, "OMP_NUM_THREADS": "1"}, check=False)
        if ended.returncode:
            return ended.returncode
        if missing := [o for o in stage.outputs if not (self.root / o).exists()]:
            print(f"{stage.name}: expected {', '.join(missing)}, got no such file", file=sys.stderr)
            return 1
        ended_s = {"duration_s": round(time.monotonic() - start, 1)}
        write_json(self.root / STAMPS / f"{stage.name}.json", begun | ended_s)
        return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the stages."""
    parser = options("recalibrate", __doc__)
    stages = load_stages()
    parser.add_argument("--only", nargs="+", choices=[s.name for s in stages], metavar="STAGE", help="run these alone")
    parser.add_argument("--evidence", action="store_true", help="run the stages that write pages of docs alone")
    given = parser.parse_args(arguments)
    if given.evidence:
        given.only = [s.name for s in stages if any(output.startswith("docs/") for output in s.outputs)]
    return Recalibration(ROOT, stages).run(given.only or ())


if __name__ == "__main__":
    sys.exit(main())
