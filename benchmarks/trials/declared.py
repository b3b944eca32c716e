"""Lights and materials other than declared: lamps near the object or elsewhere, lights that are turned alike, one of five of twice the
strength, and velvet; right ones beside.

The scenes are an egg with waves on it and a field of random waves, in closed form, under lights on a spiral, with shot noise. Velvet is the
inverted Gaussian of Ashikhmin, Premoze and Shirley, "A microfacet-based BRDF generator", SIGGRAPH 2000.
"""

import json
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from benchmarks.trials.lights import trial, write_grey
from benchmarks.trials.trial import Trial
from service.requests.solve import LightsKnown, Method
from tests.reference.colour import linear_to_srgb

SIZE = 96
NOISE = 0.003
"""Standard deviation of the noise at full scale; it is shot noise, and a tenth of it in the dark."""


class Surface(NamedTuple):
    """A surface in half widths of the image."""

    points: np.ndarray  # [rows, cols, 3]
    normal: np.ndarray  # [rows, cols, 3]
    albedo: np.ndarray  # [rows, cols]
    mask: np.ndarray  # [rows, cols] bool


@dataclass(frozen=True)
class Case:
    """One object and its lights."""

    name: str
    shape: Literal["egg", "field"]
    material: Literal["matt", "gloss", "velvet"]
    lights: int
    away: float | None = None
    """Distance of the lamps in half widths; None: they are far."""
    doubled: bool = False
    near: bool = False
    """Whether the lamps are declared as near ones, of which a half width is a tenth of a metre."""
    aside_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """By how much near lamps are declared aside of where they stand."""
    factor: float = 1.0
    """How many times as far from the origin near lamps are declared."""
    turned: float = 0.0
    """Angle in degrees by which all far lamps are declared turned about the axis to the right."""
    refined: bool = False
    adapted: bool = False
    """Whether the images have eight bits and were dimmed where they are bright, as HDR modes of phones do it."""


HALF_M = 0.1
"""Half width of an object under near lamps."""
CASES = [
    Case("egg, 8 lamps 1.5 half widths away, declared distant", "egg", "matt", 8, away=1.5),
    Case("egg, gloss, 20 lamps 2 half widths away, declared distant", "egg", "gloss", 20, away=2.0),
    Case("field, 16 lamps 6 half widths away, declared distant", "field", "matt", 16, away=6.0),
    Case("egg, one of 5 lights doubled", "egg", "matt", 5, doubled=True),
    Case("field, gloss, one of 5 lights doubled", "field", "gloss", 5, doubled=True),
    Case("egg, velvet, 20 lights", "egg", "velvet", 20), Case("field, velvet, 12 lights", "field", "velvet", 12),
    Case("egg, gloss, 20 lights", "egg", "gloss", 20), Case("egg, 8 lights", "egg", "matt", 8),
    Case("egg, 8 near lights", "egg", "matt", 8, away=2.5, near=True),
    Case("egg, 8 near lights, declared 3 cm aside", "egg", "matt", 8, away=2.5, near=True, aside_m=(0.03, 0.0, 0.0)),
    Case("field, 12 near lights, declared 1.3 times as far", "field", "matt", 12, away=4.0, near=True, factor=1.3),
    Case("egg, gloss, 20 near lights, declared 4 cm too near", "egg", "gloss", 20, away=3.0, near=True, aside_m=(0.0, 0.0, -0.04)),
    Case("egg, 8 lights, declared turned by 5°", "egg", "matt", 8, turned=5.0),
    Case("egg, 8 lights, declared turned by 5°, refined", "egg", "matt", 8, turned=5.0, refined=True),
    Case("field, gloss, 24 lights, declared turned by 10°", "field", "gloss", 24, turned=10.0),
    Case("egg, gloss, 40 lights, declared turned by 5°, refined", "egg", "gloss", 40, turned=5.0, refined=True),
    Case("field, 10 lights, images adapted from place to place", "field", "matt", 10, adapted=True),
    Case("egg, 8 lights, images adapted from place to place", "egg", "matt", 8, adapted=True),
]


def surface(shape: str, random: np.random.Generator) -> Surface:
    """Return a surface with seven waves."""
    across = (np.arange(SIZE) + 0.5) / SIZE * 2 - 1
    x, y = np.meshgrid(across, -across)
    z, slope, inside = np.zeros_like(x), np.zeros((2, SIZE, SIZE)), np.ones_like(x, dtype=bool)
    if shape == "egg":
        round_ = x**2 / 0.8 + y**2 / 0.9
        z, inside = 0.75 * np.sqrt(np.maximum(1 - round_, 1e-6)), round_ < 0.85
        slope = -0.75**2 * np.stack([x / 0.8, y / 0.9]) / z
    for _ in range(7):
        along, phase = random.normal(0, 4, 2), random.uniform(0, 6)
        high = (0.07 if shape == "egg" else 0.21) / np.hypot(*along)
        z = z + high * np.sin(along[0] * x + along[1] * y + phase)
        slope += high * along[:, None, None] * np.cos(along[0] * x + along[1] * y + phase)
    normal = np.stack([-slope[0], -slope[1], np.ones_like(x)], axis=-1)
    albedo = 0.3 + 0.4 * (np.sin(7 * x + 1) * np.sin(6 * y + 2) > 0)
    return Surface(np.stack([x, y, z - z[inside].mean()], axis=-1), normal / np.linalg.norm(normal, axis=-1, keepdims=True), albedo, inside)


