"""The rows of the gates: each measures figures of the tool by its command line and its files."""

import math
import re
import subprocess
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from studies.calibration import DRIVEN, errors_over_sd, true_values, wrong_file
from studies.conditions import row_inputs, row_logs
from studies.gates.tool import Tool, coverage_percent, reports, sideslip_rmse_deg
from studies.mapping_mistakes import VERDICTS, outcomes
from studies.pages import DRIVES, ROOT, SAMPLE_VEHICLE, read_json, read_toml, write_toml
from studies.peers.drives import PEER_DRIVES, PeerDrive, mapping_table, needed_files, vehicle_table
from studies.torture.seeds import FORMATS, RECORDINGS
from truthsim.conditions import ROWS
from truthsim.drive import simulate_drive
from truthsim.sensors import SensorNoise

SAMPLES = ROOT / "sample_logs"
ESTIMATORS = "zero,kinematic,open-loop,linear-regression,phy-ukf,physics,pure-lstm,pd-hef-paper,pd-hef,pd-hef-smoothed"
_TABLES = read_toml(Path(__file__).with_suffix(".toml"))


class Figure(NamedTuple):
    """A measured value, its unit, and its tolerance: relative, but at least absolute."""

    value: float
    unit: str
    relative: float = 0.03
    absolute: float = 0.0


Figures = dict[str, Figure]


@dataclass(frozen=True, slots=True)
class GateRow:
    """One row: ``measure`` returns its figures by name.

    ``quick``: whether the quick gates contain it. ``needs``: files outside the repository, without which it is skipped.
    """

    gate: str
    name: str
    measure: Callable[[Tool], Figures]
    quick: bool = False
    needs: tuple[Path, ...] = ()


def rmse_figures(run: Path, absolute_deg: float, coverage_of: str | None = None) -> Figures:
    """Return the sideslip RMSE of every estimator of a run, and the coverage of the 95 % interval of one."""
    figures = {
        f"RMSE {name}": Figure(value, "deg", absolute=absolute_deg)
        for name, value in sideslip_rmse_deg(run).items()
        if math.isfinite(value)
    }
    if coverage_of and math.isfinite(share := coverage_percent(run, coverage_of)):
        figures[f"coverage95 {coverage_of}"] = Figure(share, "%", absolute=1.0)
    return figures


def present(names: set[str] | list[str]) -> Figures:
    """Return a figure for each name that must exist."""
    return {name: Figure(1.0, "present", 0.0) for name in sorted(names)}


# ------------------------------------------------------------------------------------------------ condition table

_SIMULATING = threading.Lock()


def condition(row: str, drives: int, tool: Tool) -> Figures:
    """Run the estimators on the drives of a row of the condition table."""
    with _SIMULATING:
        logs, assume = row_logs(tool.work, row, drives)
    given = ("--car", "saloon", "--keep", "metrics", "--estimators", ESTIMATORS)
    run = tool.run(f"condition-{row}-{drives}", *logs, *given, *row_inputs(tool, row, logs[0], assume))
    return rmse_figures(run, 0.003, "pd-hef")


# ------------------------------------------------------------------------------------------------ recorded drives


def recorded(drive: PeerDrive, receiver: bool, tool: Tool) -> Figures:
    """Run estimators and reference on a recorded drive with its published vehicle file, which is calibrated."""
    name = f"{drive.log.partition('.')[0]}{'-gnss' if receiver else ''}"
    mapping = write_toml(tool.work / "mappings" / f"{name}.toml", mapping_table(drive, receiver=receiver))
    car = write_toml(tool.work / "cars" / f"{name}.toml", vehicle_table(drive))
    names = "zero,kinematic,open-loop,phy-ukf,physics,pd-hef"
    given = ("--car", car, "--mapping", mapping, "--keep", "estimates", "--reference", "on", "--estimators", names)
    run = tool.run(f"recorded-{name}", DRIVES / drive.log, *given)
    figures = rmse_figures(run, 0.01, "physics")
    (report,) = reports(run).values()
    calibration = report["self_calibration"] or {}
    return figures | {
        f"{name} {p['name']}": Figure(float(p[key]), p.get("unit", "1"), absolute=0.03 * abs(float(p["sd"])))
        for p in calibration.get("parameters", ())
        for name, key in (("calibrated", "value"), ("±", "sd"))
    }


#: Recorded drives of the quick gates: each has another car or container.
QUICK_DRIVES = ("gti_pole_aa.mcap", "v40_slalom.mcap", "f1tenth_xray_0.bag")


# ------------------------------------------------------------------------------------------------ simulated reference


def bare_vehicle() -> dict[str, Any]:
    """Return the vehicle file of the saloon without its validation data."""
    return {name: value for name, value in read_toml(SAMPLE_VEHICLE).items() if name != "network"}


