"""relit depth without calibration: decoded projector coordinates are the result, and they are kept where triangulation fails."""

import json

import numpy as np
import pytest

from stage.formats import exr
from stage.results.depth_maps import DepthMaps
from tests.reference import projector as reference
from tests.scenes.captures import edit_manifest, files_in, write_exr
from tests.scenes.depth import BLACK_WHITE, PROJECTOR, gray_patterns, make_scene, phase_patterns, write_patterns

SCENE = make_scene()
LIT = (SCENE.uv > 0).all(axis=-1) & (SCENE.uv < (PROJECTOR.width, PROJECTOR.height)).all(axis=-1) & ~SCENE.shaded
SIZE = {"resolution": [PROJECTOR.width, PROJECTOR.height]}
PLAIN_CAMERA = {"projection": "orthographic", "resolution": [96, 72]}
BOTH = [*phase_patterns("column", 16), *gray_patterns("column", stripe=4), *phase_patterns("row", 16), *gray_patterns("row", stripe=4)]


def decode(relit, folder, *arguments, code=0):
    outcome = relit("depth", folder, "--out", folder / "out", *arguments)
    assert (outcome.code, outcome.err) == (code, "")
    channels, _ = exr.read(folder / "out" / "depth.exr")
    return channels, json.loads((folder / "out" / "report.json").read_text()), outcome.out


def test_coordinates_are_the_result_of_a_capture_without_calibration(relit, tmp_path):
    write_patterns(tmp_path, SCENE, [*BOTH, *BLACK_WHITE], noise=0.003, projector=SIZE)
    edit_manifest(tmp_path, camera=PLAIN_CAMERA)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "points.ply").write_text("of an earlier run with a calibration")
    channels, report, said = decode(relit, tmp_path, "--read-noise", 0.003, "--photon-gain", 0)
    assert files_in(tmp_path / "out") == {"depth.exr", "report.json"}
    assert set(channels) == {"projector.U", "projector.V", "sigma.U", "sigma.V", "amplitude.Y", "confidence.Y", "status.Y", "mask.Y"}
    mask = channels["mask.Y"] > 0.5
    assert mask[LIT].mean() > 0.97 and not mask[~LIT].any()
    for axis, name in enumerate("UV"):
        error = (channels[f"projector.{name}"] - SCENE.uv[..., axis])[mask]
        assert np.abs(error).max() < 1  # a wrong period would be 16
        ratio = error / channels[f"sigma.{name}"][mask]
        assert 0.8 < np.sqrt(np.mean(ratio**2)) < 1.2  # as in test_depth.py
    # a place between those of both sides of the silhouette holds them in its sigma
    assert (channels["confidence.Y"][mask] > 0.5).mean() > 0.95
    assert "has no focal_px and no camera_from_projector" in report["found"]["decoded_only"] and "decoded only, without depth" in said
    assert report["points"] == 0 and report["pixels"]["ok"] == mask.sum() and report["sigma_u_px"]["median"] > 0
    assert "decoded projector coordinates alone" in relit.refused("export", tmp_path / "out", "--out", tmp_path / "asset.usdz")


def test_bits_tell_the_size_of_an_unknown_projector(relit, tmp_path):
    write_patterns(tmp_path, SCENE, [*gray_patterns("column"), *BLACK_WHITE], projector=None)
    channels, report, _ = decode(relit, tmp_path)
    mask = channels["mask.Y"] > 0.5
    assert mask[LIT].mean() > 0.97 and "projector.V" not in channels
    assert np.abs(channels["projector.U"] - SCENE.uv[..., 0])[mask].max() <= 1  # a stripe on either side of an edge
    assert "projector: is missing" in report["found"]["decoded_only"]


@pytest.mark.parametrize(("arguments", "words"), [
    (("--near-m", "0.5"), "--near-m: is about depths"),
    (("--max-sigma", "0.01"), "--max-sigma: is about depths"),
    ((), "a phase code does not tell how many pixels it has"),
])
def test_what_cannot_be_decoded_is_named(relit, tmp_path, arguments, words):
    write_patterns(tmp_path, SCENE, phase_patterns("column", 160), projector=None)
    assert words in relit.refused("depth", tmp_path, "--out", tmp_path / "out", *arguments)
    assert files_in(tmp_path / "out") == set()


def test_black_images_are_said(relit, tmp_path):
    write_patterns(tmp_path, SCENE, [*gray_patterns("column"), *BLACK_WHITE], level=0.0, projector=SIZE)
    assert "no pixel is decoded (6912 shadowed): the projected light is" in relit.refused("depth", tmp_path, "--out", tmp_path / "out")
    assert files_in(tmp_path / "out") == set()


