"""Measured lights into a manifest, frame by frame; every other key stays as it is."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from stage.capture import Capture
from stage.errors import ManifestError
from stage.light import DistantLight, PointLight
from stage.manifest import FILE_NAME, Frame, Manifest

SingleLight = DistantLight | PointLight


class LitFrame(NamedTuple):
    """A frame that one light of its own lit."""

    number: int
    """Of the frame in the manifest, from 0."""
    frame: Frame
    light: SingleLight


def lit_frames(capture: Capture) -> list[LitFrame]:
    """The frames whose lights can be calibrated: distant and point, in manifest order.

    Raises:
        ManifestError: there is none.
    """
    found = [LitFrame(index, frame, frame.light) for index, frame in enumerate(capture.manifest.frames)
             if isinstance(frame.light, DistantLight | PointLight)]
    if not found:
        raise ManifestError(f"{capture.folder / FILE_NAME}: frames: none is lit by a distant or point light: "
                            "give each frame one, the values are replaced")
    return found


def match(source: Capture, target: Capture) -> None:
    """Refuse to carry lights from one capture to another that was not shot in the same way.

    Raises:
        ManifestError: another count of lit frames, projection, resolution or camera position.
    """
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
    """The manifest with its distant and point lights replaced in order.

    Args:
        target: as many lit frames as there are lights.
        lights: None leaves the frame out.
    """
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
    """The light from a measured direction; its irradiance stays, that of a light which was near is not known and becomes 1."""
    irradiance = light.irradiance if isinstance(light, DistantLight) else (1.0, 1.0, 1.0)
    x, y, z = (float(value) for value in direction)
    return DistantLight(type="distant", direction=(x, y, z), irradiance=irradiance)


def as_position(light: SingleLight, position: np.ndarray, seen_from: np.ndarray) -> PointLight:
    """The light at a measured position; a far light's irradiance becomes the intensity that gives it at `seen_from`."""
    x, y, z = (float(value) for value in position)
    if isinstance(light, PointLight):
        return light.model_copy(update={"position_m": (x, y, z)})
    r, g, b = (float(value * ((position - seen_from) ** 2).sum()) for value in light.irradiance)
    return PointLight(type="point", position_m=(x, y, z), intensity=(r, g, b))


def with_brightness(light: SingleLight, rgb: np.ndarray) -> SingleLight:
    """The light with a measured irradiance (distant) or intensity (point)."""
    r, g, b = (float(value) for value in rgb)
    return light.model_copy(update={"irradiance" if isinstance(light, DistantLight) else "intensity": (r, g, b)})
