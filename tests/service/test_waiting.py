from __future__ import annotations

import pytest

from service.waiting import MAX_WAIT_SECONDS, preferred_wait


@pytest.mark.parametrize(
    ("headers", "seconds"),
    [
        (["wait=10"], 10),
        (["respond-async, wait=10"], 10),
        (["WAIT = 7 ; foo=bar"], 7),
        (['wait="5"'], 5),
        (["handling=lenient", "wait=3"], 3),
        (["wait=1, wait=9"], 1),  # RFC 7240, section 2: the first one counts
        (["wait=0"], 0),
        (["wait=100000"], MAX_WAIT_SECONDS),
        (["wait=-1"], None),
        (["wait=soon"], None),
        (["wait"], None),
        (["return=minimal"], None),
        (["waiting=5"], None),
        ([""], None),
        ([], None),
    ],
)
def test_the_wait_of_prefer_headers(headers: list[str], seconds: int | None) -> None:
    assert preferred_wait(headers) == seconds
