"""Registry of estimators: a line of :data:`SPECS` and a file with the builder of each.

A name is a preset: ``build`` returns the algorithm for a car and options (:mod:`~.algorithm`).

Another package adds an estimator by an entry point of the group :data:`ENTRY_POINTS` that names its :class:`Spec`. It
receives read-only signals, and its errors are contained (:mod:`~.plug_ins`). Example::

    # half_slip.py, of a package whose pyproject.toml has
    # [project.entry-points."pdhef.estimators"]
    # half-slip = "half_slip:SPEC"
    from dataclasses import dataclass

    from pdhef_logtool.car.vehicle import VehicleParameters
    from pdhef_logtool.estimators.base import make_steps
    from pdhef_logtool.estimators.stepwise import measured_speed
    from pdhef_logtool.estimators.table import Spec


    @dataclass(frozen=True)
    class HalfSlip:
        algorithm = "half-slip"
        version = 1

        vehicle: VehicleParameters
        name: str = "half-slip"
        causal: bool = True

        def run(self, signals, state):
            vx, state = measured_speed(signals, self.vehicle.sensors.speed_hold_s, state)
            yaw_rate = signals.yaw_rate_rad_s
            vy = 0.5 * self.vehicle.cg_to_rear_axle_m * yaw_rate
            return make_steps(vx, vy, yaw_rate), state


    def build(name, car, options):
        return HalfSlip(car.vehicle, name)


    NEEDS = frozenset({"speed_m_s", "yaw_rate_rad_s"})
    SPEC = Spec("half-slip", "half of the sideslip without tyre slip", build, NEEDS, 0x123456)
"""

import re
import sys
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib import import_module
from itertools import chain
from typing import TYPE_CHECKING, Any, Final, Literal, cast

from pdhef_logtool.estimators.plug_ins import contained, package_of
from pdhef_logtool.estimators.presets import (
    AIDED,
    OPEN_LOOP,
    SELF_CALIBRATED,
    Options as Options,
    preset_of,
    uses_calibration,
)
from pdhef_logtool.records.errors import EstimatorError, UsageError
from pdhef_logtool.records.printable import printable
from pdhef_logtool.records.signals import has_gnss
from pdhef_logtool.residual_model.bundle import NOMINAL_MODEL

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car
    from pdhef_logtool.estimators.base import Estimator

#: Inputs of the vehicle model; a filter uses a_y and yaw rate if the log has them, ``physics`` steering too.
_SPEED = frozenset({"speed_m_s"})
_INPUTS = _SPEED | {"steer_rad"}
_PLANAR = _SPEED | {"yaw_rate_rad_s"}
_PLANAR_IMU = frozenset({"yaw_rate_rad_s", "ay_m_s2"})
_LATERAL = _PLANAR_IMU | {"steer_rad"}
#: Signals for the features of a network.
FEATURES: frozenset[str] = _INPUTS | _PLANAR_IMU


