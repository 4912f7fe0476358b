"""Message types as trees of nodes, for all schema languages, and dotted paths resolved against them."""

import base64
import difflib
import functools
import inspect
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from pdhef_logtool.logs.constants import CONSTANTS
from pdhef_logtool.logs.definitions import MESSAGE_SEPARATOR, SHIPPED, Definitions, referenced, with_contained_types
from pdhef_logtool.logs.resource_limits import DEFAULT_LIMITS, ResourceLimits
from pdhef_logtool.records.errors import MappingError, PdhefError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

#: Fixed arrays up to this length are listed element by element.
LISTED_ELEMENTS = 16
#: Structs with exactly these members are read as one vector, in this order of columns.
VECTOR_ORDERS: dict[frozenset[str], tuple[str, ...]] = {
    frozenset("xyz"): ("x", "y", "z"),
    frozenset("xyzw"): ("w", "x", "y", "z"),
    frozenset("xy"): ("x", "y"),
}
#: Member names of the seconds and nanoseconds of a time struct, as ROS 1, ROS 2 and Foxglove spell them.
TIME_MEMBERS = (("sec", "nanosec"), ("secs", "nsecs"), ("sec", "nsec"), ("seconds", "nanos"))

Step: TypeAlias = str | int


@dataclass(frozen=True, slots=True)
class FieldInfo:
    """One scalar leaf of a topic's schema.

    ``path`` is dotted (``linear_acceleration.x``); fixed arrays appear as ``name[i]`` per element when they have at
    most 16 elements, sequences as ``name[]``. ``kind`` is ``number``, ``bool``, ``string`` or ``time`` (a ROS
    builtin time; the path then names the struct, for example ``header.stamp``). ``code`` is NumPy's of a number in
    a binary message (``f4``), empty where the encoding has no such types. ``unit`` is the text that the file gives
    (``km/h``), empty where it gives none.
    """

    path: str
    kind: str
    code: str = field(default="", compare=False)
    unit: str = ""


@dataclass(frozen=True, slots=True)
class Scalar:
    """A leaf. ``code`` is its NumPy code (``f8``, ``u1``...), or empty for strings and JSON values."""

    kind: Literal["number", "bool", "string"]
    code: str = ""


@dataclass(frozen=True, slots=True)
class Struct:
    """Named members in the order of the wire."""

    members: "Mapping[str, Node]"

    @property
    def time(self) -> tuple[str, str] | None:
        """Names of seconds and nanoseconds if this is a time."""
        names = set(self.members)
        return next((pair for pair in TIME_MEMBERS if names == set(pair)), None)

    @property
    def vector(self) -> tuple[str, ...] | None:
        """Names of the numeric members, in order of columns, if this is a vector."""
        order = VECTOR_ORDERS.get(frozenset(self.members))
        if order and all(isinstance(m, Scalar) and m.kind == "number" for m in self.members.values()):
            return order
        return None


@dataclass(frozen=True, slots=True)
class Array:
    """Elements of one type; ``length`` is None for a sequence."""

    item: "Node"
    length: int | None


@dataclass(frozen=True, slots=True)
class Unknown:
    """A place that the schema leaves open, and so do the first messages."""


Node: TypeAlias = Scalar | Struct | Array | Unknown


@dataclass(frozen=True)
class MessageSchema:
    """A message type: its tree and its decoder.

    ``wire`` is ``cdr``, ``ros1``, ``json`` or ``protobuf``; ``types`` are the ROS types as rosbags has them,
    ``message_class`` is the class of a protobuf type; ``limits`` apply to its messages, too; ``borrowed`` are the files
    of an installed ROS that it was read from, if the log contains no definition. ``units`` of fields by type are those
    that comments of its text state.
    """

    type_name: str
    wire: str
    root: Node
    types: Any = None
    message_class: Any = None
    limits: ResourceLimits = DEFAULT_LIMITS
    borrowed: tuple[Path, ...] = ()
    units: Mapping[str, Mapping[str, tuple[str, str]]] = field(default_factory=dict)

    @functools.cached_property
    def fields(self) -> tuple[FieldInfo, ...]:
        """The scalar leaves of the tree, times as one leaf."""
        return tuple(replace(f, unit=_stated_unit(self.units, f.path)) for f in leaves(self.root))

    @functools.cached_property
    def store(self) -> "Typestore":
        """The decoder of single ROS messages, which takes long to generate; it decodes none if its code is invalid."""
        from rosbags.typesys import Stores, get_typestore

        store = get_typestore(Stores.EMPTY)
        with suppress(Exception):
            store.register(self.types)
        return store


