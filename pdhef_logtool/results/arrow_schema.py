"""The schema files that are shipped with the package, and Arrow schemas from them."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from pdhef_logtool.logs.definitions import schema_file

if TYPE_CHECKING:
    import pyarrow as pa


def load_schema(name: str) -> dict[str, Any]:
    """Return one of the JSON documents of ``schemas/`` by file name."""
    document: dict[str, Any] = json.loads(schema_file(name).read_text(encoding="utf-8"))
    return document


def arrow_schema(name: str) -> pa.Schema:
    """Return the Arrow schema that ``schemas/<name>`` describes.

    Each field carries its unit; the schema's own metadata carry format, version and all units once more, because
    only Arrow readers see metadata of fields.
    """
    import pyarrow as pa

    def type_of(name: str) -> pa.DataType:
        is_dictionary = name == "dictionary<int32, string>"
        return pa.dictionary(pa.int32(), pa.string()) if is_dictionary else pa.type_for_alias(name)

    document = load_schema(name)
    columns = document["columns"]
    units = {column["name"]: column["unit"] for column in columns}
    fields = [
        pa.field(c["name"], type_of(c["type"]), nullable=c["nullable"], metadata={"unit": c["unit"]}) for c in columns
    ]
    stated = document | {"version": str(document["version"]), "units": json.dumps(units)}
    return pa.schema(fields, metadata={key: stated[key] for key in ("format", "version", "units", "missing")})


def arrow_array(values: Any, kind: pa.DataType) -> pa.Array:
    """Return numbers or strings [N], null for NaN and None; ``pa.array`` would import an installed pandas."""
    import pyarrow as pa

    if isinstance(values, np.ndarray) and values.dtype.kind != "U":
        is_there = ~np.isnan(values)
    else:
        is_there = np.array([v is not None and v == v for v in values], dtype=np.bool_)  # NaN differs from itself
        filler = "" if pa.types.is_string(kind) else 0
        values = [v if there else filler for v, there in zip(values, is_there, strict=True)]
    validity = None if is_there.all() else pa.py_buffer(np.packbits(is_there, bitorder="little"))
    if pa.types.is_string(kind):
        texts = [str(v).encode("utf-8", "backslashreplace") for v in values]
        offsets = np.cumsum([0, *map(len, texts)], dtype=np.int32)
        return pa.Array.from_buffers(kind, len(texts), [validity, pa.py_buffer(offsets), pa.py_buffer(b"".join(texts))])
    values = np.ascontiguousarray(values, dtype=kind.to_pandas_dtype())
    data = np.packbits(values, bitorder="little") if values.dtype == np.bool_ else values
    return pa.Array.from_buffers(kind, len(values), [validity, pa.py_buffer(data)])
