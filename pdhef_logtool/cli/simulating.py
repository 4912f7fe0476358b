"""``pdhef simulate MANOEUVRE``, ``pdhef simulate suite`` and ``pdhef simulate conditions``: drives of truthsim."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from typer import Argument, Option
from typer.core import TyperGroup

from pdhef_logtool.cli import console, options
from pdhef_logtool.records.errors import UsageError

commands = typer.Typer()


class CommandGroup(TyperGroup):
    """A group whose commands may have names of two words: ``simulate suite`` beside ``simulate dlc``."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Take the first word behind the command that is no option as the second word of its name, where it is one."""
        family = [c for name, c in self.commands.items() if name.split()[0] == args[0]]
        valued = {o for c in family for p in c.params if not getattr(p, "is_flag", False) for o in p.opts}
        words = (i for i in range(1, len(args)) if not args[i].startswith("-") and args[i - 1] not in valued)
        at = next(words, 0)
        if at and f"{args[0]} {args[at]}" in self.commands:
            args = [f"{args[0]} {args[at]}", *args[1:at], *args[at + 1 :]]
        return super().resolve_command(ctx, args)


_Many = list[str] | None
SetOutput = Annotated[Path, Option("--output", "-o", help="Folder; drives that are there already are kept.")]


@options.command(
    commands,
    "pdhef simulate --list",
    "pdhef simulate dlc --speed 100 --mu 0.85 --seed 1 -o dlc.mcap",
    "pdhef simulate road --seed 3 --sensor rtk_outages_per_h=30 -o road.mcap",
    "pdhef simulate dlc --vehicle suv --fault burst20:yaw_rate:3:5 \\",
    "  --fault dropout:wheels:6:end -o faulty.mcap",
    notes="""Sets of drives are commands of their own: pdhef simulate suite writes one to train on, pdhef simulate
conditions those of the condition table; --help behind either shows its options.

Faults: KIND:WHAT:START:END in seconds (END may be end). Kinds: burst<FACTOR>, stuck, dead, flip, bias<SI>, dropout,
delay<MS>, jump<S> (of the stamps), float, lost (the RTK's fix). What: imu, steering, wheels, rtk, all (sensors), or one
field: ax, ay, az, roll_rate, pitch_rate, yaw_rate, steer, wheel_fl, wheel_fr, wheel_rl, wheel_rr. delay and jump take
whole messages.

Vehicles: sedan, suv, hatchback or a TOML file; NAME~SEED is another car of its kind; changes follow commas: mass=1.2,
cg=0.1 (m to the rear), height=1.1, stiffness=0.85, tyres=suv.""",
)
def simulate(
    *,
    manoeuvre: Annotated[str | None, Argument(metavar="MANOEUVRE", help="--list shows the names.")] = None,
    output: Annotated[Path | None, Option("--output", "-o", help="MCAP file to write.")] = None,
    speed_km_h: Annotated[float | None, Option("--speed", help="km/h; default: the manoeuvre's.")] = None,
    friction: Annotated[float | None, Option("--mu", help="Friction; default: the manoeuvre's.")] = None,
    seed: Annotated[int, Option(help="Seed of noise and of random profiles.")] = 0,
    duration_s: Annotated[float | None, Option("--duration", help="s; default: the manoeuvre's.")] = None,
    amplitude: Annotated[float, Option(help="Factor on the manoeuvre's own amplitude.")] = 1.0,
    vehicle: Annotated[str | None, Option("--vehicle", "-v", help="See Vehicles; default sedan.")] = None,
    faults: Annotated[_Many, Option("--fault", metavar="FAULT", help="See Faults; repeatable.")] = None,
    sensors: Annotated[
        _Many, Option("--sensor", metavar="NAME=VALUE", help="A sensor's error (docs/simulate.md); repeatable.")
    ] = None,
    without: Annotated[
        _Many, Option(metavar="WHAT", help="Leave out imu, steering, wheels, rtk, perfect or events.")
    ] = None,
    steering_wheel: Annotated[bool, Option("--steering-wheel", help="Record the steering wheel's angle too.")] = False,
    rtk_rate_hz: Annotated[
        int | None, Option("--rtk-rate", help="Hz of the truth: 10, 20, 50 or 100; default: the manoeuvre's.")
    ] = None,
    keep_spins: Annotated[bool, Option("--keep-spins", help="Keep |sideslip| > 20 degrees and lifted wheels.")] = False,
    list_all: Annotated[bool, Option("--list", help="List the manoeuvres and their defaults.")] = False,
    as_json: options.JsonFlag = False,
) -> None:
    """Write a drive of the simulator as ROS 2 MCAP. It has noisy sensors, RTK truth and perfect truth."""
    if list_all:
        _list_manoeuvres(as_json)
        return
    if manoeuvre is None or output is None:
        raise UsageError(
            expected="a manoeuvre and -o FILE",
            got="no " + ("manoeuvre" if manoeuvre is None else "-o FILE"),
            where="pdhef simulate",
            remedy="pdhef simulate --list shows the manoeuvres",
        )
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
    write_drive(drive, output, without=without or (), steering_wheel=steering_wheel)
    (console.print_json if as_json else console.print_facts)({"output": str(output), **drive.facts()})


