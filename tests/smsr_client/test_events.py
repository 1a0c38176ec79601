from __future__ import annotations

import itertools

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st

from smsr_client import ServerUnreachable, ServiceError
from smsr_client.events import EventDecoder, Following
from smsr_client.flows import Flows

STREAM = (
    ': a comment\r\nretry: 2000\n\nevent: job\ndata: {"a": "\u2028"}\nid: 7\n\n'
    "data: one\rdata:two\r\r:\n\nevent: nothing\n\nid: 8\ndata: last\n\nevent: cut off\ndata: x\n"
).encode()
EVENTS = [("job", '{"a": "\u2028"}'), ("message", "one\ntwo"), ("message", "last")]


@given(st.lists(st.integers(0, len(STREAM)), max_size=12))
def test_events_are_the_same_however_the_bytes_arrive(cuts: list[int]) -> None:
    places = [0, *sorted(cuts), len(STREAM)]
    decoder = EventDecoder()
    found = [
        event
        for begin, end in itertools.pairwise(places)
        for event in decoder.feed(STREAM[begin:end])
    ]
    assert found == EVENTS
    assert decoder.last_id == "8"


def test_a_deleted_job_is_told() -> None:
    following = Following(Flows("http://x", 60), "0" * 32)
    with pytest.raises(ServiceError) as caught:
        list(following.feed(b"event: deleted\ndata: {}\n\n"))
    assert (caught.value.status, caught.value.slug) == (404, "unknown-job")


def test_a_connection_that_breaks_is_made_again_for_as_long_as_there_is_patience() -> None:
    patient, hasty = (Following(Flows("http://x", patience), "0" * 32) for patience in (60, 0))
    pauses = [patient.broken(httpx.ReadError("broke")) for _ in range(3)]
    assert pauses == sorted(set(pauses))
    with pytest.raises(ServerUnreachable, match="http://x"):
        hasty.broken(httpx.ReadError("broke"))
    with pytest.raises(ServerUnreachable, match="'x://'"):
        patient.broken(httpx.UnsupportedProtocol("Request URL has the protocol 'x://'"))
    with pytest.raises(ServiceError):
        hasty.ended(httpx.Response(503))
    assert patient.ended(httpx.Response(503, headers={"Retry-After": "9"})) == 9
    with pytest.raises(ServiceError):
        patient.ended(httpx.Response(404))
