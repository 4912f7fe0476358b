"""The files of schemas/ are there in a source tree and in a built wheel."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from pdhef_logtool.logs.schema_files import message_definition, schema_file

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
OWN_MESSAGE = "pdhef_msgs/msg/VehicleStateEstimate"


def test_a_built_wheel_ships_every_schema_file(tmp_path: Path) -> None:
    pytest.importorskip("setuptools", minversion="77")
    source = tmp_path / "source"
    ignore = shutil.ignore_patterns("__pycache__")
    for folder in ("pdhef_logtool", "truthsim", "schemas"):
        shutil.copytree(ROOT / folder, source / folder, ignore=ignore)
    for name in ("pyproject.toml", "setup.py", "LICENSE"):
        shutil.copyfile(ROOT / name, source / name)
    (source / "README.md").write_text("x")
    code = "from setuptools import build_meta; build_meta.build_wheel('dist')"
    subprocess.run([sys.executable, "-c", code], cwd=source, check=True, capture_output=True, timeout=300)
    (wheel,) = (source / "dist").glob("*.whl")
    names = set(zipfile.ZipFile(wheel).namelist())
    schemas = {p.relative_to(ROOT).as_posix() for p in (ROOT / "schemas").rglob("*") if p.is_file()}
    assert f"schemas/{OWN_MESSAGE}.msg" in schemas
    assert {f"pdhef_logtool/{name}" for name in schemas} <= names
    modules = {p.relative_to(ROOT).as_posix() for p in (ROOT / "pdhef_logtool").rglob("*.py")}
    assert modules <= names

    # The schemas are read from the wheel itself, where no source tree stands beside it.
    installed = tmp_path / "installed"
    zipfile.ZipFile(wheel).extractall(installed)
    code = (
        "import pdhef_logtool; from pdhef_logtool.results.arrow_schema import arrow_schema, load_schema;"
        "print(pdhef_logtool.__file__); print(load_schema('report.schema.json')['$schema']);"
        "print(arrow_schema('metrics.parquet.json').names[0])"
    )
    environment = {**os.environ, "PYTHONPATH": str(installed)}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, check=True, capture_output=True, text=True
    )
    where, dialect, column = done.stdout.split()
    assert Path(where).is_relative_to(installed)
    assert dialect.startswith("https://json-schema.org/")
    assert column == "log"


def test_own_definition_keeps_its_units_and_carries_its_contained_types() -> None:
    text = message_definition(OWN_MESSAGE)
    assert text.startswith(schema_file(f"{OWN_MESSAGE}.msg").read_text(encoding="utf-8").rstrip())
    assert "MSG: std_msgs/Header" in text
    assert "MSG: builtin_interfaces/Time" in text


def test_an_unknown_type_is_a_key_error() -> None:
    with pytest.raises(KeyError):
        message_definition("no_such/msg/Type")
