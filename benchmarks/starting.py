"""Duration of a short run, and step time of the network.

A run of a 10 s log in a new process, with code compiled before: metrics only, and all outputs. The network is compared
with PyTorch over the same steps and with the same result; the hybrid filter (with parallel filter and network) with the
physics filter alone, all parts on.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np

from benchmarks.filtering import R_STD, STEPS, drive
from benchmarks.measuring import CACHE, ROOT, Row, best_seconds
from pdhef_logtool.car.car import SHIPPED_CARS, Car
from pdhef_logtool.car.vehicle import PhysicsParts
from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.physics_filter import PhysicsFilter
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.residual_model.bundle import SHIPPED_FOLDERS, ModelBundle, load_bundle
from pdhef_logtool.residual_model.service import NetworkService

_LOG = ROOT / "sample_logs" / "dlc.mcap"
#: Steps of one pass of PyTorch, as the service had them.
_BLOCK_STEPS = 256
_LIGHT = ("--keep", "metrics", "--no-report")


def _start(*words: str) -> None:
    output = CACHE / "start"
    shutil.rmtree(output, ignore_errors=True)
    command = [sys.executable, "-m", "pdhef_logtool", "run", str(_LOG), "--car", "saloon", "-o", str(output), *words]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, env=environment)


def said_by_torch(bundle: ModelBundle, features: FloatArray) -> FloatArray:
    """Return what PyTorch makes of features [N, 28], block by block, both sides at a time: residual rates [N, 2]."""
    import torch

    from pdhef_logtool.residual_model.network import Architecture, ResidualNetwork

    torch.set_num_threads(1)
    network = ResidualNetwork(Architecture(len(bundle.feature_names), bundle.hidden, bundle.layers, bundle.head))
    network.load_state_dict({name: torch.from_numpy(np.array(w)) for name, w in bundle.weights.items()})
    network.eval()
    rows = bundle.normalise(features)
    both = np.stack([rows, rows * bundle.signs]).astype(np.float32)
    parts, state = [], None
    with torch.inference_mode():
        for index in range(0, len(rows), _BLOCK_STEPS):
            output, state = network(torch.from_numpy(both[:, index : index + _BLOCK_STEPS].copy()), state)
            parts.append(output.numpy().astype(np.float64))
    straight, mirrored = np.concatenate(parts, axis=1)
    return np.asarray(0.5 * (straight - mirrored) * np.array(bundle.normalisation.target_std))


def _features(bundle: ModelBundle) -> FloatArray:
    n, rng = bundle.normalisation, np.random.default_rng(0)
    features = np.zeros((STEPS, 28))
    spread = rng.standard_normal((STEPS, len(n.feature_mean)))
    features[:, bundle.columns] = np.array(n.feature_mean) + np.array(n.feature_std) * spread
    return features


def rows() -> list[Row]:
    """Measure."""
    bundle = load_bundle(SHIPPED_FOLDERS["default"])
    network, features, starts = NetworkService(bundle), _features(bundle), np.zeros(STEPS, dtype=np.bool_)
    ours, _ = network.run(features, starts, None)
    if not np.allclose(ours, said_by_torch(bundle, features), rtol=0.0, atol=1e-5):
        raise SystemExit("the compiled network and PyTorch disagree")
    signals = drive(STEPS)
    vehicle = Car.load(SHIPPED_CARS["saloon"]).vehicle
    parts = PhysicsParts(**dict.fromkeys(PhysicsParts.model_fields, True))
    physics = PhysicsFilter(vehicle.model_copy(update={"physics": parts}), r_std=R_STD)
    hybrid = AdaptivePhysics(physics, network, 1.0, adaptive=False)
    bank = replace(hybrid, adaptive=True)
    seconds = best_seconds(
        {
            "light": lambda: _start(*_LIGHT),
            "all": _start,
            "network": lambda: network.run(features, starts, None),
            "torch": lambda: said_by_torch(bundle, features),
            "physics": lambda: physics.run(signals, None),
            "hybrid": lambda: run_window(hybrid, signals),
            "bank": lambda: run_window(bank, signals),
        }
    )
    step = {name: 1e6 * s / STEPS for name, s in seconds.items()}
    return [
        Row("a new process runs 10 s, figures", seconds["light"], "s", 2.0, command=f"pdhef run {' '.join(_LIGHT)}"),
        Row("a new process runs 10 s, all outputs", seconds["all"], "s", command="pdhef run"),
        Row("network, both sides", step["network"], "µs/step", peers={"PyTorch": step["torch"] / step["network"]}),
        Row("hybrid: both filters and the network, all states", step["hybrid"], "µs/step", 2.0 * step["physics"] + 4.0),
        Row("hybrid with its bank of three filters", step["bank"], "µs/step"),
    ]
