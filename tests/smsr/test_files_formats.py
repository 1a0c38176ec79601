from __future__ import annotations

import gzip
import re
from typing import TYPE_CHECKING

import h5py
import numpy as np
import pytest
import scipy.io

from smsr.errors import UnsupportedFormat
from smsr.files import SUFFIXES, open_array, sniff
from tests.conftest import ROOT

if TYPE_CHECKING:
    from pathlib import Path

W = np.arange(60.0).reshape(6, 10)


def write(path: Path) -> None:
    """Write what files of such a name hold, by the libraries that write them."""
    match path.suffix:
        case ".npy":
            np.save(path, W)
        case ".npz":
            np.savez(path, W=W)
        case ".mat":
            scipy.io.savemat(path, {"W": W})
        case ".h5" | ".hdf5":
            with h5py.File(path, "w") as file:
                file["W"] = W
        case ".gz":
            write(path.with_suffix(""))
            path.write_bytes(gzip.compress(path.with_suffix("").read_bytes()))
        case ".csv" | ".dat":
            np.savetxt(path, W, delimiter=",")
        case ".txt" | ".tsv":
            np.savetxt(path, W, delimiter="\t")
        case _:
            raise AssertionError(f"nothing writes {path.suffix}")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_files_of_every_name_are_read(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"w{suffix}"
    write(path)
    np.testing.assert_array_equal(open_array(path), W)


@pytest.mark.parametrize("head", [b"\x89PNG\r\n", b"\x00\x01\x02"])
def test_what_cannot_be_read_is_told_all_that_can(head: bytes) -> None:
    with pytest.raises(UnsupportedFormat) as caught:
        sniff(head, "w.bin")
    for suffix in SUFFIXES:
        assert re.search(rf" {re.escape(suffix)}(,| and |\.)", caught.value.detail), suffix


def test_the_documentation_has_the_same_formats() -> None:
    table = (ROOT / "docs" / "formats.md").read_text().partition("The content decides")[0]
    named = [name for row in table.splitlines()[6:] for name in row.split("|")[2:3]]
    assert tuple(re.findall(r"`(\.[a-z0-9.]+)`", " ".join(named))) == SUFFIXES
