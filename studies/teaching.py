"""Teaching on recorded drives: taught on one drive with ground truth, scored on another one of the same car.

    python -m studies.teaching [--cars GTI,...] [--out docs] [--stored]

``pdhef learn`` teaches; ``pdhef run`` calibrates the car on the sensors of the scored drive, without ground truth.
Columns: ``physics`` of the untaught car, of the taught car, and ``pd-hef`` of the taught car with its residual; also
for a car taught by the sideslip reference in place of ground truth, if the reference is independent. The drives are in
``../shared`` and may not be redistributed. Without them, the command ends with 0 and writes no file.
"""

from __future__ import annotations

import json
import math
import sys
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import permutations
from pathlib import Path

import numpy as np
import polars as pl

from studies.gates.tool import Tool
from studies.pages import DOCS, DRIVES, RESULTS, ROOT, number, options, table, template, write, write_toml
from studies.peers.drives import PEER_DRIVES, PeerDrive, mapping_table, vehicle_table

RESULTS_FILE = RESULTS / "teaching.json"
#: No pair may be worse than untaught by more than the larger of this share and this many degrees.
WORSE_SHARE, WORSE_DEG = 0.05, 0.03
#: Driving counts as alike where the residual is active on this share of it.
ALIKE = 0.5
#: The paper's network, trained in simulation, in the sigma points of the paper's filter.
PAPER = "pd-hef-paper"


@dataclass(frozen=True, slots=True)
class TeachPart:
    """A slice of a log, in seconds from its start; ``steering_gain`` makes a road-wheel angle of its channel."""

    log: str
    start: str | None = None
    end: str | None = None
    steering_gain: float = 1.0

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


