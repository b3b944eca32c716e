"""relit solve on gradient captures: from images on disk to maps.exr, with a known truth; and the doubt that pixels take from neighbours."""

import json

import numpy as np
import pytest

from service.solve.methods.gradient import PART, neighbours_doubt
from stage.formats import exr
from tests.reference import gradient as reference
from tests.scenes.captures import angles_degrees, edit_manifest, make_scene, write_lit

SIZE, ROUGHNESS = 12, 0.2
PAIRS = [(axis, sign) for axis in "xyz" for sign in (1, -1)]
SCENE = make_scene(size=SIZE)
CAMERA = {"projection": "orthographic", "resolution": [SIZE, SIZE]}


def shaded(shade) -> np.ndarray:
    """[frame, rows, cols] of a function of normal, axis and sign, inside the mask."""
    image = np.zeros((len(PAIRS), SIZE, SIZE))
    for r, c in np.argwhere(SCENE.mask):
        image[:, r, c] = [shade(SCENE.normal[r, c], axis, sign) for axis, sign in PAIRS]
    return image[..., None]


@pytest.fixture(scope="module")
def diffuse() -> np.ndarray:
    return shaded(reference.lambert) * SCENE.albedo


@pytest.fixture(scope="module")
def highlight() -> np.ndarray:
    view = np.array([0.0, 0.0, 1.0])
    return shaded(lambda n, axis, sign: reference.ggx(n, view, axis, sign, alpha=ROUGHNESS**2, f0=0.04, nodes=20, turns=30))


def write(folder, groups: dict[str, np.ndarray], **changes):
    """A capture of the six gradients in each polarisation."""
    lights = [{"type": "gradient", "axis": axis, "sign": sign, "polarization": kind} for kind in groups for axis, sign in PAIRS]
    return write_lit(folder, np.concatenate(list(groups.values())), lights, mask=SCENE.mask, **{"camera": CAMERA, **changes})


@pytest.mark.long
def test_polarised_frames_give_both_normals(relit, tmp_path, diffuse, highlight):
    write(tmp_path, {"cross": diffuse / 2, "parallel": diffuse / 2 + highlight})
    maps, report, _ = relit.solve(tmp_path, "--method", "gradient")
    inside = SCENE.mask
    assert np.array_equal(maps.mask, inside)
    assert angles_degrees(maps.normal, SCENE.normal)[inside].max() < 0.08  # half rounding of six readings
    assert angles_degrees(maps.specular_normal, SCENE.normal)[inside].max() < 0.5  # that of a difference, and the lobe's lean
    assert np.allclose(maps.diffuse_albedo[inside], SCENE.albedo[inside], rtol=2e-3)
    channels, _ = exr.read(tmp_path / "out" / "maps.exr")
    layers = {name.partition(".")[0] for name in channels}
    assert layers == {"normal", "specular_normal", "diffuse_albedo", "specular", "roughness", "height", "sigma", "confidence", "status",
                      "mask"}
    assert np.allclose(maps.specular[inside], 0.04, atol=0.002) and np.allclose(maps.roughness[inside], ROUGHNESS, atol=0.03)
    assert all(np.isfinite(plane).all() for plane in channels.values())
    assert report["method"] == "gradient" and report["found"]["separation"] == "polarisation"
    assert report["found"]["pixels_with_specular_normal"] == report["pixels"]["ok"] == inside.sum()
    assert report["found"]["response_length"]["median"] == pytest.approx(1, abs=1e-3)
    assert report["residual"]["p95"] < 1e-3


def test_a_declared_leak_is_taken_off_the_diffuse_frames(relit, tmp_path, diffuse, highlight):
    """5 % of a highlight of F₀ 0.04 would be an albedo of 0.002 to 0.008; half rounding of the frames leaves a thousandth of theirs."""
    leak = 0.05
    frames = {"cross": diffuse / 2 + leak * highlight, "parallel": diffuse / 2 + (1 - leak) * highlight}
    maps, *_ = relit.solve(write(tmp_path, frames, polarizer_leak=leak), "--method", "gradient")
    inside = SCENE.mask
    assert angles_degrees(maps.normal, SCENE.normal)[inside].max() < 0.1
    assert np.allclose(maps.diffuse_albedo[inside], SCENE.albedo[inside], rtol=3e-3)
    assert np.allclose(maps.specular[inside], 0.04, atol=0.002)
    write(tmp_path / "crossed", {"cross": diffuse / 2}, polarizer_leak=leak)
    relit("solve", tmp_path / "crossed", "--out", tmp_path / "none").refused("polarizer_leak: is 0.05, and no frame has polarization")


