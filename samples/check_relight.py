"""Check what make_relight_checks.py rendered against arithmetic that knows nothing of the renderer's lights.

    python samples/check_relight.py checks/glossy

Superposition for the five lights, cells of the sphere for the environments, and for the near lights relit's BRDF summed
over points of the lamp in float64. Mitsuba only casts rays. Exits 1 if one fails.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import rendering
from check_conventions import lambert_ggx_brdf
from make_relight_checks import OBJECTS

from kernels.relight.weights.cells import integrate_cells
from service.relight.weights.weighting import light_weights
from stage.capture.capture import Capture
from stage.formats import exr

PIXEL_POINTS = 4  # per pixel side, for the mean that a box filter sees
LAMP_POINTS = 256  # per area light; with 64 a sphere is 0.4 % off
RAY_OFFSET_M = 1e-5
LIT_FRACTION = 0.02  # of the brightest expected radiance: below it a relative difference says nothing


class Points(NamedTuple):
    """Surface points with their material; N of them."""

    position: np.ndarray  # [N, 3] m, camera frame
    normal: np.ndarray  # [N, 3]
    albedo: np.ndarray  # [N, 3]
    f0: np.ndarray  # [N]
    roughness: np.ndarray  # [N]


def read_rgb(path: Path) -> np.ndarray:  # -> [H, W, 3] float64
    """Read the channels R, G and B of an image."""
    channels, _ = exr.read(path)
    return np.stack([channels[c] for c in "RGB"], axis=-1).astype(np.float64)


def lamp_samples(light: dict) -> list[tuple[np.ndarray, np.ndarray | None, np.ndarray]]:
    """Return points of a lamp: position, normal (None: it shines in all directions) and intensity [3] along the normal."""
    if light["type"] == "point":
        return [(np.array(light["position_m"]), None, np.array(light["intensity"]))]
    i = np.arange(LAMP_POINTS)
    s, t = (i + 0.5) / LAMP_POINTS, (0.5 + i * 0.6180339887498949) % 1
    center, radiance = np.array(light["center_m"]), np.array(light["radiance"])
    if light["type"] == "sphere":
        z, azimuth = 1 - 2 * s, 2 * np.pi * t
        normal = np.stack([np.sqrt(1 - z * z) * np.cos(azimuth), np.sqrt(1 - z * z) * np.sin(azimuth), z], axis=1)
        position, area = center + light["radius_m"] * normal, 4 * np.pi * light["radius_m"] ** 2
    else:
        u, v = np.array(light["edge_u_m"]), np.array(light["edge_v_m"])
        position = center + (s - 0.5)[:, None] * u + (t - 0.5)[:, None] * v
        normal, area = np.broadcast_to(light["normal"], position.shape), np.linalg.norm(np.cross(u, v))
    return [(p, n, radiance * area / LAMP_POINTS) for p, n in zip(position, normal, strict=True)]


def direct(mi, scene, points: Points, light: dict) -> np.ndarray:  # -> [N, 3]
    """Return the radiance towards the camera by direct light with shadows, in float64."""
    total = np.zeros_like(points.position)
    eye = np.broadcast_to([0.0, 0.0, 1.0], points.position.shape)
    for position, facing, intensity in lamp_samples(light):
        way = position - points.position
        distance = np.linalg.norm(way, axis=1, keepdims=True)
        way = way / distance
        cosine = np.ones(len(way)) if facing is None else np.clip(-way @ facing, 0, None)
        start = points.position + RAY_OFFSET_M * points.normal
        ray = mi.Ray3f(mi.Point3f(start.T), mi.Vector3f(way.T), mi.Float(distance[:, 0] - 2 * RAY_OFFSET_M), 0.0, [])
        lit = ((points.normal * way).sum(1) > 0) & (points.normal[:, 2] > 0) & (cosine > 0) & ~np.array(scene.ray_test(ray))
        irradiance = (points.normal[lit] * way[lit]).sum(1) * cosine[lit] / distance[lit, 0] ** 2
        for c in range(3):
            brdf = lambert_ggx_brdf(points.normal[lit], way[lit], eye[lit], albedo=points.albedo[lit, c], f0=points.f0[lit],
                                 roughness=points.roughness[lit])  # fmt: skip
            total[lit, c] += brdf * irradiance * intensity[c]
    return total


def cast_points(mi, scene, u: np.ndarray, v: np.ndarray, *, size: int, pixel_size_m: float) -> Points:
    """Return the modelled surface at continuous image coordinates [N]."""
    si = rendering.cast(mi, scene, u, v, resolution=size, pixel_size_m=pixel_size_m)
    hit = si.is_valid()

    def number(name: str) -> np.ndarray:
        return np.array(si.shape.eval_attribute_1(name, si, hit), dtype=np.float64)

    albedo = np.array(si.shape.eval_attribute_3("vertex_albedo", si, hit), dtype=np.float64).T
    position, normal = (np.array(vector, dtype=np.float64).T for vector in (si.p, si.sh_frame.n))
    return Points(position, normal, albedo, number("vertex_f0"), number("vertex_roughness"))


def truth_points(folder: Path, mask: np.ndarray, *, pixel_size_m: float) -> Points:
    """Return the surface at pixel centres, from truth.exr and the pixel grid alone."""
    channels, _ = exr.read(folder / "truth.exr")
    layer = {name: plane.astype(np.float64)[mask] for name, plane in channels.items()}
    row, column = np.nonzero(mask)
    x, y = (column + 0.5 - mask.shape[1] / 2) * pixel_size_m, (mask.shape[0] / 2 - row - 0.5) * pixel_size_m
    return Points(
        np.stack([x, y, layer["height.Z"]], axis=1),
        np.stack([layer[f"normal.{axis}"] for axis in "XYZ"], axis=1),
        np.stack([layer[f"diffuse_albedo.{c}"] for c in "RGB"], axis=1),
        layer["specular.R"],
        layer["roughness.Y"],
    )


def rmse(image: np.ndarray, reference: np.ndarray) -> float:
    """Return the root mean square error relative to the root mean square of the reference."""
    return float(np.sqrt(((image - reference) ** 2).mean() / (reference**2).mean()))


def main() -> None:
    """Run the checks and print each with its error."""
    mi = rendering.import_mitsuba()
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path, help="what make_relight_checks.py wrote")
    folder = parser.parse_args().folder
    record = json.loads((folder / "references.json").read_text())
    entries = {entry["file"].removesuffix(".exr"): entry for entry in record["references"]}
    manifest = json.loads((folder / "capture.json").read_text())
    camera, frames = manifest["camera"], manifest["frames"]
    mask = Capture.open(folder).mask()
    size, pixel_size_m = mask.shape[0], camera["pixel_size_m"]
    images = np.stack([read_rgb(folder / frame["image"])[mask] for frame in frames])
    directions, irradiance = (np.array([frame["light"][key] for frame in frames]) for key in ("direction", "irradiance"))
    failed = []

    def report(what: str, error: float, limit: float, cause: str) -> None:
        print(f"{'ok  ' if error <= limit else 'FAIL'} {what}: {error:.2e} (limit {limit:g}: {cause})", flush=True)
        if not error <= limit:
            failed.append(what)

    def reference(name: str) -> np.ndarray:
        return read_rgb(folder / f"{name}.exr")[mask]

    truth = truth_points(folder, mask, pixel_size_m=pixel_size_m)
    report("mean height against surface_z_m, metres", abs(truth.position[:, 2].mean() - camera["surface_z_m"]), 1e-7, "float32 heights")
    report("surface_z_m of both files", abs(record["object"]["surface_z_m"] - camera["surface_z_m"]), 0, "the same number")
    five = images[entries["five"]["light"]["frames"]].sum(0)
    report("five lights against the sum of their images, RMSE", rmse(five, reference("five")), 0.03, "noise, antialiased edges")
    report("  energy", abs(five.sum() / reference("five").sum() - 1), 0.003, "noise")

    for name, limit, energy_limit in (("patches", 0.06, 0.01), ("sky", 0.3, 0.06)):
        environment, lit = read_rgb(folder / entries[name]["light"]["image"]), reference(name)
        sums = []
        for picture in (environment, environment[:, ::-1]):
            cells = integrate_cells(picture, directions, np.eye(3)[None], device="cpu")
            weights = light_weights(cells.energy, irradiance, np.ones(len(directions)))[0]
            sums.append(np.einsum("cl,lpc->pc", weights.astype(np.float64), images))
        report(f"{name} against weighted images, RMSE", rmse(sums[0], lit), limit, "128 lights, 18 degrees apart")
        report("  energy", abs(sums[0].sum() / lit.sum() - 1), energy_limit, "the light that stands for a sun is up to 9 degrees from it")
        mirrored = rmse(sums[1], lit)
        report(f"  RMSE over that of the mirrored map, {mirrored:.2f}", rmse(sums[0], lit) / mirrored, 0.4, "mirrored, it must not fit")

    surfaces = OBJECTS[record["object"]["name"]].build(record["render"]["detail_cm"])
    scene = mi.load_dict({"type": "scene"} | {name: rendering.mesh(mi, name, surface) for name, surface in surfaces.items()})
    row, column = np.nonzero(mask)
    offsets = (np.arange(PIXEL_POINTS) + 0.5) / PIXEL_POINTS
    for name in ("near_direct", "sphere_light", "rectangle_light"):
        light, lit = entries[name]["light"], reference(name)
        footprint = np.mean([
            direct(mi, scene, cast_points(mi, scene, column + du, row + dv, size=size, pixel_size_m=pixel_size_m), light)
            for dv in offsets for du in offsets
        ], axis=0)  # fmt: skip
        for what, expected, limit in (
            ("pixel means", footprint, 0.01),
            ("truth.exr", direct(mi, scene, truth, light), 0.01 if record["object"]["name"] == "glossy" else 0.2),
        ):
            seen = expected > LIT_FRACTION * expected.max()
            difference = np.abs(expected[seen] / lit[seen] - 1)
            report(f"{name} against the BRDF at {what}, median", float(np.median(difference)), limit, "relief within a pixel, penumbras")
            print(f"       90th percentile {np.quantile(difference, 0.9):.2e}, RMSE {rmse(expected, lit):.3f}, "
                  f"energy {expected.sum() / lit.sum():.4f}")  # fmt: skip
    for name in ("near", "sphere_light", "rectangle_light"):
        full, alone = (reference(f"{name}{end}") for end in (("", "_direct") if name == "near" else ("_full", "")))
        print(f"     {name}: interreflection adds {full.sum() / alone.sum() - 1:.1%}")
    sys.exit(1 if failed else 0)


if __name__ == "__main__":
    main()
