"""Build the figures and tables of ``docs/truthsim.md``: the simulator compared with theory.

    python -m studies.truthsim_docs [docs]

Figures go to ``docs/truthsim/``, tables into the page between the comments ``<!-- begin NAME -->`` and
``<!-- end NAME -->``. The table of the independent simulator's runs is made only where those runs lie beside the
repository (``../shared/data/independent_sim``), in ``studies/results/truthsim``. Their traces stay where
they are: the page shows peaks, ratios and lags alone.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.records.signals import WHEELS, FloatArray
from studies.defaults.fit_nominal_tyres import axle_loads_n
from studies.pages import DOCS, INDEPENDENT, RESULTS, fill, options, table, write
from studies.pictures import STYLE, save, subplots
from truthsim.drive import simulate_drive
from truthsim.linear_theory import (
    axle_stiffness_n_per_rad,
    frequency_response,
    steady_roll,
    understeer_gradient_rad_per_m_s2,
)
from truthsim.manoeuvres import Plan
from truthsim.motion import Motion, simulate_motion
from truthsim.tyres import Tyre, forces_n, slip_rates
from truthsim.vehicle import GRAVITY_M_S2 as G
from truthsim.vehicle import Vehicle
from truthsim.vehicle_files import VEHICLES, load_vehicle

DRY = 0.85
COLOURS = {"sedan": "#1f5fa8", "suv": "#b5482a", "hatchback": "#3b8550"}
_SAVED_DPI = 80
_STYLE = {**STYLE, "lines.linewidth": 1.4}


def open_loop(speed_m_s: float, steer_rad: FloatArray) -> Plan:
    """Return the plan of a steering table."""
    return Plan(speed_m_s, (steer_rad.shape[0] - 1) * 1e-3, steer_rad=steer_rad)


def free_rolling(car: Vehicle) -> Vehicle:
    """Return a car without drag and rolling resistance: linear theory has no traction."""
    return car._replace(drag_area_m2=0.0, rolling_resistance=0.0)


def ramp(car: Vehicle, top_rad: float, seconds: float = 60.0) -> Motion:
    """Return the motion of a slow ramp of the steering at 80 km/h."""
    steer = np.linspace(0.0, top_rad, round(seconds * 1000) + 1)
    return simulate_motion(open_loop(80.0 / 3.6, steer), DRY, vehicle=free_rolling(car))


def slope(motion: Motion, column: FloatArray) -> float:
    """Return the slope of a quantity over a_y in the linear range."""
    a_y = motion.column("ay_m_s2")
    rows = (a_y > 0.1) & (a_y < 0.9)
    return float(np.polyfit(a_y[rows], column[rows], 1)[0])


def steady_state(folder: Path) -> dict[str, str]:
    """Understeer curves, load transfer, and the table of gradients."""
    fig, ((ax,),) = subplots(1, 1, 6.4, 3.8, _STYLE)
    rows = []
    for name in VEHICLES:
        car = load_vehicle(name)
        wheelbase = car.cg_to_front_axle_m + car.cg_to_rear_axle_m
        motion = ramp(car, 0.12)
        beyond = motion.column("steer_rad") - wheelbase * motion.column("yaw_rate_rad_s") / motion.column("vx_m_s")
        understeer, theory = slope(motion, beyond), understeer_gradient_rad_per_m_s2(car, DRY)
        roll, roll_theory = slope(motion, motion.column("roll_rad")), steady_roll(car)[0]
        front = slope(motion, 0.5 * (motion.column("fz_fr_n") - motion.column("fz_fl_n")))
        rear = slope(motion, 0.5 * (motion.column("fz_rr_n") - motion.column("fz_rl_n")))
        front_theory, rear_theory = steady_roll(car)[1]
        a_y = motion.column("ay_m_s2") / G
        angles = ((np.degrees(understeer), np.degrees(theory)), (np.degrees(roll), np.degrees(roll_theory)))
        loads = ((front, front_theory), (rear, rear_theory))
        cells = [f"{sedan * G:.2f} / {said * G:.2f}" for sedan, said in angles]
        rows.append([name, *cells, *(f"{sedan * G:.0f} / {said * G:.0f}" for sedan, said in loads), f"{a_y.max():.2f}"])
        ax.plot(a_y, np.degrees(beyond), color=COLOURS[name], label=f"{name}, simulated")
        line = np.array([0.0, 0.5])
        ax.plot(line, np.degrees(theory) * G * line, "--", color=COLOURS[name], linewidth=1.0)
    ax.set(
        xlabel="lateral acceleration, g",
        ylabel="road-wheel angle beyond L/R, deg",
        ylim=(0.0, 5.5),
        title="Understeer: slow ramp at 80 km/h, mu 0.85 (dashed: linear theory)",
    )
    ax.legend()
    save(fig, folder / "understeer.png", _SAVED_DPI)

    car = load_vehicle("sedan")
    motion = ramp(car, 0.05)
    a_y = motion.column("ay_m_s2")
    fig, ((ax,),) = subplots(1, 1, 6.4, 3.8, _STYLE)
    shades = dict(zip(WHEELS, ("#7fb0e0", "#1f5fa8", "#e8a487", "#b5482a"), strict=True))
    names = dict(zip(WHEELS, ("front left", "front right", "rear left", "rear right"), strict=True))
    loads_n = axle_loads_n(car)
    for wheel in WHEELS:
        ax.plot(a_y / G, motion.column(f"fz_{wheel}_n") / 1e3, color=shades[wheel], label=names[wheel])
        front = wheel[0] == "f"
        static = 0.5 * loads_n["front" if front else "rear"]
        moved = steady_roll(car)[1][0 if front else 1] * (1.0 if wheel[1] == "r" else -1.0)
        ax.plot(a_y / G, (static + moved * a_y) / 1e3, "--", color="black", linewidth=0.8)
    ax.set(xlabel="lateral acceleration to the left, g", ylabel="wheel load, kN")
    ax.set_title("Load transfer of the sedan (dashed: statics)")
    ax.legend()
    save(fig, folder / "load_transfer.png", _SAVED_DPI)
    head = "vehicle | understeer, deg/g | roll, deg/g | load moved in front, N/g | at the rear, N/g"
    return {"gradients": table([*head.split(" | "), "largest a_y at mu 0.85, g"], rows)}


def measured_response(car: Vehicle, frequency: float, speed: float) -> tuple[list[complex], float]:
    """Return yaw rate, a_y and roll per steering angle, and the speed held."""
    t = np.arange(0.0, 4.0 + 3.0 / frequency, 1e-3)
    steer = 0.002 * np.sin(2 * np.pi * frequency * t)
    motion = simulate_motion(open_loop(speed, steer), DRY, vehicle=free_rolling(car), period_s=0.001)
    rows = t > t[-1] - 3.0 / frequency
    turn = 2 * np.pi * frequency * t[rows]
    basis = np.stack([np.sin(turn), np.cos(turn)], axis=1)
    evaluated = [
        complex(*np.linalg.lstsq(basis, motion.column(name)[rows], rcond=None)[0]) / 0.002
        for name in ("yaw_rate_rad_s", "ay_m_s2", "roll_rad")
    ]
    return evaluated, float(motion.column("vx_m_s")[rows].mean())


def responses(folder: Path) -> dict[str, str]:
    """Frequency responses at two speeds, beside linear theory."""
    car = load_vehicle("sedan")
    points = np.array([0.3, 0.5, 0.7, 1.0, 1.4, 1.8, 2.2, 2.6, 3.0])
    fine = np.geomspace(0.3, 3.0, 80)
    fig, axes = subplots(2, 2, 8.4, 5.4, _STYLE)
    worst = {name: [0.0, 0.0] for name in ("yaw rate", "lateral acceleration", "roll")}
    for speed, colour in ((60.0 / 3.6, "#3b8550"), (100.0 / 3.6, "#1f5fa8")):
        evaluated = [measured_response(car, float(f), speed) for f in points]
        theory_here = [
            frequency_response(free_rolling(car), float(f), v, DRY) for f, (_, v) in zip(points, evaluated, strict=True)
        ]
        for k, name in enumerate(worst):
            ratios = np.array([m[k] for m, _ in evaluated]) / np.array([h[k] for h in theory_here])
            worst[name][0] = max(worst[name][0], float(np.abs(np.abs(ratios) - 1.0).max()))
            worst[name][1] = max(worst[name][1], float(np.abs(np.degrees(np.angle(ratios))).max()))
        theory = np.array([frequency_response(free_rolling(car), float(f), speed, DRY) for f in fine])
        for k, scale in ((0, 1.0), (1, np.radians(1.0) / G)):
            measured = np.array([m[k] for m, _ in evaluated])
            label = f"{speed * 3.6:.0f} km/h"
            axes[0, k].plot(fine, scale * np.abs(theory[:, k]), color=colour, label=f"{label}, linear theory")
            axes[0, k].plot(points, scale * np.abs(measured), "o", color=colour, markersize=4, label="simulated")
            axes[1, k].plot(fine, np.degrees(np.unwrap(np.angle(theory[:, k]))), color=colour)
            axes[1, k].plot(points, np.degrees(np.unwrap(np.angle(measured))), "o", color=colour, markersize=4)
    for k, title in ((0, "yaw rate over road-wheel angle, 1/s"), (1, "a_y over road-wheel angle, g/deg")):
        axes[0, k].set(title=title, ylim=(0.0, None))
        axes[1, k].set(xlabel="frequency, Hz", ylabel="phase, deg" if k == 0 else "")
        for row in (0, 1):
            axes[row, k].set_xscale("log")
            axes[row, k].set_xticks([0.3, 0.5, 1.0, 2.0, 3.0], ["0.3", "0.5", "1", "2", "3"])
            axes[row, k].minorticks_off()
    axes[0, 0].legend()
    save(fig, folder / "frequency_response.png", _SAVED_DPI)
    rows = [[name, f"{100 * gain:.2f} %", f"{phase:.2f}°"] for name, (gain, phase) in worst.items()]
    return {"responses": table(["0.3 to 3 Hz, 60 and 100 km/h", "largest amplitude error", "phase error"], rows)}


def build_up(tyre: Tyre, alpha: float, speed: float, metres: float) -> tuple[FloatArray, FloatArray]:
    """Return distance (m) and lateral force (N) of one tyre after a step of the slip angle."""
    load, step = tyre.nominal_load_n, 1e-4
    slip = 0.0
    force = []
    for _ in range(round(metres / speed / step)):
        _, side, scaled = forces_n(tyre, 0.0, slip, load, DRY)
        force.append(side)
        slip += step * slip_rates(tyre, 0.0, slip, scaled, speed, -np.tan(alpha) * speed, speed)[1]
    return np.asarray(np.arange(len(force)) * step * speed), np.array(force, dtype=np.float64)


def relaxation(folder: Path) -> dict[str, str]:
    """Force over distance after a step of the slip angle, and what the whole car's front axle shows."""
    tyre = Tyre()
    fig, ((ax,),) = subplots(1, 1, 6.4, 3.8, _STYLE)
    for alpha, colour in ((0.3, "#1f5fa8"), (3.0, "#3b8550"), (8.0, "#b5482a")):
        for speed, dash in ((10.0, "-"), (30.0, ":")):
            x, force = build_up(tyre, np.radians(alpha), speed, 3.0)
            steady = forces_n(tyre, 0.0, float(np.tan(np.radians(alpha))), tyre.nominal_load_n, DRY)[1]
            ax.plot(x, force / steady, dash, color=colour, label=f"{alpha:g} deg, {speed:g} m/s")
    x = np.linspace(0.0, 3.0, 200)
    ax.plot(x, 1.0 - np.exp(-x / tyre.lateral_relaxation_m), "--", color="black", linewidth=1.0, label="1 - exp(-x/σ)")
    ax.set(xlabel="distance rolled after the step, m", ylabel="lateral force over its final value")
    ax.set_title("Build-up of the lateral force")
    ax.legend()
    save(fig, folder / "relaxation.png", _SAVED_DPI)
    rows = []
    car = load_vehicle("sedan")
    for speed in (10.0, 20.0, 40.0):
        t = np.arange(0.0, 3.0, 1e-3)
        motion = simulate_motion(open_loop(speed, 0.002 * np.sin(4 * np.pi * t)), DRY, vehicle=car, period_s=0.001)
        force = motion.column("fy_fl_n") + motion.column("fy_fr_n")
        slip = 0.5 * (motion.column("slip_angle_fl_rad") + motion.column("slip_angle_fr_rad"))
        basis = np.stack([slip, -np.gradient(force, 1e-3)], axis=1)[300:-2]
        (_, tau), *_ = np.linalg.lstsq(basis, force[300:-2], rcond=None)
        rows.append(
            [f"{speed:g}", f"{1e3 * tau:.1f}", f"{1e3 * tyre.lateral_relaxation_m / speed:.1f}", f"{tau * speed:.3f}"]
        )
    return {"relaxation": table(["speed, m/s", "lag of the front axle, ms", "σ/v_x, ms", "lag × speed, m"], rows)}


