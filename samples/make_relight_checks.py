"""Render captures with path-traced references to check relighting against: what the lights really do to the object.

    python samples/make_relight_checks.py glossy --out checks/glossy
    python samples/make_relight_checks.py owl --out checks/owl

128 distant lights over the whole sphere, then the same object under environments, five captured lights at once, a near point light
and area lights. references.json says what each picture is. A run that was interrupted is completed by running it again.
Not committed; check_relight.py verifies the result. See samples/README.md.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import capture_files
import make_glossy
import make_owl
import numpy as np
import relight_lights
import rendering
import scene_owl
import sky
from meshing import Surface
from scipy.ndimage import binary_erosion

LIGHT_COUNT = 128
IRRADIANCE = 3.0  # about pi, so that a white surface facing a light has radiance near 1
FIVE_LIGHTS = (5, 28, 31, 58, 88)  # above, right, left, behind, low
SPP_PER_PASS = 1024  # a square number, for the multi-jittered sampler; bounds the memory of one wavefront
DIRECT, FULL = 2, 8  # longest path, in segments


class CheckObject(NamedTuple):
    """An object that the checks are rendered of."""

    build: Callable[[float], dict[str, Surface]]
    """Its parts in the camera frame, metres, for a mesh edge in centimetres."""
    field_m: float
    """Side of the square that the camera sees."""
    mask_erosion: int
    """Pixels taken off the mask, as the capture that the object is from does."""


OBJECTS = {
    "owl": CheckObject(lambda detail: scene_owl.build(detail=detail), make_owl.FIELD_M, 0),
    "glossy": CheckObject(lambda detail: {"object": make_glossy.build(metal=False, detail=detail)}, make_glossy.FIELD_M, 1),
}


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    what = "owl: that of samples/owl; glossy: that of make_glossy.py, with relit's BRDF"
    parser.add_argument("object", choices=list(OBJECTS), help=what)
    parser.add_argument("--out", type=Path, required=True, help="folder to write")
    parser.add_argument("--size", type=int, default=128, help="pixels a side (default 128)")
    parser.add_argument("--spp", type=int, default=529, help="paths per pixel and captured light, a square number (default 529)")
    parser.add_argument("--reference-spp", type=int, default=4096, help="paths per pixel of the references (default 4096)")
    parser.add_argument("--environment-spp", type=int, default=16384, help="paths per pixel under environments (default 16384)")
    parser.add_argument("--detail", type=float, default=0.03, help="mesh edge length in cm (default 0.03)")
    return parser.parse_args()


def references(near: dict[str, dict], *, reference_spp: int, environment_spp: int) -> list[dict]:
    """Return the entries of references.json: the light, the segments of a path, and the paths a pixel."""
    sun = {"sun_direction": relight_lights.numbers(sky.SUN_DIRECTION), "sun_diameter_degrees": sky.SUN_DIAMETER_DEGREES}
    patches = {
        "patches": [
            {"direction": relight_lights.numbers(relight_lights.unit(direction)), "sigma_degrees": sigma, "radiance": list(radiance)}
            for direction, sigma, radiance in relight_lights.PATCHES
        ]
    }

    def entry(name: str, what: str, light: dict, max_depth: int, spp: int) -> dict:
        return {"file": f"{name}.exr", "what": what, "light": light, "max_depth": max_depth, "spp": spp}

    def environment(name: str, facts: dict) -> dict:
        return {"type": "environment", "image": f"{name}_environment.exr"} | facts

    def lamp(name: str, what: str, max_depth: int) -> dict:
        light = near[name.removesuffix("_direct").removesuffix("_full")]
        paths = "direct light only" if max_depth == DIRECT else "interreflection too"
        return entry(name, f"{what}, {paths}", light, max_depth, reference_spp)

    return [
        entry("five", "five captured lights at once", {"type": "captured", "frames": list(FIVE_LIGHTS)}, FULL, reference_spp),
        lamp("near_direct", "near point light, shadows", DIRECT),
        lamp("near", "near point light, shadows", FULL),
        lamp("sphere_light", "spherical area light, soft shadows", DIRECT),
        lamp("rectangle_light", "rectangular area light, soft shadows", DIRECT),
        lamp("sphere_light_full", "spherical area light, soft shadows", FULL),
        lamp("rectangle_light_full", "rectangular area light, soft shadows", FULL),
        entry("patches", "soft patches of light on a dim ground, spin 0", environment("patches", patches), FULL, environment_spp),
        entry("sky", "sky with a small sun, spin 0", environment("sky", sun), FULL, environment_spp),
    ]


class Record:
    """references.json, rewritten after every picture, so that a later run knows what is complete."""

    def __init__(self, path: Path, facts: dict):
        self.path, self.facts, self.done = path, facts, {}
        if path.exists():
            before = json.loads(path.read_text())
            self.done = {entry["file"]: entry for entry in before.pop("references")}
            if before != facts:
                raise SystemExit(f"{path.parent} was rendered with {before['render']}, not {facts['render']}: give another --out.")

    def complete(self, entry: dict) -> bool:
        """Return whether the image of an entry is complete."""
        return self.done.get(entry["file"]) == entry and (self.path.parent / entry["file"]).exists()

    def add(self, *entries: dict) -> None:
        """Record that images are complete."""
        self.done |= {entry["file"]: entry for entry in entries}
        capture_files.write_json(self.path, self.facts | {"references": list(self.done.values())})


def write_environments(folder: Path) -> None:
    """Write both lat-long maps where they are missing."""
    note = "lat-long environment, linear Rec.709 radiance, procedural"
    for name, make in (
        ("patches_environment.exr", relight_lights.make_patches),
        ("sky_environment.exr", lambda: sky.make_sky(relight_lights.ENVIRONMENT_WIDTH, relight_lights.ENVIRONMENT_WIDTH // 2)),
    ):
        if not (folder / name).exists():
            capture_files.write_rgb(folder / name, make(), note=note)


def main() -> None:
    """Render the capture, then the references, each file through a temporary name; skip what is complete."""
    args = parse_arguments()
    started = time.perf_counter()
    mi = rendering.import_mitsuba()
    args.out.mkdir(parents=True, exist_ok=True)
    model = OBJECTS[args.object]
    pixel_size_m = model.field_m / args.size
    sensor = mi.load_dict(rendering.camera(mi, resolution=args.size, pixel_size_m=pixel_size_m))
    surfaces = model.build(args.detail)
    shapes = {name: rendering.mesh(mi, name, surface) for name, surface in surfaces.items()}
    center, radius_m = relight_lights.bounding_sphere(np.concatenate([surface.points for surface in surfaces.values()]))
    truth = rendering.trace_truth(mi, shapes, resolution=args.size, pixel_size_m=pixel_size_m)
    if model.mask_erosion:
        truth = truth._replace(mask=binary_erosion(truth.mask, np.ones((3, 3)), iterations=model.mask_erosion))
    directions, irradiance = rendering.fibonacci_sphere(LIGHT_COUNT), np.full((LIGHT_COUNT, 3), IRRADIANCE)
    manifest = capture_files.manifest(name=args.object, truth=truth, pixel_size_m=pixel_size_m, directions=directions,
                                      irradiance=irradiance)  # fmt: skip
    record = Record(args.out / "references.json", {
        "object": {"name": args.object, "center_m": relight_lights.numbers(center), "radius_m": radius_m,
                   "surface_z_m": manifest["camera"]["surface_z_m"]},
        "render": {"size": args.size, "spp": args.spp, "max_depth": FULL, "detail_cm": args.detail},
    })  # fmt: skip
    record.add()

    def say(what: str) -> None:
        print(f"{args.object}, {time.perf_counter() - started:4.0f} s: {what}", flush=True)

    def write(name: str, image: np.ndarray, note: str) -> None:
        capture_files.write_rgb(args.out / name, (image * truth.mask[..., None]).astype(np.float32), note=f"{args.object}, {note}")

    def sampling(spp: int, seed: int) -> dict:
        return {"spp": min(spp, SPP_PER_PASS), "passes": -(-spp // SPP_PER_PASS), "seed": seed}

    say(f"{truth.mask.sum()} of {truth.mask.size} pixels are object")
    layers = capture_files.truth_layers(truth, specular=True, dtype=np.float32)
    capture_files.write_exr(args.out / "truth.exr", layers, note="ground truth at pixel centres")
    capture_files.write_mask(args.out / "mask.png", truth.mask)
    write_environments(args.out)
    tracers = {depth: rendering.Tracer(mi, shapes, sensor, max_depth=depth) for depth in (DIRECT, FULL)}
    for i in range(LIGHT_COUNT):
        if not (args.out / f"{i:03d}.exr").exists():
            image = tracers[FULL].light(direction=directions[i], irradiance=irradiance[i], **sampling(args.spp, i + 1))
            write(f"{i:03d}.exr", image, f"light {i}")
        if (i + 1) % 16 == 0:
            say(f"light {i + 1} of {LIGHT_COUNT}")
    capture_files.write_json(args.out / "capture.json", manifest)

    lights = relight_lights.near_lights(center, radius_m)
    for number, entry in enumerate(references(lights, reference_spp=args.reference_spp, environment_spp=args.environment_spp)):
        if not record.complete(entry):
            emitters = relight_lights.emitters(mi, entry["light"], folder=args.out, directions=directions, irradiance=irradiance)
            image = tracers[entry["max_depth"]].emitters(emitters, **sampling(entry["spp"], 1001 + number))
            write(entry["file"], image, entry["what"])
            record.add(entry)
        say(entry["file"])
    say(f"{sum(f.stat().st_size for f in args.out.iterdir()) / 1e6:.1f} MB in {args.out}")


if __name__ == "__main__":
    main()
