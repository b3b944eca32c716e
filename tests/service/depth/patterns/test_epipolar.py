"""Projectors that are turned or zoomed otherwise than declared: said, and σ holds the error; right ones raise no doubt. The scenes are
height fields in closed form, seen along the lines of sight of a pinhole camera and projected by a pinhole, in float64."""


import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.depth.base.epipolar import contradiction
from service.depth.patterns.agreement import ALIKE, LEAST_PX, OF_WIDE
from stage.capture.projector import Projector
from tests.marks import first_short
from tests.scenes.captures import edit_manifest, write_images, write_manifest
from tests.scenes.depth import entries_of, phase_patterns, shown

SIZE, FOCAL, PROJECTED, LENS = (150, 110), 170.0, (200, 150), 230.0
RIGS = {"right": ((0.25, 0.02, 0.0), 1.2), "left above": ((-0.3, 0.15, 0.05), 1.6), "above": ((0.03, 0.28, -0.02), 1.4)}
WRONG = {"yaw": ((0.0, 1.0, 0.0), 1.0), "roll": ((0.0, 0.0, 1.0), 1.0), "pitch": ((-0.5, 0.0, 0.0), 1.0), "focal": ((0.0, 0.0, 0.0), 1.04)}
ASIDE = 3.5
"""Pixels by which a principal point is wrong, 1.5 % of the focal length."""


def scene(rig, seed):
    """Points [rows, cols, 3], the pose of the projector [4, 4], and where it sees the points, [rows, cols, 2]."""
    place, far = RIGS[rig]
    random = np.random.default_rng(seed)
    x = (np.arange(SIZE[0]) + 0.5 - SIZE[0] / 2) / FOCAL
    x, y = np.meshgrid(x, -(np.arange(SIZE[1]) + 0.5 - SIZE[1] / 2) / FOCAL)
    depth = far * (1 + random.uniform(-0.2, 0.2) * x + random.uniform(-0.2, 0.2) * y)
    for _ in range(4):
        along = random.normal(0, 8, 2)
        depth += 0.2 / np.hypot(*along) * np.sin(along[0] * x + along[1] * y + random.uniform(0, 6))
    points = depth[..., None] * np.stack([x, y, -np.ones_like(x)], axis=-1)
    back = np.array(place) - (0, 0, -far)
    back /= np.linalg.norm(back)
    right = np.cross((0, 1, 0), back)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right / np.linalg.norm(right), np.cross(back, right / np.linalg.norm(right)), back], axis=1)
    pose[:3, 3] = place
    return points, pose, seen(points, pose)


def seen(points, pose):
    x, y, z = np.moveaxis((points - pose[:3, 3]) @ pose[:3, :3], -1, 0)
    return np.stack([PROJECTED[0] / 2 - LENS * x / z, PROJECTED[1] / 2 + LENS * y / z], axis=-1)


def declared(pose, wrong=None):
    """The projector of a manifest, turned and zoomed by what WRONG has."""
    degrees, zoom = WRONG.get(wrong, ((0, 0, 0), 1.0))
    other = pose.copy()
    other[:3, :3] = pose[:3, :3] @ Rotation.from_euler("XYZ", degrees, degrees=True).as_matrix()
    return {"resolution": PROJECTED, "focal_px": [LENS * zoom] * 2, "camera_from_projector": other.tolist()}


def triangulated(points, uv, given):
    """The point of each line of sight whose image is nearest to uv, by a search in float64 of its inverse depth."""
    projector, guess = Projector.model_validate(given), -1 / points[..., 2]
    rays = points * guess[..., None]
    for _ in range(8):
        at, ahead = (projector.project(rays / (guess + step)[..., None])[0] for step in (0.0, 1e-5))
        way = (ahead - at) / 1e-5
        guess = guess + (way * (uv - at)).sum(axis=-1) / (way**2).sum(axis=-1)
    return rays / guess[..., None]


def judged(rig, wrong, noise, *, stripes=0.0, seed=3):
    points, pose, uv = scene(rig, seed)
    uv = (np.floor(uv / stripes) + 0.5) * stripes if stripes else uv
    uv = uv + np.random.default_rng(seed).normal(0, noise, uv.shape)
    found = triangulated(points, uv, declared(pose, wrong))
    flat = found.reshape(-1, 3)
    deviation = np.hypot(noise, stripes / 12**0.5)
    told = contradiction(Projector.model_validate(declared(pose, wrong)), flat, uv.reshape(-1, 2), np.full((len(flat), 2), deviation),
                         least_px=LEAST_PX, alike=ALIKE)
    return told, np.linalg.norm(found - points, axis=-1).ravel(), None if told is None else np.hypot(*told.moved(flat))


