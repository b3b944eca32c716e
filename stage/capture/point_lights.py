"""The point lights of a capture as arrays: their positions, and their directions and irradiances at the centre of the object."""

from typing import NamedTuple, TypeVar

import numpy as np

from stage.capture.camera import Camera
from stage.capture.capture import SOURCES, Capture
from stage.capture.light import DistantLight, GradientLight, PointLight
from stage.capture.manifest import FILE_NAME
from stage.capture.polarised_pairs import check_pairs
from stage.errors import ManifestError

AtOnePlace = TypeVar("AtOnePlace", bound=DistantLight | PointLight)
LEAST_SPAN = 0.01
"""Largest distance of near lights along an axis, over the width of the object, below which one of the two is in another unit: lights so
close together leave normals open."""
NAMED = 4
"""The most frames that an error message names; it counts the others."""


class DistantLights(NamedTuple):
    """Distant lights, one row for each frame, in the order of the manifest and the stack."""

    direction: np.ndarray  # [lights, 3] float64, unit, from the surface to the light, camera frame
    irradiance: np.ndarray  # [lights, 3] float64, relative


class PlacedLights(NamedTuple):
    """Distant and point lights, one row for each frame, in the order of the manifest and the stack."""

    direction: np.ndarray  # [lights, 3] float64, unit, from the object's centre to the light, camera frame
    irradiance: np.ndarray  # [lights, 3] float64, at the object's centre, relative
    place: np.ndarray  # [lights, 4] float64: position in metres and 1, or unit direction and 0 for a distant light
    strength: np.ndarray  # [lights, 3] float64: intensity, or irradiance of a distant light
    lobe: np.ndarray  # [lights, 4] float64: unit axis and exponent μ; 0 for a light that is equal in all directions
    centre: np.ndarray  # [3] float64, the centre of the object: mean of the masked pixels at its mean z

    @classmethod
    def about(cls, centre: np.ndarray, place: np.ndarray, strength: np.ndarray, lobe: np.ndarray) -> "PlacedLights":
        """Return lights with their directions and irradiance at the centre of an object."""
        way = place[:, :3] - place[:, 3:] * centre
        distance = np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)
        direction = way / distance
        falloff = np.where(place[:, 3:] == 1, 1 / distance**2, 1.0)
        shining = np.maximum(-(lobe[:, :3] * direction).sum(axis=1, keepdims=True), 0) ** lobe[:, 3:]  # 0 to the power 0 is 1
        return cls(direction, strength * falloff * shining, place, strength, lobe, centre)


class LightPlaces(NamedTuple):
    """Positions and irradiance of distant and point lights, one row for each frame, as `PlacedLights` has it."""

    frames: tuple[int, ...]
    """Numbers of the frames in the manifest."""
    place: np.ndarray  # [lights, 4] float64
    strength: np.ndarray  # [lights, 3] float64
    lobe: np.ndarray  # [lights, 4] float64


def lights_of(capture: Capture, needed: str, *kinds: type[AtOnePlace]) -> list[tuple[int, AtOnePlace]]:
    """Return the lights of the stack of a capture, each with the number of its frame, all of which must be of one of these kinds.
    `needed`: the kinds in words. Raises ManifestError if a light is of another kind, or there is none; the message names the frame."""
    frames = capture.manifest.frames
    for index, frame in enumerate(frames):
        if isinstance(frame.light, SOURCES) and not isinstance(frame.light, kinds):
            hint = " (relit solve --method gradient solves gradients)" if isinstance(frame.light, GradientLight) else ""
            raise ManifestError(f"{capture.folder / FILE_NAME}: frames[{index}].light: is {frame.light.type}: this needs {needed} "
                                f"lights{hint}")
    lights: list[tuple[int, AtOnePlace]] = [(index, frame.light) for index, frame in enumerate(frames) if isinstance(frame.light, kinds)]
    if not lights:
        raise ManifestError(capture.none_is_lit(f"a {needed} light"))
    return lights


