"""relit depth on projected patterns: from images on disk to depth.exr and points.ply, with a known truth."""

import json
import re

import numpy as np
import pytest

from stage.formats import exr
from stage.formats.ply import read_ply
from stage.results.depth_maps import DepthMaps
from tests.marks import first_short
from tests.reference.colour import srgb
from tests.scenes.captures import angles_degrees, edit_frame, edit_manifest, files_in, write_image
from tests.scenes.depth import AMBIENT, BLACK_WHITE, NORMAL, POSE, PROJECTOR, gray_patterns, make_scene, phase_patterns, write_patterns

SCENE = make_scene()
LIT = (SCENE.uv > 0).all(axis=-1) & (SCENE.uv < (PROJECTOR.width, PROJECTOR.height)).all(axis=-1) & ~SCENE.shaded
COLUMN_PX = 0.065
"""Metres of depth that a projector column is worth here, at most."""


def off(maps: DepthMaps) -> np.ndarray:
    return np.abs(maps.depth - SCENE.depth)[maps.mask]


@pytest.mark.parametrize("suffix", ["png", "exr"])
def test_gray_code_with_inverses(relit, tmp_path, suffix):
    write_patterns(tmp_path, SCENE, [*gray_patterns("column"), *BLACK_WHITE], suffix=suffix)
    maps, report, said = relit.depth(tmp_path, "--device", "cpu")
    assert "depth.exr" in said and "points.ply" in said
    assert maps.mask[LIT].mean() > 0.97 and not maps.mask[~LIT].any()
    assert off(maps).max() < COLUMN_PX  # half a stripe, or one where a bit is in doubt
    assert np.abs(maps.projector_u - SCENE.uv[..., 0])[maps.mask].max() <= 1.0
    assert maps.projector_v is None and maps.range is None
    assert report["found"]["codes"] == {"column": report["method"]} == {"column": "gray with inverses, edges refined"}
    assert report["pixels"]["ok"] == maps.mask.sum() == report["points"]
    assert report["sigma_m"]["median"] == pytest.approx(np.median(maps.sigma[maps.mask]), rel=1e-4)
    assert files_in(tmp_path / "out") == {"depth.exr", "points.ply", "report.json"}


def test_what_the_calibration_leaves_open_is_said(relit, tmp_path):
    """No standard deviation of a pixel holds what all pixels share; it is said where it is more than that of the pixels."""
    write_patterns(tmp_path, SCENE, [*gray_patterns("column"), *BLACK_WHITE])
    path = tmp_path / "capture.json"
    manifest = json.loads(path.read_text())
    for part, said in ((0.02, True), (1e-6, False)):
        manifest["projector"]["depth_sigma"] = part
        path.write_text(json.dumps(manifest))
        maps, report, _ = relit.depth(tmp_path)
        assert report["found"]["calibration_sigma_m"] == pytest.approx(part * np.median(maps.depth[maps.mask]), rel=0.01)
        assert float(maps.provenance["relit:calibration_sigma_m"]) == report["found"]["calibration_sigma_m"]
        assert any("projector.depth_sigma" in sentence for sentence in report["warnings"]) == said


def test_edges_of_wide_stripes_are_refined(relit, tmp_path):
    write_patterns(tmp_path, SCENE, [*gray_patterns("column", stripe=8), *BLACK_WHITE])
    refined, *_ = relit.depth(tmp_path)
    centres, report, _ = relit.depth(tmp_path, "--no-refine")
    assert report["method"] == "gray with inverses"
    column = [np.median(np.abs(maps.projector_u - SCENE.uv[..., 0])[maps.mask]) for maps in (centres, refined)]
    assert column[0] > 1.5 and column[1] < 0.3


def test_phase_numbered_by_gray(relit, tmp_path):
    write_patterns(tmp_path, SCENE, [*phase_patterns("column", 16), *gray_patterns("column", stripe=4), *BLACK_WHITE])
    maps, report, _ = relit.depth(tmp_path)
    assert report["method"] == "phase numbered by gray"
    assert maps.mask[LIT].mean() > 0.97
    assert np.median(off(maps)) < 2e-5 and off(maps).max() < 2e-4  # 16 bits


def test_phase_with_noise_is_as_sure_as_it_says(relit, tmp_path):
    write_patterns(tmp_path, SCENE, [*phase_patterns("column", 16), *gray_patterns("column", stripe=4), *BLACK_WHITE], noise=0.01)
    maps, *_ = relit.depth(tmp_path, "--read-noise", 0.01, "--photon-gain", 0)
    ratio = (maps.depth - SCENE.depth)[maps.mask] / maps.sigma[maps.mask]
    assert 0.8 < np.sqrt(np.mean(np.clip(ratio, -5, 5) ** 2)) < 1.2