@dataclass(frozen=True, slots=True)
class Selection:
    """A path resolved against a schema.

    ``components`` are the places to read, as steps (member name or index): one for a scalar or an array, one a
    column for a vector, seconds and nanoseconds for a time.
    ``text`` is the encoding of an array of bytes that is a text: ``hex``, ``base64`` or empty.
    """

    path: str
    shape: Literal["scalar", "array", "vector", "time"]
    components: tuple[tuple[Step, ...], ...]
    length: int | None = None  # columns of an array of fixed length
    text: str = ""


#: Endings of a path that read a text as the bytes that it encodes.
TEXT_ENDINGS = {"|hex": "hex", "|base64": "base64"}

#: Member that message types without members get, and its description by rosbags.
NO_MEMBERS = "structure_needs_at_least_one_member"
_ONLY_FILLER = ((NO_MEMBERS, (1, ("uint8", 0))),)


class SchemaError(Exception):
    """A schema cannot be parsed; the messages of the topic are counted, its fields are unknown."""


class NoSchemaError(SchemaError):
    """A channel has no schema of a supported kind; this is no loss."""


@contextmanager
def parsing(what: str) -> Iterator[None]:
    """Turn any error of a parser into a :class:`SchemaError`."""
    try:
        yield
    except SchemaError:
        raise
    except PdhefError as error:  # of the resource limits
        raise SchemaError(f"{what}: expected {error.expected}, got {error.got}; {error.remedy}") from error
    except RecursionError as error:
        raise SchemaError(f"{what}: nested too deeply") from error
    except Exception as error:
        reason = (str(error).splitlines() or [""])[0].rstrip(":") or type(error).__name__
        raise SchemaError(f"{what} cannot be parsed: {reason}") from error


class Unfolding:
    """Counts the places of a schema while its tree is built: a short text can describe an unlimited tree."""

    def __init__(self, limits: ResourceLimits, what: str) -> None:
        self.limits, self.what = limits, what
        self.places = 0

    def enter(self, times: int, depth: int) -> None:
        """Count a node that occurs ``times`` times in the tree, below ``depth`` others; raises LimitError."""
        self.places += times
        self.limits.check("schema_leaves", self.places, self.what)
        self.limits.check("schema_depth", depth, self.what)


_CODES = {
    "bool": "u1", "byte": "u1", "char": "u1",
    "int8": "i1", "int16": "i2", "int32": "i4", "int64": "i8",
    "uint8": "u1", "uint16": "u2", "uint32": "u4", "uint64": "u8",
    "float32": "f4", "float64": "f8",
}  # fmt: skip


#: Line between two definitions; some writers make it shorter than the 80 signs of the convention.
_SEPARATOR = re.compile(r"^={3,}[ \t]*$", re.MULTILINE)


#: Bytes of descriptors at the cost of one byte of text, which a grammar parses step by step.
_BYTES_OF_TEXT = 32
#: An element of a fixed array of structs or texts is a line in each of the functions that rosbags writes for its type.
_PLACES_AN_ELEMENT = 8


