"""Where the processor time of the commands on an hour goes, by package; measured once.

At each tick of the processor clock, the time since the last one counts for the innermost function of the package that
is running, or as start while a module is loaded.
"""

import json
import signal
import sys
import time
from collections import Counter, defaultdict
from pathlib import Path
from types import FrameType

from benchmarks.hour import run_words
from benchmarks.measuring import CACHE, ROOT, Row, command_cost
from benchmarks.one_hour_log import drive_log

TICK_S = 0.002
LEAST_S = 0.05
_PACKAGE, _START = f"{ROOT}/pdhef_logtool/", "start: interpreter and imports"


def place(frame: FrameType | None) -> str:
    """Return the package that the innermost frame of ours belongs to."""
    found = ""
    while frame is not None:
        name = frame.f_code.co_filename
        if name == "<frozen importlib._bootstrap>":
            return _START
        if not found and name.startswith(_PACKAGE):
            found = name.removeprefix(_PACKAGE).split("/")[0]
        frame = frame.f_back
    return found or _START


def measure(words: list[str], output: Path) -> None:
    """Run ``pdhef WORDS`` in this process and write the processor seconds of each package as JSON."""
    from pdhef_logtool.cli import app

    last = time.process_time()
    spent = defaultdict(float, {_START: last})

    def tick(_number: int, frame: FrameType | None) -> None:
        nonlocal last
        now = time.process_time()
        spent[place(frame)] += now - last
        last = now

    signal.signal(signal.SIGPROF, tick)
    signal.setitimer(signal.ITIMER_PROF, TICK_S, TICK_S)
    sys.argv[1:] = words
    try:
        app.main()
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        output.write_text(json.dumps(spent), encoding="utf-8")


def rows() -> list[Row]:
    """Measure."""
    works = {
        "inspect": ("inspect", drive_log()),
        "run, light outputs": run_words(CACHE / "where", light=True),
        "run, everything": run_words(CACHE / "where", light=False),
    }
    measured = []
    for work, words in works.items():
        output = CACHE / "where.json"
        command_cost(output, *words, module="benchmarks.where")
        spent = Counter(json.loads(output.read_text(encoding="utf-8")))
        measured.append(Row(work, spent.total(), "s"))
        measured += [Row(f"of it {name}", s, "s") for name, s in spent.most_common() if s >= LEAST_S]
    return measured


if __name__ == "__main__":
    measure(sys.argv[2:], Path(sys.argv[1]))
