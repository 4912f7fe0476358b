"""Machine code made before it is needed, in several processes at once: each compiles parts, and all keep them.

A part is compiled by running it over two seconds of a straight road that nobody recorded.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.presets import preset_of
from pdhef_logtool.estimators.table import Options, all_names, make_estimator
from pdhef_logtool.records.signals import ALIGNED_SIGNALS, Signals
from pdhef_logtool.workers.supervisor import Tell, can_fork, supervise

#: Parts that are no estimators: the filter of ``physics``, and what runs beside it over every drive.
_FILTER, _CHECKS = "filter", "checks"
#: The presets that are made of the filter.
_FILTERED = ("physics", "pd-hef", "pd-hef-smoothed")
#: By part the function that is compiled last. The longest parts come first.
_LAST = {
    "phy-ukf": "phy_ukf._filter",
    _FILTER: "physics_filter._filter",
    "pd-hef-smoothed": "smoothed._smooth",
    "pd-hef-paper": "hybrid_paper._filter",
    _CHECKS: "error_features._advance",
}
_STEP_NS, _STEPS = 10_000_000, 100


def compile_for(names: Sequence[str]) -> None:
    """Compile what estimators need most time for, in several processes, if it is not kept already."""
    from pdhef_logtool.compiled import cache

    wanted = {*names, _CHECKS, *([_FILTER] if set(map(preset_of, names)) & set(_FILTERED) else [])}
    parts = [part for part, last in _LAST.items() if part in wanted and not cache.is_kept(last)]
    if min(len(parts), _processors()) > 1 and cache.kept_in() is not None and can_fork():
        with suppress(OSError, RuntimeError):  # the run compiles in its own process where no others can be started
            compile_parts(parts)


def all_parts() -> tuple[str, ...]:
    """Return all parts, the longest first."""
    return (*_LAST, *(name for name in all_names(Car.load("saloon")) if name not in _LAST))


def compile_part(part: str, tell: Tell) -> None:
    """Compile one part."""
    del tell
    if part == _FILTER:
        _compile_filter()
    elif part == _CHECKS:
        _compile_checks()
    else:
        estimator, state = make_estimator(part, Car.load("saloon"), Options(gnss=True)), None
        for window in _windows():
            _, state = run_window(estimator, window, state)


def compile_parts(parts: Sequence[str], work: Callable[[str, Tell], None] = compile_part) -> None:
    """Compile parts in as many processes as there are processors; an error shows where the part is used."""
    from pdhef_logtool.compiled import cache

    cache.announce()
    preload = ("pdhef_logtool.estimators.*", "pdhef_logtool.compiled.cache:be_silent", work.__module__)
    list(supervise(work, parts, jobs=min(_processors(), len(parts)), preload=preload))


def _compile_filter() -> None:
    from pdhef_logtool.estimators.physics_filter import of_car

    # The gate of the wheels' speed is one of the checks.
    run_window(replace(of_car(Car.load("saloon")), slip_gate=False), _windows()[0])


def _compile_checks() -> None:
    from pdhef_logtool.estimators.divergence import wrong_branch
    from pdhef_logtool.estimators.error_features import error_terms
    from pdhef_logtool.estimators.sensor_faults import find_faults
    from pdhef_logtool.estimators.speed_slip import without_slip
    from pdhef_logtool.residual_model.features import FEATURES

    car, signals = Car.load("saloon"), _windows()[0]
    _compile_algebra()
    without_slip(signals, car.vehicle.sensors, None)
    find_faults(signals, car.vehicle, None)
    if car.network is not None:
        features = np.zeros((len(signals), len(FEATURES)))
        Options().service(car).run(features, np.zeros(len(signals), dtype=np.bool_), None)
    track, _ = run_window(make_estimator("zero", car), signals)
    wrong_branch(track, signals, car.vehicle)
    error_terms(track, signals, car.vehicle.roll_gradient_rad_per_m_s2, None)


def _compile_algebra() -> None:
    """Compile what the filter calls last, while another process compiles what it calls first."""
    from numba import typeof

    from pdhef_logtool.estimators.unscented import whiten, wide_root

    vector, matrix, whole, flags = np.zeros(1), np.zeros((1, 1)), np.zeros(1, dtype=np.int64), np.zeros(1, dtype=bool)
    wide_root.compile(tuple(map(typeof, (matrix, whole, flags, matrix))))
    whiten.compile(tuple(map(typeof, (vector, matrix, flags, whole, matrix, vector))))


def _windows() -> tuple[Signals, Signals]:
    """Return two windows of driving, each of :data:`_STEPS` stamps."""
    stamps = np.arange(2 * _STEPS, dtype=np.int64) * _STEP_NS + 10**18
    steer = 0.01 * np.sin(6.0 * np.arange(2 * _STEPS) * _STEP_NS * 1e-9)
    speed = np.full(2 * _STEPS, 22.0)
    signals = Signals(
        stamps_ns=stamps, ready_ns=stamps + _STEP_NS // 2, steer_rad=steer, ax_m_s2=np.zeros(2 * _STEPS),
        ay_m_s2=80.0 * steer, yaw_rate_rad_s=4.0 * steer, speed_m_s=speed, friction=np.full(2 * _STEPS, 0.8),
        wheel_speed_m_s=np.tile(speed[:, None], 4), available=frozenset(ALIGNED_SIGNALS),
    )  # fmt: skip
    return signals.rows(0, _STEPS), signals.rows(_STEPS, 2 * _STEPS)


def _processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