def reference(name: str, tool: Tool) -> Figures:
    """Run the reference and the filters on a simulated drive."""
    drive = simulate_drive(**_TABLES["reference_drives"][name], friction=0.85, seed=3)
    log = tool.log(f"{name.replace(' ', '-')}-3", drive)
    car = write_toml(tool.work / "cars" / "saloon.toml", bare_vehicle())
    names = "zero,kinematic,open-loop,phy-ukf,physics"
    run = tool.run(f"reference-{log.stem}", log, "--car", car, "--reference", "on", "--estimators", names)
    return rmse_figures(run, 0.003, "reference")


# ------------------------------------------------------------------------------------------------ ±


def plus_minus(seeds: range, tool: Tool) -> Figures:
    """Return the RMS normalized error of the estimated parameters of the saloon with wrong vehicle files."""
    right, scores = bare_vehicle(), dict[str, list[float]]()
    true = true_values(right, SensorNoise().imu_x_m)
    for seed in seeds:
        manoeuvre, speed, duration_s = DRIVEN[seed % len(DRIVEN)]
        drive = simulate_drive(manoeuvre, speed_km_h=speed, friction=0.85, seed=seed, duration_s=duration_s)
        log = tool.log(f"plus-minus-{seed}", drive, steering_wheel=True)
        car = write_toml(tool.work / "cars" / f"wrong-{seed}.toml", wrong_file(right, np.random.default_rng(seed)))
        run = tool.run(f"plus-minus-{seed}", log, "--car", car, "--keep", "estimates", "--estimators", "zero,physics")
        (report,) = reports(run).values()
        for name, score in errors_over_sd(report, true):
            scores.setdefault(name, []).append(score)
    figures = {
        f"RMS error / sd, {name}": Figure(float(np.sqrt(np.mean(np.square(values)))), "1", absolute=0.03)
        for name, values in sorted(scores.items())
    }
    everything = np.abs(np.concatenate(list(scores.values())))
    share = Figure(100.0 * float(np.mean(everything <= 1.96)), "%", absolute=1.0)
    return figures | {"within ± 1.96 sd": share, "values": Figure(float(len(everything)), "count", 0.0)}


# ------------------------------------------------------------------------------------------------ mapping mistakes


def mistakes(log: str, kinds: Sequence[tuple[str, str]], tool: Tool) -> Figures:
    """Count the verdicts of the checks of ``inspect`` on mistakes in a mapping."""
    path, folder = SAMPLES / log, tool.work / "mappings"

    def look(log: Path, mapping: Path) -> list[dict[str, Any]]:
        return list(tool.json("inspect", log, "--mapping", mapping)["checks"])

    found = outcomes(look, path, tool.mapping(path), folder / f"mistakes-{len(kinds)}", kinds)
    counts = Counter(outcome.verdict for outcome in found)
    return {name: Figure(float(counts[name]), "count", 0.0) for name in VERDICTS}


def written(file: Path, done: subprocess.CompletedProcess[str]) -> dict[str, Any]:
    """Return a JSON document that a module has written; raises RuntimeError if it has not."""
    if not file.is_file():
        raise RuntimeError(done.stderr[-2000:])
    return dict(read_json(file))


# ------------------------------------------------------------------------------------------------ third-party logs


def strangers(only: Sequence[str], tool: Tool) -> Figures:
    """Count the recognised and the wrong signals of logs of unknown layout."""
    name = f"strangers-{len(only)}"
    kept = tool.work / f"{name}.json"
    chosen = ("--only", *only) if only else ()
    given = ("--work", tool.work / name, "--keep", kept, "--out", tool.work / f"{name}.md")
    logs = written(kept, tool.python("studies.strangers", "--held-out", *given, *chosen))
    counts = Counter(outcome for log in logs.values() for outcome in log["items"].values())
    share = 100.0 * counts["right"] / counts.total()
    silent = Figure(float(counts["wrong, not reported"]), "count", 0.0)
    return {"wrong, not reported": silent, "recognised": Figure(share, "%", 0.0, 0.5)}


# ------------------------------------------------------------------------------------------------ fuzz


def fuzz(name: str, count: int, tool: Tool) -> Figures:
    """Count how commands end on mutants of a format."""
    work = tool.work / f"fuzz-{name}-{count}"
    given = ("--work", work, "--jobs", "1", "--format", name, "--count", str(count), "--out", work)
    judged = written(work / "formats.json", tool.python("studies.torture", "formats", *given))[name]
    figures = {f"{name}: problems": Figure(float(len(judged["problems"])), "count", 0.0)}
    for end in ("exit 0", "exit 1", "exit 3"):
        ended = sum(n for text, n in judged["ends"].items() if text.partition(",")[0] == end)
        figures[f"{name}: {end}"] = Figure(float(ended), "count", 0.03, 1.0)
    return figures


# ------------------------------------------------------------------------------------------------ contract


