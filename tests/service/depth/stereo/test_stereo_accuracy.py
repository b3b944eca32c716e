"""Depth of stereo against closed forms: σ, thin parts, noise, OpenCV's matcher on the same images, other rigs, and light frames of the
same capture."""

from functools import cache

import cv2
import numpy as np
import pytest

from kernels.status import Status
from service.depth.stereo.rectification import rectify
from stage.capture.camera import Camera, OtherCamera
from stage.results.maps import SurfaceMaps
from tests.reference import projector as reference
from tests.scenes import stereo as scenes
from tests.scenes.captures import edit_manifest, write_exr
from tests.scenes.depth import entry_of
from tests.scenes.projected import Ball, Wall, rectangle
from tests.scenes.stereo import CAMERA, OTHER, POSE
from tests.service.depth.stereo.test_stereo import pixels_off

pytestmark = pytest.mark.long
WALL, BALL = Wall((0.0, 0.05, -1.05), (0.25, -0.3, 1.0), 0.65), Ball((-0.06, 0.05, -0.88), 0.1, 0.55)
ABOVE = np.eye(4)
ABOVE[:3, 3] = (0.01, 0.1, 0.0)
TO_THE_LEFT = reference.look_at((-0.11, -0.01, 0.004), (0.01, 0.0, -1.0))


@cache
def seen(parts, textures=1, cell=3, camera=CAMERA, pose=None):
    patterns = [scenes.dots(200 + i, cell=cell) for i in range(textures)]
    return scenes.render(list(parts), patterns, camera, None if pose is None else np.array(pose), side=3)


def pair(parts, textures=1, cell=3, pose=POSE, other=OTHER):
    return seen(parts, textures, cell), seen(parts, textures, cell, other, tuple(map(tuple, np.asarray(pose).tolist())))


def recorded(view, seed, **noise):
    rng = np.random.default_rng(seed)
    return [scenes.recorded(image, rng, **noise) for image in view.images]


@pytest.mark.parametrize(("textures", "cell", "noise"), [
    (1, 3, {}), (3, 4, {"read": 0.008, "photons": 3000.0}), (2, 5, {"read": 0.001, "photons": 1e5})])
def test_sigma_is_that_of_the_true_error(relit, tmp_path, textures, cell, noise):
    left, right = pair((WALL, BALL), textures, cell)
    maps, *_ = relit.depth(scenes.write_pair(tmp_path, recorded(left, 1, **noise), recorded(right, 2, **noise)))
    off = np.abs(maps.depth - left.depth)[maps.mask]
    right_ones = np.abs(pixels_off(maps, left.depth))[maps.mask] < 1
    inside = [float((off <= times * maps.sigma[maps.mask])[right_ones].mean()) for times in (1, 2)]
    # 0.683 and 0.954 of a normal distribution; aliasing depends on the texture: coarse squares without noise have less than σ allows for
    assert 0.62 < inside[0] < 0.88 and 0.92 < inside[1] < 0.999
    assert (~right_ones).mean() < 0.005