@first_short("stripes", [0.0, 1.0, 4.0])
@first_short("rig", RIGS)
def test_right_calibrations_raise_no_doubt(rig, stripes):
    for seed in range(4):
        assert judged(rig, None, 0.06, stripes=stripes, seed=seed)[0] is None


def test_light_that_pulls_ramps_towards_their_middle_is_no_calibration():
    """Bounced light adds a hundredth of a ramp's mean, and noise is coarser: a projector that is turned by more is told all the same."""
    points, pose, uv = scene("right", 3)
    for wrong, pull in ((None, 0.01), ("roll", 0.0)):
        projector = declared(pose, wrong)
        ramps = uv + pull * (np.array(PROJECTED) / 2 - uv) + np.random.default_rng(3).normal(0, 0.9, uv.shape)
        flat = triangulated(points, ramps, projector).reshape(-1, 3)
        told = [contradiction(Projector.model_validate(projector), flat, ramps.reshape(-1, 2), np.full((len(flat), 2), 0.9),
                              least_px=LEAST_PX, least_part=part, alike=ALIKE) is not None for part in (0.0, OF_WIDE)]
        assert told == [True, wrong is not None]


@pytest.mark.parametrize("wrong", WRONG)
@first_short("rig", RIGS)
def test_a_wrong_projector_is_said_and_covered(rig, wrong):
    found, error, sigma = judged(rig, wrong, 0.05)
    assert found is not None and np.median(error / sigma) < 1.4 and (error > 5 * sigma).mean() < 0.01


@first_short("rig", RIGS)
def test_a_principal_point_aside_is_covered(rig):
    """It looks like a turn, which moves all depths otherwise: the fit must not take one for the other."""
    points, pose, uv = scene(rig, 5)
    uv = uv + np.random.default_rng(5).normal(0, 0.05, uv.shape)
    given = {**declared(pose), "principal_px": [PROJECTED[0] / 2 + ASIDE, PROJECTED[1] / 2 - ASIDE]}
    found = triangulated(points, uv, given)
    error = np.linalg.norm(found - points, axis=-1).ravel()
    told = contradiction(Projector.model_validate(given), found.reshape(-1, 3), uv.reshape(-1, 2), np.full((error.size, 2), 0.05),
                         least_px=LEAST_PX, alike=ALIKE)
    sigma = None if told is None else np.hypot(*told.moved(found.reshape(-1, 3)))
    assert sigma is None or (np.median(error / sigma) < 1.4 and (error > 5 * sigma).mean() < 0.01)
    assert told is not None or np.median(error) < 0.01


@first_short(("which", "aside"), [("projector", 20.0), ("projector", -20.0), ("camera", 15.0), ("camera", -15.0)])
def test_a_principal_point_a_tenth_of_the_width_aside_is_named(which, aside):
    """Along the baseline, where the lines tell the least: all depths were off by more than five sigma."""
    points, pose, uv = scene("left above", 5)
    uv = uv + np.random.default_rng(5).normal(0, 0.05, uv.shape)
    given = declared(pose)
    if which == "projector":
        given["principal_px"] = [PROJECTED[0] / 2 + aside, PROJECTED[1] / 2]
    declares = points - points[..., 2:] * np.array([-aside / FOCAL, 0.0, 0.0]) * (which == "camera")
    found = triangulated(declares, uv, given).reshape(-1, 3)
    told = contradiction(Projector.model_validate(given), found, uv.reshape(-1, 2), np.full((uv[..., 0].size, 2), 0.05),
                         least_px=LEAST_PX, alike=ALIKE)
    error = np.abs(found[:, 2] - points[..., 2].ravel())
    own = 0 if which == "projector" else 1
    assert told is not None and next(iter(told.aside)) == own
    change = told.aside[own][0][[6, 7] if own == 0 else [8, 9]] * 0.015 * (LENS if own == 0 else FOCAL)  # of units of 1.5 % of the focal
    assert np.abs(change - (-aside, 0)).max() < 0.05 * abs(aside)  # five standard deviations of the noise
    assert (error > 5 * np.hypot(*told.moved(found))).mean() < 0.01


