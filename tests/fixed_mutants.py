"""Fixed mutants: a list of faults that the tests notice; all must still be noticed after a change.

    python tests/fixed_mutants.py [--jobs 2] [--only estimators] [--file LIST.json] [--draw 30 [--add]] [--seed 1]

An entry of ``fixed_mutants.json`` has the file, its lines that contain the fault (``old``, once in the file), the same
lines with the fault (``new``) and the tests that fail. If these tests are gone, the quick tests of the package replace
them. An entry is reported if its lines no longer exist. ``--draw`` runs the tests of their packages on new mutants
(``mutants.py``) and lists survivors; ``--add`` adds those that died to the list, and removes entries without lines.

Each mutant runs in a fork of this process, which has imported libraries only. The fault is inserted at import: no file
changes, and numba's cache remains valid. A fault in a compiled function (``compiled``) runs without the compiler, as
numba would take its callers from the cache. Exit code 1: a mutant survived or its lines are gone.
"""

import argparse
import json
import os
import random
import re
import resource
import signal
import sys
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from importlib import import_module
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import spec_from_file_location
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any

import mutants
import pytest

ROOT = mutants.ROOT
LIST = Path(__file__).with_suffix(".json")
#: Imports of tests and sources that are faster to load once. Not rerun: it starts threads at import, and its server
#: waits for them in a fork, which has none.
LIBRARIES = (
    "numpy", "numba", "numba.typed", "polars", "pyarrow.parquet", "scipy.optimize", "scipy.ndimage", "scipy.stats",
    "pydantic", "rich.console", "typer", "jinja2", "mcap.reader", "mcap.writer", "rosbags.rosbag1",
    "rosbags.typesys", "google.protobuf.descriptor_pb2", "cantools", "fsspec", "safetensors.numpy", "torch",
    "matplotlib.figure", "matplotlib.backends.backend_agg", "hypothesis.extra.numpy", "jsonschema",
)  # fmt: skip
#: Other folders with tests of a package, if not ``tests/runs``.
SEAMS = {"mapping": ("tests/drive", "tests/runs"), "learning": ("tests/studies",)}
MANY = 20
#: Limits of CPU time, of one test (a mutant then counts as noticed) and of folders; waiting is five times as long.
MOST_CPU_S, MOST_CPU_OF_FOLDERS_S = 60, 1800
DIED, SURVIVED, GONE = "died", "SURVIVED", "GONE"


@dataclass(frozen=True)
class FixedMutant:
    """One fault: ``new`` instead of ``old``, and the tests that fail with it."""

    file: str
    old: str
    new: str
    tests: tuple[str, ...]
    compiled: bool = False

    @property
    def package(self) -> str:
        return self.file.split("/")[1]

    def source(self) -> str | None:
        """Return the file with the fault, None if its lines are not there, once."""
        path = ROOT / self.file
        text = path.read_text() if path.is_file() else ""
        return text.replace(self.old, self.new) if text.count(self.old) == 1 else None


@dataclass(eq=False)
class _Loader(SourceFileLoader):
    """Loads one module from a text that differs from its file."""

    name: str
    path: str
    text: str

    def get_code(self, fullname: str) -> CodeType:
        return compile(self.text, self.path, "exec", dont_inherit=True)


@dataclass(eq=False)
class _Finder(MetaPathFinder):
    module: str
    path: Path
    text: str

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != self.module:
            return None
        loader = _Loader(fullname, str(self.path), self.text)
        return spec_from_file_location(fullname, self.path, loader=loader)


@dataclass(eq=False)
class _FirstFailure:
    """Writes down the test that failed first; a file that cannot be imported counts."""

    to: Path
    nodes: list[str] = field(default_factory=list)

    def _note(self, report: Any) -> None:
        if report.failed and not self.nodes:
            self.nodes.append(report.nodeid)
            self.to.write_text(report.nodeid)

    pytest_runtest_logreport = pytest_collectreport = _note


def _in_child(mutant: FixedMutant | None, tests: Sequence[str], to: Path) -> int:
    """Run tests with the fault in this process, which ends afterwards; return pytest's exit code."""
    nothing = os.open(os.devnull, os.O_WRONLY)
    for number in (1, 2):
        os.dup2(nothing, number)
    os.chdir(ROOT)
    if mutant is not None:
        most = MOST_CPU_S if "::" in tests[0] else MOST_CPU_OF_FOLDERS_S
        resource.setrlimit(resource.RLIMIT_CPU, (most, most))
        signal.alarm(5 * most)
        if mutant.compiled:
            os.environ["NUMBA_DISABLE_JIT"] = "1"
            import_module("numba").core.config.reload_config()
        text = mutant.source()
        assert text is not None
        module = ".".join(Path(mutant.file).with_suffix("").parts).removesuffix(".__init__")
        sys.meta_path.insert(0, _Finder(module, ROOT / mutant.file, text))
    quiet = ("-x", "-q", "-p", "no:cacheprovider", "-p", "no:randomly", "-p", "no:xdist", "--hypothesis-seed=0")
    return int(pytest.main([*quiet, *tests], plugins=[_FirstFailure(to)]))


def run_forked(
    work: Iterable[tuple[Any, FixedMutant | None, Sequence[str]]], jobs: int
) -> Iterator[tuple[Any, int, str]]:
    """Run the tests of each item in a fork; yield its key, pytest's exit code (< 0: a signal) and the first failure."""
    running: dict[int, tuple[Any, Path]] = {}
    with tempfile.TemporaryDirectory(prefix="fixed-mutants-") as folder:
        os.environ["HYPOTHESIS_STORAGE_DIRECTORY"] = f"{folder}/hypothesis"

        def ended() -> tuple[Any, int, str]:
            process, status = os.wait()
            key, to = running.pop(process)
            return key, os.waitstatus_to_exitcode(status), to.read_text() if to.is_file() else ""

        for number, (key, mutant, tests) in enumerate(work):
            to = Path(folder) / str(number)
            process = os.fork()
            if not process:
                code = 3
                try:
                    code = _in_child(mutant, tests, to)
                finally:
                    os._exit(code)
            running[process] = key, to
            if len(running) == jobs:
                yield ended()
        while running:
            yield ended()


