"""Render captures of a virtual projector and camera 0.3 m apart: every kind of projected code, with interreflection and ground truth.

    python samples/make_rig.py --work rig --out rig/sets                 # every set, outside the repository
    python samples/make_rig.py --work rig --out rig/sets --set gray phase
    python samples/make_rig.py --work rig --sample samples/rig           # the committed capture

The light transport of the scene is path traced once (`--work`, a few minutes) and every picture is a sum over it. A run that was
interrupted is completed by running it again. check_rig.py verifies the result. See samples/README.md.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
import rendering

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # relit's camera and encoders: stage

import capture_files
import rig_scene
import rig_sets
import rig_transport
import rig_truth

SAMPLE_SET = "gray_phase"


def parse_arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--work", type=Path, required=True, help="folder that keeps the light transport (160 MB)")
    parser.add_argument("--out", type=Path, help="folder to write a folder for each set into")
    parser.add_argument("--sample", type=Path, help=f"folder to write the committed capture into: {SAMPLE_SET}, 16-bit PNG")
    parser.add_argument("--set", nargs="+", choices=rig_sets.SETS, default=rig_sets.SETS, help="sets to write (default: all)")
    parser.add_argument("--passes", type=int, default=64, help=f"of {rig_transport.STRATA**2} paths a pixel (default 64)")
    parser.add_argument("--distorted", action="store_true", help="lenses of both devices distort; without laser planes then")
    parser.add_argument("--full-well", type=float, help="electrons at radiance 1: adds shot noise (default: no noise)")
    parser.add_argument("--read-noise", type=float, default=0.0, help="electrons, with --full-well (default 0)")
    args = parser.parse_args()
    if args.out is None and args.sample is None:
        parser.error("give --out, --sample or both")
    return args


def with_noise(radiance: np.ndarray, *, full_well: float | None, read_noise: float, seed: int) -> np.ndarray:
    """Return the radiance that a linear camera records, with Poisson shot noise and Gaussian read noise; without a full well, no noise."""
    if full_well is None:
        return radiance
    random = np.random.default_rng(seed)
    electrons = random.poisson(radiance * full_well) + random.normal(0, read_noise, radiance.shape)
    return np.maximum(electrons / full_well, 0).astype(np.float32)


def write_image(path: Path, radiance: np.ndarray) -> None:
    """Write [rows, cols] as a grey half EXR, or as a 16-bit PNG that holds it linearly."""
    if path.suffix == ".exr":
        capture_files.write_exr(path, {"Y": radiance.astype(np.float16)}, note="linear radiance")
        return
    import OpenImageIO as oiio

    if radiance.max() > 1:
        raise ValueError(f"{path}: radiance reaches {radiance.max():.3f}, a PNG ends at 1")
    spec = oiio.ImageSpec(radiance.shape[1], radiance.shape[0], 1, "uint16")
    spec.attribute("png:compressionLevel", 9)
    out = oiio.ImageOutput.create(str(path))
    out.open(str(path), spec)
    out.write_image(np.round(radiance * 65535).astype(np.uint16)[..., None])
    out.close()


def write_set(folder: Path, name: str, frames: list[rig_sets.RigFrame], rig: rig_scene.Rig, truth: rig_truth.Truth, *,
              suffix: str, full_well: float | None, read_noise: float) -> None:  # fmt: skip
    """Write images and truth, and last the manifest, which says that the rest is there."""
    folder.mkdir(parents=True, exist_ok=True)
    rig_truth.write_truth(folder / "truth.exr", truth)
    entries = []
    for number, frame in enumerate(frames):
        image = f"{number:03d}{suffix}"
        write_image(folder / image, with_noise(frame.radiance, full_well=full_well, read_noise=read_noise, seed=number))
        entries.append({"image": image} | frame.entry)
    capture_files.write_json(folder / "capture.json", {
        "schema": "relit.capture/1",
        "name": f"rig {name.replace('_', ' ')}",
        "color_space": "lin_rec709_scene",
        "camera": rig.camera.model_dump(mode="json", exclude_none=True),
        "projector": rig.projector.model_dump(mode="json", exclude_none=True),
        "frames": entries,
    })  # fmt: skip


def main() -> None:
    """Trace the transport, then write the sets that are not there yet."""
    args = parse_arguments()
    mi = rendering.import_mitsuba()
    rig = rig_scene.make_rig(distorted=args.distorted)
    shapes = rig_scene.shapes(mi)
    args.work.mkdir(parents=True, exist_ok=True)
    kept = args.work / ("transport_distorted.npz" if args.distorted else "transport.npz")
    transport = rig_transport.render_transport(mi, shapes, rig, kept, passes=args.passes)
    truth = rig_truth.trace_truth(mi, shapes, rig)
    noise = {"full_well": args.full_well, "read_noise": args.read_noise}
    settings = {"transport": kept.stat().st_mtime_ns, **noise}
    for name in args.set if args.out else ():
        record = args.out / f".{name}.json"
        if record.exists() and json.loads(record.read_text()) == settings and (args.out / name / "capture.json").exists():
            print(f"{name}: complete")
            continue
        if name == "planes" and args.distorted:
            continue
        write_set(args.out / name, name, rig_sets.make_frames(name, rig, transport), rig, truth, suffix=".exr", **noise)
        record.write_text(json.dumps(settings))
        print(f"{name}: {sum(f.stat().st_size for f in (args.out / name).iterdir()) / 1e6:.1f} MB", flush=True)
    if args.sample:
        frames = rig_sets.make_frames(SAMPLE_SET, rig, transport)
        write_set(args.sample, SAMPLE_SET, frames, rig, truth, suffix=".png", **noise)
        print(f"{args.sample}: {sum(f.stat().st_size for f in args.sample.iterdir()) / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
