"""``pdhef simulate`` (drives of truthsim), ``convert`` (any log to MCAP) and ``compile`` (code of runs in advance)."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from pdhef_logtool.cli import console, options
from pdhef_logtool.records.errors import EXIT_OK, EXIT_PARTIAL, UsageError

if TYPE_CHECKING:
    from pdhef_logtool.runs.config import RunConfig


@options.command()
def simulate(
    manoeuvre: str | None = None,
    *,
    output: Path | None = None,
    speed_km_h: float | None = None,
    friction: float | None = None,
    seed: int = 0,
    duration_s: float | None = None,
    amplitude: float = 1.0,
    vehicle: str | None = None,
    faults: list[str] | None = None,
    sensors: list[str] | None = None,
    without: list[str] | None = None,
    rtk_rate_hz: int | None = None,
    keep_spins: bool = False,
    list_all: bool = False,
) -> None:
    """Simulate a drive and write it as MCAP, with noisy sensors, RTK and exact ground truth."""
    if list_all:
        _list_manoeuvres()
        return
    if manoeuvre is None or output is None:
        got, remedy = "manoeuvre" if manoeuvre is None else "-o FILE", "pdhef simulate --list shows the manoeuvres"
        where = "pdhef simulate"
        raise UsageError(expected="a manoeuvre and -o FILE", got=f"no {got}", where=where, remedy=remedy)
    from truthsim.batch import sensor_noise
    from truthsim.drive import DEFAULT_VEHICLE, simulate_drive, write_drive
    from truthsim.faults import parse_fault
    from truthsim.vehicle_choice import choose_vehicle

    name = vehicle or DEFAULT_VEHICLE
    drive = simulate_drive(
        manoeuvre,
        speed_km_h=speed_km_h,
        friction=friction,
        seed=seed,
        duration_s=duration_s,
        amplitude=amplitude,
        vehicle=choose_vehicle(name),
        vehicle_name=name,
        noise=sensor_noise(_numbers(sensors or ())),
        faults=[parse_fault(text) for text in faults or ()],
        rtk_rate_hz=rtk_rate_hz,
        keep_spins=keep_spins,
    )
    write_drive(drive, output, without=without or ())
    console.show({"output": str(output), **drive.facts()}, "facts")


@options.command("simulate suite")
def suite(
    *, output: Path, count: int = 200, seed: int = 0, duration_s: float = 12.5, vehicles: str = "default", jobs: int = 1
) -> None:
    """Simulate a training set of drives."""
    from truthsim.suite import write_suite

    with console.reporter() as report:
        manifest = write_suite(
            output,
            count=count,
            seed=seed,
            vehicles=vehicles,
            duration_s=duration_s,
            processes=jobs,
            progress=report.progress,
        )
    facts = {key: manifest[key] for key in ("command", "splits", "written", "dropped_draws")}
    console.show({"output": str(output), **facts}, "facts")
    for entry in manifest["drives"]:
        if "sha256" not in entry:
            console.warn(f"{entry['file']}: no drive: {entry['dropped'][-1]['reason']}")


def _numbers(pairs: Sequence[str]) -> dict[str, float]:
    values = {}
    for pair in pairs:
        name, _, text = pair.partition("=")
        try:
            values[name] = float(text)
        except ValueError:
            raise UsageError(expected="NAME=NUMBER", got=repr(pair), where="--sensor") from None
    return values


def _list_manoeuvres() -> None:
    from truthsim.manoeuvres import MANOEUVRES

    fields = ("description", "speed_km_h", "friction", "duration_s")
    rows = [{"name": name, **{f: getattr(m, f) for f in fields}} for name, m in MANOEUVRES.items()]
    console.show({"manoeuvres": rows}, "manoeuvres")


@options.command()
def convert(log: str, *, config: "RunConfig", output: Path = Path("drive.mcap")) -> None:
    """Convert a log of any format to MCAP."""
    from pdhef_logtool.logs.conversion import convert_log
    from pdhef_logtool.logs.discovery import one_place

    reading = config.read_options
    place = one_place(log, private_redirects=config.allow_private_redirects)
    lost, messages = convert_log(place, output, reading.limits, reading.msgs, reading.tables)
    for loss in lost:
        console.warn(f"{loss.where}: {loss.what}" + ("" if loss.count is None else f" ({loss.count} times)"))
    console.say(f"{messages} messages written to {output}")
    raise typer.Exit(EXIT_PARTIAL if any(loss.severity == "lost" for loss in lost) else EXIT_OK)


#: The receiver of the simulated car as a sensor.
_GNSS_MAPPING = """fill_recognised = true

[signals]
gnss_latitude_deg = { topic = "/rtk/fix", field = "latitude" }
gnss_longitude_deg = { topic = "/rtk/fix", field = "longitude" }
"""


@options.command()
def compile_() -> None:
    """Compile the filters in advance, so that the first run starts at once."""
    import time
    from tempfile import TemporaryDirectory

    from pdhef_logtool.compiled.sources import compiled_digest
    from pdhef_logtool.estimators.table import ALL_ESTIMATORS
    from pdhef_logtool.runs.config import RunConfig
    from pdhef_logtool.runs.fleet import run_logs
    from truthsim.drive import simulate_drive, write_drive

    began_s = time.perf_counter()
    saloon = RunConfig(car=Path("saloon"), estimators=(ALL_ESTIMATORS,), keep="metrics", reference="on")
    with TemporaryDirectory() as folder:
        log, mapping = Path(folder) / "drive.mcap", Path(folder) / "mapping.toml"
        write_drive(simulate_drive("banked-road"), log)
        mapping.write_text(_GNSS_MAPPING, encoding="utf-8")
        sedan = RunConfig(keep="metrics", reference="on", mapping=mapping)
        for config in (saloon, sedan):
            run_logs([str(log)], Path(folder) / "out", config, report=False)
    seconds = time.perf_counter() - began_s
    console.say(f"all code of runs is compiled ({seconds:.0f} s, {compiled_digest()})")