def test_at_least_as_accurate_as_opencv_on_the_same_images(relit, tmp_path):
    left, right = pair((WALL, BALL))
    ours, theirs = recorded(left, 3), recorded(right, 4)
    maps, *_ = relit.depth(scenes.write_pair(tmp_path, ours, theirs))
    camera = Camera(projection="perspective", **entry_of(CAMERA))
    other = OtherCamera(name="right", **entry_of(OTHER), camera_from_other=POSE.tolist())
    geometry = rectify(camera, other, where="")
    images = [geometry.rows_of((image[0] / 65535).astype(np.float32), other=side)[0] for image, side in ((ours, False), (theirs, True))]
    width = min(image.shape[1] for image in images)
    bytes_of = [np.rint(255 * np.clip(image[:, :width] / np.percentile(image, 99.5), 0, 1)).astype(np.uint8) for image in images]
    matcher = cv2.StereoSGBM_create(minDisparity=-32, numDisparities=96, blockSize=5, P1=200, P2=800, disp12MaxDiff=1, uniquenessRatio=10,
                                    mode=cv2.STEREO_SGBM_MODE_HH)
    found = matcher.compute(*bytes_of).astype(np.float64) / 16
    x, y, ahead = geometry.positions(slice(0, camera.height))
    row, col = (np.clip(np.rint(at).astype(int), 0, size - 1) for at, size in ((y, found.shape[0]), (x, width)))
    reach = geometry.focal_px * geometry.baseline_m / ahead
    truth = reach / left.depth
    its = found[row, col] + geometry.offset_px - truth
    mine = np.where(maps.mask, reach / np.where(maps.mask, maps.depth, 1) - truth, np.inf)
    both = (found[row, col] > -32.5) & (np.abs(its) < 1) & (np.abs(mine) < 1)
    assert both.mean() > 0.5
    assert np.sqrt(np.mean(mine[both] ** 2)) < 0.5 * np.sqrt(np.mean(its[both] ** 2))
    known = found[row, col] > -32.5
    assert (maps.mask & (np.abs(mine) > 1)).sum() < 0.5 * (known & (np.abs(its) > 1)).sum()


@pytest.mark.parametrize("textures", [1, 4])
def test_thin_parts_are_right_or_refused(relit, tmp_path, textures):
    bars = [rectangle(x, (-0.3, 0.3), depth) for x, depth in (((-0.1, -0.095), 0.9), ((0.03, 0.045), 0.85), ((0.1, 0.14), 0.9))]
    left, right = pair((Wall((0, 0, -1.15), (0.05, 0.1, 1), 0.6), *bars), textures)
    maps, *_ = relit.depth(scenes.write_pair(tmp_path, recorded(left, 5), recorded(right, 6)))
    off = np.abs(pixels_off(maps, left.depth))
    for index, least in ((1, 0.0), (2, 0.0), (3, 0.5)):  # 2.3, 7.4 and 19 pixels wide
        inside = left.part == index
        assert (maps.mask & inside & (off > 1)).sum() < 0.03 * inside.sum()
        assert (maps.mask & inside).sum() >= least * inside.sum()
    assert (maps.mask & (off > 1)).sum() < 0.005 * maps.mask.sum()


@pytest.mark.parametrize("pose", [ABOVE, TO_THE_LEFT], ids=["above", "to the left"])
def test_the_other_camera_may_stand_anywhere_aside(relit, tmp_path, pose):
    left, right = pair((WALL, BALL), 1, 3, pose)
    maps, *_ = relit.depth(scenes.write_pair(tmp_path, recorded(left, 7), recorded(right, 8), pose=pose))
    off = np.abs(pixels_off(maps, left.depth, pose))
    assert maps.mask.mean() > 0.65 and (maps.mask & (off > 1)).sum() < 0.005 * maps.mask.sum()
    assert np.sqrt(np.mean(off[maps.mask & (off < 1)] ** 2)) < 0.1


def test_a_third_camera_sees_what_the_second_does_not(relit, tmp_path):
    parts = Wall((0, 0, -1.2), (0.1, 0.05, 1), 0.6), rectangle((-0.1, 0.05), (-0.12, 0.1), 0.85)
    left, right = pair(parts)
    _, third = pair(parts, 1, 3, TO_THE_LEFT)
    folder = scenes.write_pair(tmp_path / "two", recorded(left, 9), recorded(right, 10))
    two, *_ = relit.depth(folder)
    folder = scenes.write_pair(tmp_path / "three", recorded(left, 9), recorded(right, 10))
    further = {"name": "left", **entry_of(OTHER), "camera_from_other": TO_THE_LEFT.tolist()}
    scenes.write_image(folder / "far_0.png", recorded(third, 11)[0])
    edit_manifest(folder, other_cameras=lambda others: [*others, further],
                  frames=[{"image": "left_0.png", "stereo": {"images": ["right_0.png", "far_0.png"]}}])
    three, report, _ = relit.depth(folder)
    assert [camera["name"] for camera in report["found"]["cameras"]] == ["right", "left"]
    gained = three.mask & (two.status == Status.OCCLUDED)
    assert gained.sum() > 0.4 * (two.status == Status.OCCLUDED).sum()
    off = np.abs(three.depth - left.depth)
    assert (three.mask & (np.abs(pixels_off(three, left.depth)) > 1)).sum() < 0.005 * three.mask.sum()
    common = two.mask & three.mask
    assert np.median(off[common]) < 0.9 * np.median(np.abs(two.depth - left.depth)[common])
    assert np.median(three.sigma[common]) < 0.85 * np.median(two.sigma[common])


