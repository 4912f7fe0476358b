"""Switches of the filters, on and off, each on drives where it matters.

    python -m studies.switches [--drives 12] [--work out/switches] [--out docs/switches.md]

Simulates the drives (kept once made; seeds from ``FIRST_SEED`` on, which nothing was fitted, tuned or trained on), runs
the shipped car with its network, and writes the page. Both sides of a switch see the same samples and are scored at
the stamps where both give an estimate; drives are the unit of the paired bootstrap.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import PhysicsParts
from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.physics_filter import PhysicsFilter
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.records.errors import SimulationError
from pdhef_logtool.records.release import released_steps
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from studies.condition_drives import ConditionDrive, read_drive, root_mean_square
from studies.pages import DOCS, ROOT, number, options, table, write
from studies.table_maths import Bound, median, median_ratio, pooled_ratio, pooled_rmse
from truthsim.conditions import write_conditions
from truthsim.drive import simulate_drive, write_drive
from truthsim.faults import parse_fault

FIRST_SEED = 11000
ESTIMATORS = ("phy-ukf:tuned", "physics", "pd-hef")
#: Ratios nearer to 1 than this are no difference that matters.
TRIFLE = 0.01
#: Names of the drives that the table of conditions makes, and how the others are made.
CONDITIONS = {
    "in-domain": "ordinary sensor errors, 60 to 110 km/h, friction 0.4 to 1, to 0.92 μ g",
    "bias": "the same drives, three times the usual bias on accelerations, yaw rate and steering",
    "delay-30": "the same drives, all sensors 30 ms later (40 ms in all)",
    "bank-and-grade": "bends banked inward, level and outward, uphill and down",
}
STARTS = "stop-and-go, friction 0.3, 40 to 62 km/h, 25 s: the driven wheels spin at the start"
STOPS = "stop-and-go, friction 0.8, 40 to 62 km/h, 60 s, three times the usual bias: several stops"
STEERING_LATE = "double lane change, 70 to 103 km/h, friction 0.85, steering alone 40 ms later"
LATE_S = 0.04

#: What runs an estimator on a drive with a switch on or off.
Run = Callable[[Estimator, ConditionDrive], StateTrack]


def with_option(estimator: Estimator, name: str, value: bool) -> Estimator:
    """Return an estimator with a field of its filter set, ``physics`` with a part where the name is that of one."""
    if isinstance(estimator, AdaptivePhysics):
        return replace(estimator, physics=_with_option(estimator.physics, name, value))
    changed: Any = estimator
    switched: Estimator = replace(changed, **{name: value})
    return switched


def _with_option(physics: PhysicsFilter, name: str, value: bool) -> PhysicsFilter:
    if name in PhysicsParts.model_fields:
        parts = physics.vehicle.physics.model_copy(update={name: value})
        return replace(physics, vehicle=physics.vehicle.model_copy(update={"physics": parts}))
    changed: dict[str, Any] = {name: value}
    return replace(physics, **changed)


def run_plain(estimator: Estimator, drive: ConditionDrive) -> StateTrack:
    """Run as it is."""
    return run_window(estimator, drive.signals)[0]


def run_option(name: str, value: bool, estimator: Estimator, drive: ConditionDrive) -> StateTrack:
    """Run with a field of the filter on or off."""
    return run_plain(with_option(estimator, name, value), drive)


def run_unpredicted(estimator: Estimator, drive: ConditionDrive) -> StateTrack:
    """Run without prediction over the latency: at each stamp stands the newest step whose samples had arrived."""
    signals: Signals = drive.signals
    track = run_window(estimator, replace(signals, ready_ns=signals.stamps_ns), None)[0]
    index = released_steps(signals.ready_ns, signals.stamps_ns)
    newest = np.maximum(index, 0)
    late = {
        n: getattr(track, n)[newest]
        for n in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad", "ay_m_s2", "covariance", "sideslip_std_rad")
    }
    return replace(track, **late, valid=track.valid[newest] & (index >= 0))


def run_late_steering(estimator: Estimator, drive: ConditionDrive) -> StateTrack:
    """Run with the steering taken for measured when it arrived: ``LATE_S`` after it was, beyond the others' delay."""
    signals: Signals = drive.signals
    t = (signals.stamps_ns - signals.stamps_ns[0]) * 1e-9
    late = np.interp(t - LATE_S, t, signals.steer_rad)
    # The samples that arrived in the meantime are used at once: nothing waits for the steering.
    ready = np.minimum(signals.ready_ns, signals.ready_ns - round(LATE_S * 1e9))
    given = replace(signals, steer_rad=late, ready_ns=np.maximum(ready, signals.stamps_ns))
    return run_window(estimator, given)[0]


