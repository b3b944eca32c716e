"""The F0 that explains path-traced dielectrics best under Schlick's approximation and under Fresnel's equations.

Relit fits the first, which assets have; Mitsuba traces the second. Normals, albedo and roughness are the true ones, so that no step of the
solver takes part.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from stage.capture.capture import Capture
from stage.capture.lighting import distant_lights
from stage.formats import exr

F0_GRID = np.arange(0.02, 0.08, 0.001)
LARGEST_SHARE = 0.01
"""Pixels with a larger share of metal are left out."""
LEAST_VIEW, LEAST_LIGHT = 0.3, 0.15
"""Cosines between the normal and the viewer, and the light: at the rim and at grazing light, pixels mix and shadows begin."""
NOISE = 0.02
"""Scale of the Cauchy cost: as radiance of an irradiance of one, and relative to a reading. It bears cast shadows and bounced light."""

Fresnel = Callable[[float, np.ndarray], np.ndarray]


def schlick(f0: float, hv: np.ndarray) -> np.ndarray:
    """Return Schlick's reflectance at the cosine hv between light and half vector (1994, eq. 15)."""
    return f0 + (1 - f0) * (1 - hv) ** 5


def fresnel(f0: float, hv: np.ndarray) -> np.ndarray:
    """Return the reflectance of a dielectric for unpolarised light by Fresnel's equations (Walter et al., EGSR 2007, eq. 22)."""
    index = (1 + np.sqrt(f0)) / (1 - np.sqrt(f0))
    g = np.sqrt(index**2 - 1 + hv**2)
    turned = (hv * (g + hv) - 1) / (hv * (g - hv) + 1)
    return np.asarray(0.5 * ((g - hv) / (g + hv)) ** 2 * (1 + turned**2))


def best_f0(folder: Path, models: tuple[Fresnel, ...]) -> list[tuple[float, float]]:
    """Return the F0 of F0_GRID of least mean cost under each model, and that cost relative to the first model's.

    Args:
        folder: a capture of distant lights, seen along z, with a truth.exr.
        models: reflectance of an F0 at cosines.
    """
    capture, (truth, _) = Capture.open(folder), exr.read(folder / "truth.exr")
    lights, mask = distant_lights(capture), capture.mask()
    chosen = mask & (truth["normal.Z"] > LEAST_VIEW) & (truth.get("metal.Y", np.zeros(mask.shape)) < LARGEST_SHARE)

    def plane(name: str) -> np.ndarray:
        return np.asarray(truth[name], dtype=np.float64)[chosen]

    normal = np.stack([plane(f"normal.{c}") for c in "XYZ"], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    albedo = np.stack([plane(f"diffuse_albedo.{c}") for c in "RGB"], axis=1)
    rough, nv = plane("roughness.Y"), normal[:, 2]
    alpha2 = rough**4
    costs = np.zeros((len(models), len(F0_GRID)))
    for frame, toward, irradiance in zip(capture.manifest.frames, lights.direction, lights.irradiance, strict=True):
        lit = normal @ toward > LEAST_LIGHT
        image, _ = exr.read(folder / frame.image)
        radiance = np.stack([np.asarray(image[c], dtype=np.float64)[chosen] for c in "RGB"], axis=1)[lit] / irradiance
        half = toward + np.array([0.0, 0.0, 1.0])
        half /= np.linalg.norm(half)
        nl, nh, hv = (normal @ toward)[lit], (normal @ half)[lit], half[2]
        wide, seen = alpha2[lit], nv[lit]
        masking = nl * np.sqrt(seen**2 * (1 - wide) + wide) + seen * np.sqrt(nl**2 * (1 - wide) + wide)
        lobe = wide * nl / (2 * np.pi * (nh**2 * (wide - 1) + 1) ** 2 * masking)  # D V n·l, Heitz 2014
        retro = 2 * rough[lit] * hv**2 - 0.5
        diffuse = nl / np.pi * (1 + retro * (1 - nl) ** 5) * (1 + retro * (1 - seen) ** 5)  # Burley 2012
        left, noise = radiance - albedo[lit] * diffuse[:, None], NOISE * (1 + radiance)
        for place, model in enumerate(models):
            for column, f0 in enumerate(F0_GRID):
                off = (left - (lobe * model(float(f0), np.array(hv)))[:, None]) / noise
                costs[place, column] += np.log1p(off**2).sum()
    return [(float(F0_GRID[cost.argmin()]), float(cost.min() / costs[0].min())) for cost in costs]


def fresnel_table(glossy: Path | None, parts: Path | None) -> list[str] | None:
    """Return the table as lines of Markdown; None without captures.

    Args:
        glossy: folder with glossy of samples/make_glossy.py.
        parts: folder with two_parts and figure of samples/make_parts.py.
    """
    folders = [folder / name for folder, name in ((glossy, "glossy"), (parts, "two_parts"), (parts, "figure"))
               if folder is not None and (folder / name / "truth.exr").is_file()]
    if not folders:
        return None
    lines = ["F0 that explains the dielectric pixels best with the true normals, albedo and roughness; the true F0 is 0.04. Mitsuba "
             "reflects by Fresnel's equations, Relit and the materials of assets by Schlick's approximation, which reflects less of light "
             "from the side: a larger F0 makes up for it. Bounced light is not taken off here.", "",
             "| | F0, Schlick | F0, Fresnel | cost, Fresnel / Schlick |", "|---|---|---|---|"]
    for folder in folders:
        (approximate, _), (exact, ratio) = best_f0(folder, (schlick, fresnel))
        lines.append(f"| {folder.name} | {approximate:.3f} | {exact:.3f} | {ratio:.3f} |")
    return lines