@functools.lru_cache(maxsize=256)
def ros_schema(
    type_name: str,
    encoding: str,
    text: str,
    wire: str,
    distro: str = "",
    limits: ResourceLimits = DEFAULT_LIMITS,
    definitions: Definitions = SHIPPED,
) -> MessageSchema:
    """Parse a ROS message definition.

    Parameters
    ----------
    type_name : in ROS 2 form.
    encoding : ``ros2msg``, ``ros2idl``, ``ros1msg`` or empty.
    text : concatenated definitions; empty takes the type from the distribution's own packages, else from definitions.
    wire : ``cdr`` or ``ros1``.
    distro : ROS distribution for a type without a text; the latest one if empty or unknown.
    limits : resource limits of the schema.
    definitions : of types that neither the text nor the distribution has.

    Raises
    ------
    SchemaError : the text does not parse, the type is not known, or it costs too much.
    """
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    what = f"the definition of {type_name}"
    borrowed: tuple[Path, ...] = ()
    types: Any = {}
    has_text = bool(text.strip())

    def text_of(name: str) -> str:
        text = definitions.text_of(name)
        limits.check("schema_bytes", len(text) * _BYTES_OF_TEXT, f"the definition of {name}")
        if not text.strip():
            missing = f"the log contains no definition of {name.replace('/msg/', '/')}"
            kind = SchemaError if has_text else NoSchemaError  # if the log's own text is not whole, messages are lost
            raise kind(f"{missing}; give its .msg file by --set msgs=DIR")
        return text

    with parsing(what):
        limits.check("schema_bytes", len(text) * _BYTES_OF_TEXT, what)
        if has_text:
            text = _SEPARATOR.sub(MESSAGE_SEPARATOR, text)
            types = _idl_types(text) if encoding == "ros2idl" else get_types_from_msg(text, type_name)
        if not has_text or referenced(types) - set(types):  # a distribution's types take long to load
            of_ros2 = getattr(Stores, f"ROS2_{distro.upper()}", Stores.LATEST)
            base = Stores.ROS1_NOETIC if wire == "ros1" else of_ros2
            distributed = get_typestore(base).fielddefs
            types = with_contained_types(types, distributed, text_of, "" if has_text else type_name)
            if not has_text:
                files = (definitions.installed(name) for name in sorted(set(types) - set(distributed)))
                borrowed = tuple(file for file in files if file is not None)
        root = _ros_root(types, type_name, limits)
    units = stated_units(text) if encoding in ("ros2msg", "ros1msg") else {}
    return MessageSchema(type_name, wire, root, types, limits=limits, borrowed=borrowed, units=units)


def _idl_types(text: str) -> Any:
    """Return the types of an IDL text as rosbags has them; raises the errors of its parser."""
    from rosbags.typesys.base import make_typesdict
    from rosbags.typesys.idl import IDLParser

    class QuickParser(IDLParser):
        """Parser that applies each rule once per position; the plain one takes 100 times as long for each bracket.

        Products and shifts are refused: a few nested ones give a number that fills the memory, and the texts that ROS
        generates contain none.
        """

        def __init__(self, text: str) -> None:
            super().__init__(text)
            for name, rule in inspect.getmembers(self, inspect.ismethod):
                if list(inspect.signature(rule).parameters) == ["pos"]:
                    setattr(self, name, functools.cache(rule))

        def shift_expr(self, pos: int) -> Any:
            return self.add_expr(pos)

        def mult_expr(self, pos: int) -> Any:
            return self.unary_expr(pos)

    return make_typesdict(QuickParser(text).specification())


def _ros_root(defs: Mapping[str, Any], type_name: str, limits: ResourceLimits) -> Struct:
    if type_name not in defs:
        raise SchemaError(f"no definition of {type_name}")
    members = defs[type_name][1]
    if not members or [field for field, _ in members] == [NO_MEMBERS]:
        return Struct({})
    return _ros_node(defs, type_name, (), 1, Unfolding(limits, f"the definition of {type_name}"))


def _ros_node(defs: Mapping[str, Any], name: str, above: tuple[str, ...], times: int, unfolding: Unfolding) -> Struct:
    if name in above:
        raise SchemaError(f"{name} contains itself")
    above = (*above, name)
    members = defs[name][1] or _ONLY_FILLER
    return Struct({field: _field_node(defs, desc, above, times, unfolding) for field, desc in members})


def _field_node(defs: Mapping[str, Any], desc: Any, above: tuple[str, ...], times: int, unfolding: Unfolding) -> Node:
    from rosbags.interfaces import Nodetype

    unfolding.enter(times, len(above))
    kind, args = desc
    if kind == Nodetype.BASE:
        base = args[0]
        if base in ("string", "wstring"):
            return Scalar("string", "wide" if base == "wstring" else "")
        if base not in _CODES:
            raise SchemaError(f"type {base} is not supported")
        return Scalar("bool" if base == "bool" else "number", _CODES[base])
    if kind == Nodetype.NAME:
        return _ros_node(defs, args, above, times, unfolding)
    length = args[1] if kind == Nodetype.ARRAY else None
    if length is not None and length < 0:
        raise SchemaError(f"an array of {length} elements")
    item = _field_node(defs, args[0], above, times * _listed(length), unfolding)
    if length is not None and (_is_text(item) or not isinstance(item, Scalar)):
        unfolding.enter(length * _PLACES_AN_ELEMENT, len(above))
    return Array(item, length)


def _listed(length: int | None) -> int:
    """Return how many times an array's element is listed."""
    return length if length is not None and length <= LISTED_ELEMENTS else 1


