"""Point sets that are in a set twice, written in another way, count once; two scans of one thing count twice."""

import numpy as np
import pytest

from service.scans.duplicates import distinct
from stage.formats.ply import PointCloud, write_ply
from stage.sets.scan_set import read_scan_set
from tests.scenes.statue import write_set

SIGMA_M = 1e-4


def surface(seed: int) -> np.ndarray:
    """A grid of points of a wavy surface 1 m away, of which noise moves the depths."""
    x, y = (values.ravel() for values in np.meshgrid(np.linspace(-0.5, 0.5, 60), np.linspace(-0.5, 0.5, 60)))
    noise = SIGMA_M * np.random.default_rng(seed).normal(size=x.size)
    return np.column_stack([x, y, 0.05 * np.sin(9 * x) * np.cos(7 * y) - 1 + noise])


def ascii_ply(points: np.ndarray) -> str:
    rows = "\n".join(" ".join(f"{value:.6g}" for value in point) for point in points)
    return f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n" + "".join(f"property float {name}\n" for name in "xyz") + \
        f"end_header\n{rows}\n"


@pytest.mark.parametrize(("again", "keys", "same"), [
    (surface(0)[::-1], {}, True), (1e3 * surface(0), {"unit": "mm"}, True), (1e3 * surface(0), {}, False), (surface(1), {}, False),
    (surface(0), {"viewpoint_m": [0, 0, 1]}, False), (surface(0)[::3], {}, True), (surface(1)[::3], {}, False)],
    ids=["order", "unit", "another size", "another scan", "another viewpoint", "thinned", "another scan, thinned"])
def test_points_that_are_written_anew_count_once(tmp_path, again, keys, same):
    points = surface(0)
    write_ply(PointCloud(points.astype(np.float32), np.zeros(points.shape, np.uint8)), tmp_path / "first.ply")
    (tmp_path / "again.ply").write_text(ascii_ply(again))
    write_set(tmp_path, [{"name": "first", "path": "first.ply"}, {"name": "again", "path": "again.ply", **keys}])
    found = distinct(*read_scan_set(tmp_path))
    assert found.same_as == ({"again": "first"} if same else {})
    assert len(found.scans.scans) == (1 if same else 2)
    assert not same or found.warnings() == ["scan again: holds no points but those of first, and counts once"]


def test_the_whole_scan_is_kept_of_its_thinned_copies(tmp_path):
    """A copy that is listed before the scan, and one of the copy."""
    sets = {"thin": surface(0)[::2], "whole": surface(0), "thinner": surface(0)[::6], "other": surface(1)}
    for name, points in sets.items():
        (tmp_path / f"{name}.ply").write_text(ascii_ply(points))
    write_set(tmp_path, [{"name": name, "path": f"{name}.ply"} for name in sets])
    found = distinct(*read_scan_set(tmp_path))
    assert found.same_as == {"thin": "whole", "thinner": "whole"} and [scan.name for scan in found.scans.scans] == ["whole", "other"]
