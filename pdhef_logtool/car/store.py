"""Atomic change of files in a car's folder.

A new folder is written beside the old one and exchanged with it, so that a reader sees one of the two.
"""

import shutil
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from pdhef_logtool.car.car import VEHICLE_FILE, Car
from pdhef_logtool.car.toml_files import part_toml
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.storage.files import write_bytes, writing
from pdhef_logtool.storage.outputs import LOCK_FILE, FolderLock, FolderTransaction

#: Timeout for waiting until another command has changed the same car.
LONGEST_WAIT_S = 60.0


def check_output(source: Car, output: Path) -> None:
    """Reject an unsuitable output folder before any computation.

    Raises
    ------
    UsageError
        The output is neither a new folder nor this car's.
    """
    if not output.exists() and output.suffix != ".toml":
        return
    theirs = output / VEHICLE_FILE
    if not output.is_dir() or (any(output.iterdir()) and not theirs.is_file()):
        raise UsageError(expected="a new folder or a car's folder", got=output.name, where="--output")
    if theirs.is_file() and theirs.read_bytes() != vehicle_file(source):
        raise UsageError(
            expected="a new folder, or the folder of the same car",
            got=f"{output.name}, which contains a different {VEHICLE_FILE}",
            where="--output",
            remedy=f"name another folder, or give --car {output}",
        )


def vehicle_file(car: Car) -> bytes:
    """Return the bytes of a car's vehicle.toml, generated for the default car."""
    if car.source is None:
        return part_toml(car.vehicle, "The default car of pdhef.").encode()
    return (car.source / VEHICLE_FILE if car.source.is_dir() else car.source).read_bytes()


def update_car(source: Car, output: Path, files: Mapping[str, bytes]) -> None:
    """Write files, by name, into the car's folder ``output``.

    A new folder contains the source's vehicle.toml and parts as well. ``output`` may be the source itself.

    Raises
    ------
    OutputError
        The folder cannot be written; the old one is unchanged.
    UsageError
        See :func:`check_output`.
    """
    check_output(source, output)
    new = not output.exists()
    lock = FolderLock(output)
    lock.acquire(wait_s=LONGEST_WAIT_S)
    try:
        base = output if (output / VEHICLE_FILE).is_file() else source.source
        with writing(output), FolderTransaction(output, keep=False) as transaction:
            fresh = transaction.file(".")
            if base is not None and base.is_dir():
                shutil.copytree(base, fresh, dirs_exist_ok=True, ignore=shutil.ignore_patterns(f"{LOCK_FILE}*"))
            else:
                write_bytes(fresh / VEHICLE_FILE, vehicle_file(source))
            for name, content in files.items():
                write_bytes(fresh / name, content)
            lock.hold_next(fresh)
    except BaseException:
        if new:
            with suppress(OSError):
                output.rmdir()
        raise
    finally:
        lock.release()
