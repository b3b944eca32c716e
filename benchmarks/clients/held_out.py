"""Lights that the solver never saw: solve a capture without some of its lights, export, and render the asset under these in Cycles.

    python -m benchmarks.clients.held_out [CAPTURE] [--work DIR]

prints the error of each light and their mean, of the exported asset and of the assets that benchmarks.clients.parts calls by the same
names; the floor is what is left with the true maps: of every capture that has a truth.exr.
"""

import argparse
import json
import shutil
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.accuracy import SAMPLES
from benchmarks.clients.by_hand import write_by_hand
from benchmarks.clients.comparison import compare
from benchmarks.clients.parts import ASSETS, true_maps
from benchmarks.clients.render import Client, Sun, render
from service.export.export import export
from service.requests.export import ExportRequest
from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve
from stage.capture.capture import Capture
from stage.results.maps import MAPS_FILE, SurfaceMaps
from stage.stack.correction import Correction

HELD_OUT = 8
PATHS = 64
"""Paths of a pixel; under one sun and seven bounces their noise is about .01."""


class HeldOut(NamedTuple):
    """A capture without some of its lights."""

    folder: Path
    lights: list[Sun]
    truth: np.ndarray  # [lights, rows, cols, 3] float32 radiance, what the camera saw under each


def leave_out(source: Path, folder: Path, count: int = HELD_OUT) -> HeldOut:
    """Copy a capture of distant lights without `count` of those in front of the object, evenly chosen in their order.

    A light from behind reaches few pixels, at grazing angles: divided by its small mean, the error says nothing of the asset.

    Args:
        source: the capture.
        folder: for the copy; absent or made by an earlier call.
        count: lights that are left out.
    """
    manifest = json.loads((source / "capture.json").read_text())
    frames = manifest["frames"]
    front = [index for index, frame in enumerate(frames) if frame["light"]["direction"][2] > 0]
    out = [front[(2 * number + 1) * len(front) // (2 * count)] for number in range(count)]
    if not folder.exists():
        shutil.copytree(source, folder, ignore=shutil.ignore_patterns(".relit"))
        manifest["frames"] = [frame for index, frame in enumerate(frames) if index not in out]
        (folder / "capture.json").write_text(json.dumps(manifest))
    capture = Capture.open(source)
    correction = Correction.of(capture)
    images = [correction.apply(each).pixels for index, each in enumerate(capture.sources()) if index in out]
    lights = [Sun(tuple(frames[index]["light"]["direction"]), tuple(frames[index]["light"]["irradiance"])) for index in out]
    return HeldOut(folder, lights, np.stack(images).astype(np.float32))


def make_assets(held: HeldOut, source: Path, work: Path) -> dict[str, Path]:
    """Solve, and write the assets of the solved and of the true maps; returned by key of parts.ASSETS."""
    solved = work / "maps"
    if not (solved / MAPS_FILE).exists():
        solve(SolveRequest(capture=held.folder, out=solved, method=Method.SVBRDF, cache=work))
    made = {"exported": work / "exported.usdz", "hand": write_by_hand(SurfaceMaps.read(solved / MAPS_FILE), work, "hand")}
    export(ExportRequest(maps=solved, out=made["exported"], name="exported"))
    if (source / "truth.exr").exists():
        truth, metal = true_maps(source)
        (work / "true").mkdir(exist_ok=True)
        truth.write(work / "true" / MAPS_FILE)
        made |= {"true": work / "true.usdz", "floor": write_by_hand(truth, work, "floor", metal)}
        export(ExportRequest(maps=work / "true", out=made["true"], name="true"))
    return made


def errors(held: HeldOut, asset: Path, *, client: Client = Client.BLENDER, samples: int = PATHS) -> list[float]:
    """Return the relative error of each light, after one scale for all: RMSE divided by the mean, over every pixel of the mask."""
    capture = Capture.open(held.folder)
    camera, mask = capture.manifest.camera, capture.mask()
    pictures = np.stack([render(client, asset, camera, light, samples=samples)[..., :3] for light in held.lights])
    scale = compare(pictures, held.truth, np.broadcast_to(mask, pictures.shape[:3])).scale
    return [compare(scale * picture, truth, mask, scaled=False).rmse for picture, truth in zip(pictures, held.truth, strict=True)]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("capture", type=Path, nargs="?", default=SAMPLES / "owl")
    parser.add_argument("--work", type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        work = given.work or Path(folder)
        work.mkdir(parents=True, exist_ok=True)
        held = leave_out(given.capture, work / "rest")
        for key, asset in make_assets(held, given.capture, work).items():
            found = errors(held, asset)
            print(f"| {ASSETS[key]} | {' | '.join(f'{each:.3f}' for each in found)} | {np.mean(found):.3f} |", flush=True)


if __name__ == "__main__":
    main()
