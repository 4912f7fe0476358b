"""The command line ``pdhef``: each command parses, calls one public function, and prints."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from pdhef_logtool.records.errors import EXIT_FAILURE, EXIT_PARTIAL, PdhefError, UsageError

if TYPE_CHECKING:
    from rich.console import Console

    from pdhef_logtool.run.pipeline import RunResult

app = typer.Typer(
    name="pdhef",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Estimate sideslip on recorded drives (MCAP, rosbag1, rosbag2), score it against truth, annotate the logs.",
    epilog="Exit codes: 0 ok, 1 failure, 2 usage, 3 finished but some input was lost or some logs failed, "
    "4 a threshold or regression gate failed.",
)


def _version(show: bool) -> None:
    if show:
        from pdhef_logtool import __version__

        print(f"pdhef {__version__}")  # noqa: T201
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    del version


JsonFlag = Annotated[bool, typer.Option("--json", help="One JSON document on stdout instead of tables.")]
MappingFile = Annotated[
    Path | None, typer.Option("--mapping", "-m", help="mapping.toml: topic.field -> signal. Default: recognised types.")
]
ThresholdsFile = Annotated[
    Path | None,
    typer.Option("--thresholds", help="thresholds.toml: limits on figures; exit code 4 when one is broken."),
]
JunitFile = Annotated[
    Path | None, typer.Option("--junit", help="Write the verdicts of --thresholds as JUnit XML, for CI.")
]
FrictionChoice = Annotated[
    str | None,
    typer.Option(
        "--friction",
        help="auto (the log's, else the vehicle file's, else estimated), file, estimate, or a number; docs/friction.md",
    ),
]
TruthChoice = Annotated[
    str | None, typer.Option("--prefer-truth", help="perfect or rtk: which truth of a simulated log counts.")
]


@app.command(
    epilog="""Examples:

  pdhef inspect drive.mcap

  pdhef inspect drive.bag --json | jq .signals

  pdhef inspect drive.mcap --write-mapping mapping.toml"""
)
def inspect(
    log: Annotated[Path, typer.Argument(help="MCAP file, rosbag1 file, rosbag2 folder or .db3 file.")],
    mapping: MappingFile = None,
    write_mapping: Annotated[
        Path | None, typer.Option("--write-mapping", help="Write a ready-to-edit mapping.toml (never overwrites).")
    ] = None,
    prefer_truth: TruthChoice = None,
    as_json: JsonFlag = False,
) -> None:
    """Show topics, rates, gaps, clock jitter, what maps to what, and what is missing."""
    from pdhef_logtool.inspection import inspect_log, render_inspection
    from pdhef_logtool.inspection import write_mapping as write_mapping_file
    from pdhef_logtool.mapping import load_mapping
    from pdhef_logtool.run.config import load_config

    config = load_config(None, {"mapping": mapping, "prefer_truth": prefer_truth})
    chosen = None if config.mapping is None else load_mapping(config.mapping)
    inspection = inspect_log(log, chosen, prefer_truth=config.prefer_truth)
    if write_mapping is not None:
        write_mapping_file(inspection, write_mapping)
        _say(f"mapping written to {write_mapping}")
    if as_json:
        _print_json(inspection.to_dict())
    else:
        render_inspection(inspection, _stdout())
    if any(loss.severity == "lost" for loss in inspection.lost):
        raise typer.Exit(EXIT_PARTIAL)


@app.command(
    epilog="""Examples:

  pdhef run drive.mcap -o out

  pdhef run drive.bag -o out --vehicle car.toml --mapping mapping.toml

  pdhef run logs/ -o out --estimators zero,phy-ukf --annotate sidecar

  pdhef run drive.mcap -o out --start +60s --end end-5s --json

  pdhef run logs/ -o out --thresholds limits.toml --junit out/gate.xml

