"""Render samples/owl: a path-traced light-stage capture of an owl figurine, with its ground truth.

    python samples/make_owl.py --out samples/owl

96 distant lights over the whole sphere, one half-float image each, plus the sky it can be relit with, references lit
by that sky and by five lights at once, and the true normals, materials and heights. See samples/README.md.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import capture_files
import numpy as np
import rendering
import scene_owl
import sky

LIGHT_COUNT = 96
IRRADIANCE = 3.0  # about pi, so that a white surface facing a light has radiance near 1
FIELD_M = 0.216  # side of the square that the camera sees
FIVE_LIGHTS = (4, 21, 38, 47, 66)
SPP_PER_PASS = 256  # a square number, for the multi-jittered sampler; bounds the memory of one wavefront


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "owl", help="folder to write (default: samples/owl)")
    parser.add_argument("--resolution", type=int, default=320, help="pixels a side (default 320)")
    parser.add_argument("--spp", type=int, default=256, help="paths per pixel and light (default 256)")
    parser.add_argument("--reference-spp", type=int, default=4096, help="paths per pixel of the references (default 4096)")
    parser.add_argument("--max-depth", type=int, default=8, help="longest path, in segments (default 8)")
    parser.add_argument("--detail", type=float, default=0.03, help="mesh edge length in cm (default 0.03)")
    parser.add_argument("--mantissa-bits", type=int, default=8, choices=range(5, 11), help="kept in the images (default 8)")
    return parser.parse_args()


def main() -> None:
    """Render everything into the output folder, each file through a temporary name."""
    args = parse_arguments()
    started = time.perf_counter()
    mi = rendering.import_mitsuba()
    args.out.mkdir(parents=True, exist_ok=True)
    pixel_size_m = FIELD_M / args.resolution
    sensor = mi.load_dict(rendering.camera(mi, resolution=args.resolution, pixel_size_m=pixel_size_m))
    shapes = {name: rendering.mesh(mi, name, part) for name, part in scene_owl.build(detail=args.detail).items()}
    truth = rendering.trace_truth(mi, shapes, resolution=args.resolution, pixel_size_m=pixel_size_m)
    directions = rendering.fibonacci_sphere(LIGHT_COUNT)
    irradiance = np.full((LIGHT_COUNT, 3), IRRADIANCE)
    print(f"owl: {truth.mask.sum()} of {truth.mask.size} pixels are object, {time.perf_counter() - started:.0f} s")

    tracer = rendering.Tracer(mi, shapes, sensor, max_depth=args.max_depth)

    def sampling(spp: int, seed: int) -> dict:
        return {"spp": min(spp, SPP_PER_PASS), "passes": -(-spp // SPP_PER_PASS), "seed": seed}

    def masked(image: np.ndarray, bits: int) -> np.ndarray:
        return capture_files.round_mantissa(image * truth.mask[..., None], bits)

    def light(i: int) -> dict:
        return rendering.distant_light(mi, direction=directions[i], irradiance=irradiance[i])

    def write(name: str, image: np.ndarray, note: str) -> None:
        capture_files.write_rgb(args.out / name, image, note=note)

    environment = sky.make_sky()
    write("environment.exr", environment, "lat-long environment, linear Rec.709 radiance, procedural (samples/sky.py)")
    capture_files.write_exr(
        args.out / "truth.exr", capture_files.truth_layers(truth, specular=True), note="ground truth at pixel centres"
    )
    capture_files.write_mask(args.out / "mask.png", truth.mask)
    for i in range(LIGHT_COUNT):
        image = tracer.light(direction=directions[i], irradiance=irradiance[i], **sampling(args.spp, i + 1))
        write(f"{i:03d}.exr", masked(image, args.mantissa_bits), f"owl, light {i}")
        print(f"\rlight {i + 1} of {LIGHT_COUNT}, {time.perf_counter() - started:.0f} s", end="", flush=True)
    print()
    five = tracer.emitters({f"light_{i}": light(i) for i in FIVE_LIGHTS}, **sampling(args.reference_spp, 1001))
    write("reference_five.exr", masked(five, 10), "owl, five captured lights at once")
    lit = tracer.emitters({"sky": sky.as_mitsuba_envmap(mi, environment)}, **sampling(args.reference_spp, 1002))
    write("reference_environment.exr", masked(lit, 10), "owl under environment.exr")
    write_descriptions(args, truth, pixel_size_m, directions, irradiance)
    size = sum(f.stat().st_size for f in args.out.iterdir())
    print(f"{args.out}: {size / 1e6:.2f} MB in {time.perf_counter() - started:.0f} s")


def write_descriptions(args, truth, pixel_size_m: float, directions: np.ndarray, irradiance: np.ndarray) -> None:
    """Write capture.json (last of the capture, so that its presence means a whole one) and reference.json."""
    capture_files.write_json(
        args.out / "reference.json",
        {
            "reference_five.exr": {
                "what": "the object path traced under these captured lights at once, each as in capture.json",
                "frames": list(FIVE_LIGHTS),
                "spp": args.reference_spp,
            },
            "reference_environment.exr": {
                "what": "the object path traced under environment.exr, every pixel of it a constant patch, spin 0",
                "environment": "environment.exr",
                "sun_direction": [round(float(x), 6) for x in sky.SUN_DIRECTION],
                "spp": args.reference_spp,
            },
            "truth.exr": {
                "what": "ray-cast at pixel centres: shading normal (camera frame), diffuse albedo, specular F0, "
                "roughness (alpha = roughness squared), camera-frame z in metres, mask"
            },
            "frames": {"spp": args.spp, "max_depth": args.max_depth, "mantissa_bits": args.mantissa_bits},
        },
    )
    capture_files.write_json(args.out / "capture.json", capture_files.manifest(
        name="owl", truth=truth, pixel_size_m=pixel_size_m, directions=directions, irradiance=irradiance))


if __name__ == "__main__":
    main()
