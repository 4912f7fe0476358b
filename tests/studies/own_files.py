"""Damaged output files: files of a run are changed, then every command that reads them is run."""

from __future__ import annotations

import json
import os
import random
import shutil
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from studies.pages import ROOT
from studies.torture.mutating import damage_bytes
from studies.torture.workers import Ended, Verdict, command, judge

#: Of the run that is damaged.
_LOGS = tuple(str(ROOT / "sample_logs" / f"{name}.mcap") for name in ("dlc", "step"))
_OPTIONS = ("--car", "saloon", "-e", "zero,kinematic", "--end", "1.5", "--keep", "estimates", "--no-report")
#: By how these end, the line that says why begins.
_TOLD = ("pdhef", "warning: ")
_TEXTS = (b"", b"{}", b"[]", b"null", b"NaN", b'"text"', b'{"logs": 1e999}', b"\xff\xfe\x00", b"[" * 100_000, b"PAR1")


def own_file_judge(work: Path, seed: int) -> Callable[[int], Verdict]:
    """Make the sound run, and return a function that judges one damaged run by its number."""
    sound = work / "sound-run"
    shutil.rmtree(sound, ignore_errors=True)
    ended = _run(sound)
    assert ended.code == 0, ended.err
    return partial(judge_own_file, work, seed, sound)


def judge_own_file(work: Path, seed: int, sound: Path, number: int) -> Verdict:
    """Damage a file of a run, or several, read it with a command, and go on with the run.

    After ``--resume`` the tables must equal the tables of the sound run, for any damage.
    """
    rng = random.Random(f"{seed} own file {number}")
    run = work / "cases" / f"own-{number}"
    shutil.copytree(sound, run)
    try:
        replaced = _damage(run, number, rng)
        call = _READERS[number // len(_files(sound)) % len(_READERS)]
        verdict = judge_told(command(*(str(run if a == "RUN" else sound if a == "SOUND" else a) for a in call)))
        if verdict.problem:
            return verdict
        ended = _run(run, "--resume")
        again = judge_told(ended)
        same = all(
            (run / name).read_bytes() == (sound / name).read_bytes() for name in _TABLES if (run / name).is_file()
        )
        if not again.problem and not replaced and (ended.code or not same):
            return Verdict(
                again.end, f"exit {ended.code} of --resume, tables {'' if same else 'not '}the same: {ended.err}"
            )
        return again if again.problem else verdict
    finally:
        shutil.rmtree(run, ignore_errors=True)


def judge_told(ended: Ended) -> Verdict:
    """Return the verdict on the end of a command; without usable input, it must at least warn with a reason."""
    told = any(line.startswith(_TOLD) for line in ended.err.splitlines())
    return judge(Ended(ended.code, ended.out, f"{ended.err}\npdhef\n" if told else ended.err))


_TABLES = ("metrics.parquet", "run.json")
_READERS: tuple[Sequence[str], ...] = (
    ("report", "RUN"),
    ("compare", "SOUND", "RUN", "--cluster", "car"),
    ("events", "RUN", "--where", "abs(ay_m_s2) > 0.5 or diverged"),
    ("compare", "RUN", "SOUND", "--cluster", "day", "--json"),
)


def _run(output: Path, *options: str) -> Ended:
    return command("run", *_LOGS, "-o", str(output), *_OPTIONS, *options)


def _files(run: Path) -> list[Path]:
    """Return the files that commands read back, from the first drive only."""
    names = ["journal.jsonl", "run.json", "metrics.parquet", "logs/dlc/report.json", "logs/dlc/estimates.parquet"]
    return [*(run / name for name in names), sorted((run / "metrics").rglob("*.parquet"))[0]]


def _damage(run: Path, number: int, rng: random.Random) -> bool:
    """Damage a file; return whether it gave way to a folder, which no command replaces by a file."""
    files = _files(run)
    path = files[number % len(files)]
    content = path.read_bytes()
    way = rng.randrange(10)
    if way == 0 and rng.random() < 0.3:
        path.unlink()
        path.mkdir()
        return True
    if way < 4:
        path.write_bytes(damage_bytes(content, rng))
    elif way < 6:
        path.write_bytes(content[: rng.randrange(len(content))] if way == 4 else _flipped(content, rng))
    elif way == 6:
        path.write_bytes(rng.choice(_TEXTS))
    elif path.suffix == ".parquet":
        _damage_table(path, rng)
    else:
        path.write_bytes(damage_bytes(content, rng))
    if way % 2:
        _unseal(run / "run.json")
    return False


def _flipped(content: bytes, rng: random.Random) -> bytes:
    data = bytearray(content)
    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(data)


def _unseal(file: Path) -> None:
    """Make run.json one of an earlier version, which has no checksums, if it is still one."""
    try:
        document = json.loads(file.read_text(encoding="utf-8"))
        for one in (document, *document["logs"]):
            one.pop("digest", None)
            one.pop("files", None)
        file.write_text(json.dumps(document), encoding="utf-8")
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError):
        return


def _damage_table(path: Path, rng: random.Random) -> None:
    """Drop, retype or change a column, or drop all rows."""
    table = pq.read_table(path, partitioning=None)
    place = rng.randrange(table.num_columns)
    name = table.column_names[place]
    match rng.randrange(5):
        case 0:
            table = table.drop_columns([name])
        case 1:
            table = table.slice(0, 0)
        case 2:
            table = table.set_column(place, name, _column(table.num_rows, rng))
        case 3:
            table = table.rename_columns([f"{c}x" if c == name else c for c in table.column_names])
        case _:
            table = table.set_column(place, name, table[name].take(pa.array(np.zeros(table.num_rows, dtype=np.int64))))
    pq.write_table(table, path)


def _column(rows: int, rng: random.Random) -> pa.Array:
    values: list[Callable[[], Any]] = [
        lambda: pa.nulls(rows),
        lambda: pa.array(["text"] * rows),
        lambda: pa.array([b"\xff"] * rows),
        lambda: pa.array([1e308] * rows),
        lambda: pa.array([float("nan")] * rows),
        lambda: pa.array([-(2**63)] * rows),
        lambda: pa.array([[1]] * rows),
    ]
    return rng.choice(values)()


def numbers(count: int) -> Iterator[int]:
    """Yield the numbers of cases; the environment asks for more of them."""
    yield from range(int(os.environ.get("PDHEF_OWN_FILES", count)))
