"""Two cameras under one projector that nobody has calibrated: depth by the cameras alone, where both see the same place of it."""

import json
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.depth.stereo.row_offsets import row_offsets
from service.depth.stereo.stereo_pair import WINDOW_REACH, bend, box_mean, contrast
from stage.formats.images import write_png
from tests.reference import projector as reference
from tests.scenes.captures import edit_manifest
from tests.scenes.depth import (
    CAMERA,
    CENTRE,
    NORMAL,
    PLANE,
    POSE,
    PROJECTOR,
    RADIUS,
    Scene,
    gray_patterns,
    make_scene,
    phase_patterns,
    write_patterns,
)

SECOND = reference.Device(100, 76, 150.0, (-0.1, 0.02, 0.0), (0.0, 0.001))
PLACE = reference.look_at((-0.28, 0.05, 0.03), (0.02, 0.0, -1.4))  # of the second camera in the frame of the first
PATTERNS = [{"code": "white"}, {"code": "black"}, *gray_patterns("column", stripe=4, inverse=False), *phase_patterns("column", 8.0),
            *gray_patterns("row", stripe=4, inverse=False), *phase_patterns("row", 8.0)]


def seen_from(camera, pose):
    """The sphere before the plane, seen by a camera elsewhere; points in the frame of the first."""
    rays = reference.pixel_rays(camera) @ pose[:3, :3].T
    at = pose[:3, 3]
    depth = np.fmin(reference.plane_depth(rays, np.array(PLANE) - at, NORMAL), reference.sphere_depth(rays, np.array(CENTRE) - at, RADIUS))
    points = rays * depth[..., None] + at
    to = POSE[:3, 3] - points
    clear = np.isnan(reference.sphere_depth(-to, np.array(CENTRE) - POSE[:3, 3], RADIUS * 0.999))
    on_sphere = np.linalg.norm(points - CENTRE, axis=-1) < RADIUS * 1.001
    facing = (to * (points - CENTRE)).sum(axis=-1) > 0
    shaded = np.where(on_sphere, ~facing, ~clear)
    return Scene(depth, points, reference.seen_by(PROJECTOR, POSE, points), np.full((*depth.shape, 3), 0.6), shaded)


def measured(relit, folder, *options, **more):
    return relit.depth(folder / "first", "--beside", folder / "second", *options, out=folder / "out", **more)


def two_captures(folder, noise=0.0):
    first, second = make_scene(), seen_from(SECOND, PLACE)
    size = {"resolution": [PROJECTOR.width, PROJECTOR.height]}
    for name, scene, camera, pose in (("first", first, CAMERA, None), ("second", second, SECOND, PLACE)):
        write_patterns(folder / name, scene, PATTERNS, noise=noise, camera=camera)
        described = json.loads((folder / name / "capture.json").read_text())["camera"]
        edit_manifest(folder / name, projector=size, camera=described | ({} if pose is None else {"world_from_camera": pose.tolist()}))
    return first


@pytest.mark.parametrize(("noise", "most"), [(0.0, 1e-3), pytest.param(0.004, 4e-3, marks=pytest.mark.long)])
def test_depth_is_that_of_the_cameras(relit, tmp_path, noise, most):
    """The projector of the manifests has a size and nothing else. Of 1.4 m, planes through 5 × 5 pixels of a sphere are off by
    1 mm, at its rim by a centimetre."""
    first = two_captures(tmp_path, noise)
    maps, report, _ = measured(relit, tmp_path)
    error = np.abs(maps.depth - first.depth)[maps.mask]
    assert np.median(error) < most and np.quantile(error, 0.99) < 10 * most, (np.median(error), np.quantile(error, 0.99))
    places = reference.seen_by(SECOND, PLACE, first.points)
    inside = ((places > 3) & (places < np.array([SECOND.width, SECOND.height]) - 3)).all(axis=-1) & ~first.shaded
    lit = ((first.uv > 1) & (first.uv < np.array([PROJECTOR.width, PROJECTOR.height]) - 1)).all(axis=-1)
    assert (maps.mask & inside & lit).sum() > 0.8 * (inside & lit).sum()
    if noise:
        ratio = (maps.depth - first.depth)[maps.mask] / maps.sigma[maps.mask]
        assert 0.4 < np.sqrt(np.median(ratio**2)) / 0.6745 < 1.5
    assert report["found"]["beside"]["residual_px"]["median"] < 0.3
    assert "two cameras" in report["method"] and "decoded_only" not in report["found"]


