"""``pd-hef`` and its variants: ``physics`` of the car plus residual gain times the network's residual.

The network acts on the car that it was trained for; without such a network the gain is 0, and ``pd-hef`` equals
``physics``.
"""

from dataclasses import replace

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import SMOOTHING
from pdhef_logtool.estimators.adaptive_physics import RESIDUAL_NOISE, AdaptivePhysics
from pdhef_logtool.estimators.presets import Options, options_of
from pdhef_logtool.estimators.smoothed import NOT_CAUSAL, SmoothedPhysics, for_smoothing
from pdhef_logtool.estimators.vehicle_ukf import of_car
from pdhef_logtool.residual_model.interface import PlugInModel

FILTER_ALONE = "taught residual not used: it was fitted to the error of the filter, which differs from the smoother's"


def build(name: str, car: Car, options: Options) -> AdaptivePhysics:
    """Return ``physics`` of a car with its taught residual, or with its network.

    The residual gain of the network comes from the name or the car; a name with options selects the network.
    """
    model = car.model
    if name == "pd-hef" and model is not None and model.residual is not None:
        physics = AdaptivePhysics(of_car(car, use_speed=options.use_speed), name=name)
        if (car.fitted_physics is not None) == model.calibrated:
            return replace(physics, network=model.residual, trust=1.0, notes=(model.evidence,))
        state, other = ("calibrated", "not calibrated") if model.calibrated else ("not calibrated", "calibrated")
        return replace(physics, notes=(f"residual gain 0: it belongs to a {state} car, this drive has one {other}",))
    return _with_network(name, car, options)


def _with_network(name: str, car: Car, options: Options) -> AdaptivePhysics:
    """Return ``physics`` of a car with its network."""
    gain, note = _gain(name, car) if options.steers else (0.0, "a network needs the steering")
    physics = of_car(car, use_speed=options.use_speed)
    notes = (f"residual gain {gain:g}: {note}",) if note else ()
    alone = AdaptivePhysics(physics, adaptive="fixed-r" not in options_of(name), name=name, notes=notes)
    if gain == 0.0:
        return alone
    network = car.network.plug_in if isinstance(car.network, PlugInModel) else car.network
    noise = RESIDUAL_NOISE if alone.adaptive and car.fitted_physics is not None else 1.0
    return replace(alone, network=network, trust=gain, residual_noise=noise)


def build_smoothed(name: str, car: Car, options: Options) -> SmoothedPhysics:
    """Return the smoothed filter, with the noise for smoothing; ``name`` is the name of the result."""
    filtered = _with_network(name, car, options)
    factors = SMOOTHING if car.fitted_physics is None else car.fitted_physics.smoothing
    filtered = replace(filtered, physics=for_smoothing(filtered.physics, factors), residual_noise=1.0)
    taught = () if car.model is None or car.model.residual is None else (FILTER_ALONE,)
    return SmoothedPhysics(filtered, name=name, notes=(NOT_CAUSAL, *taught, *filtered.notes))


def _gain(name: str, car: Car) -> tuple[float, str]:
    """Return the residual gain of the network, and a note; empty for a gain that the name states."""
    if car.residual_network is None:
        return 0.0, "the car has no network" if car.network is None else "the network is for phy-ukf, as in the paper"
    if chosen := options_of(name):
        return float(chosen.get("gain", 1.0)), ""
    gain = car.residual_gain
    return gain, "within its region of validity" if gain else "the network was not trained with the physics of this car"
