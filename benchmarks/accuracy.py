"""Accuracy of solved maps against ground truth, for the shipped samples and the DiLiGenT objects in a data folder."""

import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve
from stage.capture.capture import Capture
from stage.formats import exr
from stage.importers import diligent
from stage.results.maps import SurfaceMaps

SAMPLES = Path(__file__).parents[1] / "samples"


class SolveError(NamedTuple):
    """The errors of the maps of a capture over the pixels of its mask that have an estimate."""

    coverage: float
    """Fraction of the mask that counts as solved."""
    mean_deg: float
    median_deg: float
    albedo_median: float
    """Median relative error of diffuse albedo, all channels; NaN without a true one."""
    height_rms: float
    """RMS of height error over the relief (highest minus lowest true height); NaN without a true one."""


def angles_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angle in degrees between unit vectors along the last axis."""
    cross = np.linalg.norm(np.cross(a.astype(np.float64), b.astype(np.float64)), axis=-1)
    return np.degrees(np.arctan2(cross, (a.astype(np.float64) * b).sum(axis=-1)))


def read_truth(path: Path) -> dict[str, np.ndarray]:
    """Return the layers of a truth.exr: normal and diffuse_albedo [rows, cols, 3], height and mask [rows, cols]."""
    channels, _ = exr.read(path)
    truth = {}
    for name, suffixes in (("normal", "XYZ"), ("diffuse_albedo", "RGB"), ("height", "Z"), ("mask", "Y")):
        planes = [channels[f"{name}.{s}"].astype(np.float64) for s in suffixes]
        truth[name] = planes[0] if len(planes) == 1 else np.stack(planes, axis=-1)
    return truth


def compare(maps: SurfaceMaps, truth: dict[str, np.ndarray], mask: np.ndarray) -> SolveError:
    """Return the errors of solved maps, over every pixel that has an estimate, also where it is unsure."""
    assert maps.normal is not None and maps.diffuse_albedo is not None
    covered = float((mask & maps.mask).sum() / mask.sum())
    solved = mask & (maps.mask if maps.estimated is None else maps.mask | maps.estimated)
    angle = angles_deg(maps.normal, truth["normal"])[solved]
    albedo = height = np.nan
    if "diffuse_albedo" in truth:
        true = truth["diffuse_albedo"][solved]
        albedo = float(np.median(np.abs(maps.diffuse_albedo[solved] - true) / np.maximum(true, 1e-6)))
    if "height" in truth and maps.height is not None:
        difference = (maps.height - truth["height"])[solved]
        relief = np.ptp(truth["height"][solved])
        height = float(np.sqrt(np.mean((difference - difference.mean()) ** 2)) / relief)
    return SolveError(covered, float(angle.mean()), float(np.median(angle)), albedo, height)


def sample_errors(name: str, method: Method) -> SolveError:
    """Solve a shipped sample and return its errors."""
    with tempfile.TemporaryDirectory() as folder:
        capture = SAMPLES / name
        maps = solve(SolveRequest(capture=capture, out=Path(folder), method=method, cache=Path(folder))).maps
        return compare(maps, read_truth(capture / "truth.exr"), Capture.open(capture).mask())


def diligent_errors(source: Path, method: Method) -> SolveError:
    """Solve a DiLiGenT object and return the errors of its normals."""
    with tempfile.TemporaryDirectory() as folder:
        capture = Path(folder) / "capture"
        diligent.import_folder(source, capture)
        maps = solve(SolveRequest(capture=capture, out=Path(folder), method=method)).maps
        truth = {"normal": np.load(source / "normal_gt.npz")["normal"]}
        return compare(maps, truth, Capture.open(capture).mask())
