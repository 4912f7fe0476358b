"""From ``topic.field`` to signal: mapping files, recognition of known types, clocks, and the reading of channels.

A mapping states field, scale, offset and time of each signal; without a file, names and physics determine it. It must
not import the car: a log is mapped before a vehicle is known.
"""

from pdhef_logtool.mapping.channels import (
    MappedChannels as MappedChannels,
    merge_losses as merge_losses,
    read_signals as read_signals,
)
from pdhef_logtool.mapping.checking import check_mapping as check_mapping, resolve_mapping as resolve_mapping
from pdhef_logtool.mapping.choosing import choose_mapping as choose_mapping, tables_for as tables_for
from pdhef_logtool.mapping.clocks import ClockModel as ClockModel, clock_key as clock_key, fit_clocks as fit_clocks
from pdhef_logtool.mapping.mapping_file import (
    load_mapping as load_mapping,
    mapping_of as mapping_of,
    mapping_to_toml as mapping_to_toml,
)
from pdhef_logtool.mapping.recognition import Ambiguity as Ambiguity, AutoMapping as AutoMapping, auto_map as auto_map
from pdhef_logtool.mapping.records import Mapping as Mapping, QualityGate as QualityGate, SignalSource as SignalSource
