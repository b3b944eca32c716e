"""Trials of photometric sampling and of the reference ball: an ellipsoid under evenly bright caps and under single lights.

Rendered here with importance sampling of visible microfacets (Heitz, JCGT 2018), which shares no code with the solver or with its tests. A
cap has a hard edge,
which the sources of neither have.
"""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.accuracy import angles_deg
from benchmarks.trials.declared import reflect
from benchmarks.trials.trial import Trial
from kernels.status import SOLVED
from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve
from tests.scenes.captures import write_exr, write_image, write_manifest

SIDE, RELIEF, NOISE, DARK_NOISE = 24, 0.8, 0.01, 0.001
VIEW = np.array([0.0, 0.0, 1.0])
MICROFACETS, DIRECTIONS = 1024, 20000
Material = tuple[float, float, float]
"""Albedo, GGX width α (0: a mirror) and F0."""
MIRROR, METAL, PLASTIC, PAINT = (0.0, 0.0, 0.9), (0.0, 0.2, 0.8), (0.4, 0.12, 0.05), (0.6, 0.3, 0.0)


def trials(data: Path | None) -> Iterator[Trial]:
    """Yield what relit solve makes of each material under caps of several widths, and with a ball of the right and of a wrong material."""
    normal, mask = ellipsoid(SIDE, RELIEF)
    for half, count, material, name in ((30, 10, MIRROR, "mirror"), (14, 26, MIRROR, "mirror"), (8, 30, MIRROR, "mirror"),
                                        (14, 26, METAL, "metal"), (14, 26, PLASTIC, "plastic"), (30, 10, PAINT, "paint")):
        centres = even(count)
        radiance = under_caps(normal[mask], centres, half, material)
        lights = [cap(centre, half) for centre in centres]
        sees = half == 30 or material[1] > 0  # a mirror under narrow caps does not see enough
        yield solved(f"sampling, {name}, {count} caps of {half}°", sees, normal, mask, radiance, lights)
    lights, directions = single_lights(20)
    sphere, disc = ellipsoid(96, 1.0)
    for ball, name, right in ((PLASTIC, "plastic", True), ((0.0, 0.3, 0.8), "metal", False)):
        with tempfile.TemporaryDirectory() as folder:
            write(Path(folder) / "ball", disc, under_lights(sphere[disc], directions, ball), lights)
            radiance = under_lights(normal[mask], directions, PLASTIC)
            yield solved(f"reference, plastic with a {name} ball", right, normal, mask, radiance, lights,
                         method=Method.REFERENCE, reference_ball=Path(folder) / "ball")
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / "ball", disc, under_lights(sphere[disc], directions, (0.6, 1.0, 0.0)), lights)
        toward = np.broadcast_to(directions[:, None], (len(directions), int(mask.sum()), 3))
        radiance = 0.5 / np.pi * np.stack([reflect("velvet", normal[mask], way) for way in toward], axis=1)
        yield solved("reference, velvet with a matt ball", False, normal, mask, np.repeat(radiance[..., None], 3, axis=2), lights,
                     method=Method.REFERENCE, reference_ball=Path(folder) / "ball")


def solved(name: str, in_model: bool, normal: np.ndarray, mask: np.ndarray, radiance: np.ndarray, lights: list[dict[str, Any]],
           **options: Any) -> Trial:
    """Return the trial of a capture with noise."""
    rng = np.random.default_rng(4)
    noisy = radiance * (1 + NOISE * rng.normal(size=radiance.shape)) + DARK_NOISE * radiance.max() * rng.normal(size=radiance.shape)
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder), mask, noisy, lights)
        result = solve(SolveRequest(capture=Path(folder), out=Path(folder) / "out", cache=Path(folder) / "cache", **options))
    maps = result.maps
    return Trial(name, in_model, angles_deg(maps.normal[mask], normal[mask]), maps.sigma[mask], maps.confidence[mask],
                 np.isin(maps.status[mask], SOLVED), "°", "; ".join(result.warnings))


