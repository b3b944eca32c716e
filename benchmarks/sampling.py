"""Photometric sampling against truth: balls of many materials under diffused sources, through files, as a user would solve them.

`python -m benchmarks.sampling` prints the table of docs/svbrdf.md; the images come from the float64 twin of the tests, which
shares no code with the solver. Noise is Gaussian, a part of each reading.
"""

import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.accuracy import angles_deg
from service.requests.solve import SolveRequest
from service.solve.solve import solve
from tests.reference import sampling as twin
from tests.scenes.extended_lights import COLOUR, SHARPNESS, VIEW, Ball, ball, light, write_sampling

LIGHTS, SIDE, NOISE = 24, 48, 0.01
LAMBERTIAN, GLOSSY, MIRROR, MIXTURE = 1, 2, 3, 4


class Material(NamedTuple):
    """The materials of the two halves of a ball."""

    radiance: Callable[[np.ndarray, np.ndarray], np.ndarray]
    """(normals, centres) → [n, lights]"""
    regime: Callable[[np.ndarray], np.ndarray]


def paint(albedo: float) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    return lambda normal, centres: albedo * twin.lambert(normal, centres, SHARPNESS)


def mirror(f0: float) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    return lambda normal, centres: twin.mirror(normal, VIEW, centres, SHARPNESS, f0=f0)


def metal(alpha: float, f0: float) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    return lambda normal, centres: twin.ggx(normal, VIEW, centres, SHARPNESS, alpha=alpha, f0=f0)


def both(*parts: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    return lambda normal, centres: sum(part(normal, centres) for part in parts)


def halves(left: Callable[[np.ndarray, np.ndarray], np.ndarray],
           right: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    return lambda normal, centres: np.where(normal[:, :1] < 0, left(normal, centres), right(normal, centres))


def one(code: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda normal: np.full(len(normal), code)


MATERIALS = {
    "mirror, F0 0.9": Material(mirror(0.9), one(MIRROR)),
    "half painted, half metallic (roughness 0.32)": Material(
        halves(paint(0.6), metal(0.1, 0.8)), lambda normal: np.where(normal[:, 0] < 0, LAMBERTIAN, GLOSSY)),
    "half painted, half mirror": Material(
        halves(paint(0.6), mirror(0.9)), lambda normal: np.where(normal[:, 0] < 0, LAMBERTIAN, MIRROR)),
    "paint": Material(paint(0.6), one(LAMBERTIAN)),
    "metal, roughness 0.5": Material(metal(0.25, 0.8), one(GLOSSY)),
    "metal, roughness 0.7": Material(metal(0.49, 0.8), one(GLOSSY)),
    "plastic, roughness 0.5": Material(both(paint(0.5), metal(0.25, 0.04)), one(MIXTURE)),
    "glazed: paint under a mirror of F0 0.04": Material(both(paint(0.5), mirror(0.04)), one(MIXTURE)),
}


def run(name: str, noise: float, folder: Path, scene: Ball, centres: np.ndarray, lights: list[dict]) -> str:
    """Solve one ball and return its row of the table."""
    material, normals = MATERIALS[name], scene.normal[scene.mask]
    radiance = material.radiance(normals, centres)[..., None] * COLOUR
    radiance = radiance * (1 + noise * np.random.default_rng(0).normal(size=radiance.shape))
    write_sampling(folder, scene, radiance, centres, lights=lights)
    began = time.process_time()
    maps = solve(SolveRequest(capture=folder, out=folder / "out", cache=folder / "cache")).maps
    seconds = time.process_time() - began
    error = angles_deg(maps.normal[scene.mask], normals)
    right = (maps.regime[scene.mask] == material.regime(normals)).mean()
    return (f"| {name} | {100 * noise:g} % | {error.mean():.2f} | {np.median(error):.2f} "
            f"| {np.percentile(error, 99):.2f} | {100 * right:.1f} % | {np.median(maps.diffuse_albedo[scene.mask]):.3f} "
            f"| {np.median(maps.specular[scene.mask]):.3f} "
            f"| {np.median(maps.roughness[scene.mask]):.2f} | {seconds:.1f} |")


def main(side: int = SIDE) -> None:
    scene, centres = ball(side), twin.lattice(LIGHTS)
    lights = [light(centre) for centre in centres]
    print(f"{LIGHTS} sources, {scene.mask.sum()} pixels; degrees; medians of the whole ball\n")
    print("| ball | noise | mean | median | 99 % | regime | albedo | F0 | roughness | CPU s |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for name in MATERIALS:
        for noise in (0.0, NOISE):
            with tempfile.TemporaryDirectory() as folder:
                print(run(name, noise, Path(folder), scene, centres, lights), flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
