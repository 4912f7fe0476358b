"""How the benchmarks measure: processor seconds, the best of several rounds, peak memory of a process of its own.

Processor seconds (user + system) of a single-threaded way and the best of interleaved rounds make a ratio stand still
on a machine that others use too.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: Generated logs and outputs; ignored by git.
CACHE = ROOT / "out" / "bench"
ROUNDS = 3


@dataclass(frozen=True, slots=True)
class Figure:
    """One line of the table.

    Attributes
    ----------
    benchmark, name : file of the benchmark, and what was measured.
    value, unit : the figure.
    limit : what it must not exceed (``at most``) or fall below (``at least``); None without a target.
    """

    benchmark: str
    name: str
    value: float
    unit: str
    limit: float | None = None
    sense: str = ""

    @property
    def passed(self) -> bool | None:
        """Whether the target is met; None without one."""
        if self.limit is None:
            return None
        return self.value <= self.limit if self.sense == "at most" else self.value >= self.limit


def best_seconds(ways: Mapping[str, Callable[[], object]], rounds: int = ROUNDS) -> dict[str, float]:
    """Return the processor seconds of each way: the best of ``rounds``, in turns, so that all see the same machine."""
    best = dict.fromkeys(ways, float("inf"))
    for _ in range(rounds):
        for name, way in ways.items():
            start = time.process_time()
            way()
            best[name] = min(best[name], time.process_time() - start)
    return best


def peak_bytes(module: str, *arguments: str) -> int:
    """Return the peak resident memory of ``python -m module arguments`` in a new process.

    Linux counts the peak of a process from its parent's size on, so a small one in between starts it.
    """
    code = (
        "import resource, subprocess, sys; subprocess.run([sys.executable, '-m', *sys.argv[1:]], check=True);"
        "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)"
    )
    command = [sys.executable, "-c", code, module, *arguments]
    done = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
    return int(done.stdout.split()[-1]) * (1 if sys.platform == "darwin" else 1024)


def machine_facts() -> dict[str, str]:
    """Return what a figure depends on, without names of hosts or folders."""
    packages = ("numpy", "mcap", "rosbags", "zstandard", "numba", "filterpy")
    return {
        "processor": _processor(),
        "cores": str(os.cpu_count()),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        **{name: version(name) for name in packages},
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or "unknown"
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")
