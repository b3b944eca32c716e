"""relit fuse: from a scan set to a mesh, measured against the closed form of the statue; all vertices count."""

import json
import sys

import numpy as np
import pytest

from service.errors import AssetError, RequestError
from service.requests.register import FuseRequest
from service.scans.points.ply_points import read_ply_faces, read_ply_points
from stage.capture.camera import Camera
from stage.results.depth_maps import DepthMaps
from stage.results.depth_normals import depth_normals
from stage.results.maps import SurfaceMaps
from tests.scenes.in_front import gradient, unit
from tests.scenes.register import fuse_scans
from tests.scenes.statue import SIGMA, colour_of, distance, shoot, shoot_parallel, turntable, write_scans
from tests.service.scans.mesh_files import read_faces

pytestmark = pytest.mark.long
VOXEL = 4e-3
OFF = 5e-3
"""By how far one scan is put beside its place."""
ON_MAP = np.zeros((4, 4))
ON_MAP[:3, 3] = 450123, 5201234, 431
"""Metres from a statue at the origin to one in coordinates of a map."""


@pytest.fixture(scope="module")
def shots():
    return turntable(18, (160, 120))


@pytest.fixture(scope="module")
def fused(tmp_path_factory, shots):
    folder = tmp_path_factory.mktemp("statue")
    file = write_scans(folder, shots, coloured=True)
    return fuse_scans(file, folder / "out", voxel_m=VOXEL)


def test_the_fused_statue_is_better_than_its_scans(fused):
    ply = read_ply_points(fused.mesh_path)
    error = distance(ply.points)
    assert np.median(np.abs(error)) <= 0.15e-3  # pixels of 7.5 mm see chords; the noise of one scan is 0.25 mm
    assert np.percentile(np.abs(error), 90) < 2 * SIGMA + 1e-3  # edges are as sharp as pixels
    assert abs(np.median(error)) < 0.1e-3
    assert all(scan["fused"] for scan in fused.facts["scans"]) and not [w for w in fused.warnings if "pose" in w]
    faces = read_faces(fused.mesh_path)
    assert faces.max() == len(ply.points) - 1 and len(faces) == fused.facts["faces"]
    assert fused.facts["holes"]["edges_of_more_than_two_faces"] == 0


def test_vertices_have_the_colours_of_the_places_that_they_show(fused):
    ply = read_ply_points(fused.mesh_path)
    assert ply.colours is not None and ply.normals is not None
    off = np.abs(ply.colours.astype(int) - colour_of(ply.points)).max(axis=1)
    assert np.percentile(off, 95) < 12  # over a pixel of 7.5 mm the colour changes by 7 of 255
    true = unit(gradient(distance, ply.points))
    assert np.median((ply.normals * true).sum(axis=1)) > np.cos(np.radians(5))  # 25 pixels with .25 mm of noise give 1°, bends more


def test_the_report_lists_the_holes_and_what_was_seen(fused):
    facts = json.loads(fused.report_path.read_text())
    holes = facts["holes"]
    assert holes["count"] > 0 and holes["longest"][0]["length_m"] >= holes["longest"][-1]["length_m"]
    below = [hole for hole in holes["longest"] if hole["centre_m"][1] < -0.45]  # the foot stands on the table
    assert max(hole["length_m"] for hole in below) > 0.5
    assert facts["area_share_seen_by"]["1"] > facts["area_share_seen_by"]["5"] > 0
    assert {scan["name"] for scan in facts["scans"]} == {f"view {k}" for k in range(18)}
    assert all(0.3 < scan["residual_median_sigmas"] < 1.2 for scan in facts["scans"])


def test_a_scan_at_a_wrong_place_is_left_out_and_named(tmp_path, shots):
    poses = [shot.world_from_camera.copy() for shot in shots]
    poses[4][:3, 3] += OFF * poses[4][:3, 0]
    file = write_scans(tmp_path, shots, poses=poses)
    result = fuse_scans(file, tmp_path / "out", voxel_m=VOXEL)
    about = [warning for warning in result.warnings if "its pose is wrong" in warning]
    assert len(about) == 1 and about[0].startswith("scan view 4: lies ") and "left out" in about[0]
    assert [scan["name"] for scan in result.facts["scans"] if not scan["fused"]] == ["view 4"]
    found = result.facts["scans"][4]["displacement_m"]
    assert 0.2 * OFF < found < OFF  # along the normals, of which only those to the side are moved