@pytest.mark.long
def test_what_the_second_camera_does_not_see_has_no_depth(relit, tmp_path):
    """The sphere hides a part of the plane from the second camera; no other part is taken for it."""
    first = two_captures(tmp_path)
    maps, *_ = measured(relit, tmp_path)
    way = first.points - PLACE[:3, 3]
    hidden = reference.sphere_depth(way, np.array(CENTRE) - PLACE[:3, 3], RADIUS * 1.02) < 0.98
    assert hidden.sum() > 40
    wrong = maps.mask & hidden & (np.abs(maps.depth - first.depth) > 0.02)
    assert wrong.sum() <= 0.02 * hidden.sum()


@pytest.mark.long
@pytest.mark.parametrize("degrees", [(0.5, 0, 0), (0, 0.1, 0), (0, 0, 0.5), (0, 2, 0)])
def test_a_wrong_pose_is_named_and_sigma_holds_it(relit, tmp_path, degrees):
    first = two_captures(tmp_path, 0.004)
    pose = PLACE.copy()
    pose[:3, :3] = pose[:3, :3] @ Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    edit_manifest(tmp_path / "second", camera=lambda camera: {**camera, "world_from_camera": pose.tolist()})
    maps, report, _ = measured(relit, tmp_path)
    error = np.abs(maps.depth - first.depth)[maps.mask] / maps.sigma[maps.mask]
    assert maps.mask.mean() > 0.7 and np.median(error) < 2.5 and (error > 5).mean() < 0.06  # one error that all share; 2° bend too
    assert any("contradict its calibration" in sentence for sentence in report["warnings"])
    refined, report, _ = measured(relit, tmp_path, "--refine-projector")
    told = report["found"]["beside"]["refined"]["world_from_camera"]
    turns = [np.trace(PLACE[:3, :3].T @ np.array(each)[:3, :3]) for each in (told, pose)]
    assert turns[0] > turns[1]
    left = np.abs(refined.depth - first.depth)[refined.mask]
    assert np.median(left) < 0.8 * np.median(error * maps.sigma[maps.mask]) and (left > 5 * refined.sigma[refined.mask]).mean() < 0.01


@pytest.mark.long
def test_a_principal_point_a_tenth_of_the_width_aside_is_named_and_held(relit, tmp_path):
    """It moved all depths by ten and more sigma."""
    first = two_captures(tmp_path, 0.004)
    edit_manifest(tmp_path / "second", camera=lambda camera: {**camera, "principal_px": [SECOND.width * 0.6, SECOND.height / 2]})
    maps, report, _ = measured(relit, tmp_path)
    error = np.abs(maps.depth - first.depth)[maps.mask] / maps.sigma[maps.mask]
    assert maps.mask.mean() > 0.5 and (error > 5).mean() < 0.01
    assert any("its camera.principal_px were" in sentence for sentence in report["warnings"])


@pytest.mark.long
def test_an_inverse_pose_of_a_small_thing_gives_no_depth(relit, tmp_path):
    """Few pixels are lit on it: they were solved without a word."""
    first = two_captures(tmp_path, 0.004)
    part = np.zeros(first.depth.shape, np.uint8)
    part[30:50, 40:62] = 255  # 440 pixels
    write_png(tmp_path / "first" / "mask.png", part, srgb=False)
    edit_manifest(tmp_path / "first", mask="mask.png")
    assert not measured(relit, tmp_path).report["warnings"]
    edit_manifest(tmp_path / "second", camera=lambda camera: {**camera, "world_from_camera": np.linalg.inv(PLACE).tolist()})
    assert not measured(relit, tmp_path, code=1).maps.mask.any()


@pytest.mark.long
@pytest.mark.parametrize("times", [2.0, 0.5])
def test_lines_of_sight_that_meet_by_chance_give_no_depth(relit, tmp_path, times):
    """A tenth of them met under another focal length, nearly all of these far off."""
    two_captures(tmp_path, 0.004)
    edit_manifest(tmp_path / "second", camera=lambda camera: {**camera, "focal_px": [times * focal for focal in camera["focal_px"]]})
    maps, _, said = measured(relit, tmp_path, code=1)
    assert "check camera.world_from_camera of both captures" in said and "camera.focal_px" in said and not maps.mask.any()