@dataclass(frozen=True, slots=True)
class Spec:
    """One estimator.

    Attributes
    ----------
    build : called with the name, the :class:`Car` and :class:`Options`: a function, or ``module:function`` under
        :mod:`pdhef_logtool.estimators`, imported when it is first needed. A class is called with vehicle and name.
    needs : required aligned signals. one_of : signals; it requires at least one of them, unless empty.
    colour : 0xRRGGBB in every plot, distinguishable with any colour vision (Okabe and Ito 2008; Tol's muted scheme).
    causal : whether an estimate at t uses only samples available at t.
    group : :data:`ALL_ESTIMATORS` or :data:`PEERS`, which name all of their estimators, or empty.
    network : required part of a network bundle; empty: no part; ``optional``: it also runs without.
    needs_noise : whether it requires filter noise in the car.
    """

    name: str
    text: str
    build: "str | Callable[[str, Car, Options], Estimator]"
    needs: frozenset[str]
    colour: int
    causal: bool = True
    group: Literal["all", "peers", ""] = "all"
    network: Literal["", "optional", "residual", "paper", "pure_lstm", "linear_regression"] = ""
    needs_noise: bool = False
    one_of: frozenset[str] = frozenset()

    def lacking(self, available: frozenset[str]) -> list[str]:
        """Return the required signals that a log does not provide."""
        return sorted(self.needs - available | (self.one_of if self.one_of.isdisjoint(available) else frozenset()))

    def missing(self, car: "Car") -> str:
        """Return why it cannot run on a car, empty if it can."""
        if self.name == OPEN_LOOP and car.self_calibrated is None:
            return "the log has not calibrated its car"
        if preset_of(self.name) in SELF_CALIBRATED:
            car = car.calibrated_car
        if self.needs_noise and self.name not in car.noise:
            return f"the car has no noise for {self.name} in fit.toml"
        if self.network in ("", "optional"):
            return ""
        if car.network is None:
            return "no network; --network names one, pdhef train writes one"
        if self.network == "residual":
            return "" if car.residual_network is not None else "the network is for phy-ukf; pdhef train writes another"
        if self.network == "paper":
            has = car.network.paper_network is not None or car.network.model == NOMINAL_MODEL
            return "" if has else "no network of the paper's design; pdhef train --paper writes one"
        if getattr(car.network, self.network) is None:
            return "the network has no such baseline (docs/estimators.md)"
        return ""

    def make(self, car: "Car", options: Options) -> "Estimator":
        """Build the estimator; compiled code is only imported here.

        Raises
        ------
        UsageError
            The car lacks a required part.
        """
        if reason := self.missing(car):
            raise UsageError(expected="a car with all required parts", got=reason, where=self.name)
        build: Any = self.build
        if isinstance(build, str):
            module, _, function = build.partition(":")
            build = getattr(import_module(f"{__package__}.{module}"), function)
        calibration = car.self_calibrated if uses_calibration(self.name) else None
        car = car if calibration is None else car.calibrated_car
        estimator = build(car.vehicle, self.name) if isinstance(build, type) else build(self.name, car, options)
        if options.gnss and self.name in AIDED:
            from pdhef_logtool.estimators.gnss_aided import GnssAided

            estimator = GnssAided(estimator)
        if calibration is not None:
            estimator = replace(estimator, causal=self.causal and calibration.causal)
        return cast("Estimator", estimator)