def ellipsoid(side: int, stretch: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the normals [side, side, 3] and the mask of z = stretch · √(1 - x² - y²)."""
    centre = ((np.arange(side) + 0.5) / side * 2 - 1) * 1.05
    x, y = np.meshgrid(centre, -centre)
    mask = x**2 + y**2 < 0.995
    z = np.sqrt(np.where(mask, 1 - x**2 - y**2, 1))
    normal = np.stack([stretch * x, stretch * y, z], axis=-1)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True), mask


def even(count: int) -> np.ndarray:
    """Return [count, 3] directions spread over the sphere."""
    i = np.arange(count) + 0.5
    z, turn = 1 - 2 * i / count, np.pi * (3 - 5**0.5) * i + 0.4
    return np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)


def cap(centre: np.ndarray, half: float) -> dict[str, Any]:
    """Return an evenly bright cap of this half width in degrees, as the manifest holds it."""
    grid = even(DIRECTIONS)
    inside = grid[grid @ centre > np.cos(np.radians(half))]
    return {"type": "extended", "directions": np.round(inside, 9).tolist(), "radiance": np.ones((len(inside), 3)).tolist(),
            "solid_angle": [4 * np.pi / DIRECTIONS] * len(inside)}


def under_caps(normal: np.ndarray, centres: np.ndarray, half: float, material: Material) -> np.ndarray:
    """Return [n, lights, 3] the radiance of pixels under caps of radiance one."""
    albedo, alpha, f0 = material

    def shines(direction: np.ndarray) -> np.ndarray:
        return (direction @ centres.T > np.cos(np.radians(half))).astype(float)

    grid = even(DIRECTIONS)
    result = albedo / np.pi * np.maximum(normal @ grid.T, 0) @ shines(grid) * (4 * np.pi / DIRECTIONS)
    if alpha == 0:
        result += fresnel(normal[:, 2:], f0) * shines(2 * normal[:, 2:] * normal - VIEW)
    elif f0 > 0:
        lobes = (reflected(one, alpha, f0) for one in normal)
        result += np.stack([(weight[:, None] * shines(light)).mean(axis=0) for light, weight in lobes])
    return np.repeat(result[..., None], 3, axis=2)


def reflected(normal: np.ndarray, alpha: float, f0: float) -> tuple[np.ndarray, np.ndarray]:
    """Return directions [m, 3] in which a GGX surface reflects the view, drawn by its visible microfacets, and the weight [m] of each."""
    side = np.cross([0.0, 1.0, 0.0], normal)
    side /= np.linalg.norm(side)
    frame = np.stack([side, np.cross(normal, side), normal])
    view = frame @ VIEW
    stretched = np.array([alpha * view[0], alpha * view[1], view[2]])
    stretched /= np.linalg.norm(stretched)
    first = np.cross([0.0, 0.0, 1.0], stretched)
    first = first / np.linalg.norm(first) if np.linalg.norm(first) > 1e-9 else np.array([1.0, 0.0, 0.0])
    second = np.cross(stretched, first)
    step = np.arange(MICROFACETS)
    radius, turn = np.sqrt((step + 0.5) / MICROFACETS), 2 * np.pi * ((step * 0.6180339887) % 1)
    across, along, tilt = radius * np.cos(turn), radius * np.sin(turn), 0.5 * (1 + stretched[2])
    along = (1 - tilt) * np.sqrt(1 - across**2) + tilt * along
    up = np.sqrt(np.maximum(1 - across**2 - along**2, 0))
    half = across[:, None] * first + along[:, None] * second + up[:, None] * stretched
    half = np.stack([alpha * half[:, 0], alpha * half[:, 1], np.maximum(half[:, 2], 1e-9)], axis=1)
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    facing = half @ view
    light = 2 * facing[:, None] * half - view

    def hidden(cosine: Any) -> Any:
        return (np.sqrt(1 + alpha**2 * (1 / np.maximum(cosine, 1e-6) ** 2 - 1)) - 1) / 2

    masking = (1 + hidden(view[2])) / (1 + hidden(view[2]) + hidden(light[:, 2]))
    return light @ frame, np.where(light[:, 2] > 0, masking * fresnel(facing, f0), 0)


def fresnel(cosine: np.ndarray, f0: float) -> np.ndarray:
    return f0 + (1 - f0) * np.clip(1 - cosine, 0, 1) ** 5


def single_lights(count: int) -> tuple[list[dict[str, Any]], np.ndarray]:
    """Return distant lights within 75° of the view as the manifest holds them, and their directions."""
    directions = even(3 * count)
    directions = directions[directions[:, 2] > np.cos(np.radians(75))]
    return [{"type": "distant", "direction": way.tolist(), "irradiance": [1.0, 1.0, 1.0]} for way in directions], directions


def under_lights(normal: np.ndarray, directions: np.ndarray, material: Material) -> np.ndarray:
    """Return [n, lights, 3] the radiance of pixels under single lights of irradiance one."""
    albedo, alpha, f0 = material
    half = directions + VIEW
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    nl, nh, nv = np.maximum(normal @ directions.T, 0), np.maximum(normal @ half.T, 0), np.maximum(normal[:, 2:], 1e-3)
    spread = alpha**2 / (np.pi * (nh**2 * (alpha**2 - 1) + 1) ** 2)
    visible = nl * np.sqrt(alpha**2 + (1 - alpha**2) * nv**2) + nv * np.sqrt(alpha**2 + (1 - alpha**2) * nl**2)
    value = nl * (albedo / np.pi + spread * fresnel(half @ VIEW, f0) / (2 * np.maximum(visible, 1e-9)))
    return np.repeat(value[..., None], 3, axis=2)


def write(folder: Path, mask: np.ndarray, radiance: np.ndarray, lights: list[dict[str, Any]]) -> None:
    """Write a capture of the masked pixels."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = []
    for index, light in enumerate(lights):
        image = np.zeros((*mask.shape, 3))
        image[mask] = np.maximum(radiance[:, index], 0)
        write_exr(folder / f"{index:03d}.exr", image)
        frames.append({"image": f"{index:03d}.exr", "light": light})
    write_image(folder / "mask.png", (mask * 255).astype(np.uint8))
    rows, cols = mask.shape
    write_manifest(folder, {"schema": "relit.capture/1", "name": "trial", "mask": "mask.png", "frames": frames,
                            "camera": {"projection": "orthographic", "resolution": [cols, rows]}})