def traces(folder: Path) -> dict[str, str]:
    """The paper's two manoeuvres."""
    rows = []
    for manoeuvre, name, title in (
        ("dlc", "double_lane_change", "A: double lane change, 100 km/h, mu 0.85"),
        ("sine-sweep", "sine_sweep", "B: sine sweep 0.6 to 1 Hz, 60 km/h, mu 0.3"),
    ):
        drive = simulate_drive(manoeuvre, seed=1)
        t, truth = drive.times_s, drive.truth
        fig, axes = subplots(3, 2, 8.4, 6.4, _STYLE)
        felt = [("ay_m_s2", "a_y", 1 / G), ("specific_force_y_m_s2", "felt by the leaning IMU", 1 / G)]
        panels = (
            ("road-wheel angle, deg", [("steer_rad", "", np.degrees(1.0))]),
            ("yaw rate, deg/s", [("yaw_rate_rad_s", "", np.degrees(1.0))]),
            ("acceleration, g", felt),
            ("sideslip, deg", [("sideslip_rad", "", np.degrees(1.0))]),
            ("roll, deg", [("roll_rad", "", np.degrees(1.0))]),
            ("wheel load, kN", [(f"fz_{w}_n", w, 1e-3) for w in WHEELS]),
        )
        for ax, (label, lines) in zip(axes.ravel(), panels, strict=True):
            for k, (column, text, factor) in enumerate(lines):
                colour = ("#1f5fa8", "#b5482a", "#3b8550", "#8a5aa8")[k]
                ax.plot(t, factor * truth[column], color=colour, label=text or None)
            ax.set_ylabel(label)
            if len(lines) > 1:
                ax.margins(y=0.3)
                ax.legend(ncols=4, loc="upper left", fontsize=7)
        for ax in axes[-1]:
            ax.set_xlabel("time, s")
        fig.suptitle(title)
        save(fig, folder / f"{name}.png", _SAVED_DPI)
        unit = drive.friction * G
        yaw_rate, roll = (np.degrees(float(np.abs(truth[c]).max())) for c in ("yaw_rate_rad_s", "roll_rad"))
        largest = f"{drive.peak_ay_m_s2 / G:.2f} g = {drive.peak_ay_m_s2 / unit:.2f} mu g"
        angles = [f"{yaw_rate:.1f}", f"{np.degrees(drive.peak_sideslip_rad):.2f}", f"{roll:.2f}"]
        lightest = min(float(truth[f"fz_{w}_n"].min()) for w in WHEELS)
        rows.append([title.split(",")[0], largest, *angles, f"{lightest:.0f}"])
    head = "manoeuvre | largest a_y | yaw rate, deg/s | sideslip, deg | roll, deg | lightest wheel, N"
    return {"peaks": table(head.split(" | "), rows)}


