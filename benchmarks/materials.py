"""The effect of sharing materials between pixels: albedo, F0 and roughness of the path-traced objects, with it and without, and how well
the maps render the captured images again."""

import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.fresnel import LARGEST_SHARE
from kernels.photometric.lambertian.readings import pad_lights
from service.reporting.progress import Timings
from service.solve.base.solution import SolveInput
from service.solve.methods.material import solve_material
from service.solve.methods.material_options import MaterialOptions
from stage.capture.capture import Capture
from stage.capture.lighting import distant_lights
from stage.formats import exr
from stage.stack.ingest import open_stack
from tests.reference import microfacet as twin

TOO_BRIGHT = 0.03
"""Excess of F0 over the truth at which a dielectric pixel counts as too bright: 0.04 becomes 0.07, which no plastic or paint has."""
SURE = 0.5
"""Confidence above which a pixel that is too bright is a wrong answer that is given as a right one."""
LEAST_LIGHT = 0.1
"""Cosine between the normal and the light below which readings are not compared: penumbras and normals a degree off decide them."""
ALIKE = 2.0
"""Factor from what the true material reflects directly within which a reading is compared: others are in shadow or in bounced light."""
VIEW = np.array([0.0, 0.0, 1.0])


class Surface(NamedTuple):
    """Normals and materials of the pixels of an object, float64."""

    normal: np.ndarray  # [n, 3] unit
    albedo: np.ndarray  # [n, 3]
    specular: np.ndarray  # [n, 3] F0
    roughness: np.ndarray  # [n]

    def render(self, light: np.ndarray) -> np.ndarray:
        """Return radiance [n, 3] of Relit's BRDF under a light of irradiance one."""
        normal = np.where(self.normal[:, 2:] > 1e-3, self.normal, [0.0, 0.0, 1e-3])
        lobe = (twin.specular(normal, light, VIEW, self.roughness**2, f0) for f0 in self.specular.T)
        return np.asarray(self.albedo * twin.diffuse(normal, light, VIEW)[:, None] + np.stack(list(lobe), axis=1))


class Errors(NamedTuple):
    """Errors of the materials of an object."""

    spread: dict[str, tuple[float, float]]
    """Median and 90th percentile of `albedo`, relative and only of dielectrics, `F0`, relative of metals and absolute of dielectrics, and
    `roughness`, absolute."""
    too_bright: float
    """Pixels whose F0 is too high by TOO_BRIGHT, as a part of all."""
    sure: float
    """Those of them with a confidence above SURE, as a part of all."""
    rendered: float
    """RMSE of the captured images rendered from the maps, direct light alone, over the root mean square of the images."""


def material_errors(folder: Path, options: MaterialOptions) -> Errors:
    """Solve an object, and compare with its truth the pixels that are wholly of a dielectric, or those of a metal.

    Args:
        folder: a capture of distant lights, seen along z, with a truth.exr, of dielectrics and perhaps metals, or of a metal alone where
            its name ends so.
        options: the steps of the solver that are left out.
    """
    capture, (truth, _) = Capture.open(folder), exr.read(folder / "truth.exr")
    lit, metal = distant_lights(capture), folder.name.endswith("metal")
    with tempfile.TemporaryDirectory() as cache:
        stack = open_stack(capture, cache=Path(cache))
        solution = solve_material(SolveInput(stack, capture.camera, capture.mask(), ("cpu",), Timings()),
                                  pad_lights(lit.direction, lit.irradiance, stack.scale), options=options)
    chosen = np.flatnonzero(capture.mask() & (truth.get("metal.Y", np.zeros(capture.mask().shape)) < LARGEST_SHARE))

    def planes(name: str, suffixes: str) -> np.ndarray:
        return np.stack([np.asarray(truth[f"{name}.{suffix}"], dtype=np.float64).reshape(-1)[chosen] for suffix in suffixes], axis=1)

    assert solution.specular is not None and solution.roughness is not None
    albedo = planes("diffuse_albedo", "RGB")  # holds F0 of a metal
    normal = planes("normal", "XYZ")
    true = Surface(normal / np.linalg.norm(normal, axis=1, keepdims=True), np.zeros_like(albedo) if metal else albedo,
                   albedo if metal else planes("specular", "RGB"), planes("roughness", "Y")[:, 0])
    found = Surface(*(np.asarray(values.T[chosen], dtype=np.float64) for values in
                      (solution.normal, solution.albedo, solution.specular, solution.roughness)))
    off = {"F0": np.abs(found.specular - true.specular) / (true.specular if metal else 1.0),
           "roughness": np.abs(found.roughness - true.roughness)}
    if not metal:
        off["albedo"] = np.abs(found.albedo - true.albedo) / np.maximum(true.albedo, 1e-3)
    bright = (found.specular - true.specular).mean(axis=1) > TOO_BRIGHT
    sure = bright & (solution.confidence[chosen] > SURE)
    return Errors({name: (float(np.median(error)), float(np.percentile(error, 90))) for name, error in off.items()},
                  float(bright.mean()), float(sure.mean()), _rendered(capture, chosen, true, found))