def written(folder, wrong):
    """A capture under two periods along both axes on cloth, with shot noise; the true depth."""
    points, pose, uv = scene("right", 8)
    random = np.random.default_rng(1)
    y, x = np.mgrid[:SIZE[1], :SIZE[0]]
    albedo = 0.55 + 0.2 * np.sin(x / 2.5) * np.sin(y / 3.5) + 0.1 * (np.sin(x / 11 + y / 17) > 0)
    images, patterns = [], [wave for axis in ("column", "row") for period in (20.0, 23.0) for wave in phase_patterns(axis, period)]
    for pattern in patterns:
        light = albedo * (0.05 + 0.8 * shown(pattern, uv))
        images.append(light + 0.02 * np.sqrt(light + 0.01) * 0.3 * random.standard_normal(light.shape))
    write_manifest(folder, {
        "schema": "relit.capture/1", "name": "waves", "color_space": "lin_rec709_scene",
        "frames": write_images(folder, images, entries_of(patterns), "{:02d}.png"),
        "camera": {"projection": "perspective", "resolution": SIZE, "focal_px": [FOCAL, FOCAL]}, "projector": declared(pose, wrong)})
    return -points[..., 2]


@pytest.mark.parametrize("wrong", [None, "yaw", pytest.param("roll", marks=pytest.mark.long)])
def test_depth_says_it(relit, tmp_path, wrong):
    depth = written(tmp_path, wrong)
    maps, report, _ = relit.depth(tmp_path, "--device", "cpu", "--read-noise", "0.003", code=None, unsure=True)
    warnings = report["warnings"]
    error = np.abs(maps.depth - depth)[maps.depth > 0] / maps.sigma[maps.depth > 0]
    if wrong is None:
        assert warnings == [] and maps.mask.mean() > 0.9
    else:
        assert any("contradict its calibration" in sentence for sentence in warnings)
        assert np.median(error) < 1.4 and (error > 5).mean() < 0.02


@pytest.mark.long
@pytest.mark.parametrize("wrong", ["yaw", "roll"])
def test_a_projector_is_refined(relit, tmp_path, wrong):
    """Depths are nearer to the truth, and σ holds what is left; the report tells the projector."""
    depth = written(tmp_path, wrong)
    errors = {}
    for name, words in (("declared", []), ("refined", ["--refine-projector"])):
        maps, report, _ = relit.depth(tmp_path, "--device", "cpu", "--least-confidence", "0", *words, out=tmp_path / name)
        error = np.abs(maps.depth - depth)[maps.mask]
        errors[name], error = float(np.median(error)), error / maps.sigma[maps.mask]
        assert np.median(error) < 1.4 and (error > 5).mean() < 0.02
    assert errors["refined"] < 0.5 * errors["declared"]
    found = report["found"]["refined_projector"]
    turned = np.array(found["camera_from_projector"])[:3, :3]
    true, given = (np.array(declared(scene("right", 8)[1], name)["camera_from_projector"])[:3, :3] for name in (None, wrong))
    assert np.trace(true.T @ turned) > np.trace(true.T @ given)


def test_what_cannot_be_refined_is_refused(relit, tmp_path):
    written(tmp_path, None)
    edit_manifest(tmp_path, frames=lambda frames: [frame for frame in frames if frame["pattern"]["axis"] == "column"])
    relit("depth", tmp_path, "--out", tmp_path / "out", "--refine-projector").refused("one axis alone")


@pytest.mark.long
@pytest.mark.parametrize("k", [(1.5, 0.0), (-1.0, 3.0)])
def test_a_lens_that_no_turn_explains_is_not_taken_for_one(relit, tmp_path, k):
    """As where boards were in the middle of the image alone: a projector turned by 30°, or of a negative focal length, was named."""
    written(tmp_path, None)
    pose = scene("right", 8)[1]
    edit_manifest(tmp_path, projector={**declared(pose), "distortion": {"model": "brown_conrady", "k": [*k, 0.0]}})
    _, report, _ = relit.depth(tmp_path, "--device", "cpu", "--read-noise", "0.003", "--least-confidence", "0", code=None)
    said = " ".join(report["warnings"])
    assert "no small turn of it and no other focal length explain" in said and "as if it were turned" not in said
