"""Check an installation without extras: fleets run, and every module imports; then each extra is added in turn.

    python tests/release/plain_install.py [--extras formats http s3 train]

The package is installed from a copy of this tree into a new environment, which is removed at the end. Exit code 1: an
import or a run failed.
"""

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
EXTRAS = ("formats", "http", "s3", "train")
#: Imports every module of the package in one process; prints those that fail. Modules that define networks need an
#: extra, and their error names it; with this extra they must import.
IMPORTS = """
import importlib, pkgutil, sys
import pdhef_logtool
from pdhef_logtool.records.errors import UsageError

failed, installed = [], sys.argv[1:]
def note(name):
    error = sys.exc_info()[1]
    extra = getattr(error, "remedy", "").partition("pdhef-logtool[")[2].partition("]")[0]
    if not isinstance(error, UsageError) or extra in ("", *installed) or ".logs." in name:
        failed.append(f"{name}: {error!r}")
names = [m.name for m in pkgutil.walk_packages(pdhef_logtool.__path__, "pdhef_logtool.", note)]
for name in names:
    if not name.endswith("__main__"):
        try:
            importlib.import_module(name)
        except Exception:
            note(name)
print(len(names), "modules", *failed, sep="\\n  ")
sys.exit(bool(failed) or len(names) < 100)
"""
RUN = ("-e", "zero", "--car", "saloon", "--annotate", "none", "--keep", "metrics", "--no-report")
MANY = 51


def _do(what: str, *command: str | Path, cwd: Path) -> None:
    """Run a command and print how long it took; its output is shown if it fails, and this process ends."""
    environment = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "PYTHONHOME")}
    start = time.monotonic()
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True)
    print(f"{what}: {'ok' if done.returncode == 0 else 'FAILED'}, {time.monotonic() - start:.0f} s", flush=True)
    if done.returncode:
        sys.exit(f"{done.stdout[-4000:]}\n{done.stderr[-4000:]}\n{what}: exit code {done.returncode}")


def main() -> None:
    """Install without extras, run two fleets, then add the extras; import all modules after each step."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--extras", nargs="*", choices=EXTRAS, default=EXTRAS)
    extras = parser.parse_args().extras
    with tempfile.TemporaryDirectory(prefix="plain-install-") as scratch:
        folder = Path(scratch)
        source, logs = folder / "source", folder / "logs"
        ignored = shutil.ignore_patterns(".*", "__pycache__", "build", "dist", "out", "*.egg-info", "sample_logs")
        shutil.copytree(ROOT, source, ignore=ignored)
        python = folder / "venv" / ("Scripts" if os.name == "nt" else "bin") / "python"
        pip = (sys.executable, "-m", "pip", "--quiet", "--python", python)
        _do("new environment", sys.executable, "-m", "venv", "--without-pip", folder / "venv", cwd=folder)
        _do("wheel", sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", folder, source, cwd=folder)
        (wheel,) = folder.glob("*.whl")
        install = (*pip, "install", "--no-compile", "--constraint", ROOT / "constraints.txt")
        _do("pip install .", *install, wheel, cwd=folder)
        _do("import of all modules", python, "-c", IMPORTS, cwd=folder)
        compiled = Path("pdhef_logtool/__pycache__/compiled")  # code of the same sources, which saves a minute
        if (ROOT / compiled).is_dir():
            (installed,) = (folder / "venv").glob("[Ll]ib/**/site-packages/pdhef_logtool")
            shutil.copytree(ROOT / compiled, installed.parent / compiled, dirs_exist_ok=True)
        pdhef = (python, "-m", "pdhef_logtool")
        _do("logs", *pdhef, "simulate", "suite", "--count", str(MANY), "--duration", "3", "-o", logs, cwd=folder)
        two = sorted(logs.glob("*.mcap"))[:2]
        _do("run of 2 logs with --jobs 2", *pdhef, "run", *two, "-o", folder / "two", *RUN, "--jobs", "2", cwd=folder)
        _do(f"run of {MANY} logs", *pdhef, "run", logs, "-o", folder / "many", *RUN, cwd=folder)
        for number, extra in enumerate(extras, start=1):
            _do(f"extra {extra}", *install, f"{wheel}[{extra}]", cwd=folder)
            _do("import of all modules", python, "-c", IMPORTS, *extras[:number], cwd=folder)


if __name__ == "__main__":
    main()
