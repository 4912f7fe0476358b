"""A residual dataset on disk: one Parquet file per drive, and manifest.json.

See docs/formats.md#residual-dataset.

Files are in ``split=SPLIT/car=CAR/part-DRIVE.parquet``: ``polars.scan_parquet`` and others read them as one table.
Features, targets and weights are stored as float32, with a relative error of 6e-8. The footer of each file contains its
entry of the manifest, so that the files of an interrupted command remain usable. Files that the manifest does not name
do not belong to the dataset. A later call extends the manifest and replaces entries with the same log and slice.
"""

import json
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pdhef_logtool.car.parts import car_folder
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.learning.network.residuals import ResidualRows
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.records.signals import S_PER_NS
from pdhef_logtool.residual_model.features import FEATURES
from pdhef_logtool.results.opened_run import MAX_DOCUMENT_BYTES
from pdhef_logtool.results.parquet_sink import arrow_array, arrow_schema, parquet_writer
from pdhef_logtool.results.run_report import tool_versions, write_json
from pdhef_logtool.storage.documents import DIGEST, checked_sha256, digest, is_sealed, read_sealed, seal, validated

FORMAT = "pdhef.residual-dataset"
FORMAT_VERSION = 7
MANIFEST = "manifest.json"
#: Glob pattern of the drives' files in a dataset.
FILES = "split=*/car=*/part-*.parquet"
TARGETS = (("target_dvy_m_s", "m/s"), ("target_dyaw_rate_rad_s", "rad/s"))
TRUTH = ("truth_vx_m_s", "truth_vy_m_s")
#: Columns for conditions of ``--where``; ground truth is never an input, but may select training data.
COLUMNS = (*FEATURES, *TRUTH)
SPLITS = ("train", "validation", "test")
#: Rows of a row group, which takes less than 2 MB.
ROWS_A_GROUP = 32768

_ENTRY = b"pdhef.drive"
_EXPECTED = f"a residual dataset with its {MANIFEST}"
_REMEDY = "write one with pdhef extract LOG... -o DATASET (--resume finishes an interrupted one)"
_AGAIN = "extract it again"
_SCHEMA = "residuals.parquet.json"


def write_drive(path: Path, rows: ResidualRows, entry: Mapping[str, Any], *, truth_source: str = "") -> None:
    """Write the Parquet file of one drive, with the drive's entry.

    ``truth_source`` : source of the true sideslip.

    Raises
    ------
    OutputError
        When the file cannot be written.
    """
    schema = arrow_schema(_SCHEMA)
    names = (*FEATURES, *(name for name, _ in TARGETS), *TRUTH)
    numbers = np.hstack([rows.features, rows.targets, rows.truth_velocity])
    columns: dict[str, Any] = dict(zip(names, numbers.T, strict=True))
    columns |= {"stamp_ns": rows.stamps_ns, "weight": rows.weight, "segment": rows.segment.astype(np.int32)}
    columns |= {"truth_std_rad": rows.truth_std_rad, "chosen": rows.chosen}
    columns["truth_source"] = np.full(len(rows), truth_source)
    table = pa.Table.from_arrays([arrow_array(columns[f.name], f.type) for f in schema], schema=schema)
    with parquet_writer(path, schema, use_dictionary=["segment"], write_page_checksum=True) as writer:
        writer.write_table(table, row_group_size=ROWS_A_GROUP)
        writer.add_key_value_metadata({_ENTRY.decode(): json.dumps(seal(entry), sort_keys=True)})


