"""Benchmark of sideslip: every estimator and peer on drives with ground truth: ``docs/benchmark.md``.

    python -m studies.peers.benchmark [--folder DIR] [--published FILE.csv ...] [--car CAR] [--mapping FILE]
                                      [--out docs/benchmark.md]

Without ``--folder`` and ``--published``: the recorded drives of ``../shared``, and the page is written. Otherwise the
tables are printed.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

import pdhef_logtool as pdhef
from pdhef_logtool.evaluation.statistics import pooled
from pdhef_logtool.evaluation.track_errors import NORMAL_95, signal_error
from pdhef_logtool.logs.discovery import find_logs
from pdhef_logtool.mapping import Mapping
from pdhef_logtool.model.drive_model import DriveModel
from pdhef_logtool.model.intervals import drive_intervals
from pdhef_logtool.runs.estimating import estimate_drive
from studies.pages import DOCS, DRIVES, RESULTS, number, options, table, template, write
from studies.peers.drives import OFFSET, PEER_DRIVES, REFERENCE, mapping_of, vehicle_of
from studies.peers.scoring import SIDESLIP

#: Factor of the part of an error outside a 95 % interval in its score: 2 / 0.05.
PENALTY = 40.0
RUN_MAPPING = Path(__file__).with_name("published.toml")
RUN_CAR = REFERENCE / "vehicles" / "f1tenth.toml"


@dataclass(frozen=True, slots=True)
class Entry:
    """A log of the benchmark.

    ``group``: heading of its table; ``drive``: name of the recorded drive; mapping None: recognised.
    """

    log: Path
    group: str
    drive: str
    car: pdhef.Car
    mapping: Mapping | None


def recorded() -> Iterator[Entry]:
    """Yield the recorded drives, except for those with an offset in the ground truth."""
    for d in PEER_DRIVES:
        if d.group != OFFSET:
            car = pdhef.Car.of(vehicle_of(d))
            yield Entry(DRIVES / d.log, f"{d.group[0].upper()}{d.group[1:]} cars", d.drive, car, mapping_of(d))


def of_folder(folder: Path, car: Path | None, mapping: Path | None) -> Iterator[Entry]:
    """Yield the logs below a folder, with the vehicle and mapping files in it."""
    car, mapping = (
        given or _there(folder / name) for given, name in ((car, "vehicle.toml"), (mapping, "mapping.toml"))
    )
    loaded = pdhef.Car.load(car or "sedan"), pdhef.load_mapping(mapping) if mapping else None
    for log in find_logs(str(folder)):
        yield Entry(Path(str(log.path)), folder.name, log.stem, *loaded)


def _there(path: Path) -> Path | None:
    return path if path.is_file() else None


def published(file: Path, folder: Path) -> Iterator[Entry]:
    """Split a published table of arXiv:2408.15610 into a log for each run, and yield these.

    ``file``: time in s in its first column, which has no name, and ``run_id``.
    """
    rows = pl.read_csv(file)
    for (run,), of_run in rows.rename({rows.columns[0]: "time"}).group_by("run_id", maintain_order=True):
        log = folder / f"{file.stem}_{run}.csv"
        of_run.sort("time").write_csv(log)
        yield Entry(log, file.stem, log.stem, pdhef.Car.load(RUN_CAR), pdhef.load_mapping(RUN_MAPPING))


def scores(entry: Entry) -> Iterator[dict[str, Any]]:
    """Yield the scores of all estimators on a log, with the car calibrated on it as in a run; angles in degrees."""
    with pdhef.read_drive(entry.log, entry.car, entry.mapping) as drive:
        model, whole = DriveModel.fit(drive), drive.whole()
        given = [e for group in ("all", "peers") for e in pdhef.choose(drive, [group], model.car)[0]]
        corrected, truth = model.apply(whole.signals), whole.truth
        for name, estimator in {e.name: e for e in given}.items():
            begin = time.process_time()
            intervals = drive_intervals(model.car, [estimator])
            (track,) = estimate_drive(whole, corrected, [estimator], intervals=intervals).tracks.values()
            seconds = time.process_time() - begin
            if truth is None or track.name != name:
                continue
            error = signal_error(track, truth, SIDESLIP, entry.car.vehicle.low_speed_blend_m_s)
            used = np.isfinite(error)
            if not used.any():
                continue
            error, half = (np.degrees(x[used]) for x in (np.abs(error), NORMAL_95 * track.sideslip_std_rad))
            length_s = float(np.ptp(track.stamps_ns) * 1e-9)
            yield {
                "group": entry.group,
                "log": entry.log.name,
                "drive": entry.drive,
                "car": entry.car.vehicle.name,
                "estimator": name,
                "scored_s": length_s * float(np.mean(used)),
                "rmse_deg": float(np.sqrt(np.mean(error**2))),
                "available": float(np.mean(track.valid)),
                "coverage95": float(np.mean(error <= half)) if np.isfinite(half).any() else np.nan,
                "winkler_deg": float(np.mean(2.0 * half + PENALTY * np.maximum(error - half, 0.0))),
                "seconds_per_hour": 3600.0 * seconds / length_s,
            }


def table_of(rows: pl.DataFrame) -> str:
    """Return the table of a group, the lowest error of `zero` first."""
    zero = rows.filter(estimator="zero").select("log", of_zero="rmse_deg")
    lines = []
    for (name,), own in rows.join(zero, on="log").group_by("estimator", maintain_order=True):
        weights, values, others = (own[c].to_numpy() for c in ("scored_s", "rmse_deg", "of_zero"))
        factors = {factor: own[factor].to_list() for factor in ("car", "drive")}
        error = pooled(weights, values, None, squares=True, positive=True, level=0.95, factors=factors)
        ratio = float(np.sqrt(np.average(values**2, weights=weights) / np.average(others**2, weights=weights)))
        share, covers, winkler, cost = (
            float(np.average(own[c].to_numpy(), weights=weights))
            for c in ("available", "coverage95", "winkler_deg", "seconds_per_hour")
        )
        cells = [str(len(own)), number(error.value, 2), f"{number(error.low, 2)} to {number(error.high, 2)}"]
        cells += [number(ratio, 2), f"{share:.0%}", number(covers, 2), number(winkler, 2), number(cost, 1)]
        lines.append((ratio, [f"`{name}`", *cells]))
    head = ["estimator", "drives", "RMSE", "95 %", "of zero", "available", "covers", "Winkler", "s/h"]
    return table(head, [cells for _, cells in sorted(lines)], right_from=1)


def main(arguments: Sequence[str] | None = None) -> int:
    """Score all estimators, print the tables, and write the page of the recorded drives."""
    parser = options("peers.benchmark", __doc__)
    parser.add_argument("--folder", type=Path, help="logs with ground truth")
    parser.add_argument("--published", type=Path, nargs="+", default=[], metavar="CSV", help="of arXiv:2408.15610")
    parser.add_argument("--car", type=Path, help="car folder or vehicle.toml of --folder")
    parser.add_argument("--mapping", type=Path, help="mapping.toml of --folder")
    parser.add_argument("--out", type=Path, default=DOCS / "benchmark.md")
    given = parser.parse_args(arguments)
    own = bool(given.folder or given.published)
    if not own and not DRIVES.is_dir():
        print("needs ../shared beside the repository, or --folder")
        return 0
    rows, failed = list[dict[str, Any]](), 0
    with tempfile.TemporaryDirectory() as work:
        entries = [entry for file in given.published for entry in published(file, Path(work))]
        entries += of_folder(given.folder, given.car, given.mapping) if given.folder else ()
        for i, entry in enumerate(entries if own else recorded()):
            try:
                if not i:
                    list(scores(entry))  # loads the compiled code, which no score may contain
                rows += scores(entry)
            except pdhef.PdhefError as error:
                failed += 1
                print(f"{entry.log.name}: {error}", file=sys.stderr)
            print(entry.log.name, file=sys.stderr, flush=True)
    if not rows:
        return 1
    groups = pl.DataFrame(rows).group_by("group", maintain_order=True)
    tables = "\n".join(f"## {group}\n\n{table_of(of_group)}\n" for (group,), of_group in groups)
    print(tables)
    if not own:
        pl.DataFrame(rows).write_json(RESULTS / "peers" / "benchmark.json")
        write(given.out, template(__file__, tables=tables))
    return 3 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
