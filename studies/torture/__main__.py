"""Fuzz and fault-injection tests, counted: ``docs/reliability.md``.

    python -m studies.torture [PART ...] [--work out/torture] [--seed 1] [--logs 200000] [--drives 24] [--kills 20]
                              [--count 500] [--format blf ...] [--hours 10] [--jobs 2] [--out docs]

Parts: bombs, shared, mutations, formats, crashes, hours; all without one. ``--logs``: mutated recordings; ``--count``:
mutants of each other format; ``--drives`` and ``--kills``: of the crashes.

Resumable: results in the work folder are not computed again; remove it after a change of the code. Exit code 1:
something ended as it should not.
"""

import argparse
import shutil
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from pdhef_logtool.workers.supervisor import Limits
from studies.mcap_logs import Message, messages, stamp_ns, stamped, write_log
from studies.pages import ROOT, blocks, options, read_json, update, write_json
from studies.torture.bombs import BOMBS, former_cases, judge_bomb
from studies.torture.crashes import crash_cases
from studies.torture.mutants import HANG_S, format_judge, log_judge
from studies.torture.seeds import FORMATS
from studies.torture.workers import NO_VERDICT, Verdict, judge, measured, run_cases

_IMU = "/imu/data"
_TOPICS = (_IMU, "/vehicle/status/steering_status", "/vehicle/wheel_speeds", "/truth/perfect/odometry")
_THREE = ("run", "--car", "saloon", "--annotate", "none", "--estimators", "zero,kinematic,phy-ukf")


def judged(given: argparse.Namespace, name: str) -> dict[str, Any]:
    """Judge mutants of a format, each by a separate command; of ``logs``: recordings, in supervised processes."""
    begin, work, seed = time.monotonic(), given.work, given.seed
    is_log = name == "logs"
    judge, count = (log_judge(work, seed), given.logs) if is_log else (format_judge(work, name, seed), given.count)
    limits = None if is_log else Limits(silence_s=3 * HANG_S)
    cases = run_cases(judge, count, work / f"{name}-{seed}.jsonl", jobs=given.jobs, tell=_say, limits=limits)
    return {
        "seed": seed,
        "wall_s": time.monotonic() - begin,
        "count": count,
        "ends": dict(sorted(Counter(case.end for case in cases.values()).items())),
        "problems": [(number, case.problem[-800:]) for number, case in cases.items() if case.problem],
        "slowest_s": max((case.costs.get("s", 0.0) for case in cases.values()), default=0.0),
        "peak_bytes": max((int(case.costs.get("bytes", 0)) for case in cases.values()), default=0),
    }


def one_by_one(part: str, work: Path, cases: Mapping[str, Callable[[Path], Verdict]]) -> list[dict[str, Any]]:
    """Judge the cases of a part, each in a temporary folder."""
    collected = []
    for i, (name, judge_case) in enumerate(cases.items()):
        folder = work / f"{part}-{i}"
        folder.mkdir(parents=True, exist_ok=True)
        try:
            verdict = judge_case(folder)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
        collected.append({"name": name, "end": verdict.end, "problem": verdict.problem, **verdict.costs})
        _say(f"{part}: {name}: {verdict.end}{verdict.problem and ', WRONG: ' + verdict.problem}")
    return collected


def write_hours(path: Path, hours: float) -> None:
    """Write a log of the given hours: the sample road drive repeated, each time from the end of the last one."""
    once = [m for m in messages(ROOT / "sample_logs" / "road.mcap") if m.topic in _TOPICS]
    imu_ns = [m.log_time_ns for m in once if m.topic == _IMU]
    lasts_ns = imu_ns[-1] - imu_ns[0] + 10_000_000

    def repeated() -> Iterator[Message]:
        for shift_ns in range(0, round(hours * 3600e9 / lasts_ns) * lasts_ns, lasts_ns):
            for m in once:
                at_ns, published_ns = m.log_time_ns + shift_ns, m.publish_time_ns + shift_ns
                yield stamped(m, stamp_ns(m) + shift_ns)._replace(log_time_ns=at_ns, publish_time_ns=published_ns)

    write_log(path, repeated(), "ros2")


def long_log(hours: float, words: Sequence[str], folder: Path) -> Verdict:
    """Measure the memory of a command over many hours."""
    log, output = folder.parent / f"hours-{hours:g}.mcap", ("-o", str(folder / "out")) if "run" in words else ()
    if not log.is_file():
        write_hours(log, hours)
    process = measured(words[0], str(log), *words[1:], *output, limit_s=3600.0)
    return Verdict(
        f"exit {process.code}", judge(process, (0, 3)).problem, {"s": process.wall_s, "bytes": process.peak_bytes}
    )


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


_ENDS = ("exit 0", "exit 1", "exit 2", "exit 3", "internal error", NO_VERDICT)


def _counts(judged_kind: Mapping[str, Any]) -> list[int]:
    """Return the number of cases of a kind, with each of the usual ends, and with others."""
    ends: Counter[str] = Counter()
    for end, n in judged_kind["ends"].items():
        ends[end.partition(",")[0]] += n
    counted = [ends[k] for k in _ENDS]
    return [judged_kind["count"], *counted, judged_kind["count"] - sum(counted)]


def main() -> int:
    """Run the parts that are not done, and write the page."""
    numbers = {"seed": 1, "logs": 200_000, "drives": 24, "kills": 20, "hours": 10.0, "jobs": 2, "count": 500}
    parser = options("torture", __doc__, "work out", **numbers)
    parser.add_argument("--format", action="append", choices=FORMATS, help="a table or CAN format; may be given again")
    parser.add_argument("parts", nargs="*", help="parts; all without one")
    given = parser.parse_args()
    work: Path = given.work
    work.mkdir(parents=True, exist_ok=True)
    lengths = product((1.0, given.hours), (("inspect",), _THREE))
    hours = {f"`{words[0]}`, {h:g} h": partial(long_log, h, words) for h, words in lengths}
    todo: dict[str, Callable[[], Any]] = {
        "bombs": lambda: one_by_one("bombs", work, {b.name: partial(judge_bomb, b) for b in BOMBS}),
        "shared": lambda: one_by_one("shared", work, {bomb.name: partial(judge_bomb, bomb) for bomb in former_cases()}),
        "mutations": lambda: {"logs": judged(given, "logs")},
        "formats": lambda: {name: judged(given, name) for name in given.format or FORMATS},
        "crashes": lambda: one_by_one("crashes", work, crash_cases(work, given.drives, given.kills, given.seed)),
        "hours": lambda: one_by_one("hours", work, hours),
    }
    if unknown := set(given.parts) - set(todo):
        parser.error(f"expected parts out of {', '.join(todo)}, got {', '.join(sorted(unknown))}")
    results: dict[str, Any] = {}
    for name, do in todo.items():
        kept = work / f"{name}.json"
        again = name == "formats" and given.format
        if (again or not kept.is_file()) and (not given.parts or name in given.parts):
            write_json(kept, (read_json(kept) if again and kept.is_file() else {}) | do() if again else do())
        if kept.is_file():
            results[name] = read_json(kept)
    update(given.out, "reliability.md", blocks(__file__, results=results, given=given, ends=_ENDS, counts=_counts))
    rows = [r for part in results.values() for r in (part if isinstance(part, list) else part.values())]
    return int(any(r.get("problem") or r.get("problems") for r in rows))


if __name__ == "__main__":
    sys.exit(main())