_F1TENTH = sorted(p.log for p in PEER_DRIVES if p.car == "1:10 F1TENTH")
CARS = (
    TeachCar("250 LM", (TeachPart("revs_250lm_a.mcap", None, "150"), TeachPart("revs_250lm_a.mcap", "150"))),
    TeachCar("GTI", (
        TeachPart("gti_pole_aa.mcap"), TeachPart("gti_low_speed.mcap"), TeachPart("niki_gti_1khz.mcap", None, "50"),
        TeachPart("stanford_wet_1.mcap", steering_gain=1.0 / 13.9),
    )),
    TeachCar("V40", (TeachPart("v40_slalom.mcap"), TeachPart("v40_swd_gnss.mcap"))),
    TeachCar("TT-S", (TeachPart("tts_kk.mcap", None, "62"), TeachPart("tts_kk.mcap", "62"))),
    TeachCar("Polaris", (TeachPart("polaris_a.mcap"), TeachPart("polaris_b.mcap"))),
    TeachCar("1:10 DART", (TeachPart("dart_circles_fast.mcap"), TeachPart("dart_steer_rate.mcap"))),
    TeachCar("1:10 F1TENTH", tuple(map(TeachPart, _F1TENTH)), taught_on=5),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Score:
    """RMSE in degrees, also without the constant; shares with an active residual and inside 95 % intervals."""

    rmse_deg: float
    without_constant_deg: float
    active: float
    covered: float | None


@dataclass(frozen=True, slots=True)
class PairResult:
    """A pair: taught on ``taught``, scored on ``scored``."""

    car: str
    taught: str
    scored: str
    untaught: Score
    prior: Score
    hybrid: Score
    kinematic_deg: float
    paper_deg: float
    rung: str
    reference: Score | None = None

    @property
    def worse(self) -> bool:
        """Whether teaching costs more than it may."""
        limit = max((1.0 + WORSE_SHARE) * self.untaught.rmse_deg, self.untaught.rmse_deg + WORSE_DEG)
        return self.hybrid.rmse_deg > limit

    @property
    def ratio(self) -> float:
        """RMSE of ``pd-hef`` of the taught car over the RMSE of untaught ``physics``."""
        return self.hybrid.rmse_deg / self.untaught.rmse_deg

    @property
    def referred(self) -> PairResult | None:
        """The same if the reference teaches, None if it cannot."""
        return None if self.reference is None else replace(self, hybrid=self.reference)


def peer_of(part: TeachPart) -> PeerDrive:
    """Return the recorded drive of a part."""
    return next(p for p in PEER_DRIVES if p.log == part.log)


def inputs(tool: Tool, part: TeachPart, *, receiver: bool = False, truth: bool = True) -> list[str | Path]:
    """Return the log of a part with the options for its mapping and slice; ``receiver``: of the V40's GNSS."""
    mapping = mapping_table(peer_of(part), receiver=receiver)
    if part.steering_gain != 1.0:
        wheel = mapping["signals"].pop("steering_wheel_rad")
        mapping["signals"]["steer_rad"] = wheel | {"scale": wheel["scale"] * part.steering_gain}
    if not truth:
        del mapping["truth"]
    name = f"{part.log}{'-gnss' if receiver else ''}{'' if truth else '-without'}.toml"
    file = write_toml(tool.work / "mappings" / name, mapping)
    span = [t for k, value in (("start", part.start), ("end", part.end)) if value for t in ("--set", f"{k}={value}")]
    return [DRIVES / part.log, "--mapping", file, *span]


def learn(tool: Tool, car: Path, parts: Sequence[TeachPart], name: str) -> tuple[Path, str]:
    """Teach a car on parts; return it and the name of its residual."""
    output = tool.work / "cars" / name
    _, *options_of = inputs(tool, parts[0])  # parts that teach together have the same mapping and slice
    tool.json("learn", *(DRIVES / part.log for part in parts), *options_of, "--car", car, "-o", output)
    taught = tomllib.loads((output / "model.toml").read_text(encoding="utf-8"))
    return output, taught.get("residual", {}).get("rung", "none")


def learn_by_reference(tool: Tool, car: Path, part: TeachPart, name: str) -> Path | None:
    """Teach a car on a drive of the V40 by the reference with its receiver; None if it does not teach."""
    output = tool.work / "cars" / name
    given = (*inputs(tool, part, receiver=True, truth=False), "--car", car, "-o", output)
    try:
        tool.json("learn", *given, "--set", "reference=on")
    except RuntimeError as refused:
        print(f"{name}: {refused}", file=sys.stderr)
        return None
    return output


def scores(tool: Tool, part: TeachPart, car: Path, names: Sequence[str], *options_of: str) -> dict[str, Score]:
    """Run estimators on a part, calibrated on its own sensors, and return their scores."""
    run_name = f"{car.stem}-{part.name}{''.join(options_of)}".replace(" ", "-")
    given = ["--keep", "estimates", "--estimators", ",".join(names), *options_of]
    folder = tool.run(run_name, *inputs(tool, part), "--car", car, *given)
    figures = pl.read_parquet(folder / "metrics.parquet").filter(signal="sideslip_rad", segment="all")
    (file,) = folder.glob("logs/*/estimates.parquet")
    tracks = pl.read_parquet(file)
    found = {}
    for name in names:
        of = dict(figures.filter(estimator=name).select("metric", "value").iter_rows())
        trust = tracks.filter(estimator=name)["network_trust"].to_numpy()
        constant = math.sqrt(max(of["rmse"] ** 2 - of["bias"] ** 2, 0.0))
        degrees = math.degrees(of["rmse"]), math.degrees(constant)
        found[name] = Score(*degrees, float(np.mean(trust > 0.0)), of.get("coverage95"))
    return found


def pairs_of(tool: Tool, car: TeachCar) -> Iterator[PairResult]:
    """Yield the results of a car's pairs."""
    parts = car.parts
    file = write_toml(tool.work / "cars" / f"{car.name}.toml".replace(" ", "-").replace(":", "-"),
                      vehicle_table(peer_of(parts[0])))  # fmt: skip
    untaught = [scores(tool, part, file, ("physics", "kinematic")) for part in parts]
    paper = [scores(tool, part, file, (PAPER,), "--network", "default")[PAPER] for part in parts]
    choices: list[tuple[tuple[int, ...], int]] = [((a,), b) for a, b in permutations(range(len(parts)), 2)]
    if car.taught_on > 1:
        choices = [(tuple(range(car.taught_on)), k) for k in range(car.taught_on, len(parts))]
    learned: dict[tuple[int, ...], tuple[Path, str, Path | None]] = {}
    for teachers, k in choices:
        taught_on = parts[teachers[0]].name if len(teachers) == 1 else f"{len(teachers)} runs"
        if teachers not in learned:
            name = f"{file.stem}-{teachers[0]}"
            taught, rung = learn(tool, file, [parts[i] for i in teachers], name)
            has_receiver = parts[teachers[0]].log.startswith("v40_")
            by_reference = (
                learn_by_reference(tool, file, parts[teachers[0]], f"{name}-reference") if has_receiver else None
            )
            learned[teachers] = taught, rung, by_reference
        taught, rung, by_reference = learned[teachers]
        after = scores(tool, parts[k], taught, ("physics", "pd-hef"))
        referred = None if by_reference is None else scores(tool, parts[k], by_reference, ("pd-hef",))["pd-hef"]
        of = untaught[k]
        yield PairResult(
            car.name, taught_on, parts[k].name, of["physics"], after["physics"], after["pd-hef"],
            of["kinematic"].rmse_deg, paper[k].rmse_deg, rung, referred,
        )  # fmt: skip


def pair_table(results: Sequence[PairResult]) -> str:
    """Return one line per pair."""

    def cell(s: Score) -> str:
        return f"{s.rmse_deg:.3f} ({s.without_constant_deg:.3f})"

    body = [[
            r.car, r.taught, r.scored, cell(r.untaught), cell(r.prior), cell(r.hybrid),
            number(r.ratio, 2) + (" worse" if r.worse else ""), geometric_mean([p.ratio] if (p := r.referred) else []),
            number(r.paper_deg, 3), r.rung, f"{r.hybrid.active:.0%}",
            " / ".join("–" if s.covered is None else f"{s.covered:.0%}" for s in (r.untaught, r.hybrid)),
        ] for r in results]  # fmt: skip
    head = "car, taught on, scored on, untaught, taught, pd-hef, ratio, reference, paper, residual, active, 95 %"
    return table(head.split(", "), body, right_from=3)


def summary(results: Sequence[PairResult]) -> str:
    """Return the figures that the targets are about."""

    def mean(ratios: Sequence[float]) -> str:
        return f"{geometric_mean(ratios)} ({len(ratios)} pairs)" if ratios else "–"

    alike = [r for r in results if r.hybrid.active >= ALIKE]
    unlike = [r for r in results if r.hybrid.active < ALIKE]
    small = [r for r in results if r.car == "1:10 F1TENTH"]
    pairs = [(r, p) for r in results if (p := r.referred) is not None]
    lines = [
        ["pairs worse than untaught by more than max(5 %, 0.03°)", str(sum(r.worse for r in results))],
        ["geometric mean of the ratios, residual active on at least 50 %", mean([r.ratio for r in alike])],
        ["geometric mean of the ratios, residual active on less", mean([r.ratio for r in unlike])],
        ["the same with the prior alone, all pairs", mean([r.prior.rmse_deg / r.untaught.rmse_deg for r in results])],
        ["the same with the paper's network, all pairs", mean([r.paper_deg / r.untaught.rmse_deg for r in results])],
        ["1:10 cars, pd-hef over kinematic", mean([r.hybrid.rmse_deg / r.kinematic_deg for r in small])],
        ["geometric mean of the ratios, taught by the reference", mean([p.ratio for _, p in pairs])],
        ["the same pairs, taught by ground truth", mean([r.ratio for r, _ in pairs])],
        ["pairs worse than untaught by more than that, taught by the reference", str(sum(p.worse for _, p in pairs))],
    ]
    return table(["figure", "value"], lines)


def geometric_mean(ratios: Sequence[float]) -> str:
    """Return the geometric mean of ratios, a dash without any."""
    return f"{math.exp(float(np.mean(np.log(ratios)))):.2f}" if ratios else "–"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the pairs and write the page."""
    parser = options("teaching", __doc__)
    parser.add_argument("--cars", default=",".join(c.name for c in CARS))
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "teaching")
    parser.add_argument("--out", type=Path, default=DOCS)
    parser.add_argument("--results", type=Path, default=RESULTS_FILE)
    parser.add_argument("--stored", action="store_true", help="write the page of the stored results")
    given = parser.parse_args(arguments)
    if given.stored:
        write_page(given.out, stored_results(given.results))
        return 0
    if not DRIVES.is_dir():
        print("needs ../shared beside the repository (recorded drives that may not be redistributed); nothing is done")
        return 0
    wanted = given.cars.split(",")
    if unknown := set(wanted) - {c.name for c in CARS}:
        parser.error(f"--cars: expected names out of {', '.join(c.name for c in CARS)}, got {', '.join(unknown)}")
    results = []
    for car in (c for c in CARS if c.name in wanted):
        for result in pairs_of(Tool(ROOT, given.work.resolve()), car):
            results.append(result)
            print(pair_table([result]).splitlines()[-1], file=sys.stderr)
    write(given.results, json.dumps([asdict(r) for r in results], indent=1) + "\n")
    write_page(given.out, results)
    return 0


def stored_results(file: Path) -> list[PairResult]:
    """Return the results of a stored run."""
    scores = ("untaught", "prior", "hybrid", "reference")
    documents = json.loads(file.read_text(encoding="utf-8"))
    return [PairResult(**{**d, **{name: Score(**d[name]) for name in scores if d.get(name)}}) for d in documents]


def write_page(folder: Path, results: Sequence[PairResult]) -> None:
    """Write the page of results."""
    write(folder / "teaching.md", template(__file__, pairs=pair_table(results), summary=summary(results)))


if __name__ == "__main__":
    sys.exit(main())
