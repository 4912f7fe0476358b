"""Bit for bit as before: estimates, figures and messages of the tree at hand against those of an older commit.

    python tests/same_as_before.py COMMIT [--work out/same] [--keep]

Both trees run the same logs on this machine, with the same interpreter and libraries: the sample logs, and where
``../shared`` is there the recorded 250 LM, whole and damaged. Compared are the columns of estimates.parquet, the values
of metrics.parquet, and payloads and stamps of every topic below ``/pdhef``. A difference that mends a fault stands in
:data:`MENDED` with that fault; any other ends with 1.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from pdhef_logtool.results.mcap_sink import topic_of

ROOT = Path(__file__).resolve().parents[1]
DRIVES = ROOT.parent / "shared" / "data" / "drives"

_REFERENCE = ["--car", "tests/reference/vehicles/revs_250lm.toml"]
_MAPPING = ["--mapping", "tests/reference/mappings/revs_250lm.toml"]
_SAMPLES = ("dlc.mcap", "road.mcap", "step.mcap", "step_rosbag2", "fishhook.mcap", "faults.mcap", "no_truth.mcap")
#: Names of estimators in the older commit, and the names of the same estimators now.
RENAMED = {
    "gyro": "zero:no-lateral",
    "open-loop-calibrated": "open-loop:calibrated",
    "phy-ukf:tuned": "phy-ukf:tuned",
    "pd-hef:fixed-r": "pd-hef:fixed-r",
    "pd-hef:gain=1": "pd-hef:gain=1",
}


@dataclass(frozen=True, slots=True)
class Case:
    """One command line; ``{drives}`` and ``{out}`` are filled in. ``exit_code`` : that it must end with."""

    name: str
    words: tuple[str, ...]
    exit_code: int = 0

    @property
    def needs_drives(self) -> bool:
        """Whether it reads recorded drives."""
        return any("{drives}" in w for w in self.words)


def cases() -> tuple[Case, ...]:
    """Return the command lines."""
    samples = tuple(f"sample_logs/{name}" for name in _SAMPLES)
    lm = "{drives}/revs_250lm_a.mcap"
    known = (*_REFERENCE, *_MAPPING)
    samples_car = ("--car", "sample_logs/vehicle.toml")
    return (
        Case("samples", ("run", *samples, "--car", "saloon")),
        Case("low-friction", ("run", "sample_logs/sweep.mcap", "--car", "saloon", "--friction", "0.3")),
        Case("untuned", ("run", *samples[:1], "sample_logs/faults.mcap", *samples_car, "--set", "sensors=esp")),
        Case(
            "default-car",
            (
                "run",
                "sample_logs/dlc.mcap",
                "--network",
                "default",
                "--friction",
                "estimate",
                "--annotate",
                "sidecar",
            ),
        ),
        Case("250lm", ("run", lm, *known)),
        Case("250lm-truncated", ("run", "{drives}/faulty/revs_250lm_a_truncated60.mcap", *known), 3),
        Case("250lm-flipped", ("run", "{drives}/faulty/revs_250lm_a_flipped_byte.mcap", *known), 3),
        Case("250lm-car", ("learn", lm, *known, "--end", "150")),
        Case("250lm-taught", ("run", lm, "--car", "{out}/250lm-car", *_MAPPING, "--start", "155")),
        Case(
            "recorded",
            ("metrics", "{out}/samples/logs/dlc/annotated.mcap", "--estimate", "/pdhef/phy_ukf/state", *samples_car),
        ),
    )


#: By case, estimator and column (metric, topic): the fault that a difference mends.
MENDED: dict[tuple[str, str, str], str] = {}


def main(arguments: list[str] | None = None) -> int:
    """Run both trees and compare; 0 if nothing differs but what is mended."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commit", help="to compare with")
    parser.add_argument("--work", type=Path, default=Path("out/same"), help="both trees' outputs")
    parser.add_argument("--keep", action="store_true", help="take the older tree's outputs as they are there")
    given = parser.parse_args(arguments)
    work = given.work.resolve()
    before, after = work / "before", work / "after"
    if not (given.keep and before.is_dir()):
        tree = work / "tree"
        _git("worktree", "add", "--force", "--detach", str(tree), given.commit)
        try:
            _run(tree, before)
        finally:
            _git("worktree", "remove", "--force", str(tree))
    _run(ROOT, after)
    differences = list(compare(before, after))
    unexplained = 0
    for case, estimator, what, text in differences:
        places = ((case, estimator, what), (case, estimator, "*"), (case, "*", what))
        fault = next((MENDED[p] for p in places if p in MENDED), "")
        unexplained += not fault
        verdict = f" MENDED: {fault}" if fault else " DIFFERS"
        print(f"{case} {estimator} {what}: {text}{verdict}")
    print(f"{len(differences)} differences, {unexplained} of them not explained")
    return 1 if unexplained else 0


