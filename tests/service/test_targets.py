"""No address that a client can think of leads a webhook inside."""

from __future__ import annotations

import asyncio
import ipaddress
from typing import TYPE_CHECKING, Any

import pytest

from service.targets import TargetRefused, Targets, is_public, parse
from worker.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Sequence

PUBLIC = "93.184.215.14"


def settings(**more: object) -> Settings:
    return Settings.model_validate({"redis_url": "redis://localhost", **more})


def addresses(url: str, found: Sequence[str] | None = None, **more: object) -> list[str]:
    """What a webhook would connect to; names resolve to what is given, else as on this system."""
    if found is None:
        targets = Targets(settings(**more))
    else:

        async def resolve(host: str, port: int) -> Sequence[str]:
            return found

        targets = Targets(settings(**more), resolve)
    return asyncio.run(targets.addresses(targets.parse(url)))


@pytest.mark.parametrize(
    "address",
    [
        "0.0.0.0",
        "0.1.2.3",
        "10.0.0.1",
        "100.64.0.1",
        "127.0.0.1",
        "127.255.255.254",
        "169.254.169.254",
        "172.16.0.1",
        "172.31.255.255",
        "192.0.0.8",
        "192.0.2.1",
        "192.88.99.1",
        "192.168.1.1",
        "198.18.0.1",
        "198.51.100.1",
        "203.0.113.1",
        "224.0.0.1",
        "239.255.255.250",
        "240.0.0.1",
        "255.255.255.255",
        "::",
        "::1",
        "::127.0.0.1",
        "::ffff:127.0.0.1",
        "::ffff:93.184.215.14",
        "::ffff:0:127.0.0.1",
        "64:ff9b::127.0.0.1",
        "64:ff9b::a9fe:a9fe",
        "64:ff9b:1::1",
        "100::1",
        "2001::1",
        "2001:db8::1",
        "2002:7f00:1::1",
        "3fff::1",
        "4000::1",
        "fc00::1",
        "fd00:ec2::254",
        "fe80::1",
        "fec0::1",
        "ff02::1",
        "ff0e::1",
    ],
)
def test_addresses_that_are_not_public(address: str) -> None:
    assert not is_public(ipaddress.ip_address(address))
    host = f"[{address}]" if ":" in address else address
    with pytest.raises(TargetRefused):
        addresses(f"https://{host}/hook")
    with pytest.raises(TargetRefused, match="public"):
        addresses("https://example.org/hook", [address])
    with pytest.raises(TargetRefused, match="public"):
        addresses("https://example.org/hook", [PUBLIC, address])


@pytest.mark.parametrize("address", [PUBLIC, "8.8.8.8", "2606:4700:4700::1111", "2a00:1450::1"])
def test_addresses_that_are_public(address: str) -> None:
    assert is_public(ipaddress.ip_address(address))
    host = f"[{address}]" if ":" in address else address
    assert addresses(f"https://{host}/hook") == [address]
    assert addresses("https://example.org/hook", [address, address]) == [address]


@pytest.mark.parametrize(
    "url",
    [
        "",
        "example.org",
        "//example.org",
        "http://example.org/",
        "ftp://example.org/",
        "file:///etc/passwd",
        "gopher://example.org/",
        "HTTPS:example.org",
        "https://",
        "https:///hook",
        "https://.",
        "https://user@example.org/",
        "https://user:password@example.org/",
        "https://:@example.org/",
        "https://@example.org/",
        "https://example.org@127.0.0.1/",
        "https://127.0.0.1#@example.org/",
        "https://example.org\\@127.0.0.1/",
        "https://example.org/#fragment",
        "https://example.org/ hook",
        "https://example.org/\r\nX: y",
        "https://example.org/\x00",
        "https://exämple.org/",
        "https://①②⑦.⓪.⓪.①/",
        "https://example.org:22/",
        "https://example.org:25/",
        "https://example.org:0/",
        "https://example.org:65536/",
        "https://example.org:-1/",
        "https://2130706433/",
        "https://017700000001/",
        "https://0x7f000001/",
        "https://0x7f.1/",
        "https://127.1/",
        "https://127.0.0.1./",
        "https://0177.0.0.1/",
        "https://127.0.0.0x1/",
        "https://1.2.3.4.5/",
        "https://[::1",
        "https://[::1%25lo]/",
        "https://[fe80::1%25eth0]/",
        "https://[v1.fe80]/",
        "https://ex%61mple.org/",
        "https://127%2e0.0.1/",
        "https://exa mple.org/",
        "https://example..org/",
        "https://" + "a" * 64 + ".org/",
        "https://example.org/" + "a" * 2048,
    ],
)
def test_forms_that_are_refused(url: str) -> None:
    with pytest.raises(TargetRefused):
        addresses(url, [PUBLIC])
    if not url.startswith("http://"):
        with pytest.raises(TargetRefused):
            addresses(url, [PUBLIC], webhook_http=True)


@pytest.mark.parametrize(
    ("url", "host", "port"),
    [
        ("https://example.org", "example.org", 443),
        ("https://EXAMPLE.org./hook?key=1", "example.org", 443),
        ("https://xn--exmple-cua.org:8443/", "xn--exmple-cua.org", 8443),
        ("https://example.org:80/", "example.org", 80),
        ("https://[2606:4700::1]:4443/a/b", "2606:4700::1", 4443),
        ("https://a_b.example.org/", "a_b.example.org", 443),
        ("https://1.2.3.example/", "1.2.3.example", 443),
    ],
)
def test_forms_that_are_taken(url: str, host: str, port: int) -> None:
    target = parse(url)
    assert (target.host, target.port) == (host, port)


def test_names_of_this_machine_are_refused() -> None:
    with pytest.raises(TargetRefused):
        addresses("https://localhost/")
    with pytest.raises(TargetRefused, match="resolved"):
        addresses("https://nobody.invalid/")


def test_what_the_operator_allows() -> None:
    more: dict[str, Any] = {"webhook_http": True, "webhook_allow": "127.0.0.0/8, ::1/128"}
    assert addresses("http://127.0.0.1:9000/", **more) == ["127.0.0.1"]
    assert addresses("http://[::1]:9000/", **more) == ["::1"]
    assert addresses("http://inside.example/", ["127.0.0.1", PUBLIC], **more) == [
        "127.0.0.1",
        PUBLIC,
    ]
    for other in ("10.0.0.1", "::ffff:127.0.0.1", "169.254.169.254"):
        with pytest.raises(TargetRefused):
            addresses("http://inside.example/", [other], **more)
