"""The checks of channels in memory."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.drive.checks import check_drive
from pdhef_logtool.drive.measured import measure
from pdhef_logtool.drive.truth import TruthTrack
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.signals import Channel


def checks_of(
    signals: Mapping[str, Channel],
    truth: Mapping[str, Channel] | None = None,
    derived: TruthTrack | None = None,
    vehicle: VehicleParameters | None = None,
    **options: Any,
) -> tuple[Check, ...]:
    return check_drive(measure(signals, truth, derived, vehicle), vehicle, **options)
