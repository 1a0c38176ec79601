"""What can be wrong with an input, as exceptions with stable names.

Every exception carries a `slug`, the last part of the `type` of an RFC 9457 problem document, so a
library caller, the command line and an HTTP client see one name for one mistake. Messages say what
is wrong and what would be right.
"""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING, ClassVar

if TYPE_CHECKING:
    from collections.abc import Iterable


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Return the question, with a space before it, whether a near name was meant, or nothing."""
    near = difflib.get_close_matches(name, known, n=1)
    return f" Did you mean {near[0]!r}?" if near else ""


class SmsrError(Exception):
    """Base of all errors that this library raises on purpose.

    Parameters
    ----------
    detail : str
        What is wrong here and what would be right, for a person.
    **context : int, float, str or list
        Machine-readable facts (the row, the frame, the limit), copied into problem documents.
    """

    slug: ClassVar[str] = "internal"
    title: ClassVar[str] = "Something went wrong in the solver"

    def __init__(self, detail: str, **context: object) -> None:
        super().__init__(detail)
        self.detail = detail
        self.context = context


class InputError(SmsrError, ValueError):
    """The input cannot be used as given."""

    slug = "invalid-input"
    title = "The input cannot be used"


class UnsupportedFormat(InputError):
    """The file is of no format that is read here."""

    slug = "unsupported-format"
    title = "This file format is not supported"


class UnreadableFile(InputError):
    """The file claims a known format but is truncated, corrupt or forbidden (pickles)."""

    slug = "unreadable-file"
    title = "The file cannot be read"


class EmptyFile(InputError):
    """The file has no bytes."""

    slug = "empty-file"
    title = "The file is empty"


class ArrayNotFound(InputError):
    """No numeric array in the file, or none under the key asked for."""

    slug = "array-not-found"
    title = "No usable array in the file"


class AmbiguousArray(InputError):
    """Several arrays in the file could be meant."""

    slug = "ambiguous-array"
    title = "Several arrays in the file could be meant"


class TooLarge(InputError):
    """The data, once decompressed, would pass the limit."""

    slug = "too-large"
    title = "The data are larger than the limit"


class NotNumeric(InputError):
    """Complex, object, text or structured data where real numbers are needed."""

    slug = "not-numeric"
    title = "The data are not real numbers"


class WrongShape(InputError):
    """The array has a number of axes or sizes that no layout allows."""

    slug = "wrong-shape"
    title = "The array has the wrong shape"


class OddRowCount(WrongShape):
    """A measurement matrix with an odd number of rows."""

    slug = "odd-row-count"
    title = "The measurement matrix has an odd number of rows"


class AmbiguousLayout(WrongShape):
    """More than one layout fits the array."""

    slug = "ambiguous-layout"
    title = "The layout of the measurements is ambiguous"


class TooFewFrames(WrongShape):
    """Fewer than 3 frames."""

    slug = "too-few-frames"
    title = "Too few frames"


class TooFewPoints(WrongShape):
    """Fewer than 4 points."""

    slug = "too-few-points"
    title = "Too few points"


class NotFinite(InputError):
    """NaN or infinity in the data."""

    slug = "not-finite"
    title = "The data have NaN or infinite entries"


class TooFewObservations(InputError):
    """A point or a frame of which so little is seen that the rest cannot be filled in."""

    slug = "too-few-observations"
    title = "Too little of a point or a frame is seen"


class ConstantMeasurements(InputError):
    """All points coincide in every frame, so there is no shape to find."""

    slug = "constant-measurements"
    title = "The measurements do not vary"


class GroundTruthMismatch(InputError):
    """Ground truth of other frames or points than the measurements."""

    slug = "ground-truth-mismatch"
    title = "The ground truth does not fit the measurements"


class InvalidFaces(InputError):
    """Faces that are no (F, 3) integer array of point indices."""

    slug = "invalid-faces"
    title = "The faces are not valid"


class UnknownOption(InputError):
    """An option that does not exist."""

    slug = "unknown-option"
    title = "There is no such option"


class InvalidOption(InputError):
    """An option with a value of the wrong type or out of its range."""

    slug = "invalid-option"
    title = "An option has an invalid value"


class AnimationTooLarge(SmsrError):
    """More frames or points than one GLB file can hold."""

    slug = "animation-too-large"
    title = "The animation is too large for one file"


class FiguresUnavailable(SmsrError):
    """Matplotlib is not installed."""

    slug = "figures-unavailable"
    title = "Figures cannot be drawn here"


class NothingToDraw(SmsrError):
    """The result has nothing that this figure shows."""

    slug = "nothing-to-draw"
    title = "The result has nothing that this figure shows"


class Cancelled(SmsrError):
    """The progress callback asked the run to stop."""

    slug = "cancelled"
    title = "The run was cancelled"


class NumericalFailure(SmsrError):
    """The solver met a state it cannot continue from; never raised for valid, generic input."""

    slug = "numerical-failure"
    title = "The solver could not finish"
