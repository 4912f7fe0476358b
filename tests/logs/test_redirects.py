"""Redirects of a web server: to public addresses and to its own host, elsewhere only where an option allows it."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("aiohttp", reason="reads http://: pip install 'pdhef-logtool[http]'")

import aiohttp

from pdhef_logtool import Car, ReadOptions, read_drive
from pdhef_logtool.cli.app import app
from pdhef_logtool.logs import remote_source
from pdhef_logtool.logs.discovery import LogInput, identity_of
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.redirect_guard import PrivateRedirectError, RedirectGuard, is_public
from pdhef_logtool.logs.remote_place import RemotePlace
from pdhef_logtool.records.errors import EXIT_FAILURE, EXIT_OK, LogError, PdhefError
from tests.counting_server import CountingServer, Fault, serving, status


@pytest.fixture(autouse=True)
def _alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote_source, "WAITS_S", ())
    for name in ("http_proxy", "HTTP_PROXY", "https_proxy", "HTTPS_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def server(sample_logs_dir: Path) -> Iterator[CountingServer]:
    with serving(**{"dlc.mcap": (sample_logs_dir / "dlc.mcap").read_bytes()}) as of:
        yield of


def _redirecting(to: str, code: int = 302) -> Fault:
    return status(code, {"Location": to}, of="away.mcap")


def _named(monkeypatch: pytest.MonkeyPatch, **addresses: list[str]) -> None:
    """Make names of this test (``NAME.test``) resolve to addresses, the last for good."""

    async def resolve(_: object, host: str, port: int = 0, family: int = 0) -> list[dict[str, Any]]:
        of_name = addresses.get(host.lower().rstrip(".").removesuffix(".test"))
        if of_name is None:
            raise OSError(None, "no such host")
        address = of_name.pop(0) if len(of_name) > 1 else of_name[0]
        return [{"hostname": host, "host": address, "port": port, "family": socket.AF_INET, "proto": 0, "flags": 0}]

    monkeypatch.setattr(aiohttp.DefaultResolver, "resolve", resolve)


TARGETS = {
    "by its name": "http://localhost:{port}/dlc.mcap",
    "as a number": "http://2130706433:{port}/dlc.mcap",
    "in IPv6": "http://[::1]:{port}/dlc.mcap",
    "mapped to IPv6": "http://[::ffff:127.0.0.1]:{port}/dlc.mcap",
    "of a link": "http://169.254.169.254/latest/meta-data",
    "of a network": "http://10.0.0.1/dlc.mcap",
    "unspecified": "http://0.0.0.0:{port}/dlc.mcap",
}


@pytest.mark.parametrize("target", TARGETS.values(), ids=TARGETS)
@pytest.mark.parametrize("code", [302, 307])
def test_a_redirect_to_another_private_host_is_refused(server: CountingServer, target: str, code: int) -> None:
    server.fault = _redirecting(target.format(port=server.url.rpartition(":")[2]), code)
    place = RemotePlace(server.place("away.mcap"))
    for use in (open_log, lambda p: identity_of(LogInput(p, "x"))):
        with pytest.raises(LogError) as refused:
            use(place)
        assert "a redirect to " in refused.value.got
        assert "allow_private_redirects=true" in refused.value.remedy
        assert "\n" not in str(refused.value)
    assert {r.path for r in server.requests} == {"away.mcap"}, "nothing else was asked for"


def test_a_redirect_on_the_same_host_is_followed(server: CountingServer) -> None:
    server.fault = _redirecting("/dlc.mcap")
    with serving(**server.files) as other:
        for to in ("/dlc.mcap", server.place("dlc.mcap"), other.place("dlc.mcap")):
            server.fault = _redirecting(to)
            with closing(open_log(RemotePlace(f"{server.place('away.mcap')}?{len(to)}"))) as log:
                assert log.lost == ()


def _exit_code(*arguments: object) -> int:
    try:
        return app([str(a) for a in arguments], prog_name="pdhef", standalone_mode=False) or EXIT_OK
    except PdhefError as error:
        return error.exit_code


def test_an_option_allows_it(server: CountingServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    server.fault = _redirecting(server.place("dlc.mcap").replace("127.0.0.1", "localhost"))
    url = server.place("away.mcap")
    with (
        pytest.raises(LogError, match="a redirect to localhost, an address of this machine or its network"),
        read_drive(url, Car.load("saloon")),
    ):
        pass
    with read_drive(url, "saloon", options=ReadOptions(allow_private_redirects=True)) as drive:
        assert drive.losses == ()
    assert _exit_code("inspect", url, "--fields") == EXIT_FAILURE
    assert _exit_code("inspect", url, "--fields", "--set", "allow_private_redirects=true") == EXIT_OK
    (tmp_path / "pdhef.toml").write_text("allow_private_redirects = true\n")
    monkeypatch.chdir(tmp_path)
    assert _exit_code("inspect", url, "--fields") == EXIT_OK


def test_a_public_host_may_redirect_to_public_ones_alone(
    server: CountingServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pdhef_logtool.logs.redirect_guard.is_public", lambda ip: ip.startswith("127."))
    port = server.url.rpartition(":")[2]
    _named(monkeypatch, one=["127.0.0.1"], two=["127.0.0.1"], inside=["10.0.0.1"])
    for name, followed in (("two", True), ("inside", False)):
        server.fault = _redirecting(f"http://{name}.test:{port}/dlc.mcap")
        place = RemotePlace(f"http://one.test:{port}/away.mcap?{name}")
        if followed:
            open_log(place).close()
        else:
            with pytest.raises(LogError, match=r"a redirect to inside\.test"):
                open_log(place)


def test_a_name_that_turns_private_is_not_connected_to(monkeypatch: pytest.MonkeyPatch) -> None:
    _named(monkeypatch, origin=["8.8.8.8", "127.0.0.1"], other=["8.8.4.4", "10.0.0.1"], intranet=["10.1.1.1"])

    async def resolved() -> None:
        guard = RedirectGuard("origin.test")
        for name in ("origin.test", "other.test"):
            assert await guard.resolve(name)
            with pytest.raises(PrivateRedirectError):
                await guard.resolve(name)
        assert await RedirectGuard("intranet.test").resolve("Intranet.test.")
        monkeypatch.setenv("HTTPS_PROXY", "http://user:word@intranet.test:3128")
        assert await RedirectGuard("origin.test").resolve("intranet.test")

    asyncio.run(resolved())


PUBLIC = {
    "8.8.8.8": True, "2001:4860:4860::8888": True, "64:ff9b::808:808": True, "::ffff:8.8.8.8": True,
    "127.0.0.1": False, "10.1.2.3": False, "172.16.0.1": False, "192.168.1.1": False, "169.254.169.254": False,
    "100.64.0.1": False, "0.0.0.0": False, "224.0.1.1": False, "255.255.255.255": False, "240.0.0.1": False,
    "::1": False, "::": False, "fe80::1%eth0": False, "fd00::1": False, "::ffff:127.0.0.1": False,
    "::ffff:10.0.0.1": False, "64:ff9b::7f00:1": False, "2002:7f00:1::": False, "ff02::1": False,
}  # fmt: skip


@pytest.mark.parametrize("address", PUBLIC)
def test_which_addresses_are_public(address: str) -> None:
    assert is_public(address) is PUBLIC[address]
