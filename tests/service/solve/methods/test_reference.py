"""relit solve --method reference: a ball of the same, unknown material under the same lights, which need not be known either."""

import json

import numpy as np
import pytest

from stage.formats import exr
from tests.marks import first_short
from tests.reference.sampling import lattice
from tests.scenes.captures import angles_degrees, distant, edit_frame, edit_manifest, write_image, write_lit

LIGHTS, SIDE = 24, 40
RNG = np.random.default_rng(5)
DIRECTIONS = lattice(LIGHTS, 75.5225)
STRENGTH = RNG.uniform(0.5, 2.0, (LIGHTS, 3))


def velvet(normal: np.ndarray) -> np.ndarray:
    """[n, lights] of no textbook's material: flat, brighter at the rim, with a wide highlight off the mirror direction."""
    cosine = np.maximum(normal @ DIRECTIONS.T, 0)
    half = DIRECTIONS + [0.0, 0.0, 0.8]
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    rim = (1 - normal[:, 2:]) ** 2
    return cosine**0.6 * (0.3 + 0.5 * rim) + 0.6 * np.maximum(normal @ half.T, 0) ** 40 * (cosine > 0)


def surface(side: int, stretch: float) -> tuple[np.ndarray, np.ndarray]:
    """Normals [side, side, 3] and mask of an ellipsoid z = stretch · √(1 - x² - y²)."""
    centre = ((np.arange(side) + 0.5) / side * 2 - 1) * 1.06
    x, y = np.meshgrid(centre, -centre)
    mask = x**2 + y**2 < 1
    z = np.sqrt(np.where(mask, 1 - x**2 - y**2, 1))
    normal = np.stack([stretch * x, stretch * y, z], axis=-1)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True), mask


def write(folder, normal, mask, albedo, *, shade=velvet, noise=0.0):
    radiance = shade(normal[mask])[..., None] * STRENGTH * albedo
    radiance = radiance * (1 + noise * np.random.default_rng(7).normal(size=radiance.shape))
    images = np.zeros((LIGHTS, *mask.shape, 3))
    images[:, mask] = radiance.swapaxes(0, 1)
    return write_lit(folder, images, [distant(direction, 1.0) for direction in DIRECTIONS], mask=mask,
                     camera={"projection": "orthographic", "resolution": list(mask.shape[::-1])})


@pytest.fixture
def captures(tmp_path):
    """The object, whose albedo varies, and the ball."""
    normal, mask = surface(SIDE, 0.6)
    albedo = RNG.uniform(0.3, 0.9, (mask.sum(), 1, 1))
    write(tmp_path / "object", normal, mask, albedo)
    write(tmp_path / "ball", *surface(140, 1.0), 0.5)
    return tmp_path


def by_ball(relit, captures, *options, **more):
    return relit.solve(captures / "object", "--method", "reference", "--reference-ball", captures / "ball", *options,
                       out=captures / "out", **more)


@pytest.mark.long
def test_normals_of_a_material_without_a_model(relit, captures):
    maps, *_ = by_ball(relit, captures, "--cache", captures / "cache")
    normal, mask = surface(SIDE, 0.6)
    error = angles_degrees(maps.normal, normal)[mask]
    assert np.array_equal(maps.mask, mask) and error.mean() < 0.3  # the pixels of the ball are 0.9 degrees apart
    assert error[normal[mask][:, 2] > 0.3].max() < 2  # its last pixel inside the rim is at 78 degrees
    by_model = angles_degrees(relit.solve(captures / "object", "--method", "svbrdf", code=None).maps.normal, normal)[mask]
    assert by_model.mean() > 5 * error.mean()


def chrome(normal: np.ndarray) -> np.ndarray:
    """[n, lights] of polished metal: a sharp highlight alone."""
    half = DIRECTIONS + [0.0, 0.0, 1.0]
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    return np.maximum(normal @ half.T, 0) ** 60 * (normal @ DIRECTIONS.T > 0) + 1e-3