@options.command(
    commands,
    "pdhef simulate suite --count 200 --seed 1 --jobs 2 -o logs/",
    "pdhef simulate suite --count 2000 --vehicles randomised -o many_cars/",
    notes="manifest.json tells of each drive its split and the command that makes it again.",
    name="simulate suite",
)
def suite(
    output: SetOutput,
    count: Annotated[int, Option(help="Number of drives.")] = 200,
    seed: Annotated[int, Option(help="Seed of all draws.")] = 0,
    duration_s: Annotated[float, Option("--duration", help="s a drive.")] = 12.5,
    vehicles: Annotated[str, Option(help="default, or randomised: another each drive.")] = "default",
    jobs: options.Jobs = 1,
    as_json: options.JsonFlag = False,
) -> None:
    """Write a set of simulated drives to train on. Each one is drawn by its own number, so --count changes none."""
    from truthsim.suite import write_suite

    with console.progress() as bar:
        manifest = write_suite(
            output, count=count, seed=seed, vehicles=vehicles, duration_s=duration_s, processes=jobs, progress=bar
        )
    told = ("splits", "written", "dropped_draws")
    _tell_of_set(manifest, output, told, console.print_json if as_json else console.print_facts)


@options.command(
    commands,
    "pdhef simulate conditions --drives 30 --jobs 2 -o table/",
    "pdhef simulate conditions --rows in-domain,gyro-dead -o table/",
    notes="manifest.json tells of each row its drives and what the estimator is told.",
    name="simulate conditions",
)
def conditions(
    output: SetOutput,
    drives: Annotated[int, Option(help="Drives a row.")] = 30,
    rows: Annotated[str | None, Option(help="Comma-separated rows; default: all.")] = None,
    seed: Annotated[int, Option(help="Seed of all draws.")] = 0,
    jobs: options.Jobs = 1,
    as_json: options.JsonFlag = False,
) -> None:
    """Write the simulated drives of the condition table. Each row has one thing wrong."""
    from truthsim.conditions import write_conditions

    names = None if rows is None else options.split_names(rows)
    with console.progress() as bar:
        manifest = write_conditions(output, drives=drives, seed=seed, rows=names, processes=jobs, progress=bar)
    _tell_of_set(manifest, output, ("rows",), console.print_json if as_json else _print_rows)


def _numbers(pairs: Sequence[str]) -> dict[str, float]:
    values = {}
    for pair in pairs:
        name, _, text = pair.partition("=")
        try:
            values[name] = float(text)
        except ValueError:
            raise UsageError(expected="NAME=NUMBER", got=repr(pair), where="--sensor") from None
    return values


def _tell_of_set(manifest: dict[str, Any], folder: Path, keys: Sequence[str], tell: Callable[[Any], None]) -> None:
    tell({"output": str(folder), **{key: manifest[key] for key in ("command", *keys)}})
    for entry in manifest["drives"]:
        if "sha256" not in entry:
            console.warn(f"{entry['file']}: no drive: {entry['dropped'][-1]['reason']}")


def _print_rows(facts: dict[str, Any]) -> None:
    bins = list(facts["rows"][0]["drives_in_bin"])
    table = console.table("row", "drives", *bins, "what is wrong")
    for row in facts["rows"]:
        counts = [str(row["drives_in_bin"][b]) for b in bins]
        table.add_row(row["name"], str(len(row["files"])), *counts, row["description"])
    console.stdout().print(table)


def _list_manoeuvres(as_json: bool) -> None:
    from truthsim.manoeuvres import MANOEUVRES

    fields = ("description", "speed_km_h", "friction", "duration_s")
    if as_json:
        rows = [{"name": name, **{f: getattr(m, f) for f in fields}} for name, m in MANOEUVRES.items()]
        console.print_json({"manoeuvres": rows})
        return
    table = console.table("name", "km/h", "mu", "s", "what it is")
    for name, m in MANOEUVRES.items():
        table.add_row(name, f"{m.speed_km_h:g}", f"{m.friction:g}", f"{m.duration_s:g}", m.description)
    console.stdout().print(table)
