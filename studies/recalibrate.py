"""Regenerate everything that is derived from the sources: shipped vehicle files, cars, networks, evidence pages.

    python -m studies.recalibrate [--list] [--only STAGE ...]

The stages run in the order of the table. A stage is skipped if the command and the digest of its inputs are those of
its last completion and its outputs exist. After a failure or an interruption, the same command continues with the stage
that was not completed; if its inputs have changed since, its work folders are deleted first. Comments, docstrings and
the layout of pages (``studies.pages``, ``studies.pictures``) do not count as inputs. Constants that were chosen once
(``studies/defaults/tune_*.py``) stay. The stamp files are in ``out/recalibrate``.
"""

from __future__ import annotations

import ast
import json
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
from studies.pages import ROOT, options, table

STAMPS = Path("out") / "recalibrate"
SIMULATOR = ("truthsim",)
#: Packages that decide estimates and parameters.
FILTERS = tuple(
    f"pdhef_logtool/{name}"
    for name in ("car", "drive", "estimators", "evaluation", "learning", "logs", "mapping", "records", "residual_model")
)
TOOL = ("pdhef_logtool/**/*.py", *SIMULATOR)
CAR, TRAINING = "pdhef_logtool/models/default", "out/train-default"
_TRAIN = "python -m studies.defaults.train_default --steps"
#: Parts of the shipped car, and both shipped networks.
SHIPPED = ("pdhef_logtool/models",)
RECORDED = "../shared/data/drives"
INDEPENDENT = "../shared/data/independent_sim"


@dataclass(frozen=True, slots=True)
class Stage:
    """One command. Paths and glob patterns are relative to the repository; a folder stands for all files below it.

    ``work`` : folders in which the command continues after an interruption. ``duration`` : on two cores.
    """

    name: str
    command: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    duration: str = "not measured"
    work: tuple[str, ...] = ()


def _trained(step: str, inputs: tuple[str, ...], outputs: tuple[str, ...], *work: str, **more: str) -> Stage:
    sources = (*FILTERS, "studies/defaults/train_default.py", "studies/defaults/fit_physics.py")
    return Stage(step, f"{_TRAIN} {step}", (*sources, *inputs), outputs, work=work, **more)


def _page(name: str, module: str, page: str, *inputs: str, arguments: str = "", **more: Any) -> Stage:
    sources = f"studies/{module}" if (ROOT / "studies" / module).is_dir() else f"studies/{module}.py"
    command = f"python -m studies.{module} {arguments}".rstrip()
    return Stage(name, command, (*TOOL, *SHIPPED, sources, *inputs), (f"docs/{page}.md",), **more)


_DRIVES = tuple(f"{TRAINING}/{name}/manifest.json" for name in ("one_car", "other_cars", "evidence"))
_DATASETS = tuple(f"{TRAINING}/{model}/manifest.json" for model in ("physics", "nominal"))
_CONDITION_SOURCES = ("studies/condition_drives.py", "studies/condition_runs.py", "studies/conditions_page.py")
STAGES: tuple[Stage, ...] = (
    Stage(
        "vehicle-files",
        "python -m studies.defaults.fit_nominal_tyres",
        (*SIMULATOR, "studies/defaults/fit_nominal_tyres.py"),
        ("sample_logs/vehicle.toml", "sample_logs/vehicle_mu03.toml"),
        duration="2 s",
    ),
    Stage(
        "simulate",
        f"{_TRAIN} simulate",
        (*SIMULATOR, "studies/defaults/train_default.py", "sample_logs/vehicle.toml"),
        (f"{CAR}/vehicle.toml", *_DRIVES),
        work=tuple(f"{TRAINING}/{name}" for name in ("one_car", "other_cars", "evidence")),
    ),
    _trained("fit", (*SIMULATOR, f"{CAR}/vehicle.toml"), (f"{CAR}/fit.toml",), f"{TRAINING}/fit"),
    _trained(
        "extract",
        (f"{CAR}/vehicle.toml", f"{CAR}/fit.toml", _DRIVES[0]),
        _DATASETS,
        f"{TRAINING}/physics",
        f"{TRAINING}/nominal",
    ),
    _trained("train", _DATASETS, (f"{CAR}/network",)),
    _trained("noise", (f"{CAR}/vehicle.toml", f"{CAR}/fit.toml", f"{CAR}/network", _DRIVES[0]), (f"{CAR}/noise.toml",)),
    _trained("gain", (f"{CAR}/noise.toml", f"{CAR}/network", _DRIVES[2]), (f"{CAR}/network.toml",)),
    _trained(
        "intervals",
        (f"{CAR}/noise.toml", f"{CAR}/network.toml", f"{CAR}/network", _DRIVES[0]),
        (f"{CAR}/intervals.json", f"{CAR}/intervals-unsure.json"),
        f"{TRAINING}/unsure",
    ),
    Stage(
        "many-cars",
        "python -m studies.many_cars",
        (*FILTERS, *SIMULATOR, "studies/many_cars.py", "sample_logs/vehicle.toml"),
        ("pdhef_logtool/models/many-cars",),
        duration="25 min",
        work=("out/many-cars", "out/many-cars-data"),
    ),
    _page("model-card", "model_card", "model_card", *_DRIVES, *_DATASETS, "studies/condition_drives.py"),
    _page(
        "conditions", "conditions", "conditions", *_CONDITION_SOURCES, INDEPENDENT,
        arguments="--car saloon --drives 30 --seed 1", work=("out/conditions",),
    ),
    _page(
        "recorded-drives", "real", "real", "tests/reference", RECORDED,
        arguments="--network many-cars --trials 64",
    ),
    _page(
        "calibration", "calibration", "calibration", "studies/self_calibration.py", "studies/identified_bands.py",
        "studies/many_cars.py", "tests/reference", RECORDED,
    ),
    _page("paper", "paper", "paper", *_DRIVES, *_DATASETS, work=("out/paper",)),
    _page("third-party-logs", "strangers", "third_party_logs", RECORDED, "../shared/reader_corpus",
          arguments="--held-out", duration="2 min"),
    _page("comparison", "comparing", "comparing"),
    _page("simulator", "truthsim_docs", "truthsim", INDEPENDENT, duration="15 s"),
    _page("reliability", "torture", "reliability", duration="up to 2 h", work=("out/torture",)),
    Stage(
        "performance", "python -m benchmarks.performance --write-docs", (*TOOL, *SHIPPED, "benchmarks"),
        ("docs/performance.md",),
    ),
)  # fmt: skip


