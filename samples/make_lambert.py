"""Render samples/lambert: a Lambertian validation capture whose every pixel has a closed form.

    python samples/make_lambert.py --out samples/lambert
    python samples/make_lambert.py --max-depth 8 --out lambert_bounce

The default is direct light only (paths of two segments): then the radiance of a lit pixel is exactly
rho/pi * E * max(0, n.l) and that of a shadowed one 0, and whatever a solver gets wrong is its own. With
`--max-depth 8` the same object also lights itself, which is what a real capture does to a Lambertian fit.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import capture_files
import numpy as np
import rendering
from feathers import mix, noise, smoothstep
from meshing import Surface, gradient, mesh_of, vertex_normals
from scipy.ndimage import binary_erosion

LIGHT_COUNT = 32
LARGEST_ANGLE_DEGREES = 75.0  # from +z
IRRADIANCE_RANGE = (0.8, 3.1)  # each light and channel its own, so that a solver that forgets one is found out
FIELD_M = 0.1
FOOTPRINT_SUBSAMPLES = 8  # per pixel side, for the mean normal that a box filter sees
CLAY, SLATE = np.array([0.70, 0.42, 0.25]), np.array([0.25, 0.42, 0.55])


HILL_COUNT = 11
HILL_SPREAD_DEGREES = 42.0  # from +z: further out a hill would hide what lies behind it
HILL_HEIGHT_CM, HILL_WIDTH = (0.8, 1.15), (0.15, 0.2)  # the width is an angle in radians


def hills() -> list[tuple[np.ndarray, float, float]]:
    """Return the direction, height and angular half-width of each hill: a Fibonacci lattice on a cap, with the sizes in rotation."""
    i = np.arange(HILL_COUNT) + 0.5
    z = 1 - (1 - np.cos(np.radians(HILL_SPREAD_DEGREES))) * i / HILL_COUNT
    azimuth, ring = np.pi * (1 + 5**0.5) * i, np.sqrt(1 - z * z)
    size = (i * 0.381966) % 1
    return [
        (np.array([r * np.cos(a), r * np.sin(a), c]), float(np.interp(t, [0, 1], HILL_HEIGHT_CM)), float(np.interp(t, [0, 1], HILL_WIDTH)))
        for r, a, c, t in zip(ring, azimuth, z, size, strict=True)
    ]


def distance(p: np.ndarray) -> np.ndarray:
    """Return the signed distance in centimetres to a bumpy ball with hills that cast shadows and hide nothing from the camera.

    Nothing is hidden, because normals cannot tell the depth of what stands before a hidden part.
    """
    radius = np.linalg.norm(p, axis=-1)
    unit = p / np.maximum(radius, 1e-9)[..., None]
    surface = 4.05 + 0.05 * np.sin(4 * unit[..., 0] + 1) * np.cos(5 * unit[..., 1])
    for direction, height, width in hills():
        apart = 2 - 2 * unit @ direction
        surface = surface + height * np.exp(-apart / (2 * width**2))
    return radius - surface


def build(*, detail: float = 0.02) -> Surface:
    """Build the object in metres, camera frame, with two albedos that blend smoothly; `detail` is in centimetres."""
    points, faces = mesh_of(distance, [-4.9] * 3, [4.9, 4.9, 6.0], detail)
    n = len(points)
    albedo = mix(CLAY, SLATE, smoothstep(-2.0, 2.0, noise(points, 7.0, seed=2)))
    normals = gradient(distance, points, step=0.005)
    if np.einsum("ij,ij->i", normals, vertex_normals(points, faces)).min() < 0.9:
        raise ValueError("the mesh folds over itself: choose a smaller --detail")
    return Surface(points * 0.01, faces, normals, albedo, np.zeros(n), np.ones(n))


def footprint_truth(mi, shapes: dict, *, resolution: int, pixel_size_m: float) -> capture_files.Truth:
    """Return the truth of a box filter: the mean normal of each pixel, and the albedo that belongs to it.

    A pixel lit all over has radiance E/pi * mean(rho n) . l, so its normal is mean(n) renormalised and its albedo
    the part of mean(rho n) along it: a little less than mean(rho) where the surface curves within the pixel.
    The mask is eroded by one pixel.
    """
    centre = rendering.trace_truth(mi, shapes, resolution=resolution, pixel_size_m=pixel_size_m)
    mask = binary_erosion(centre.mask, np.ones((3, 3)))
    scene = mi.load_dict({"type": "scene", **shapes})
    row, column = np.mgrid[:resolution, :resolution]
    normal, weighted = 0.0, 0.0
    for sub in range(FOOTPRINT_SUBSAMPLES**2):
        dv, du = (np.array(divmod(sub, FOOTPRINT_SUBSAMPLES)) + 0.5) / FOOTPRINT_SUBSAMPLES
        si = rendering.cast(mi, scene, column + du, row + dv, resolution=resolution, pixel_size_m=pixel_size_m)
        n = np.array(si.sh_frame.n, dtype=np.float64).T
        rho = np.array(si.shape.eval_attribute_3("vertex_albedo", si, si.is_valid()), dtype=np.float64).T
        normal = normal + n
        weighted = weighted + rho[:, :, None] * n[:, None, :]
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    albedo = np.einsum("pci,pi->pc", weighted, normal) / FOOTPRINT_SUBSAMPLES**2
    grid = (resolution, resolution, 3)
    return centre._replace(
        normal=(normal.reshape(grid) * mask[..., None]).astype(np.float32),
        diffuse_albedo=(albedo.reshape(grid) * mask[..., None]).astype(np.float32),
        height=centre.height * mask,
        mask=mask,
    )


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parent / "lambert", help="folder to write (default: samples/lambert)"
    )
    parser.add_argument("--resolution", type=int, default=128, help="pixels a side (default 128)")
    parser.add_argument("--spp", type=int, default=1024, help="paths per pixel and light, a square number (default 1024)")
    parser.add_argument("--max-depth", type=int, default=2, help="longest path, in segments: 2 is direct light only (default)")
    parser.add_argument("--detail", type=float, default=0.02, help="mesh edge length in cm (default 0.02)")
    return parser.parse_args()


def main() -> None:
    """Render the capture and print how far its lit pixels are from the closed form."""
    args = parse_arguments()
    started = time.perf_counter()
    mi = rendering.import_mitsuba()
    args.out.mkdir(parents=True, exist_ok=True)
    pixel_size_m = FIELD_M / args.resolution
    sensor = mi.load_dict(rendering.camera(mi, resolution=args.resolution, pixel_size_m=pixel_size_m))
    shapes = {"object": rendering.mesh(mi, "object", build(detail=args.detail), lambertian=True)}
    truth = footprint_truth(mi, shapes, resolution=args.resolution, pixel_size_m=pixel_size_m)
    tracer = rendering.Tracer(mi, shapes, sensor, max_depth=args.max_depth)
    directions = rendering.fibonacci_cap(LIGHT_COUNT, LARGEST_ANGLE_DEGREES)
    irradiance = np.random.default_rng(7).uniform(*IRRADIANCE_RANGE, (LIGHT_COUNT, 3)).round(3)

    note = "ground truth, mean over each pixel's footprint; height at pixel centres"
    layers = capture_files.truth_layers(truth, specular=False, dtype=np.float32)
    capture_files.write_exr(args.out / "truth.exr", layers, note=note)
    capture_files.write_mask(args.out / "mask.png", truth.mask)
    differences = []
    for i in range(LIGHT_COUNT):
        image = tracer.light(direction=directions[i], irradiance=irradiance[i], spp=args.spp, seed=i + 1)
        image *= truth.mask[..., None]
        capture_files.write_rgb(args.out / f"{i:03d}.exr", image, note=f"light {i}")
        expected = truth.diffuse_albedo / np.pi * irradiance[i] * np.clip(truth.normal @ directions[i], 0, None)[..., None]
        lit = truth.mask & (image[..., 1] > 0.9 * expected[..., 1]) & (expected[..., 1] > 0.02)
        differences.append((np.abs(image - expected) / np.maximum(expected, 1e-9))[lit].ravel())
        print(f"\rlight {i + 1} of {LIGHT_COUNT}, {time.perf_counter() - started:.0f} s", end="", flush=True)
    name = "lambert" if args.max_depth == 2 else "lambert_bounce"
    capture_files.write_json(args.out / "capture.json", capture_files.manifest(
        name=name, truth=truth, pixel_size_m=pixel_size_m, directions=directions, irradiance=irradiance))
    difference = np.concatenate(differences)
    size = sum(f.stat().st_size for f in args.out.iterdir())
    median, most = np.quantile(difference, [0.5, 0.99])
    print(f"\nlit pixels against rho/pi E n.l: median {median:.2e}, 99 % below {most:.2e}, relative")
    print(f"{args.out}: {truth.mask.sum()} object pixels, {size / 1e6:.2f} MB in {time.perf_counter() - started:.0f} s")


if __name__ == "__main__":
    main()
