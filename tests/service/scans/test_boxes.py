"""Boxes of a fusion: bricks that many pixels see are cut, and the surface stays the same."""

import numpy as np
import pytest

from kernels.fusion.bricks import BLOCK, BRICK_VOXELS
from service.reporting.progress import Timings
from service.requests.fuse import FuseRequest
from service.scans import boxes
from service.scans.fuse import fuse
from service.scans.fused_bricks import fused_bricks
from stage.scans.ply_points import read_ply_points
from tests.scenes.statue import turntable, write_scans
from tests.service.scans.mesh_files import read_faces

VOXEL = 3e-3
"""The whole statue has some 12 000 pixels in a scan, and lies in bricks of 0.77 m."""
FEW = 2500


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return write_scans(tmp_path_factory.mktemp("boxes"), turntable(5, (128, 96)), coloured=True)


def fused(file, out):
    found = fuse(FuseRequest(scan_set=file, out=out, voxel_m=VOXEL, texture=False, device="cpu"))
    ply = read_ply_points(found.mesh_path)
    return found.facts, ply, ply.points[read_faces(found.mesh_path)].reshape(-1, 9)


def test_boxes_of_a_few_pixels_give_the_surface_of_whole_bricks(file, tmp_path, monkeypatch):
    facts, whole, corners = fused(file, tmp_path / "whole")
    monkeypatch.setattr(boxes, "MOST_PIXELS", FEW)
    cut_facts, cut, cut_corners = fused(file, tmp_path / "cut")
    assert cut_facts["scans"] == facts["scans"] and cut_facts["holes"]["open_edges"] == facts["holes"]["open_edges"]
    ours, theirs = (np.lexsort(ply.points.T) for ply in (cut, whole))
    assert np.array_equal(cut.points[ours], whole.points[theirs]) and np.array_equal(cut.sigma[ours], whole.sigma[theirs])
    assert np.array_equal(np.unique(cut_corners, axis=0), np.unique(corners, axis=0))
    # where boxes meet, a vertex is blended by the angle to the faces that one of them has: 64 of 135 000 differ, one by more than 2
    differ = np.abs(cut.colours[ours].astype(int) - whole.colours[theirs]).max(axis=1)
    assert (differ > 0).mean() < 2e-3 and (differ > 2).mean() < 1e-4


def test_no_box_is_seen_by_more_pixels_than_allowed_unless_it_is_the_smallest(file, tmp_path, monkeypatch):
    monkeypatch.setattr(boxes, "MOST_PIXELS", FEW)
    with fused_bricks(FuseRequest(scan_set=file, out=tmp_path, voxel_m=VOXEL, device="cpu"), Timings()) as known:
        scans = [known.scan(place) for place in range(len(known.used))]
        rng = np.random.default_rng(0)
        places = rng.integers(-BRICK_VOXELS, BRICK_VOXELS, (4000, 3))
        found = list(boxes.boxes(places, scans, VOXEL, np.zeros(3)))
    sides = {box.blocks for box in found}
    assert len(sides) > 1 and min(sides) == boxes.LEAST_BLOCKS
    for box in found:
        assert sum(each.pixels for each in box.watching) <= FEW or box.blocks == boxes.LEAST_BLOCKS
        inside = places[box.chosen] - box.corner
        assert len(inside) and inside.min() >= 0 and inside.max() < box.blocks * BLOCK
    chosen = np.concatenate([box.chosen for box in found])
    assert len(np.unique(chosen)) == len(chosen)
    seen = [bool(boxes.watching_views(list(enumerate(scans)), place * VOXEL, (place + 1) * VOXEL)) for place in places]
    assert set(np.flatnonzero(seen)) <= set(chosen.tolist())