def light_places(capture: Capture) -> LightPlaces:
    """Return where the lights of the stack of a capture are, all of which must be distant or point lights."""
    lights: list[tuple[int, DistantLight | PointLight]] = lights_of(capture, "distant or point", DistantLight, PointLight)
    place, strength, lobe = np.zeros((len(lights), 4)), np.zeros((len(lights), 3)), np.zeros((len(lights), 4))
    for row, (_, light) in enumerate(lights):
        if isinstance(light, DistantLight):
            place[row, :3], strength[row] = light.direction, light.irradiance
        else:
            place[row], strength[row] = (*light.position_m, 1), light.intensity
            if light.axis is not None and light.anisotropy:
                lobe[row] = *light.axis, light.anisotropy
    return LightPlaces(tuple(index for index, _ in lights), place, strength, lobe)


def distance_is_missing(capture: Capture) -> bool:
    """Return whether a capture has near lights, does not say how far the surface is, and its images may tell: those of polarised pairs are
    not Lambertian, and an orthographic camera needs the size of a pixel."""
    camera = capture.camera
    scaled = camera.projection == "perspective" or camera.pixel_size_m is not None
    return scaled and camera.surface_z_m is None and bool(capture.lit_by(PointLight)) and not capture.is_polarised


def place_lights(capture: Capture) -> PlacedLights:
    """Return the lights of the stack of a capture, all of which must be distant or point lights.
    Raises ManifestError if a light is of another type, there is none, the camera has no scale, or lights stand inside or behind the
    object."""
    where = capture.folder / FILE_NAME
    frames, place, strength, lobe = light_places(capture)
    camera, mask = capture.camera, capture.mask()
    if not camera.metric:
        field = "surface_z_m" if camera.projection == "perspective" else "pixel_size_m"
        told = " (relit solve estimates it from the images, and relight takes it from --maps)" if distance_is_missing(capture) else ""
        raise ManifestError(f"{where}: camera.{field}: is missing: near lights need the place of the surface in metres{told}")
    points = camera.points(np.full(mask.shape, camera.surface_z_m or 0.0))[mask]
    centre, wide = points.mean(axis=0, dtype=np.float64), float(np.ptp(points, axis=0).max())
    near = place[place[:, 3] == 1, :3]
    if len(near) == len(place) > 2 and (apart := float(np.ptp(near, axis=0).max())) < LEAST_SPAN * wide:
        raise ManifestError(f"{where}: frames[].light.position_m: the near lights lie within {apart:.2g} m, and the object is {wide:.2g} m "
                            "wide: give the positions, camera.surface_z_m and camera.pixel_size_m in metres")
    _check_places(frames, place, camera, mask, str(where))
    check_pairs(capture, place)
    return PlacedLights.about(centre, place, strength, lobe)


def _check_places(frames: tuple[int, ...], place: np.ndarray, camera: Camera, mask: np.ndarray, where: str) -> None:
    """Raise ManifestError for point lights inside the object, and when fewer than three lights stand in front of it."""
    mean_z = camera.surface_z_m or 0.0
    pixel = camera.pixel_size_m or -mean_z / min(camera.focal_px or (1.0,))
    x, y = camera.plane_coordinates()
    inside, front = [], 0
    for index, (px, py, pz, is_point) in zip(frames, place, strict=True):
        if not is_point:
            front += pz > 0
            continue
        front += pz > mean_z
        if pz > mean_z + pixel or (camera.projection == "perspective" and pz >= 0):
            continue
        far = -pz if camera.projection == "perspective" else 1.0
        # along the middle row and column: lens distortion moves the place by a few pixels, which matters little here
        col, row = np.abs(x[len(x) // 2] - px / far).argmin(), np.abs(y[:, x.shape[1] // 2] - py / far).argmin()
        if np.hypot(x[row, col] - px / far, y[row, col] - py / far) * far < pixel and mask[row, col]:
            inside.append(index)
    named = ", ".join(f"frames[{index}]" for index in inside[:NAMED]) + (", …" if len(inside) > NAMED else "")
    if inside:
        raise ManifestError(f"{where}: {named}: light.position_m: {len(inside)} of {len(place)} lights lie within the object or "
                            f"less than a pixel in front of it (z = {mean_z:g} m, +z is towards the viewer)")
    if front < 3 <= len(place):
        raise ManifestError(f"{where}: frames[].light.position_m: {front} of {len(place)} lights lie in front of the surface "
                            f"(z = {mean_z:g} m, +z is towards the viewer), and theirs is {place[:, 2].min():.3g} to "
                            f"{place[:, 2].max():.3g} m: a normal needs three or more; check axes and unit of the positions")