Times: seconds from the log's start (12.5, +10s), before its end (end-5s), nanoseconds (an integer of 1e15 or more), or
RFC 3339 (2026-01-31T12:00:00Z)."""
)
def run(
    logs: Annotated[list[str], typer.Argument(help="Logs, folders that hold some, or glob patterns.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for everything that the run writes.")],
    estimators: Annotated[
        str | None, typer.Option("--estimators", "-e", help="Comma-separated names; see pdhef estimators.")
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option("--model", help="Folder of a model bundle, many-cars, or none. Default: the shipped model."),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            "--calibration",
            help="File of pdhef calibrate, none, or unsure (wide, for a changed car). Default: the model folder's.",
        ),
    ] = None,
    vehicle: Annotated[Path | None, typer.Option("--vehicle", "-v", help="vehicle.toml.")] = None,
    mapping: MappingFile = None,
    start: Annotated[str | None, typer.Option("--start", help="Start of the slice (see Times).")] = None,
    end: Annotated[str | None, typer.Option("--end", help="End of the slice (see Times).")] = None,
    annotate: Annotated[
        str | None,
        typer.Option("--annotate", help="full: copy of the log with our topics; sidecar: our topics only; none."),
    ] = None,
    sensors: Annotated[
        str | None, typer.Option("--sensors", help="full, or esp: no wheel speeds in the filters after the start.")
    ] = None,
    friction: FrictionChoice = None,
    prefer_truth: TruthChoice = None,
    thresholds: ThresholdsFile = None,
    junit: JunitFile = None,
    config: Annotated[Path | None, typer.Option("--config", help="pdhef.toml; flags win over it.")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Run estimators on logs, compare them with truth, and write annotated logs, recordings and metrics."""
    from pdhef_logtool.cli.summary import render_run
    from pdhef_logtool.run.config import load_config
    from pdhef_logtool.run.pipeline import run_logs

    settings = load_config(
        config,
        {
            "estimators": None if estimators is None else tuple(n.strip() for n in estimators.split(",") if n.strip()),
            "model": model,
            "calibration": calibration,
            "vehicle": vehicle,
            "mapping": mapping,
            "start": start,
            "end": end,
            "annotate": annotate,
            "sensors": sensors,
            "friction": friction,
            "prefer_truth": prefer_truth,
            "thresholds": thresholds,
        },
    )
    with _progress() as progress:
        result = run_logs(logs, output, settings, junit=junit, progress=progress, warn=_warn)
    if as_json:
        _print_json(result.to_dict())
    else:
        render_run(result, _stdout())
    _end(result)