def read_entry(path: Path) -> dict[str, Any] | None:
    """Return the manifest's entry in a drive's file.

    Return None if the file is missing or damaged: all of it is read to verify its checksums.
    """
    try:
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            entry = json.loads(file.metadata.metadata[_ENTRY])
            groups = [file.metadata.row_group(g) for g in range(file.num_row_groups)]
            types = [[g.column(i).physical_type for i in range(g.num_columns)] for g in groups]
            of_file = [file.schema.column(i).physical_type for i in range(file.metadata.num_columns)]
            names = arrow_schema(_SCHEMA).names  # no checksum covers these
            if file.schema_arrow.names != names or any(t != of_file for t in types):
                return None
            for _ in file.iter_batches():
                pass
    except (OSError, KeyError, TypeError, ValueError, RecursionError, pa.ArrowException):
        return None
    if not isinstance(entry, dict) or not is_sealed(entry):
        return None
    return {key: value for key, value in entry.items() if key != DIGEST}


def drive_file(folder: Path, entry: Mapping[str, Any]) -> Path:
    """Return the path of a drive in a dataset, by the split, car, log and slice of its entry."""
    car = car_folder(entry["car"], entry["vehicle_sha256"])
    return folder / split_folder(entry["split"]) / car / f"part-{entry['name']}.parquet"


def split_folder(split: str) -> str:
    """Return the folder name of a split, quoted; readers of partitioned datasets unquote it."""
    return f"split={quote(split, safe='')}"


def write_manifest(
    folder: Path,
    entries: Sequence[Mapping[str, Any]],
    failed: Sequence[Mapping[str, str]],
    *,
    settings: Mapping[str, Any],
    vehicles: Mapping[str, Mapping[str, Any]],
    duplicates: Sequence[Mapping[str, str]] = (),
) -> dict[str, Any]:
    """Write manifest.json for the given drives, and return it.

    Parameters
    ----------
    entries : one per drive, from its file or an earlier manifest.
    failed : log, file and reason of the logs without a drive.
    duplicates : log, file and name of the equal drive, for the logs that were excluded as duplicates.
    settings : of the latest call.
    vehicles : by the digest of their physics; unused vehicles are omitted.

    Raises
    ------
    OutputError
        It cannot be written, or a drive's file is missing or differs from the earlier manifest.
    """
    drives = []
    for entry in sorted(entries, key=lambda e: str(e["name"])):
        path = drive_file(folder, entry)
        sha256 = checked_sha256(path, entry.get("file_sha256"), MANIFEST, _AGAIN)
        drives.append({**entry, "file": path.relative_to(folder).as_posix(), "file_sha256": sha256})
    splits = {}
    for name in dict.fromkeys((*SPLITS, *(d["split"] for d in drives))):
        of = [d for d in drives if d["split"] == name]
        splits[name] = {"drives": len(of)} | {key: sum(d[key] for d in of) for key in ("rows", "usable_rows")}
    document = {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "model": settings["model"],
        "sha256": digest([[d["name"], d["file_sha256"]] for d in drives]),
        "features": list(FEATURES),
        "targets": [{"name": name, "unit": unit} for name, unit in TARGETS],
        "period_s": float(np.median([d["period_s"] for d in drives])) if drives else None,
        "settings": dict(settings),
        "vehicles": [vehicles[sha256] for sha256 in sorted({d["vehicle_sha256"] for d in drives})],
        "splits": splits,
        "drives": drives,
        "failed": list(failed),
        "duplicates": list(duplicates),
        "versions": tool_versions(),
    }
    write_json(folder / MANIFEST, seal(document))
    return document


def remove_unnamed(folder: Path, manifest: Mapping[str, Any]) -> None:
    """Remove drive files that the manifest does not name, as readers of the folder would include them."""
    named = {d["file"] for d in manifest["drives"]}
    for path in sorted(folder.glob(FILES)):
        if path.relative_to(folder).as_posix() not in named:
            path.unlink()
            for parent in (path.parent, path.parent.parent):
                with suppress(OSError):  # not empty
                    parent.rmdir()


