"""A release: one version everywhere, and a container file that names existing files."""

import re
import tomllib
from pathlib import Path

import check_sbom

from pdhef_logtool.records.version import __version__

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_one_version_everywhere():
    assert PROJECT["version"] == __version__
    newest = re.search(r"^## (\S+) \((.+)\)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert newest is not None and (newest[1] == __version__ or newest[2] == "unreleased")


def test_the_container_file_is_for_this_package():
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


def test_every_dependency_is_locked_and_a_run_needs_no_torch():
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
