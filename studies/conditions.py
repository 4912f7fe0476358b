"""The condition table (docs/method.md#evaluation): every estimator on the same drives with one error in each row.

    python -m studies.conditions [--car CAR] [--network FOLDER] [--drives 10] [--jobs 2] [--rows NAME ...] [--stored]

Simulates the drives, runs all estimators by ``pdhef run``, and writes the page ``conditions.md`` with two figures to
``--out``, and all tables to ``--results``. ``--work`` keeps logs and runs: a repeated call resumes where it stopped.
``--stored`` renders the page from ``--results``. Friction is the only input of an estimator from the ground truth, and
only with the factor of the row. The runs of the independent simulator are a row if ``../shared`` is beside the
repository.
"""

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import polars as pl

from pdhef_logtool import PdhefError, __version__
from pdhef_logtool.records.signals import FloatArray
from studies.gates.tool import Tool
from studies.pages import INDEPENDENT, OF_PAGES, ROOT, blocks, options, read_json, update, write_json, write_toml
from studies.pictures import save, subplots
from truthsim.conditions import ROW_NAMES, ROWS, write_conditions

INDEPENDENT_ROW = "independent-simulator"
INDEPENDENT_MAPPING = Path(__file__).with_name("independent_sim.toml")
ESTIMATORS = (
    "zero", "kinematic", "open-loop", "linear-regression", "phy-ukf", "phy-ukf:tuned", "physics", "pure-lstm",
    "pd-hef-paper", "pd-hef:fixed-r", "pd-hef", "pd-hef-smoothed",
)  # fmt: skip
COLUMNS = ("row", "drive", "estimator", "signal", "segment", "metric", "value", "unit", "n")
#: The estimator of interest, the references of its RMSE ratios, and the ratio from which it is worse.
SUBJECT, REFERENCES, MARGIN = "pd-hef", ("physics", "phy-ukf", "pd-hef-paper"), 1.05
#: In the picture with their spans, from the naive to the best; the others are medians in grey.
DRAWN = ("zero", "open-loop", "phy-ukf", "physics", "pd-hef", "pd-hef-smoothed")
#: Okabe and Ito (2008), without yellow.
COLOURS = ("#000000", "#E69F00", "#56B4E9", "#0072B2", "#D55E00", "#009E73")
RESAMPLES = 2000
KEPT_METRICS = ("rmse", "availability", "coverage95", "lag_s", "nees", "nis", "nis_dof")


def row_logs(work: Path, row: str, drives: int, seed: int = 1, jobs: int = 1) -> tuple[list[Path], dict[str, Any]]:
    """Simulate the drives of a row; return their logs and the changed inputs of the estimators."""
    folder = work / f"drives-{seed}-{drives}-{row}"
    manifest = write_conditions(folder, drives=drives, seed=seed, rows=[row], processes=jobs)
    (entry,) = (e for e in manifest["rows"] if e["name"] == row)
    return [folder / file for file in entry["files"]], entry["assume"]


def row_inputs(tool: Tool, name: str, log: Path, assume: dict[str, Any]) -> list[str | Path]:
    """Return the options of a run with the mapping and the friction of a row."""
    mapping = tool.mapping(log)
    # The exact ground truth has the clock of the sensors.
    if assume.get("friction") != "unknown":
        friction = {"topic": "/truth/perfect/state", "field": "friction", "stamp": "header.stamp"}
        mapping["signals"]["friction"] = friction | {"scale": assume.get("friction_factor", 1.0)}
    file = write_toml(tool.work / "mappings" / f"condition-{name}.toml", mapping)
    return ["--mapping", file, *(["--set", f"sensors={assume['sensors']}"] if "sensors" in assume else [])]


