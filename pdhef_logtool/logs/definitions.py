"""Message definitions for logs that hold none: a folder of the user's, and a few common packages that are shipped."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from pdhef_logtool.logs.schema_files import shipped_definition
from pdhef_logtool.records.documents import read_text
from pdhef_logtool.records.errors import UsageError

#: A workspace with more files is more than messages, and a longer text is no message.
MOST_FILES = 50_000
MOST_BYTES = 1 << 20


@dataclass(frozen=True, slots=True, eq=False)
class Definitions:
    """Files of definitions by type name in ROS 2 form, and by bare name where a file lies in no package."""

    files: Mapping[str, Path] = field(default_factory=dict)

    def text_of(self, type_name: str) -> str:
        """Return the text of a type without the types it contains; empty where there is none.

        The user's files come first, then what is shipped.
        """
        package, _, name = type_name.partition("/msg/")
        path = self.files.get(type_name) or self.files.get(name if package else "")
        if path is None:
            return shipped_definition(type_name)
        return read_text(path)[:MOST_BYTES]


#: What there is without a folder of the user's.
SHIPPED = Definitions()


def read_definitions(folder: Path | None) -> Definitions:
    """Find the definitions in a folder of ``.msg`` files, of packages, or in a workspace; None gives those shipped.

    ``PACKAGE/msg/Name.msg`` and ``PACKAGE/Name.msg`` are ``PACKAGE/msg/Name``; a file that lies in the folder itself
    stands for its name in any package.

    Raises
    ------
    UsageError : It is no folder, or holds no definition.
    """
    if folder is None:
        return SHIPPED
    files: dict[str, Path] = {}
    for number, path in enumerate(sorted(folder.rglob("*.msg")) if folder.is_dir() else ()):
        if number >= MOST_FILES:
            break
        above = path.parent.parent if path.parent.name == "msg" else path.parent
        own = path.parent == folder or (path.parent.name == "msg" and path.parent.parent == folder)
        # A package's own folder may be given as well: package.xml tells it from a folder of files.
        if own and not (above / "package.xml").is_file():
            files.setdefault(path.stem, path)
        files.setdefault(f"{above.resolve().name}/msg/{path.stem}", path)
    if not files:
        raise UsageError(
            expected="a folder that holds .msg files, packages or a workspace",
            got="one without any" if folder.is_dir() else "no folder",
            where=str(folder),
            remedy="give the folder of the package's source, or /opt/ros/DISTRO/share of the machine that recorded",
        )
    return Definitions(files)
