"""Location of a remote log: a URL, and the part of it that may be printed."""

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TypeAlias
from urllib.parse import SplitResult, parse_qsl, unquote, urlencode, urlsplit

from pdhef_logtool.records.errors import UsageError

SCHEMES = ("s3", "http", "https")
_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+)://")
#: Query parameters that give access or differ for each link are no part of an object's name.
_OF_ACCESS = re.compile(
    r"x-(amz|goog|ms|oss|cos)-.*|aws.*|google.*|signature|expires|policy|key-pair-id|sig|s[etprkv]|sk[a-z]+|"
    r".*(token|secret|password|credential|signature|auth|api[-_]?key).*",
    re.IGNORECASE,
)


@dataclass(frozen=True, repr=False)
class RemotePlace:
    """An object on a server. Its text has no user, password or query, as these can give access.

    ``private_redirects``: whether its server may redirect to other hosts of this machine and its network.
    """

    url: str
    private_redirects: bool = False

    @cached_property
    def _parts(self) -> SplitResult:
        return urlsplit(self.url)

    @property
    def scheme(self) -> str:
        """``s3``, ``http`` or ``https``."""
        return self._parts.scheme.lower()

    @property
    def host(self) -> str:
        """Server with port, or bucket."""
        return self._parts.netloc.rpartition("@")[2]

    @property
    def key(self) -> str:
        """Key in an object store: the part behind the bucket, unchanged."""
        return self.url.split("://", 1)[1].partition("/")[2]

    @property
    def parts(self) -> tuple[str, ...]:
        """Scheme and server, folders, name, as they are shown: no part is empty."""
        path = self.key if self.scheme == "s3" else unquote(self._parts.path)
        return (f"{self.scheme}://{self.host}", *filter(None, path.split("/")))

    @property
    def name(self) -> str:
        """Name of the object: the last component of its path."""
        return self.parts[-1] if len(self.parts) > 1 else self.host

    @property
    def parent(self) -> str:
        """Everything before the name."""
        return "/".join(self.parts[:-1])

    @property
    def identity(self) -> str:
        """The URL in a canonical form, without user, password and access tokens."""
        if self.scheme == "s3":
            return str(self)
        asked = [(k, v) for k, v in parse_qsl(self._parts.query, keep_blank_values=True) if not _OF_ACCESS.fullmatch(k)]
        return str(self) + (f"?{urlencode(asked)}" if asked else "")

    def __repr__(self) -> str:
        """Return the type and the text that may be shown."""
        return f"RemotePlace({str(self)!r})"

    def __str__(self) -> str:
        """Return the URL without user, password and query."""
        return "/".join(self.parts)


#: A file or folder of this machine, or an object on another.
LogPlace: TypeAlias = Path | RemotePlace


def place_of(argument: str, *, private_redirects: bool = False) -> LogPlace:
    """Return the place that an argument names; ``private_redirects`` as for :class:`RemotePlace`.

    Raises
    ------
    UsageError : A URL with another scheme or without a server.
    """
    match = _URL.match(argument)
    if match is None or Path(argument).exists():
        return Path(argument)
    place = RemotePlace(argument, private_redirects)
    try:
        valid = place.scheme in SCHEMES and bool(place.host)
    except ValueError:  # a malformed server
        valid = False
    if not valid:
        raise UsageError(
            expected=", ".join(f"{scheme}://" for scheme in SCHEMES) + " and a server or bucket",
            got=f"{match[1]}://",
            where=argument.split("?")[0].rpartition("@")[2],
            remedy="give such a URL, or a path of this machine",
        )
    return place
