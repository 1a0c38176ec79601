"""Options as data: one dataclass says type, default, range and help of each.

The command line, the HTTP service and its page all build on `describe` and `parse`; nothing about
an option is written twice.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import numpy as np

from smsr.errors import InvalidOption, UnknownOption, did_you_mean

if TYPE_CHECKING:
    from collections.abc import Mapping

T = TypeVar("T")


def option(
    default: T,
    help: str,  # noqa: A002  (the word users know)
    *,
    minimum: float | None = None,
    maximum: float | None = None,
) -> T:
    """Return a dataclass field with its help and its inclusive range.

    Parameters
    ----------
    default : object
        Value when the caller gives none.
    help : str
        One or two plain sentences.
    minimum, maximum : float, optional
        Inclusive bounds of a number.
    """
    metadata = {"help": help, "minimum": minimum, "maximum": maximum}
    return dataclasses.field(default=default, metadata=metadata)


@dataclass(frozen=True, slots=True, kw_only=True)
class Options:
    """Options of `smsr.reconstruct`."""

    preset: Literal["default", "paper"] = option(
        "default",
        "Stages and constants: 'default' is what measures best, 'paper' follows the publication.",
    )
    layout: Literal["auto", "interleaved", "stacked"] = option(
        "auto",
        "Row order of a 2-D measurement matrix: interleaved is u1, v1, u2, v2, ...; stacked is all "
        "u rows, then all v rows. 'auto' takes a 2-D matrix as interleaved and recognises "
        "(T, 2, N) and (T, N, 2) arrays.",
    )
    missing: Literal["refuse", "complete"] = option(
        "refuse",
        "What NaN in the measurements means: 'refuse' takes it as an error, 'complete' as points "
        "that are not seen in a frame and are filled in from the rest before solving.",
    )
    outliers: Literal["keep", "reject"] = option(
        "keep",
        "What is done about gross errors: 'reject' looks for positions far off both from how all "
        "points move and from the same track a frame earlier and later, and fills them in anew.",
    )
    virtual_points: int | None = option(
        None,
        "Number of virtual points that the measurements are reduced to before solving. The "
        "strongest singular directions are kept; what they do not span gets zero depth. Null takes "
        "up to 64, as many as make up all but 0.05 % of the tracks.",
        minimum=4,
        maximum=4096,
    )
    noise: float | None = option(
        None,
        "Standard deviation of the noise of the tracks, in their own units and below their spread; "
        "it is taken off before solving. 0 reproduces the tracks exactly; null has it estimated in "
        "the default preset and is 0 in the preset 'paper'.",
        minimum=0.0,
    )
    camera_model: Literal["auto", "relaxed", "uniform", "paper"] = option(
        "auto",
        "How cameras are found: 'relaxed' by convex problems, 'uniform' as a turn of constant "
        "velocity, 'paper' by rank-3 thresholding. 'auto' is 'paper' in that preset; otherwise "
        "the relaxed cameras, less the drift that points at rest show, or a simple path of the "
        "camera where that explains them; for a rigid object they come from its factorisation, for "
        "one that is flat but for its deformation from how its plane is seen.",
    )
    camera_scale: Literal["constant", "varying"] = option(
        "constant",
        "Whether the camera keeps its scale: 'constant' is an orthographic camera, and objects may "
        "grow; 'varying' is for an object that comes nearer or goes away, or a lens that zooms: "
        "the scale of each frame is found from distances between points, which should keep.",
    )
    basis_size: int | None = option(
        None,
        "Number K of basis shapes in the camera stage; null has several tried.",
        minimum=1,
        maximum=30,
    )
    camera_iterations: int = option(
        500,
        "Most iterations of each convex problem of the camera stage; in 'paper', most gradient "
        "steps for each basis size.",
        minimum=1,
        maximum=100_000,
    )
    camera_tolerance: float = option(
        1e-6,
        "Relative residual at which a convex problem of the camera stage stops; 'paper' stops "
        "where a step changes less than a ten-thousandth.",
        minimum=1e-15,
        maximum=1.0,
    )
    smoothing: bool | None = option(
        None,
        "Replace the measurements by the nearest smooth motion before finding shapes. Null is on "
        "in the preset 'paper' for up to 1000 points, as published, and off otherwise.",
    )
    smoothing_ratio: float = option(
        0.3,
        "Number of cosines in the smoothing stage, as a part of the number of frames.",
        minimum=0.001,
        maximum=1.0,
    )
    smoothing_iterations: int = option(
        30, "Most Gauss-Newton iterations of the smoothing stage.", minimum=1, maximum=10_000
    )
    shape_method: Literal["auto", "nuclear", "reweighted", "paper"] = option(
        "auto",
        "How shapes are found: 'nuclear' minimises the nuclear norm to convergence, 'reweighted' "
        "a reweighted nuclear norm and the motion between frames, 'paper' follows the published "
        "schedule of penalties. 'auto' is 'paper' in that preset; otherwise 'reweighted', refined "
        "to the likeliest depths of a Gaussian deformation and of lengths that keep, and to the "
        "likeliest velocity of a camera on a simple path, with depth "
        "faded out where the tracks do not bear it out, and one shape for a rigid object.",
    )
    shape_iterations: int = option(
        1000,
        "Most iterations of each way into the shape problem; there are up to two for each of two "
        "sets of cameras.",
        minimum=1,
        maximum=100_000,
    )
    shape_tolerance: float = option(
        1e-4,
        "Relative residual at which the shape stage stops; five times that before a refinement to "
        "likely depths.",
        minimum=1e-15,
        maximum=1.0,
    )
    penalty: float = option(
        1.0,
        "First penalty mu of the published shape stage, for measurements of unit spectral norm.",
        minimum=1e-9,
        maximum=1e9,
    )
    penalty_growth: float = option(
        1.02,
        "Factor rho on the penalty in each iteration of the published shape stage.",
        minimum=1.0,
        maximum=10.0,
    )
    motion_weight: float = option(
        1.0,
        "Weight of least motion between frames in the reweighted shape stage, relative to what the "
        "method finds fit; 0 for none.",
        minimum=0.0,
        maximum=1000.0,
    )


_SPARSE_POINTS = 1000


def resolve(options: Options, *, points: int) -> Options:
    """Replace what is left to the preset by what the preset says.

    Parameters
    ----------
    options : Options
        As given.
    points : int
        N.

    Returns
    -------
    Options
        `smoothing` is True or False. `camera_model` and `shape_method` are 'auto' only where the
        data decide.
    """
    published = options.preset == "paper"
    changes: dict[str, Any] = {}
    if options.smoothing is None:
        changes["smoothing"] = published and points <= _SPARSE_POINTS
    if published and options.noise is None:
        changes["noise"] = 0.0
    if published and options.camera_model == "auto":
        changes["camera_model"] = "paper"
    if published and options.shape_method == "auto":
        changes["shape_method"] = "paper"
    return dataclasses.replace(options, **changes)


@dataclass(frozen=True, slots=True)
class OptionDescription:
    """What a person or a form needs to know about one option."""

    name: str
    type: Literal["integer", "number", "boolean", "string"]
    default: int | float | bool | str | None
    help: str
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] | None = None
    nullable: bool = False


_TYPE_NAMES: dict[type, Literal["integer", "number", "boolean", "string"]] = {
    int: "integer",
    float: "number",
    bool: "boolean",
    str: "string",
}


def describe(cls: type) -> tuple[OptionDescription, ...]:
    """Describe every option of an options dataclass, in order of definition."""
    hints = typing.get_type_hints(cls)
    descriptions = []
    for field in dataclasses.fields(cls):
        hint = hints[field.name]
        nullable = False
        if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
            members = [m for m in typing.get_args(hint) if m is not types.NoneType]
            nullable = len(members) < len(typing.get_args(hint))
            (hint,) = members
        choices: tuple[str, ...] | None = None
        if typing.get_origin(hint) is Literal:
            choices = typing.get_args(hint)
            hint = str
        descriptions.append(
            OptionDescription(
                name=field.name,
                type=_TYPE_NAMES[hint],
                default=typing.cast("int | float | bool | str | None", field.default),
                help=field.metadata["help"],
                minimum=field.metadata["minimum"],
                maximum=field.metadata["maximum"],
                choices=choices,
                nullable=nullable,
            )
        )
    return tuple(descriptions)


O = TypeVar("O")  # noqa: E741  (an options dataclass)


def parse(cls: type[O], values: Mapping[str, object]) -> O:
    """Build an options dataclass from names and values, checking each.

    Parameters
    ----------
    cls : type
        An options dataclass whose fields are made by `option`.
    values : mapping
        Names to values, as from JSON. Integers pass for numbers; nothing else is converted.

    Raises
    ------
    UnknownOption
        A name that is no option; near names are suggested.
    InvalidOption
        A value of the wrong type, out of range, or no allowed choice.
    """
    known = {d.name: d for d in describe(cls)}
    checked: dict[str, Any] = {}
    for name, value in values.items():
        if name not in known:
            raise UnknownOption(
                f"There is no option {name!r}.{did_you_mean(name, known)} "
                f"Options are {', '.join(known)}.",
                option=name,
                options=list(known),
            )
        checked[name] = _check(known[name], value)
    return cls(**checked)


def _check(what: OptionDescription, value: object) -> int | float | bool | str | None:
    if isinstance(value, np.integer | np.floating | np.bool_ | np.str_) and not isinstance(
        value, np.timedelta64
    ):
        value = value.item()
    if value is None and what.nullable:
        return None
    match what.type:
        case "boolean":
            fits = isinstance(value, bool)
        case "integer":
            fits = isinstance(value, int) and not isinstance(value, bool)
        case "number":
            fits = isinstance(value, int | float) and not isinstance(value, bool)
            fits = fits and math.isfinite(typing.cast("float", value))
        case "string":
            fits = isinstance(value, str)
    if not fits:
        raise _invalid(what, value, f"must be of type {what.type}{' or null' * what.nullable}")
    if what.choices is not None and value not in what.choices:
        raise _invalid(what, value, f"must be one of {', '.join(what.choices)}")
    if what.type in ("integer", "number"):
        number = typing.cast("float", value)
        low = -math.inf if what.minimum is None else what.minimum
        high = math.inf if what.maximum is None else what.maximum
        if not low <= number <= high:
            bounds = f"between {low:g} and {high:g}" if math.isfinite(high) else f"at least {low:g}"
            raise _invalid(what, value, f"must be {bounds}")
        if what.type == "number":
            return float(number)
    return typing.cast("int | float | bool | str", value)


def _invalid(what: OptionDescription, value: object, rule: str) -> InvalidOption:
    shown = repr(value)
    shown = shown if len(shown) <= 60 else shown[:57] + "..."
    return InvalidOption(f"Option {what.name!r} {rule}; it was {shown}.", option=what.name)
