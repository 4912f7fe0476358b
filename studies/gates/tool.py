"""The tool under test as its users see it: the command line, and the files of a run."""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from studies.pages import read_json, read_toml
from truthsim.drive import Drive, write_drive

#: The longest time for one command, s.
LIMIT_S = 3600.0


@dataclass(frozen=True, slots=True)
class Tool:
    """The source tree under test, and a folder for its outputs."""

    tree: Path
    work: Path

    def python(self, module: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
        """Run a module of the tree under test."""
        environment = os.environ | {"PYTHONPATH": str(self.tree), "OMP_NUM_THREADS": "1", "COLUMNS": "200"}
        command = [sys.executable, "-m", module, *map(str, arguments)]
        return subprocess.run(
            command, cwd=self.tree, env=environment, capture_output=True, text=True, check=False, timeout=LIMIT_S
        )

    def pdhef(self, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
        """Run a command of the tool."""
        return self.python("pdhef_logtool", *arguments)

    def json(self, *arguments: str | Path) -> dict[str, Any]:
        """Return the JSON document that a command prints.

        Raises
        ------
        RuntimeError
            The command fails.
        """
        done = self.pdhef(*arguments, "--json")
        if done.returncode not in (0, 3, 4):
            raise RuntimeError(f"pdhef {' '.join(map(str, arguments))}: exit {done.returncode}\n{done.stderr[-2000:]}")
        return dict(json.loads(done.stdout))

    def run(self, name: str, *arguments: str | Path) -> Path:
        """Run estimators on logs without pages; return the output folder."""
        output = self.work / "runs" / name
        self.json("run", *arguments, "-o", output, "--annotate", "none", "--no-report")
        return output

    def log(self, name: str, drive: Drive, *, steering_wheel: bool = False) -> Path:
        """Write a simulated drive as MCAP; return its path."""
        path = self.work / "logs" / f"{name}.mcap"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        write_drive(drive, path, steering_wheel=steering_wheel)
        return path

    def mapping(self, log: Path) -> dict[str, Any]:
        """Return the mapping that the tool recognises."""
        file = self.work / "mappings" / f"{log.parent.parent.name}-{log.parent.name}-{log.stem}.toml"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.unlink(missing_ok=True)
        self.json("inspect", log, "--write-mapping", file)
        return read_toml(file)


def metrics(run: Path, **of: str) -> pl.DataFrame:
    """Return the metrics over whole logs of a run, those with the given columns alone."""
    return pl.read_parquet(run / "metrics.parquet").filter(segment="all", **of)


def sideslip_rmse_deg(run: Path) -> dict[str, float]:
    """Return the sideslip RMSE over all samples of all logs of a run by estimator, in degrees."""
    rows = metrics(run, signal="sideslip_rad", metric="rmse")
    pooled = rows.group_by("estimator").agg((pl.col("value") ** 2 * pl.col("n")).sum() / pl.col("n").sum())
    return {name: float(np.degrees(np.sqrt(square))) for name, square in pooled.sort("estimator").iter_rows()}


def coverage_percent(run: Path, estimator: str) -> float:
    """Return the share of samples within the 95 % interval of sideslip over all logs of a run."""
    rows = metrics(run, signal="sideslip_rad", metric="coverage95", estimator=estimator)
    return 100.0 * float(np.average(rows["value"], weights=rows["n"])) if len(rows) else float("nan")


def estimates(run: Path) -> pl.DataFrame:
    """Return the estimates of a run of one log."""
    (file,) = run.glob("logs/*/estimates.parquet")
    return pl.read_parquet(file)


def reports(run: Path) -> dict[str, dict[str, Any]]:
    """Return the report.json of every log of a run by name."""
    return {f.parent.name: read_json(f) for f in sorted(run.glob("logs/*/report.json"))}
