"""What is gone of a log is told alike by every command that reads drives, and ends each of them with 3."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import torch
from typer.testing import CliRunner

from pdhef_logtool.cli.app import app
from pdhef_logtool.learning.drives import DriveRecord, drives_document, exit_code, tell_drive
from pdhef_logtool.records.signals import Loss
from pdhef_logtool.residual_model.bundle import ModelBundle, Normalisation
from pdhef_logtool.residual_model.features import FEATURES
from pdhef_logtool.residual_model.network import Architecture, ResidualNetwork

REFERENCE = Path(__file__).resolve().parents[1] / "reference"
#: Calibration needs five drives.
COPIES = ("cut", "cut2", "cut3", "cut4", "cut5")


def _model(folder: Path) -> Path:
    torch.manual_seed(0)
    n = len(FEATURES)
    network = ResidualNetwork(Architecture(n, 8, 1, (4,)))
    weights = {k: v.numpy().copy() for k, v in network.state_dict().items()}
    ModelBundle(FEATURES, 8, 1, (4,), 0.01, Normalisation((0.0,) * n, (10.0,) * n, (1.0, 1.0)), weights).save(folder)
    return folder


def _run(*arguments: object) -> tuple[dict[str, Any], list[str]]:
    """Run a command that must end with 3; return its JSON and the lines of stderr."""
    result = CliRunner().invoke(app, [str(a) for a in (*arguments, "--json")])
    assert result.exit_code == 3, (arguments[0], result.exit_code, result.exception, result.stderr)
    return json.loads(result.stdout), result.stderr.splitlines()


def _compare(folder: Path, common: tuple[object, ...], end_s: int, estimate: str) -> None:
    log, out = folder / "cut.mcap", folder / "out"
    for name in COPIES[1:]:
        shutil.copy(log, folder / f"{name}.mcap")
    logs = tuple(folder / f"{name}.mcap" for name in COPIES)
    model = _model(folder / "model")
    common = (*common, "--end", end_s)
    ran, _ = _run("run", log, "-o", out, *common, "-e", "phy-ukf", "--annotate", "none", "--model", "none")
    expected = ran["logs"][0]["report"]["losses"]
    lost = [x for x in expected if x["severity"] == "lost"]
    assert [x["kind"] for x in lost] == ["truncated"]
    scored, _ = _run("metrics", log, *common, "--estimate", estimate)
    assert scored["logs"][0]["report"]["losses"] == expected
    warning = f"warning: cut: {lost[0]['what']} (cut.mcap)"
    commands: dict[str, tuple[object, ...]] = {
        "identify": (log, "-o", folder / "identified.toml", *common, "--holdout", 0),
        "extract": (log, "-o", folder / "residuals", *common, "--split", "train"),
        "tune": (log, "-o", folder / "tuned.toml", *common, "-e", "phy-ukf-tuned", "--trials", 4),
        "trust": (log, "-o", folder / "trusted.toml", *common, "--model", model),
        "calibrate": (*logs, "-o", folder / "c.json", *common, "-e", "phy-ukf", "--model", "none", "--vary", 0),
    }
    for command, arguments in commands.items():
        document, said = _run(command, *arguments)
        assert document["exit_code"] == 3
        assert document["left_out"] == []
        (drive,) = (d for d in document["drives"] if d["name"] == "cut")
        assert drive["losses"] == expected, command
        assert said.count(warning) == 1, (command, said)


def test_a_truncated_log_is_told_alike_by_all_commands(sample_logs_dir: Path, tmp_path: Path) -> None:
    whole = (sample_logs_dir / "road.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) // 4])
    _compare(
        tmp_path, ("--vehicle", sample_logs_dir / "vehicle.toml"), 35, "sideslip_rad=/truth/perfect/state.sideslip_rad"
    )


def test_the_truncated_250_lm_is_told_alike_by_all_commands(shared_dir: Path, tmp_path: Path) -> None:
    shutil.copyfile(shared_dir / "data/drives/faulty/revs_250lm_a_truncated60.mcap", tmp_path / "cut.mcap")
    vehicle, mapping = REFERENCE / "vehicles" / "revs_250lm.toml", REFERENCE / "mappings" / "revs_250lm.toml"
    _compare(
        tmp_path,
        ("--vehicle", vehicle, "--mapping", mapping),
        60,
        "vx_m_s=/vehicle/status/velocity_status.longitudinal_velocity",
    )


def _record(name: str, *, severity: str = "", left_out: str = "") -> DriveRecord:
    losses = (Loss("gap", "something", "/imu", severity=severity),) if severity else ()  # type: ignore[arg-type]
    return DriveRecord(name, f"{name}.mcap", losses=losses, notes=("a note",), left_out=left_out)


def test_one_rule_for_exit_codes() -> None:
    good, noted, lost = _record("good"), _record("noted", severity="note"), _record("lost", severity="lost")
    out = _record("out", left_out="no truth")
    assert exit_code([good, noted]) == 0
    assert exit_code([good, lost]) == 3
    assert exit_code([good, out]) == 3
    assert exit_code([out, out]) == 1


def test_one_wording_for_what_is_told() -> None:
    said: list[str] = []
    for record in (_record("noted", severity="note"), _record("lost", severity="lost"), _record("out", left_out="why")):
        tell_drive(record, said.append)
    assert said == [
        "noted: a note",
        "lost: a note",
        "lost: something (/imu)",
        "out: a note",
        "out is left out: why",
    ]
    document = drives_document([_record("lost", severity="lost"), _record("out", left_out="why")])
    assert [d["name"] for d in document["drives"]] == ["lost"]
    assert document["drives"][0]["losses"][0]["severity"] == "lost"
    assert document["left_out"][0]["reason"] == "why"
    json.dumps(document, allow_nan=False)


def test_a_damaged_chunk_is_counted_once(shared_dir: Path) -> None:
    log = shared_dir / "data/drives/faulty/revs_250lm_a_flipped_byte.mcap"
    mapping = REFERENCE / "mappings" / "revs_250lm.toml"
    speed = "vx_m_s=/vehicle/status/velocity_status.longitudinal_velocity"
    scored, _ = _run("metrics", log, "--mapping", mapping, "--estimate", speed)
    (lost,) = (x for x in scored["logs"][0]["report"]["losses"] if x["severity"] == "lost")
    assert lost["what"].startswith(f"{lost['count']} messages lost")
