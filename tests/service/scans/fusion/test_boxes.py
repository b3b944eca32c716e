"""Boxes of a fusion: bricks that many pixels see are cut, and the surface stays the same."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kernels.device import to_numpy
from kernels.fusion.bricks import BLOCK, BRICK, BRICK_VOXELS, find_blocks
from kernels.fusion.views import RangeImage, upload_views
from service.reporting.progress import Timings
from service.requests.register import FuseRequest
from service.scans.fusion import boxes
from service.scans.fusion.fused_bricks import fused_bricks
from service.scans.fusion.fused_surface import places_near
from service.scans.fusion.range_images import PreparedScan, focal_of, prepare_scan
from service.scans.points.ply_points import read_ply_points
from stage.capture.camera import Camera, Distortion
from tests.marks import first_short
from tests.scenes.register import fuse_scans, scan_with
from tests.scenes.statue import shoot, shoot_parallel, turntable, write_scans
from tests.service.scans.mesh_files import read_faces

VOXEL = 3e-3
"""The whole statue has some 12 000 pixels in a scan, and lies in bricks of 0.77 m."""
FEW = 2500


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return write_scans(tmp_path_factory.mktemp("boxes"), turntable(5, (128, 96)), coloured=True)


def fused(file, out):
    found = fuse_scans(file, out, voxel_m=VOXEL, close="none")
    ply = read_ply_points(found.mesh_path)
    return found.facts, ply, ply.points[read_faces(found.mesh_path)].reshape(-1, 9)


@pytest.mark.long
def test_boxes_of_a_few_pixels_give_the_surface_of_whole_bricks(file, tmp_path, monkeypatch):
    facts, whole, corners = fused(file, tmp_path / "whole")
    monkeypatch.setattr(boxes, "MOST_PIXELS", FEW)
    cut_facts, cut, cut_corners = fused(file, tmp_path / "cut")
    assert cut_facts["scans"] == facts["scans"] and cut_facts["holes"]["open_edges"] == facts["holes"]["open_edges"]
    ours, theirs = (np.lexsort(ply.points.T) for ply in (cut, whole))
    assert np.array_equal(cut.points[ours], whole.points[theirs])
    assert np.array_equal(np.unique(cut_corners, axis=0), np.unique(corners, axis=0))
    # where boxes meet, a vertex is blended by the angle to the faces that one of them has: 64 of 135 000 differ, one by more than 2
    differ = np.abs(cut.colours[ours].astype(int) - whole.colours[theirs]).max(axis=1)
    assert (differ > 0).mean() < 2e-3 and (differ > 2).mean() < 1e-4
    assert (cut.sigma[ours] != whole.sigma[theirs]).mean() < 2e-3  # the views that see it too, over which errors average


@pytest.mark.long
def test_no_box_is_seen_by_more_pixels_than_allowed_unless_it_is_the_smallest(file, tmp_path, monkeypatch):
    monkeypatch.setattr(boxes, "MOST_PIXELS", FEW)
    with fused_bricks(FuseRequest(scan_set=file, out=tmp_path, voxel_m=VOXEL, device="cpu"), Timings()) as known:
        scans = [known.scan(place) for place in range(len(known.used))]
        rng = np.random.default_rng(0)
        places = rng.integers(-BRICK_VOXELS, BRICK_VOXELS, (800, 3))
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


SIZE = 80, 60
CAMERAS = {
    "pinhole": Camera(projection="perspective", resolution=SIZE, focal_px=(70.0, 72.0), principal_px=(37.0, 31.0)),
    "barrel": Camera(projection="perspective", resolution=SIZE, focal_px=(70.0, 72.0),
                     distortion=Distortion(model="brown_conrady", k=(-0.15, 0.0, 0.0), p=(0.004, 0.0))),
    "parallel": Camera(projection="orthographic", resolution=SIZE, pixel_size_m=0.02),
}


def outline(camera, pose):
    """A scan of a camera that stands at a pose, with nothing measured."""
    nothing = np.zeros((camera.height, camera.width), dtype=np.float32)
    image = RangeImage(nothing, nothing, nothing, nothing, nothing, np.linalg.inv(pose), focal_of(camera), camera.principal_point,
                       orthographic=camera.projection == "orthographic")
    return PreparedScan("scan", image, camera, (), nothing, nothing, False)


@first_short("camera", CAMERAS.values(), ids=CAMERAS)
def test_a_window_holds_all_that_its_camera_sees_of_a_box_and_little_else(camera):
    rng = np.random.default_rng(3)
    seen_pixels = window_pixels = 0
    for _ in range(200):
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
        pose[:3, 3] = rng.normal(size=3)
        scan = outline(camera, pose)
        low = rng.uniform(-1.5, 1.0, 3)
        high = low + rng.uniform(0.2, 1.0, 3)
        points = rng.uniform(low, high, (20_000, 3))
        there = (points - pose[:3, 3]) @ pose[:3, :3]
        if camera.projection == "perspective":
            there = there[there[:, 2] < -1e-3]
            there = there[np.hypot(there[:, 0], there[:, 1]) < -1.2 * there[:, 2]]  # where the distortion is one to one
        u, v = camera.image_coordinates(there)
        inside = (u >= 0) & (u < SIZE[0]) & (v >= 0) & (v < SIZE[1])
        window = [each.window for each in boxes.watching_views([(0, scan)], low, high)]
        if not inside.any():
            window_pixels += sum((bottom - top) * (right - left) for top, bottom, left, right in window)
            continue
        (top, bottom, left, right), = window
        assert top <= v[inside].min() and v[inside].max() <= bottom and left <= u[inside].min() and u[inside].max() <= right
        seen_pixels += (np.ptp(u[inside]) + 1) * (np.ptp(v[inside]) + 1)
        window_pixels += (bottom - top) * (right - left)
    # a margin of WINDOW_PIXELS around a window of some 40 pixels adds half, and the box has corners that no ray of the image meets
    assert window_pixels < 2 * seen_pixels, window_pixels / seen_pixels


def test_a_box_beside_a_camera_is_not_seen():
    scan = outline(CAMERAS["pinhole"], np.eye(4))
    assert boxes.watching_views([(0, scan)], np.array([4.0, -1.0, -0.5]), np.array([5.0, 1.0, 0.5])) == []
    (_, _, window), = boxes.watching_views([(0, scan)], np.array([-0.5, -0.5, -0.5]), np.array([0.5, 0.5, 0.5]))
    assert window == (0, SIZE[1], 0, SIZE[0])


@pytest.mark.long
@pytest.mark.parametrize("parallel", [False, True], ids=["perspective", "orthographic"])
def test_the_places_of_a_scan_hold_all_blocks_that_it_marks_whatever_its_noise(tmp_path, parallel):
    """A pixel in fifty is a hundred times as noisy as the others, and one knows nothing: it alone reaches through the whole scene."""
    rng = np.random.default_rng(0)
    pose = turntable(1, (96, 72))[0].world_from_camera
    shot = shoot_parallel(pose, (96, 72), 0.015) if parallel else shoot(pose, (96, 72), 130.0)
    sigma = np.where(rng.random(shot.side) < 0.02, 100.0, 1.0) * 2e-4 * rng.lognormal(0, 0.5, shot.side)
    sigma[tuple(np.argwhere(shot.mask)[1000])] = 50.0
    camera = (Camera(projection="orthographic", resolution=(72, 96), pixel_size_m=0.015) if parallel else
              Camera(projection="perspective", resolution=(72, 96), focal_px=(130.0, 130.0)))
    cloud = camera.points(-shot.depth)[shot.mask]
    scan = scan_with(cloud.astype(np.float32), sigma[shot.mask], camera=camera, pixels=np.flatnonzero(shot.mask), pose=pose)
    prepared = prepare_scan(scan, tmp_path)
    origin, voxel = np.array([0.011, -0.02, 0.007]), VOXEL
    near = {tuple(place) for place in places_near(prepared, origin, voxel)}
    views = upload_views([prepared.image], origin, device="cpu")
    marked = set()
    for brick in np.ndindex(4, 4, 4):
        corner = BRICK_VOXELS * (np.array(brick) - 2)
        found = find_blocks(views, voxel, tuple(int(x) for x in corner), BRICK, device="cpu")
        at = corner + BLOCK * to_numpy(found.place)
        marked |= {tuple(place) for place in boxes.LEAST_VOXELS * (at // boxes.LEAST_VOXELS)}
    inside = {place for place in near if all(-2 * BRICK_VOXELS <= x < 2 * BRICK_VOXELS for x in place)}
    assert len(marked) > 100 and marked <= near
    assert len(inside) < 5 * len(marked)  # what a box of a margin holds beside a surface, on both sides: 3.2 and 3.5
