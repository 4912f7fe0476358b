"""docs/model_card.md: what the shipped model was made of, how good it is on drives that it never saw, and its limits.

    python -m studies.model_card [--work out/train-default] [--model pdhef_logtool/models/default] [--out docs]

Every figure is computed here from the logs that ``studies.defaults.train_default`` simulated and the model that it
wrote.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters, load_vehicle
from pdhef_logtool.estimators.registry import runnable
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.residual_model.bundle import PAPER_FOLDER, PURE_LSTM_FOLDER, ModelBundle, load_bundle
from studies.condition_drives import SIDESLIP, read_drive
from studies.defaults.train_default import DRIVES, HOME, SETS

ESTIMATORS = (
    "zero",
    "linear-regression",
    "phy-ukf",
    "phy-ukf-tuned",
    "physics-plus",
    "pure-lstm",
    "pd-hef-paper",
    "pd-hef-trust0",
    "pd-hef-fixed-r",
    "pd-hef",
)
#: Set, split, how the card calls them.
PARTS = (
    ("one_car", "test", "the car of the vehicle file, test drives"),
    ("one_car", "extrapolation", "the same car, cells of manoeuvre, speed and friction that were held out"),
    ("other_cars", "test", "other cars of its kind with this car's vehicle file, test drives"),
)
LEAST_SAMPLES = 100


def errors_deg(folder: Path, split: str, vehicle: VehicleParameters, model: ModelBundle) -> dict[str, list[float]]:
    """Return the sideslip RMSE in degrees of every estimator on every drive of a split."""
    entries = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))["drives"]
    found: dict[str, list[float]] = {}
    for entry in entries:
        if entry.get("split") != split or "sha256" not in entry:
            continue
        drive = read_drive(folder / entry["file"], vehicle, entry["file"])
        ready, _ = runnable(ESTIMATORS, vehicle, drive.signals.available, model=model)
        for name, estimator in zip([e.name for e in ready], ready, strict=True):
            track, _ = estimator.run(drive.signals, None)
            error = np.degrees(signal_error(track, drive.truth, SIDESLIP, vehicle.low_speed_blend_m_s))
            error = error[np.isfinite(error)]
            if error.size >= LEAST_SAMPLES:
                found.setdefault(name, []).append(float(np.sqrt(np.mean(error**2))))
    return found


def table(found: dict[str, list[float]]) -> str:
    """Return a Markdown table: median, 10th and 90th percentile and pooled RMSE."""
    lines = ["| estimator | median ° | 10 % – 90 % ° | pooled ° | drives |", "| --- | --- | --- | --- | --- |"]
    for name, values in found.items():
        v = np.array(values)
        low, mid, high = np.quantile(v, [0.1, 0.5, 0.9])
        pooled = np.sqrt(np.mean(v**2))
        lines.append(f"| `{name}` | {mid:.3f} | {low:.3f} – {high:.3f} | {pooled:.3f} | {v.size} |")
    return "\n".join(lines)


def size_kb(folder: Path) -> float:
    """Return the size of everything in a folder."""
    return sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()) / 1024.0


def network_line(name: str, network: ModelBundle) -> str:
    """Say what a network is and how its training ended."""
    p: dict[str, Any] = network.provenance
    return (
        f"| {name} | {len(network.feature_names)} | {network.layers} × {network.hidden} |"
        f" {sum(w.size for w in network.weights.values()):,} | {p['epochs']} (best {p['best_epoch']}) |"
        f" {p['validation_loss']:.4f} | {p['test_loss']:.4f} |"
    )


def page(work: Path, folder: Path) -> str:
    """Return the card."""
    model, vehicle = load_bundle(folder), load_vehicle(folder / "vehicle.toml")
    manifest = json.loads((work / "dataset" / "manifest.json").read_text(encoding="utf-8"))
    recipe = model.provenance["recipe"]
    splits = ", ".join(f"{n} {s['drives']} drives" for n, s in manifest["splits"].items())
    networks = [network_line("residual network", model)]
    for name, bundle, place in (
        ("`pure-lstm`", model.pure_lstm, PURE_LSTM_FOLDER),
        ("paper's network", model.paper_network, PAPER_FOLDER),
    ):
        if bundle is not None:
            networks.append(network_line(f"{name} (`{place}`)", bundle))
    parts = []
    for place, split, words in PARTS:
        parts.append(f"### {words[0].upper()}{words[1:]}\n\n{table(errors_deg(work / place, split, vehicle, model))}\n")
    return f"""# Model card of the shipped model

Written by `python -m studies.model_card`; the model by `make train-default`.

- Place: `pdhef_logtool/models/default`, {size_kb(folder) / 1024.0:.2f} MB, sha256 `{model.sha256[:16]}…`.
- What it is for: the residual of the nominal single-track model of the simulated saloon (`vehicle.toml` beside it,
  with the filter noise that belongs to it). On another car its trust is capped by that car's vehicle file.
- Data: simulated, {DRIVES} drives of 12.5 s of that car (seed {SETS["one_car"][0]}), friction 0.3 to 1.0, 40 to
  120 km/h, sensors with METHOD's noise, biases and delays; friction is told by the simulator. {splits}; split by drive.
- Training: seed {recipe["seed"]}, one cycle up to a learning rate of {recipe["learning_rate"]:g}, on
  {model.provenance["training_hours"]:.2f} h of driving.

| network | features | LSTM | weights | epochs | validation loss | test loss |
| --- | --- | --- | --- | --- | --- | --- |
{chr(10).join(networks)}

Losses are mean squares of normalised targets. `pure-lstm` has another target: its losses compare with no other.

## Sideslip RMSE on drives that took no part

Sensors have METHOD's noise, biases and delays; friction is told.

{chr(10).join(parts)}
## Limits

- One family of simulated cars. It knows nothing of trucks, of worn dampers, of tyres near their temperature limit.
- Fishhooks are in no training drive; the condition table (`docs/conditions.md`) has them, faults, wrong friction, bank.
- Below the vehicle's low-speed limit the residual is switched off.
- What a real car brings is in `make real`; for yours: `pdhef identify`, `pdhef extract`, `pdhef train --init`.
"""


def main(arguments: list[str] | None = None) -> int:
    """Write the card."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--work", type=Path, default=Path("out/train-default"))
    parser.add_argument("--model", type=Path, default=HOME)
    parser.add_argument("--out", type=Path, default=Path("docs"))
    given = parser.parse_args(arguments)
    given.out.mkdir(parents=True, exist_ok=True)
    (given.out / "model_card.md").write_text(page(given.work, given.model), encoding="utf-8")
    print(given.out / "model_card.md")
    return 0


if __name__ == "__main__":
    sys.exit(main())