def input_digest(root: Path, inputs: Sequence[str]) -> str:
    """Return the digest of all input files; one that is missing counts as such."""
    return digest([[pattern, [list(entry) for entry in _entries(root, pattern)]] for pattern in inputs])


def _entries(root: Path, pattern: str) -> Iterator[tuple[str, str]]:
    for path in sorted(root.glob(pattern)):
        files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
        for file in files:
            if "__pycache__" not in file.parts:
                yield os.path.relpath(file, root), _content(root, file)


def _content(root: Path, file: Path) -> str:
    """Return the size of a file outside the repository, and the digest of one inside."""
    state = file.stat()
    if not file.resolve().is_relative_to(root.resolve()):
        return str(state.st_size)
    return _file_digest(file, state.st_mtime_ns, state.st_size)


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
        return json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}

    def is_complete(self, stage: Stage) -> bool:
        """Return whether nothing changed since the last completion."""
        stamp = self.stamp(stage)
        now = {"command": stage.command, "inputs": input_digest(self.root, stage.inputs)}
        same = all(stamp.get(key) == value for key, value in now.items())
        return same and "duration_s" in stamp and all((self.root / o).exists() for o in stage.outputs)

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
        begun = {"command": stage.command, "inputs": input_digest(self.root, stage.inputs)}
        before = self.stamp(stage)
        if {key: before.get(key) for key in begun} != begun:
            for folder in stage.work:
                shutil.rmtree(self.root / folder, ignore_errors=True)
        self._write(stage, begun)
        print(f"{stage.name}: {stage.command}", flush=True)
        start = time.monotonic()
        words = [sys.executable if word == "python" else word for word in shlex.split(stage.command)]
        ended = subprocess.run(words, cwd=self.root, env={**os.environ, "OMP_NUM_THREADS": "1"}, check=False)
        if ended.returncode:
            return ended.returncode
        missing = [o for o in stage.outputs if not (self.root / o).exists()]
        if missing:
            print(f"{stage.name}: expected {', '.join(missing)}, got no such file", file=sys.stderr)
            return 1
        self._write(stage, {**begun, "duration_s": round(time.monotonic() - start, 1)})
        return 0

    def _write(self, stage: Stage, stamp: dict[str, Any]) -> None:
        file = self.root / STAMPS / f"{stage.name}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(stamp, indent=1) + "\n", encoding="utf-8")

    def listed(self) -> str:
        """Return a table of the stages: duration as stated and of the last completion here, state and command."""
        body = []
        for stage in self.stages:
            last = self.stamp(stage).get("duration_s")
            here = "–" if last is None else f"{last:g} s"
            body.append([stage.name, stage.duration, here, "no" if self.is_complete(stage) else "yes", stage.command])
        return table(["stage", "duration", "last here", "to do", "command"], body)


def main(arguments: Sequence[str] | None = None) -> int:
    """List or run the stages."""
    parser = options("recalibrate", __doc__)
    parser.add_argument("--list", action="store_true", help="print the stages and run none")
    parser.add_argument("--only", nargs="+", choices=[s.name for s in STAGES], metavar="STAGE", help="run these alone")
    given = parser.parse_args(arguments)
    recalibration = Recalibration(ROOT, STAGES)
    if given.list:
        print(recalibration.listed())
        return 0
    return recalibration.run(given.only or ())


if __name__ == "__main__":
    sys.exit(main())
