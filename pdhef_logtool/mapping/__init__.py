"""From ``topic.field`` to signal: mapping files, recognition of known types, clocks, and the reading of channels."""

from __future__ import annotations

from pdhef_logtool.mapping.channels import (
    CleanSamples,
    MappedChannels,
    clean_samples,
    gate_mask,
    join_channels,
    merge_losses,
    read_signals,
)
from pdhef_logtool.mapping.checking import check_mapping, resolve_mapping
from pdhef_logtool.mapping.choosing import choose_mapping
from pdhef_logtool.mapping.clocks import ClockModel, apply_clock, clock_key, fit_clock_line, fit_clocks
from pdhef_logtool.mapping.mapping_file import load_mapping, mapping_to_toml
from pdhef_logtool.mapping.recognition import Ambiguity, AutoMapping, auto_map
from pdhef_logtool.mapping.records import VECTOR_COLUMNS, CanSettings, Mapping, QualityGate, SignalSource

__all__ = [
    "VECTOR_COLUMNS",
    "Ambiguity",
    "AutoMapping",
    "CanSettings",
    "CleanSamples",
    "ClockModel",
    "MappedChannels",
    "Mapping",
    "QualityGate",
    "SignalSource",
    "apply_clock",
    "auto_map",
    "check_mapping",
    "choose_mapping",
    "clean_samples",
    "clock_key",
    "fit_clock_line",
    "fit_clocks",
    "gate_mask",
    "join_channels",
    "load_mapping",
    "mapping_to_toml",
    "merge_losses",
    "read_signals",
    "resolve_mapping",
]
