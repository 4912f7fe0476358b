"""Third-party logs, scored: ``docs/third_party_logs.md``.

    python -m studies.strangers [--only NAME ...] [--held-out [GROUP ...]] [--work FOLDER] [--out FILE]

``--only`` takes parts of names, prints the messages of the tool for these logs, and writes no page. ``--held-out`` adds
layouts that were built last: its groups, by default ``held-out``. Exit code 1: something is wrong and not reported.
"""

import shutil
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path

from studies.pages import DOCS, RESULTS, options, read_json, read_toml, write, write_json
from studies.strangers.containers import write as write_log
from studies.strangers.layouts import layouts, mountings
from studies.strangers.page import Result, merged, page
from studies.strangers.recordings import ITEMS, Recording
from studies.strangers.scoring import ANSWERS, SHARED, look, other_recording, score_log

#: First results of held-out layouts, present and former.
FIRST_RUNS: dict[str, str] = read_toml(Path(__file__).with_name("first_runs.toml"))


def score_recording(recording: Recording, folder: Path) -> Result:
    """Write a log of our own, score it, and remove it."""
    print(recording.name, file=sys.stderr)
    path = write_log(recording.topics, folder / recording.name, recording.container)
    start_ns = min((int(t.arrival_ns[0]) for t in recording.topics if len(t.arrival_ns)), default=None)
    try:
        return score_log(path, recording, start_ns)
    finally:
        shutil.rmtree(path) if path.is_dir() else path.unlink()


def score_others(only: Sequence[str]) -> Iterator[Result]:
    """Yield the results of third-party recordings, if available."""
    if not SHARED.is_dir():
        print(f"{SHARED} is not there: recordings of others are left out", file=sys.stderr)
        return
    for file, table in ANSWERS.items():
        if "same_as" not in table and _wanted(file, only) and (SHARED / file).exists():
            print(file, file=sys.stderr)
            yield score_log(SHARED / file, other_recording(file))


def first_runs() -> Iterator[tuple[int, str, Counter[str]]]:
    """Yield number, description and outcomes of the held-out layouts of each completed first run."""
    for name, what in FIRST_RUNS.items():
        file = RESULTS / "third_party_logs" / f"{name}_first_run.json"
        if file.is_file():
            logs = read_json(file)
            yield len(logs), what, Counter(outcome for log in logs.values() for outcome in log["items"].values())


def others_without_answers() -> tuple[int, list[str]] | None:
    """Return number and mapped channels of the recordings in ``reader_corpus`` without vehicle signals, if there."""
    catalogue = SHARED / "reader_corpus" / "CATALOG.json"
    if not catalogue.is_file():
        return None
    channels = {name for names in ITEMS.values() for name in names}
    mapped_files, count = [], 0
    for entry in read_json(catalogue):
        file = f"reader_corpus/{entry['file']}"
        if entry["expected"] != "ok" or file in ANSWERS or "/conformance/" in file:
            continue
        count += 1
        _, _, mapped = look(SHARED / file)
        taken = {name: len(c) for name, c in mapped.items() if name in channels}
        if taken:
            most = max(taken.values())
            mapped_files.append(f"`{entry['file']}` ({', '.join(sorted(taken))}; {most} samples at most)")
    return count, mapped_files


def _wanted(name: str, only: Sequence[str]) -> bool:
    return not only or any(part in name for part in only)


def main() -> int:
    """Make the logs, score them, write the page."""
    parser = options("strangers", __doc__, "work")
    parser.add_argument("--only", nargs="+", default=[], help="parts of names of logs")
    parser.add_argument("--held-out", nargs="*", metavar="GROUP", help="with layouts that were built last")
    parser.add_argument("--out", type=Path, default=DOCS / "third_party_logs.md", help="the page")
    parser.add_argument("--keep", type=Path, help="write the results as JSON, to compare with later")
    given = parser.parse_args()
    given.work.mkdir(parents=True, exist_ok=True)
    last = () if given.held_out is None else given.held_out or ("held-out",)
    made = chain(mountings(), layouts("fault", "layout", *last))
    recordings = [r for r in made if _wanted(r.name, given.only)]
    kinds: dict[str, list[Result]] = {}
    for result in chain((score_recording(r, given.work) for r in recordings), score_others(given.only)):
        kinds.setdefault(result.log.kind or result.log.name, []).append(result)
    results = [merged(logs) for logs in kinds.values()]
    if given.only:
        for result in chain.from_iterable(kinds.values()):
            _show(result)
    else:
        about = {"first_runs": [*first_runs()], "corpus": others_without_answers(), "is_complete": bool(last)}
        write(given.out, page(results, **about))
    if given.keep:
        write_json(given.keep, {r.log.name: r.as_json() for r in sorted(results, key=lambda r: r.log.name)})
    return 1 if any(r.count("wrong, not reported") for r in results) else 0


def _show(result: Result) -> None:
    print(f"== {result.log.name}: {result.log.what}")
    for item, outcome in result.items.items():
        print(f"   {item}: {outcome} {result.wrong.get(item, '')} {result.verdicts.get(item, '')}".rstrip())
    if result.named is not None:
        print(f"   cause named: {result.named}")
    for line in (*result.alarms, *result.said.splitlines()):
        print(f"   | {line}")


if __name__ == "__main__":
    sys.exit(main())
