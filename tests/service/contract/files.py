"""Files that Schemathesis sends: sound ones of every role, and others."""

from __future__ import annotations

import io

import numpy as np
import schemathesis
from hypothesis import strategies as st

from smsr.synthetic import make_example

EXAMPLE = make_example(frames=8, side=4)


def npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


SOUND = [npy(EXAMPLE.measurements), npy(EXAMPLE.ground_truth), npy(EXAMPLE.faces)]

for media_type in ("application/octet-stream", "application/offset+octet-stream"):
    schemathesis.openapi.media_type(
        media_type, st.one_of(st.sampled_from(SOUND), st.binary(max_size=300))
    )


@schemathesis.serializer("application/offset+octet-stream")
def as_it_is(ctx: schemathesis.SerializationContext, value: bytes) -> bytes:
    return value
