"""Replacement of the lights of a manifest by measured ones; every other key stays unchanged."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from stage.capture.capture import Capture
from stage.capture.light import DistantLight, PointLight
from stage.capture.manifest import FILE_NAME, Frame, Manifest
from stage.errors import ManifestError

SingleLight = DistantLight | PointLight


class LitFrame(NamedTuple):
    """A frame that one distant or point light lit."""

    number: int
    """The index of the frame in the manifest."""
    frame: Frame
    light: SingleLight


def lit_frames(capture: Capture) -> list[LitFrame]:
    """Return the frames whose lights can be calibrated, which are distant and point lights, in manifest order; one or more."""
    found = [LitFrame(index, frame, frame.light) for index, frame in enumerate(capture.manifest.frames)
             if isinstance(frame.light, DistantLight | PointLight)]
    if not found:
        raise ManifestError(f"{capture.folder / FILE_NAME}: frames: none is lit by a distant or point light: "
                            "give each frame one, the values are replaced")
    return found


def check_same_setup(source: Capture, target: Capture) -> None:
    """Check that lights that were measured in `source` may be written into `target`, because both were taken in the same setup."""
    where = target.folder / FILE_NAME
    measured, wanted = len(lit_frames(source)), len(lit_frames(target))
    if measured != wanted:
        raise ManifestError(f"{where}: frames: {wanted} are lit by a distant or point light, {source.folder} has {measured}: "
                            "lights are matched by order")
    for field in ("projection", "resolution"):
        if getattr(source.camera, field) != getattr(target.camera, field):
            raise ManifestError(f"{where}: camera.{field}: differs from that of {source.folder}: "
                                "directions hold for one camera position")
    first, second = source.camera.world_from_camera, target.camera.world_from_camera
    if first is not None and second is not None and not np.allclose(first, second, atol=1e-6):
        raise ManifestError(f"{where}: camera.world_from_camera: differs from that of {source.folder}: "
                            "directions hold for one camera position")


def with_lights(target: Capture, lights: Sequence[SingleLight | None]) -> Manifest:
    """Return the manifest of a capture with its distant and point lights replaced, in manifest order; None removes the frame."""
    by_index: Mapping[int, SingleLight | None] = dict(zip((lit.number for lit in lit_frames(target)), lights, strict=True))
    frames = []
    for index, frame in enumerate(target.manifest.frames):
        light = by_index.get(index)
        if light is not None:
            frames.append(frame.model_copy(update={"light": light}))
        elif index not in by_index:
            frames.append(frame)
    return target.manifest.model_copy(update={"frames": tuple(frames)})


def as_direction(light: SingleLight, direction: np.ndarray) -> DistantLight:
    """Return a distant light from a measured direction. The irradiance of a distant light stays; that of a point light becomes 1."""
    irradiance = light.irradiance if isinstance(light, DistantLight) else (1.0, 1.0, 1.0)
    x, y, z = (float(value) for value in direction)
    return DistantLight(type="distant", direction=(x, y, z), irradiance=irradiance, polarization=light.polarization)


def as_position(light: SingleLight, position: np.ndarray, seen_from: np.ndarray) -> PointLight:
    """Return a point light at a measured position; the irradiance of a distant light becomes an intensity that gives it at `seen_from`."""
    x, y, z = (float(value) for value in position)
    if isinstance(light, PointLight):
        return light.model_copy(update={"position_m": (x, y, z)})
    r, g, b = (float(value * ((position - seen_from) ** 2).sum()) for value in light.irradiance)
    return PointLight(type="point", position_m=(x, y, z), intensity=(r, g, b), polarization=light.polarization)


def with_brightness(light: SingleLight, rgb: np.ndarray) -> SingleLight:
    """Return a light with a measured irradiance (distant light) or intensity (point light)."""
    r, g, b = (float(value) for value in rgb)
    return light.model_copy(update={"irradiance" if isinstance(light, DistantLight) else "intensity": (r, g, b)})