@pytest.mark.long
def test_both_axes_of_two_periods(relit, tmp_path):
    write_patterns(tmp_path, SCENE, [*phase_patterns("column", 16), *phase_patterns("column", 144), *phase_patterns("row", 16),
                                     *phase_patterns("row", 144), {"code": "black"}])
    maps, report, _ = relit.depth(tmp_path)
    assert maps.mask[LIT].mean() > 0.97
    assert off(maps).max() < 3e-4
    assert report["found"]["residual_px"]["p95"] < 0.05
    assert np.abs(maps.projector_v - SCENE.uv[..., 1])[maps.mask].max() < 0.05


def kary(base, digits, stripe, **values):
    return [{"code": "kary", "axis": "column", "base": base, "digit": digit, "digits": digits, "stripe_px": stripe, **values}
            for digit in range(digits)]


def modulated(period):
    return [{"code": "modulated", "axis": "column", "period_px": period, "step": i, "steps": 3, "carrier_period_px": 6,
             "carrier_step": j, "carrier_steps": 3} for i in range(3) for j in range(3)]


def micro(*periods):
    return [{"code": "phase", "axis": "column", "period_px": period, "step": 0, "steps": 3} for period in periods]


@pytest.mark.parametrize(("patterns", "name", "worst_px"), [
    ([{**p, "code": "xor", "base_bit": 0} for p in gray_patterns("column")], "xor with inverses", 1.0),
    ([*modulated(16), *gray_patterns("column", stripe=4)], "modulated phase numbered by gray", 0.02),
    ([*modulated(16), *modulated(144)], "modulated phase", 0.02),
    ([*phase_patterns("column", 16, 3), *micro(15.2, 17.1, 18.4, 14.3)], "micro phase", 0.02),
    (kary(4, 4, 1, levels=[0, 0.33, 0.67, 1]), "kary", 1.0),
    (kary(3, 4, 2, colors=[[1, 0, 0], [0, 1, 0], [0, 0, 1]]), "kary", 2.0),
    ([{"code": "ramp", "axis": "column", "direction": "up"}], "ramp", 0.02),
    ([{"code": "ramp", "axis": "column", "direction": direction} for direction in ("up", "down")], "ramp", 0.02),
    ([{**p, "code": "binary"} for p in gray_patterns("column", inverse=False)], "binary", 1.0),
    ([*phase_patterns("column", 16), *kary(4, 3, 4, levels=[0, 0.33, 0.67, 1])], "phase numbered by kary", 0.01),
])
def test_every_code(relit, tmp_path, patterns, name, worst_px):
    decodes(relit, tmp_path, [*patterns, *BLACK_WHITE], name, worst_px)


def decodes(relit, folder, patterns, name, worst_px):
    write_patterns(folder, SCENE, patterns)
    maps, report, _ = relit.depth(folder)
    assert report["found"]["codes"]["column"] == name
    assert maps.mask[LIT].mean() > 0.93
    assert np.abs(maps.projector_u - SCENE.uv[..., 0])[maps.mask].max() <= worst_px


@first_short(("patterns", "name", "worst_px"), [
    ([*phase_patterns("column", 16), *gray_patterns("column", stripe=4, inverse=False)], "phase numbered by gray", 0.02),
    ([*phase_patterns("column", 16, 3), *gray_patterns("column", stripe=4, inverse=False)], "phase numbered by gray", 0.02),
    ([*phase_patterns("row", 96), *gray_patterns("column", inverse=False)], "gray, white and black from phases", 1.0),
    (modulated(128), "modulated phase", 0.05),
    ([*modulated(16), *phase_patterns("column", 128)], "modulated phase with phase", 0.02),
    ([*phase_patterns("column", 16), *phase_patterns("column", 128)], "phase", 0.02),
])
def test_captures_without_white_and_black(relit, tmp_path, patterns, name, worst_px):
    """Phases tell what white and black frames would show; a period as long as the projector is wide numbers the others, or itself."""
    decodes(relit, tmp_path, patterns, name, worst_px)


def test_waves_with_an_offset(relit, tmp_path):
    """The projector shows waves of another phase at its first column: sines, and waves that were generated from pixel centres."""
    frames = [*phase_patterns("column", 16), *phase_patterns("column", 128), *modulated(128)]
    write_patterns(tmp_path, SCENE, [{**frame, "offset_rad": -0.7 * np.pi} for frame in frames], projector=None)
    data = json.loads((tmp_path / "capture.json").read_text())
    found = []
    for code in ("phase", "modulated"):
        edit_manifest(tmp_path, projector={"resolution": [PROJECTOR.width, PROJECTOR.height]},
                      frames=[frame for frame in data["frames"] if frame["pattern"]["code"] == code])
        relit.done("depth", tmp_path, "--out", tmp_path / "out")
        channels, _ = exr.read(tmp_path / "out" / "depth.exr")
        mask = channels["mask.Y"] > 0.5
        assert mask[LIT].mean() > 0.9
        found.append(np.abs(channels["projector.U"] - SCENE.uv[..., 0])[mask].max())
    assert max(found) < 0.05  # 16 bits; an offset that is not heeded is 5.6 and 45 columns