@dataclass(frozen=True, slots=True)
class Switch:
    """One switch on one kind of drives; ``default`` by estimator: whether it ships on. Those left out have it not."""

    name: str
    drives: str
    on: Run
    off: Run
    default: dict[str, bool]


def option_switch(title: str, drives: str, name: str, default: dict[str, bool]) -> Switch:
    """Return the switch of a field of the filters."""
    return Switch(title, drives, partial(run_option, name, True), partial(run_option, name, False), default)


_ALL = dict.fromkeys(ESTIMATORS, True)
_ROLLING = {"phy-ukf:tuned": True}
_PART = {"physics": True}
SWITCHES = (
    option_switch("part biases", "bias", "biases", _PART),
    *(option_switch(f"part {p.replace('_', ' ')}", "in-domain", p, _PART) for p in PhysicsParts.model_fields),
    option_switch("part bank", "bank-and-grade", "bank", _PART),
    option_switch("body-roll correction of a_y", "in-domain", "roll_correction", _ROLLING),
    option_switch("body-roll correction of a_y", "bank-and-grade", "roll_correction", _ROLLING),
    option_switch("standstill", "stops", "standstill", _ALL),
    option_switch("slip gate", "starts", "slip_gate", _ALL),
    option_switch("slip gate", "in-domain", "slip_gate", _ALL),
    Switch("prediction over the latency", "in-domain", run_plain, run_unpredicted, _ALL),
    Switch("prediction over the latency", "delay-30", run_plain, run_unpredicted, _ALL),
    Switch("the steering's own measurement time", "steering-late", run_plain, run_late_steering, _ALL),
)


@dataclass(frozen=True, slots=True)
class Line:
    """A row of the page: RMSE in degrees by drive [N] with it on and off, and the stamps [N] of each."""

    switch: Switch
    estimator: str
    on: FloatArray
    off: FloatArray
    samples: FloatArray

    @property
    def median(self) -> Bound:
        """Ratio of the medians, on over off."""
        return median_ratio(self.on, self.off)

    @property
    def pooled(self) -> Bound:
        """Ratio of the pooled figures, on over off."""
        return pooled_ratio(self.on, self.off, self.samples, self.samples)

    @property
    def says(self) -> str:
        """What the bounds decide: both figures' where they agree, the pooled one's word with its name where not."""
        if np.array_equal(self.on, self.off):
            return "changes nothing"
        words = (word(self.median), word(self.pooled))
        if words[0] == words[1]:
            return words[0]
        told = [f"{w} ({n})" for w, n in zip(words, ("median", "pooled"), strict=True) if w != "open"]
        return ", ".join(told)


def word(bound: Bound) -> str:
    """Return whether on is better than off, worse, or neither for sure; no matter where it is less than ``TRIFLE``."""
    if abs(bound.low - 1.0) < TRIFLE and abs(bound.high - 1.0) < TRIFLE:
        return "no matter"
    return "helps" if bound.high < 1.0 else "**harms**" if bound.low > 1.0 else "open"