def test_a_scan_that_is_there_twice_is_fused_once(tmp_path, shots):
    """The mesh is to the last byte that of the set without the second one, its σ with it."""
    file = write_scans(tmp_path / "once", shots[:3])
    once = fuse_scans(file, tmp_path / "once" / "out", voxel_m=2 * VOXEL)
    listed = json.loads(file.read_text())
    listed["scans"].append({**listed["scans"][1], "name": "again"})
    file.write_text(json.dumps(listed))
    twice = fuse_scans(file, tmp_path / "twice", voxel_m=2 * VOXEL)
    assert [w for w in twice.warnings if w not in once.warnings] == [
        "scan again: holds no points but those of view 1, and counts once"]
    assert twice.mesh_path.read_bytes() == once.mesh_path.read_bytes()


def test_a_scan_without_overlap_is_named(tmp_path, shots):
    poses = [shot.world_from_camera.copy() for shot in shots[:3]]
    poses[2][0, 3] += 3.0
    file = write_scans(tmp_path, shots[:3], poses=poses)
    result = fuse_scans(file, tmp_path / "out", voxel_m=VOXEL)
    (warning,) = (warning for warning in result.warnings if "in common" in warning)
    assert warning.startswith("scan view 2: ")


def test_holes_of_a_right_scan_do_not_accuse_its_pose(tmp_path, shots):
    """A scan that is alone cannot lie elsewhere."""
    random = np.random.default_rng(0)
    alone = shots[0]._replace(mask=shots[0].mask & (random.random(shots[0].mask.shape) > 0.1))
    (warning,) = fuse_scans(write_scans(tmp_path, [alone]), tmp_path / "out").warnings
    assert "borders and holes" in warning and "pose" not in warning


def test_a_mesh_without_holes_says_what_is_invented(tmp_path, shots):
    file = write_scans(tmp_path, shots[::5], coloured=True)
    measured, closed = (fuse_scans(file, tmp_path / close, voxel_m=2 * VOXEL, close=close) for close in ("none", "all"))
    assert closed.facts["watertight"] and closed.facts["holes"]["count"] > 5
    before, after, faces = read_ply_points(measured.mesh_path), read_ply_points(closed.mesh_path), read_faces(closed.mesh_path)
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    assert np.array_equal(after.points[:len(before.points)], before.points) and np.isfinite(after.sigma).all()
    assert closed.facts["vertices"] == len(after.kept) == after.kept.sum() + closed.facts["holes"]["closed"]["vertices"]
    assert read_ply_faces(closed.mesh_path, after.kept).max() < len(after.points)
    corners = faces[~after.kept[faces].all(axis=1)]
    assert len(corners) and closed.facts["holes"]["closed"]["area_m2"] > 0.01  # the statue of 1 m stood on a table that no scan saw
    with pytest.raises(ValueError, match="close: is all, but tiles"):
        FuseRequest(scan_set=file, out=tmp_path / "tiles", close="all", tiles=True)