@pytest.mark.long
def test_a_ball_of_another_material_is_named_and_widens_sigma(relit, captures):
    write(captures / "ball", *surface(140, 1.0), 0.5, shade=chrome)
    maps, report, said = by_ball(relit, captures, code=None)
    assert "the ball is of another material" in report["warnings"][0]
    assert report["found"]["reference"]["unexplained_over_noise"] > 2
    assert "another material" in said
    normal, mask = surface(SIDE, 0.6)
    error, sigma = angles_degrees(maps.normal, normal), maps.sigma
    assert error[mask].mean() > 10  # the wrong ball gives wrong normals
    kept = maps.mask
    assert not kept.any() or 0.3 < np.median(error[kept] / sigma[kept]) < 1.6  # and says so at each pixel
    assert (error[kept] > np.maximum(5 * sigma[kept], 5)).sum() <= 0.01 * mask.sum()
    assert maps.confidence[mask].max() < 0.5


@pytest.mark.long
def test_the_right_ball_raises_no_alarm_under_noise(relit, captures):
    for folder, shape in (("object", surface(SIDE, 0.6)), ("ball", surface(140, 1.0))):
        write(captures / folder, *shape, 0.5, noise=0.02)
    maps, report, _ = by_ball(relit, captures)
    assert report["warnings"] == [] and report["found"]["reference"]["unexplained_over_noise"] < 1.3
    normal, mask = surface(SIDE, 0.6)
    inner = mask & (normal[..., 2] > 0.3)  # further out the ball has no pixels
    ratio = angles_degrees(maps.normal, normal)[inner] / maps.sigma[inner]
    assert 0.4 < np.median(ratio) < 1.4 and (ratio > 5).mean() < 0.01
    assert np.median(maps.confidence[inner]) > 0.6


@pytest.mark.long
def test_what_is_not_estimated_is_absent(relit, captures):
    _, report, _ = by_ball(relit, captures)
    channels, _ = exr.read(captures / "out" / "maps.exr")
    assert {name.partition(".")[0] for name in channels} == {"normal", "height", "sigma", "confidence", "status", "mask"}
    assert report["found"]["reference"]["radius_px"] == pytest.approx(70 / 1.06, abs=0.5)
    assert report["options"]["reference_ball"] == str(captures / "ball")
    options = json.loads(exr.read_header(captures / "out" / "maps.exr").metadata["relit:options"])
    assert options["method"] == "reference"
    assert options["reference_ball"] == report["found"]["reference"]["content"]  # its content, not its path


@pytest.mark.parametrize("arguments", [("--method", "reference"), ("--reference-ball", "ball")])
def test_method_and_ball_go_together(relit, captures, arguments):
    words = (captures / word if word == "ball" else word for word in arguments)
    said = relit.refused("solve", captures / "object", "--out", captures / "out", *words)
    assert "--method reference and --reference-ball CAPTURE go together" in said


FAULTS = {
    "other lights": (lambda ball: edit_frame(ball, 3, light={"type": "distant", "direction": [0, 0, 1], "irradiance": [1, 1, 1]}),
                     "the light of 003.exr is not that of 003.exr of the capture"),
    "fewer lights": (lambda ball: edit_frame(ball, 3, light={"type": "off"}), "23 are lit, the capture has 24"),
    "no mask": (lambda ball: edit_manifest(ball, mask=None), "mask: is missing: it says where the ball is"),
    "no ball": (lambda ball: write_image(ball / "mask.png", np.pad(np.full((90, 10), 255, np.uint8), ((25, 25), (65, 65)))), "ball"),
    "perspective": (lambda ball: edit_manifest(ball, camera={"projection": "perspective", "resolution": [140, 140],
                                                             "focal_px": [300, 300], "principal_px": [70, 70]}),
                    "camera.projection: is perspective"),
}


@first_short("fault", FAULTS)
def test_what_is_no_reference_is_refused(relit, captures, fault):
    change, words = FAULTS[fault]
    change(captures / "ball")
    assert words in relit.refused("solve", captures / "object", "--method", "reference", "--reference-ball", captures / "ball",
                                  "--out", captures / "out")
    assert not (captures / "out").exists()
