"""Names of estimators: a preset, with options after a colon, such as ``pd-hef:gain=1,fixed-r``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from pdhef_logtool.records.errors import UsageError

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car
    from pdhef_logtool.residual_model.interface import ResidualModel

#: Options by preset: None for a switch, the allowed range for an option with a value.
OPTIONS: Mapping[str, Mapping[str, tuple[float, float] | None]] = {
    "zero": {"no-lateral": None},
    "open-loop": {"calibrated": None},
    "phy-ukf": {"tuned": None},
    "pd-hef": {"gain": (0.0, 1.0), "fixed-r": None},
}
#: Presets built on ``physics``. They use the calibrated vehicle if available; all others use the vehicle file.
SELF_CALIBRATED = frozenset({"physics", "pd-hef", "pd-hef-smoothed"})
#: The open-loop model on the calibrated vehicle.
OPEN_LOOP = "open-loop:calibrated"
#: Presets that GNSS velocity corrects.
AIDED = frozenset({"physics", "pd-hef"})


@dataclass(frozen=True, slots=True)
class Options:
    """Settings of a run that apply to every estimator.

    Attributes
    ----------
    use_speed : False is the paper's ``esp`` suite for the filters: the speed sensor only initializes them.
    trust : residual gain of the hybrid filters, in [0, 1]; None: by the car's evidence.
    gnss : whether GNSS velocity corrects :data:`AIDED` if the log has it.
    network : the car's network, shared by several estimators; None: each estimator loads it.
    """

    use_speed: bool = True
    trust: float | None = None
    network: ResidualModel | None = field(default=None, compare=False)
    gnss: bool = False

    def service(self, car: Car) -> ResidualModel:
        """Return the car's network."""
        assert car.network is not None, "the table lets no estimator run without the network that it needs"
        return self.network or car.network.service()


def preset_of(name: str) -> str:
    """Return the preset of a name without its options."""
    return name.partition(":")[0]


def options_of(name: str) -> dict[str, str]:
    """Return the options in a name with their values as text; the value of a switch is empty."""
    given = name.partition(":")[2]
    return dict(option.partition("=")[::2] for option in given.split(",")) if given else {}


def split_names(text: str) -> tuple[str, ...]:
    """Split a comma-separated list of names; an option belongs to the name before it."""
    names: list[str] = []
    for part in filter(None, map(str.strip, text.split(","))):
        if names and ":" in names[-1] and part.partition("=")[0] in OPTIONS.get(preset_of(names[-1]), ()):
            names[-1] += f",{part}"
        else:
            names.append(part)
    return tuple(names)


def check_options(names: Sequence[str]) -> None:
    """Raise UsageError for an unknown option of a preset, or for a value out of range."""
    for name in names:
        preset, colon, _ = name.partition(":")
        allowed, given = OPTIONS.get(preset, {}), options_of(name)
        if colon and not (given and all(k in allowed and _fits(v, allowed[k]) for k, v in given.items())):
            texts = [k if limits is None else f"{k}={limits[0]:g}..{limits[1]:g}" for k, limits in allowed.items()]
            raise UsageError(
                expected=f"options of {preset}: {', '.join(texts) or 'none'}", got=name, where="--estimators"
            )


def _fits(value: str, limits: tuple[float, float] | None) -> bool:
    if limits is None:
        return not value
    try:
        return limits[0] <= float(value) <= limits[1]
    except ValueError:
        return False