def read_list(file: Path = LIST) -> list[FixedMutant]:
    """Return the mutants of the list."""
    return [FixedMutant(**{**entry, "tests": tuple(entry["tests"])}) for entry in json.loads(file.read_text())]


def write_list(found: Iterable[FixedMutant], file: Path = LIST) -> None:
    """Write the list, by file."""
    entries = [
        {k: v for k, v in asdict(m).items() if v is not False} for m in sorted(found, key=lambda m: (m.file, m.old))
    ]
    file.write_text(json.dumps(entries, indent=1, ensure_ascii=False) + "\n")


def is_there(test: str) -> bool:
    """Tell whether the function of a test is in its file, or the folder of tests exists."""
    file, _, name = test.partition("[")[0].partition("::")
    if not name:
        return (ROOT / file).is_dir()
    return (ROOT / file).is_file() and f"def {name.rpartition('::')[2]}(" in (ROOT / file).read_text()


def judge(mutants_: Sequence[FixedMutant], jobs: int) -> Iterator[tuple[FixedMutant, str, str]]:
    """Yield the outcome of each mutant, DIED, SURVIVED or GONE, and the test that failed first."""
    work = []
    for mutant in mutants_:
        if mutant.source() is None:
            yield mutant, GONE, ""
        else:
            tests = [t for t in mutant.tests if is_there(t)]
            work.append((mutant, mutant, tests or quick_tests(mutant.package)))
    for mutant, code, failed in run_forked(work, jobs):
        unclear = code < 0 and "::" not in mutant.tests[0]  # the folders' time was up
        yield mutant, SURVIVED if unclear or code in (0, 3, 4, 5) else DIED, failed


def quick_tests(package: str) -> list[str]:
    """Return pytest's arguments for the quick tests of a package."""
    return [f"tests/{package}", "-m", "not slow"]


def fixed(mutant: mutants.Mutant, tests: Sequence[str] = ()) -> FixedMutant:
    """Return a drawn mutant with as many whole lines around it as make it unique in its file."""
    source = (ROOT / mutant.file).read_bytes()
    end = mutant.start + len(mutant.old.encode())
    first, last = source.rfind(b"\n", 0, mutant.start) + 1, source.find(b"\n", end)
    while source.count(source[first:last]) > 1:
        first = source.rfind(b"\n", 0, first - 1) + 1
    new = source[first : mutant.start] + mutant.new.encode() + source[end:last]
    return FixedMutant(mutant.file, source[first:last].decode(), new.decode(), tuple(tests), mutant.compiled)


def stored_test(node: str) -> str:
    """Return a test's id for the list, with its parameters if they are plain."""
    name, _, parameters = node.partition("[")
    return node if re.fullmatch(r"[\w.\- ]*\]", parameters, re.ASCII) else name


def candidates(count: int, seed: int, only: str = "") -> list[mutants.Mutant]:
    """Draw mutants over the packages, whose names contain ``only``, by their size; at most one a function."""
    packages = sorted(p.parent.name for p in (ROOT / mutants.SOURCES).glob("*/__init__.py") if only in p.parent.name)
    sizes = {p: len(mutants.possible(p)) for p in packages if (ROOT / "tests" / p).is_dir()}
    drawn = [m for p, n in sizes.items() for m in mutants.draw(p, -(-count * n // sum(sizes.values())), seed)]
    random.Random(seed).shuffle(drawn)
    return drawn[:count]


def main() -> int:
    """Judge the list, or add to it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=2, help="mutants at a time")
    parser.add_argument("--only", default="", help="packages whose names contain this")
    parser.add_argument("--file", type=Path, default=LIST, help="the list")
    parser.add_argument("--draw", type=int, default=0, help="judge so many new ones in place of the list")
    parser.add_argument("--add", action="store_true", help="add those of them that died to the list")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    known = read_list(options.file)
    chosen = [m for m in known if options.only in m.package]
    if options.draw:
        drawn = candidates(options.draw, options.seed, options.only)
        chosen = [fixed(m, [f"tests/{m.package}", *SEAMS.get(m.package, ("tests/runs",))]) for m in drawn]
    if len(chosen) > MANY:
        for name in LIBRARIES:
            import_module(name)
    tests = sorted({test.partition("[")[0] for m in chosen for test in m.tests if is_there(test)})
    ((_, code, failed),) = run_forked([("no mutant", None, tests)], 1)
    if code:
        print(f"the tests do not pass without a mutant: {failed or f'pytest ended with {code}'}", file=sys.stderr)
        return 2
    ends, new = [], []
    for mutant, end, failed in judge(chosen, options.jobs):
        ends.append(end)
        if end != DIED:
            print(f"{end}: {mutant.file}: {mutant.old.strip()}  ->  {mutant.new.strip()}", flush=True)
        elif "::" in failed and not mutant.compiled:
            new.append(replace(mutant, tests=(stored_test(failed),)))
    if options.add:
        write_list({(m.file, m.old): m for m in (*new, *known) if m.source() is not None}.values(), options.file)
    print(f"{ends.count(DIED)} of {len(ends)} died, {ends.count(SURVIVED)} survived, {ends.count(GONE)} are gone")
    return int(ends.count(DIED) < len(ends))


if __name__ == "__main__":
    sys.exit(main())
