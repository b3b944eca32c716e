"""The names of the colour spaces that a capture may declare, and the scene-linear space that belongs to each.

The names are those of the Color Interop Forum. Pixels are converted in `stage.colour.colour`; this module imports no image library, so
that requests and the command line can check a name without loading one.
"""

from typing import Annotated, Literal, get_args

from pydantic import AfterValidator

ColorSpaceName = Literal[
    "lin_rec709_scene", "lin_ap1_scene", "lin_ap0_scene", "lin_rec2020_scene", "lin_p3d65_scene", "lin_adobergb_scene",
    "srgb_texture", "srgb_rec709_scene", "g22_rec709_scene", "g18_rec709_scene", "srgb_p3d65_scene", "g22_adobergb_scene",
]
"""The values that `color_space` may have: scene-linear spaces, and the display-encoded spaces of 8-bit cameras and textures."""

_LINEAR_OF: dict[str, str] = {
    "srgb_texture": "lin_rec709_scene",
    "srgb_rec709_scene": "lin_rec709_scene",
    "g22_rec709_scene": "lin_rec709_scene",
    "g18_rec709_scene": "lin_rec709_scene",
    "srgb_p3d65_scene": "lin_p3d65_scene",
    "g22_adobergb_scene": "lin_adobergb_scene",
}


def is_linear(space: str) -> bool:
    """Return whether the values of a colour space are proportional to radiance."""
    return space not in _LINEAR_OF


def _of_light(space: str) -> str:
    if not is_linear(space):
        raise ValueError(f"is {space}: a light has a scene-linear colour, such as lin_rec709_scene")
    return space


LightSpaceName = Annotated[ColorSpaceName, AfterValidator(_of_light)]
"""The values that `color_space` of a light may have: scene-linear spaces alone."""


def linear_space(space: str) -> str:
    """Return the name of the scene-linear space that has the primaries of `space`: the working space of a capture."""
    if space not in get_args(ColorSpaceName):
        raise ValueError(f"{space} is not a colour space that relit knows")
    return _LINEAR_OF.get(space, space)
