from __future__ import annotations

import pytest

from smsr_client import AsyncClient, Client, ClientError, WrongAddress


@pytest.mark.parametrize(
    "address",
    [
        "http://127.0.0.1:8000",
        "https://smsr.example.org",
        "HTTP://localhost:8000/prefix",
        "http://[::1]:8000",
        "http://user:word@host",
        "https://m\u00fcnchen.example",
    ],
)
@pytest.mark.parametrize("kind", [Client, AsyncClient])
def test_an_address_is_taken_as_it_is(kind: type[Client | AsyncClient], address: str) -> None:
    assert kind(address).server == address
    assert kind(f"{address}/").server == address


@pytest.mark.parametrize(
    ("address", "right"),
    [
        ("localhost:8431", "write http://localhost:8431."),
        ("foo", "write http://foo."),
        ("10.1.2.3:80/prefix", "write http://10.1.2.3:80/prefix."),
        ("[::1]:8000", "write http://[::1]:8000."),
        ("", "as http://127.0.0.1:8000."),
        ("no address", "as http://127.0.0.1:8000."),
        ("http://no address", "as http://127.0.0.1:8000."),
        ("ftp://localhost", "as http://127.0.0.1:8000."),
        ("http://", "as http://127.0.0.1:8000."),
        ("http:///path", "as http://127.0.0.1:8000."),
        ("http:/localhost", "as http://127.0.0.1:8000."),
        ("//localhost", "as http://127.0.0.1:8000."),
        ("/path", "as http://127.0.0.1:8000."),
        ("http://localhost:port", "as http://127.0.0.1:8000."),
        ("http://localhost:99999", "as http://127.0.0.1:8000."),
        ("localhost:0", "as http://127.0.0.1:8000."),
        ("http://[::1", "as http://127.0.0.1:8000."),
        ("http://xn--", "as http://127.0.0.1:8000."),
        ("http://localhost\n", "as http://127.0.0.1:8000."),
    ],
)
@pytest.mark.parametrize("kind", [Client, AsyncClient])
def test_what_is_no_address_is_refused_with_what_would_be_one(
    kind: type[Client | AsyncClient], address: str, right: str
) -> None:
    with pytest.raises(WrongAddress) as caught:
        kind(address)
    assert isinstance(caught.value, ClientError)
    assert str(caught.value).startswith(repr(address))
    assert str(caught.value).endswith(right)
