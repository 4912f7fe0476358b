"""How far ``pd-hef`` may follow a network on a vehicle, and why (METHOD §14).

Innovations do not tell whether a network helps on a car that it has never seen. What does is a drive with truth: the
vehicle file then holds a cap, the evidence for it, and the network that the evidence is about (``pdhef trust``).
Without evidence, or with another network, the filter runs on physics alone.
"""

from __future__ import annotations

from dataclasses import dataclass

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.residual_model.bundle import ModelBundle

#: Cap without evidence: METHOD §14's guard on a car without a truth drive.
CAP_WITHOUT_EVIDENCE = 0.0
#: Digits of a hash that are shown.
SHOWN_DIGITS = 12


@dataclass(frozen=True, slots=True)
class AllowedTrust:
    """The cap in [0, 1], and the reason in words."""

    cap: float
    reason: str

    @property
    def note(self) -> str:
        """What the report says."""
        return f"network trust {self.cap:g}: {self.reason}"


def allowed_trust(vehicle: VehicleParameters, model: ModelBundle) -> AllowedTrust:
    """Return the cap of the vehicle file where its evidence is about this network, else the cap without evidence.

    A file with evidence but without ``model_sha256`` was written by hand and holds for any network.
    """
    found = vehicle.network
    if not found.has_evidence:
        return AllowedTrust(
            min(found.trust_cap, CAP_WITHOUT_EVIDENCE),
            f"no evidence that this network helps on {vehicle.name}; a drive with truth and pdhef trust give it",
        )
    here = model.sha256
    if found.model_sha256 is not None and found.model_sha256 != here:
        return AllowedTrust(
            min(found.trust_cap, CAP_WITHOUT_EVIDENCE),
            f"the evidence of the vehicle file is about model {found.model_sha256[:SHOWN_DIGITS]}, this one is "
            f"{here[:SHOWN_DIGITS]}; pdhef trust tries it",
        )
    return AllowedTrust(found.trust_cap, found.evidence)
