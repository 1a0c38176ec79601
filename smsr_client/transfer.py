"""Files on their way: what is sent, what is fetched, and how far either is."""

from __future__ import annotations

import io
import os
from collections.abc import Callable
from http import HTTPStatus
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, TypeAlias

import httpx
import numpy as np

if TYPE_CHECKING:
    from typing import Self

    from numpy.typing import NDArray

AnyPath: TypeAlias = str | os.PathLike[str]

Transferred: TypeAlias = Callable[[int, int], object]
"""Called with the bytes that went over and the bytes in all, 0 where those are not known."""


class Counter:
    """Adds up bytes and reports them."""

    def __init__(self, total: int, report: Transferred | None) -> None:
        self._total, self._report, self._done = total, report, 0

    @property
    def done(self) -> int:
        """Bytes that went over."""
        return self._done

    def to(self, done: int) -> None:
        """Set what went over, in which a resumed upload goes back."""
        self._done = done
        self.add(0)

    def add(self, count: int) -> None:
        """Count more bytes."""
        self._done += count
        if self._report is not None:
            self._report(self._done, self._total)


class Source:
    """What is sent as one file: a file, or an array as ``.npy``.

    Parameters
    ----------
    what : path or ndarray
        Masked entries of a masked array become NaN.
    role : str
        What the file is to the job; an array is named after it.
    """

    def __init__(self, what: AnyPath | NDArray[Any], role: str) -> None:
        self._content: Path | bytes
        if isinstance(what, str | os.PathLike):
            self._content = Path(what)
            self.name, self.bytes = self._content.name, self._content.stat().st_size
        else:
            written = io.BytesIO()
            np.save(written, _unmasked(what), allow_pickle=False)
            self._content = written.getvalue()
            self.name, self.bytes = f"{role}.npy", len(self._content)

    def open(self, counter: Counter) -> Reader:
        """Open it for reading; what is read is counted."""
        content = self._content
        file = io.BytesIO(content) if isinstance(content, bytes) else content.open("rb", 0)
        return Reader(file, counter)


class Reader:
    """A binary file that reports how much of it was read."""

    def __init__(self, file: IO[bytes], counter: Counter) -> None:
        self._file, self._counter = file, counter
        self.seek, self.tell, self.close = file.seek, file.tell, file.close

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def read(self, size: int = -1, /) -> bytes:
        """Read and count."""
        data = self._file.read(size) or b""
        self._counter.add(len(data))
        return data


class PartialFile:
    """A file that is being fetched, over as many connections as it takes.

    Parameters
    ----------
    path : Path
        What has come in so far.
    progress : callable, optional
    """

    def __init__(self, path: Path, progress: Transferred | None) -> None:
        self._path, self._progress = path, progress
        self._tag = ""
        self._held = 0
        self._file: IO[bytes] | None = None
        self._counter = Counter(0, None)

    def headers(self) -> dict[str, str]:
        """Return the headers that ask for what is missing (RFC 9110, section 14)."""
        # Bytes of a range count as they are sent, so no coding may be laid over them.
        headers = {"Accept": "*/*", "Accept-Encoding": "identity"}
        self._held = self._path.stat().st_size if self._tag and self._path.exists() else 0
        if self._held:
            headers |= {"Range": f"bytes={self._held}-", "If-Range": self._tag}
        return headers

    def begin(self, response: httpx.Response) -> bool:
        """Take the head of an answer; whether its body belongs to the file.

        Raises
        ------
        httpx.ReadError
            Nothing of this file can be added to what is there: it begins again.
        """
        partial = response.status_code == HTTPStatus.PARTIAL_CONTENT
        former, self._tag = self._tag, _strong_tag(response)
        if self._held and (response.is_client_error or (partial and self._tag != former)):
            self._path.unlink()
            raise httpx.ReadError("the file has changed")
        if response.is_error:
            self._tag = former
            return False
        held = self._held if partial else 0
        length = int(response.headers.get("content-length", 0))
        self._counter = Counter(held + length if length else 0, self._progress)
        self._counter.add(held)
        # Unbuffered: what is collected is lost when the connection breaks.
        self._file = self._path.open("ab" if held else "wb", buffering=0)
        return True

    def add(self, chunk: bytes) -> None:
        """Take a part of the body."""
        if self._file is None:
            raise ValueError("nothing has begun")
        self._file.write(chunk)
        self._counter.add(len(chunk))

    def end(self) -> None:
        """Take note that the body is over, or has broken off."""
        if self._file is not None:
            self._file.close()
            self._file = None


def _unmasked(array: NDArray[Any]) -> NDArray[Any]:
    """Return an array whose masked entries are NaN, as `smsr.reconstruct` takes them."""
    if isinstance(array, np.ma.MaskedArray) and np.ma.is_masked(array):
        return np.where(np.ma.getmaskarray(array), np.nan, np.ma.getdata(array))
    return np.asarray(array)


def _strong_tag(response: httpx.Response) -> str:
    """Return the entity tag where the file can be asked for in parts, otherwise nothing."""
    tag = str(response.headers.get("etag", ""))
    in_parts = response.headers.get("accept-ranges") == "bytes"
    return tag if in_parts and not tag.startswith("W/") else ""
