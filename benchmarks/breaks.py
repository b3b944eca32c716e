"""Counts wrongly cut surfaces and wrongly joined breaks in ray-cast depth maps: `python -m benchmarks.breaks`.

A ray caster of its own: boxes and spheres on floors, before walls or under the open sky, stairs, a corner of two walls, and planes at
grazing angles. Two neighbouring pixels lie on two surfaces where one of 24 steps between their lines of sight makes more than half of the
change of the inverse depth. Breaks are counted where they are steeper than 80°, surfaces everywhere.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from stage.capture.camera import Camera
from stage.results.depth_breaks import connected, same_surface

COLS, ROWS, FOCAL_PX = 160, 120, 130.0
STEPS = 24
"""Lines of sight between two pixels by which a break is known."""
SAMPLES = 5
"""Rays of a pixel in each direction, of which a mixed pixel is the mean, weighted with 1 / depth² as returned light is."""
CAMERA = Camera(projection="perspective", resolution=(COLS, ROWS), focal_px=(FOCAL_PX, FOCAL_PX))
NOISE: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "none": np.zeros_like,
    "structured light, 2 mm at 1 m, growing with Z²": lambda depth: 0.002 * depth**2,
    "time of flight, 10 mm + 2 mm/m² Z²": lambda depth: 0.01 + 0.002 * depth**2,
    "time of flight, 20 mm + 6 mm/m² Z²": lambda depth: 0.02 + 0.006 * depth**2,
}

Surface = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Depths along the lines of sight (x, y, -1), infinite where they miss it."""


class Counts(NamedTuple):
    """Pairs of neighbouring pixels."""

    surface: int
    cut: int
    breaks: int
    joined: int


