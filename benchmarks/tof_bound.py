"""Photon histograms through `relit depth` beside the Cramér-Rao bound: what photons allow, what is made of them, how true sigma is."""

from typing import NamedTuple

import numpy as np

from benchmarks.tof_accuracy import COLS, ROWS, SEED, solved_maps
from stage.spread import MAD_TO_SIGMA
from stage.tof.simulate import HistogramCamera, TofScene, range_bound_m
from tests.reference import tof as scenes

BACKGROUND = 0.02
FAR_M = (11.3, 11.7)
"""The least and largest range of the far wall: over two bins, because the error from five photons depends on the position in the bin."""
GOALS_MM = {1.0: 20, 0.2: 46}
"""The goals for the median error in mm, by part of the full light."""
FIFTHS = 5


class Light(NamedTuple):
    """The histograms of one scene at a part of the full light."""

    possible_mm: float  # least median error
    median_mm: float
    solved: float
    observed_over_sigma: list[float]  # in fifths of the pixels by sigma
    clipped_rms: float


def far_wall(albedo: np.ndarray, cosine: float) -> scenes.View:
    """Return a scene of a wall whose range goes from FAR_M[0] on the left to FAR_M[1]."""
    return scenes.View(np.linspace(*FAR_M, albedo.shape[1]) * np.ones(albedo.shape), albedo, np.full(albedo.shape, cosine))


def least_median_m(sigma_m: np.ndarray) -> float:
    """Return the median of |error| over pixels with normal errors of the given standard deviations."""
    random = np.abs(np.random.default_rng(0).standard_normal((200, sigma_m.size)))
    return float(np.median(random * sigma_m.reshape(-1)))


def measured(view: scenes.View, part: float) -> Light:
    """Solve one scene and return its errors."""
    counts = scenes.histogram(view, 4000 * part, background=BACKGROUND, seed=SEED)
    maps = solved_maps([(counts, {"type": "pulsed", "bin_s": 1.5e-9, "start_s": 0.0})])
    scene = TofScene(range_m=view.distance, albedo=view.albedo, cosine=view.cosine)
    possible = range_bound_m(scene, HistogramCamera(signal_photons=4000 * part, background=BACKGROUND))
    along = (maps.depth / np.maximum(maps.range, 1e-9))[maps.mask]
    error, sigma = (maps.range - view.distance)[maps.mask], maps.sigma[maps.mask] / along
    fifths = np.array_split(np.argsort(sigma), FIFTHS)
    return Light(1000 * least_median_m(possible), 1000 * float(np.median(np.abs(error))), float(maps.mask.mean()),
                 [MAD_TO_SIGMA * float(np.median(np.abs(error / sigma)[fifth])) for fifth in fifths],
                 float(np.sqrt(np.mean(np.clip(error / sigma, -4, 4) ** 2))))


def bound_rows() -> list[str]:
    """Return the table as lines of Markdown."""
    room = scenes.room(ROWS, COLS)
    lines = ["Histograms, compared with what their photons allow. Possible: median of the errors that the Cramér-Rao bound of each pixel "
             "allows (`range_bound_m`). Observed over sigma: 1.4826 · median of |error|/sigma, in fifths of the pixels from the smallest "
             "sigma to the largest; RMS of the same, clipped at 4.", "",
             "| scene | light | possible, mm | measured, mm | goal, mm | no depth | observed over sigma | RMS |",
             "|---|---|---|---|---|---|---|---|"]
    away = f"{FAR_M[0]} to {FAR_M[1]} m"
    for name, view in (("the room", room), (f"its tiles on a wall at {away}, cos θ 0.8", far_wall(room.albedo, 0.8)),
                       (f"a white wall at {away}, cos θ 1", far_wall(np.ones_like(room.albedo), 1.0))):
        for title, part in (("whole", 1.0), ("a fifth", 0.2)):
            light = measured(view, part)
            goal = f"{GOALS_MM[part]}{' (not possible)' if light.possible_mm > GOALS_MM[part] else ''}"
            observed = " ".join(f"{ratio:.2f}" for ratio in light.observed_over_sigma)
            lines.append(f"| {name} | {title} | {light.possible_mm:.3g} | {light.median_mm:.3g} | {goal} | "
                         f"{100 * (1 - light.solved):.2g} % | {observed} | {light.clipped_rms:.2f} |")
    return lines
