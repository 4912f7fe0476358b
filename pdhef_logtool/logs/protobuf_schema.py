"""Protobuf message types from the descriptors that a log carries.

Two cases of a missing value differ, as in the language: a plain scalar of proto3 that is not on the wire
is its default (0), whereas an absent sub-message, an unset ``optional`` and the members of a ``oneof`` that are not the
set one are absent (NaN). Maps and types that contain themselves have no place among columns and are left out.
"""

from contextlib import suppress
from functools import lru_cache
from graphlib import CycleError, TopologicalSorter
from typing import Any

from pdhef_logtool.logs import message_schema as schemas
from pdhef_logtool.logs.resource_limits import DEFAULT_LIMITS, ResourceLimits

#: Protobuf nests by reference, so that a small file can describe an endless tree.
_MAX_DEPTH = 16
_WELL_KNOWN = "google/protobuf/"


@lru_cache(maxsize=256)
def protobuf_schema(type_name: str, data: bytes, limits: ResourceLimits = DEFAULT_LIMITS) -> schemas.MessageSchema:
    """Parse a serialized ``FileDescriptorSet``.

    Parameters
    ----------
    type_name : full name of the message, for example ``foxglove.LocationFix``.
    data : the set, with all files that the message's own imports; Google's well-known types may be left out.

    Raises
    ------
    SchemaError : the set does not parse, lacks a file or the type, or exceeds a resource limit.
    """
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    what = f"the descriptors of {type_name}"
    with schemas.parsing(what):
        limits.check("schema_bytes", len(data), what)
        files = descriptor_pb2.FileDescriptorSet.FromString(data)
        pool = descriptor_pool.DescriptorPool()
        by_name = {file.name: file for file in files.file}
        unfolding = schemas.Unfolding(limits, what)
        unfolding.enter(len(by_name), 0)
        for name in _in_order(by_name):
            pool.AddSerializedFile(by_name[name].SerializeToString())
        try:
            descriptor = pool.FindMessageTypeByName(type_name.removeprefix("."))
        except KeyError as error:
            raise schemas.SchemaError(f"the descriptors contain no message {type_name}") from error
        root = _message_node(descriptor, (), unfolding)
        message_class = message_factory.GetMessageClass(descriptor)
    return schemas.MessageSchema(type_name, "protobuf", root, None, message_class, limits)


def _in_order(files: dict[str, Any]) -> list[str]:
    """Return the files' names, imported ones first; well-known files that are not there are added."""
    pending = list(files)
    while pending:
        importer = pending.pop()
        for name in files[importer].dependency:
            if name not in files:
                files[name] = _well_known_file(name, importer)
                pending.append(name)
    try:
        return [*TopologicalSorter({name: file.dependency for name, file in files.items()}).static_order()]
    except CycleError as error:
        raise schemas.SchemaError(f"{error.args[1][0]} imports itself") from error


def _well_known_file(name: str, importer: str) -> Any:
    """Return Google's own file of this name, which writers may leave out."""
    import importlib

    from google.protobuf import descriptor_pb2

    if name.startswith(_WELL_KNOWN) and name.endswith(".proto"):
        module = name.removeprefix(_WELL_KNOWN).removesuffix(".proto")
        with suppress(ImportError):
            imported = importlib.import_module(f"google.protobuf.{module}_pb2")
            return descriptor_pb2.FileDescriptorProto.FromString(imported.DESCRIPTOR.serialized_pb)
    raise schemas.SchemaError(f"{importer} imports {name}, which the descriptors lack")


def _message_node(descriptor: Any, above: tuple[str, ...], unfolding: schemas.Unfolding) -> schemas.Struct:
    inside = (*above, descriptor.full_name)
    nodes = {field.name: _field_node(field, inside, unfolding) for field in descriptor.fields}
    return schemas.Struct({name: node for name, node in nodes.items() if node is not None})


def _field_node(field: Any, inside: tuple[str, ...], unfolding: schemas.Unfolding) -> schemas.Node | None:
    """Return a field's node; None if it cannot be a column."""
    from google.protobuf.descriptor import FieldDescriptor

    unfolding.enter(1, len(inside))
    node: schemas.Node
    if field.message_type is not None:
        kind = field.message_type
        if kind.GetOptions().map_entry or kind.full_name in inside or len(inside) >= _MAX_DEPTH:
            return None
        node = _message_node(kind, inside, unfolding)
    elif field.type == FieldDescriptor.TYPE_STRING:
        node = schemas.Scalar("string")
    elif field.type == FieldDescriptor.TYPE_BYTES:
        node = schemas.Array(schemas.Scalar("number", "u1"), None)
    else:
        node = schemas.Scalar("bool" if field.type == FieldDescriptor.TYPE_BOOL else "number")
    return schemas.Array(node, None) if _is_repeated(field) else node


def _is_repeated(field: Any) -> bool:
    # Releases up to 6.30 have the label only, which later ones deprecate.
    is_repeated = getattr(field, "is_repeated", None)
    return bool(field.label == field.LABEL_REPEATED) if is_repeated is None else bool(is_repeated)