def simulate(folder: Path, count: int) -> dict[str, list[Path]]:
    """Make the drives of every kind that are not there yet; one that spins is left out."""
    found: dict[str, list[Path]] = {}
    table_folder = folder / f"conditions-{count}"
    manifest = write_conditions(table_folder, drives=count, seed=FIRST_SEED, rows=list(CONDITIONS))
    for row in manifest["rows"]:
        found[row["name"]] = [table_folder / f for f in row["files"]]
    biased = [parse_fault(f"bias{v:g}:{c}:0:end") for c, v in (("ax", 0.24), ("ay", 0.24), ("yaw_rate", 0.0045))]
    late = [parse_fault(f"delay{1000 * LATE_S:g}:steering:0:end")]
    stop = {"manoeuvre": "stop-and-go"}
    #: First speed and its step in km/h, and the rest.
    own: dict[str, tuple[float, float, dict[str, Any]]] = {
        "starts": (40.0, 2.0, {**stop, "friction": 0.3, "duration_s": 25}),
        "stops": (40.0, 2.0, {**stop, "friction": 0.8, "duration_s": 60, "faults": biased}),
        "steering-late": (70.0, 3.0, {"manoeuvre": "dlc", "friction": 0.85, "faults": late}),
    }
    for number_of_kind, (kind, (first_km_h, step_km_h, more)) in enumerate(own.items(), start=1):
        found[kind] = []
        for i in range(count):
            seed = FIRST_SEED + 100 * number_of_kind + i
            path = folder / f"{kind}-{seed}.mcap"
            if not path.is_file():
                try:
                    write_drive(simulate_drive(seed=seed, speed_km_h=first_km_h + step_km_h * i, **more), path)
                except SimulationError as error:
                    print(f"left out: {error}", file=sys.stderr)
                    continue
            found[kind].append(path)
    return found


def measure(drives: dict[str, list[Path]], car: Car) -> Iterator[Line]:
    """Run both sides of every switch on its drives, kind by kind."""
    estimators = [make_estimator(name, car) for name in ESTIMATORS]
    for kind, paths in drives.items():
        read = [read_drive(p, car) for p in paths]
        for switch in (s for s in SWITCHES if s.drives == kind):
            for e in estimators:
                if e.name in switch.default:
                    sides = np.array([compare(switch, e, d) for d in read]).reshape(-1, 3)
                    yield Line(switch, e.name, sides[:, 0], sides[:, 1], sides[:, 2])


def compare(switch: Switch, estimator: Estimator, drive: ConditionDrive) -> list[float]:
    """Return the sideslip RMSE in degrees on and off, and the number of stamps that both are scored at."""
    on, off = (np.degrees(drive.error(run(estimator, drive))) for run in (switch.on, switch.off))
    both = np.isfinite(on) & np.isfinite(off)
    if not both.any():
        return [float("nan"), float("nan"), 0.0]
    return [*(root_mean_square(e[both]) for e in (on, off)), float(both.sum())]


NOTES = """How each is switched:
- *Bias states*: the filter estimates the biases of a_y, yaw rate and steering angle, or does not; the noise is that of
  the shipped file either way.
- *Parts* of `physics`: with values and noise that were found with all of its parts, also where one is switched off;
  what one is worth when the others are fitted without it, stands in `tried` of the car's `fit.toml`.
- *Body-roll correction*: the filter's a_y holds g times the roll gradient, or is taken for planar.
- *Standstill*: motion is held at zero while the car stands, and the bias of a_x is learnt there, or it just filters on.
- *Slip gate*: speed samples of wheels that spin or lock are left out, or used
  ([method.md](method.md#wheel-slip)).
- *Prediction over the latency*: the newest step that had arrived is predicted to the stamp, or stands there as it is.
- *The steering's own measurement time*: each channel is put where it was measured, however late it came, and the step
  waits for it; or the steering counts as measured when it arrived, and nothing waits. A filter on physics alone may be
  are better with a steering angle that is old even where the right one is there in time: presumably it stands for the
  lag of body and tyres that their model lacks. What does harm there is the model, not the timing.
- *Grade* has no switch: the bias of a_x, which takes it up, is a state of every filter. *Bank* is a part of `physics`;
  the other filters have no state of it, a bias of a_y takes it up where there is one.

`pd-hef` is switched in its two filters; the parallel filter that feeds its network stays as it was trained with, save
the slip gate and the two of latency, which hold for all of it. The noise was tuned with the switches as they ship (the
slip gate came later), which is to the advantage of that side."""