def runs_of(tool: Tool, row: str, given: argparse.Namespace) -> Iterator[Path]:
    """Run the estimators on the drives of a row and yield the output folders."""
    common = ["--car", given.car, "--estimators", ",".join(ESTIMATORS), "--keep", "metrics", "--jobs", given.jobs]
    common += [] if given.network is None else ["--network", given.network]
    if row != INDEPENDENT_ROW:
        logs, assume = row_logs(given.work, row, given.drives, given.seed, given.jobs)
        yield tool.run(f"{row}-{given.seed}-{given.drives}", *logs, *common, *row_inputs(tool, row, logs[0], assume))
        return
    for log in sorted(INDEPENDENT.glob("*.parquet")):
        friction = read_json(log.with_suffix(".json"))["mu"]
        given_files = ("--mapping", INDEPENDENT_MAPPING, "--friction", str(friction))
        yield tool.run(f"{row}-{log.stem}", log, *common, *given_files)


def run(given: argparse.Namespace) -> None:
    """Run all rows and write the results."""
    tool, frames = Tool(ROOT, given.work.resolve()), []
    for row in given.rows:
        print(row, file=sys.stderr)
        tables = (pl.read_parquet(folder / "metrics.parquet") for folder in runs_of(tool, row, given))
        frames += [found.rename({"log": "drive"}).with_columns(row=pl.lit(row)) for found in tables]
    kept = pl.col("metric").is_in(KEPT_METRICS) & pl.col("segment").is_in(("all", "linear", "nonlinear"))
    network = "" if given.network is None else f" --network {given.network.name}"
    facts = {
        "command": f"python -m studies.conditions --car {given.car}{network} --drives {given.drives}"
        f" --seed {given.seed}",
        "car": given.car,
        "version": __version__,
        "rows": {r.name: r.description for r in ROWS} | {INDEPENDENT_ROW: "runs of another simulator, true friction"},
        "order": ESTIMATORS,
    }
    given.results.mkdir(parents=True, exist_ok=True)
    metrics = pl.concat(frames).select(COLUMNS).filter(kept)
    metrics.write_parquet(given.results / "metrics.parquet", compression="zstd", compression_level=19)
    write_json(given.results / "facts.json", facts)


# ------------------------------------------------------------------------------------------------ the page