def test_a_lens_without_a_pose_is_refused(relit, tmp_path):
    write_patterns(tmp_path, SCENE, gray_patterns("column"), projector={**SIZE, "focal_px": [150, 150]})
    assert "projector.camera_from_projector: is missing" in relit.refused("depth", tmp_path, "--out", tmp_path / "out")


def test_coordinates_are_kept_where_a_pixel_has_no_depth(relit, tmp_path):
    write_patterns(tmp_path, SCENE, [*BOTH, *BLACK_WHITE])
    channels, report, _ = decode(relit, tmp_path, "--far-m", 1.4)
    beyond = LIT & (SCENE.depth > 1.41)
    assert beyond.sum() > 1000 and (channels["mask.Y"][beyond] == 0).all() and (channels["depth.Z"][beyond] == 0).all()
    assert np.abs(channels["projector.U"] - SCENE.uv[..., 0])[beyond].max() < 0.1
    assert (channels["sigma.U"][beyond] > 0).all()
    assert report["points"] == (channels["mask.Y"] > 0.5).sum()
    assert (DepthMaps.read(tmp_path / "out" / "depth.exr").projector_u[beyond] == 0).all()  # a reader of depths sees solved pixels alone


def test_coordinates_are_the_result_where_no_pixel_has_a_depth(relit, tmp_path):
    """The pose in the manifest is that of a projector that is turned away: the planes of its columns meet no line of sight in front."""
    write_patterns(tmp_path, SCENE, [*phase_patterns("column", 16), *gray_patterns("column", stripe=4), *BLACK_WHITE])
    pose = reference.look_at((0.3, 0.08, 0.02), (1.2, 0.0, -1.4))
    edit_manifest(tmp_path, projector=lambda projector: {**projector, "camera_from_projector": pose.tolist()})
    channels, report, said = decode(relit, tmp_path)
    mask = channels["mask.Y"] > 0.5
    assert mask[LIT].mean() > 0.97 and np.abs(channels["projector.U"] - SCENE.uv[..., 0])[mask].max() < 0.1
    assert "out_of_range" in report["found"]["decoded_only"] and "check the frames' patterns, projector.camera_from_projector" in said


@pytest.mark.parametrize(("change", "words"), [
    (lambda pattern: {**pattern, "inverse": not pattern["inverse"]}, "patterns and inverses are exchanged"),
    (lambda pattern: {**pattern, "bit": pattern["bits"] - 1 - pattern["bit"]}, "the order of bits is reversed"),
])
def test_frames_that_are_declared_wrongly_are_named_and_nothing_is_believed(relit, tmp_path, change, words):
    patterns = [*gray_patterns("column"), *gray_patterns("row")]
    write_patterns(tmp_path, SCENE, [*patterns, *BLACK_WHITE], projector=SIZE)
    edit_manifest(tmp_path, frames=lambda frames: [
        {**frame, "pattern": change(frame["pattern"]) if "axis" in frame["pattern"] else frame["pattern"]} for frame in frames])
    channels, report, said = decode(relit, tmp_path, code=1)
    assert words in said and any(words in sentence for sentence in report["warnings"])
    assert not channels["mask.Y"].any() and channels["confidence.Y"].max() < 0.11


def test_wrong_codes_among_right_ones_are_doubted(relit, tmp_path):
    """Light of a coarse bit and its inverse is exchanged in single pixels, as a flash or a moving edge does."""
    folder = write_patterns(tmp_path, SCENE, [*gray_patterns("column"), *BLACK_WHITE], suffix="exr", projector=SIZE)
    chosen = np.random.default_rng(4).random(LIT.shape) < 0.02
    for bit in (2, 4):  # frames come in pairs of a bit and its inverse
        paths = [folder / f"{2 * bit + turned:02d}.exr" for turned in (0, 1)]
        images = [exr.read(path)[0] for path in paths]
        for path, own, other in zip(paths, images, images[::-1], strict=True):
            write_exr(path, np.stack([np.where(chosen, other[name], own[name]) for name in "RGB"], axis=-1))
    channels, _, _ = decode(relit, tmp_path)
    mask = channels["mask.Y"] > 0.5
    wrong = np.abs(channels["projector.U"] - SCENE.uv[..., 0]) > 2
    assert (chosen & LIT & wrong).sum() > 50
    assert (mask & wrong).sum() <= 0.02 * (chosen & LIT).sum() and mask[LIT & ~chosen].mean() > 0.9
