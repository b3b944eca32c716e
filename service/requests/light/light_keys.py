"""Light keys: a JSON file that animates lights, environment, captured images and exposure (schema relit.keys/1, docs/relight.md)."""

from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from pydantic import AfterValidator, Field

from service.requests.light.picture_options import MAX_STOPS, FrameRate
from stage.colour.colour_spaces import LightSpaceName
from stage.model import Direction, FirstFault, NotNegative, Rgb, Strict, Text
from stage.records import read_record

SUN_DEGREES = 0.53
"""Angular diameter of the sun, and the default of UsdLux DistantLight."""
OPPOSITE = -1 + 1e-6
"""Two directions whose cosine is below this are opposite within 0.1 degrees: there is no one shortest way between them."""

LAST_FRAME = 999_999_999
"""The largest number of a frame."""
Stops = Annotated[float, Field(ge=-MAX_STOPS, le=MAX_STOPS)]


class Key(Strict):
    """A value at a frame."""

    frame: Annotated[int, Field(ge=0, le=LAST_FRAME)]
    interpolation: Literal["linear", "step"] = "linear"
    """The change from this key to the next: even, or none until the next."""


class EnvironmentKey(Key):
    """The turn of the environment map about an axis by the right-hand rule (about +y: from +z towards +x), and its exposure."""

    turn_degrees: float = 0.0
    axis: Direction = (0.0, 1.0, 0.0)
    exposure: Stops = 0.0
    """Stops, for the environment alone."""


class LightKey(Key):
    """A distant disc of even radiance."""

    direction: Direction
    """Direction from the surface to the middle of the disc, camera frame."""
    irradiance: Rgb
    """Irradiance on a surface that faces the light, in the unit of the captured lights."""
    angle_degrees: Annotated[float, Field(ge=0, le=180)] = SUN_DEGREES
    """Diameter of the disc as seen from the object."""


class WeightKey(Key):
    """The weight with which a captured image is added, as it was captured."""

    weight: NotNegative


class ExposureKey(Key):
    """The exposure of the whole frame, added to --exposure."""

    stops: Stops


AnyKey = TypeVar("AnyKey", bound=Key)


def _in_order(keys: tuple[AnyKey, ...]) -> tuple[AnyKey, ...]:
    for index, (one, other) in enumerate(pairwise(keys), start=1):
        if other.frame <= one.frame:
            raise ValueError(f"key {index} is at frame {other.frame}, the one before at {one.frame}: give keys in the order of frames")
    return keys


def _no_opposites(keys: tuple[AnyKey, ...], *, field: str) -> tuple[AnyKey, ...]:
    for index, (one, other) in enumerate(pairwise(keys), start=1):
        cosine = sum(a * b for a, b in zip(getattr(one, field), getattr(other, field), strict=True))
        if one.interpolation == "linear" and cosine < OPPOSITE:
            raise ValueError(f"key {index}: its {field} is opposite to the one before: give a key between, so that the way is known")
    return keys


InOrder = AfterValidator(_in_order)
Some = Field(min_length=1)


class LightTrack(Strict):
    """One animated light."""

    name: Text
    color_space: LightSpaceName = "lin_rec709_scene"
    """The colour space of the irradiance."""
    keys: Annotated[tuple[LightKey, ...], Some, FirstFault, InOrder, AfterValidator(partial(_no_opposites, field="direction"))]


class CapturedTrack(Strict):
    """One animated image of the capture."""

    image: Text
    keys: Annotated[tuple[WeightKey, ...], Some, FirstFault, InOrder]


class LightKeys(Strict):
    """The content of a light-key file."""

    schema_: Literal["relit.keys/1"] = Field(alias="schema")
    frames_per_second: FrameRate | None = None
    """Frames per second, for whoever plays the frames: keys stand at frame numbers."""
    environment: Annotated[tuple[EnvironmentKey, ...], FirstFault, InOrder, AfterValidator(partial(_no_opposites, field="axis"))] = ()
    lights: Annotated[tuple[LightTrack, ...], FirstFault] = ()
    captured: Annotated[tuple[CapturedTrack, ...], FirstFault] = ()
    exposure: Annotated[tuple[ExposureKey, ...], FirstFault, InOrder] = ()

    @classmethod
    def read(cls, path: Path) -> "LightKeys":
        """Read and check a file; errors name the file and the field."""
        return read_record(path, cls)
