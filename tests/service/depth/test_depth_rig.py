"""The committed capture of a path-traced projector and camera, against its ground truth (samples/README.md)."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.rig import read_truth
from service.depth.depth import depth
from service.requests.depth import DepthRequest

RIG = Path(__file__).parents[3] / "samples" / "rig"


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    out = tmp_path_factory.mktemp("rig")
    return depth(DepthRequest(capture=RIG, out=out, cache=out, device="cpu"))


TRUTH = read_truth(RIG / "truth.exr")


def test_lit_pixels_are_decoded_and_shadow_is_refused(solved):
    assert solved.maps.mask[TRUTH.lit].mean() >= 0.97 and solved.maps.mask[TRUTH.shadow].mean() < 0.10


def test_columns_and_depths_are_those_of_the_geometry(solved):
    clean = TRUTH.clean & solved.maps.mask
    column = np.abs(solved.maps.projector_u - TRUTH.u)[clean]
    assert column.max() < 8  # half a period: no wrong unwrap
    assert np.median(column) <= 0.014
    assert np.median(np.abs(solved.maps.depth - TRUTH.depth)[clean]) <= 0.30e-3


def test_interreflection_bends_the_phase_only_in_the_groove(solved):
    column = np.abs(solved.maps.projector_u - TRUTH.u)
    open_ground, groove = (column[part & solved.maps.mask] for part in (TRUTH.clean & ~TRUTH.groove, TRUTH.groove))
    assert np.percentile(open_ground, 95) < 0.02
    assert np.median(groove) > 5 * np.median(open_ground)  # the sample has the light between its walls
    assert np.median(groove) < 0.1


def test_light_that_bounces_between_matt_walls_is_not_taken_for_light_below_the_surface(solved):
    """A quarter of the groove's light comes from its other wall."""
    assert not solved.warnings and np.median(solved.maps.confidence[TRUTH.clean]) > 0.4  # 0.12 where it is
