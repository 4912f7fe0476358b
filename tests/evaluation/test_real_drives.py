"""Recorded drives: alignment and truth reproduce the figures that the data's description gives for them."""

from __future__ import annotations

from pathlib import Path

import pytest

from pdhef_logtool.car.toml_files import read_vehicle_file
from pdhef_logtool.drive.alignment import align, plan_alignment
from pdhef_logtool.evaluation.manoeuvres import find_manoeuvres
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import fit_clocks, load_mapping, read_signals

REFERENCE = Path(__file__).resolve().parents[1] / "reference"
DRIVES = {
    "comma2k19_segment.mcap": ("comma2k19", "comma2k19_rav4"),
    "lunda_v40": ("lunda_v40", "lunda_v40"),
    "v40_slalom.mcap": ("../../../studies/peers/v40_gnss", "lunda_v40"),
}


@pytest.fixture(scope="module")
def drive(shared_dir):
    done = {}

    def read(name):
        if name not in done:
            mapping_name, vehicle_name = DRIVES[name]
            log = open_log(shared_dir / "data" / "drives" / name)
            mapping = load_mapping(REFERENCE / "mappings" / f"{mapping_name}.toml")
            clocks = fit_clocks(log, mapping, log.start_ns, log.end_ns)
            channels = read_signals(log, mapping, clocks, log.start_ns, log.end_ns)
            log.close()
            done[name] = channels, read_vehicle_file(REFERENCE / "vehicles" / f"{vehicle_name}.toml").vehicle
        return done[name]

    return read


def aligned(channels, vehicle):
    return align(channels.signals, plan_alignment(channels.signals, vehicle))[0]


@pytest.mark.parametrize(
    ("name", "expected"),
    [("lunda_v40", ["sine-with-dwell"]), ("v40_slalom.mcap", ["slalom"]), ("comma2k19_segment.mcap", [])],
)
def test_recorded_manoeuvres_are_recognised(drive, name, expected):
    channels, vehicle = drive(name)
    assert [m.name for m in find_manoeuvres(aligned(channels, vehicle), vehicle)] == expected