def test_what_is_missing_is_named(relit, tmp_path):
    two_captures(tmp_path)
    command = ["depth", tmp_path / "first", "--beside", tmp_path / "second", "--out", tmp_path / "out"]
    second = tmp_path / "second" / "capture.json"
    good = second.read_text()
    camera = json.loads(good)["camera"]
    edit_manifest(tmp_path / "second", camera={key: value for key, value in camera.items() if key != "world_from_camera"})
    assert "second/capture.json: camera.world_from_camera: is missing" in relit.refused(*command)
    edit_manifest(tmp_path / "second", camera={**camera, "world_from_camera": np.eye(4).tolist()})
    assert "camera.world_from_camera: the second camera stands 0 m from" in relit.refused(*command)
    second.write_text(good)
    kept = [frame for frame in json.loads(good)["frames"] if frame["pattern"].get("axis") != "row"]
    edit_manifest(tmp_path / "second", frames=kept)
    assert "second has a code of one axis alone: two cameras need" in relit.refused(*command)
    frames = json.loads(good)["frames"]
    edit_manifest(tmp_path / "second", frames=[{**frame, "pattern": next_one["pattern"]}
                                               for frame, next_one in zip(frames, [*frames[1:], frames[0]], strict=True)])
    assert re.search(r"second/capture\.json: frames: .* if each image shows the pattern of the (next|frame)", relit.refused(*command))
    second.write_text(good)
    axes = np.diag([1.0, -1, -1, 1])  # of OpenCV
    edit_manifest(tmp_path / "second", camera={**camera, "world_from_camera": (axes @ PLACE @ axes).tolist()})
    assert "check camera.world_from_camera of both captures" in relit.refused(*command)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("offset", [-0.7, 0.0, 0.3])
def test_an_offset_is_measured(offset):
    rng = np.random.default_rng(0)
    wave, phase = rng.uniform(-1, 1, (40, 2)), rng.uniform(0, 2 * np.pi, 40)
    y, x = np.mgrid[:60, :120].astype(float)

    def image(at_x, at_y):
        return (0.5 + 0.05 * sum(np.cos(k[0] * at_x + k[1] * at_y + p) for k, p in zip(wave, phase, strict=True))).astype(np.float32)

    left, right = image(x, y), 0.6 * image(x + 7, y - offset) + 0.1  # lower by the offset
    flat = np.zeros_like(left)
    usable = np.zeros(left.shape, bool)
    usable[3:-3, 25:-8] = True  # what lies lower is within the image
    found = row_offsets(left, right, flat + 7, flat, flat, usable)
    assert len(found.offset) > 40 and np.abs(found.offset - offset).max() < 0.03  # bicubic interpolation
    assert len(row_offsets(left, right, flat + 7, flat, flat, ~usable & False).offset) == 0


def test_means_and_contrast():
    image = np.random.default_rng(0).random((20, 30))
    mean = box_mean(image, 2)
    assert abs(mean[7, 9] - image[5:10, 7:12].mean()) < 1e-12
    assert abs(mean[0, 0] - np.pad(image, 2, mode="edge")[:5, :5].mean()) < 1e-12
    frames = np.stack([image, 3 * image + 100]).astype(np.float32)  # an offset has no contrast
    expected = np.sqrt((1 + 9) / 2) * image[5:10, 7:12].std()
    assert abs(contrast(frames, 2)[7, 9] - expected) < 1e-4 * expected


def test_a_bend_is_what_a_plane_of_least_squares_lies_above_the_surface():
    y, x = np.mgrid[:40, :50].astype(float)
    surface = 12 + 0.1 * x - 0.05 * y + 0.5 * 0.02 * (x - 25) ** 2 + 0.5 * -0.008 * (y - 20) ** 2
    dy, dx = np.mgrid[-WINDOW_REACH:WINDOW_REACH + 1, -WINDOW_REACH:WINDOW_REACH + 1]
    columns = np.stack([np.ones(dx.size), dx.ravel(), dy.ravel()], axis=-1)
    window = surface[20 - WINDOW_REACH:21 + WINDOW_REACH, 25 - WINDOW_REACH:26 + WINDOW_REACH].ravel()
    above = np.linalg.lstsq(columns, window, rcond=None)[0][0] - surface[20, 25]
    usable = np.ones(surface.shape, bool)
    found = bend(surface, usable)
    assert abs(found[20, 25] - above) < 1e-9 and abs(above - (0.02 - 0.008) / 2 * 20 / 3) < 1e-9
    step = np.where(x > 24, surface + 30, surface)
    beside = np.r_[8:18, 32:42]
    assert np.abs(bend(step, usable) - above)[8:-8, beside].max() < 1e-9 and np.abs(bend(step, usable)).max() < 0.1  # a step is no bend
    assert not bend(surface, np.zeros_like(usable)).any()
