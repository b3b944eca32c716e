"""Error maps of normals with and without the steps that take an object's own light out of its images, as one picture, docs/steps.png.

Black is 0, orange 10 degrees or more; the mean is that of every pixel.

    python -m benchmarks.step_picture [--data DIR] [--relighting DIR]
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.accuracy import angles_deg, read_truth
from benchmarks.pictures import heat
from kernels.photometric.lambertian.readings import pad_lights
from service.relight.sheet import write_sheet
from service.reporting.progress import Timings
from service.solve.base.solution import SolveInput
from service.solve.methods.material import solve_material
from service.solve.methods.material_options import WHOLE_SOLVER
from stage.capture.capture import Capture
from stage.capture.lighting import distant_lights
from stage.importers import diligent
from stage.stack.ingest import open_stack

TARGET = Path(__file__).parents[1] / "docs" / "steps.png"
STEPS = {
    "bounced light left in": replace(WHOLE_SOLVER, interreflection=False, parts=False, settling=False, scale=False, metals=False,
                                            intensities=False),
    "taken off once": replace(WHOLE_SOLVER, parts=False, settling=False, scale=False, metals=False, intensities=False),
    "svbrdf": WHOLE_SOLVER,
}


def picture_row(title: str, capture: Capture, truth: np.ndarray, cache: Path) -> list[tuple[str, np.ndarray]]:
    """Return the error maps of one object, each with its mean error.

    Args:
        title: of the object.
        capture: orthographic, of distant lights.
        truth: [rows, cols, 3] true normals.
        cache: folder for the stack.
    """
    stack, mask, lit = open_stack(capture, cache=cache), capture.mask(), distant_lights(capture)
    lights = pad_lights(lit.direction, lit.irradiance, stack.scale)
    given = SolveInput(stack, capture.camera, mask, ("cpu",), Timings(), relative=capture.manifest.irradiance_scale == "relative")
    row = []
    for name, options in STEPS.items():
        normal = np.moveaxis(solve_material(given, lights, options=options).normal.reshape(3, *mask.shape), 0, -1)
        error = angles_deg(normal, truth)
        row.append((f"{title}, {name}: {error[mask].mean():.2f}°", heat(error, mask)))
    return row


def main() -> None:
    """Solve every object with every set of steps and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--data", type=Path, help="folder with diligent_cat")
    parser.add_argument("--relighting", type=Path, help="folder with two_parts and figure of samples/make_parts.py")
    given = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as work:
        if given.data:
            diligent.import_folder(given.data / "diligent_cat", Path(work) / "cat")
            truth = np.load(given.data / "diligent_cat" / "normal_gt.npz")["normal"]
            rows.append(picture_row("cat", Capture.open(Path(work) / "cat"), truth, Path(work)))
        for name in ("two_parts", "figure") if given.relighting else ():
            folder = given.relighting / name
            rows.append(picture_row(name, Capture.open(folder), read_truth(folder / "truth.exr")["normal"], Path(work) / name))
    if not rows:
        parser.error("give --data or --relighting")
    write_sheet(TARGET, rows)


if __name__ == "__main__":
    main()
