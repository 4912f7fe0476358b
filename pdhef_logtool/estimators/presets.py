"""Names of estimators: a preset, with an option after a colon, such as ``pd-hef:gain=1``."""

from dataclasses import dataclass

#: Presets built on ``physics``. They use the calibrated vehicle if available; all others use the vehicle file.
SELF_CALIBRATED = frozenset({"physics", "pd-hef", "pd-hef-smoothed"})
#: The filter on the vehicle file.
ON_FILE = "phy-ukf"
#: The open-loop model on the calibrated vehicle.
OPEN_LOOP = "open-loop:calibrated"


def uses_calibration(name: str) -> bool:
    """Return whether an estimator uses the calibrated or identified vehicle; all others use the vehicle file."""
    return name == OPEN_LOOP or preset_of(name) in SELF_CALIBRATED


#: Presets that GNSS velocity corrects.
AIDED = frozenset({"physics", "pd-hef"})


@dataclass(frozen=True, slots=True)
class Options:
    """Settings of a run that apply to every estimator.

    Attributes
    ----------
    use_speed : False is the paper's ``esp`` suite for the filters: the speed sensor only initializes them.
    gnss : whether GNSS velocity corrects :data:`AIDED` if the log has it. steers : whether the log has the steering.
    """

    use_speed: bool = True
    gnss: bool = False
    steers: bool = True


def preset_of(name: str) -> str:
    """Return the preset of a name without its options."""
    return name.partition(":")[0]


def options_of(name: str) -> dict[str, str]:
    """Return the options in a name with their values as text; the value of a switch is empty."""
    option = name.partition(":")[2]
    return {key: value for key, _, value in [option.partition("=")] if key}
