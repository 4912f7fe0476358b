"""The files of schemas/ are there in a source tree and in a built wheel."""

from __future__ import annotations

import pytest

from pdhef_logtool.logs.schema_files import message_definition, schema_file

pytestmark = pytest.mark.slow

OWN_MESSAGE = "pdhef_msgs/msg/VehicleStateEstimate"


def test_own_definition_keeps_its_units_and_carries_its_contained_types() -> None:
    text = message_definition(OWN_MESSAGE)
    assert text.startswith(schema_file(f"{OWN_MESSAGE}.msg").read_text(encoding="utf-8").rstrip())
    assert "MSG: std_msgs/Header" in text
    assert "MSG: builtin_interfaces/Time" in text


def test_an_unknown_type_is_a_key_error() -> None:
    with pytest.raises(KeyError):
        message_definition("no_such/msg/Type")
