"""Estimators by the names that the command line and the tables use."""

from __future__ import annotations

from dataclasses import dataclass

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.residual_model.bundle import ModelBundle

#: Name and one line on each, in the order of the tables.
DESCRIPTIONS: dict[str, str] = {
    "zero": "sideslip 0; speed, yaw rate and lateral acceleration from the sensors",
    "gyro": "the sensors passed through; claims no lateral velocity",
    "kinematic": "leaky integral of a_y - v_x r",
    "open-loop": "nominal single-track model from steering and speed alone",
    "linear-regression": "sideslip linear in the network's features, low-passed at 2 Hz (needs a model with baselines)",
    "phy-ukf": "unscented Kalman filter on the nominal model, sensor-level noise (frozen baseline)",
    "phy-ukf-tuned": "the same with the noise of an identified vehicle file, corrected for body roll",
    "physics-plus": "the strongest filter on physics alone: lagging axle forces, load transfer, roll, biases",
    "pure-lstm": "a network that says v_y itself, from the same inputs, no filter (needs a model with baselines)",
    "pd-hef": "hybrid filter that finds faulty sensors and scales wrong forces (needs a model)",
    "pd-hef-fixed-r": "hybrid filter: nominal model plus the network's residual, trust 1, fixed noise (needs a model)",
    "pd-hef-trust0": "the hybrid filter with its network switched off (needs a model)",
    "pd-hef-trust1": "the hybrid filter at trust 1, whatever the vehicle file allows (needs a model)",
    "pd-hef-smoothed": "the hybrid filter smoothed with what came later: not causal, ranked apart (needs a model)",
    "pd-hef-paper": "the paper's hybrid filter with its adaptive mechanism, to the letter (needs a model)",
}
#: Names that stand for another estimator, under whose name it runs.
ALIASES: dict[str, str] = {}

DEFAULT_ESTIMATORS = ("zero", "gyro", "kinematic", "open-loop", "phy-ukf", "physics-plus")
#: Run by default as well where the vehicle file has what it needs.
TUNED_ESTIMATORS = ("phy-ukf-tuned",)
#: Trust of the hybrid filters by name; they need a model.
HYBRID_TRUST = {"pd-hef-fixed-r": 1.0, "pd-hef-trust0": 0.0, "pd-hef-trust1": 1.0}
#: Every estimator that needs a model.
MODEL_ESTIMATORS = ("pd-hef", *HYBRID_TRUST, "pd-hef-smoothed", "pd-hef-paper", "pure-lstm", "linear-regression")
#: Those whose estimates use what comes later.
NOT_CAUSAL = ("pd-hef-smoothed",)
#: Run by default as well where a model is given that has what they need.
DEFAULT_MODEL_ESTIMATORS = (
    "linear-regression",
    "pure-lstm",
    "pd-hef",
    "pd-hef-fixed-r",
    "pd-hef-smoothed",
    "pd-hef-trust0",
    "pd-hef-paper",
)


@dataclass(frozen=True, slots=True)
class Skipped:
    """An estimator that cannot run on a log, and why."""

    name: str
    reason: str


def check_names(names: tuple[str, ...]) -> None:
    """Raise UsageError if a name is unknown or occurs twice."""
    meant = [ALIASES.get(n, n) for n in names]
    unknown = [n for n in meant if n not in DESCRIPTIONS]
    twice = sorted({n for n in meant if meant.count(n) > 1})
    if unknown or twice or not names:
        raise UsageError(
            expected=f"estimators out of {', '.join(DESCRIPTIONS)}",
            got=", ".join(unknown + twice) or "none",
            where="--estimators",
        )


def make_estimator(
    name: str, vehicle: VehicleParameters, *, use_speed: bool = True, model: ModelBundle | None = None
) -> Estimator:
    """Build an estimator; compiled code is imported here and not before.

    Parameters
    ----------
    name : one of :data:`DESCRIPTIONS` or :data:`ALIASES`.
    use_speed : False is the paper's ``esp`` suite for the filters (METHOD §1).
    model : the network; those of :data:`MODEL_ESTIMATORS` need it.
    """
    check_names((name,))
    name = ALIASES.get(name, name)
    if name in MODEL_ESTIMATORS:
        return _model_estimator(name, vehicle, use_speed, model)
    if name in ("zero", "gyro"):
        from pdhef_logtool.estimators.pass_through import PassThrough

        return PassThrough(name, claims_zero_sideslip=name == "zero")
    if name == "kinematic":
        from pdhef_logtool.estimators.kinematic import Kinematic

        return Kinematic()
    if name == "open-loop":
        from pdhef_logtool.estimators.open_loop import OpenLoop

        return OpenLoop(vehicle)
    if name == "phy-ukf-tuned":
        from pdhef_logtool.estimators.physics_tuned import physics_ukf_tuned

        return physics_ukf_tuned(vehicle, use_speed=use_speed)
    if name == "physics-plus":
        from pdhef_logtool.estimators.physics_plus import physics_plus

        return physics_plus(vehicle, use_speed=use_speed)
    from pdhef_logtool.estimators.physics import PhysicsUkf

    return PhysicsUkf(vehicle, use_speed=use_speed)


