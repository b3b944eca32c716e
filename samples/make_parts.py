"""Render captures of objects in several parts, one floating before the other, with relit references, in Mitsuba's `principled` BSDF.

    python samples/make_parts.py two_parts --out parts/two_parts
    python samples/make_parts.py figure --out parts/figure --noise 0.01

`two_parts`: a metal ball before a lumpy painted body that has a stripe of metal with soft borders. `figure`: a ring and an arm before a
torso with deep folds. `atelier`: a velvet cushion, a lacquered apple and a brushed disc, whose sheen, coat and anisotropy no map holds.
128 distant lights over the whole sphere, then the same object under the lights of make_relight_checks.py, with the same names. Not
committed. It traces with Mitsuba's scalar variant, so that it needs no LLVM, within a few minutes on 2 cores.
A run that was interrupted is completed by running it again.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import capture_files
import make_relight_checks
import numpy as np
import part_scenes
import relight_lights
import rendering
from scipy.ndimage import binary_erosion

SPECULAR = 0.5  # of `principled`: F0 = 0.04
F0 = 0.04
COVERAGE_SUBSAMPLES = 4  # steps per pixel side, edges included, whose rays must all hit for a pixel to be in the mask
SPREAD_PX = 2.5  # standard deviation of the filter of bounced light, whose paths are few: fireflies become a glow of the same energy
ALIKE = (0.25, 0.1)  # difference in the normal, and in albedo and F0, at which the filter stops
READ_NOISE = 0.002  # standard deviation of noise that does not depend on brightness, as radiance


def part_mesh(mi, name: str, mesh: part_scenes.PartMesh):
    """Return the Mitsuba mesh of a part: `principled` dielectric and metal, blended by the share of the metal."""

    def principled(colour: str, metallic: float) -> dict:
        return {"type": "principled", "base_color": {"type": "mesh_attribute", "name": colour}, "metallic": metallic,
                "roughness": {"type": "mesh_attribute", "name": "vertex_roughness"}, "specular": SPECULAR, **mesh.beyond}

    blend = {"type": "blendbsdf", "weight": {"type": "mesh_attribute", "name": "vertex_share"},
             "first": principled("vertex_dielectric", 0.0), "second": principled("vertex_metal", 1.0)}
    return rendering.mesh_with(mi, name, mesh, blend, mesh.paint._asdict())


def trace_truth(mi, shapes: dict, *, resolution: int, pixel_size_m: float) -> dict[str, np.ndarray]:
    """Return the channels of truth.exr at pixel centres [H, W], ray by ray."""
    scene = mi.load_dict({"type": "scene", **shapes})

    def ray(u: float, v: float):
        x, y = (u - 0.5 * resolution) * pixel_size_m, (0.5 * resolution - v) * pixel_size_m
        return mi.Ray3f(mi.Point3f(x, y, rendering.CAMERA_DISTANCE_M), mi.Vector3f(0, 0, -1))

    steps = np.linspace(0, resolution, resolution * COVERAGE_SUBSAMPLES + 1)
    hit = np.array([[scene.ray_test(ray(u, v)) for u in steps] for v in steps])
    corners = np.lib.stride_tricks.sliding_window_view(hit, (COVERAGE_SUBSAMPLES + 1,) * 2)[::COVERAGE_SUBSAMPLES, ::COVERAGE_SUBSAMPLES]
    mask = binary_erosion(corners.all(axis=(2, 3)), np.ones((3, 3)))
    names = [f"normal.{c}" for c in "XYZ"] + [f"{name}.{c}" for name in ("diffuse_albedo", "specular") for c in "RGB"]
    names += ["roughness.Y", "metal.Y", "part.Y", "height.Z"]
    values = np.zeros((len(names), resolution, resolution), np.float32)
    parts = list(shapes.values())
    for row, column in np.argwhere(mask):
        si = scene.ray_intersect(ray(column + 0.5, row + 0.5))
        colour, metal = (np.array(si.shape.eval_attribute_3(f"vertex_{name}", si)) for name in ("dielectric", "metal"))
        share, roughness = (float(si.shape.eval_attribute_1(f"vertex_{name}", si)) for name in ("share", "roughness"))
        normal = np.array(si.sh_frame.n)
        values[:, row, column] = [*(normal if normal[2] > 0 else np.array(si.n)), *((1 - share) * colour),
                                  *((1 - share) * F0 + share * metal), roughness, share,
                                  1 + next(i for i, part in enumerate(parts) if part is si.shape or part == si.shape), si.p[2]]
    return dict(zip(names, values, strict=True)) | {"mask.Y": mask.astype(np.float32)}


def spread_bounces(full: np.ndarray, direct: np.ndarray, layers: dict[str, np.ndarray]) -> np.ndarray:
    """Return an image whose bounced light, `full` less `direct` [H, W, 3], is filtered over pixels of like surface (joint bilateral)."""
    normal = np.stack([layers[f"normal.{c}"] for c in "XYZ"], -1)
    material = np.stack([layers[f"{name}.{c}"] for name in ("diffuse_albedo", "specular") for c in "RGB"], -1)
    reach = int(3 * SPREAD_PX)
    total, weights = np.zeros(full.shape), np.zeros(full.shape[:2])
    for down in range(-reach, reach + 1):
        for right in range(-reach, reach + 1):
            def moved(plane: np.ndarray, shift: tuple[int, int] = (down, right)) -> np.ndarray:
                return np.roll(plane, shift, axis=(0, 1))

            apart = ((normal - moved(normal)) ** 2).sum(-1) / ALIKE[0] ** 2 + ((material - moved(material)) ** 2).sum(-1) / ALIKE[1] ** 2
            same = (layers["part.Y"] == moved(layers["part.Y"])) & (layers["mask.Y"] > 0)
            weight = same * np.exp(-0.5 * (apart + (down**2 + right**2) / SPREAD_PX**2))
            total += weight[..., None] * moved(full - direct)
            weights += weight
    return direct + np.maximum(total / np.maximum(weights, 1e-9)[..., None], 0)


def main() -> None:
    """Render one capture and its references; skip what is complete."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("object", choices=list(part_scenes.SCENES))
    parser.add_argument("--out", type=Path, required=True, help="folder to write")
    parser.add_argument("--size", type=int, default=128, help="pixels a side (default 128)")
    parser.add_argument("--spp", type=int, default=64, help="paths per pixel and captured light (default 64)")
    parser.add_argument("--reference-spp", type=int, default=256, help="paths per pixel of the references (default 256)")
    parser.add_argument("--environment-spp", type=int, default=4096, help="paths per pixel under environments (default 4096)")
    parser.add_argument("--noise", type=float, default=0.0, help="noise of the captured images: relative standard deviation at radiance 1, "
                        "falling as shot noise does (default 0)")
    parser.add_argument("--detail", type=float, default=0.04, help="mesh edge length in cm (default 0.04)")
    args = parser.parse_args()
    started = time.perf_counter()
    mi = rendering.import_mitsuba("scalar_rgb")
    args.out.mkdir(parents=True, exist_ok=True)
    pixel_size_m = part_scenes.FIELD_M / args.size
    sensor = mi.load_dict(rendering.camera(mi, resolution=args.size, pixel_size_m=pixel_size_m))
    meshes = {name: part_scenes.build(part, detail=args.detail) for name, part in part_scenes.SCENES[args.object].items()}
    shapes = {name: part_mesh(mi, name, mesh) for name, mesh in meshes.items()}
    layers = trace_truth(mi, shapes, resolution=args.size, pixel_size_m=pixel_size_m)
    mask = layers["mask.Y"] > 0
    center, radius_m = relight_lights.bounding_sphere(np.concatenate([mesh.points for mesh in meshes.values()]))
    count = make_relight_checks.LIGHT_COUNT
    directions, irradiance = rendering.fibonacci_sphere(count), np.full((count, 3), make_relight_checks.IRRADIANCE)
    truth = capture_files.Truth(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0), layers["height.Z"], mask)
    manifest = capture_files.manifest(name=args.object, truth=truth, pixel_size_m=pixel_size_m, directions=directions,
                                      irradiance=irradiance)
    record = make_relight_checks.Record(args.out / "references.json", {
        "object": {"name": args.object, "parts": list(shapes), "center_m": relight_lights.numbers(center), "radius_m": radius_m,
                   "surface_z_m": manifest["camera"]["surface_z_m"]},
        "render": {"size": args.size, "spp": args.spp, "noise": args.noise, "detail_cm": args.detail}})
    record.add()

    def say(what: str) -> None:
        print(f"{args.object}, {time.perf_counter() - started:4.0f} s: {what}", flush=True)

    def write(name: str, image: np.ndarray, note: str) -> None:
        capture_files.write_rgb(args.out / name, (image * mask[..., None]).astype(np.float32), note=f"{args.object}, {note}")

    say(f"{mask.sum()} of {mask.size} pixels are object")
    capture_files.write_exr(args.out / "truth.exr", layers, note="ground truth at pixel centres; part.Y counts the parts from 1")
    capture_files.write_mask(args.out / "mask.png", mask)
    make_relight_checks.write_environments(args.out)
    tracer = rendering.Tracer(mi, shapes, sensor, max_depth=make_relight_checks.FULL)
    direct = rendering.Tracer(mi, shapes, sensor, max_depth=make_relight_checks.DIRECT)
    for i in range(count):
        if not (args.out / f"{i:03d}.exr").exists():
            given = {"direction": directions[i], "irradiance": irradiance[i], "spp": args.spp}
            image = spread_bounces(tracer.light(**given, seed=i + 1), direct.light(**given, seed=i + 2001), layers)
            if args.noise > 0:
                deviation = np.sqrt(args.noise**2 * np.maximum(image, 0) + READ_NOISE**2)
                image = np.maximum(image + deviation * np.random.default_rng(i).standard_normal(image.shape), 0)
            write(f"{i:03d}.exr", image, f"light {i}")
        if (i + 1) % 16 == 0:
            say(f"light {i + 1} of {count}")
    capture_files.write_json(args.out / "capture.json", manifest)
    lights = relight_lights.near_lights(center, radius_m)
    entries = make_relight_checks.references(lights, reference_spp=args.reference_spp, environment_spp=args.environment_spp)
    for number, entry in reversed(list(enumerate(entries))):  # environments first
        if not record.complete(entry):
            emitters = relight_lights.emitters(mi, entry["light"], folder=args.out, directions=directions, irradiance=irradiance)
            chosen = direct if entry["max_depth"] == make_relight_checks.DIRECT else tracer
            image = chosen.emitters(emitters, spp=entry["spp"], seed=1001 + number)
            if entry["max_depth"] > make_relight_checks.DIRECT and entry["light"]["type"] != "environment":  # which have paths enough
                image = spread_bounces(image, direct.emitters(emitters, spp=entry["spp"], seed=3001 + number), layers)
            write(entry["file"], image, entry["what"])
            record.add(entry)
        say(entry["file"])


if __name__ == "__main__":
    main()