def json_schema(type_name: str, text: bytes, examples: Iterable[bytes], limits: ResourceLimits) -> MessageSchema:
    """Parse a JSON Schema; the first three messages define the places that it leaves open, without a text all.

    Raises
    ------
    SchemaError : the schema does not parse or exceeds a limit; without a text, the first message.
    """
    what = f"the JSON Schema of {type_name}" if text.strip() else "the first message"
    root: Node = Unknown()
    with parsing(what):
        limits.check("schema_bytes", len(text), what)
        if text.strip():
            document = json.loads(text.decode("utf-8", errors="replace"))
            root = _json_node(document, document, Unfolding(limits, what), 1, (), 0)
    first = islice(examples, 3)
    while _is_open(root) and (example := next(first, None)) is not None:
        try:
            with parsing(what):
                limits.check("schema_bytes", len(example), what)
                root = _filled(root, _example_node(json.loads(example), Unfolding(limits, what), 0))
        except SchemaError:
            if isinstance(root, Unknown):
                raise
    if isinstance(root, Unknown) and not text.strip():
        raise NoSchemaError("JSON without a schema and without a message")
    return MessageSchema(type_name, "json", root, limits=limits)


def _is_open(node: Node) -> bool:
    """Return whether a schema leaves a place open."""
    if isinstance(node, Struct):
        return any(map(_is_open, node.members.values()))
    return isinstance(node, Unknown) or (isinstance(node, Array) and _is_open(node.item))


def _filled(node: Node, other: Node) -> Node:
    """Return a tree with its open places as another tree has them."""
    if isinstance(node, Unknown):
        return other
    if isinstance(node, Struct) and isinstance(other, Struct):
        return Struct({k: _filled(member, other.members.get(k, member)) for k, member in node.members.items()})
    if isinstance(node, Array) and isinstance(other, Array):
        return Array(_filled(node.item, other.item), node.length)
    return node


#: Scalars of JSON Schema by their type.
_JSON_SCALARS: dict[object, Scalar] = {
    "number": Scalar("number"),
    "integer": Scalar("number"),
    "boolean": Scalar("bool"),
    "string": Scalar("string"),
}


def _json_node(
    schema: Any, document: Any, unfolding: Unfolding, times: int, inside: tuple[str, ...], depth: int
) -> Node:
    """Return the tree of a part of a document; ``inside`` are the references that lead here: recursion is left open."""
    if not isinstance(schema, dict) or depth > unfolding.limits.schema_depth:
        return Unknown()
    unfolding.enter(times, 0)
    below = functools.partial(_json_node, document=document, unfolding=unfolding, inside=inside, depth=depth + 1)
    reference = schema.get("$ref")
    if isinstance(reference, str) and reference.startswith("#/"):
        if reference in inside:
            return Unknown()
        return below(_referenced(document, reference), times=times, inside=(*inside, reference))
    kind = _json_type(schema.get("type"))
    if kind == "object" or (kind is None and "properties" in schema):
        properties = schema.get("properties")
        if not isinstance(properties, dict) or not properties:
            return Unknown()
        return Struct({k: below(v, times=times) for k, v in properties.items()})
    if kind == "array":
        least, most = schema.get("minItems"), schema.get("maxItems")
        length = least if isinstance(least, int) and least == most and least >= 0 else None
        return Array(below(schema.get("items"), times=times * _listed(length)), length)
    return _JSON_SCALARS.get(kind, Unknown())


def _referenced(document: Any, reference: str) -> Any:
    """Return the part of a document that ``#/definitions/Name`` names, or None."""
    for part in reference[2:].split("/"):
        document = document.get(part) if isinstance(document, dict) else None
    return document


def _json_type(declared: object) -> str | None:
    """Return the type that a JSON Schema declares, null aside; None where it declares none or several."""
    types = [t for t in declared if t != "null"] if isinstance(declared, list) else [declared]
    return str(types[0]) if len(types) == 1 and types[0] is not None else None


def _example_node(value: object, unfolding: Unfolding, depth: int) -> Node:
    """Return the tree of a JSON value; raises LimitError."""
    unfolding.enter(1, depth)
    if isinstance(value, dict):
        return Struct({k: _example_node(v, unfolding, depth + 1) for k, v in value.items()})
    if isinstance(value, list):
        return Array(_example_node(value[0], unfolding, depth + 1) if value else Unknown(), None)
    if isinstance(value, bool):
        return Scalar("bool")
    if isinstance(value, (int, float)):
        return Scalar("number")
    return Scalar("string") if isinstance(value, str) else Unknown()


