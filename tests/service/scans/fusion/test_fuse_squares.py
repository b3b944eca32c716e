"""relit fuse with voxels much larger than pixels: squares of pixels give a better surface from a part of the data."""

import numpy as np
import pytest

from service.requests.register import FuseRequest
from service.scans.fusion import range_images
from service.scans.fusion.fuse import FuseResult, fuse
from service.scans.points.ply_points import read_ply_points
from tests.scenes.statue import colour_of, distance, turntable, write_scans

pytestmark = pytest.mark.long
VOXEL = 26e-3
"""Somewhat more than six pixels."""


@pytest.fixture(scope="module")
def both(tmp_path_factory) -> list[FuseResult]:
    """Fused with squares of pixels and with the pixels as they are."""
    folder = tmp_path_factory.mktemp("squares")
    file = write_scans(folder, turntable(9, (320, 240)), coloured=True)
    found = []
    with pytest.MonkeyPatch.context() as patch:
        for least in (range_images.LEAST_SQUARES, 1000):
            patch.setattr(range_images, "LEAST_SQUARES", least)
            found.append(fuse(FuseRequest(scan_set=file, out=folder / str(least), voxel_m=VOXEL, texture=False, device="cpu")))
    return found


def test_the_surface_is_better(both):
    squares, pixels = (read_ply_points(found.mesh_path).points for found in both)
    assert [{scan["square_px"] for scan in found.facts["scans"]} for found in both] == [{3}, {1}]
    off = [np.median(np.abs(distance(points))) for points in (squares, pixels)]
    assert off[0] < off[1]  # a voxel reads four pixels of a view, and all of their squares
    assert both[0].facts["area_m2"] == pytest.approx(both[1].facts["area_m2"], rel=0.1)  # squares at edges are left out
    assert all(scan["fused"] for scan in both[0].facts["scans"])
    assert both[0].facts["scans"][0]["pixels"] < 0.15 * both[1].facts["scans"][0]["pixels"]


def test_colours_are_means_of_squares(both):
    ply = read_ply_points(both[0].mesh_path)
    assert ply.colours is not None
    assert np.percentile(np.abs(ply.colours.astype(int) - colour_of(ply.points)).max(axis=1), 90) < 16  # 7 of 255 over a pixel
