"""The effect of each part of the general solver: normals of the same pixels with the parts added one at a time."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.accuracy import angles_deg, read_truth
from kernels import packs
from kernels.photometric.lambertian.lambert import NormalFit, solve_lambert
from kernels.photometric.lambertian.readings import Lights, grey_factors, grey_readings, pad_lights
from kernels.photometric.lambertian.robust import solve_robust
from kernels.photometric.model.samples import Samples, evenly, gather
from kernels.photometric.search.hypotheses import LobeShape, SearchOptions
from kernels.photometric.search.lobe_shape import choose_lobe_shape
from kernels.photometric.search.normal_search import find_normals
from kernels.photometric.svbrdf import SHAPE_TEMPERATURE, average_normals, solve_svbrdf
from kernels.status import Status
from service.reporting.progress import Timings
from service.solve.base.solution import SolveInput
from service.solve.methods.kinds import LOBE_PIXELS
from service.solve.methods.material import solve_material
from service.solve.methods.material_options import MaterialOptions
from stage.capture.capture import Capture
from stage.capture.lighting import distant_lights
from stage.colour.colour import GREY_WEIGHTS
from stage.importers import diligent
from stage.stack.ingest import open_stack

PIXELS = 4000
"""The pixels of each object at even steps, which determine a mean to two digits."""
NO_SHADOW = SearchOptions(shadow_cost=30.0)
"""A cost above every residual, so that shadows are treated as outliers."""


@dataclass
class Case:
    """The pixels of one object, prepared for the solver."""

    name: str
    truth: np.ndarray  # [n, 3] unit
    lambert: np.ndarray  # [n, 3]
    robust: np.ndarray  # [n, 3]
    samples: Samples
    channels: tuple[Samples, ...]
    """The same pixels with the readings of one channel as their grey."""
    shape: LobeShape
    """The shared diffuse shape, chosen on LOBE_PIXELS of them."""
    whole: Callable[[MaterialOptions], np.ndarray]
    """Solves the whole image; [n, 3] of its normals."""


def load_case(name: str, capture: Capture, truth: np.ndarray, cache: Path) -> Case:
    """Read a capture of distant lights, and choose its pixels.

    Args:
        name: for the table.
        capture: orthographic.
        truth: [rows, cols, 3] true normals.
        cache: folder for the stack.
    """
    stack = open_stack(capture, cache=cache)
    lit = distant_lights(capture)
    lights = pad_lights(lit.direction, lit.irradiance, stack.scale)
    factors = grey_factors(lights, GREY_WEIGHTS)
    inside = np.flatnonzero(capture.mask())
    chosen = inside[evenly(len(inside), PIXELS)]
    band = packs.upload(*stack.pick(chosen), device="cpu")

    def normals(solver: Callable[..., NormalFit]) -> tuple[np.ndarray, np.ndarray]:
        fit = solver(band, grey_readings(band, factors), lights.direction)
        return fit.normal.numpy()[:, : len(chosen)].T, fit.status.numpy()[: len(chosen)] == Status.OK

    lambert, robust = normals(solve_lambert), normals(solve_robust)
    solved = np.flatnonzero(lambert[1] & robust[1])
    samples = _gather(band, solved, lights, factors, stack.light_count)
    channels = tuple(_gather(band, solved, lights, grey_factors(lights, one), stack.light_count) for one in np.eye(3))
    few = solved[evenly(len(solved), LOBE_PIXELS)]
    shape = choose_lobe_shape(_gather(band, few, lights, factors, stack.light_count), robust[0][few]).mean

    def whole(options: MaterialOptions) -> np.ndarray:
        solution = solve_material(SolveInput(stack, capture.camera, capture.mask(), ("cpu",), Timings(),
                                             relative=capture.manifest.irradiance_scale == "relative"), lights, options=options)
        return solution.normal[:, chosen[solved]].T

    return Case(name, truth.reshape(-1, 3)[chosen[solved]], lambert[0][solved], robust[0][solved], samples, channels, shape, whole)


def _gather(band: packs.Band, pixels: np.ndarray, lights: Lights, factors: np.ndarray, count: int) -> Samples:
    view = np.tile(np.array([0, 0, 1], dtype=np.float32), (len(pixels), 1))
    return gather(band, pixels, view, lights, factors, count)


def _channels_apart(case: Case) -> np.ndarray:
    found = [find_normals(samples, case.robust, shape=case.shape).best for samples in case.channels]
    return average_normals(np.stack([search.normal for search in found]), np.stack([search.cost for search in found]),
                           temperature=SHAPE_TEMPERATURE)[0]


VARIANTS: dict[str, Callable[[Case], np.ndarray]] = {
    "`lambert`": lambda case: case.lambert,
    "`robust`": lambda case: case.robust,
    "hypotheses × Lambert and five GGX lobes, Cauchy weights":
        lambda case: find_normals(case.samples, case.robust, shape=LobeShape(), options=NO_SHADOW).best.normal,
    "+ cast shadow as a separate hypothesis": lambda case: find_normals(case.samples, case.robust, shape=LobeShape()).best.normal,
    "+ diffuse shape shared by the object": lambda case: find_normals(case.samples, case.robust, shape=case.shape).best.normal,
    "· the same with the three channels searched separately and averaged by cost (not used)": _channels_apart,
    "+ averaged over nearby shapes": lambda case: solve_svbrdf(case.samples, case.robust, shape=case.shape, single_lobe=False).normal,
    "+ a single lobe fitted jointly with the normal": lambda case: solve_svbrdf(case.samples, case.robust, shape=case.shape).normal,
    "+ readings in cast shadows of the height left out":
        lambda case: case.whole(MaterialOptions(interreflection=False, metals=False, intensities=False)),
    "+ interreflection subtracted, materials shared":
        lambda case: case.whole(MaterialOptions(settling=False, parts=False, metals=False, intensities=False)),
    "+ parts placed in depth by their shadows": lambda case: case.whole(MaterialOptions(settling=False, metals=False, intensities=False)),
    "+ shape and interreflection in turn": lambda case: case.whole(MaterialOptions(scale=False, metals=False, intensities=False)),
    "+ scale of albedo where that of the lights is unknown": lambda case: case.whole(MaterialOptions(metals=False, intensities=False)),
    "+ intensities of the lights refined": lambda case: case.whole(MaterialOptions(metals=False)),
    "+ metals searched again under the lobes that they share (`svbrdf`)": lambda case: case.whole(MaterialOptions()),
    "· the same without two materials in a pixel, which leave the normals as they are":
        lambda case: case.whole(MaterialOptions(mixtures=False)),
}


def ablation_table(data: Path | None, glossy: Path | None, traced: Path | None) -> list[str] | None:
    """Return the mean and median angular error of each variant of the solver on each object in the data folders.

    Args:
        data: folder with diligent_ball and diligent_cat.
        glossy: folder with glossy and glossy_metal of samples/make_glossy.py.
        traced: folder with two_parts and figure of samples/make_parts.py.

    Returns:
        Lines of Markdown, or None without any data.
    """
    with tempfile.TemporaryDirectory() as folder:
        cases = []
        for name in ("diligent_ball", "diligent_cat") if data else ():
            capture = Path(folder) / name
            diligent.import_folder(data / name, capture)
            truth = np.load(data / name / "normal_gt.npz")["normal"]
            cases.append(load_case(name, Capture.open(capture), truth, capture / ".relit"))
        for home, names in ((glossy, ("glossy", "glossy_metal")), (traced, ("two_parts", "figure"))):
            for name in names if home else ():
                truth = read_truth(home / name / "truth.exr")["normal"]
                cases.append(load_case(name, Capture.open(home / name), truth, Path(folder) / f"{name}-stack"))
        if not cases:
            return None
        lines = ["Angular error of normals, degrees, mean / median, over some 4000 pixels of each object:", "",
                 "| | " + " | ".join(case.name for case in cases) + " |", "|---|" + "---|" * len(cases)]
        for what, solve in VARIANTS.items():
            errors = [angles_deg(solve(case), case.truth) for case in cases]
            lines.append(f"| {what} | " + " | ".join(f"{e.mean():.2f} / {np.median(e):.2f}" for e in errors) + " |")
        shapes = "; ".join(f"{c.name}: " + ("Lambert" if c.shape.rough < 0 else f"roughness {c.shape.rough:g}")
                           + f", slope {c.shape.slope:g}" for c in cases)
        return [*lines, "", f"Shapes chosen: {shapes}."]