#: Estimators of other packages: each entry point names a :class:`Spec`.
ENTRY_POINTS = "pdhef.estimators"
#: Modules that the fork server of workers has loaded.
FILTERS = ("pdhef_logtool.estimators.*", "pdhef_logtool.compiled.cache:load_kept")
#: Groups, in place of names: the estimators of this tool and published ones, as far as they can run on the car.
ALL_ESTIMATORS: Final = "all"
PEERS: Final = "peers"
#: The estimator whose name has a number, and its names.
GAIN, _GAINS = "pd-hef:gain=1", re.compile(r"pd-hef:gain=(0(\.\d*)?|\.\d+|1(\.0*)?)")
#: Estimators of this package, in the order of the tables. A preset with an option has an entry if it differs.
SPECS: tuple[Spec, ...] = (
    Spec("zero", "sideslip 0; speed, yaw rate and lateral acceleration from the sensors",
         "pass_through:PassThrough", _PLANAR, 0xF0E442),
    Spec("zero:no-lateral", "the sensors passed through; claims no lateral velocity",
         "pass_through:PassThrough", _PLANAR, 0xCC79A7),
    Spec("kinematic", "leaky integral of a_y - v_x r", "kinematic:Kinematic", _PLANAR | {"ay_m_s2"}, 0x009E73),
    Spec("open-loop", "nominal single-track model from steering and speed alone",
         "open_loop:OpenLoop", _INPUTS, 0xE69F00),
    Spec(OPEN_LOOP, "open-loop on the car calibrated by its log, without ground truth: not causal",
         "open_loop:OpenLoop", _INPUTS, 0x661100, causal=False),
    Spec("linear-regression", "sideslip linear in the network's features, low-passed at 2 Hz (needs such a model)",
         "direct_network:build", FEATURES, 0xDDCC77, network="linear_regression"),
    Spec("phy-ukf", "unscented Kalman filter on the nominal model, sensor-level noise (frozen baseline)",
         "vehicle_ukf:build_nominal", _INPUTS, 0x0072B2),
    Spec("physics", "best filter with physics only, with the model parts supported by driving data",
         "adaptive_physics:build", _SPEED, 0x44AA99, one_of=_LATERAL),
    Spec("phy-ukf:tuned", "phy-ukf with the noise of an identified car, corrected for body roll",
         "vehicle_ukf:build_nominal", _INPUTS, 0x56B4E9, needs_noise=True),
    Spec("pure-lstm", "a network that outputs v_y, without a filter (needs such a model)",
         "direct_network:build", FEATURES, 0xAA4499, network="pure_lstm"),
    Spec("pd-hef", "physics plus the residual of the car's network, within its region of validity",
         "pd_hef:build", _SPEED, 0xD55E00, network="optional", one_of=_LATERAL),
    Spec("pd-hef:fixed-r", "pd-hef at gain 1 without the adaptive mechanism (needs a network)",
         "pd_hef:build", _INPUTS, 0x117733, network="residual"),
    Spec("pd-hef-smoothed", "pd-hef smoothed with later samples: not causal, ranked apart",
         "pd_hef:build_smoothed", _SPEED, 0x332288, causal=False, network="optional", one_of=_LATERAL),
    Spec(GAIN, "pd-hef at a residual gain from 0 to 1 on any car (needs a network)",
         "pd_hef:build", _INPUTS, 0x882255, group="", network="residual"),
    Spec("pd-hef-paper", "the paper's hybrid filter with its adaptive mechanism, unchanged (needs its network)",
         "hybrid_paper:build", FEATURES, 0xCC6677, network="paper"),
    Spec("linear-kf", "peer: Kalman filter on the linear single track (Leanza et al. 2021)",
         "peers.linear_kf:LinearKalman", _INPUTS, 0x7F7F7F, group=PEERS, one_of=_PLANAR_IMU),
    Spec("linear-kf:open-loop", "peer: linear single track from steering and speed alone (Riekert and Schunck 1940)",
         "peers.linear_kf:LinearKalman", _INPUTS, 0xBBBBBB, group=PEERS),
    Spec("learned-single-track", "peer: single track with parameters learned from the yaw rate (openpilot's paramsd)",
         "peers.learned_single_track:LearnedSingleTrack", _INPUTS | _PLANAR, 0x999933, group=PEERS),
    Spec("slip-ukf", "peer: unscented Kalman filter over speed and sideslip with axle forces (Goblirsch et al. 2024)",
         "peers.slip_ukf:SlipUkf", FEATURES, 0x6699CC, group=PEERS),
    Spec("washout", "peer: kinematic with a leak to the stationary single track (Piyabongkarn et al. 2009)",
         "peers.washout:Washout", FEATURES, 0x88CCEE, group=PEERS),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Skipped:
    """An estimator that cannot run, and why; ``is_error``: its plug-in failed."""

    spec: Spec
    reason: str
    is_error: bool = False

    @property
    def name(self) -> str:
        """Name of the estimator."""
        return self.spec.name


@cache
def all_specs() -> tuple[Spec, ...]:
    """Return the estimators of this package, then those that installed packages add by entry point.

    An entry point that cannot be loaded, or adds a name that exists, is left out with a warning on stderr.
    """
    from importlib.metadata import entry_points

    specs = list(SPECS)
    for entry in sorted(entry_points(group=ENTRY_POINTS), key=lambda entry: entry.name):
        reason = ""
        try:
            with contained(entry.name, entry.module):
                spec = entry.load()
        except EstimatorError as error:
            reason = error.got
        else:
            if not isinstance(spec, Spec):
                reason = f"got {type(spec).__name__}, expected {Spec.__module__}.Spec"
            elif spec.name in {s.name for s in specs}:
                reason = f"an estimator named {spec.name} exists"
        if reason:
            where = f"entry point {entry.name} = {entry.value} ({ENTRY_POINTS})"
            sys.stderr.write(f"pdhef: {printable(f'{where} is not used: {reason}')}\n")
        else:
            specs.append(spec)
    return tuple(specs)


def spec_of(name: str) -> Spec:
    """Return the spec of a name; raises UsageError for an unknown name."""
    check_names((name,))
    lines = {s.name: s for s in all_specs()}
    return lines[name] if name in lines else replace(lines[GAIN], name=name)


def check_names(names: Sequence[str]) -> None:
    """Raise UsageError for an unknown or repeated name, and for no names."""
    existing = [ALL_ESTIMATORS, PEERS, *(s.name for s in all_specs())]
    wrong = [n for n in names if n not in existing and not _GAINS.fullmatch(n)]
    wrong += sorted({n for n in names if names.count(n) > 1})
    if wrong or not names:
        expected = f"estimators out of {', '.join(existing)} (0 to 1)"
        raise UsageError(expected=expected, got=", ".join(wrong) or "none", where="--estimators")


def all_names(car: "Car", group: str = ALL_ESTIMATORS) -> tuple[str, ...]:
    """Return the estimators of a group: those that find all required parts in the car.

    Baselines and physics first, then estimators with a network.
    """
    suited = [s for s in all_specs() if s.group == group and not s.missing(car)]
    return tuple(s.name for s in sorted(suited, key=lambda s: bool(s.network)))


def make_estimator(name: str, car: "Car", options: Options | None = None) -> "Estimator":
    """Build an estimator by its name; raises UsageError if the car lacks a required part."""
    return spec_of(name).make(car, options or Options())


def runnable(
    names: Sequence[str],
    car: "Car",
    available: frozenset[str],
    options: Options | None = None,
    refused: Collection[str] = (),
) -> "tuple[list[Estimator], list[Skipped]]":
    """Build the estimators that car and log allow; return these, and the skipped ones with their reasons.

    Parameters
    ----------
    names : of estimators and groups. available : signals of the log.
    refused : signals of the log that failed a check and are not used.
    """
    options = options or Options()
    options = replace(options, gnss=options.gnss and has_gnss(available), steers="steer_rad" in available)
    estimators: list[Estimator] = []
    skipped: list[Skipped] = []
    named = (all_names(car, name) if name in (ALL_ESTIMATORS, PEERS) else (name,) for name in names)
    for spec in map(spec_of, dict.fromkeys(chain.from_iterable(named))):
        lacking = spec.lacking(available)
        bad = sorted(_sources_of(lacking, refused))
        lacks = f"a check of {', '.join(bad)} failed" if bad else f"the log has no {', '.join(lacking)}"
        reason = spec.missing(car) or (lacks if lacking else "")
        if reason:
            skipped.append(Skipped(spec, reason))
            continue
        try:
            with contained(spec.name, package_of(spec.build)):
                estimators.append(spec.make(car, options))
        except EstimatorError as error:
            skipped.append(Skipped(spec, f"failed: {error}", is_error=True))
    return estimators, skipped


def _sources_of(aligned: Sequence[str], refused: Collection[str]) -> set[str]:
    """Return the refused signals that may be the source of aligned ones: steering and wheel angles have two names."""
    stems = {name.partition("_")[0] for name in aligned} | ({"wheel", "gnss"} if "speed_m_s" in aligned else set())
    return {name for name in refused if name in aligned or name.partition("_")[0] in stems}