@dataclass(frozen=True, slots=True, eq=False)
class DatasetDrive:
    """One drive of a dataset. Its arrays are read on every access, as a dataset may exceed the memory.

    ``entry`` is its entry in the manifest.
    """

    path: Path
    entry: Mapping[str, Any]

    def load(self) -> ResidualRows:
        """Read the rows of the drive at which the parallel filter has a state; targets are 0 where the weight is.

        Raises
        ------
        OutputError
            The file is missing or differs from the manifest.
        """
        checked_sha256(self.path, self.entry["file_sha256"], MANIFEST, _AGAIN)
        table = pq.read_table(self.path, partitioning=None)
        column = {name: table[name].to_numpy() for name in table.column_names if name != "split"}
        stamps = column["stamp_ns"].astype(np.int64)
        step_s = np.full(stamps.shape[0], float(self.entry["period_s"]))
        step_s[:-1] = np.diff(stamps) * S_PER_NS
        rows = np.isfinite([column[name] for name in FEATURES]).all(axis=0)  # with a state of the filter
        column = {name: values[rows] for name, values in column.items()}
        weight = column["weight"].astype(np.float32)
        targets = np.stack([column[name] for name, _ in TARGETS], axis=1).astype(np.float32)
        targets[weight == 0.0] = 0.0
        return ResidualRows(
            stamps_ns=stamps[rows],
            features=np.stack([column[name] for name in FEATURES], axis=1).astype(np.float32),
            targets=targets,
            step_s=step_s[rows],
            weight=weight,
            segment=column["segment"].astype(np.int64),
            truth_velocity=np.stack([column[name] for name in TRUTH], axis=1).astype(np.float32),
            chosen=column["chosen"],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Dataset:
    """A residual dataset with its manifest and drives.

    ``sha256`` identifies the content; ``model`` is the filter of features and residuals (:data:`~.bundle.MODELS`).
    """

    folder: Path
    model: str
    sha256: str
    drives: tuple[DatasetDrive, ...]
    manifest: Mapping[str, Any]

    @property
    def physics_sha256(self) -> str:
        """Digest of the physics behind the residuals; of several vehicles, the digest of their digests."""
        hashes = [str(v["sha256"]) for v in self.manifest["vehicles"]]
        return hashes[0] if len(hashes) == 1 else digest(hashes)

    @property
    def vehicle_name(self) -> str:
        """Names of the vehicles behind the residuals."""
        return ", ".join(sorted({str(v["name"]) for v in self.manifest["vehicles"]}))

    def vehicle(self, drive: DatasetDrive) -> VehicleParameters:
        """Return the vehicle behind the residuals of a drive."""
        wanted = drive.entry["vehicle_sha256"]
        parameters = next((v["parameters"] for v in self.manifest["vehicles"] if v["sha256"] == wanted), None)
        where, expected = self.folder / MANIFEST, "the parameters of a vehicle"
        return validated(VehicleParameters, parameters, where, OutputError, expected=expected)


def read_dataset(folder: Path, model: str = "") -> Dataset:
    """Open a dataset by its manifest, with the residuals of a model, or of any.

    Raises
    ------
    OutputError
        The folder contains no dataset, or one of another format or model, or with other features.
    """
    path = folder / MANIFEST
    document = read_sealed(path, _EXPECTED, OutputError, _REMEDY, MAX_DOCUMENT_BYTES)
    kind, version, names = (document.get(key) for key in ("format", "version", "features"))
    if (kind, version, names) != (FORMAT, FORMAT_VERSION, list(FEATURES)):
        raise OutputError(
            expected=f"{FORMAT} {FORMAT_VERSION} with the features {', '.join(FEATURES)}",
            got=f"{kind} {version} with {', '.join(names or ['none'])}",
            where=path,
            remedy="pdhef extract LOG... -o DATASET creates it again, in another folder",
        )
    if model not in ("", document["model"]):
        raise OutputError(
            expected=f"residuals of {model}",
            got=f"residuals of {document['model']}",
            where=folder,
            remedy=f"pdhef extract LOG... -o DATASET --filter {model} writes them, into another folder",
        )
    drives = tuple(DatasetDrive(folder / d["file"], d) for d in document["drives"])
    return Dataset(folder, document["model"], document["sha256"], drives, document)
