"""The general solver against least squares, and its search against the same arithmetic in vectorised NumPy, in one run."""

from collections.abc import Callable

import numpy as np

from benchmarks.timing import run_seconds
from kernels import packs
from kernels.photometric.lambertian.lambert import solve_lambert
from kernels.photometric.lambertian.readings import grey_factors, grey_readings, pad_lights
from kernels.photometric.model.candidates import rings
from kernels.photometric.model.samples import gather
from kernels.photometric.search.descent import descend
from kernels.photometric.search.hypotheses import LobeShape, search_normals
from kernels.photometric.svbrdf import solve_svbrdf
from stage.colour.colour import GREY_WEIGHTS
from tests.reference import hypotheses as twin

LIGHTS, PIXELS, NUMPY_PIXELS = 96, 16384, 1024
RINGS = ((5.0, 10.0), 12)


def median_seconds(work: Callable[[], object], repeats: int = 5) -> float:
    """Return the median seconds of several runs."""
    return float(np.median(run_seconds(work, repeats)))


def search_rows() -> list[str]:
    """Return the table as lines of Markdown."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(LIGHTS, 3))
    directions[:, 2] = np.abs(directions[:, 2]) + 0.3
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    normal = rng.normal(size=(PIXELS, 3)) * [0.3, 0.3, 0] + [0, 0, 1]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    radiance = np.maximum(directions @ normal.T, 0) * rng.lognormal(0, 0.05, (LIGHTS, PIXELS)) / np.pi
    lights = pad_lights(directions, np.ones((LIGHTS, 3)))
    band = packs.upload(np.repeat(radiance[None], 3, axis=0).astype(np.float16), device="cpu")
    factors = grey_factors(lights, GREY_WEIGHTS)
    view = np.tile(np.array([0, 0, 1], dtype=np.float32), (PIXELS, 1))
    samples = gather(band, np.arange(PIXELS), view, lights, factors, LIGHTS)
    start = normal.astype(np.float32)
    wide, fine = RINGS, ()
    candidates = len(rings(*RINGS))
    least_squares = median_seconds(lambda: solve_lambert(band, grey_readings(band, factors), lights.direction))
    search = median_seconds(lambda: search_normals(samples, start, shape=LobeShape(), wide=wide, fine=fine))
    readings = (radiance / np.median(radiance, axis=0)).T[:NUMPY_PIXELS].astype(np.float32)
    numpy = median_seconds(lambda: twin.cost(readings, start[:NUMPY_PIXELS], directions.astype(np.float32), view[:NUMPY_PIXELS]), 3)
    descents = median_seconds(lambda: descend(samples, start, shape=LobeShape()))
    whole = median_seconds(lambda: solve_svbrdf(samples, start, shape=LobeShape()), 3)
    ours, theirs = PIXELS * candidates / search, NUMPY_PIXELS / numpy
    return [f"The general solver, {LIGHTS} lights, on the CPU:", "", "| | per second |", "|---|---|",
            f"| candidates judged, kernel | {ours:,.0f} |", f"| candidates judged, the same in vectorised NumPy | {theirs:,.0f} |",
            f"| ratio | {ours / theirs:.1f} |", f"| pixels, descent of the normal from a start | {PIXELS / descents:,.0f} |",
            f"| pixels, search, averaging and material | {PIXELS / whole:,.0f} |",
            f"| pixels, `lambert` normals | {PIXELS / least_squares:,.0f} |"]