def leaves(node: Node, path: str = "") -> Iterator[FieldInfo]:
    """List the scalar leaves of a tree, times as one leaf; see :class:`~pdhef_logtool.logs.drive_log.FieldInfo`."""
    if isinstance(node, Struct):
        if path and node.time:
            yield FieldInfo(path, "time")
            return
        for name, member in node.members.items():
            yield from leaves(member, f"{path}.{name}" if path else name)
    elif isinstance(node, Array):
        if node.length is not None and node.length <= LISTED_ELEMENTS:
            for i in range(node.length):
                yield from leaves(node.item, f"{path}[{i}]")
        else:
            yield from leaves(node.item, f"{path}[]")
    elif isinstance(node, Scalar):
        yield FieldInfo(path, node.kind, "" if node.kind == "string" else node.code)


_SECTION = re.compile(r"^=+\nMSG: *(\S*)", re.MULTILINE)
# Possessive: the time is linear in any text.
_BLOCK = re.compile(r"((?:^ *+#.*\n)*+)((?:^ *+[^#\s].*\n?)*+)", re.MULTILINE)
_MEMBER = re.compile(r"^ *+([A-Za-z][\w/]*+)(?:[\[<]\S*+)? ++(\w++)[^=#\n]*+(?:#(.*))?$", re.MULTILINE)
_UNIT = re.compile(CONSTANTS["comments"]["unit"])


def stated_units(definition: str) -> dict[str, dict[str, tuple[str, str]]]:
    """Return type and unit of the fields by type, "" for the first, as comments beside or above the fields state."""
    stated: dict[str, dict[str, tuple[str, str]]] = {}
    _, *parts = _SECTION.split(f"=\nMSG:\n{definition}")
    for name, text in zip(parts[::2], parts[1::2], strict=True):
        members = stated.setdefault(name.rpartition("/")[2], {})
        for above, lines in _BLOCK.findall(text):
            for kind, field_name, beside in _MEMBER.findall(lines):
                size, unit = _unit_in(beside or above)
                members[field_name] = kind.rpartition("/")[2], f"{size} {unit}".strip() if "int" in kind else unit
    return stated


def _unit_in(comment: str) -> tuple[str, str]:
    """Return the size of a count and the unit, if a comment contains only one; empty otherwise."""
    units = {(size, unit.replace(" per ", "/"), steps) for size, unit, steps in _UNIT.findall(comment)}
    size, unit, steps = units.pop() if len(units) == 1 else ("", "", "")
    return size or (steps and f"1/{round(max(float(steps), 1.0 / float(steps)))}"), unit


def _stated_unit(stated: Mapping[str, Mapping[str, tuple[str, str]]], path: str) -> str:
    """Return the unit of a field, or else of the structs around it."""
    kind = unit = ""
    for name in re.sub(r"\[\d*\]", "", path).split("."):
        kind, its = stated.get(kind, {}).get(name, ("-", ""))
        unit = its or unit
    return unit


_PART = r"[^.\[\]]+(?:\[\d+\])*"
_PATH = re.compile(rf"{_PART}(?:\.{_PART})*")


def parse_path(path: str) -> tuple[Step, ...]:
    """Split ``a.b[3].c`` into its steps; ``[]`` at the end names the whole array and is dropped.

    Raises
    ------
    MappingError : the text is no path.
    """
    text = path.removesuffix("[]")
    if not _PATH.fullmatch(text):
        expected = "a dotted path such as twist.linear.x or data[0]"
        raise MappingError(expected=expected, got=repr(path), where="field path")
    return tuple(name or int(index) for index, name in re.findall(r"\[(\d+)\]|([^.\[\]]+)", text))


def resolve(schema: MessageSchema, topic: str, path: str) -> Selection:
    """Resolve a path against a schema.

    Raises
    ------
    MappingError : the type has no such path, or it is no number; the message names similar paths.
    """
    ending = next((e for e in TEXT_ENDINGS if path.endswith(e)), "")
    steps = parse_path(path.removesuffix(ending))
    node: Node | None = schema.root
    for step in steps:
        node = _part(node, step)
    if node is None:
        raise nearest(
            path, [leaf.path for leaf in schema.fields], f"a field of {schema.type_name or 'the message'}", topic
        )
    # Records of ROS messages are read without their texts.
    has_texts = schema.wire in ("json", "protobuf")
    if ending and has_texts and (isinstance(node, Unknown) or _is_text(node)):
        return Selection(path, "array", (steps,), None, TEXT_ENDINGS[ending])
    if ending:
        expected = f"a text of {TEXT_ENDINGS[ending]} digits in a JSON or protobuf message"
        raise MappingError(expected=expected, got=repr(path), where=topic, remedy=f"drop the ending {ending}")
    return _number_selection(schema, topic, path, node, steps)


