"""Check the built archives: one wheel and one source archive of this version, with exactly the files that a run needs.

python tests/release/check_dist.py dist
"""

import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
#: Of the wheel; it had 2.9 MB when this was written.
MOST_BYTES = 4_000_000
#: Data files that are read at run time, by their folder in the tree.
DATA = ("pdhef_logtool/models", "pdhef_logtool/reports/assets", "pdhef_logtool/reports/templates", "truthsim/vehicles")
NEEDED = {"pdhef_logtool/py.typed", "truthsim/py.typed", "pdhef_logtool/mapping/vendors.toml"}
NOT_SHIPPED = ("tests", "studies", "benchmarks", "docs", "sample_logs")
_LEFT_OVER = ("__pycache__", ".nbi", ".nbc", ".pyc", ".partial", ".tmp")


def _files(folder: str, pattern: str = "*") -> set[str]:
    paths = (p.relative_to(ROOT) for p in (ROOT / folder).rglob(pattern) if p.is_file())
    return {p.as_posix() for p in paths if not any(x in p.as_posix() for x in _LEFT_OVER)}


def problems(folder: Path) -> list[str]:
    """Return the problems of the archives of a folder, in lines."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    version = project["version"]
    names = sorted(p.name for p in folder.iterdir())
    wheel, source = f"pdhef_logtool-{version}-py3-none-any.whl", f"pdhef_logtool-{version}.tar.gz"
    if names != [wheel, source]:
        return [f"expected {wheel} and {source} alone, got {', '.join(names) or 'nothing'}"]
    found = []
    if (size := (folder / wheel).stat().st_size) > MOST_BYTES:
        found.append(f"the wheel has {size} bytes, more than {MOST_BYTES}")
    with zipfile.ZipFile(folder / wheel) as archive:
        packed = set(archive.namelist())
        metadata = archive.read(f"pdhef_logtool-{version}.dist-info/METADATA").decode()
        entry = archive.read(f"pdhef_logtool-{version}.dist-info/entry_points.txt").decode()
    needed = {*NEEDED, *_files("pdhef_logtool", "*.py"), *_files("truthsim", "*.py")}
    needed |= {name for data in DATA for name in _files(data)}
    needed |= {f"pdhef_logtool/{name}" for name in _files("schemas")}
    found += [f"the wheel lacks {name}" for name in sorted(needed - packed)]
    tops = {name.partition("/")[0] for name in packed}
    if others := sorted(tops - {"pdhef_logtool", "truthsim", f"pdhef_logtool-{version}.dist-info"}):
        found.append(f"the wheel holds {', '.join(others)}")
    found += [f"the wheel holds {name}" for name in sorted(packed) if any(x in name for x in _LEFT_OVER)]
    if f"\nVersion: {version}\n" not in metadata or "pdhef = pdhef_logtool.__main__:main" not in entry:
        found.append("the wheel's metadata name another version, or no command pdhef")
    with tarfile.open(folder / source) as archive:
        inside = {name.partition("/")[2] for name in archive.getnames()}
    held = sorted({name.partition("/")[0] for name in inside} & set(NOT_SHIPPED))
    found += [f"the source archive holds {name}/" for name in held]
    return found + [f"the source archive lacks {name}" for name in ("LICENSE", "setup.py") if name not in inside]


if __name__ == "__main__":
    wrong = problems(Path(sys.argv[1]))
    print("\n".join(wrong) or "\n".join(f"{p.name}: {p.stat().st_size} bytes" for p in Path(sys.argv[1]).iterdir()))
    sys.exit(bool(wrong))
