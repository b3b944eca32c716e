"""How the values of options are written: a ball, an albedo, the corners of a board, lengths and levels."""

from functools import partial
from typing import Annotated, Any, NoReturn

from pydantic import AfterValidator, BeforeValidator, Field

from service.requests.base.base import Options
from stage.model import Finite, Positive

LARGEST_SQUARE_M = 1.0
"""The largest side of a square of a chessboard, metres: larger numbers are millimetres."""
THICKEST_STENCIL_M = 2e-3
"""The thickest stencil of solder paste, several times what is sold, metres: larger numbers are millimetres or micrometres."""


def refuse(sentence: str) -> NoReturn:
    """Refuse the options of a request with a sentence."""
    from service.errors import RequestError  # which knows the errors of the kernels: not for a client, which imports this

    raise RequestError(sentence)


class Circle(Options):
    """The outline of a ball in the image."""

    u: Finite
    v: Finite
    radius_px: Positive


def _numbers(text: str) -> list[float]:
    """Return the finite numbers of a text with commas between them; none where it holds anything else."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        return []
    return values if all(abs(value) < float("inf") for value in values) else []


def _circle(given: Any) -> Any:
    if not isinstance(given, str):
        return given
    values = _numbers(given)
    if len(values) != 3:
        refuse(f"--ball {given}: give centre and radius in pixels, such as 812.5,604,230")
    return dict(zip(Circle.model_fields, values, strict=True))


def _albedo(given: Any) -> Any:
    """Return the albedo of three channels of a text with one number or three."""
    if not isinstance(given, str):
        return tuple(given) if isinstance(given, list) else given
    values = _numbers(given)
    if len(values) not in (1, 3):
        refuse(f"--albedo {given}: give one number or three, such as 0.18")
    return tuple(values * 3 if len(values) == 1 else values)


def _part_of_the_light(given: tuple[float, ...] | None) -> tuple[float, ...] | None:
    """Return an albedo, which is refused where it seems to be in percent."""
    if given is not None and max(given) > 1:
        refuse(f"--albedo {max(given):g}: nothing reflects more than all light: give a part of it, such as {max(given) / 100:g} for "
               f"{max(given):g} %")
    return given


def _corners(given: Any) -> Any:
    """Return the inner corners of a chessboard, across and down, that a text such as 9x6 names."""
    if not isinstance(given, str):
        return tuple(given) if isinstance(given, list) else given
    parts = given.lower().split("x")
    if len(parts) != 2 or not all(part.isdecimal() for part in parts):
        refuse(f"--board {given}: give two whole numbers with an x between, as 9x6")
    return tuple(map(int, parts))


def _in_metres(given_m: float | None, *, option: str, what: str, most_m: float = LARGEST_SQUARE_M) -> Any:
    """Return a length, which is refused where it seems to be in millimetres or micrometres."""
    if given_m is not None and given_m > most_m:
        part, unit = (1e-3, "mm") if 1e-3 * given_m <= most_m else (1e-6, "µm")
        refuse(f"{option} {given_m:g}: is {given_m:g} m, more than {what} has: "
               f"give metres, such as {part * given_m:g} for {given_m:g} {unit}")
    return given_m


def _levels(given: Any) -> Any:
    if isinstance(given, tuple) and given and not _numbers(text := ",".join(map(str, given))):
        refuse(f"--levels {text}: give numbers from 0 to 1 with commas between")
    return given


Corners = Annotated[int, Field(ge=3)]
CircleText = BeforeValidator(_circle)
AlbedoText = BeforeValidator(_albedo)
PartOfLight = AfterValidator(_part_of_the_light)
CornersText = BeforeValidator(_corners)
LevelsText = BeforeValidator(_levels)
SquareSide = AfterValidator(partial(_in_metres, option="--square-m", what="a square of a chessboard"))
MarkerSide = AfterValidator(partial(_in_metres, option="--marker-m", what="a marker"))
StepHeight = AfterValidator(partial(_in_metres, option="--step-m", what="a step"))
StencilThickness = AfterValidator(partial(_in_metres, option="--stencil-m", what="a stencil", most_m=THICKEST_STENCIL_M))
