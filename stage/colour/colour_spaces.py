"""The names of the colour spaces that a capture may declare, and the scene-linear space that belongs to each.

The names listed here are those of the Color Interop Forum; others are those of the OpenColorIO configuration. Pixels are converted in
`stage.colour.colour`; this module imports no image library for the listed names, so that requests and the command line can check them
without loading one.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Annotated, NamedTuple

from pydantic import AfterValidator, Field

from stage.colour.location import location
from stage.model import Line

NAMES = (
    "lin_rec709_scene", "lin_ap1_scene", "lin_ap0_scene", "lin_rec2020_scene", "lin_p3d65_scene", "lin_adobergb_scene",
    "srgb_texture", "srgb_rec709_scene", "g22_rec709_scene", "g18_rec709_scene", "srgb_p3d65_scene", "g22_adobergb_scene",
)
"""The names that are known under every configuration: scene-linear spaces, and the display-encoded spaces of 8-bit cameras and textures."""


class Review(NamedTuple):
    """The way from scene-linear pixels to those of a display; without values that of `Configuration.view`."""

    view: str | None = None
    """DISPLAY/VIEW, or a view, as `Configuration.view` takes it."""
    look: str | None = None
    """Looks, as `Configuration.checked_look` takes them; None: those of the view."""


_LINEAR_OF: dict[str, str] = {
    "srgb_texture": "lin_rec709_scene",
    "srgb_rec709_scene": "lin_rec709_scene",
    "g22_rec709_scene": "lin_rec709_scene",
    "g18_rec709_scene": "lin_rec709_scene",
    "srgb_p3d65_scene": "lin_p3d65_scene",
    "g22_adobergb_scene": "lin_adobergb_scene",
}

_AS_GIVEN: ContextVar[bool] = ContextVar("_AS_GIVEN", default=False)


def is_linear(space: str) -> bool:
    """Return whether the values of a colour space are proportional to radiance."""
    if space in NAMES:
        return space not in _LINEAR_OF
    from stage.colour.configuration import current  # which loads an image library

    return current().checked(space) in current().linear


def linear_space(space: str) -> str:
    """Return the scene-linear space that belongs to a space, the working space of a capture: that with its primaries where there is one.
    Raises ColourError if the configuration does not have the space."""
    return _linear_of(space)[0]


def channels_apart(space: str) -> bool:
    """Return whether a channel of the linear space depends on the same channel of the encoded space alone."""
    return _linear_of(space)[1]


def _linear_of(space: str) -> tuple[str, bool]:
    if space in NAMES:
        return _LINEAR_OF.get(space, space), True
    from stage.colour.configuration import linear_of

    return linear_of(location(), space)


@contextmanager
def names_as_given() -> Iterator[None]:
    """Take names in models as they are within a context: a process that has another configuration has checked them."""
    token = _AS_GIVEN.set(True)
    try:
        yield
    finally:
        _AS_GIVEN.reset(token)


def _known(space: str) -> str:
    if not _AS_GIVEN.get():
        is_linear(space)
    return space


def _of_light(space: str) -> str:
    if _AS_GIVEN.get():
        return space
    if not is_linear(space):
        raise ValueError(f"is {space}: give a scene-linear colour space, such as lin_rec709_scene")
    return linear_space(space)  # one name for a space, by which lights and captures are compared


ColorSpaceName = Annotated[Line, AfterValidator(_known), Field(min_length=1, max_length=200, examples=list(NAMES))]
"""The values that `color_space` may have: NAMES, and the names, aliases and roles of the OpenColorIO configuration."""
LightSpaceName = Annotated[Line, AfterValidator(_of_light), Field(min_length=1, max_length=200,
                                                                 examples=[name for name in NAMES if name not in _LINEAR_OF])]
"""The values that `color_space` of a light or a relit frame may have: scene-linear spaces alone."""