def _rendered(capture: Capture, chosen: np.ndarray, true: Surface, found: Surface) -> float:
    """Return the relative RMSE of the captured images rendered from what was found, over readings of direct light."""
    lights, missed, whole = distant_lights(capture), 0.0, 0.0
    for frame, toward, irradiance in zip(capture.manifest.frames, lights.direction, lights.irradiance, strict=True):
        image, _ = exr.read(capture.folder / frame.image)
        reading = np.stack([np.asarray(image[c], dtype=np.float64).reshape(-1)[chosen] for c in "RGB"], axis=1) / irradiance
        total, expected = reading.sum(axis=1), true.render(toward).sum(axis=1)
        direct = (true.normal @ toward > LEAST_LIGHT) & (total > expected / ALIKE) & (total < ALIKE * expected)
        missed += float(((found.render(toward) - reading)[direct] ** 2).sum())
        whole += float((reading[direct] ** 2).sum())
    return float(np.sqrt(missed / whole))


def material_table(glossy: Path | None, parts: Path | None) -> list[str] | None:
    """Return the table as lines of Markdown; None without captures.

    Args:
        glossy: folder with glossy and glossy_metal of samples/make_glossy.py.
        parts: folder with two_parts and figure of samples/make_parts.py.
    """
    objects = [folder / name for folder, names in ((glossy, ("glossy", "glossy_metal")), (parts, ("two_parts", "figure")))
               for name in names if folder is not None and (folder / name / "truth.exr").is_file()]
    if not objects:
        return None
    lines = ["Errors, median / 90th percentile: relative for albedo and the F0 of a metal, absolute for the F0 of a dielectric "
             "(0.04) and roughness; of two_parts and figure, the pixels of dielectrics. Too bright: pixels whose F0 is too high by more "
             f"than {TOO_BRIGHT}, and those of them with a confidence above {SURE}. Rendered: relative RMSE of the captured images "
             "rendered from the maps, where direct light falls.",
             "", "| | albedo | F0 | roughness | too bright | sure | rendered |", "|---|---|---|---|---|---|---|"]
    for folder in objects:
        for what, options in (("each pixel alone", MaterialOptions(sharing=False)),
                              ("materials shared (`svbrdf`)", MaterialOptions())):
            errors = material_errors(folder, options)
            metal = "albedo" not in errors.spread
            relative = {"F0"} if metal else {"albedo"}
            cells = [" / ".join(f"{100 * e:.2g} %" if key in relative else f"{e:.2g}" for e in errors.spread[key])
                     if key in errors.spread else "–" for key in ("albedo", "F0", "roughness")]
            cells += ["–", "–"] if metal else [f"{100 * part:.2g} %" for part in (errors.too_bright, errors.sure)]
            lines.append(f"| {folder.name}, {what} | " + " | ".join([*cells, f"{errors.rendered:.3f}"]) + " |")
    return lines
