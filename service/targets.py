"""Where webhooks may go: protection against requests forged through the server (SSRF).

A client chooses the address of a webhook, and the service connects to it from inside the network of
its operator. So only public addresses are taken, and what was checked is what is connected to: a
name is resolved once for each attempt, all its addresses are judged, and the connection goes to one
of them, whatever the name resolves to a moment later.
"""

from __future__ import annotations

import asyncio
import ipaddress
import re
import socket
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import httpx

if TYPE_CHECKING:
    from worker.settings import Settings

Address: TypeAlias = ipaddress.IPv4Address | ipaddress.IPv6Address
Resolve: TypeAlias = Callable[[str, int], Awaitable[Sequence[str]]]
"""Gives the addresses of a name; raises OSError where there are none."""

MAX_URL = 2048
RESOLVE_SECONDS = 5.0
LOW_PORTS = frozenset({80, 443})
"""Ports below 1024 that are HTTP's; the others are other services'."""

_TRANSLATED = tuple(
    map(
        ipaddress.IPv6Network,
        (
            "::/96",  # IPv4-compatible (RFC 4291, section 2.5.5.1)
            "64:ff9b::/96",  # NAT64 (RFC 6052)
            "64:ff9b:1::/48",  # NAT64 of a local network (RFC 8215)
            "2001::/32",  # Teredo (RFC 4380)
            "2002::/16",  # 6to4 (RFC 3056)
        ),
    )
)
"""IPv6 addresses that carry an IPv4 address, which a gateway may turn them into."""

_UNICAST = ipaddress.IPv6Network("2000::/3")
_SPECIAL = tuple(
    map(
        ipaddress.ip_network,
        (
            "192.0.0.0/24",  # protocol assignments (RFC 6890)
            "192.88.99.0/24",  # relays of 6to4 (RFC 7526)
            "3fff::/20",  # documentation (RFC 9637)
        ),
    )
)
"""What `ipaddress` has not always known."""

_PLAIN = re.compile(r"[\x21-\x5b\x5d-\x7e]+")
"""Printable ASCII without the backslash, which some parsers take for a slash."""
_NUMBER = re.compile(r"[0-9]+|0[xX][0-9a-fA-F]*")
_NAME = re.compile(r"(?=.{1,253}$)([a-z0-9_]([a-z0-9_-]{0,61}[a-z0-9_])?\.)*[a-z0-9-]{1,63}\.?")


class TargetRefused(Exception):
    """An address that no webhook goes to; the message says why, for the client that named it."""


@dataclass(frozen=True, slots=True)
class Target:
    """The address of a webhook, whose form is right.

    Attributes
    ----------
    url : httpx.URL
    host : str
        In ASCII, IPv6 addresses without brackets.
    port : int
    """

    url: httpx.URL
    host: str
    port: int


def parse(text: str, *, http: bool = False) -> Target:
    """Read the address of a webhook.

    Parameters
    ----------
    text : str
    http : bool
        Whether http:// is allowed.

    Raises
    ------
    TargetRefused
        It is no address that webhooks may go to, whatever its name resolves to.
    """
    if len(text) > MAX_URL or not _PLAIN.fullmatch(text):
        raise TargetRefused(
            f"it is not at most {MAX_URL} printable ASCII characters without spaces and backslashes"
        )
    try:
        url = httpx.URL(text)
    except (httpx.InvalidURL, ValueError):
        raise TargetRefused("it is not a URL") from None
    schemes = ("https", "http") if http else ("https",)
    if url.scheme not in schemes:
        raise TargetRefused(f"it does not begin with {' or '.join(s + '://' for s in schemes)}")
    if url.userinfo or "@" in re.split(r"[/?#]", text.partition("//")[2], maxsplit=1)[0]:
        raise TargetRefused("it has a user name or a password")
    if url.fragment or "#" in text:
        raise TargetRefused("it has a fragment")
    host = url.raw_host.decode("ascii").lower()
    if not _is_address(host):
        labels = host.rstrip(".").split(".")
        if _NUMBER.fullmatch(labels[-1]):
            # WHATWG URL, section 3.5: such a host is an IPv4 address in another notation.
            raise TargetRefused("its host is a number")
        if not _NAME.fullmatch(host):
            raise TargetRefused("its host is not the name of one")
    host = host.rstrip(".")
    port = {"https": 443, "http": 80}[url.scheme] if url.port is None else url.port
    if port not in LOW_PORTS and not 1024 <= port < 65536:
        raise TargetRefused(f"its port is {port}; ports are 80, 443 and those from 1024 on")
    return Target(url, host, port)


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return "%" not in host


def is_public(address: Address) -> bool:
    """Whether an address is one of the public Internet, for one receiver."""
    if isinstance(address, ipaddress.IPv6Address) and (
        address not in _UNICAST
        or address.ipv4_mapped is not None
        or any(address in network for network in _TRANSLATED)
    ):
        return False
    if any(address in network for network in _SPECIAL):
        return False
    return address.is_global and not (
        address.is_multicast
        or address.is_reserved
        or address.is_private
        or address.is_loopback
        or address.is_link_local
        or address.is_unspecified
    )


async def resolve(host: str, port: int) -> Sequence[str]:
    """Return the addresses of a name, as the system resolves it, best first.

    Raises
    ------
    OSError
        The name cannot be resolved.
    """
    async with asyncio.timeout(RESOLVE_SECONDS):
        found = await asyncio.get_running_loop().getaddrinfo(
            host, port, type=socket.SOCK_STREAM, proto=socket.IPPROTO_TCP
        )
    return [str(address[0]) for *_, address in found]


class Targets:
    """Judges addresses by the settings of the operator.

    Parameters
    ----------
    settings : Settings
    resolve : callable
        Gives the addresses of a name.
    """

    def __init__(self, settings: Settings, resolve: Resolve = resolve) -> None:
        self._http = settings.webhook_http
        self._allowed = settings.webhook_networks
        self._resolve = resolve

    def parse(self, text: str) -> Target:
        """Read an address; see `parse`. Addresses given as numbers are judged too."""
        target = parse(text, http=self._http)
        if _is_address(target.host):
            self._judge([target.host])
        return target

    async def addresses(self, target: Target) -> list[str]:
        """Resolve a name and return its addresses, all of which may be connected to.

        Raises
        ------
        TargetRefused
            It has none, or one that no webhook goes to.
        """
        if _is_address(target.host):
            found: Sequence[str] = [target.host]
        else:
            try:
                found = await self._resolve(target.host, target.port)
            except (OSError, UnicodeError):  # a TimeoutError is an OSError
                found = []
        if not found:
            raise TargetRefused("its host cannot be resolved")
        self._judge(found)
        return list(dict.fromkeys(found))

    def _judge(self, found: Sequence[str]) -> None:
        for text in found:
            address = ipaddress.ip_address(text.partition("%")[0])
            if "%" in text or not (
                is_public(address) or any(address in network for network in self._allowed)
            ):
                # Which address it is would tell an outsider about the names of the inside.
                raise TargetRefused("its host is not on the public Internet")