@pytest.mark.parametrize(("patterns", "most_px"), [
    ([*phase_patterns("row", 96), *gray_patterns("column", inverse=False)], 1.0),
    ([{"code": "ramp", "axis": "column", "direction": "up"}, *BLACK_WHITE], 0.2),
], ids=["gray, white and black from phases", "ramp"])
def test_the_projectors_response_is_heeded(relit, tmp_path, patterns, most_px):
    """Light = level^2.2: the mean of the wave lies at .36 of white, and the threshold of the bits half way all the same."""
    write_patterns(tmp_path, SCENE, patterns, gamma=2.2)
    edit_manifest(tmp_path, projector=lambda projector: {**projector, "response": (np.linspace(0, 1, 256) ** 2.2).tolist()})
    maps, *_ = relit.depth(tmp_path)
    assert maps.mask[LIT].mean() > 0.93
    off_px = np.abs(maps.projector_u - SCENE.uv[..., 0])[maps.mask]
    assert off_px.max() <= most_px and np.median(off_px) < 0.5


@pytest.mark.parametrize(("patterns", "words"), [
    ([{"code": "ramp", "axis": "column", "direction": "up"}], "column ramp needs its opposite or a white frame"),
    (kary(4, 4, 1, levels=[0, 0.33, 0.67, 1]), "column kary code needs a white and a black frame"),
    (gray_patterns("column", inverse=False), "neither inverses nor a white and a black frame"),
    (phase_patterns("column", 16), "repeat after"),
    ([*gray_patterns("column")[2:], *BLACK_WHITE], "column gray code of 7 bits has no frame of bit 6"),
])
def test_missing_frames_are_named(relit, tmp_path, patterns, words):
    write_patterns(tmp_path, SCENE, patterns)
    fails(relit, tmp_path, words)


def test_points_have_place_colour_and_normal(relit, tmp_path):
    scene = make_scene(sphere=False)
    write_patterns(tmp_path, scene, [*phase_patterns("column", 16), *gray_patterns("column", stripe=4), *BLACK_WHITE])
    maps, *_ = relit.depth(tmp_path, "--normals")
    cloud = read_ply(tmp_path / "out" / "points.ply")
    assert np.abs(cloud.points - scene.points[maps.mask]).max() < 2e-4
    assert np.median(angles_degrees(cloud.normals, np.array(NORMAL) / np.linalg.norm(NORMAL))) < 1
    linear = scene.albedo[maps.mask]
    encoded = srgb(linear / np.percentile(linear.max(axis=-1), 99))
    assert np.abs(cloud.colours - 255 * encoded).max() < 1.5
    relit.depth(tmp_path)
    assert read_ply(tmp_path / "out" / "points.ply").normals is None


def test_the_mask_and_the_range_of_depths_hold(relit, tmp_path):
    write_patterns(tmp_path, SCENE, [*gray_patterns("column"), *BLACK_WHITE], mask="mask.png")
    mask = np.zeros(SCENE.depth.shape, np.uint8)
    mask[20:50, 20:70] = 255
    write_image(tmp_path / "mask.png", mask)
    maps, report, _ = relit.depth(tmp_path, "--far-m", 1.3)
    assert not maps.mask[mask == 0].any() and maps.depth.max() <= 1.3
    assert report["pixels"]["out_of_range"] > 0 and report["pixels"]["mask"] == 1500


def test_saturated_readings_are_refused(relit, tmp_path):
    write_patterns(tmp_path, SCENE, [*phase_patterns("column", 16), *phase_patterns("column", 144)], saturation=0.6)
    maps, report, _ = relit.depth(tmp_path)
    bright = SCENE.albedo.max(axis=-1) * (AMBIENT + 0.8 * 0.85) > 0.61  # one of four steps is at 0.85 of full on or above
    assert report["pixels"]["saturated"] > 0 and not maps.mask[bright & LIT].any()


@first_short("patterns", [[*phase_patterns("column", 16), *gray_patterns("column", stripe=4)],
                          [*gray_patterns("column", stripe=4), *gray_patterns("row", stripe=4)]])
