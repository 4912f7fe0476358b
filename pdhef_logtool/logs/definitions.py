"""Message definitions: of logs without any the user's, an installed ROS's, and a few that are shipped (``schemas``)."""

import os
import re
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

from pdhef_logtool.logs.resource_limits import MIB
from pdhef_logtool.records.errors import UsageError

#: A workspace with more files is more than messages, and a longer text is no message.
MOST_FILES = 50_000
MOST_BYTES = MIB
#: A type name may come from a log, and becomes a path.
_TYPE_NAME = re.compile(r"([A-Za-z]\w*)/(?:msg|srv|action)/([A-Za-z]\w*)", re.ASCII)
#: Line between two definitions.
MESSAGE_SEPARATOR = "=" * 80
#: Environment variables with the packages of ROS 2 and ROS 1, and the default folders.
_PREFIXES, _SOURCES = ("AMENT_PREFIX_PATH", "CMAKE_PREFIX_PATH"), "ROS_PACKAGE_PATH"
_USUAL = (Path("/usr/local"), Path("/usr"))


@dataclass(frozen=True, slots=True, eq=False)
class Definitions:
    """Files of definitions by type name in ROS 2 form, and by bare name where a file lies in no package.

    ``folders`` are those of packages of an installed ROS.
    """

    files: Mapping[str, Path | zipfile.Path] = field(default_factory=dict)
    folders: tuple[Path, ...] = ()

    def text_of(self, type_name: str) -> str:
        """Return the text of a type without the types it contains, or an empty string.

        The order is the user's files, shipped files, installed files.
        """
        package, _, name = type_name.partition("/msg/")
        path = self.files.get(type_name) or self.files.get(name if package else "")
        path = path or self.installed(type_name)
        if path is None:
            return shipped_definition(type_name)
        with path.open("rb") as file:
            return file.read(MOST_BYTES).decode("utf-8-sig", errors="replace").replace("\r\n", "\n")

    def installed(self, type_name: str) -> Path | None:
        """Return the file of a type that only an installed ROS or a sourced workspace defines."""
        match = _TYPE_NAME.fullmatch(type_name)
        if match is None or type_name in self.files or match[2] in self.files or shipped_definition(type_name):
            return None
        return next((path for path in self._places(match[1], match[2]) if path.is_file()), None)

    def _places(self, package: str, name: str) -> Iterator[Path]:
        file = Path("msg", f"{name}.msg")
        for folder in self.folders:
            if folder.name == package:
                yield folder / file
            yield folder / package / file
            yield from sorted(folder.glob(f"*/{package}/{file.as_posix()}"))


#: Shipped definitions only, without the user's and the machine's.
SHIPPED = Definitions()


@cache
def _of_machine(prefixes: str, sources: str) -> Definitions:
    """Return shipped and installed definitions: sourced workspaces first, then the newest distribution."""
    named, given = ([Path(p) for p in paths.split(os.pathsep) if p] for paths in (prefixes, sources))
    installed = [*named, *sorted(Path("/opt/ros").glob("*"), reverse=True), *_USUAL]
    return Definitions(folders=tuple(dict.fromkeys([*(prefix / "share" for prefix in installed), *given])))


def dbc_files(place: Path | str | None) -> tuple[Path, ...]:
    """Return a DBC file, or the DBC files of a folder."""
    if place is None:
        return ()
    place = Path(place)
    return tuple(sorted(place.rglob("*.dbc"))) if place.is_dir() else (place,) * (place.suffix.lower() == ".dbc")


def read_definitions(place: Path | str | None) -> Definitions:
    """Find the definitions in a folder of ``.msg`` files, of packages, in a workspace, a zip file or a wheel.

    ``PACKAGE/msg/Name.msg`` and ``PACKAGE/Name.msg`` are ``PACKAGE/msg/Name``; a file that lies in the folder itself
    defines its name in any package. None: only shipped and installed definitions.

    Raises
    ------
    UsageError : It is neither folder nor archive, or contains no definition.
    """
    prefixes = os.pathsep.join(os.environ.get(name, "") for name in _PREFIXES)
    machine = _of_machine(prefixes, os.environ.get(_SOURCES, ""))
    if place is None:
        return machine
    place = Path(place)
    is_archive = place.is_file() and zipfile.is_zipfile(place)
    files: dict[str, Path | zipfile.Path] = {}
    if is_archive:
        archive = zipfile.ZipFile(place)
        inside = _named(map(Path, sorted(n for n in archive.namelist() if n.endswith(".msg"))), Path(), in_archive=True)
        files |= {name: zipfile.Path(archive, path.as_posix()) for name, path in inside.items()}
    elif place.is_dir():
        files |= _named(sorted(place.rglob("*.msg")), place)
    if not files:
        raise UsageError(
            expected="a folder, zip file or wheel with .msg files, packages or a workspace",
            got="one without any" if is_archive or place.is_dir() else "neither folder nor archive",
            where=str(place),
            remedy="give the package's source, or /opt/ros/DISTRO/share of the machine that recorded",
        )
    return replace(machine, files=files)


