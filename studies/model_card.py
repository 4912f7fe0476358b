"""docs/model_card.md: what the shipped model was made of, how good it is on drives that it never saw, and its limits.

    python -m studies.model_card [--work out/train-default] [--car saloon] [--out docs]

Every figure is computed here from the logs that ``studies.defaults.train_default`` simulated and the model that it
wrote.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.estimators.table import runnable
from pdhef_logtool.residual_model.bundle import PAPER_FOLDER, PURE_LSTM_FOLDER, ModelBundle
from studies.condition_drives import drives_of, read_drive, root_mean_square, sideslip_error
from studies.defaults.train_default import DRIVES, SETS
from studies.pages import options, table, write

ESTIMATORS = ("zero", "linear-regression", "phy-ukf", "phy-ukf:tuned", "physics", "pure-lstm", "pd-hef-paper",
              "pd-hef:fixed-r", "pd-hef")  # fmt: skip
#: Set, split, how the card calls them.
PARTS = (
    ("one_car", "test", "the car of the vehicle file, test drives"),
    ("one_car", "extrapolation", "the same car, cells of manoeuvre, speed and friction that were held out"),
    ("other_cars", "test", "other cars of its kind with this car's vehicle file, test drives"),
)
LEAST_SAMPLES = 100


def errors_deg(folder: Path, split: str, car: Car) -> dict[str, list[float]]:
    """Return the sideslip RMSE in degrees of every estimator on every drive of a split."""
    errors: dict[str, list[float]] = {}
    for entry in drives_of(folder, split):
        drive = read_drive(folder / entry["file"], car)
        ready, _ = runnable(ESTIMATORS, car, drive.signals.available)
        for estimator in ready:
            error = np.degrees(sideslip_error(estimator, drive))
            if np.count_nonzero(np.isfinite(error)) >= LEAST_SAMPLES:
                errors.setdefault(estimator.name, []).append(root_mean_square(error))
    return errors


def error_table(errors: dict[str, list[float]]) -> str:
    """Return a Markdown table: median, 10th and 90th percentile and pooled RMSE."""
    body = []
    for name, values in errors.items():
        low, mid, high = np.quantile(values, [0.1, 0.5, 0.9])
        body.append(
            [
                f"`{name}`",
                f"{mid:.3f}",
                f"{low:.3f} – {high:.3f}",
                f"{np.sqrt(np.mean(np.square(values))):.3f}",
                str(len(values)),
            ]
        )
    return table(["estimator", "median °", "10 % – 90 % °", "pooled °", "drives"], body)


def network_line(name: str, network: ModelBundle) -> list[str]:
    """Return what a network is and how its training ended."""
    p: dict[str, Any] = network.provenance
    shape = (str(len(network.feature_names)), f"{network.layers} × {network.hidden}")
    weights = f"{sum(w.size for w in network.weights.values()):,}"
    losses = (f"{p['validation_loss']:.4f}", f"{p['test_loss']:.4f}")
    return [name, *shape, weights, f"{p['epochs']} (best {p['best_epoch']})", *losses]


def page(work: Path, car: Car) -> str:
    """Return the card."""
    model, folder = car.network, car.source
    assert model is not None and folder is not None
    size = sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())
    manifest = json.loads((work / model.model / "manifest.json").read_text(encoding="utf-8"))
    recipe = model.provenance["recipe"]
    splits = ", ".join(f"{n} {s['drives']} drives" for n, s in manifest["splits"].items())
    networks = [network_line("residual network", model)]
    for name, bundle, place in (
        ("`pure-lstm`", model.pure_lstm, PURE_LSTM_FOLDER),
        ("paper's network", model.paper_network, PAPER_FOLDER),
    ):
        if bundle is not None:
            networks.append(network_line(f"{name} (`{place}`)", bundle))
    parts = [
        f"### {words[0].upper()}{words[1:]}\n\n{error_table(errors_deg(work / place, split, car))}\n"
        for place, split, words in PARTS
    ]
    return f"""# Model card of the shipped model

This page describes the shipped network. Command: `python -m studies.model_card`; training: `make train-default`.

- Place: `pdhef_logtool/models/default`, {size / 2**20:.2f} MB, sha256 `{model.sha256[:16]}…`.
- Purpose: residual of `physics` of the simulated saloon (`vehicle.toml` and `fit.toml` beside it). On another car its
  residual gain is limited by validation data of that car; on this one the limit is {car.allowed_trust.cap:g}. The
  baselines in its folder use the nominal model.
- Data: simulated, {DRIVES} drives of 12.5 s of that car (seed {SETS["one_car"][0]}), friction 0.3 to 1.0, 40 to
  120 km/h, sensors with [errors](method.md#sensors); the simulator provides the friction. {splits}; split by drive.
- Training: seed {recipe["seed"]}, one cycle up to a learning rate of {recipe["learning_rate"]:g}, on
  {model.provenance["training_hours"]:.2f} h of driving.

{table(["network", "features", "LSTM", "weights", "epochs", "validation loss", "test loss"], networks)}

Losses are mean squares of normalised targets. `pure-lstm` has a different target, so its losses are not comparable.

## Sideslip RMSE on test drives

Sensors have [errors](method.md#sensors); the true friction is given.

{chr(10).join(parts)}
## Limits

- The training drives are of one family of simulated cars, without trucks, worn dampers or overheated tyres.
- No training drive is a fishhook; [conditions](conditions.md) contains fishhooks, faults, wrong friction and bank.
- Below the vehicle's low-speed limit the residual is switched off.
- Acts on no real car without validation data ([peers](peers.md), [teaching](teaching.md)): `pdhef learn`.
- A network for all cars is not shipped: trained on 300 simulated cars, it had 0.966 times the error of calibrated
  `physics` in the geometric mean of seven real cars (95 % 0.92 to 1.01), and 1.08 times on the V40 (commit 695708d).
"""


def main(arguments: list[str] | None = None) -> None:
    """Write the card."""
    parser = options("model_card", __doc__)
    parser.add_argument("--work", type=Path, default=Path("out/train-default"))
    parser.add_argument("--car", default="saloon")
    parser.add_argument("--out", type=Path, default=Path("docs"))
    given = parser.parse_args(arguments)
    write(given.out / "model_card.md", page(given.work, Car.load(given.car)))


if __name__ == "__main__":
    main()