def exit_codes(tool: Tool) -> Figures:
    """Return the exit codes of commands that end well and badly."""
    folder = tool.work / "contract"
    folder.mkdir(parents=True, exist_ok=True)
    content = (SAMPLES / "dlc.mcap").read_bytes()
    (folder / "cut.mcap").write_bytes(content[: len(content) // 2])
    (folder / "noise.mcap").write_bytes(bytes(range(256)) * 40)
    write_toml(folder / "plan.toml", {"requirement": [_TABLES["requirement"]]})
    for name in ("new-plan.toml", "simulated.mcap", "converted.mcap"):
        (folder / name).unlink(missing_ok=True)
    given = {"sample": SAMPLES / "dlc.mcap", "folder": folder}
    return {
        name: Figure(float(tool.pdhef(*(word.format(**given) for word in words)).returncode), "exit code", 0.0)
        for name, words in _TABLES["exit_codes"].items()
    }


def options(tool: Tool) -> Figures:
    """Return the commands and their options, as ``--help`` lists them."""
    listed = re.findall(r"^  ([a-z]+)(?: suite| conditions)?  +[A-Z]", tool.pdhef("--help").stdout, re.MULTILINE)
    helps = {name: tool.pdhef(name, "--help").stdout for name in dict.fromkeys(listed)}
    found = {name: set(re.findall(r"^  .*?(--[a-z-]+)", text, re.MULTILINE)) for name, text in helps.items()}
    return present([f"{c} {o}".strip() for c, names in found.items() for o in ("", *names)])


def files_and_keys(tool: Tool) -> Figures:
    """Return the files of a run, the columns of its tables, and the keys of its documents."""
    import polars as pl

    output = tool.work / "runs" / "files"
    tool.json("run", SAMPLES / "dlc.mcap", "-o", output, "--car", "saloon", "--estimators", "zero,physics")
    names = {str(f.relative_to(output)) for f in output.rglob("*") if f.is_file() and "metrics/" not in str(f)}
    log = output / "logs" / "dlc"
    for table in (output / "metrics.parquet", log / "estimates.parquet"):
        names |= {f"{table.name} {column}" for column in pl.read_parquet_schema(table)}
    for file, depth in ((output / "run.json", 1), (log / "report.json", 2)):
        names |= {f"{file.name} {key}" for key in keys(read_json(file), depth)}
    inspected = tool.json("inspect", SAMPLES / "dlc.mcap")
    names |= {f"inspect --json {key}" for key in keys(inspected, 1)}
    names |= {f"inspect --json topics[].{key}" for key in inspected["topics"][0]}
    return present(names)


def keys(document: dict[str, Any], depth: int) -> Iterator[str]:
    """Yield the paths of the keys of a document down to a depth, and of the first entry of a list."""
    for name, value in document.items():
        yield name
        inner = value[0] if isinstance(value, list) and value else value
        if depth > 1 and isinstance(inner, dict):
            yield from (f"{name}.{key}" for key in keys(inner, depth - 1))


# ------------------------------------------------------------------------------------------------ all

#: Formats of which a few mutants are quick.
_FEW_FORMATS = ("csv", "blf", *RECORDINGS)


def all_rows() -> Iterator[GateRow]:
    """Yield all rows in the order of the file; the fuzz tests, which take longest, are last."""
    for name, measure in {"exit codes": exit_codes, "options": options, "files and keys": files_and_keys}.items():
        yield GateRow("contract", name, measure, quick=True)
    for name in _TABLES["reference_drives"]:
        yield GateRow("reference", name, partial(reference, name), quick=name == "double lane change")
    for d in PEER_DRIVES:
        needs, is_quick = needed_files(d), d.log in QUICK_DRIVES
        yield GateRow("recorded drives", d.log, partial(recorded, d, False), is_quick, needs)
        if d.log.startswith("v40_"):
            yield GateRow("recorded drives", f"{d.log}, GNSS velocity", partial(recorded, d, True), needs=needs)
    for row in ROWS:
        yield GateRow("conditions", row.name, partial(condition, row.name, 10))
    for name in ("in-domain", "gyro-stuck"):
        yield GateRow("conditions", f"{name}, 2 drives", partial(condition, name, 2), quick=True)
    yield GateRow("third-party logs", "all", partial(strangers, ()))
    yield GateRow("third-party logs", "7 layouts", partial(strangers, _TABLES["few_layouts"]), quick=True)
    yield GateRow("plus-minus", "20 cars", partial(plus_minus, range(20)))
    yield GateRow("plus-minus", "1 car", partial(plus_minus, range(2, 3)), quick=True)
    for log in ("dlc.mcap", "road.mcap"):
        yield GateRow("mapping mistakes", log, partial(mistakes, log, ()))
    few_mistakes = partial(mistakes, "dlc.mcap", _TABLES["few_mistakes"])
    yield GateRow("mapping mistakes", "dlc.mcap, 6 mistakes", few_mistakes, quick=True)
    for name in FORMATS:
        yield GateRow("fuzz", name, partial(fuzz, name, 50))
        if name in _FEW_FORMATS:
            yield GateRow("fuzz", f"{name}, 3 mutants", partial(fuzz, name, 3), quick=True)
