"""How the benchmarks measure: processor seconds, the best of several rounds, peak memory of a separate process.

Processor seconds (user + system) of a single-threaded way and the best of interleaved rounds make a ratio stand still
on a machine that others use too.
"""

import json
import os
import platform
import subprocess
import sys
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from resource import RUSAGE_CHILDREN, RUSAGE_SELF, getrusage

ROOT = Path(__file__).resolve().parents[1]
#: Generated logs and outputs; ignored by git.
CACHE = ROOT / "out" / "bench"
ROUNDS = 3
_RSS_UNIT = 1 if sys.platform == "darwin" else 1024


@dataclass(frozen=True, slots=True)
class Row:
    """One line of a table.

    Attributes
    ----------
    work : the measured work, in words.
    value, unit : the figure.
    target : upper (``at most``) or lower (``at least``) limit; None without a target.
    peers : how many times as much as ours each peer takes, measured in the same run.
    command : command line for this work, empty without.
    """

    work: str
    value: float
    unit: str
    target: float | None = None
    sense: str = "at most"
    peers: Mapping[str, float] = field(default_factory=dict)
    command: str = ""


def best_seconds(ways: Mapping[str, Callable[[], object]], rounds: int = ROUNDS) -> dict[str, float]:
    """Return the processor seconds of each way: the best of ``rounds``, in turns, so that all see the same machine."""
    best = dict.fromkeys(ways, float("inf"))
    for _ in range(rounds):
        for name, way in ways.items():
            start = _processor_seconds()
            way()
            best[name] = min(best[name], _processor_seconds() - start)
    return best


def _processor_seconds() -> float:
    """Return the processor seconds of this process and of its children that have ended."""
    return sum(sum(getrusage(who)[:2]) for who in (RUSAGE_SELF, RUSAGE_CHILDREN))


@dataclass(frozen=True, slots=True)
class Cost:
    """Processor seconds, peak resident memory and elapsed seconds of a command."""

    seconds: float
    peak_bytes: int
    elapsed_s: float


def command_cost(*arguments: str | Path, tree: Path = ROOT, module: str = "pdhef_logtool") -> Cost:
    """Return the cost of ``pdhef ARGUMENTS`` of a source tree; its exit code must be 0 or 3.

    Linux counts the peak of a process from the size of its parent on, so a small one in between starts it.
    """
    code = (
        "import json, resource, subprocess, sys, time; start = time.monotonic();"
        "done = subprocess.run(sys.argv[1:], capture_output=True, text=True); elapsed_s = time.monotonic() - start;"
        "used = resource.getrusage(resource.RUSAGE_CHILDREN);"
        "print(json.dumps([done.returncode, used.ru_utime + used.ru_stime, used.ru_maxrss, elapsed_s]))"
    )
    command = [sys.executable, "-c", code, sys.executable, "-m", module, *map(str, arguments)]
    # Byte code is kept, as in an installation.
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    environment |= {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(tree)}
    done = subprocess.run(command, cwd=tree, check=True, capture_output=True, text=True, env=environment)
    code_of, seconds, peak, elapsed_s = json.loads(done.stdout)
    if code_of not in (0, 3):
        raise SystemExit(f"{module} {' '.join(map(str, arguments))} ended with {code_of}")
    return Cost(seconds, peak * _RSS_UNIT, elapsed_s)


def gauge_seconds() -> float:
    """Return the processor seconds of a fixed loop: the speed of the machine at the time of a measurement."""

    def loop() -> None:
        total, block = 0, bytes(1 << 20)
        for number in range(2_000_000):
            total += number * number % 7
        for _ in range(100):
            zlib.crc32(block)

    return best_seconds({"gauge": loop})["gauge"]


def machine_facts() -> dict[str, str]:
    """Return the machine and the versions that a figure depends on, without names of hosts or folders."""
    packages = ("numpy", "mcap", "rosbags", "zstandard", "numba", "filterpy")
    return {
        "gauge": f"{gauge_seconds():.3f} s",
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