def ratio_of_medians(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return lower bound, median(a) / median(b) and upper bound over drives [N], paired; NaN without two drives.

    The bootstrap draws whole drives with replacement, the same for both sides; the bounds are those of 95 %.
    """
    both = np.isfinite(a) & np.isfinite(b)
    a, b = a[both], b[both]
    if not len(a):
        return np.full(3, np.nan)
    draw = np.random.default_rng(0).integers(len(a), size=(RESAMPLES, len(a)))
    with np.errstate(divide="ignore", invalid="ignore"):
        value, drawn = np.median(a) / np.median(b), np.median(a[draw], axis=1) / np.median(b[draw], axis=1)
    low, high = np.nanpercentile(drawn, [2.5, 97.5]) if len(a) > 1 else (np.nan, np.nan)
    return np.array([low, value, high])


def verdict(low: float, high: float) -> str:
    """Return the verdict from the interval of a ratio."""
    if not np.isfinite(low):
        return "–"
    return "better" if high < 1.0 else "worse" if low > MARGIN else "not worse" if high <= MARGIN else "open"


def write_page(out: Path, folder: Path) -> None:
    """Render the page and its two figures from the results in a folder; drives without a scored sample do not count."""
    facts = read_json(folder / "facts.json")
    sideslip = pl.col("signal").cast(pl.String) == "sideslip_rad"
    metrics = pl.read_parquet(folder / "metrics.parquet").filter(sideslip, segment="all")
    errors = metrics.filter(metric="rmse").pivot("estimator", index=["row", "drive"], values="value").sort("drive")
    rows = [r for r in facts["rows"] if r in set(errors["row"])]
    rmse = {r: {n: np.degrees(errors.filter(row=r)[n].to_numpy()) for n in facts["order"]} for r in rows}
    ratios = {o: np.array([ratio_of_medians(rmse[r][SUBJECT], rmse[r][o]) for r in rows]) for o in REFERENCES}
    spans = {n: np.array([np.nanpercentile(rmse[r][n], [10, 50, 90]) for r in rows]) for n in facts["order"]}
    drawn = {n: spans[n] for n in DRAWN}
    others = {n: span for n, span in spans.items() if n not in DRAWN}
    pictures = out / "conditions"
    pictures.mkdir(parents=True, exist_ok=True)
    label = "sideslip RMSE in degrees: median and 10th to 90th percentile over drives"
    plot(pictures / "sideslip.png", rows, drawn, label, medians=others)
    label = f"median sideslip RMSE of {SUBJECT} over that of the reference, 95 % interval"
    plot(pictures / "ratios.png", rows, ratios, label, limits={1.0: "-", MARGIN: ":"})

    covered = metrics.filter(metric="coverage95", estimator=SUBJECT).group_by("row")
    coverage = covered.agg((pl.col("value") * pl.col("n")).sum() / pl.col("n").sum())
    about = {"facts": facts, "rows": rows, "drawn": drawn, "ratios": ratios, "independent": INDEPENDENT_ROW}
    about |= {"drives": dict(errors["row"].value_counts().iter_rows()), "coverage": dict(coverage.iter_rows())}
    verdicts = {o: [verdict(low, high) for low, _, high in bounds] for o, bounds in ratios.items()}
    made = blocks(__file__, subject=SUBJECT, margin=MARGIN, verdicts=verdicts, **about)
    update(out, "README.md", {"conditions": made.pop("conditions")})
    update(out, "conditions.md", made)


def plot(
    path: Path, rows: Sequence[str], spans: Mapping[str, FloatArray], label: str, *,
    medians: Mapping[str, FloatArray] = MappingProxyType({}), limits: Mapping[float, str] = MappingProxyType({}),
) -> None:  # fmt: skip
    """Draw low, middle and high [rows, 3] of every name in a lane per row, and medians in grey."""
    fig, grid = subplots(1, 1, 9.0, 1.5 + 0.36 * len(rows), {"font.size": 9})
    axes = grid[0, 0]
    for row in range(0, len(rows), 2):
        axes.axhspan(row - 0.5, row + 0.5, color="0.94", linewidth=0)
    step = 0.8 / max(len(spans), 1)
    for i, (name, span) in enumerate(spans.items()):
        y = np.arange(len(rows)) + (i - 0.5 * (len(spans) - 1)) * step
        colour, marker = COLOURS[i % len(COLOURS)], "osD^vP"[i % 6]
        axes.hlines(y, span[:, 0], span[:, 2], color=colour, linewidth=1.6, alpha=0.55)
        axes.plot(span[:, 1], y, marker, markersize=4.5, color=colour, label=name)
    for i, span in enumerate(medians.values()):
        label_of = None if i else "the others of the table"
        axes.plot(span[:, 1], np.arange(len(rows)), "|", markersize=7, color="0.6", zorder=1.5, label=label_of)
    for limit, dash in limits.items():
        axes.axvline(limit, color="black", linewidth=0.8, linestyle=dash)
    axes.set(xscale="log", xlabel=label, ylim=(len(rows) - 0.5, -0.5))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_yticks(range(len(rows)), rows)
    axes.tick_params(axis="y", length=0)
    axes.grid(alpha=0.4, axis="x")
    fig.legend(frameon=False, loc="outside upper center", ncols=7)
    save(fig, path)


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the table; 1 with one line where an input is wrong."""
    parser = options("conditions", __doc__, OF_PAGES, drives=10, seed=1, jobs=2)
    parser.add_argument("--car", default="saloon")
    parser.add_argument("--network", type=Path, help="instead of the car's")
    all_rows = (*ROW_NAMES, INDEPENDENT_ROW)
    parser.add_argument("--rows", nargs="+", choices=all_rows, default=all_rows, metavar="ROW", help="all by default")
    given = parser.parse_args(arguments)
    try:
        if not given.stored:
            run(given)
        write_page(given.out, given.results)
    except (PdhefError, RuntimeError) as error:
        print(error, file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
