"""Sound files of every format that is read, and ways to damage them."""

from __future__ import annotations

import gzip
import io
import os
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
import scipy.io

if TYPE_CHECKING:
    import random
    from collections.abc import Callable

CASES = int(os.environ.get("SMSR_MUTATIONS", "0"))
"""Damaged files of each format that are asked for; without it each test makes a few."""

rng = np.random.default_rng(0)
W = rng.standard_normal((12, 15))
S = rng.standard_normal((18, 15)).astype(np.float32)
FACES = rng.integers(0, 15, (9, 3), dtype=np.int32)


def by_numpy(save: Callable[..., Any], *arrays: Any, **named: Any) -> bytes:
    buffer = io.BytesIO()
    save(buffer, *arrays, **named)
    return buffer.getvalue()


def by_scipy(*, compress: bool) -> bytes:
    buffer: Any = io.BytesIO()
    cells = np.array([W, "x"], dtype=object)
    content = {"W": W, "GT": {"name": "x", "shape3D": S}, "faces": FACES, "cells": cells}
    scipy.io.savemat(buffer, content, do_compression=compress)
    return bytes(buffer.getvalue())


def by_h5py() -> bytes:
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        file.create_dataset("W", data=W.T, chunks=(5, 12), compression="gzip", shuffle=True)
        file["GT/shape3D"] = S
        file.create_dataset("faces", data=FACES, chunks=(9, 2), compression="lzf")
        file["W"].attrs["MATLAB_class"] = np.bytes_("double")
    return buffer.getvalue()


def by_savetxt(**how: Any) -> bytes:
    buffer = io.BytesIO()
    np.savetxt(buffer, W, **how)
    return buffer.getvalue()


SOUND: dict[str, Callable[[], bytes]] = {
    "c.npy": lambda: by_numpy(np.save, W),
    "fortran.npy": lambda: by_numpy(np.save, np.asfortranarray(S.reshape(6, 3, 15))),
    "stored.npz": lambda: by_numpy(np.savez, W=W, S=S, faces=FACES),
    "deflated.npz": lambda: by_numpy(np.savez_compressed, W=W, S=S, faces=FACES),
    "plain.mat": lambda: by_scipy(compress=False),
    "compressed.mat": lambda: by_scipy(compress=True),
    "w.h5": by_h5py,
    "commas.csv": lambda: by_savetxt(delimiter=",", header="a,b"),
    "blanks.txt": lambda: by_savetxt(fmt="%g"),
    "packed.csv.gz": lambda: gzip.compress(by_savetxt(delimiter=";", fmt="%g")),
}

EXTREMES = [0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1]


def mutated(content: bytes, random_: random.Random) -> bytes:
    """Change a file in one to three ways, more often near its ends, where headers stand."""
    data = bytearray(content)
    for _ in range(random_.choice([1, 1, 2, 3])):
        if not data:
            break
        near = min(len(data), random_.choice([64, 512, len(data)]))
        at = random_.randrange(near) if random_.random() < 0.7 else len(data) - 1
        at -= random_.randrange(near) if at == len(data) - 1 else 0
        at = max(at, 0)
        match random_.randrange(8):
            case 0:
                del data[at:]
            case 1:
                data[at] ^= 1 << random_.randrange(8)
            case 2:
                data[at] = random_.choice([0, 1, 0x7F, 0x80, 0xFF, random_.randrange(256)])
            case 3:
                size = random_.choice([1, 2, 4, 8])
                value = random_.choice(EXTREMES) & (2 ** (8 * size) - 1)
                data[at : at + size] = value.to_bytes(size, random_.choice(["little", "big"]))
            case 4:
                del data[at : at + random_.choice([1, 2, 8, 100])]
            case 5:
                data[at:at] = data[at : at + random_.choice([1, 8, 100])]
            case 6:
                data[at:at] = random_.randbytes(random_.choice([1, 4, 16]))
            case 7:  # digits of a text or of a header
                digits = [i for i, byte in enumerate(data[:2000]) if 48 <= byte <= 57]
                if digits:
                    data[random_.choice(digits)] = random_.choice(b"0123456789-.eLj(),'")
    return bytes(data)