def speed() -> dict[str, str]:
    """How many times faster than real time, one core, 1 ms, sensors included."""
    simulate_drive("road", duration_s=10.0)
    seconds = []
    for seed in range(3):
        start = time.perf_counter()
        simulate_drive("road", seed=seed, duration_s=120.0)
        seconds.append(time.perf_counter() - start)
    # In steps of 50, so that the page does not change with every build.
    times = int(120.0 / min(seconds) // 50 * 50)
    what = "times real time on one core (a drive on the road, driver and sensors included)."
    return {"speed": f"more than {times} {what}"}


#: What is known of the other simulator's car and differs from the sedan: no bars, short relaxation, no compliance,
#: parallel steering, pitch centre at 0.05 m.
_OTHER_RELAXATION_M = 0.2
_QUANTITIES = {"a_y": "ay", "yaw rate": "yaw_rate", "sideslip": "beta", "roll": "roll"}
_UNITS = {"a_y": (1.0, "m/s²"), "yaw rate": (np.degrees(1.0), "°/s"), "sideslip": (np.degrees(1.0), "°")}
_UNITS["roll"] = (np.degrees(1.0), "°")


def other_stiffness_n_per_rad(ramp_run: Any) -> tuple[float, float]:
    """Cornering stiffness of the other car's axles, from the linear part of its slow ramp."""
    v_x, v_y, r, steer = (ramp_run[c].to_numpy() for c in ("vx", "vy", "yaw_rate", "steer"))
    rows = (np.abs(ramp_run["ay"].to_numpy()) > 0.2) & (np.abs(ramp_run["ay"].to_numpy()) < 1.5)
    front = (steer - np.arctan2(v_y + 1.16 * r, v_x))[rows]
    rear = -np.arctan2(v_y - 1.71 * r, v_x)[rows]
    force = {a: (ramp_run[f"Fy_{a}l"] + ramp_run[f"Fy_{a}r"]).to_numpy()[rows] for a in "fr"}
    return float(np.polyfit(front, force["f"], 1)[0]), float(np.polyfit(rear, force["r"], 1)[0])


def like_the_other(front_n_per_rad: float, rear_n_per_rad: float) -> Vehicle:
    """Return the sedan with what is known of the other simulator's car."""
    car = Vehicle()
    sedan = axle_stiffness_n_per_rad(car, DRY)

    def tyre(of: Tyre, factor: float) -> Tyre:
        return of._replace(
            stiffness_peak=of.stiffness_peak * factor,
            stiffness_friction_power=0.0,
            lateral_relaxation_m=_OTHER_RELAXATION_M,
            lateral_relaxation_min_m=_OTHER_RELAXATION_M,
        )

    return car._replace(
        front_anti_roll_n_m_per_rad=0.0,
        rear_anti_roll_n_m_per_rad=0.0,
        pitch_centre_height_m=0.05,
        front_compliance_rad_per_n=0.0,
        rear_compliance_rad_per_n=0.0,
        ackermann=0.0,
        front_tyre=tyre(car.front_tyre, front_n_per_rad / sedan[0]),
        rear_tyre=tyre(car.rear_tyre, rear_n_per_rad / sedan[1]),
    )


def leaning_m(car: Vehicle) -> float:
    """How far the CG of the whole car moves sideways against the wheels per roll angle, m.

    The other simulator's CG stays above its wheels, so its sideslip is that of the wheels.
    """
    unsprung = 2.0 * (car.front_unsprung_mass_kg + car.rear_unsprung_mass_kg)
    sprung = car.mass_kg - unsprung
    centre = 0.5 * (car.front_roll_centre_height_m + car.rear_roll_centre_height_m)
    return car.cg_height_m - (unsprung * car.wheel_radius_m + sprung * centre) / car.mass_kg


def lag_text(mine: FloatArray, theirs: FloatArray, period_s: float) -> str:
    """How much later mine is: the shift of the best correlation within 0.25 s, refined by a parabola.

    A dash where the two are not alike enough to have a lag, or the best lies at the edge.
    """
    most = round(0.25 / period_s)
    inner = slice(most, -most)
    shifts = np.arange(-most, most + 1)
    alike = np.array([np.corrcoef(np.roll(mine, -int(k))[inner], theirs[inner])[0, 1] for k in shifts])
    best = int(alike.argmax())
    if alike[best] < 0.9 or best in (0, alike.shape[0] - 1):
        return "–"
    below, top, above = alike[best - 1 : best + 2]
    return f"{1e3 * period_s * (shifts[best] + 0.5 * (below - above) / (below - 2.0 * top + above)):+.0f} ms"


def independent() -> dict[str, str]:
    """The same steering on the independent simulator's runs; nothing where they are absent."""
    if not INDEPENDENT.is_dir():
        return {}
    import polars as pl

    runs = {path.stem.removeprefix("ocd_v1__"): pl.read_parquet(path) for path in sorted(INDEPENDENT.glob("*.parquet"))}
    stiffness = other_stiffness_n_per_rad(runs["ramp_100kmh_mu100_long"])
    cars = (Vehicle(), like_the_other(*stiffness))
    rows = []
    for name, run in runs.items():
        if name.startswith("normal"):
            continue
        t = run["t"].to_numpy() - run["t"][0]
        steer = np.interp(np.arange(0.0, t[-1], 1e-3), t, run["steer"].to_numpy())
        friction = float(name.split("_mu")[1][:3]) / 100.0
        motions = [simulate_motion(open_loop(float(run["vx"][0]), steer), friction, vehicle=car) for car in cars]
        for quantity, column in _QUANTITIES.items():
            factor, unit = _UNITS[quantity]
            theirs = np.interp(motions[0].times_s, t, run[column].to_numpy())
            line = [name.replace("_", " ").replace("0p", "0."), quantity, f"{factor * np.abs(theirs).max():.3g} {unit}"]
            for motion, car in zip(motions, cars, strict=True):
                v_y = motion.column("vy_m_s")
                if car is cars[1]:
                    v_y = v_y + leaning_m(car) * motion.column("roll_rate_rad_s")
                mine = {
                    "a_y": motion.column("ay_m_s2"),
                    "yaw rate": motion.column("yaw_rate_rad_s"),
                    "sideslip": np.arctan2(v_y, motion.column("vx_m_s")),
                    "roll": motion.column("roll_rad"),
                }[quantity]
                lag = "–" if name.startswith("ramp") else lag_text(mine, theirs, 0.01)
                ratio = np.abs(mine).max() / np.abs(theirs).max()
                line += [f"{factor * np.abs(mine).max():.3g}", f"{ratio:.2f}", lag]
            rows.append(line)
    head = ["run", "quantity", "other: peak"]
    for car_name in ("sedan", "like the other"):
        head += [f"{car_name}: peak", "ratio", "later by"]
    sedan = axle_stiffness_n_per_rad(Vehicle(), DRY)
    words = (
        f"Cornering stiffness of the axles, kN/rad: other {stiffness[0] / 1e3:.0f} and {stiffness[1] / 1e3:.0f}, "
        f"sedan {sedan[0] / 1e3:.0f} and {sedan[1] / 1e3:.0f} before compliance.\n\n"
    )
    return {"independent": words + table(head, rows)}


def main(docs: Path) -> None:
    """Build all figures and tables."""
    folder = docs / "truthsim"
    folder.mkdir(parents=True, exist_ok=True)
    blocks: dict[str, str] = {}
    for part in (steady_state, responses, relaxation, traces):
        blocks.update(part(folder))
    blocks.update(speed())
    for name, text in independent().items():
        write(RESULTS / "truthsim" / f"{name}.md", f"# Runs of Open-Car-Dynamics and of truthsim\n\n{text}\n")
    path = docs / "truthsim.md"
    write(path, fill(path.read_text(encoding="utf-8"), blocks, "docs/truthsim.md"))
    for name, text in blocks.items():
        print(f"{name}\n{text}\n")


if __name__ == "__main__":
    parser = options("truthsim_docs", __doc__)
    parser.add_argument("docs", type=Path, nargs="?", default=DOCS)
    main(parser.parse_args().docs)