def plane(normal: tuple[float, float, float], offset: float, inside: Callable[[np.ndarray], np.ndarray] | None = None) -> Surface:
    """Return the part of the plane normal · p = offset whose points [..., 3] are inside."""
    def depth(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            found = offset / (normal[0] * x + normal[1] * y - normal[2])
            found = np.where((found > 0) & np.isfinite(found), found, np.inf)
            if inside is not None:
                found = np.where(inside(np.stack([x * found, y * found, -found], axis=-1)), found, np.inf)
        return found
    return depth


def sphere(centre: tuple[float, float, float], radius: float) -> Surface:
    """Return a sphere."""
    def depth(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        ray, middle = np.stack([x, y, -np.ones_like(x)], axis=-1), np.array(centre)
        a, b, c = (ray * ray).sum(axis=-1), ray @ middle, middle @ middle - radius**2
        under = b * b - a * c
        return np.where(under >= 0, (b - np.sqrt(np.maximum(under, 0))) / a, np.inf)
    return depth


def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> list[Surface]:
    """Return the sides of a box."""
    def side(axis: int, offset: float) -> Surface:
        others = [other for other in range(3) if other != axis]
        first, last = np.array(low)[others] - 1e-9, np.array(high)[others] + 1e-9
        normal = tuple(float(axis == other) for other in range(3))
        return plane((normal[0], normal[1], normal[2]), offset,
                     lambda points: ((points[..., others] >= first) & (points[..., others] <= last)).all(axis=-1))
    return [side(axis, corner[axis]) for axis in range(3) for corner in (low, high)]


def scenes() -> dict[str, list[Surface]]:
    """Return the surfaces of each scene, metres."""
    floor = plane((0, 1, 0), -1.5)
    things = [*box((-1.5, -1.5, -4.5), (-0.5, 0, -4)), *box((1, -1.5, -9), (2, 0.6, -8.5)), sphere((0.6, -1.1, -3.2), 0.4)]
    stairs = [side for step in range(8) for side in box((-2, -1.5, -8 - 0.3 * step), (2, -1.33 + 0.17 * step, -4 - 0.3 * step))]
    slant = np.radians(85)
    tilted = np.array([-0.3, 0.9, 0.18]) / np.linalg.norm([-0.3, 0.9, 0.18])
    return {
        "horizon": [floor, *things, *box((-0.2, -1.5, -13), (0.5, -0.3, -12.6))],
        "room": [floor, plane((0, 0, 1), -12), plane((1, 0, 0), -4), *things],
        "stairs": [floor, plane((0, 0, 1), -9), *stairs],
        "sphere": [sphere((0, 0, -2), 0.6), plane((0, 0, 1), -4)],
        "corner": [plane((0.8, 0, 0.6), -1.8), plane((-0.8, 0, 0.6), -1.8), plane((0, 1, 0), -1)],
        "plane at 85°": [plane((np.sin(slant), 0, np.cos(slant)), -2 * np.cos(slant), lambda p: (p[..., 2] > -6) & (abs(p[..., 1]) < 0.6)),
                         plane((0, 0, 1), -8), *box((0.4, -0.4, -2.5), (0.7, 0.4, -2.2))],
        "tilted": [plane((tilted[0], tilted[1], tilted[2]), -1), plane((0, 0, 1), -14), *box((-1.2, -1.2, -5), (-0.4, 0.2, -4.6)),
                   sphere((0.2, -0.4, -2.5), 0.3)],
        "low camera": [plane((0, 1, 0), -0.35), plane((0, 0, 1), -10), *box((-0.6, -0.35, -2.2), (-0.3, -0.1, -2)),
                       *box((0.2, -0.35, -5.2), (0.9, 0.3, -5)), *box((-1.5, -0.35, -7.4), (-0.6, -0.2, -7))],
    }


def cast(surfaces: list[Surface], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the depth of the nearest surface along each line of sight."""
    return np.minimum.reduce([surface(x, y) for surface in surfaces])


def mixed(surfaces: list[Surface]) -> np.ndarray:
    """Return the depths [rows, cols] of pixels that mix what all their rays meet."""
    u, v = np.meshgrid((np.arange(COLS * SAMPLES) + 0.5) / SAMPLES, (np.arange(ROWS * SAMPLES) + 0.5) / SAMPLES)
    depth = cast(surfaces, *CAMERA.plane_at(u, v)).reshape(ROWS, SAMPLES, COLS, SAMPLES)
    light = np.where(np.isfinite(depth), 1 / depth**2, 0)
    total = light.sum(axis=(1, 3))
    return np.where(total > 0, (np.where(np.isfinite(depth), depth, 0) * light).sum(axis=(1, 3)) / np.where(total > 0, total, 1), np.inf)


def count(surfaces: list[Surface], noise: Callable[[np.ndarray], np.ndarray], *, mix: bool, by_slope: bool) -> Counts:
    """Return what is found on one scene, by the slope alone or by stage.results.depth_breaks."""
    x, y = CAMERA.plane_coordinates()
    true = cast(surfaces, x, y)
    seen = np.isfinite(true)
    sigma = noise(np.where(seen, true, 1))
    measured = mixed(surfaces) if mix else true
    depth = np.where(seen, measured, 1) + sigma * np.random.default_rng(1).standard_normal(true.shape)
    seen &= depth > 0
    found = np.zeros(4, dtype=np.int64)
    for down, right in ((0, 1), (1, 0)):
        here, there = (slice(0, ROWS - down), slice(0, COLS - right)), (slice(down, None), slice(right, None))
        along = np.linspace(0, 1, STEPS + 1)[:, None, None]
        inverse = 1 / cast(surfaces, x[here] + (x[there] - x[here]) * along, y[here] + (y[there] - y[here]) * along)
        change = np.abs(inverse[-1] - inverse[0])
        apart = np.abs(np.diff(inverse, axis=0)).max(axis=0) > 0.5 * np.maximum(change, 1e-12)
        both = seen[here] & seen[there]
        true_here, true_there = (np.where(seen, true, 1)[part] for part in (here, there))
        breaks = both & apart & ~same_surface(true_here, true_there, 1.0, CAMERA)
        joined = (both & same_surface(depth[here], depth[there], 1.0, CAMERA) if by_slope
                  else connected(np.where(seen, depth, 1), seen, CAMERA, (down, right), sigma=sigma)[here])
        surface = both & ~apart
        found += [surface.sum(), (surface & ~joined).sum(), breaks.sum(), (breaks & joined).sum()]
    return Counts(*found.tolist())


def main() -> None:
    """Print a table of all scenes together."""
    print("| noise | pixels | rule | surface, pairs | cut | breaks | joined |\n|---|---|---|---|---|---|---|")
    for name, noise in NOISE.items():
        for mix in (False, True):
            for by_slope in (True, False):
                counts = [count(surfaces, noise, mix=mix, by_slope=by_slope) for surfaces in scenes().values()]
                total = Counts(*np.sum(counts, axis=0).tolist())
                print(f"| {name} | {'mixed' if mix else 'clean'} | {'slope' if by_slope else 'surface'} "
                      f"| {total.surface} | {total.cut} | {total.breaks} | {total.joined} |")


if __name__ == "__main__":
    main()