def test_metal_has_the_normal_of_its_highlight(relit, tmp_path, highlight):
    bright = 10 * highlight
    write(tmp_path, {"cross": np.full_like(bright, 1e-5).repeat(3, -1), "parallel": bright.repeat(3, -1) + 1e-5})
    maps, report, _ = relit.solve(tmp_path)
    assert np.array_equal(maps.mask, SCENE.mask)
    assert report["found"]["pixels_by_highlight_alone"] == SCENE.mask.sum()
    assert angles_degrees(maps.normal, SCENE.normal)[SCENE.mask].max() < 1  # ten times a dielectric's lobe is not quite a metal's
    assert np.allclose(maps.confidence[SCENE.mask], 0.2, atol=1e-3) and not maps.diffuse_albedo.any()


def test_gradient_is_the_default_for_gradient_frames(relit, tmp_path, diffuse, highlight):
    """And without a polariser colour tells the highlight from the diffuse, but where the cap is nearly grey."""
    write(tmp_path, {"none": diffuse + highlight})
    maps, report, _ = relit.solve(tmp_path)
    assert report["method"] == "gradient" and report["found"]["separation"] == "colour"
    assert maps.specular is None and maps.roughness is None  # light that leaks between the parts hides how sharp the lobe is
    grey = report["found"]["pixels_taken_as_diffuse"]
    solved = report["pixels"]["ok"] + report["pixels"]["ambiguous"]
    assert 0 < grey < solved / 2 and report["found"]["pixels_separated"] == solved - grey
    assert report["pixels"]["ambiguous"] >= grey  # and their status says so
    error, sure = angles_degrees(maps.normal, SCENE.normal), maps.confidence
    told = SCENE.mask & (maps.specular_normal.any(axis=-1))
    assert told.sum() == report["found"]["pixels_separated"]
    assert error[told].max() < 0.5  # half rounding over a chroma of a tenth
    assert sure[SCENE.mask & ~told].max() < 0.16 and np.median(sure[told]) > 0.15


def test_a_grey_object_is_taken_as_diffuse_and_the_report_says_so(relit, tmp_path, diffuse):
    write(tmp_path, {"none": np.repeat(diffuse[..., :1], 3, axis=-1)})
    maps, report, _ = relit.solve(tmp_path, code=1)  # all are ambiguous
    assert maps.specular_normal is None
    assert report["found"]["pixels_taken_as_diffuse"] == report["pixels"]["ambiguous"] == SCENE.mask.sum()
    assert angles_degrees(maps.normal, SCENE.normal)[SCENE.mask].max() < 0.08


def test_a_lamp_in_the_picture_is_bright_and_leaves_maps_that_can_be_read(relit, tmp_path, diffuse):
    inside = tuple(np.argwhere(SCENE.mask)[0])
    lit = diffuse.copy()
    lit[(slice(None), *inside)] *= 1e5
    write(tmp_path, {"cross": lit / 2})
    maps, *_ = relit.solve(tmp_path)
    assert maps.diffuse_albedo[inside].max() == np.finfo(np.float16).max


@pytest.mark.parametrize(("full", "signs", "said"), [
    (1.0, (1, -1), None), (1.0, (1,), None), (0.7, (1, -1), "axis x add up to 1.43 times the full frame"),
    (0.7, (1,), "a gradient, is brighter than the full frame")])