def page(lines: Sequence[Line], command: str, model_sha256: str, vehicle_name: str) -> str:
    """Return the page."""
    ordered = sorted(lines, key=lambda x: (SWITCHES.index(x.switch), ESTIMATORS.index(x.estimator)))
    kinds = CONDITIONS | {"starts": STARTS, "stops": STOPS, "steering-late": STEERING_LATE}
    body = [
        [
            x.switch.name,
            x.switch.drives,
            f"`{x.estimator}`",
            "on" if x.switch.default[x.estimator] else "off",
            f"{number(median(x.on))} / {number(median(x.off))}",
            _ratio(x.median),
            f"{number(pooled_rmse(x.on, x.samples))} / {number(pooled_rmse(x.off, x.samples))}",
            _ratio(x.pooled),
            x.says,
        ]
        for x in ordered
    ]
    head = "switch | drives | estimator | ships | median on / off, ° | ratio | pooled on / off, ° | ratio | on"
    harms = [x for x in ordered if "harms" in x.says]
    wrong = [x for x in ordered if x.says == ("helps" if not x.switch.default[x.estimator] else "**harms**")]
    most = max(len(x.on) for x in ordered)
    kinds_text = "\n".join(f"- `{name}`: {text}" for name, text in kinds.items())
    harm = "\n".join(map(_sentence, harms)) or "Nothing, as far as the bounds tell."
    better = "\n".join(map(_sentence, wrong)) or "Nowhere, as far as the bounds of both figures tell."
    return f"""# Switches, on and off

Made by `{command}`. Sideslip RMSE on simulated drives, at most {most} a row, seeds from {FIRST_SEED},
with the shipped network ({model_sha256[:12]}) and its vehicle file ({vehicle_name}). Ratio: on over
off, with its 95 % interval by paired bootstrap over drives: *open* where it holds 1, *no matter*
where it is within {100 * TRIFLE:g} % of it. *ships*: how the switch stands without being touched.

{table(head.split(" | "), body)}

Drives:
{kinds_text}

## What does harm
{harm}

## Where the other setting than the shipped one is better on these drives
{better}

## How
{NOTES}
"""


def _ratio(bound: Bound) -> str:
    return f"{number(bound.value, 2)} ({number(bound.low, 2)} to {number(bound.high, 2)})"


def _sentence(x: Line) -> str:
    ships = "on" if x.switch.default[x.estimator] else "off"
    return (
        f"- {x.switch.name}, `{x.estimator}` on `{x.switch.drives}` (ships {ships}): median {_ratio(x.median)}, "
        f"pooled {_ratio(x.pooled)}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Make the page."""
    parser = options("switches", __doc__)
    parser.add_argument("--drives", type=int, default=12, help="drives a row")
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "switches")
    parser.add_argument("--out", type=Path, default=DOCS / "switches.md")
    given = parser.parse_args(arguments)
    began = time.monotonic()
    car = Car.load("saloon")
    lines = []
    for line in measure(simulate(given.work, given.drives), car):
        print(f"{line.switch.name}, {line.switch.drives}, {line.estimator}: {line.says}", file=sys.stderr)
        lines.append(line)
    command = f"python -m studies.switches --drives {given.drives}"
    assert car.network is not None
    write(given.out, page(lines, command, car.network.sha256, car.vehicle.name))
    print(f"{time.monotonic() - began:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    main()
