"""Fuzz and fault-injection tests, counted: ``docs/reliability.md``.

    python -m studies.torture [--work out/torture] [--seed 1] [--logs 200000] [--kills 200]
                              [--count 500] [--format blf ...] [--hours 10] [--jobs 2] [--only mutations ...]
                              [--out docs/reliability.md]

Resumable: results in the work folder are not computed again; remove it after a change of the code. Exit code 1:
something ended as it should not.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from pdhef_logtool.workers.supervisor import Limits
from studies.pages import DOCS, ROOT, fill, options, table, write
from studies.torture.bombs import BOMBS, former_cases, judge_bomb
from studies.torture.formats import HANG_S, format_judge
from studies.torture.hours import write_hours
from studies.torture.killing import contents, faults, kill_many, kill_run, leftovers
from studies.torture.logs import log_judge
from studies.torture.outside import measured
from studies.torture.table_seeds import FORMATS
from studies.torture.workers import NO_VERDICT, Verdict, run_cases

_THREE = ("--estimators", "zero,kinematic,phy-ukf")


def mutations(work: Path, seed: int, jobs: int, logs: int) -> dict[str, Any]:
    """Judge mutated logs."""
    return {"logs": _judged(work, "logs", log_judge(work, seed), seed, logs, jobs)}


def formats(work: Path, seed: int, jobs: int, count: int, names: Iterable[str]) -> dict[str, Any]:
    """Judge mutated files of table and CAN formats, each by a separate command."""
    limits = Limits(silence_s=3 * HANG_S)
    return {name: _judged(work, name, format_judge(work, name, seed), seed, count, jobs, limits) for name in names}


def _judged(
    work: Path,
    name: str,
    judge: Callable[[int], Verdict],
    seed: int,
    count: int,
    jobs: int,
    limits: Limits | None = None,
) -> dict[str, Any]:
    begin = time.monotonic()
    cases = run_cases(judge, count, work / f"{name}-{seed}.jsonl", jobs=jobs, tell=_say, limits=limits)
    return {
        "seed": seed,
        "wall_s": time.monotonic() - begin,
        "count": count,
        "ends": dict(sorted(Counter(case.end for case in cases).items())),
        "problems": [(case.number, case.problem[-800:]) for case in cases if case.problem],
        "slowest_s": max((case.wall_s for case in cases), default=0.0),
        "peak_bytes": max((case.peak_bytes for case in cases), default=0),
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


def kills(work: Path, seed: int, count: int) -> dict[str, Any]:
    """Kill runs into one folder; the next run must give the output of an undisturbed run, without leftovers."""
    logs = [str(ROOT / "sample_logs" / name) for name in ("step.mcap", "dlc.mcap")]
    call = [*logs, "--car", "saloon"]
    calm, output = work / "calm", work / "killed"
    begin = time.monotonic()
    measured("run", *call, "-o", str(calm), limit_s=300.0)
    lasts_s = time.monotonic() - begin
    ends: Counter[str] = Counter()
    wrong: list[str] = []
    for killed in kill_many(call, output, count=count, lasts_s=lasts_s, writes_s=lasts_s / 3, seed=seed):
        ends["done before" if killed.exit_code is None else f"signal {killed.number}: {killed.exit_code}"] += 1
        wrong += faults(output)
        if sum(ends.values()) % 20 == 0:
            _say(f"kills: {sum(ends.values())} of {count}")
    left = leftovers(output)
    kill_run(call, output, after_s=300.0)
    same, other = contents(calm), contents(output)
    wrong += [
        f"{p} differs from the undisturbed run's"
        for p in sorted(same.keys() | other.keys())
        if same.get(p) != other.get(p)
    ]
    wrong += [f"{p} was not swept" for p in leftovers(output)]
    shutil.rmtree(calm)
    shutil.rmtree(output)
    return {"count": count, "seed": seed, "ends": dict(sorted(ends.items())), "left": len(left), "problems": wrong}


def hours(work: Path, most: float) -> list[dict[str, Any]]:
    """Measure the memory of ``inspect`` and of ``run`` with three estimators over an hour and over many."""
    collected = []
    for length in (1.0, most):
        log = work / "hours.mcap"
        write_hours(log, length)
        for call in (("inspect", str(log)), ("run", str(log), "-o", str(work / "out"), "--annotate", "none", *_THREE)):
            process = measured(*call, *(["--car", "saloon"] if call[0] == "run" else []), limit_s=3600.0)
            entry = {
                "command": call[0],
                "hours": length,
                "code": process.code,
                "s": process.wall_s,
                "bytes": process.peak_bytes,
            }
            collected.append(entry)
            _say(f"hours: {entry}")
        shutil.rmtree(work / "out", ignore_errors=True)
        log.unlink()
    return collected


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


# ------------------------------------------------------------------------------------------------ the page


def blocks(results: dict[str, Any]) -> dict[str, str]:
    """Return the tables of the page by name."""
    lists = [name for name in ("bombs", "shared") if results.get(name)]
    texts: dict[str, str] = {name: _list(results[name]) for name in lists}
    texts |= {name: _mutations(results[name]) for name in ("mutations", "formats") if results.get(name)}
    if done := results.get("kills"):
        rows = [[end, str(n)] for end, n in done["ends"].items()]
        wrong = "; ".join(sorted(set(done["problems"]))) or "none"
        text = f"{done['count']} kills, seed {done['seed']}. Hidden paths left by the last: {done['left']}."
        texts["kills"] = f"{text} Faults found: {wrong}.\n\n{table(['ended', 'times'], rows, right_from=1)}"
    if done := results.get("hours"):
        rows = [[f"`{r['command']}`", f"{r['hours']:g}", str(r["code"]), *_costs(r)] for r in done]
        texts["hours"] = table(["command", "hours", "exit code", "s", "MiB"], rows, right_from=1)
    return texts


def _list(rows: list[dict[str, Any]]) -> str:
    head = ["case", "ended", *[name for key, name in (("s", "s"), ("bytes", "MiB")) if key in rows[0]]]
    wrong = [f", **wrong**: {_cell(r['problem'])}" if r["problem"] else "" for r in rows]
    body = [[r["name"], r["end"] + w, *_costs(r)] for r, w in zip(rows, wrong, strict=True)]
    return table(head, body, right_from=2)


def _costs(row: dict[str, Any]) -> list[str]:
    return [*([f"{row['s']:.1f}"] if "s" in row else []), *([f"{row['bytes'] >> 20}"] if "bytes" in row else [])]


def _cell(text: str) -> str:
    return " ".join(text.split())[-200:].replace("|", "/")


_ENDS = ("exit 0", "exit 1", "exit 2", "exit 3", "internal error", NO_VERDICT)


def _mutations(collected: dict[str, Any]) -> str:
    rows = []
    for name, r in collected.items():
        ends: Counter[str] = Counter()
        for end, n in r["ends"].items():
            ends[end.partition(",")[0]] += n
        counted = [ends[k] for k in _ENDS]
        counts = [f"{n:,}" for n in (r["count"], *counted, r["count"] - sum(counted))]
        rows.append([name, str(r["seed"]), *counts, f"{r['slowest_s']:.1f}", str(r["peak_bytes"] >> 20)])
    text = table(["what", "seed", "cases", *_ENDS, "other", "slowest s", "peak MiB"], rows, right_from=1)
    wrong = [(name, *p) for name, r in collected.items() for p in r["problems"]]
    if wrong:
        text += "\n\nWrong, by number:\n\n" + "\n".join(f"- {n} {i}: `{_cell(p)}`" for n, i, p in wrong[:40])
    return text


def main() -> int:
    """Run the parts that are not done, and write the page."""
    parser = options("torture", __doc__)
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "torture")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--logs", type=int, default=200_000)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--hours", type=float, default=10.0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--count", type=int, default=500, help="mutants of each table and CAN format")
    parser.add_argument("--format", action="append", choices=FORMATS, help="a table or CAN format; may be given again")
    parser.add_argument("--only", action="append", help="a part; may be given again")
    parser.add_argument("--out", type=Path, default=DOCS / "reliability.md")
    given = parser.parse_args()
    work: Path = given.work
    work.mkdir(parents=True, exist_ok=True)
    todo: dict[str, Callable[[], Any]] = {
        "bombs": lambda: one_by_one("bombs", work, {b.name: partial(judge_bomb, b) for b in BOMBS}),
        "shared": lambda: one_by_one("shared", work, {bomb.name: partial(judge_bomb, bomb) for bomb in former_cases()}),
        "mutations": lambda: mutations(work, given.seed, given.jobs, given.logs),
        "formats": lambda: formats(work, given.seed, given.jobs, given.count, given.format or FORMATS),
        "kills": lambda: kills(work, given.seed, given.kills),
        "hours": lambda: hours(work, given.hours),
    }
    if unknown := set(given.only or ()) - set(todo):
        parser.error(f"--only: expected parts out of {', '.join(todo)}, got {', '.join(sorted(unknown))}")
    results: dict[str, Any] = {}
    for name, do in todo.items():
        kept = work / f"{name}.json"
        again = name == "formats" and given.format
        if (again or not kept.is_file()) and (given.only is None or name in given.only):
            done = do()
            if again and kept.is_file():
                done = json.loads(kept.read_text()) | done
            kept.write_text(json.dumps(done, indent=1))
        if kept.is_file():
            results[name] = json.loads(kept.read_text())
    if given.out.is_file():
        counts = f"--logs {given.logs} --count {given.count} --kills {given.kills}"
        counts += f" --hours {given.hours:g}"
        asked = {"command": f"The figures below: `python -m studies.torture --seed {given.seed} {counts}`."}
        write(given.out, fill(given.out.read_text(), blocks(results) | asked, str(given.out)))
    return int(any(_wrong(r) for r in results.values()))


def _wrong(result: Any) -> bool:
    """Return whether anything in a part's results ended as it should not."""
    if isinstance(result, list):
        return any(r.get("problem") or r.get("code", 0) not in (0, 3) for r in result)
    return bool(result.get("problems")) or any(isinstance(r, dict) and r.get("problems") for r in result.values())


if __name__ == "__main__":
    sys.exit(main())