@app.command(
    epilog="""Examples:

  pdhef metrics drive.mcap --estimate /localization/odometry

  pdhef metrics drive.mcap --estimate sideslip_rad=/esc/state.beta --estimate vx_m_s=/esc/state.speed --name esc

  pdhef metrics drive.mcap --estimate /pdhef/phy_ukf/state --truth /ins/odometry --vehicle car.toml -o out

  pdhef metrics drive.mcap --mapping mapping.toml --thresholds limits.toml --junit gate.xml

The type tells the signals of nav_msgs/Odometry, geometry_msgs/Twist*Stamped and pdhef_msgs/VehicleStateEstimate; others
need SIGNAL=, one of vx_m_s, vy_m_s, yaw_rate_rad_s, sideslip_rad, ay_m_s2, their *_std_*, valid. Scales, offsets, signs
and several estimators stand in a mapping file, one [estimates.NAME.SIGNAL] table a signal."""
)
def metrics(
    log: Annotated[str, typer.Argument(help="MCAP file, rosbag1 file, rosbag2 folder or .db3 file.")],
    estimate: Annotated[
        list[str] | None,
        typer.Option("--estimate", help="[SIGNAL=]TOPIC[.FIELD], repeatable. Default: the mapping's [estimates]."),
    ] = None,
    truth: Annotated[
        list[str] | None,
        typer.Option("--truth", help="[SIGNAL=]TOPIC[.FIELD], repeatable. Default: the mapped or recognised truth."),
    ] = None,
    name: Annotated[
        str | None, typer.Option("--name", help="What the estimator is called; or which of [estimates] is scored.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for tables and report. Default: print only.")
    ] = None,
    vehicle: Annotated[
        Path | None, typer.Option("--vehicle", "-v", help="vehicle.toml: place of the truth, friction, low speed.")
    ] = None,
    mapping: MappingFile = None,
    start: Annotated[str | None, typer.Option("--start", help="Start of the slice, as in pdhef run.")] = None,
    end: Annotated[str | None, typer.Option("--end", help="End of the slice, as in pdhef run.")] = None,
    prefer_truth: TruthChoice = None,
    thresholds: ThresholdsFile = None,
    junit: JunitFile = None,
    config: Annotated[Path | None, typer.Option("--config", help="pdhef.toml; flags win over it.")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Score an estimate that somebody else recorded in the log against the truth."""
    from pdhef_logtool.cli.summary import render_run
    from pdhef_logtool.run.config import load_config
    from pdhef_logtool.run.recorded_estimates import score_log

    settings = load_config(
        config,
        {
            "vehicle": vehicle,
            "mapping": mapping,
            "start": start,
            "end": end,
            "prefer_truth": prefer_truth,
            "thresholds": thresholds,
        },
    )
    with _progress() as progress:
        result = score_log(
            log,
            settings,
            estimates=estimate or (),
            truth=truth or (),
            name=name,
            output=output,
            junit=junit,
            progress=progress,
            warn=_warn,
        )
    if as_json:
        _print_json(result.to_dict())
    else:
        render_run(result, _stdout())
    _end(result)


@app.command(
    epilog="""Examples:

  pdhef simulate --list

  pdhef simulate dlc --speed 100 --mu 0.85 --seed 1 -o dlc.mcap

  pdhef simulate road --duration 300 --seed 3 --sensor rtk_outages_per_h=30 -o road.mcap

  pdhef simulate dlc --vehicle suv --fault burst20:yaw_rate:3:5 --fault dropout:wheels:6:end -o faulty.mcap

  pdhef simulate suite --count 200 --seed 1 --jobs 2 -o logs/

  pdhef simulate conditions --drives 30 --jobs 2 -o table/

Faults: KIND:WHAT:START:END in seconds (END may be end). Kinds: burst<FACTOR>, stuck, dead, flip, bias<SI>, dropout,
delay<MS>, jump<S> (of the stamps), float, lost (the RTK's fix). What: imu, steering, wheels, rtk, all (sensors), or one
field: ax, ay, az, roll_rate, pitch_rate, yaw_rate, steer, wheel_fl, wheel_fr, wheel_rl, wheel_rr. delay and jump take
whole messages.

Vehicles: sedan, suv, hatchback or a TOML file; NAME~SEED is another car of its kind; changes follow commas: mass=1.2,
cg=0.1 (m to the rear), height=1.1, stiffness=0.85, tyres=suv.

suite writes a training set, conditions the drives of the condition table, both with a manifest.json; what is there
already is kept."""
)
def simulate(
    manoeuvre: Annotated[
        str | None, typer.Argument(help="Name of a manoeuvre (--list shows them), or suite, or conditions.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="MCAP file to write; a folder for suite and conditions.")
    ] = None,
    speed_km_h: Annotated[float | None, typer.Option("--speed", help="km/h; default: the manoeuvre's.")] = None,
    friction: Annotated[float | None, typer.Option("--mu", help="Friction; default: the manoeuvre's.")] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of noise and of random profiles; default 0.")] = None,
    duration_s: Annotated[float | None, typer.Option("--duration", help="s; default: the manoeuvre's.")] = None,
    amplitude: Annotated[
        float | None, typer.Option("--amplitude", help="Factor on the manoeuvre's own amplitude; default 1.")
    ] = None,
    vehicle: Annotated[str | None, typer.Option("--vehicle", "-v", help="See Vehicles; default sedan.")] = None,
    faults: Annotated[list[str] | None, typer.Option("--fault", help="See Faults; repeatable.")] = None,
    sensors: Annotated[
        list[str] | None,
        typer.Option("--sensor", help="NAME=VALUE of a sensor's error, repeatable; docs/simulate.md lists them."),
    ] = None,
    without: Annotated[
        list[str] | None,
        typer.Option("--without", help="Do not record imu, steering, wheels, rtk, perfect or events; repeatable."),
    ] = None,
    steering_wheel: Annotated[
        bool, typer.Option("--steering-wheel", help="Record the angle at the steering wheel too.")
    ] = False,
    rtk_rate_hz: Annotated[
        int | None, typer.Option("--rtk-rate", help="Hz of the truth: 10, 20, 50 or 100; default: the manoeuvre's.")
    ] = None,
    keep_spins: Annotated[
        bool, typer.Option("--keep-spins", help="Keep a drive with |sideslip| > 20 degrees or a lifted wheel.")
    ] = False,
    count: Annotated[int | None, typer.Option("--count", help="suite: number of drives; default 200.")] = None,
    vehicles: Annotated[
        str | None, typer.Option("--vehicles", help="suite: default, or randomised (another car each drive).")
    ] = None,
    drives: Annotated[int | None, typer.Option("--drives", help="conditions: drives a row; default 30.")] = None,
    rows: Annotated[str | None, typer.Option("--rows", help="conditions: comma-separated rows; default: all.")] = None,
    jobs: Annotated[int | None, typer.Option("--jobs", help="suite, conditions: processes; default 1.")] = None,
    list_all: Annotated[bool, typer.Option("--list", help="List the manoeuvres and their defaults.")] = False,
    as_json: JsonFlag = False,
) -> None:
    """Write drives of the simulator truthsim as ROS 2 MCAP: noisy sensors, RTK truth and perfect truth."""
    from truthsim.manoeuvres import MANOEUVRES

    if list_all:
        _list_manoeuvres(MANOEUVRES, as_json)
        return
    if manoeuvre is None or output is None:
        raise UsageError(
            expected="a manoeuvre and -o FILE",
            got="no " + ("manoeuvre" if manoeuvre is None else "-o FILE"),
            where="pdhef simulate",
            remedy="pdhef simulate --list shows the manoeuvres",
        )
    single = {
        "--speed": speed_km_h,
        "--mu": friction,
        "--amplitude": amplitude,
        "--vehicle": vehicle,
        "--fault": faults,
        "--sensor": sensors,
        "--without": without,
        "--steering-wheel": steering_wheel or None,
        "--rtk-rate": rtk_rate_hz,
        "--keep-spins": keep_spins or None,
    }
    if manoeuvre == "suite":
        from truthsim.suite import write_suite

        _refuse(manoeuvre, {**single, "--drives": drives, "--rows": rows})
        with _progress() as progress:
            manifest = write_suite(
                output,
                count=200 if count is None else count,
                seed=0 if seed is None else seed,
                vehicles=vehicles or "default",
                duration_s=12.5 if duration_s is None else duration_s,
                processes=1 if jobs is None else jobs,
                progress=progress,
            )
        _print_batch(manifest, output, ("splits", "written", "dropped_draws"), as_json)
        return
    if manoeuvre == "conditions":
        from truthsim.conditions import write_conditions

        _refuse(manoeuvre, {**single, "--duration": duration_s, "--count": count, "--vehicles": vehicles})
        with _progress() as progress:
            manifest = write_conditions(
                output,
                drives=30 if drives is None else drives,
                seed=0 if seed is None else seed,
                rows=None if rows is None else [name.strip() for name in rows.split(",") if name.strip()],
                processes=1 if jobs is None else jobs,
                progress=progress,
            )
        _print_batch(manifest, output, ("rows",), as_json)
        return
    _refuse(manoeuvre, {"--count": count, "--vehicles": vehicles, "--drives": drives, "--rows": rows, "--jobs": jobs})
    from truthsim.batch import sensor_noise
    from truthsim.drive import DEFAULT_VEHICLE, simulate_drive, write_drive
    from truthsim.faults import parse_fault
    from truthsim.vehicle_choice import choose_vehicle

    name = vehicle or DEFAULT_VEHICLE
    drive = simulate_drive(
        manoeuvre,
        speed_km_h=speed_km_h,
        friction=friction,
        seed=0 if seed is None else seed,
        duration_s=duration_s,
        amplitude=1.0 if amplitude is None else amplitude,
        vehicle=choose_vehicle(name),
        vehicle_name=name,
        noise=sensor_noise(_numbers(sensors or (), "--sensor")),
        faults=[parse_fault(text) for text in faults or ()],
        rtk_rate_hz=rtk_rate_hz,
        keep_spins=keep_spins,
    )
    write_drive(drive, output, without=without or (), steering_wheel=steering_wheel)
    facts = {"output": str(output), **drive.facts()}
    if as_json:
        _print_json(facts)
    else:
        for key, value in facts.items():
            print(f"{key}: {value:.4g}" if isinstance(value, float) else f"{key}: {value}")  # noqa: T201


def _refuse(what: str, options: dict[str, object]) -> None:
    """Refuse options that mean nothing here, so that none is silently ignored."""
    given = [name for name, value in options.items() if value is not None]
    if given:
        raise UsageError(expected=f"options of {what}", got=", ".join(given), where="pdhef simulate")


def _numbers(pairs: Sequence[str], option: str) -> dict[str, float]:
    values = {}
    for pair in pairs:
        name, _, text = pair.partition("=")
        try:
            values[name] = float(text)
        except ValueError:
            raise UsageError(expected="NAME=NUMBER", got=repr(pair), where=option) from None
    return values


def _print_batch(manifest: dict[str, Any], folder: Path, keys: Sequence[str], as_json: bool) -> None:
    summary = {"output": str(folder), "command": manifest["command"], **{key: manifest[key] for key in keys}}
    if as_json:
        _print_json(summary)
    elif "rows" in summary:
        from rich.table import Table

        bins = list(summary["rows"][0]["drives_in_bin"])
        table = Table("row", "drives", *bins, "what is wrong", box=None, header_style="bold")
        for row in summary["rows"]:
            counts = [str(row["drives_in_bin"][b]) for b in bins]
            table.add_row(row["name"], str(len(row["files"])), *counts, row["description"])
        _stdout().print(table)
    else:
        for key, value in summary.items():
            print(f"{key}: {value}")  # noqa: T201
    for entry in manifest["drives"]:
        if "sha256" not in entry:
            _warn(f"{entry['file']}: no drive: {entry['dropped'][-1]['reason']}")


def _list_manoeuvres(manoeuvres: Any, as_json: bool) -> None:
    rows = [
        {
            "name": name,
            "description": m.description,
            "speed_km_h": m.speed_km_h,
            "friction": m.friction,
            "duration_s": m.duration_s,
        }
        for name, m in manoeuvres.items()
    ]
    if as_json:
        _print_json({"manoeuvres": rows})
        return
    from rich.table import Table

    table = Table("name", "km/h", "mu", "s", "what it is", box=None, header_style="bold")
    for row in rows:
        table.add_row(
            row["name"], f"{row['speed_km_h']:g}", f"{row['friction']:g}", f"{row['duration_s']:g}", row["description"]
        )
    _stdout().print(table)


@app.command(
    epilog="""Examples:

  pdhef identify drives/ -o car.toml --vehicle guess.toml

  pdhef identify drive.mcap -o car.toml --vehicle guess.toml --end 150 --holdout 0"""
)
def identify(
    logs: Annotated[list[str], typer.Argument(help="Logs with truth, folders that hold some, or glob patterns.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="vehicle.toml to write; a plot goes beside it.")],
    vehicle: Annotated[
        Path | None, typer.Option("--vehicle", "-v", help="Starting file: mass, geometry, sensor noise, priors.")
    ] = None,
    mapping: MappingFile = None,
    start: Annotated[str | None, typer.Option("--start", help="Start of the slice of each log (as for run).")] = None,
    end: Annotated[str | None, typer.Option("--end", help="End of the slice of each log (as for run).")] = None,
    holdout: Annotated[
        float, typer.Option("--holdout", help="Share at the end of each slice that is only scored, once.")
    ] = 0.25,
    prefer_truth: TruthChoice = None,
    as_json: JsonFlag = False,
) -> None:
    """Fit axle tyres, steering, roll gradient, biases and the filter's noise to drives with truth."""
    from pdhef_logtool.cli.summary import render_identification
    from pdhef_logtool.learning.car.identify_command import run_identification
    from pdhef_logtool.run.config import load_config

    settings = load_config(
        None, {"vehicle": vehicle, "mapping": mapping, "start": start, "end": end, "prefer_truth": prefer_truth}
    )
    with _progress() as progress:
        result = run_identification(logs, output, settings, holdout=holdout, progress=progress, warn=_warn)
    if as_json:
        _print_json(result.to_dict())
    else:
        render_identification(result, _stdout())
    raise typer.Exit(result.exit_code)


@app.command(
    epilog="""Examples:

  pdhef extract logs/ -o residuals --vehicle car.toml --jobs 2

  pdhef extract drive.mcap -o residuals --vehicle car.toml --prefer-truth rtk --truth-smoothing 0.15

  pdhef extract 'held_out/*.mcap' -o residuals_test --split test --resume

Drives are split 70/15/15 by a hash of their content and --seed, unless the manifest of a simulated set beside them has
a split, or --split puts all of them into one."""
)
def extract(
    logs: Annotated[list[str], typer.Argument(help="Logs with truth, folders that hold some, or glob patterns.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the dataset.")],
    vehicle: Annotated[
        Path | None,
        typer.Option(
            "--vehicle", "-v", help="vehicle.toml of the nominal model. Default: what a set's manifest names."
        ),
    ] = None,
    mapping: MappingFile = None,
    start: Annotated[str | None, typer.Option("--start", help="Start of each slice, as in pdhef run.")] = None,
    end: Annotated[str | None, typer.Option("--end", help="End of each slice, as in pdhef run.")] = None,
    sensors: Annotated[
        str | None, typer.Option("--sensors", help="full, or esp: no wheel speeds in the filters after the start.")
    ] = None,
    friction: FrictionChoice = None,
    prefer_truth: TruthChoice = None,
    truth_smoothing: Annotated[
        str,
        typer.Option("--truth-smoothing", help="auto (from the truth's noise), none, or half a window in seconds."),
    ] = "auto",
    split: Annotated[
        str | None, typer.Option("--split", help="train, validation or test for all drives of this command.")
    ] = None,
    seed: Annotated[int, typer.Option("--seed", help="Seed of the split by drive.")] = 0,
    vary: Annotated[
        float, typer.Option("--vary", help="Make friction and vehicle wrong by this spread for a part of the drives.")
    ] = 0.0,
    jobs: Annotated[int, typer.Option("--jobs", "-j", help="Processes at work; changes nothing that is written.")] = 1,
    resume: Annotated[
        bool, typer.Option("--resume", help="Keep drives whose log and settings are as they were.")
    ] = False,
    as_json: JsonFlag = False,
) -> None:
    """Write the residual dataset of drives with truth, which the network is trained on."""
    from pdhef_logtool.cli.summary import render_extraction
    from pdhef_logtool.learning.network.extract_command import ExtractSettings, run_extraction
    from pdhef_logtool.run.config import load_config

    config = load_config(
        None,
        {
            "vehicle": vehicle,
            "mapping": mapping,
            "start": start,
            "end": end,
            "sensors": sensors,
            "friction": friction,
            "prefer_truth": prefer_truth,
        },
    )
    settings = ExtractSettings(config, truth_smoothing=truth_smoothing, split=split, seed=seed, vary=vary)
    with _progress() as progress:
        result = run_extraction(logs, output, settings, jobs=jobs, resume=resume, progress=progress, warn=_warn)
    if as_json:
        _print_json(result.to_dict())
    else:
        render_extraction(result, _stdout())
    raise typer.Exit(result.exit_code)


@app.command(
    epilog="""Examples:

  pdhef train residuals/ -o model

  pdhef train mycar/ -o mycar_model --init model --epochs 10

  pdhef train residuals/ -o model --baselines

An interrupted training goes on from its last whole epoch when the same command is given again."""
)
def train(
    dataset: Annotated[Path, typer.Argument(help="Folder that pdhef extract wrote.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the model bundle to write.")],
    init: Annotated[
        Path | None, typer.Option("--init", help="Model bundle to fine-tune, or many-cars, or default.")
    ] = None,
    baselines: Annotated[
        bool, typer.Option("--baselines", help="Train pure-lstm and linear-regression into the model instead.")
    ] = False,
    paper: Annotated[bool, typer.Option("--paper", help="The paper's Table 1 instead of the default recipe.")] = False,
    seed: Annotated[int, typer.Option("--seed", help="Seed of weights, order and dropout.")] = 0,
    epochs: Annotated[int | None, typer.Option("--epochs", help="Default: the recipe's.")] = None,
    device: Annotated[str, typer.Option("--device", help="PyTorch device: cpu or cuda.")] = "cpu",
    as_json: JsonFlag = False,
) -> None:
    """Train the residual network on a dataset of pdhef extract; write weights, loss history and plot."""
    from pdhef_logtool.cli.summary import render_baselines, render_training
    from pdhef_logtool.learning.network.train_command import run_training

    if baselines:
        from pdhef_logtool.learning.network.baselines import run_baselines

        if init is not None:
            raise UsageError(expected="--baselines or --init", got="both", where="train")
        with _progress() as progress:
            both = run_baselines(
                dataset, output, paper=paper, seed=seed, epochs=epochs, device=device, progress=progress
            )
        if as_json:
            _print_json(both.to_dict())
        else:
            render_baselines(both, _stdout())
        return
    with _progress() as progress:
        result = run_training(
            dataset, output, init=init, paper=paper, seed=seed, epochs=epochs, device=device, progress=progress
        )
    if as_json:
        _print_json(result.to_dict())
    else:
        render_training(result, _stdout())


@app.command(
    epilog="""Examples:

  pdhef tune logs/ --split validation --vehicle car.toml -o car_tuned.toml --jobs 2

  pdhef tune logs/ --split validation --vehicle car.toml --model model --trials 256 -o car_tuned.toml

Every estimator gets the same search space, drives and number of trials. Beside the vehicle file stand NAME.tuning.json
with every trial, and NAME.tuning.png. Drives that a set's manifest marks test or extrapolation are refused
(docs/tune.md)."""
)
def tune(
    logs: Annotated[list[str], typer.Argument(help="Logs with truth, folders that hold some, or glob patterns.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="vehicle.toml to write; record and plot go beside it.")
    ],
    vehicle: Annotated[
        Path | None, typer.Option("--vehicle", "-v", help="vehicle.toml whose filter noise is tuned.")
    ] = None,
    model: Annotated[Path | None, typer.Option("--model", help="Folder of a model bundle; adds pd-hef.")] = None,
    estimators: Annotated[
        str | None,
        typer.Option(
            "--estimators",
            "-e",
            help="Out of phy-ukf-tuned, physics-plus, pd-hef, pd-hef-smoothed; default: all that can but the last.",
        ),
    ] = None,
    trials: Annotated[int, typer.Option("--trials", help="Of each estimator.")] = 128,
    seed: Annotated[int, typer.Option("--seed", help="Seed of the search.")] = 0,
    split: Annotated[
        str | None, typer.Option("--split", help="Only drives of this split, by the manifest of their set.")
    ] = None,
    any_split: Annotated[
        bool, typer.Option("--any-split", help="Take drives of the splits test and extrapolation too.")
    ] = False,
    mapping: Annotated[
        Path | None,
        typer.Option("--mapping", "-m", "--signal-map", help="mapping.toml: topic.field -> signal, for all drives."),
    ] = None,
    start: Annotated[str | None, typer.Option("--start", help="Start of the slice of each log (as for run).")] = None,
    end: Annotated[str | None, typer.Option("--end", help="End of the slice of each log (as for run).")] = None,
    sensors: Annotated[
        str | None, typer.Option("--sensors", help="full, or esp: no wheel speeds in the filters after the start.")
    ] = None,
    friction: FrictionChoice = None,
    prefer_truth: TruthChoice = None,
    jobs: Annotated[int, typer.Option("--jobs", "-j", help="Processes at work; changes no number.")] = 1,
    as_json: JsonFlag = False,
) -> None:
    """Tune the process and measurement noise of several estimators alike, for sideslip, on drives with truth."""
    from pdhef_logtool.cli.summary import render_tuning
    from pdhef_logtool.learning.noise.tune_command import TuneSettings, run_tuning
    from pdhef_logtool.run.config import load_config

    config = load_config(
        None,
        {
            "vehicle": vehicle,
            "model": model,
            "mapping": mapping,
            "start": start,
            "end": end,
            "sensors": sensors,
            "friction": friction,
            "prefer_truth": prefer_truth,
        },
    )
    names = None if estimators is None else tuple(n.strip() for n in estimators.split(",") if n.strip())
    settings = TuneSettings(config, names, trials=trials, seed=seed, split=split, any_split=any_split)
    with _progress() as progress:
        result = run_tuning(logs, output, settings, jobs=jobs, progress=progress, warn=_warn)
    if as_json:
        _print_json(result.to_dict())
    else:
        render_tuning(result, _stdout())
    raise typer.Exit(result.exit_code)


@app.command(
    epilog="""Examples:

  pdhef calibrate logs/ --split validation --vehicle car.toml --model model -o model

  pdhef calibrate logs/ --vehicle car.toml --vary 0 -o car.calibration.json

Give drives of many kinds that neither network nor filter noise was fitted to; drives that a set's manifest marks test
or extrapolation are refused. pdhef run takes calibration.json from its model's folder, or the file that --calibration
names (docs/calibrate.md)."""
)
def calibrate(
    logs: Annotated[list[str], typer.Argument(help="Logs with truth, folders that hold some, or glob patterns.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder of a model (calibration.json is written there), or a .json.")
    ],
    vehicle: Annotated[
        Path | None, typer.Option("--vehicle", "-v", help="vehicle.toml that the estimators run with.")
    ] = None,
    model: Annotated[
        Path | None,
        typer.Option("--model", help="Folder of a model bundle, many-cars, or none. Default: the shipped model."),
    ] = None,
    estimators: Annotated[
        str | None, typer.Option("--estimators", "-e", help="Comma-separated names; default: as for run.")
    ] = None,
    vary: Annotated[
        float,
        typer.Option("--vary", help="Run each drive twice more with friction and vehicle wrong by this spread."),
    ] = 0.1,
    seed: Annotated[int, typer.Option("--seed", help="Seed of --vary.")] = 0,
    split: Annotated[
        str | None, typer.Option("--split", help="Only drives of this split, by the manifest of their set.")
    ] = None,
    any_split: Annotated[
        bool, typer.Option("--any-split", help="Take drives of the splits test and extrapolation too.")
    ] = False,
    mapping: MappingFile = None,
    start: Annotated[str | None, typer.Option("--start", help="Start of the slice of each log (as for run).")] = None,
    end: Annotated[str | None, typer.Option("--end", help="End of the slice of each log (as for run).")] = None,
    sensors: Annotated[
        str | None, typer.Option("--sensors", help="full, or esp: no wheel speeds in the filters after the start.")
    ] = None,
    friction: FrictionChoice = None,
    prefer_truth: TruthChoice = None,
    as_json: JsonFlag = False,
) -> None:
    """Fit the 95 % intervals of every estimator on drives with truth, by regime, and store them beside a model."""
    from pdhef_logtool.cli.summary import render_calibration
    from pdhef_logtool.learning.evidence.calibrate_command import CalibrateSettings, run_calibration
    from pdhef_logtool.run.config import load_config

    config = load_config(
        None,
        {
            "estimators": None if estimators is None else tuple(n.strip() for n in estimators.split(",") if n.strip()),
            "vehicle": vehicle,
            "model": model,
            "mapping": mapping,
            "start": start,
            "end": end,
            "sensors": sensors,
            "friction": friction,
            "prefer_truth": prefer_truth,
        },
    )
    settings = CalibrateSettings(config, spread=vary, seed=seed, split=split, any_split=any_split)
    with _progress() as progress:
        result = run_calibration(logs, output, settings, progress=progress, warn=_warn)
    if as_json:
        _print_json(result.to_dict())
    else:
        render_calibration(result, _stdout())
    raise typer.Exit(result.exit_code)


@app.command(
    epilog="""Examples:

  pdhef trust drive.mcap --vehicle car.toml --start 155 -o car_trusted.toml

  pdhef trust logs/ --split test --vehicle car.toml --model model -o car_trusted.toml

Give driving that neither the network nor the vehicle file was fitted to. The filter runs at trust 0, 0.25, 0.5, 0.75
and 1. The cap is 1 only if a bootstrap of blocks confirms the gain, at most 0.5 on a mean gain, else 0 (docs/trust.md).
Beside the vehicle file stands NAME.trust.json with all figures."""
)
def trust(
    logs: Annotated[list[str], typer.Argument(help="Logs with truth, folders that hold some, or glob patterns.")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="vehicle.toml to write, with its cap; may be that of --vehicle.")
    ],
    vehicle: Annotated[Path | None, typer.Option("--vehicle", "-v", help="vehicle.toml of the drives' car.")] = None,
    model: Annotated[
        Path | None, typer.Option("--model", help="Folder of a model bundle. Default: the shipped model.")
    ] = None,
    mapping: MappingFile = None,
    start: Annotated[str | None, typer.Option("--start", help="Start of the slice of each log (as for run).")] = None,
    end: Annotated[str | None, typer.Option("--end", help="End of the slice of each log (as for run).")] = None,
    split: Annotated[
        str | None, typer.Option("--split", help="Only drives of this split, by the manifest of their set.")
    ] = None,
    any_split: Annotated[
        bool, typer.Option("--any-split", help="Take drives of the splits train and validation too.")
    ] = False,
    seed: Annotated[int, typer.Option("--seed", help="Seed of the bootstrap.")] = 0,
    sensors: Annotated[
        str | None, typer.Option("--sensors", help="full, or esp: no wheel speeds in the filters after the start.")
    ] = None,
    friction: FrictionChoice = None,
    prefer_truth: TruthChoice = None,
    as_json: JsonFlag = False,
) -> None:
    """Find out on drives with truth how far the network may be trusted on a vehicle, and write it into its file."""
    from pdhef_logtool.cli.summary import render_trust
    from pdhef_logtool.learning.evidence.trust_command import TrustSettings, run_trust
    from pdhef_logtool.run.config import load_config

    config = load_config(
        None,
        {
            "vehicle": vehicle,
            "model": model,
            "mapping": mapping,
            "start": start,
            "end": end,
            "sensors": sensors,
            "friction": friction,
            "prefer_truth": prefer_truth,
        },
    )
    settings = TrustSettings(config, seed=seed, split=split, any_split=any_split)
    with _progress() as progress:
        result = run_trust(logs, output, settings, progress=progress, warn=_warn)
    if as_json:
        _print_json(result.to_dict())
    else:
        render_trust(result, _stdout())
    raise typer.Exit(result.exit_code)


@app.command()
def estimators(as_json: JsonFlag = False) -> None:
    """List the estimators that run can use."""
    from pdhef_logtool.estimators.registry import DESCRIPTIONS

    if as_json:
        _print_json({"estimators": [{"name": n, "description": d} for n, d in DESCRIPTIONS.items()]})
        return
    from rich.table import Table

    table = Table("name", "what it is", box=None, header_style="bold")
    for name, description in DESCRIPTIONS.items():
        table.add_row(name, description)
    _stdout().print(table)


@app.command(
    epilog="""Examples:

  pdhef view out

  pdhef view out/logs/drive/recording.rrd"""
)
def view(
    output: Annotated[Path, typer.Argument(help="Output folder of a run, the folder of one log, or a .rrd file.")],
    log: Annotated[str | None, typer.Option("--log", help="Which log of the run; default: the first.")] = None,
) -> None:
    """Open the recording of a run in the Rerun viewer."""
    from pdhef_logtool.cli.viewer import find_recording, open_viewer

    recording = find_recording(output, log)
    _say(f"opening {recording}")
    raise typer.Exit(open_viewer(recording))


# ---- printing ----


def _stdout() -> Console:
    from rich.console import Console

    # A pipe has no width of its own: tables are then as wide as they need to be, unless COLUMNS says otherwise.
    if sys.stdout.isatty() or os.environ.get("COLUMNS"):
        return Console()
    return Console(width=160)


def _say(text: str) -> None:
    print(text, file=sys.stderr)  # noqa: T201


def _warn(text: str) -> None:
    print(f"warning: {text}", file=sys.stderr)  # noqa: T201


def _end(result: RunResult) -> NoReturn:
    """Leave with the result's exit code; what closed the gate, and what the code does not show, goes to stderr."""
    failed = [v for v in result.verdicts if v.failed]
    for verdict in failed:
        where = f"{verdict.log}: {verdict.estimator}: {verdict.threshold.label}"
        _say(f"pdhef: threshold failed: {where}: {verdict.reason}")
    if failed:
        for one in result.results:
            if one.outcome.outcome != "ok":
                _say(f"pdhef: {one.outcome.log} besides {one.outcome.outcome}")
    raise typer.Exit(result.exit_code)


def _print_json(document: Any) -> None:
    print(json.dumps(document, indent=2, sort_keys=False, ensure_ascii=False, allow_nan=False))  # noqa: T201


@contextmanager
def _progress() -> Iterator[Callable[[str, float], None]]:
    """Yield ``update(text, share)``: a bar on a terminal's stderr, silence elsewhere."""
    if not sys.stderr.isatty():
        yield lambda _text, _share: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda text, share: bar.update(task, description=text, completed=share)


def main() -> NoReturn:
    """Run the command line; every error that a user can repair is one line on stderr and an exit code."""
    try:
        app(standalone_mode=True)
    except PdhefError as error:
        _say(f"pdhef: {error}")
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        _say("pdhef: interrupted; nothing half-written was left under its final name")
        sys.exit(130)
    except BrokenPipeError:
        # The reader of our stdout has gone (for example ``| head``): no error of ours.
        sys.stderr.close()
        sys.exit(EXIT_FAILURE)
    except Exception as error:
        if os.environ.get("PDHEF_TRACEBACK"):
            raise
        _say(f"pdhef: internal error, {type(error).__name__}: {error}; PDHEF_TRACEBACK=1 shows where, please report it")
        sys.exit(EXIT_FAILURE)
    sys.exit(0)
