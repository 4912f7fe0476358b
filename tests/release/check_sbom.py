"""Checks the bill of materials of a release: this version, and all that it needs at run time in the locked versions.

python tests/release/check_sbom.py dist/sbom.cdx.json
"""

import json
import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
#: Distributions of extras, which a release does not bring along.
NOT_SHIPPED = re.compile(r"torch|triton|nvidia-.*|cuda-.*|pytest.*")
#: Packages present in every virtual environment.
INSTALLERS = {"pip", "setuptools"}


def normalized(name: str) -> str:
    """Return the name of a distribution as package indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def locked() -> dict[str, set[str]]:
    """Return the versions of constraints.txt by name; one name can have several, for different Python versions."""
    found: dict[str, set[str]] = {}
    for line in (ROOT / "constraints.txt").read_text().splitlines():
        if not line.startswith("#"):
            name, _, version = line.partition(";")[0].strip().partition("==")
            found.setdefault(normalized(name), set()).add(version)
    return found


def problems(file: Path) -> list[str]:
    """Return the problems of a bill of materials, one line each."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    bill, pinned = json.loads(file.read_text()), locked()
    if bill.get("bomFormat") != "CycloneDX":
        return [f"expected CycloneDX, got {bill.get('bomFormat')}"]
    root = bill["metadata"]["component"]
    found = []
    if (root["name"], root["version"]) != (project["name"], project["version"]):
        found.append(f"expected {project['name']} {project['version']}, got {root['name']} {root['version']}")
    versions = {normalized(c["name"]): c["version"] for c in bill["components"]}
    needed = {normalized(re.split(r"[<>=~!\[; ]", d)[0]) for d in project["dependencies"]}
    found += [f"{name} is missing" for name in sorted(needed - set(versions))]
    for name, version in sorted(versions.items()):
        if NOT_SHIPPED.fullmatch(name):
            found.append(f"{name} is no dependency of a run")
        elif name not in INSTALLERS and version not in pinned.get(name, set()):
            found.append(f"{name} {version} is not in constraints.txt")
    return found + (["a path of the build machine"] if "file://" in file.read_text() else [])


if __name__ == "__main__":
    wrong = problems(Path(sys.argv[1]))
    print(
        "\n".join(wrong) or f"{sys.argv[1]}: {len(json.loads(Path(sys.argv[1]).read_text())['components'])} components"
    )
    sys.exit(bool(wrong))
