"""Render glossy test captures: Mitsuba's `principled` BSDF, as a dielectric and as a metal, with full interreflection.

    python samples/make_glossy.py --out glossy --metal 0
    python samples/make_glossy.py --out glossy_metal --metal 1

A bumpy ball with a half-sunk ring, a knob and a horn: concave seams light each other, the horn and the ring throw shadows, and roughness
runs from 0.3 to 0.75 over the surface. The captures are not committed: make them for benchmarks/figures.py and
benchmarks/pictures.py. The diffuse lobe of `principled` (Burley 2012) is not Lambertian, so a solver cannot win by assuming the
renderer's model.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import capture_files
import numpy as np
import rendering
from feathers import mix, noise, smoothstep
from meshing import Surface, gradient, mesh_of
from scipy.ndimage import binary_erosion

LIGHT_COUNT = 64
LARGEST_ANGLE_DEGREES = 75.0  # from +z
FIELD_M = 0.1
ROUGHNESS = (0.3, 0.75)
SPECULAR = 0.5  # of `principled`: F0 = 0.04
PAINT, GLAZE = np.array([0.62, 0.30, 0.16]), np.array([0.16, 0.34, 0.46])
BRASS, STEEL = np.array([0.90, 0.72, 0.38]), np.array([0.66, 0.62, 0.58])


def distance(p: np.ndarray) -> np.ndarray:
    """Return the signed distance to a bumpy ball with a half-sunk ring, knob and horn, in centimetres."""

    def join(a, b, k):
        h = np.maximum(k - np.abs(a - b), 0) / k
        return np.minimum(a, b) - 0.25 * k * h * h

    radius = np.linalg.norm(p, axis=-1)
    unit = p / np.maximum(radius, 1e-9)[..., None]
    bumps = np.sin(4 * unit[..., 0] + 1) * np.cos(5 * unit[..., 1]) + np.sin(3 * unit[..., 2] + 6 * unit[..., 1] * unit[..., 0])
    d = radius - 4.05 - 0.11 * bumps
    axis = np.array([0.36, -0.34, 0.87]) / np.linalg.norm([0.36, -0.34, 0.87])
    q = p - 4.05 * axis
    along = q @ axis
    ring = np.hypot(np.linalg.norm(q - along[..., None] * axis, axis=-1) - 1.25, along) - 0.34
    knob = np.linalg.norm(p - [-1.75, 1.15, 3.45], axis=-1) - 0.85
    start, tip = np.array([0.9, 1.6, 3.2]), np.array([1.15, 2.15, 5.0])
    t = np.clip((p - start) @ (tip - start) / ((tip - start) @ (tip - start)), 0, 1)
    horn = np.linalg.norm(p - start - t[..., None] * (tip - start), axis=-1) - (0.55 - 0.38 * t)
    return join(join(join(d, ring, 0.35), knob, 0.35), horn, 0.5)


def build(*, metal: bool, detail: float = 0.03) -> Surface:
    """Build the object in metres, camera frame; colour and roughness vary smoothly and independently."""
    points, faces = mesh_of(distance, [-4.9] * 3, [4.9, 4.9, 5.6], detail)
    one, two = (BRASS, STEEL) if metal else (PAINT, GLAZE)
    albedo = mix(one, two, smoothstep(-2.0, 2.0, noise(points, 7.0, seed=2)))
    low, high = ROUGHNESS
    roughness = low + (high - low) * smoothstep(-2.5, 2.5, noise(points, 6.0, seed=5))
    normals = gradient(distance, points, step=0.005)
    return Surface(points * 0.01, faces, normals, albedo, np.full(len(points), 0.04), roughness)


def principled_mesh(mi, surface: Surface, *, metal: bool):
    """Return the Mitsuba mesh of a surface with the `principled` BSDF."""
    bsdf = {
        "type": "principled",
        "base_color": {"type": "mesh_attribute", "name": "vertex_albedo"},
        "roughness": {"type": "mesh_attribute", "name": "vertex_roughness"},
        "metallic": float(metal),
        "specular": SPECULAR,
    }
    return rendering.mesh_with(mi, "object", surface, bsdf, rendering.materials(surface))


def main() -> None:
    """Render one capture."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, required=True, help="folder to write")
    parser.add_argument("--metal", type=int, choices=(0, 1), default=0, help="1: metal, 0: dielectric (default)")
    parser.add_argument("--resolution", type=int, default=128, help="pixels a side (default 128)")
    parser.add_argument("--spp", type=int, default=256, help="paths per pixel and light (default 256)")
    parser.add_argument("--max-depth", type=int, default=8, help="longest path, in segments (default 8)")
    args = parser.parse_args()
    started = time.perf_counter()
    mi = rendering.import_mitsuba()
    args.out.mkdir(parents=True, exist_ok=True)
    pixel_size_m = FIELD_M / args.resolution
    sensor = mi.load_dict(rendering.camera(mi, resolution=args.resolution, pixel_size_m=pixel_size_m))
    shapes = {"object": principled_mesh(mi, build(metal=bool(args.metal)), metal=bool(args.metal))}
    truth = rendering.trace_truth(mi, shapes, resolution=args.resolution, pixel_size_m=pixel_size_m)
    truth = truth._replace(mask=binary_erosion(truth.mask, np.ones((3, 3))))
    if args.metal:
        truth = truth._replace(f0=truth.diffuse_albedo[..., 0], diffuse_albedo=truth.diffuse_albedo)
    capture_files.write_exr(args.out / "truth.exr", capture_files.truth_layers(truth, specular=True, dtype=np.float32),
                            note="ground truth at pixel centres; of a metal, diffuse_albedo holds its F0")
    capture_files.write_mask(args.out / "mask.png", truth.mask)
    tracer = rendering.Tracer(mi, shapes, sensor, max_depth=args.max_depth)
    directions, irradiance = rendering.fibonacci_cap(LIGHT_COUNT, LARGEST_ANGLE_DEGREES), np.full((LIGHT_COUNT, 3), np.pi)
    for i in range(LIGHT_COUNT):
        image = tracer.light(direction=directions[i], irradiance=irradiance[i], spp=args.spp, seed=i + 1)
        capture_files.write_exr(args.out / f"{i:03d}.exr", {"RGB": (image * truth.mask[..., None]).astype(np.float16)},
                                note=f"light {i}")
        print(f"\rlight {i + 1} of {LIGHT_COUNT}, {time.perf_counter() - started:.0f} s", end="", flush=True)
    capture_files.write_json(args.out / "capture.json", capture_files.manifest(
        name="glossy_metal" if args.metal else "glossy", truth=truth, pixel_size_m=pixel_size_m, directions=directions,
        irradiance=irradiance))
    print()


if __name__ == "__main__":
    main()
