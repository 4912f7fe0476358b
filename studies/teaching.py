"""Teaching on recorded drives: taught on one drive with ground truth, scored on another one of the same car.

    python -m studies.teaching [--cars GTI ...] [--out docs] [--stored]

``pdhef learn`` teaches; ``pdhef run`` calibrates the car on the sensors of the scored drive, without ground truth.
Columns: ``physics`` of the untaught car, of the taught car, and ``pd-hef`` of the taught car with its residual; also
for a car taught by the sideslip reference in place of ground truth, if the reference is independent. The drives are in
``../shared`` and may not be redistributed. Without them, the command ends with 0 and writes no file.
"""

import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from studies import pages
from studies.gates.tool import Tool, estimates, metrics
from studies.pages import DRIVES, ROOT, read_toml, write_toml
from studies.peers.drives import FULL_SIZE, PEER_DRIVES, mapping_table, peer_drive, vehicle_table

STORED = "pairs.json"
#: No pair may be worse than untaught by more than the larger of this share and this many degrees.
WORSE_SHARE, WORSE_DEG = 0.05, 0.03
#: Driving counts as alike where the residual is active on this share of it.
ALIKE = 0.5
#: The paper's network, trained in simulation, in the sigma points of the paper's filter.
PAPER = "pd-hef-paper"


@dataclass(frozen=True, slots=True)
class TeachPart:
    """A slice of a log, in seconds from its start; ``steering_ratio`` makes a road-wheel angle of its channel."""

    log: str
    start: str | None = None
    end: str | None = None
    steering_ratio: float = 1.0

    @property
    def name(self) -> str:
        """Log and slice."""
        span = "" if self.start is None and self.end is None else f" {self.start or '0'} to {self.end or 'end'} s"
        return f"{self.log.partition('.')[0]}{span}"


@dataclass(frozen=True, slots=True)
class TeachCar:
    """A car: its parts; pairs of them, in which one or several teach."""

    name: str
    parts: tuple[TeachPart, ...]
    taught_on: int = 1


CARS = tuple(
    TeachCar(name, tuple(TeachPart(**part) for part in entry.pop("parts")), **entry)
    for name, entry in read_toml(Path(__file__).with_suffix(".toml")).items()
)


#: RMSE in degrees, also without the constant; shares with an active residual and inside 95 % intervals.
Score = dict[str, Any]
#: A pair as it is stored: names of car and parts, the scores ``untaught``, ``prior``, ``hybrid`` and ``reference``.
Pair = dict[str, Any]


def ratio(pair: Pair, way: str = "hybrid") -> float:
    """Return the RMSE of a way over that of untaught ``physics``."""
    return float(pair[way]["rmse_deg"] / pair["untaught"]["rmse_deg"])


def is_worse(pair: Pair, way: str = "hybrid") -> bool:
    """Return whether teaching costs more than it may."""
    untaught = pair["untaught"]["rmse_deg"]
    return bool(pair[way]["rmse_deg"] > max((1.0 + WORSE_SHARE) * untaught, untaught + WORSE_DEG))


def inputs(tool: Tool, part: TeachPart, *, receiver: bool = False, truth: bool = True) -> list[str | Path]:
    """Return the log of a part with the options for its mapping and slice; ``receiver``: of the V40's GNSS."""
    mapping = mapping_table(peer_drive(part.log), receiver=receiver)
    if part.steering_ratio != 1.0:
        wheel = mapping["signals"].pop("steering_wheel_rad")
        mapping["signals"]["steer_rad"] = wheel | {"scale": wheel["scale"] * (1.0 / part.steering_ratio)}
    if not truth:
        del mapping["truth"]
    name = f"{part.log}{'-gnss' if receiver else ''}{'' if truth else '-without'}.toml"
    file = write_toml(tool.work / "mappings" / name, mapping)
    span = [t for k, value in (("start", part.start), ("end", part.end)) if value for t in ("--set", f"{k}={value}")]
    return [DRIVES / part.log, "--mapping", file, *span]


def learn(tool: Tool, car: Path, name: str, *given: str | Path) -> Path:
    """Teach a car on logs with their options; return it. Raises RuntimeError if they do not teach."""
    output = tool.work / "cars" / name
    tool.json("learn", *given, "--car", car, "-o", output)
    return output


def learn_by_reference(tool: Tool, car: Path, part: TeachPart, name: str) -> Path | None:
    """Teach a car on a drive of the V40 by the reference with its receiver; None if it does not teach."""
    try:
        return learn(tool, car, name, *inputs(tool, part, receiver=True, truth=False), "--set", "reference=on")
    except RuntimeError as refused:
        print(f"{name}: {refused}", file=sys.stderr)
        return None


