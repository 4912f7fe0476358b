"""Mutated configurations: mapping, vehicle, car folder, pdhef.toml, plans, metadata of networks and bags."""

from __future__ import annotations

import copy
import json
import random
import shutil
import tomllib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

from pdhef_logtool.evaluation.plan_example import EXAMPLE
from pdhef_logtool.storage.toml_text import toml_text
from studies.pages import ROOT
from studies.torture.mutating import EDGES, TEXTS, damage_bytes
from studies.torture.seeds import SEEDS
from studies.torture.workers import Verdict, command, judge

_MODEL = ROOT / "pdhef_logtool" / "models" / "default"
_CONFIG = """estimators = ["zero", "kinematic"]
annotate = "none"
start = "0"
friction = 0.9
sensors = "full"
"""
_IMU = {"name": "/imu/data", "type": "sensor_msgs/msg/Imu", "serialization_format": "cdr"}
_METADATA = {
    "rosbag2_bagfile_information": {
        "version": 9, "storage_identifier": "sqlite3", "duration": {"nanoseconds": 1180000000},
        "starting_time": {"nanoseconds_since_epoch": 1767225600000000000}, "message_count": 240,
        "topics_with_message_count": [{"topic_metadata": _IMU, "message_count": 60}],
        "compression_format": "", "compression_mode": "", "relative_file_paths": ["rosbag2.db3"],
        "ros_distro": "jazzy",
    }
}  # fmt: skip
_DEEP = 2000


def config_judge(work: Path, seed: int) -> Callable[[int], Verdict]:
    """Return what judges one mutated configuration by its number; sound ones are made first."""
    log = work / "seeds" / "rosbag2.db3"
    log.parent.mkdir(parents=True, exist_ok=True)
    SEEDS[log.name](log)
    mapping = work / "sound" / "mapping.toml"
    mapping.parent.mkdir(parents=True, exist_ok=True)
    mapping.unlink(missing_ok=True)
    command("inspect", str(log), "--write-mapping", str(mapping))
    documents = {
        "mapping.toml": mapping.read_bytes(),
        "vehicle.toml": (ROOT / "sample_logs" / "vehicle.toml").read_bytes(),
        "plan.toml": EXAMPLE.encode(),
        "pdhef.toml": _CONFIG.encode(),
        "metadata.yaml": json.dumps(_METADATA).encode(),
        "model.json": (_MODEL / "network" / "model.json").read_bytes(),
    }
    parts = sorted(p.name for p in _MODEL.iterdir() if p.suffix in (".toml", ".json", ".jsonl"))
    documents |= {f"car/{name}": (_MODEL / name).read_bytes() for name in parts}
    return partial(judge_config, work, seed, log, documents)


def judge_config(work: Path, seed: int, log: Path, documents: dict[str, bytes], number: int) -> Verdict:
    """Give a mutant to the command that reads it."""
    name = sorted(documents)[number % len(documents)]
    rng = random.Random(f"{seed} {name} {number}")
    content = damage_document(name, documents[name], rng)
    folder = work / "cases" / f"config-{number}"
    folder.mkdir(parents=True, exist_ok=True)
    try:
        return judge(command(*_arguments(name, content, log, folder)))
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _arguments(name: str, content: bytes, log: Path, folder: Path) -> list[str]:
    """Write the document where its reader expects it; return the command that reads it."""
    run = ["run", str(log), "-o", str(folder / "out"), "--annotate", "none"]
    some = ["--estimators", "zero,kinematic,phy-ukf"]
    path = folder / Path(name).name
    if name.startswith("car/"):
        car = folder / "car"
        shutil.copytree(_MODEL, car)
        (car / path.name).write_bytes(content)
        return [*run, *some, "--car", str(car)]
    if name == "model.json":
        shutil.copytree(_MODEL / "network", folder / "network")
        (folder / "network" / name).write_bytes(content)
        return [*run, "--estimators", "zero,pure-lstm", "--car", "saloon", "--network", str(folder / "network")]
    path.write_bytes(content)
    if name == "metadata.yaml":
        shutil.copy(log, folder / log.name)
        return ["inspect", str(folder)]
    if name == "mapping.toml":
        return ["inspect", str(log), "--mapping", str(path)]
    if name == "vehicle.toml":
        return [*run, *some, "--car", str(path)]
    if name == "plan.toml":
        return [*run, "--estimators", "zero", "--car", "saloon", "--plan", str(path)]
    return [*run, "--car", "saloon", "--config", str(path)]


def damage_document(name: str, content: bytes, rng: random.Random) -> bytes:
    """Change bytes of a document, or one to three of its entries."""
    if rng.random() < 0.3:
        return damage_bytes(content, rng)
    text = content.decode()
    toml, lines = name.endswith(".toml"), name.endswith(".jsonl")
    parse = tomllib.loads if toml else (lambda t: [json.loads(x) for x in t.splitlines()]) if lines else json.loads
    document: Any = parse(text)
    try:
        for _ in range(rng.choice((1, 1, 2, 3))):
            _damage_entry(document, rng)
        return _dumped(document, toml, lines)
    except (ValueError, TypeError, RecursionError):  # what the format, or its writer, cannot express
        return damage_bytes(content, rng)


def _dumped(document: Any, toml: bool, lines: bool) -> bytes:
    if toml:
        text = toml_text(document)
    else:
        text = "\n".join(json.dumps(x, ensure_ascii=False) for x in (document if lines else [document]))
    return text.encode("utf-8", errors="surrogatepass")


def _damage_entry(document: Any, rng: random.Random) -> None:
    places = list(_places(document))
    if not places:
        return
    holder, key = rng.choice(places)
    match rng.randrange(8):
        case 0:
            del holder[key]
        case 1 if isinstance(holder, dict):
            holder[rng.choice((key + "x", key[:-1], key.upper(), "", "a.b", "\n", "é"))] = holder.pop(key)
        case 2:
            other, place = rng.choice(places)
            if place in other if isinstance(other, dict) else place < len(other):
                holder[key] = copy.deepcopy(other[place])
        case 3:
            times = rng.choice((1, 2, 1000))  # once only a thousand: writing two million entries is not ours to time
            holder[key] = [holder[key]] * (times if len(places) < 1000 else min(times, 2))
        case 4 if isinstance(holder[key], int | float):
            holder[key] = holder[key] * rng.choice((-1, 0, 1e-9, 10, 1e3, 1e9, 1e300))
        case _:
            holder[key] = _odd_value(rng)


def _places(document: Any) -> Iterator[tuple[Any, Any]]:
    if isinstance(document, dict | list):
        for key in list(document) if isinstance(document, dict) else range(len(document)):
            yield document, key
            yield from _places(document[key])


def _odd_value(rng: random.Random) -> Any:
    deep: Any = 1
    if rng.random() < 0.03:
        for _ in range(_DEEP if rng.random() < 0.1 else 60):
            deep = [deep]
        return deep
    text = rng.choice(TEXTS).decode("utf-8", errors="replace")
    numbers = (rng.choice(EDGES), -rng.choice(EDGES), 10**400, 0.5, -1, 1e308, 5e-324, -0.0, float("nan"), float("inf"))
    texts = ("", text, "x" * 100_000, "..", "/", "/dev/zero", "/dev/stdin")
    return rng.choice((*numbers, *texts, True, False, [], {}, [[]], {"": {}}, [1, "a"]))
