"""Real captures with ground truth, where they are at hand: the folder named by RELIT_TEST_DATA."""

import os
from pathlib import Path

import numpy as np
import pytest

from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve
from stage.capture.capture import Capture
from stage.formats import images
from stage.importers import diligent
from stage.results.maps import SurfaceMaps
from tests.scenes.captures import angles_degrees

DATA = Path(os.environ.get("RELIT_TEST_DATA", "nowhere"))

pytestmark = [pytest.mark.long,
              pytest.mark.skipif(not (DATA / "diligent_ball").is_dir(), reason=f"no DiLiGenT objects in {DATA} (RELIT_TEST_DATA)")]

LEAST_SQUARES_DEGREES = {"ball": 4.17, "cat": 8.46}
"""Mean angular error of plain least squares over every reading, at the resolution of these objects, as published."""
ROBUST_DEGREES = {"ball": 2.1, "cat": 7.1}
"""What position thresholding reaches, not to be lost again."""


@pytest.fixture(scope="module", params=["ball", "cat"])
def imported(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    diligent.import_folder(DATA / f"diligent_{request.param}", folder)
    return request.param, folder


def mean_error(name, folder, method) -> float:
    """Return the mean angular error in degrees of every normal inside the mask, also where it is unsure; none may be missing."""
    solve(SolveRequest(capture=folder, out=folder / method, method=method))
    maps = SurfaceMaps.read(folder / method / "maps.exr", unsure=True)
    mask = Capture.open(folder).mask()
    assert maps.normal[mask].any(axis=-1).all()
    return float(angles_degrees(maps.normal, np.load(DATA / f"diligent_{name}" / "normal_gt.npz")["normal"])[mask].mean())


def least_squares_error(name, *, every_reading: bool) -> float:
    """Return the mean angular error in degrees of NumPy's least squares on BT.601 grey; else without readings of zero and full scale."""
    source = DATA / f"diligent_{name}"
    mask = images.read_pixels(source / "mask.png").max(axis=-1) > 0.5
    recorded = np.stack([images.read_pixels(path)[mask] for path in sorted(source.glob("[0-9]*.png"))])
    directions = np.loadtxt(source / "light_directions.txt")
    grey = (recorded / np.loadtxt(source / "light_intensities.txt")[:, None]) @ (0.299, 0.587, 0.114)
    used = np.ones(grey.shape, bool) if every_reading else (grey > 0) & (recorded < 1).all(axis=-1)
    normals = np.stack([np.linalg.lstsq(directions[u], g[u], rcond=None)[0] for u, g in zip(used.T, grey.T, strict=True)])
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return float(angles_degrees(normals, np.load(source / "normal_gt.npz")["normal"][mask]).mean())


def test_least_squares_is_the_published_figure(imported):
    """The published figure, by NumPy over every reading; ours leaves out readings of zero and of full scale, and so does its twin."""
    name, folder = imported
    assert least_squares_error(name, every_reading=True) == pytest.approx(LEAST_SQUARES_DEGREES[name], abs=0.01)
    # single precision and a regularised pixel here and there; leaving readings out moves the figures by 0.03° to 0.4°
    assert mean_error(name, folder, Method.LAMBERT) == pytest.approx(least_squares_error(name, every_reading=False), abs=0.005)


def test_robust_is_better(imported):
    name, folder = imported
    assert mean_error(name, folder, Method.ROBUST) <= ROBUST_DEGREES[name]