def scores(tool: Tool, part: TeachPart, car: Path, names: Sequence[str], *options_of: str) -> dict[str, Score]:
    """Run estimators on a part, calibrated on its own sensors, and return their scores."""
    run_name = f"{car.stem}-{part.name}{''.join(options_of)}".replace(" ", "-")
    given = ["--keep", "estimates", "--estimators", ",".join(names), *options_of]
    folder = tool.run(run_name, *inputs(tool, part), "--car", car, *given)
    figures = metrics(folder, signal="sideslip_rad")
    active = estimates(folder).group_by("estimator").agg((pl.col("network_trust").fill_null(0.0) > 0.0).mean())
    found = {}
    for name, share in active.filter(pl.col("estimator").is_in(names)).iter_rows():
        of = dict(figures.filter(estimator=name).select("metric", "value").iter_rows())
        found[str(name)] = {
            "rmse_deg": math.degrees(of["rmse"]),
            "without_constant_deg": math.degrees(math.sqrt(max(of["rmse"] ** 2 - of["bias"] ** 2, 0.0))),
            "active": share,
            "covered": of.get("coverage95"),
        }
    return found


def pairs_of(tool: Tool, car: TeachCar) -> Iterator[Pair]:
    """Yield the results of a car's pairs."""
    parts = car.parts
    stem = car.name.replace(" ", "-").replace(":", "-")
    file = write_toml(tool.work / "cars" / f"{stem}.toml", vehicle_table(peer_drive(parts[0].log)))
    untaught = [scores(tool, part, file, ("physics", "kinematic")) for part in parts]
    paper = [scores(tool, part, file, (PAPER,), "--network", "default")[PAPER] for part in parts]
    teachers = [(a,) for a in range(len(parts))] if car.taught_on == 1 else [tuple(range(car.taught_on))]
    for chosen in teachers:
        name, first = f"{stem}-{chosen[0]}", parts[chosen[0]]
        _, *options_of = inputs(tool, first)  # parts that teach together have the same mapping and slice
        taught = learn(tool, file, name, *(DRIVES / parts[i].log for i in chosen), *options_of)
        has_receiver = first.log.startswith("v40_")
        by_reference = learn_by_reference(tool, file, first, f"{name}-reference") if has_receiver else None
        for k in (k for k in range(len(parts)) if k not in chosen):
            after = scores(tool, parts[k], taught, ("physics", "pd-hef"))
            yield {
                "car": car.name,
                "taught": first.name if len(chosen) == 1 else f"{len(chosen)} runs",
                "scored": parts[k].name,
                "untaught": untaught[k]["physics"],
                "prior": after["physics"],
                "hybrid": after["pd-hef"],
                "kinematic_deg": untaught[k]["kinematic"]["rmse_deg"],
                "paper_deg": paper[k]["rmse_deg"],
                "rung": read_toml(taught / "model.toml").get("residual", {}).get("rung", "none"),
                "reference": by_reference and scores(tool, parts[k], by_reference, ("pd-hef",))["pd-hef"],
            }


def blocks(results: Sequence[Pair]) -> dict[str, str]:
    """Return table and summary of the pairs, and the sentence of README.md, by name."""
    full_size = {part.car for part in PEER_DRIVES if part.group == FULL_SIZE}
    referred = [r for r in results if r["reference"]]
    ratios = {
        "all": [ratio(r) for r in results],
        "full_size": [ratio(r) for r in results if r["car"] in full_size],
        "alike": [ratio(r) for r in results if r["hybrid"]["active"] >= ALIKE],
        "unlike": [ratio(r) for r in results if r["hybrid"]["active"] < ALIKE],
        "prior": [ratio(r, "prior") for r in results],
        "paper": [r["paper_deg"] / r["untaught"]["rmse_deg"] for r in results],
        "small": [r["hybrid"]["rmse_deg"] / r["kinematic_deg"] for r in results if r["car"] == "1:10 F1TENTH"],
        "reference": [ratio(r, "reference") for r in referred],
        "by_truth": [ratio(r) for r in referred],
    }
    return pages.blocks(
        __file__,
        results=results,
        ratio=ratio,
        is_worse=is_worse,
        mean={name: mean(of) for name, of in ratios.items()},
        worse=[r for r in results if is_worse(r)],
        worse_by_reference=sum(is_worse(r, "reference") for r in referred),
    )


def mean(ratios: Sequence[float]) -> str:
    """Return the geometric mean of ratios and their number, a dash without any."""
    return f"{math.exp(float(np.mean(np.log(ratios)))):.2f} ({len(ratios)} pairs)" if ratios else "–"


def main() -> None:
    """Run the pairs and write the page."""
    parser = pages.options("teaching", __doc__, pages.OF_PAGES)
    parser.add_argument("--cars", nargs="+", choices=[c.name for c in CARS], default=[c.name for c in CARS])
    given = parser.parse_args()
    if not given.stored:
        if not DRIVES.is_dir():
            print("nothing is done: needs ../shared beside the repository")
            return
        results = []
        for car in (c for c in CARS if c.name in given.cars):
            for result in pairs_of(Tool(ROOT, given.work.resolve()), car):
                results.append(result)
                print(blocks([result])["pairs"].splitlines()[-1], file=sys.stderr)
        pages.write_json(given.results / STORED, results)
    made = blocks(pages.read_json(given.results / STORED))
    pages.update(given.out, "README.md", {"teaching": made.pop("teaching")})
    pages.update(given.out, "peers.md", made)


if __name__ == "__main__":
    main()