def test_bands_change_nothing(relit, tmp_path, monkeypatch, patterns):
    write_patterns(tmp_path, SCENE, [*patterns, *BLACK_WHITE], noise=0.01)
    whole, *_ = relit.depth(tmp_path)
    monkeypatch.setattr("stage.stack.planes.BAND_BYTES", 100_000)
    monkeypatch.setattr("stage.stack.planes.MEMORY_BYTES", 0)
    parts, *_ = relit.depth(tmp_path)
    assert (whole.depth == parts.depth).all() and (whole.status == parts.status).all()


@pytest.mark.parametrize(("pose", "options", "words"), [
    (POSE * np.array([[1, 1, 1, 1000]] * 3 + [[1, 1, 1, 1]]), (), "give the translation in metres"),
    (POSE * [-1, 1, -1, 1], (), "the projector lights nothing that the camera sees"),
    (np.eye(4), (), "without a baseline there is no depth"),
    (POSE, ("--near-m", 2, "--far-m", 1), "--far-m: is 1 m, not beyond the nearest that is asked for, 2 m"),
    (POSE, ("--near-m", 0.1, "--far-m", 0.5), "no pixel has a depth .*out_of_range.* within --near-m 0.1 and --far-m 0.5: give"),
], ids=["millimetres", "turned", "nowhere", "near beyond far", "near"])
def test_impossible_devices_are_named(relit, tmp_path, pose, options, words):
    write_patterns(tmp_path, SCENE, [*gray_patterns("column"), *BLACK_WHITE])
    edit_manifest(tmp_path, projector=lambda projector: {**projector, "camera_from_projector": pose.tolist()})
    fails(relit, tmp_path, words, *options)


def fails(relit, folder, words, *arguments):
    assert re.search(words, relit.refused("depth", folder, "--out", folder / "out", *arguments))
    assert files_in(folder / "out") == set()


def test_two_frames_of_one_pattern_are_named(relit, tmp_path):
    write_patterns(tmp_path, SCENE, [*gray_patterns("column"), *gray_patterns("column")[:1]])
    fails(relit, tmp_path, "show one pattern")
    write_image(tmp_path / "off.png", np.zeros(SCENE.depth.shape, np.uint16))
    edit_manifest(tmp_path, frames=lambda frames: [{"image": "off.png", "light": {"type": "off"}}, *frames])
    fails(relit, tmp_path, r"frames: frames 1 and 15 show one pattern \(column gray bit 6")


def test_images_of_another_size_are_named(relit, tmp_path):
    write_patterns(tmp_path, SCENE, gray_patterns("column"))
    write_image(tmp_path / "03.png", np.zeros((10, 10), np.uint16))
    fails(relit, tmp_path, "03.png: is 10x10")


def test_black_images_are_said(relit, tmp_path):
    write_patterns(tmp_path, SCENE, [*gray_patterns("column"), *BLACK_WHITE], level=0.0)
    fails(relit, tmp_path, "no pixel has a depth .*shadowed.*not seen")


def test_frames_of_another_kind(relit, tmp_path):
    write_patterns(tmp_path, SCENE, BLACK_WHITE)
    fails(relit, tmp_path, "none has a pattern with a code, a laser, tof or stereo")
    write_patterns(tmp_path, SCENE, [*gray_patterns("column"), *BLACK_WHITE])
    fails(relit, tmp_path, "none has a laser, which --using asks for", "--using", "laser")
    edit_frame(tmp_path, 15, pattern=None, laser={"type": "ray", "origin_m": [0.2, 0, 0], "direction": [0, 0, -1]})
    fails(relit, tmp_path, "there are pattern and laser frames: --using says which")


def test_a_part_of_the_images_has_the_depth_of_the_whole(relit, tmp_path):
    write_patterns(tmp_path, SCENE, [*phase_patterns("column", 16), *gray_patterns("column", stripe=4), *BLACK_WHITE])
    whole, *_ = relit.depth(tmp_path)
    rows, cols = whole.mask.shape
    x, y, width, height = cols // 4, rows // 5, cols // 2, rows // 2
    part, report, _ = relit.depth(tmp_path, "--crop", f"{x},{y},{width},{height}")
    inside = (slice(y, y + height), slice(x, x + width))
    both = part.mask & whole.mask[inside]
    assert both.sum() > 0.995 * whole.mask[inside].sum()  # pixels beside the border of the part are doubted without their neighbours
    # full scale comes from the largest values of the part, and so the noise that carries are judged by; a depth moves by rounding alone
    np.testing.assert_allclose(part.depth[both], whole.depth[inside][both], rtol=1e-5)
    assert report["options"]["crop"] == [x, y, width, height]
    points = read_ply(tmp_path / "out" / "points.ply").points
    expected = part.camera.points(-part.depth)[part.mask]
    np.testing.assert_allclose(points, expected, rtol=1e-5)
