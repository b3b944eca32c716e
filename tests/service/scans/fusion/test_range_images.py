"""Prepared scans: what of their files is in memory."""

from pathlib import Path

import numpy as np
import pytest

from service.scans.fusion import range_images
from service.scans.fusion.fuse import FuseResult
from service.scans.fusion.range_images import prepare_scan
from service.scans.points.ply_points import read_ply_points
from service.scans.read import read_scan
from stage.sets.scan_set import read_scan_set
from tests.scenes.register import fuse_scans
from tests.scenes.statue import colour_of, distance, turntable, write_scans

pytestmark = pytest.mark.long
STATUS = Path("/proc/self/status")
SHAPE = 256, 320
"""As large that the arrays, some 50 bytes a pixel, are far more than what the kernel counts late."""


def mapped_mib() -> float:
    """Memory of mapped files that this process holds."""
    return next(int(line.split()[1]) for line in STATUS.read_text().splitlines() if line.startswith("RssFile")) / 1024


@pytest.mark.skipif(not STATUS.exists(), reason="memory is told by /proc")
def test_what_is_released_leaves_memory_and_can_be_read_again(tmp_path):
    file, listed = read_scan_set(write_scans(tmp_path / "scans", turntable(2, SHAPE[::-1])))
    (tmp_path / "arrays").mkdir()
    scan = prepare_scan(read_scan(file, listed, 0), tmp_path / "arrays")
    before = mapped_mib()
    sums = [float(np.sum(array, dtype=np.float64)) for array in (*scan.image[:5], scan.layers, scan.feather)]
    held = mapped_mib()
    scan.release()
    assert held - before > 3 and mapped_mib() - before < 1
    assert [float(np.sum(array, dtype=np.float64)) for array in (*scan.image[:5], scan.layers, scan.feather)] == sums


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
            found.append(fuse_scans(file, folder / str(least), voxel_m=VOXEL))
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
