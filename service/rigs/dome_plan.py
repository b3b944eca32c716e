"""Plans of domes: how well so many lamps render environments, as errors of the irradiance and of highlights, against the number of lamps.

Highlights are those of a GGX lobe with the view from the front, as relit's materials have them (Walter et al., EGSR 2007).
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.drive.judgement import environment_samples, irradiance_of
from service.relight.environments import Environments
from service.relight.sheet import BACKGROUND, write_sheet
from service.relight.weights.weighting import integrate
from service.reporting.progress import Progress, Timings
from service.requests.relight import LightWeights
from service.requests.rig import RigPlanRequest
from stage.files import write_text
from stage.formats.csv_table import table_text
from stage.rig.rig import read_rig
from stage.transforms import fibonacci_sphere

SPACE = "lin_rec709_scene"
NORMALS = 256
ROUGHNESS = (0.1, 0.3, 0.6)
"""The roughnesses of the highlights; α is the square of each."""
WIDTH, HEIGHT = 1040, 420
COLOURS = ((0.95, 0.6, 0.2), (0.35, 0.7, 0.95), (0.5, 0.85, 0.45), (0.9, 0.4, 0.75))
MARK = 4
"""Half the side of the square of a rig, pixels."""
BATCH = 64


class PlanRow(NamedTuple):
    """The errors of a dome under an environment: root mean square errors over the normals, as parts of what the environment gives."""

    environment: str
    lights: int
    irradiance: float
    highlights: tuple[float, ...]
    """One for each of ROUGHNESS."""
    rig: str = ""
    """The name of the rig; none where lamps are spread evenly."""


def plan_rig(request: RigPlanRequest, progress: Progress | None = None) -> tuple[list[PlanRow], list[str]]:
    """Judge domes under environments, write plan.csv and plan.png, and return their rows, and what is doubtful about the environments.
    Raises StageError if a map or a rig cannot be used. Raises StorageError if a file cannot be read or written."""
    timings = Timings(progress)
    given_rigs = [read_rig(path) for path in request.rigs]
    domes = [("", fibonacci_sphere(count)) for count in request.lights] + [(rig.name, rig.directions) for rig in given_rigs]
    timings.stage("plan", len(request.environment) * len(domes))
    normals = fibonacci_sphere(NORMALS)
    rows, doubts = [], []
    for path in request.environment:
        environments = Environments(path)
        environments.check([1])
        environment = environments.read(environments.path(1), SPACE)
        doubts += environments.doubts()
        direction, energy = environment_samples(environment)
        wanted = [irradiance_of(direction, energy, normals), *(_lobe(direction, energy, normals, roughness) for roughness in ROUGHNESS)]
        for name, lamps in domes:
            given = integrate(environment.radiance, lamps, np.eye(3)[None], weighting=LightWeights.KERNEL, device="cpu")[0]
            got = [irradiance_of(lamps, given, normals), *(_lobe(lamps, given, normals, roughness) for roughness in ROUGHNESS)]
            errors = [float(np.sqrt(((a - b) ** 2).mean() / max((b**2).mean(), 1e-300))) for a, b in zip(got, wanted, strict=True)]
            rows.append(PlanRow(path.name, len(lamps), errors[0], tuple(errors[1:]), name))
            timings.advance(len(rows))
    timings.stage("files", 1)
    request.out.mkdir(parents=True, exist_ok=True)
    columns = ["environment", "lights", "irradiance_percent", *(f"highlights_{roughness:g}_percent" for roughness in ROUGHNESS), "rig"]
    write_text(request.out / "plan.csv", table_text(columns, (
        [row.environment, row.lights, *(f"{100 * error:.4g}" for error in (row.irradiance, *row.highlights)), row.rig] for row in rows)))
    _plot(rows, request.out / "plan.png")
    timings.close()
    return rows, doubts


def _lobe(direction: np.ndarray, energy: np.ndarray, normals: np.ndarray, roughness: float) -> np.ndarray:
    """Return the radiance [normals, 3] that a GGX mirror of F0 1 sends to the front under samples of light; normals face the front."""
    alpha2 = roughness**4
    towards = np.array([0.0, 0.0, 1.0])
    half = direction + towards
    half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-9)
    found = np.zeros((len(normals), 3))
    for begin in range(0, len(normals), BATCH):
        normal = normals[begin : begin + BATCH]
        seen, lit, across = np.maximum(normal[:, 2:], 0), np.maximum(normal @ direction.T, 0), np.maximum(normal @ half.T, 0)
        distribution = alpha2 / (np.pi * (across**2 * (alpha2 - 1) + 1) ** 2)
        masked = lit * np.sqrt(seen**2 * (1 - alpha2) + alpha2) + seen * np.sqrt(lit**2 * (1 - alpha2) + alpha2)
        found[begin : begin + BATCH] = (distribution * 0.5 / np.maximum(masked, 1e-9) * lit * (seen > 0)) @ energy
    return found


def _plot(rows: list[PlanRow], path: Path) -> None:
    """Write a plot of the errors against the number of lamps for each environment, both logarithmic; rigs are squares."""
    tiles = []
    lights = np.log([row.lights for row in rows])
    errors = np.log([[max(row.irradiance, 1e-5), *(max(error, 1e-5) for error in row.highlights)] for row in rows])
    low, high = errors.min(), max(errors.max(), errors.min() + 1)
    for name in dict.fromkeys(row.environment for row in rows):
        picture = np.tile(BACKGROUND, (HEIGHT, WIDTH, 1))
        chosen = [index for index, row in enumerate(rows) if row.environment == name and not row.rig]
        given = [index for index, row in enumerate(rows) if row.environment == name and row.rig]
        x = 20 + (lights - lights.min()) / max(float(np.ptp(lights)), 1e-9) * (WIDTH - 40)
        for curve, colour in enumerate(COLOURS):
            y = 20 + (high - errors[:, curve]) / (high - low) * (HEIGHT - 40)
            order = np.array(chosen)[np.argsort(x[chosen])]
            across = np.linspace(x[chosen].min(), x[chosen].max(), 4 * WIDTH)
            down = np.interp(across, x[order], y[order])
            for shift in (0, 1):
                picture[np.clip(np.rint(down).astype(int) + shift, 0, HEIGHT - 1), np.rint(across).astype(int)] = colour
            for row, column in np.rint(np.stack([y, x], axis=1)[given]).astype(int):
                picture[row - MARK : row + MARK + 1, column - MARK : column + MARK + 1] = colour
        tiles.append([(f"{name}: {np.exp(low):.2%} to {np.exp(high):.2%}, {round(np.exp(lights.min()))} to {round(np.exp(lights.max()))} "
                       "lamps; orange irradiance; highlights of roughness .1 blue, .3 green, .6 pink; squares are rigs", picture)])
    write_sheet(path, tiles, height=HEIGHT)
