"""The matte of a capture against the exact coverage of a rendered outline, and backgrounds that must not fool it."""

import cv2
import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.results.matte import Matte, MatteSource, matte_of
from stage.stack.ingest import open_stack
from tests.marks import first_short
from tests.scenes.captures import edit_manifest
from tests.scenes.coverage import Covered, render_covered, write_covered


def found(folder, scene: Covered, mask=None, **options) -> Matte:
    capture = Capture.open(write_covered(folder, scene, scene.coverage > 0.5 if mask is None else mask, **options))
    return matte_of(capture, open_stack(capture))


def edge_error(scene: Covered, coverage, grey=None, factor=None):
    """Mean error over the partly covered pixels: of the coverage, or of the picture under all lights over a grey, as a share of it."""
    partly = (scene.coverage > 0.01) & (scene.coverage < 0.99)
    if grey is None:
        return np.abs(coverage - scene.coverage)[partly].mean()
    truth = scene.object.mean(axis=0) + (1 - scene.coverage[..., None]) * grey
    over = scene.images.mean(axis=0) * factor[..., None] + (1 - coverage[..., None]) * grey
    return (np.abs(over - truth)[partly] / grey).mean()


@first_short(("options", "most"), [
    ({}, 0.05), ({"lights": 96, "size": 64}, 0.05), ({"lowest": 0.5}, 0.09), ({"hole": 0.15}, 0.06),
], ids=["lights around", "many lights", "lights in front", "a hole"])
def test_coverage_of_a_hard_mask_is_estimated_from_the_images(tmp_path, options, most):
    """The limits are what shading that changes within a pixel of the rim leaves open: more where no light comes from the side."""
    scene = render_covered(**options)
    matte = found(tmp_path, scene)
    assert matte.source is MatteSource.IMAGES and matte.hard == 0
    hard = np.float32(scene.coverage > 0.5)
    assert edge_error(scene, hard) > 0.17 and edge_error(scene, matte.coverage) < most
    assert np.abs(matte.coverage - scene.coverage).max() < 0.35
    for grey in (0.18, 0.5):
        assert edge_error(scene, hard, grey, hard * 0 + 1) > 0.17 and edge_error(scene, matte.coverage, grey, matte.factor) < most
    away = cv2.distanceTransform(np.uint8(scene.coverage == 0), cv2.DIST_L2, 5) > 3
    assert not matte.coverage[away].any() and not matte.factor[away].any()
    assert set(np.unique(matte.factor)) == {0, 1}  # the images hold radiance times coverage already


@pytest.mark.long
@pytest.mark.parametrize("change", [cv2.dilate, cv2.erode])
def test_a_mask_that_is_a_pixel_off_has_the_same_coverage(tmp_path, change):
    scene = render_covered(size=64)
    mask = change(np.uint8(scene.coverage > 0.5), np.ones((3, 3))) > 0
    assert edge_error(scene, np.float32(mask)) > 0.35
    assert edge_error(scene, found(tmp_path, scene, mask).coverage) < 0.05


@pytest.mark.long
def test_a_rim_that_is_black_under_every_light_follows_the_mask(tmp_path):
    """As that of a mirror, here along the left half: the images cannot tell it from the background."""
    scene = render_covered(size=64, lights=16)
    depth = cv2.distanceTransform(np.uint8(scene.coverage > 0.5), cv2.DIST_L2, 5)
    black = (depth < 2.5) & (np.arange(64) < 32)
    matte = found(tmp_path, scene._replace(images=scene.images * np.where(black, 0.01, 1)[..., None]))
    assert matte.source is MatteSource.IMAGES
    left, right = (scene._replace(coverage=np.where((np.arange(64) < 32) == side, scene.coverage, 0)) for side in (True, False))
    assert edge_error(right, matte.coverage) < 0.06
    assert edge_error(left, matte.coverage) < 0.15 < edge_error(left, np.float32(scene.coverage > 0.5))  # a smoothed mask
    whole = (scene.coverage == 1) & (np.arange(64) < 28)  # away from where the black rim begins
    assert matte.coverage[whole].min() > 0.4 and matte.coverage[whole].mean() > 0.99  # the filter rounds the tip of the ellipse


@pytest.mark.long
@pytest.mark.parametrize("blur_px", [1.2, 3.0])
def test_an_object_out_of_focus_has_a_wide_border(tmp_path, blur_px):
    scene = render_covered(size=80, lights=16)

    def blurred(image):
        return cv2.GaussianBlur(image, (0, 0), blur_px)

    scene = Covered(blurred(scene.coverage), scene.directions, np.stack([blurred(image) for image in scene.images]),
                    np.stack([blurred(image) for image in scene.object]))
    matte = found(tmp_path, scene)
    assert matte.source is MatteSource.IMAGES
    # of a rim that is wider than its shading is even, the more the wider
    assert edge_error(scene, matte.coverage) < 0.05 * blur_px**0.5 < edge_error(scene, np.float32(scene.coverage > 0.5))


