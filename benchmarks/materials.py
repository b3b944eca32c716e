"""The effect of sharing materials between pixels: albedo, F0 and roughness of the path-traced objects, with it and without."""

import tempfile
from pathlib import Path

import numpy as np

from kernels.photometric.readings import pad_lights
from service.reporting.progress import Timings
from service.solve.material import MaterialOptions, solve_material
from service.solve.solution import SolveInput
from stage import exr
from stage.capture import Capture
from stage.ingest import open_stack
from stage.lighting import distant_lights


def material_errors(folder: Path, options: MaterialOptions) -> dict[str, tuple[float, float]]:
    """Return the median and the 90th percentile of errors over the solved pixels.

    Args:
        folder: a capture of distant lights with a truth.exr, a dielectric, or a metal where its name ends so.
        options: the steps of the solver that are left out.

    Returns:
        `albedo`, relative (only of a dielectric), `F0`, relative of a metal and absolute of a dielectric, `roughness`, absolute.
    """
    capture, (truth, _) = Capture.open(folder), exr.read(folder / "truth.exr")
    lit = distant_lights(capture)
    with tempfile.TemporaryDirectory() as cache:
        stack = open_stack(capture, cache=Path(cache))
        solution = solve_material(SolveInput(stack, capture.camera, capture.mask(), ("cpu",), Timings()),
                                  pad_lights(lit.direction, lit.irradiance, stack.scale), options=options)
    inside = np.flatnonzero(capture.mask())

    def plane(name: str) -> np.ndarray:
        return np.asarray(truth[name], dtype=np.float64).reshape(-1)[inside]

    assert solution.specular is not None and solution.roughness is not None
    albedo = np.stack([plane(f"diffuse_albedo.{c}") for c in "RGB"])
    specular, found = solution.specular[:, inside].astype(np.float64), solution.albedo[:, inside].astype(np.float64)
    if folder.name.endswith("metal"):  # its diffuse_albedo holds F0
        errors = {"F0": np.abs(specular - albedo) / albedo}
    else:
        errors = {"albedo": np.abs(found - albedo) / albedo,
                  "F0": np.abs(specular - np.stack([plane(f"specular.{c}") for c in "RGB"]))}
    errors["roughness"] = np.abs(solution.roughness[inside].astype(np.float64) - plane("roughness.Y"))
    return {name: (float(np.median(error)), float(np.percentile(error, 90))) for name, error in errors.items()}


def material_table(glossy: Path) -> list[str]:
    """Return the table as lines of Markdown.

    Args:
        glossy: folder with glossy and glossy_metal of samples/make_glossy.py.
    """
    lines = ["Errors, median / 90th percentile: relative for albedo and the F0 of a metal, absolute for the F0 of a dielectric "
             "(0.04) and roughness.",
             "", "| | albedo | F0 | roughness |", "|---|---|---|---|"]
    for name in ("glossy", "glossy_metal"):
        for what, options in (("each pixel alone", MaterialOptions(sharing=False)),
                              ("materials shared (`svbrdf`)", MaterialOptions())):
            errors = material_errors(glossy / name, options)
            relative = {"albedo"} if name == "glossy" else {"F0"}
            cells = [" / ".join(f"{100 * e:.2g} %" if key in relative else f"{e:.2g}" for e in errors[key]) if key in errors else "–"
                     for key in ("albedo", "F0", "roughness")]
            lines.append(f"| {name}, {what} | " + " | ".join(cells) + " |")
    return lines