def reflect(material: str, normal: np.ndarray, toward: np.ndarray) -> np.ndarray:
    """Return the radiance of normals [rows, cols, 3] under light from directions of that shape, for albedo 1 and irradiance π."""
    facing, seen = np.maximum((normal * toward).sum(axis=-1), 0), np.maximum(normal[..., 2], 0)
    half = toward + np.array([0.0, 0.0, 1.0])
    top = np.clip((normal * half).sum(axis=-1) / np.linalg.norm(half, axis=-1), 0, 1)
    if material == "velvet":
        sine = np.sqrt(np.maximum(1 - top**2, 1e-6))
        fuzz = 0.25 + 4 * np.exp(-((top / sine / 0.5) ** 2)) / np.maximum(sine, 0.05) ** 4
        return np.where(facing > 0, 0.5 * facing * fuzz / (facing + seen - facing * seen + 1e-6), 0)
    return facing + (0.6 * (facing > 0) * top**60 if material == "gloss" else 0)


def write(folder: Path, case: Case, number: int) -> Surface:
    """Write the capture of a case."""
    random = np.random.default_rng(500 + number)
    found = surface(case.shape, random)
    i = np.arange(case.lights) + 0.5
    up = 1 - (1 - np.cos(np.radians(50))) * i / case.lights
    turn = np.pi * (1 + 5**0.5) * i + random.uniform(0, 6)
    directions = np.stack([np.sqrt(1 - up**2) * np.cos(turn), np.sqrt(1 - up**2) * np.sin(turn), up], axis=1)
    images = np.empty((case.lights, SIZE, SIZE))
    for image, direction in zip(images, directions, strict=True):
        way = np.broadcast_to(direction, found.points.shape) if case.away is None else case.away * direction - found.points
        length = np.linalg.norm(way, axis=-1)
        image[:] = found.albedo * reflect(case.material, found.normal, way / length[..., None]) * (1 if case.away is None else
                                                                                                  (case.away / length) ** 2)
    images[case.lights // 2] *= 2 if case.doubled else 1
    scale = 0.9 / np.percentile(images, 99.9)
    images *= scale
    images += NOISE * np.sqrt(images + 0.01) * random.standard_normal(images.shape)
    frames = []
    images = np.clip(images, 0, 1) * found.mask
    if case.adapted:
        images = np.stack([dimmed_where_bright(image) for image in images])
    for place, (image, direction) in enumerate(zip(images, directions, strict=True)):
        write_grey(folder / f"{place:02d}.exr", image)
        told = Rotation.from_rotvec([case.turned, 0, 0], degrees=True).apply(direction)
        light = {"type": "distant", "direction": told.tolist(), "irradiance": [np.pi] * 3}
        if case.near:
            away_m = case.factor * HALF_M * (case.away or 0.0)
            light = {"type": "point", "position_m": (away_m * direction + case.aside_m).tolist(),
                     "intensity": [np.pi * scale * away_m**2] * 3}
        frames.append({"image": f"{place:02d}.exr", "light": light})
    write_grey(folder / "mask.exr", found.mask)
    (folder / "capture.json").write_text(json.dumps({
        "schema": "relit.capture/1", "name": "declared", "frames": frames, "mask": "mask.exr", "saturation": 0.999,
        "irradiance_scale": "relative", "color_space": "srgb_texture" if case.adapted else "lin_rec709_scene",
        "camera": {"projection": "orthographic", "resolution": [SIZE, SIZE],
                   **({"pixel_size_m": 2 * HALF_M / SIZE, "surface_z_m": 0.0} if case.near else {})}}))
    return found


def dimmed_where_bright(light: np.ndarray) -> np.ndarray:
    """Return [rows, cols] light from 0 to 1 as codes of eight bits from 0 to 1, dimmed by the mean code around each pixel."""
    codes = linear_to_srgb(light)
    return np.rint(255 * np.clip(0.7 * codes / (0.3 + 1.4 * gaussian_filter(codes, SIZE / 8)), 0, 1)) / 255


def trials(data: Path | None) -> Iterator[Trial]:
    """Yield every case, by the default method."""
    for number, case in enumerate(CASES):
        with tempfile.TemporaryDirectory() as folder:
            truth = write(Path(folder), case, number)
            method = Method.SVBRDF if case.lights >= 12 else Method.ROBUST
            placed = case.away is None or (case.near and not any(case.aside_m) and case.factor == 1)
            right = placed and not case.doubled and not case.turned and not case.adapted and case.material != "velvet"
            yield trial(case.name, Path(folder), truth.normal, truth.mask, in_model=right, method=method,
                        lights=LightsKnown.REFINED if case.refined else LightsKnown.DECLARED)[0]