def _named(paths: Iterable[Path], root: Path, *, in_archive: bool = False) -> dict[str, Path]:
    """Return files by type name, and by bare name where they lie in the root itself."""
    files: dict[str, Path] = {}
    for number, path in enumerate(paths):
        if number >= MOST_FILES:
            break
        above = path.parent.parent if path.parent.name == "msg" else path.parent
        # The folder of a single package can be given: it contains a package.xml, a folder of files does not.
        if root in (path.parent, above) and (in_archive or not (above / "package.xml").is_file()):
            files.setdefault(path.stem, path)
        package = above.name if in_archive else above.resolve().name
        files.setdefault(f"{package}/msg/{path.stem}", path)
    return files


def schema_file(name: str) -> Traversable:
    """Return a file of ``schemas/`` by its relative name, in an installed package or in a source tree."""
    shipped = files("pdhef_logtool").joinpath("schemas", name)
    return shipped if shipped.is_file() else Path(__file__).parents[2] / "schemas" / name


@cache
def shipped_definition(type_name: str) -> str:
    """Return the text of a shipped type without the types it contains, or an empty string."""
    if not _TYPE_NAME.fullmatch(type_name):
        return ""
    file = schema_file(f"{type_name}.msg")
    return file.read_text(encoding="utf-8") if file.is_file() else ""


@cache
def message_definition(type_name: str) -> str:
    """Return the ros2msg text of a message type with all types it contains.

    Own types (``pdhef_msgs``) come from ``schemas/``, common ROS 2 types from the latest distribution.

    Parameters
    ----------
    type_name : in ROS 2 form, for example ``sensor_msgs/msg/Imu``.

    Raises
    ------
    KeyError : the type is in neither, or the name is invalid.
    """
    if not _TYPE_NAME.fullmatch(type_name):
        raise KeyError(type_name)
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.LATEST)
    if text := shipped_definition(type_name):
        types = get_types_from_msg(text, type_name)
        store.register(with_contained_types(types, store.fielddefs, shipped_definition))
        generated = store.generate_msgdef(type_name, ros_version=2)[0]
        # Keep the comments of the shipped text: they contain the units.
        _, separator, rest = generated.partition(MESSAGE_SEPARATOR)
        return text.rstrip("\n") + "\n" + separator + rest
    if type_name not in store.fielddefs:
        raise KeyError(type_name)
    return store.generate_msgdef(type_name, ros_version=2)[0]


def with_contained_types(
    types: Mapping[str, Any], distributed: Mapping[str, Any], text_of: Callable[[str], str], wanted: str = ""
) -> dict[str, Any]:
    """Return types with all types that they contain, at any depth.

    Parameters
    ----------
    distributed : types of a distribution. text_of : returns the definition of any other type.
    wanted : name of a further type.
    """
    from rosbags.typesys import get_types_from_msg

    completed = dict(types)
    todo = ({wanted} if wanted else set()) | (referenced(types) - set(types))
    while todo:
        name = todo.pop()
        if name in distributed:
            completed[name] = distributed[name]
        else:
            completed |= get_types_from_msg(text_of(name), name)
        todo |= referenced({name: completed[name]}) - set(completed)
    return completed


def referenced(types: Mapping[str, Any]) -> set[str]:
    """Return the names of the types that types contain directly."""
    from rosbags.interfaces import Nodetype

    names: set[str] = set()
    for _, members in types.values():
        for _, (kind, args) in members:
            inner_kind, inner = (kind, args) if kind in (Nodetype.BASE, Nodetype.NAME) else args[0]
            if inner_kind == Nodetype.NAME:
                names.add(inner)
    return names