def test_bad_input_is_refused_in_a_sentence(tmp_path, shots, monkeypatch):
    def refused(words, scan_set, **changes):
        with pytest.raises((RequestError, AssetError), match=words):
            fuse_scans(scan_set, tmp_path / "out", **changes)

    monkeypatch.setitem(sys.modules, "xatlas", None)
    refused(r"xatlas: pip install 'relit\[scans\]', or give --no-texture", write_scans(tmp_path, shots[:1]), texture=True)
    file = write_scans(tmp_path, shots[:2], poses=[shots[0].world_from_camera, None])
    refused(r"scans\[1\] \(view 1\): scan_to_world is missing: run relit", file)
    pair = [shots[0], shoot(shots[0].world_from_camera, shots[0].side, shots[0].focal, seed=5)]
    refused("the poses contradict each other: run relit register first",
            write_scans(tmp_path, pair, poses=[pair[0].world_from_camera, pair[0].world_from_camera @ _moved(OFF)]))
    around = shots[::6]
    inverted = write_scans(tmp_path, around, poses=[np.linalg.inv(shot.world_from_camera) for shot in around])
    on_map = write_scans(tmp_path / "map", shots[:2], poses=[shot.world_from_camera + ON_MAP for shot in shots[:2]])
    refused("scans lie 5.2e[+]06 m from the origin, where the floats of a mesh hold places to 0.5 m only: subtract one", on_map)
    refused("the poses are world_to_scan: read so, .* and 0 and 0 as they are: write them as scan_to_world", inverted)
    apart = [shot.world_from_camera + 9 * number * np.outer(np.eye(4)[0], np.eye(4)[3]) for number, shot in enumerate(around)]
    refused(f"no two of the {len(around)} scans have a surface in common: look whether lengths are in metres",
            write_scans(tmp_path, around, poses=apart))
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("mixed", [False, True])
def test_range_images_of_orthographic_cameras_are_fused(tmp_path, shots, mixed):
    """Cameras whose frame lies in the middle of the statue, so that half of the depths are below 0; every third is perspective if mixed."""
    pixel = 7.5e-3
    poses = [shot.world_from_camera.copy() for shot in shots[::2]]
    parallel = []
    for number, pose in enumerate(poses):
        pose[:3, 3] = [0, 0, 0]
        parallel.append(shoot_parallel(pose, (160, 120), pixel, seed=number))
    file = write_scans(tmp_path, shots[::2], poses=[shot.world_from_camera if mixed and number % 3 == 0 else poses[number]
                                                    for number, shot in enumerate(shots[::2])])
    camera = Camera(projection="orthographic", resolution=(120, 160), pixel_size_m=pixel)
    for number, shot in enumerate(parallel):
        if not mixed or number % 3:
            DepthMaps(camera=camera, mask=shot.mask, depth=shot.depth.astype(np.float32),
                      sigma=np.full(shot.side, SIGMA, dtype=np.float32)).write(tmp_path / f"scan{number}" / "depth.exr")
    result = fuse_scans(file, tmp_path / "out", voxel_m=VOXEL)
    error = distance(read_ply_points(result.mesh_path).points)
    assert np.median(np.abs(error)) <= 0.2e-3 and abs(np.median(error)) < 0.1e-3  # half as many views as above
    assert np.percentile(np.abs(error), 90) < 2 * SIGMA + 1e-3
    assert all(scan["fused"] for scan in result.facts["scans"]) and not [w for w in result.warnings if "pose" in w]
    assert all(0.3 < scan["residual_median_sigmas"] < 1.2 for scan in result.facts["scans"])
    assert result.facts["area_share_seen_by"]["2"] > 0.5


def _moved(by: float) -> np.ndarray:
    pose = np.eye(4)
    pose[2, 3] = by
    return pose


def test_joined_maps_replace_the_depth_by_a_better_one(tmp_path):
    """Depths of 2 mm of noise beside heights of .1 mm, as `relit join` leaves them."""
    noise, joined = 2e-3, 1e-4
    shots = turntable(6, (160, 120), sigma=noise)
    better = turntable(6, (160, 120), sigma=joined, seed=50)
    maps = []
    for shot in better:
        camera = Camera(projection="perspective", resolution=shot.side[::-1], focal_px=(shot.focal, shot.focal))
        depth = np.where(shot.mask, shot.depth, 1).astype(np.float32)
        maps.append(SurfaceMaps(camera=camera, mask=shot.mask, normal=depth_normals(depth, shot.mask, camera, radius=2), height=-depth,
                                height_sigma=np.full(shot.side, joined, dtype=np.float32)))
    found = [fuse_scans(write_scans(tmp_path / name, shots, sigma=noise, maps=given), tmp_path / name / "out", voxel_m=VOXEL)
             for name, given in (("depth", None), ("joined", maps))]
    error = [np.median(np.abs(distance(read_ply_points(result.mesh_path).points))) for result in found]
    assert error[1] < 0.4 * error[0]  # pixels of 7.5 mm see chords, which no noise explains
    assert found[1].facts["sigma_m"]["median"] < 0.7 * found[0].facts["sigma_m"]["median"]
