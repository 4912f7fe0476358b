"""Check of redirects of web servers: to public addresses and within the same host only.

A log's server may be malicious: a redirect could make this machine send requests to itself or to its network. So the
target of each redirect is checked, and also the addresses of each connection, as names can change in between.
"""

import ipaddress
import socket
from typing import Any
from urllib.parse import urlsplit
from urllib.request import getproxies

#: Translates IPv4 addresses, which are the last 32 bits.
_NAT64 = ipaddress.ip_network("64:ff9b::/96")


class PrivateRedirectError(Exception):
    """A redirect leads to a host that is not public; its text names the host."""


def is_public(address: str) -> bool:
    """Return whether an IP address is reached over the internet, and not only on this machine or its network."""
    ip = ipaddress.ip_address(address.partition("%")[0])
    if isinstance(ip, ipaddress.IPv6Address):
        inner = ip.ipv4_mapped or ip.sixtofour or (ip.teredo[1] if ip.teredo else None)
        if ip in _NAT64:
            inner = ipaddress.IPv4Address(int(ip) & 0xFFFFFFFF)
        if inner is not None:
            return is_public(str(inner))
    return ip.is_global and not ip.is_multicast


class RedirectGuard:
    """A resolver of aiohttp for requests to one server, which checks their redirects.

    Parameters
    ----------
    origin : host of the URL that the user gave; it may have any address, but not change from a public one to others.
    """

    def __init__(self, origin: str) -> None:
        import aiohttp

        self._origin = _host(origin)
        self._origin_was_public = False
        proxies = (urlsplit(proxy if "//" in proxy else f"//{proxy}").hostname for proxy in getproxies().values())
        self._proxies = frozenset(_host(host) for host in proxies if host)
        self._resolver = aiohttp.DefaultResolver()

    async def resolve(self, host: str, port: int = 0, family: socket.AddressFamily = socket.AF_INET) -> list[Any]:
        """Return the addresses of a host to connect to; raises PrivateRedirectError."""
        addresses = await self._resolver.resolve(host, port, family)
        public = all(is_public(address["host"]) for address in addresses)
        name = _host(host)
        if not public and (self._origin_was_public if name == self._origin else name not in self._proxies):
            raise PrivateRedirectError(name)
        self._origin_was_public |= public and name == self._origin
        return addresses

    async def check_redirect(self, _session: Any, _context: Any, redirect: Any) -> None:
        """Raise PrivateRedirectError for a redirect to another host that is not public."""
        import yarl

        headers = redirect.response.headers
        host = _host(redirect.response.url.join(yarl.URL(headers.get("Location") or headers.get("URI", ""))).raw_host)
        if host in ("", self._origin):
            return
        try:
            addresses = [str(ipaddress.ip_address(host))]
        except ValueError:
            try:
                addresses = [address["host"] for address in await self._resolver.resolve(host, 0, socket.AF_UNSPEC)]
            except OSError:  # a proxy may resolve it; without one the request fails
                return
        if not all(map(is_public, addresses)):
            raise PrivateRedirectError(host)

    async def close(self) -> None:
        """Release the resolver."""
        await self._resolver.close()


async def guarded_client(*, origin: str, **options: Any) -> Any:
    """Return a session of aiohttp that checks redirects of a server."""
    import aiohttp

    guard = RedirectGuard(origin)
    trace = aiohttp.TraceConfig()
    trace.on_request_redirect.append(guard.check_redirect)
    connector = aiohttp.TCPConnector(resolver=guard)  # type: ignore[arg-type]  # its base would need aiohttp
    return aiohttp.ClientSession(connector=connector, trace_configs=[trace], **options)


def _host(host: str | None) -> str:
    return (host or "").lower().rstrip(".").strip("[]")