def _git(*words: str) -> None:
    subprocess.run(["git", "-C", str(ROOT), *words], check=True, capture_output=True)


def _run(tree: Path, out: Path) -> None:
    """Run every case with the sources of a tree."""
    out.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(tree)}
    for case in cases():
        if case.needs_drives and not DRIVES.is_dir():
            print(f"{case.name}: no ../shared, left out")
            continue
        words = [w.format(drives=DRIVES, out=out) for w in case.words] + ["--estimators", "all"] * (
            case.words[0] == "run"
        )
        command = [sys.executable, "-m", "pdhef_logtool", *words, "-o", str(out / case.name)]
        done = subprocess.run(command, cwd=tree, env=environment, capture_output=True, text=True, check=False)
        print(f"{tree.name}: {case.name} ended with {done.returncode}", flush=True)
        if done.returncode != case.exit_code:
            raise SystemExit(f"{' '.join(command)}\n{done.stderr}")


def compare(before: Path, after: Path) -> Iterator[tuple[str, str, str, str]]:
    """Yield what differs: case, estimator, column or topic, and how."""
    for old in sorted(before.glob("*/logs/*")):
        new = after / old.relative_to(before)
        case = old.relative_to(before).parts[0]
        files = {"estimates.parquet": _estimates, "metrics.parquet": _figures, "annotated.mcap": _messages}
        for file in (f for f in files if (old / f).is_file()):
            yield from ((case, *d) for d in files[file](old / file, new / file))


def _estimates(old: Path, new: Path) -> Iterator[tuple[str, str, str]]:
    one, other = (_renamed(pl.read_parquet(p)).sort("estimator", "stamp_ns") for p in (old, new))
    for name in one["estimator"].unique().sort():
        a, b = (t.filter(pl.col("estimator") == name) for t in (one, other))
        if len(a) != len(b):
            yield name, "*", f"{len(a)} rows before, {len(b)} now"
            continue
        for column in a.columns:
            x, y = (t[column].to_numpy() for t in (a, b))
            same = (x == y) | ((x != x) & (y != y)) if x.dtype.kind == "f" else x == y
            if not np.all(same):
                yield name, column, f"{int(np.count_nonzero(~same))} of {len(x)} rows"


def _figures(old: Path, new: Path) -> Iterator[tuple[str, str, str]]:
    keys = ("estimator", "signal", "segment", "metric")
    tables = (_renamed(pl.read_parquet(p)) for p in (old, new))
    one, other = ({tuple(r[k] for k in keys): (r["value"], r["unit"], r["n"]) for r in t.to_dicts()} for t in tables)
    for key in sorted(one.keys() | other.keys()):
        if one.get(key) != other.get(key):
            yield key[0], key[-1], f"{'/'.join(key[1:-1])}: {one.get(key)} before, {other.get(key)} now"


def _renamed(table: pl.DataFrame) -> pl.DataFrame:
    """Return a table with the names of estimators as they are now; ``a~b`` names a pair of estimators."""
    names = {n: "~".join(RENAMED.get(one, one) for one in n.split("~")) for n in table["estimator"].unique()}
    return table.with_columns(pl.col("estimator").cast(pl.String).replace(names))


def _messages(old: Path, new: Path) -> Iterator[tuple[str, str, str]]:
    topics = {topic_of(before, ""): topic_of(now, "") for before, now in RENAMED.items()}
    one, other = _ours(old), _ours(new)
    for place, now in topics.items():
        one = {now + t.removeprefix(place) if t.startswith(place) else t: messages for t, messages in one.items()}
    for topic in sorted(one.keys() | other.keys()):
        if one.get(topic) != other.get(topic):
            yield topic.split("/")[2], topic, "payloads or stamps"


def _ours(path: Path) -> dict[str, list[tuple[int, int, bytes]]]:
    from mcap.reader import make_reader

    found: dict[str, list[tuple[int, int, bytes]]] = {}
    with path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            if channel.topic.startswith("/pdhef/"):
                found.setdefault(channel.topic, []).append((message.log_time, message.publish_time, message.data))
    return found


if __name__ == "__main__":
    sys.exit(main())
