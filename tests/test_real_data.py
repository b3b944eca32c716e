"""Real captures with ground truth, where they are at hand: the folder named by RELIT_TEST_DATA, else ../shared/data."""

import os
from pathlib import Path

import numpy as np
import pytest

from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve
from stage.capture import Capture
from stage.importers import diligent
from tests.scenes.captures import angles_degrees

DATA = Path(os.environ.get("RELIT_TEST_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))

pytestmark = pytest.mark.skipif(not (DATA / "diligent_ball").is_dir(), reason=f"no DiLiGenT objects in {DATA} (RELIT_TEST_DATA)")

LAMBERT_DEGREES = {"ball": 4.17, "cat": 8.43}
"""Mean angular error of plain least squares on BT.601 grey, at the resolution of these objects."""
ROBUST_DEGREES = {"ball": 2.1, "cat": 7.1}
"""What position thresholding reaches, not to be lost again."""


@pytest.fixture(scope="module", params=["ball", "cat"])
def imported(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    diligent.import_folder(DATA / f"diligent_{request.param}", folder)
    return request.param, folder


def mean_error(name, folder, method) -> float:
    maps = solve(SolveRequest(capture=folder, out=folder / method, method=method)).maps
    truth = np.load(DATA / f"diligent_{name}" / "normal_gt.npz")["normal"]
    mask = Capture.open(folder).mask()
    return float(angles_degrees(np.where(maps.mask[..., None], maps.normal, (0, 0, 1)), truth)[mask].mean())


def test_least_squares_is_the_published_figure(imported):
    name, folder = imported
    assert mean_error(name, folder, Method.LAMBERT) == pytest.approx(LAMBERT_DEGREES[name], abs=0.02)


def test_robust_is_better(imported):
    name, folder = imported
    assert mean_error(name, folder, Method.ROBUST) <= ROBUST_DEGREES[name]
