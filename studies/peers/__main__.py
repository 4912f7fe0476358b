"""Every estimator and published ones on drives with ground truth: ``docs/peers.md``.

    python -m studies.peers [--out docs] [--stored]
    python -m studies.peers --folder DIR [--car CAR] [--mapping FILE] | --published FILE.csv ...

Without ``--folder`` and ``--published``: the recorded drives of ``../shared``, which may not be redistributed, and the
page is written; without these drives, nothing is done. Otherwise the table is printed. All estimators get the same
vehicle file and the same mapped and aligned signals; ground truth is used for scores only.
"""

import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import polars as pl

import pdhef_logtool as pdhef
from pdhef_logtool.car.toml_files import part_toml
from pdhef_logtool.drive.options import OFF
from pdhef_logtool.logs.discovery import find_logs
from pdhef_logtool.records.tracks import StateTrack
from studies.pages import DRIVES, OF_PAGES, options, read_json, update, write_json
from studies.peers.drives import OFFSET, PEER_DRIVES, REFERENCE, PeerDrive, mapping_of, mapping_table, vehicle_of
from studies.peers.page import CAUSAL, NO_FILE, SEDAN, blocks, estimator_table
from studies.peers.scoring import Entry, scores

STORED = ("scores.parquet", "parameters.json")
RUN_MAPPING = Path(__file__).with_name("published.toml")
RUN_CAR = REFERENCE / "vehicles" / "f1tenth.toml"


def recorded(d: PeerDrive) -> Entry:
    """Return a recorded drive with its published vehicle file."""
    car = pdhef.Car(vehicle_of(d))
    return Entry(DRIVES / d.log, d.group, d.drive, d.car, car, mapping_of(d), d.least_speed_m_s, d.group == OFFSET)


def of_folder(folder: Path, car: Path | None, mapping: Path | None) -> Iterator[Entry]:
    """Yield the logs below a folder, with the vehicle and mapping files in it."""
    beside = [folder / name for name in ("vehicle.toml", "mapping.toml")]
    car, mapping = (
        given or (file if file.is_file() else None) for given, file in zip((car, mapping), beside, strict=True)
    )
    loaded = pdhef.Car.load(car), pdhef.load_mapping(mapping) if mapping else None
    for log in find_logs(str(folder)):
        yield Entry(Path(str(log.path)), folder.name, log.stem, loaded[0].vehicle.name, *loaded)


def published(file: Path, folder: Path) -> Iterator[Entry]:
    """Split a published table of arXiv:2408.15610 into a log for each run, and yield these.

    ``file``: time in s in its first column, which has no name, and ``run_id``.
    """
    rows, car = pl.read_csv(file), pdhef.Car.load(RUN_CAR)
    for (run,), of_run in rows.rename({rows.columns[0]: "time"}).group_by("run_id", maintain_order=True):
        log = folder / f"{file.stem}_{run}.csv"
        of_run.sort("time").write_csv(log)
        yield Entry(log, file.stem, log.stem, car.vehicle.name, car, pdhef.load_mapping(RUN_MAPPING))


def scored(entries: Iterable[Entry]) -> tuple[list[dict[str, Any]], int]:
    """Return the scores of all logs, and how many logs cannot be scored."""
    rows, failed = list[dict[str, Any]](), 0
    for entry in entries:
        print(entry.log.name, file=sys.stderr, flush=True)
        try:
            rows += scores(entry)[0]
        except pdhef.PdhefError as error:
            failed += 1
            print(error, file=sys.stderr)
    return rows, failed


def recorded_scores(work: Path) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return the scores of all recorded drives, and the parameters that were calibrated on each.

    ``work`` takes the models, which the causal variant of other drives uses.
    """
    rows, parameters = list[dict[str, Any]](), list[dict[str, Any]]()
    models, truths = dict[str, tuple[float, Path]](), dict[str, StateTrack | None]()
    scores(recorded(PEER_DRIVES[0]))  # loads the compiled code
    for d in PEER_DRIVES:
        own, model, truths[d.log] = scores(recorded(d))
        rows += own
        print(d.log, {r["estimator"]: round(r["rmse_deg"], 3) for r in own}, file=sys.stderr, flush=True)
        if model.posterior is not None and not model.posterior.refused:
            parameters.append({"log": d.log, "parameters": model.posterior.to_dict()["parameters"]})
            models[d.log] = own[0]["length_s"], work / f"{d.log}.model.toml"
            models[d.log][1].write_text(part_toml(model.file, "Written by python -m studies.peers."))
    for d in PEER_DRIVES:
        alike = [o for o in PEER_DRIVES if o.drive != d.drive and _recorder(o) == _recorder(d) and o.log in models]
        earlier = max((models[o.log] for o in alike), default=(0.0, OFF))[1]
        causal = replace(recorded(d), names=("pd-hef",), labels={"pd-hef": CAUSAL}, model=earlier)
        labels = {"linear-kf:open-loop": SEDAN, "pd-hef": NO_FILE}
        bare = replace(recorded(d), names=tuple(labels), labels=labels, car=pdhef.Car.load(None), truth=truths[d.log])
        rows += scored([causal, bare])[0]
    return rows, parameters


def _recorder(drive: PeerDrive) -> tuple[object, ...]:
    vehicle = vehicle_of(drive).model_dump(exclude={"name"})
    return drive.car, mapping_table(drive)["signals"], vehicle


def main(arguments: Sequence[str] | None = None) -> int:
    """Score all estimators; print the tables of logs that are given, or write page and results."""
    parser = options("peers", __doc__, OF_PAGES)
    parser.add_argument("--folder", type=Path, help="logs with ground truth")
    parser.add_argument("--published", type=Path, nargs="+", default=[], metavar="CSV", help="of arXiv:2408.15610")
    parser.add_argument("--car", type=Path, help="car folder or vehicle.toml of --folder")
    parser.add_argument("--mapping", type=Path, help="mapping.toml of --folder")
    given = parser.parse_args(arguments)
    work: Path = given.work
    work.mkdir(parents=True, exist_ok=True)
    if given.folder or given.published:
        entries = [entry for file in given.published for entry in published(file, work)]
        entries += of_folder(given.folder, given.car, given.mapping) if given.folder else ()
        scored(entries[:1])  # loads the compiled code, which no score may contain
        rows, failed = scored(entries)
        for (group,), of_group in pl.DataFrame(rows).group_by("group", maintain_order=True) if rows else ():
            print(f"## {group}\n\n{estimator_table(of_group)}\n")
        return 1 if not rows else 3 if failed else 0
    scored_file, parameters_file = (given.results / stored for stored in STORED)
    if not given.stored:
        if not DRIVES.is_dir():
            print("nothing is compared: needs ../shared beside the repository, or --folder")
            return 0
        rows, parameters = recorded_scores(work)
        given.results.mkdir(parents=True, exist_ok=True)
        pl.DataFrame(rows).write_parquet(scored_file, compression="zstd")
        write_json(parameters_file, parameters)
    stored = pl.read_parquet(scored_file), read_json(parameters_file)
    update(given.out, "peers.md", blocks(*stored))
    return 0


if __name__ == "__main__":
    sys.exit(main())
