"""A release: one version everywhere, and a container file that names existing files."""

from __future__ import annotations

import re
import tarfile
import tomllib
import zipfile
from pathlib import Path

import check_dist
import check_sbom
import pytest

from pdhef_logtool.records.version import __version__

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_one_version_everywhere() -> None:
    assert PROJECT["version"] == __version__
    newest = re.search(r"^## (\S+) \((.+)\)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert newest is not None and (newest[1] == __version__ or newest[2] == "unreleased")


def test_the_container_file_is_for_this_package() -> None:
    lines = [line for line in (ROOT / "Dockerfile").read_text().splitlines() if not line.startswith("#")]
    steps = [line.split()[0] for line in lines if re.match(r"[A-Z]+ ", line)]
    assert steps[0] == "FROM" and steps.index("USER") > max(i for i, s in enumerate(steps) if s == "RUN")
    assert 'ENTRYPOINT ["pdhef"]' in lines and "USER root" not in lines
    (python,) = re.findall(r"FROM python:3\.(\d+)-slim", "\n".join(lines))
    assert int(python) >= int(PROJECT["requires-python"].removeprefix(">=3."))
    ignored = (ROOT / ".dockerignore").read_text().splitlines()
    assert {"!dist/*.whl", "!constraints.txt"} <= set(ignored) and "COPY constraints.txt dist/*.whl /tmp/dist/" in lines
    (install,) = (line for line in lines if "pip install" in line)
    assert "--constraint /tmp/dist/constraints.txt" in install and "index" not in install
    assert "RUN pdhef compile" in lines


def test_every_dependency_is_locked_and_a_run_needs_no_torch() -> None:
    extras = PROJECT["optional-dependencies"]
    names = {
        check_sbom.normalized(re.split(r"[<>=~\[]", requirement)[0])
        for requirement in (*PROJECT["dependencies"], *(r for extra in extras.values() for r in extra))
    }
    pinned = check_sbom.locked()
    assert names - {"pdhef-logtool"} <= set(pinned)
    assert all(re.fullmatch(r"[0-9.]+[0-9a-z.]*", version) for versions in pinned.values() for version in versions)
    assert not [name for name in pinned if name.startswith(("nvidia-", "cuda-")) or name == "triton"]
    assert not any("torch" in requirement for requirement in PROJECT["dependencies"])
    assert any("train" in requirement for requirement in extras["dev"])


def _archives(folder: Path, without: str = "", besides: str = "") -> Path:
    """Write stubs of a wheel and a source archive, correct except for one file."""
    name = f"pdhef_logtool-{__version__}"
    files = [*(ROOT / "pdhef_logtool").rglob("*"), *(ROOT / "truthsim").rglob("*")]
    inside = {f.relative_to(ROOT).as_posix(): f for f in files if f.is_file() and "__pycache__" not in f.parts}
    inside |= {f"pdhef_logtool/{f.relative_to(ROOT).as_posix()}": f for f in (ROOT / "schemas").rglob("*.*")}
    folder.mkdir()
    with zipfile.ZipFile(folder / f"{name}-py3-none-any.whl", "w", zipfile.ZIP_DEFLATED) as wheel:
        for path, file in inside.items():
            if path != without:
                wheel.write(file, path)
        wheel.writestr(f"{name}.dist-info/METADATA", f"Name: pdhef-logtool\nVersion: {__version__}\n")
        wheel.writestr(f"{name}.dist-info/entry_points.txt", "[console_scripts]\npdhef = pdhef_logtool.__main__:main\n")
        if besides:
            wheel.writestr(besides, "")
    with tarfile.open(folder / f"{name}.tar.gz", "w:gz") as source:
        for needed in ("LICENSE", "setup.py"):
            source.add(ROOT / needed, f"{name}/{needed}")
    return folder


@pytest.mark.slow
def test_what_is_built_is_looked_at(tmp_path: Path) -> None:
    assert check_dist.problems(_archives(tmp_path / "a")) == []
    lacking = check_dist.problems(_archives(tmp_path / "b", without="pdhef_logtool/schemas/run.schema.json"))
    assert lacking == ["the wheel lacks pdhef_logtool/schemas/run.schema.json"]
    assert check_dist.problems(_archives(tmp_path / "c", besides="tests/x.py")) == ["the wheel holds tests"]
    compiled = "pdhef_logtool/records/__pycache__/x.nbi"
    assert check_dist.problems(_archives(tmp_path / "d", besides=compiled)) == [f"the wheel holds {compiled}"]
    (tmp_path / "a" / "other.whl").write_text("")
    assert "alone" in check_dist.problems(tmp_path / "a")[0]
