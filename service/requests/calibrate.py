"""What can be asked of `relit calibrate`: one frozen model a kind."""

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Finite = Annotated[float, Field(allow_inf_nan=False)]
Above0 = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Circle(BaseModel):
    """The outline of a ball, typed."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    u: Finite
    v: Finite
    radius_px: Above0


class LightsRequest(BaseModel):
    """Base of the kinds that measure lights."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    capture: Path
    """The capture with the calibration images; its distant and point lights may be placeholders."""
    apply_to: Path | None = None
    """Another capture under the same lights in the same order, whose manifest is written; None: the capture itself."""
    out: Path | None = None
    """Where the manifest is written; None: over the target's capture.json."""
    drop_failed: bool = False
    """Leave out frames whose light cannot be measured, in place of refusing the capture."""


class BallRequest(LightsRequest):
    """Base of the kinds that look at balls: circles first, then masks."""

    circles: tuple[Circle, ...] = ()
    masks: tuple[Path, ...] = ()


class MirrorBallRequest(BallRequest):
    """Directions of far lights from one mirror ball."""

    level: Annotated[float, Field(gt=0, lt=1)] = 0.1
    """The spot is what is brighter than this part of its peak."""


class LightPositionsRequest(MirrorBallRequest):
    """Positions of near lights from two or more mirror balls."""

    ball_radius_m: tuple[Above0, ...] = ()
    """Of every ball, or one for each; an orthographic camera with pixel_size_m needs none."""
    ball_z_m: tuple[Finite, ...] = ()
    """Camera-frame z of the centres, for an orthographic camera; empty: surface_z_m, or 0."""


class GreyBallRequest(BallRequest):
    """Brightness of each light from one grey ball."""

    albedo: tuple[Above0, Above0, Above0] | None = None
    """Of the ball; None: irradiance is relative, mean 1."""
    refine_direction: bool = False
    """Take the direction of distant lights from the shading, in place of the manifest."""
    ball_radius_m: Above0 | None = None
    """For point lights and a perspective camera."""
    ball_z_m: Finite | None = None
    """For point lights and an orthographic camera; None: surface_z_m, or 0."""


class IntensityRequest(LightsRequest):
    """Brightness of each light from images of the object itself."""

    pixels: Annotated[int, Field(ge=100, le=100_000)] = 2000
    """Of the mask, drawn at random, that take part."""


class FramesRequest(BaseModel):
    """Base of the kinds that average images."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    capture: Path
    images: tuple[Path, ...]
    """Image files, of the capture's resolution and encoding."""


class DarkRequest(FramesRequest):
    """dark.exr from images with the lens covered, at the exposure of the frames."""


class FlatFieldRequest(FramesRequest):
    """flat.exr from images of an evenly lit white card."""

    dark_images: tuple[Path, ...] = ()
    """Dark images at the exposure of the white card; empty: the capture's dark is also that of the card."""


class SaturationRequest(BaseModel):
    """The capture's saturation from where its histogram piles up."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    capture: Path
    write: bool = False
    """Set `saturation` in the manifest, in place of only saying it."""


class ProcamRequest(BaseModel):
    """Camera, projector and their pose from a chessboard under projected light, one capture a pose of the board."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    captures: Annotated[tuple[Path, ...], Field(min_length=1)]
    board: tuple[Annotated[int, Field(ge=3)], Annotated[int, Field(ge=3)]]
    """Inner corners across and down."""
    square_m: Above0
    """Side of a square."""
    projector: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]] | None = None
    """Width and height of the projector; None: what the captures say."""
    apply_to: tuple[Path, ...] = ()
    """Other captures of the same rig, whose manifests are written too."""
    drop_outliers: bool = False
    """Leave out views whose error stands out, and fit again."""
    device: str | None = None
    cache: Path | None = None


class ResponseRequest(BaseModel):
    """The light of a projector at each level, from images of evenly grey projections."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    capture: Path
    """Its camera is the one that took the images; its projector gets the response."""
    images: Annotated[tuple[Path, ...], Field(min_length=3)]
    levels: tuple[Annotated[float, Field(ge=0, le=1)], ...] = ()
    """Of each image, 0 to 1; empty: even steps from 0 to 1 in the order of the images."""
