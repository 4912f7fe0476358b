"""tomllib reads written TOML back unchanged."""

import tomllib
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pdhef_logtool.storage.toml_text import toml_text

_TEXTS = st.text(st.characters(exclude_categories=["Cs"]), max_size=8)
_PLAIN = st.one_of(st.booleans(), st.integers(-(2**63), 2**63 - 1), st.floats(allow_nan=False), _TEXTS)
_TABLES: Any = st.recursive(
    st.dictionaries(_TEXTS, st.one_of(_PLAIN, st.lists(_PLAIN, max_size=3))),
    lambda inner: st.dictionaries(_TEXTS, st.one_of(_PLAIN, st.lists(inner, max_size=2), inner), max_size=4),
    max_leaves=8,
)


@given(_TABLES)
def test_a_document_is_read_back(entries):
    assert tomllib.loads(toml_text(entries, "A head\nof two lines")) == entries


def test_the_layout_is_for_readers():
    entries = {"t": {"n": [1, 2.0], "u": {"x": True}}, "names": ["a", 'b"'], "rows": [{"k v": 1e-9}], "v": 1}
    text = """# Head
v = 1
names = [
    "a",
    "b\\"",
]
rows = [
    {"k v" = 1e-09},
]

[t]
n = [1, 2.0]

[t.u]
x = true
"""
    assert toml_text(entries, "Head") == text
    with pytest.raises(TypeError, match="NoneType"):
        toml_text({"a": None})