def _model_estimator(name: str, vehicle: VehicleParameters, use_speed: bool, model: ModelBundle | None) -> Estimator:
    missing = _missing_of_model(name, model)
    if missing or model is None:
        raise UsageError(expected="a model that has what it needs", got=missing, where=name)
    if name == "linear-regression" and model.linear_regression is not None:
        from pdhef_logtool.estimators.linear_regression import LinearRegression

        return LinearRegression(vehicle, model.linear_regression, use_speed=use_speed)
    from pdhef_logtool.residual_model.service import NetworkService

    if name == "pure-lstm" and model.pure_lstm is not None:
        from pdhef_logtool.estimators.direct_network import DirectNetwork

        return DirectNetwork(vehicle, NetworkService(model.pure_lstm), use_speed=use_speed)

    if name == "pd-hef":
        from pdhef_logtool.estimators.cautious import at_trust
        from pdhef_logtool.estimators.trust_policy import allowed_trust

        allowed = allowed_trust(vehicle, model)
        return at_trust(vehicle, NetworkService(model), allowed.cap, use_speed=use_speed, notes=(allowed.note,))
    if name == "pd-hef-smoothed":
        from pdhef_logtool.estimators.cautious import smoothed_at_trust
        from pdhef_logtool.estimators.trust_policy import allowed_trust

        allowed = allowed_trust(vehicle, model)
        return smoothed_at_trust(
            vehicle, NetworkService(model), allowed.cap, use_speed=use_speed, notes=(allowed.note,)
        )
    if name == "pd-hef-paper":
        from pdhef_logtool.estimators.hybrid_paper import PaperHybridUkf

        return PaperHybridUkf(vehicle, NetworkService(model.paper_network or model), use_speed=use_speed)
    from pdhef_logtool.estimators.hybrid import hybrid_ukf

    return hybrid_ukf(vehicle, NetworkService(model), trust=HYBRID_TRUST[name], use_speed=use_speed, name=name)


def _missing_of_model(name: str, model: ModelBundle | None) -> str:
    """Return why the model does not let an estimator run, empty if it does."""
    if name not in MODEL_ESTIMATORS:
        return ""
    if model is None:
        return "no network; --model names one, pdhef train writes one"
    baselines = {"pure-lstm": model.pure_lstm, "linear-regression": model.linear_regression}
    if name in baselines and baselines[name] is None:
        return "the model has no such baseline; pdhef train --baselines writes it"
    return ""


def default_names(vehicle: VehicleParameters, model: ModelBundle | None = None) -> tuple[str, ...]:
    """Return the estimators that run when none are named."""
    tuned = tuple(n for n in TUNED_ESTIMATORS if n in vehicle.filter)
    return DEFAULT_ESTIMATORS + tuned + tuple(n for n in DEFAULT_MODEL_ESTIMATORS if not _missing_of_model(n, model))


def runnable(
    names: tuple[str, ...],
    vehicle: VehicleParameters,
    available: frozenset[str],
    *,
    use_speed: bool = True,
    model: ModelBundle | None = None,
) -> tuple[list[Estimator], list[Skipped]]:
    """Split estimators into those whose needs the log meets and those that are skipped with the reason."""
    estimators: list[Estimator] = []
    skipped: list[Skipped] = []
    for name in (ALIASES.get(n, n) for n in names):
        if name in TUNED_ESTIMATORS and name not in vehicle.filter:
            skipped.append(Skipped(name, f"the vehicle file has no [filter.{name}]; pdhef identify writes one"))
            continue
        if reason := _missing_of_model(name, model):
            skipped.append(Skipped(name, reason))
            continue
        estimator = make_estimator(name, vehicle, use_speed=use_speed, model=model)
        missing = sorted(estimator.needs - available)
        if missing:
            skipped.append(Skipped(name, f"the log has no {', '.join(missing)}"))
        else:
            estimators.append(estimator)
    return estimators, skipped
