"""Light keys: lights, environment, captured images and exposure animated by a small JSON (schema relit.keys/1, docs/relight.md)."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, TypeVar

import numpy as np
from pydantic import AfterValidator, Field

from service.requests.picture import MAX_STOPS
from stage.colour_spaces import ColorSpaceName, is_linear
from stage.model import Direction, FirstFault, NotNegative, Positive, Rgb, Strict, Text, Vector
from stage.records import read_record

SCHEMA = "relit.keys/1"
SUN_DEGREES = 0.53
"""Angular diameter of the sun, and the default of UsdLux DistantLight."""
OPPOSITE = -1 + 1e-6
"""Cosine of two directions between which no shortest way can be told: within 0.1 degrees of opposite."""

LAST_FRAME = 999_999_999
"""As large as the number of a frame may be."""
Stops = Annotated[float, Field(ge=-MAX_STOPS, le=MAX_STOPS)]


class Key(Strict):
    """A value at a frame."""

    frame: Annotated[int, Field(ge=0, le=LAST_FRAME)]
    interpolation: Literal["linear", "step"] = "linear"
    """From this key to the next: an even change, or none until the next."""


class EnvironmentKey(Key):
    """How the map stands: turned about an axis by the right-hand rule (about +y: from +z towards +x)."""

    turn_degrees: float = 0.0
    axis: Direction = (0.0, 1.0, 0.0)
    exposure: Stops = 0.0
    """Stops, of the environment alone."""


class LightKey(Key):
    """A far disc of even radiance."""

    direction: Direction
    """From the surface to the middle of the disc, camera frame."""
    irradiance: Rgb
    """On a surface that faces it, in the unit of the captured lights."""
    angle_degrees: Annotated[float, Field(ge=0, le=180)] = SUN_DEGREES
    """Diameter of the disc as seen from the object."""


class WeightKey(Key):
    """How much of a captured image is added, as it was captured."""

    weight: NotNegative


class ExposureKey(Key):
    """Of the whole frame, beside --exposure."""

    stops: Stops


AnyKey = TypeVar("AnyKey", bound=Key)


def _in_order(keys: tuple[AnyKey, ...]) -> tuple[AnyKey, ...]:
    for index, (one, other) in enumerate(pairwise(keys), start=1):
        if other.frame <= one.frame:
            raise ValueError(f"key {index} is at frame {other.frame}, the one before at {one.frame}: give keys in the order of frames")
    return keys


def _no_opposites(keys: Sequence[Key], field: str) -> None:
    for index, (one, other) in enumerate(pairwise(keys), start=1):
        if one.interpolation == "linear" and np.dot(getattr(one, field), getattr(other, field)) < OPPOSITE:
            raise ValueError(f"key {index}: its {field} is opposite to the one before: give a key between, so that the way is known")


def _ways(keys: tuple[LightKey, ...]) -> tuple[LightKey, ...]:
    _no_opposites(keys, "direction")
    return keys


def _axes(keys: tuple[EnvironmentKey, ...]) -> tuple[EnvironmentKey, ...]:
    _no_opposites(keys, "axis")
    return keys


def _linear(space: str) -> str:
    if not is_linear(space):
        raise ValueError(f"is {space}: a light has a scene-linear colour, such as lin_rec709_scene")
    return space


InOrder = AfterValidator(_in_order)
Some = Field(min_length=1)


class LightTrack(Strict):
    """One animated light."""

    name: Text
    color_space: Annotated[ColorSpaceName, AfterValidator(_linear)] = "lin_rec709_scene"
    """Of its irradiance."""
    keys: Annotated[tuple[LightKey, ...], Some, FirstFault, InOrder, AfterValidator(_ways)]


class CapturedTrack(Strict):
    """One animated image of the capture."""

    image: Text
    keys: Annotated[tuple[WeightKey, ...], Some, FirstFault, InOrder]


class LightKeys(Strict):
    """Everything a light-key file says."""

    schema_: Literal["relit.keys/1"] = Field(alias="schema")
    frames_per_second: Positive | None = None
    """For the reader of the frames: keys stand at frame numbers."""
    environment: Annotated[tuple[EnvironmentKey, ...], FirstFault, InOrder, AfterValidator(_axes)] = ()
    lights: Annotated[tuple[LightTrack, ...], FirstFault] = ()
    captured: Annotated[tuple[CapturedTrack, ...], FirstFault] = ()
    exposure: Annotated[tuple[ExposureKey, ...], FirstFault, InOrder] = ()

    @classmethod
    def read(cls, path: Path) -> "LightKeys":
        """Read and check a file.

        Raises:
            StorageError: it cannot be read.
            ManifestError: not JSON, or a field is wrong; the message names file and field.
        """
        return read_record(path, cls, SCHEMA)


class Span(NamedTuple):
    """Where a frame lies between two neighbouring keys."""

    first: int
    second: int
    fraction: float
    """0 at the first, 1 at the second."""


def span(keys: Sequence[Key], frame: int) -> Span:
    """The keys around a frame; before the first and after the last key their values hold."""
    after = next((index for index, key in enumerate(keys) if key.frame > frame), len(keys))
    if after == 0 or after == len(keys) or keys[after - 1].interpolation == "step":
        held = max(0, after - 1)
        return Span(held, held, 0.0)
    one, other = keys[after - 1], keys[after]
    return Span(after - 1, after, (frame - one.frame) / (other.frame - one.frame))


def mixed(first: Sequence[float], second: Sequence[float], fraction: float) -> np.ndarray:
    """Linear interpolation, float64."""
    return (1 - fraction) * np.asarray(first, dtype=np.float64) + fraction * np.asarray(second, dtype=np.float64)


def swung(first: Vector, second: Vector, fraction: float) -> np.ndarray:
    """The unit vector on the shorter great circle between two, at an even pace.

    Source: Shoemake, "Animating Rotation with Quaternion Curves", SIGGRAPH 1985 (slerp).
    """
    one, other = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    sine = float(np.linalg.norm(np.cross(one, other)))
    angle = float(np.arctan2(sine, one @ other))
    if sine < 1e-12:  # the same direction: there is no way between
        return one
    return (np.sin((1 - fraction) * angle) * one + np.sin(fraction * angle) * other) / sine