def test_a_full_frame_of_another_exposure_is_named(relit, tmp_path, diffuse, full, signs, said):
    """Without it nothing was said, and where highlights were told apart normals were 15° off at a σ of 4°."""
    kept = [number for number, (_, sign) in enumerate(PAIRS) if sign in signs]
    lights = [{"type": "gradient", "axis": PAIRS[n][0], "sign": PAIRS[n][1]} for n in kept] + [{"type": "full"}]
    write_lit(tmp_path, np.concatenate([diffuse[kept], full * (diffuse[:1] + diffuse[1:2])]), lights, mask=SCENE.mask, camera=CAMERA)
    outcome = relit("solve", tmp_path, "--out", tmp_path / "out", "--method", "gradient")
    warnings = json.loads((tmp_path / "out" / "report.json").read_text())["warnings"]
    assert outcome.err == "" and [said in each for each in warnings if each.startswith("frames: ")] == ([] if said is None else [True])


def test_polarisers_that_are_exchanged_are_named(relit, tmp_path, diffuse, highlight):
    write(tmp_path, {"cross": diffuse / 2 + highlight, "parallel": diffuse / 2})
    relit("solve", tmp_path, "--out", tmp_path / "out", "--method", "gradient")
    assert "cross images are brighter than the parallel ones" in (tmp_path / "out" / "report.json").read_text()


def test_a_perspective_camera(relit, tmp_path, diffuse):
    camera = {"projection": "perspective", "resolution": [SIZE, SIZE], "focal_px": [40, 40], "principal_px": [6, 6]}
    write(tmp_path, {"cross": diffuse / 2}, camera=camera)
    maps, report, _ = relit.solve(tmp_path)
    assert maps.specular_normal is None and report["found"]["separation"] == "crossed polariser"
    assert angles_degrees(maps.normal, SCENE.normal)[maps.mask].max() < 0.08


def test_info_takes_gradient_frames_and_names_what_is_missing(relit, tmp_path, diffuse):
    write(tmp_path, {"none": diffuse})
    outcome = relit("info", tmp_path)
    assert outcome.code == 0 and "6 gradient light" in outcome.out
    edit_manifest(tmp_path, frames=lambda frames: frames[:4])
    for command in (["info", tmp_path], ["solve", tmp_path, "--out", tmp_path / "out"]):
        assert "gradient capture lacks axis z" in relit.refused(*command)


def test_distant_methods_say_which_one_solves_gradients(relit, tmp_path, diffuse):
    write(tmp_path, {"none": diffuse})
    relit("solve", tmp_path, "--method", "lambert", "--out", tmp_path / "out").refused("--method gradient")
    assert not (tmp_path / "out").exists()


def test_a_pixel_between_doubtful_ones_is_as_doubtful():
    """Two doubtful regions with a line between them where occlusion and interreflection cancel."""
    doubt, inside = np.zeros((64, 64)), np.ones((64, 64), bool)
    doubt[:, 10:20], doubt[:, 21:31] = 12.0, 8.0
    found = neighbours_doubt(doubt, inside)
    assert (found[:, 20] == 12).all() and (found[:, 10:20] == 12).all()
    reach = 64 // PART
    assert (found[:, 32 + reach :] == 0).all() and (found[:, : 9 - reach] == 0).all()
    assert np.array_equal(neighbours_doubt(doubt.T, inside), found.T)


def test_it_is_the_largest_of_the_window():
    """Against a plain loop."""
    doubt = np.repeat(np.repeat(np.random.default_rng(1).uniform(0, 9, (16, 16)), 4, axis=0), 4, axis=1)
    found, reach = neighbours_doubt(doubt, np.ones((64, 64), bool)), 64 // PART
    smooth = np.sort([np.pad(doubt, 1)[r : r + 64, c : c + 64] for r in range(3) for c in range(3)], axis=0)[-3]
    for row, col in ((0, 0), (5, 63), (30, 31), (63, 12)):
        window = smooth[max(0, row - reach) : row + reach + 1, max(0, col - reach) : col + reach + 1]
        assert found[row, col] == np.float32(max(window.max(), doubt[row, col]))


def test_nothing_is_doubted_outside_the_mask():
    inside = np.zeros((20, 20), bool)
    assert not neighbours_doubt(np.zeros((20, 20)), inside).any()
    inside[5:15, 5:15] = True
    found = neighbours_doubt(np.where(inside, 3.0, 0.0), inside)
    assert (found[inside] == 3).all() and not found[~inside].any()
