"""Whether a retraining can be left alone: sound drives pass the gate, corrupted labels do not, a second call is idle.

    python -m studies.retrain [--drives 60] [-o out/retrain] [--jobs 2]

Simulated drives of the car that the package ships, which its network has not seen. The same teach three times: as
they are, with the sign of every residual turned round, and with the residuals of a drive in a random order. The gate's
drives are sound each time. What is there from an interrupted call is taken.
"""

from __future__ import annotations

import hashlib
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pdhef_logtool.learning.network.dataset import MANIFEST, TARGETS, read_manifest
from pdhef_logtool.learning.network.extract_command import extract
from pdhef_logtool.learning.retrain import retrain_command
from pdhef_logtool.learning.retrain.retrain_command import RetrainResult, RetrainSettings, retrain
from pdhef_logtool.records.documents import digest, seal
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.sinks.report import write_json
from studies.pages import options
from truthsim.suite import write_suite

SEED, DRIVES = 6100, 60
Corrupt = Callable[[np.ndarray, np.random.Generator], np.ndarray]
KINDS: dict[str, Corrupt | None] = {
    "sound": None,
    "turned round": lambda targets, _: -targets,
    "shuffled": lambda targets, rng: rng.permutation(targets),
}


def main(arguments: list[str] | None = None) -> int:
    """Run the check and print a line a kind; 1 if one came out otherwise than it should."""
    parser = options("retrain", __doc__)
    parser.add_argument("--drives", type=int, default=DRIVES)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/retrain"))
    parser.add_argument("--jobs", type=int, default=2)
    asked = parser.parse_args(arguments)
    logs = asked.output / "logs"
    write_suite(logs, count=asked.drives, seed=SEED, processes=asked.jobs)
    (logs / "manifest.json").unlink()  # a fleet has none, and its drives are dealt
    drives = sorted(str(p) for p in logs.glob("*.mcap"))
    right = True
    for kind, corrupt in KINDS.items():
        folder = asked.output / kind.replace(" ", "-")
        began = time.monotonic()
        found = retrained(drives, folder, corrupt, jobs=asked.jobs)
        first_s = time.monotonic() - began
        right &= found.accepted == (corrupt is None)
        why = found.document["comparison"]["verdict"] + "".join(f"; {r}" for r in found.document["reasons"])
        print(f"{kind}: {'accepted' if found.accepted else 'rejected'} ({why}), {first_s:.0f} s")
    said: list[str] = []
    began = time.monotonic()
    retrained(drives, asked.output / "sound", None, jobs=asked.jobs, say=said.append)
    idle = sum(text.endswith("(as found before)") for text in said)
    print(f"sound, again: {idle} of {len(said)} stages had nothing to do, {time.monotonic() - began:.1f} s")
    return 0 if right and idle == len(said) else 1


def retrained(
    logs: Sequence[str], folder: Path, corrupt: Corrupt | None, *, jobs: int, say: Callable[[str], None] = print
) -> RetrainResult:
    """Retrain the shipped car on logs, with the labels of the dataset spoilt between extraction and training."""

    def spoilt(arguments: Any, output: Path, *rest: Any, **named: Any) -> Any:
        result = extract(arguments, output, *rest, **named)
        if corrupt is not None:
            result.manifest.update(corrupt_labels(output, corrupt))
        return result

    settings = RetrainSettings(config=RunConfig(car=Path("saloon")))
    with patch.object(retrain_command, "extract", spoilt):
        return retrain(logs, folder, settings, jobs=jobs, say=lambda text: say(f"  {text}"))


def corrupt_labels(dataset: Path, corrupt: Corrupt) -> dict[str, Any]:
    """Spoil the targets of every drive of a dataset, usable rows among themselves; return its manifest."""
    document = read_manifest(dataset)
    for drive in document["drives"]:
        path = dataset / drive["file"]
        table, rng = pq.read_table(path, partitioning=None), np.random.default_rng(0)
        targets = np.stack([table[name].to_numpy() for name, _ in TARGETS], axis=1)
        use = table["weight"].to_numpy() > 0.0
        targets[use] = corrupt(targets[use], rng)
        for column, (name, _) in enumerate(TARGETS):
            place = table.column_names.index(name)
            table = table.set_column(place, table.schema.field(name), pa.array(targets[:, column], from_pandas=True))
        pq.write_table(table, path)
        drive["file_sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
    files = [d["file_sha256"] for d in document["drives"]]
    document["sha256"] = digest(files)
    write_json(dataset / MANIFEST, seal(document))
    return document


if __name__ == "__main__":
    sys.exit(main())