def test_geometry_and_reflectance_of_one_moment(relit, tmp_path):
    """Texture and lights in one capture: `solve`, `depth` and `join` speak of the same pixels."""
    left, right = pair((WALL, BALL), 3)
    normal = np.where((left.part == 1)[..., None], (left.points - BALL.center_m) / BALL.radius_m, WALL.normal / np.linalg.norm(WALL.normal))
    directions = [(0, 0, 1), (0.5, 0, 1), (-0.5, 0, 1), (0, 0.5, 1), (0, -0.5, 1), (0.35, 0.35, 1)]
    further = []
    for index, direction in enumerate(np.array(directions) / np.linalg.norm(directions, axis=1, keepdims=True)):
        light = {"type": "distant", "direction": direction.tolist(), "irradiance": [3, 3, 3]}
        lit = 0.6 / np.pi * 3 * np.clip(normal @ direction, 0, None)
        write_exr(tmp_path / f"olat_{index}.exr", np.repeat(lit[..., None], 3, axis=-1))
        further.append({"image": f"olat_{index}.exr", "light": light})
    scenes.write_pair(tmp_path, recorded(left, 12), recorded(right, 13), further=further)
    maps, *_ = relit.depth(tmp_path)
    assert relit("solve", tmp_path, "--method", "lambert", "--out", tmp_path / "solved").code == 0
    solved = SurfaceMaps.read(tmp_path / "solved" / "maps.exr")
    assert solved.camera.resolution == maps.camera.resolution and solved.camera.focal_px == maps.camera.focal_px
    # each pixel of both is compared with the truth of that pixel's line of sight: half a pixel beside, the normals of the ball turn by 0.7°
    assert (np.abs(solved.normal - normal).max(axis=-1) < 0.005)[solved.mask].mean() > 0.99
    assert (np.abs(pixels_off(maps, left.depth)) < 1)[maps.mask].mean() > 0.995
    ball = left.part == 1
    assert (maps.mask & solved.mask)[ball].mean() > 0.8
    relit.done("join", tmp_path / "solved", tmp_path / "out", "--out", tmp_path / "joined")
    joined = SurfaceMaps.read(tmp_path / "joined" / "maps.exr")
    both = joined.mask & maps.mask
    before, after = (np.median(np.abs(found - left.depth)[both]) for found in (maps.depth, -joined.height))
    assert both.mean() > 0.7 and after < before


def test_bands_of_rows_agree_with_the_whole_image(relit, tmp_path, monkeypatch):
    left, right = pair((WALL, BALL))
    folder = scenes.write_pair(tmp_path, recorded(left, 14), recorded(right, 15))
    whole, *_ = relit.depth(folder)
    monkeypatch.setattr("service.depth.stereo.stereo_pair.VOLUME_BYTES", 1 << 20)  # the fewest rows at a time
    banded, *_ = relit.depth(folder)
    # paths that begin 24 rows above a band choose what those that begin at the top choose, but for single pixels at edges
    assert (whole.mask != banded.mask).mean() < 0.01
    both = whole.mask & banded.mask
    assert (np.abs(whole.depth - banded.depth)[both] < 0.2 * whole.sigma[both]).mean() > 0.99