def _number_selection(schema: MessageSchema, topic: str, path: str, node: Node, steps: tuple[Step, ...]) -> Selection:
    """Return how the node at some steps becomes a column; raises MappingError for one that is no number."""
    if _is_text(node):
        raise _no_number(schema, topic, path, "a text")
    if isinstance(node, Unknown | Scalar):
        return Selection(path, "scalar", (steps,))
    if isinstance(node, Array):
        if isinstance(node.item, Struct | Array) or _is_text(node.item):
            raise _no_number(schema, topic, path, "an array of structs or texts")
        if node.length is not None and node.length > schema.limits.array_width:
            raise _no_number(schema, topic, path, f"an array of {node.length} elements, too many for columns")
        return Selection(path, "array", (steps,), node.length)
    if node.time:
        return Selection(path, "time", tuple((*steps, part) for part in node.time))
    if node.vector:
        return Selection(path, "vector", tuple((*steps, part) for part in node.vector))
    raise _no_number(schema, topic, path, "a struct")


def _is_text(node: Node) -> bool:
    return isinstance(node, Scalar) and node.kind == "string"


def _part(node: Node | None, step: Step) -> Node | None:
    """Return a member of a struct or an element of an array, or None; below an open place all is open."""
    if isinstance(node, Unknown):
        return node
    if isinstance(node, Struct) and isinstance(step, str):
        return node.members.get(step)
    is_element = isinstance(node, Array) and isinstance(step, int) and (node.length is None or step < node.length)
    return node.item if isinstance(node, Array) and is_element else None


def nearest(name: str, names: Sequence[str], expected: str, where: object) -> MappingError:
    """Return the error for a topic or field that is not among these names."""
    near = difflib.get_close_matches(name, names, n=3, cutoff=0.4)
    if not near:
        last = name.rsplit(".", 1)[-1]
        near = [n for n in names if n.rsplit(".", 1)[-1] == last][:3] or list(names[:5])
    remedy = f"nearest: {', '.join(near)}" if near else "there are none"
    return MappingError(expected=expected, got=repr(name), where=str(where), remedy=remedy)


def _no_number(schema: MessageSchema, topic: str, path: str, what: str) -> MappingError:
    below = [leaf.path for leaf in schema.fields if leaf.path.startswith(path) and leaf.kind != "string"][:3]
    return MappingError(
        expected="a number, a time, a vector or an array of numbers",
        got=f"{path!r}, which is {what}",
        where=topic,
        remedy=f"nearest: {', '.join(below)}" if below else "",
    )


def bytes_of_text(value: object, encoding: str) -> list[int] | None:
    """Decode a text of ``hex`` or ``base64`` digits; None for any other text."""
    if not isinstance(value, str):
        return None
    try:
        if encoding == "hex":
            digits = value.strip().removeprefix("0x").removeprefix("0X")
            return list(bytes.fromhex(digits.replace(":", " ").replace("-", " ")))
        return list(base64.b64decode(value, validate=True))
    except ValueError:
        return None


def _value_at(value: Any, step: Step) -> Any:
    """Return an element, an entry or an attribute of a value; None if it lacks it."""
    if isinstance(step, str):
        return value.get(step) if isinstance(value, dict) else getattr(value, step, None)
    try:
        return value[step]
    except (IndexError, KeyError, TypeError):
        return None


def values_at(values: Sequence[Any], steps: Sequence[Step]) -> Sequence[Any]:
    """Follow steps through messages or values of one type; None where one of them lacks a step.

    Absent fields of protobuf messages are None. A default that the type declares (proto2) replaces an absent value.
    """
    for step in steps:
        kind: Any = type(next((value for value in values if value is not None), None))
        named = kind.DESCRIPTOR.fields_by_name if hasattr(kind, "DESCRIPTOR") else {}
        if isinstance(step, int) or step not in named:
            values = [_value_at(value, step) for value in values]
            continue
        field = named[step]
        if field.has_presence and not field.has_default_value:
            values = [getattr(v, step) if v is not None and v.HasField(step) else None for v in values]
        else:
            values = [None if v is None else getattr(v, step) for v in values]
    return values