@pytest.mark.long
def test_a_lit_wall_with_moving_shadows_is_kept(tmp_path):
    """The mask cannot be softened, and a picture of the whole is whole."""
    matte = found(tmp_path, render_covered(background=0.4))
    assert matte.source is MatteSource.BACKGROUND and (matte.coverage == 1).all() and (matte.factor == 1).all()


@pytest.mark.long
def test_a_wall_beside_a_part_of_the_object_has_a_hard_border(tmp_path):
    scene, lit = render_covered(), render_covered(background=0.4)
    rows = np.arange(48) < 18  # the upper part of the ellipse
    images = np.where(rows[:, None, None], lit.images, scene.images)
    matte = found(tmp_path, scene._replace(images=images))
    assert matte.source is MatteSource.IMAGES and 0.05 < matte.hard < 0.5
    assert set(np.unique(matte.coverage[:16])) == {0, 1} and (matte.factor[:16] == matte.coverage[:16]).all()
    low = scene._replace(coverage=np.where(rows[:, None], 0, scene.coverage))
    assert edge_error(low, matte.coverage) < 0.08  # the row beside the wall is lit by it


def test_partial_values_of_a_mask_are_the_coverage(tmp_path):
    dark, lit = (render_covered(background=background) for background in (0.0, 0.4))
    for name, scene in (("dark", dark), ("lit", lit)):
        matte = found(tmp_path / name, scene, scene.coverage)
        assert matte.source is MatteSource.MASK_IMAGE
        assert np.allclose(matte.coverage, scene.coverage, atol=1e-4)  # 16 bits
        partly = (scene.coverage > 0) & (scene.coverage < 1)
        # before a black wall the images are premultiplied; before a lit one they have to be
        expected = np.where(scene.coverage > 0, 1, 0) if name == "dark" else scene.coverage
        assert np.abs(matte.factor - expected)[partly].mean() < 0.02


@pytest.mark.long
@pytest.mark.parametrize("background", [0.0, 0.4])
@pytest.mark.parametrize("covered", [0.25, 0.625])
def test_partial_values_without_a_pixel_of_the_background_alone(tmp_path, background, covered):
    """A tight crop of which the last column is partly covered; at most pixels the mask says more than a half, or at all."""
    scene = render_covered()
    inner = scene.images[:, 16:32, 16:32].copy()
    assert (scene.coverage[16:32, 16:32] == 1).all()
    coverage = np.ones((16, 16))
    coverage[:, -1] = covered
    wall = background * np.maximum(scene.directions[:, 2], 0)[:, None, None]
    inner[:, :, -1] = covered * inner[:, :, -1] + (1 - covered) * wall
    matte = found(tmp_path, Covered(coverage, scene.directions, inner, inner), coverage)
    assert matte.source is MatteSource.MASK_IMAGE
    assert np.allclose(matte.coverage, coverage, atol=1e-4)  # 16 bits
    assert np.allclose(matte.factor, 1 if background == 0 else coverage, atol=1e-4)


@pytest.mark.long
def test_images_that_are_cut_along_the_mask_keep_their_whole_border(tmp_path):
    scene = render_covered()
    whole = cv2.erode(np.uint8(scene.coverage == 1), np.ones((3, 3))) > 0
    matte = found(tmp_path, scene, whole, cut=True)
    assert matte.source is MatteSource.MASK and matte.hard == 0 and np.array_equal(matte.coverage, whole)


@first_short("change", ["few lights", "a thin rod"])
def test_what_the_images_do_not_show_stays_hard(tmp_path, change):
    scene = render_covered(lights=5) if change == "few lights" else render_covered(radii=(0.9, 0.02))
    matte = found(tmp_path, scene)
    assert matte.source is MatteSource.MASK and matte.hard == 1 and np.array_equal(matte.coverage, scene.coverage > 0.5)


@pytest.mark.parametrize("shape", ["no mask", "everything", "one pixel", "all but one"])
def test_masks_at_their_limits(tmp_path, shape):
    scene = render_covered(size=12, lights=8)
    mask = np.full((12, 12), shape in ("everything", "all but one"))
    mask[6, 6] = shape == "one pixel"
    if shape in ("no mask", "everything"):
        mask[:] = True
    folder = write_covered(tmp_path, scene, mask)
    if shape == "no mask":
        edit_manifest(folder, mask=None)
    capture = Capture.open(folder)
    matte = matte_of(capture, open_stack(capture))
    assert np.isfinite(matte.coverage).all() and matte.coverage.min() >= 0 and matte.coverage.max() <= 1
    if shape in ("no mask", "everything"):
        assert (matte.coverage == 1).all() and (matte.factor == 1).all()


def test_an_object_under_no_light_at_all(tmp_path):
    scene = render_covered(size=24, lights=8)
    matte = found(tmp_path, scene._replace(images=scene.images * 0))
    assert np.isfinite(matte.coverage).all() and np.isfinite(matte.factor).all()
