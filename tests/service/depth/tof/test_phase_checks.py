"""Phases that are declared backwards, or of other frequencies, and fog: named, and no range is believed. The room, its images and their
noise are those of tests/reference/tof.py."""

import numpy as np
import pytest

from tests.marks import first_short
from tests.reference import tof
from tests.scenes.depth import depth_of
from tests.scenes.tof import cw_frames, pulsed_frames, write

ROWS, COLS = 72, 96
VIEW = tof.room(ROWS, COLS)
HZ = (20e6, 50e6, 60e6)


def bowl():
    """The inside of half a sphere, its middle 1.5 m away, whose walls are darker where they come nearer; around it a black wall."""
    y, x = np.mgrid[0:ROWS, 0:COLS] + 0.5
    ray = np.stack([(x - COLS / 2) / 90, (y - ROWS / 2) / 90, np.ones((ROWS, COLS))], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    root = ray[..., 2]**2 - (1 - 0.5**2)
    distance = ray[..., 2] + np.sqrt(np.maximum(root, 0))
    normal = (ray * distance[..., None] - [0, 0, 1]) / 0.5
    return tof.View(np.where(root > 0, distance, 1.5), np.where(root > 0, 0.6, 0.02), np.where(root > 0, (normal * ray).sum(axis=-1), 1))


def painted():
    """A relief whose hollows are painted bright."""
    y, x = np.mgrid[0:ROWS, 0:COLS] / np.array([ROWS, COLS]).reshape(2, 1, 1)
    distance = 2 + 0.05 * np.sin(12 * x) * np.cos(9 * y)
    return tof.View(distance, 0.2 + 7 * (distance - 1.95), np.ones(distance.shape))


def textured(*, curved):
    """A corner of two walls, or a hollow about the camera, whose albedo is another one at every pixel."""
    y, x = np.mgrid[0:ROWS, 0:COLS] + 0.5
    ray = np.stack([(x - COLS / 2) / 90, (y - ROWS / 2) / 90, np.ones((ROWS, COLS))], axis=-1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    albedo = np.random.default_rng(5).uniform(0.1, 0.9, (ROWS, COLS))
    if curved:  # a sphere of 0.9 m whose middle is 1.5 m away: bent as a plane is whose range is 2.5 m less its own
        distance = 0.6 * ray[..., 2] + np.sqrt(0.9**2 - 0.6**2 * (1 - ray[..., 2] ** 2))
        return tof.View(distance, albedo, ((distance[..., None] * ray - [0, 0, 0.6]) / 0.9 * ray).sum(axis=-1))
    normals = np.array([[1, 0, 1], [-1, 0, 1]]) / np.sqrt(2)
    cosine = (ray @ normals.T).max(axis=-1)
    return tof.View(1.4 / cosine, albedo, cosine)


def measured(folder, images, settings):
    """What relit depth makes of correlation images under these declarations."""
    write(folder, cw_frames(images, settings), camera={"projection": "perspective", "resolution": [COLS, ROWS], "focal_px": [90.0, 90.0]})
    return depth_of(folder)


def under(hz=HZ, phases=4, **more):
    """Images of the room and their true settings."""
    settings = tof.even(hz, phases)
    return tof.correlations(VIEW, 2e5, settings, ambient=30, seed=3, **more), settings


def backwards(hz, delta):
    return hz, -delta % (2 * np.pi)


@pytest.mark.parametrize(("hz", "phases", "declared", "words"), [
    *((hz, phases, backwards, "phases ran backwards") for hz, phases in ((HZ, 4), (HZ, 3), ((30e6, 70e6), 4), ((12e6,), 4))),
    (HZ, 4, lambda hz, delta: backwards(hz, delta) if hz == 50e6 else (hz, delta), "the phases of 50 MHz run backwards"),
    (HZ, 4, lambda hz, delta: (hz, (delta - np.pi / 2) % (2 * np.pi)), "reference_phase_rad is a quarter of a turn more"),
    (HZ, 4, lambda hz, delta: ({50e6: 52e6}.get(hz, hz), delta), "52 MHz are 50 MHz"),
    *(pytest.param(of, 4, lambda hz, delta, told=told: (told.get(hz, hz), delta), words, marks=pytest.mark.long) for of, told, words in (
        (HZ, {60e6: 57e6}, "57 MHz are 60 MHz"), (HZ, {20e6: 60e6, 60e6: 20e6}, "20 and 60 MHz are exchanged"),
        ((16e6, 120e6), {120e6: 126e6}, "126 MHz are 120 MHz"))),  # 95 % of the ranges were 9 m off
], ids=["backwards", "three phases", "two frequencies", "one", "one of three", "a quarter aside", "52 MHz", "57 MHz", "exchanged",
        "126 MHz"])
def test_a_wrong_declaration_is_named(tmp_path, hz, phases, declared, words):
    images, settings = under(hz, phases)
    result = measured(tmp_path, images, [declared(*setting) for setting in settings])
    assert not result.maps.mask.any() and words in result.warnings[0]


def without(images, lost, of=None):
    images = images.copy()
    images[lost] = 3.0 if of is None else images[of] if isinstance(of, int) else of * images[lost]
    return images


@first_short(("hz", "fault", "words"), [
    (HZ, lambda images: without(images, 4, 0.8), "50 MHz at 120° is 0.8 times"),
    (HZ, lambda images: images[[1, 0, *range(2, 9)]], "order 2, 1, 3"),
    ((60e6,), lambda images: without(images, 1, 0), "shows what that at 0° shows"),
    ((60e6,), lambda images: without(images, 2), "60 MHz at 240° has one reading"),
], ids=["darker", "exchanged", "shown twice", "blank"])
def test_an_image_of_three_is_named(tmp_path, hz, fault, words):
    """Three images fit any wave: they were wiggling or fog, and under one frequency believed without a word."""
    images, settings = under(hz, 3)
    result = measured(tmp_path, fault(images), settings)
    assert not result.maps.mask.any() and words in result.warnings[0]


@pytest.mark.parametrize("hz", [HZ, (60e6,)], ids=["three", "one"])
def test_planes_with_texture_tell_that_phases_run_backwards(tmp_path, hz):
    """The texture hides how brightness changes with the range: the planes bend as reversed planes do."""
    settings = tof.even(hz, 4)
    images = tof.correlations(textured(curved=False), 2e5, settings, ambient=30, seed=3)
    right = measured(tmp_path / "right", images, settings)
    assert not right.warnings and right.maps.mask.mean() > 0.95
    result = measured(tmp_path / "backwards", images, [backwards(*setting) for setting in settings])
    assert not result.maps.mask.any()
    assert "plane if ranges are reversed" in result.warnings[0]


@pytest.mark.long
@pytest.mark.parametrize("reverse", [True, False], ids=["last bin first", "right"])
def test_histograms_whose_last_bin_comes_first_are_named(tmp_path, reverse):
    counts = tof.histogram(textured(curved=False), 20000, bins=48, bin_s=4e-10, sigma_s=5e-10, seed=3)
    write(tmp_path, pulsed_frames(counts[..., ::-1] if reverse else counts, bin_s=4e-10),
          camera={"projection": "perspective", "resolution": [COLS, ROWS], "focal_px": [90.0, 90.0]})
    result = depth_of(tmp_path)
    assert any("check the order of the bins" in said for said in result.warnings) == reverse and (result.maps.mask.mean() > 0.95) != reverse


@pytest.mark.parametrize("hz", [HZ, (12e6,)], ids=["three", "one"])
def test_readings_that_stop_at_one_level_are_saturated(tmp_path, hz):
    """A camera that was full in one reading of seven: what is left is right. An even wall without noise is not called full."""
    images, settings = under(hz)
    full = np.percentile(images, 85)
    clipped = measured(tmp_path / "clipped", np.minimum(images, full), settings)
    off = (np.abs(clipped.maps.range - VIEW.distance) / np.maximum(clipped.maps.sigma, 1e-9))[clipped.maps.mask]
    assert "those of a full camera" in clipped.warnings[0] and len(clipped.warnings) == 1
    assert clipped.maps.mask.mean() > 0.5 and (off > 5).mean() < 0.02
    even = tof.View(np.full((ROWS, COLS), 1.3), np.full((ROWS, COLS), 0.5), np.ones((ROWS, COLS)))
    assert not any("full" in said for said in measured(tmp_path / "even", tof.correlations(even, 2e5, settings), settings).warnings)


def test_fog_is_not_believed(tmp_path):
    """Fog scatters light from all depths before a surface, here 2 % a metre, and most of it from near the camera."""
    images, settings = under()
    near = np.arange(0.25, 8.0, 0.05)
    for image, (hz, delta) in zip(images, settings, strict=True):
        for at in near:
            image += 2e5 * 0.02 / 4 / at**2 * 0.05 * (1 + np.cos(4 * np.pi * hz * at / tof.LIGHT - delta)) * (at < VIEW.distance)
    result = measured(tmp_path, images, settings)
    error = np.abs(result.maps.range - VIEW.distance)[result.maps.mask]
    assert (error > 0.1).sum() < 0.01 * VIEW.distance.size
    assert "as in fog" in result.warnings[0]


@pytest.mark.parametrize("view", [bowl(), painted(), textured(curved=True)], ids=["bowl", "painted", "textured hollow"])
@pytest.mark.parametrize("hz", [HZ, (60e6,)], ids=["three", "one"])
def test_surfaces_that_grow_brighter_with_the_distance_are_believed(tmp_path, view, hz):
    """Light does not fall with the distances that they have if the phases run backwards."""
    settings = tof.even(hz, 4)
    result = measured(tmp_path, tof.correlations(view, 2e5, settings, ambient=30, seed=3), settings)
    assert not result.warnings
    assert result.maps.mask[view.albedo > 0.1].mean() > 0.95


@pytest.mark.parametrize("more", [{}, {"harmonics": {3: 0.06}}], ids=["cosine", "wiggling"])
def test_what_is_declared_rightly_is_believed(tmp_path, more):
    images, settings = under(**more)
    result = measured(tmp_path, images, settings)
    assert result.maps.mask.mean() > 0.95
    assert not any("believed" in sentence for sentence in result.warnings)


@pytest.mark.parametrize(("hz", "phases"), [((60e6,), 4), ((60e6, 90e6), 3)], ids=["one frequency", "two"])
def test_surfaces_behind_the_span_are_named(tmp_path, hz, phases):
    """A floor that runs from 2 to 6 m: the phases repeat after 2.5 and 5 m. From 2 m on the second pair tells its ranges apart."""
    range_m = np.linspace(6, 2, ROWS)[:, None] + np.zeros((ROWS, COLS))
    settings = tof.even(hz, phases)
    images = tof.correlations(tof.View(range_m, np.full(range_m.shape, 0.5), np.ones(range_m.shape)), 2e5, settings, ambient=30, seed=3)
    found = measured(tmp_path, images, settings)
    assert not found.maps.mask.any() and "run on from" in found.warnings[0]
    if len(hz) > 1:
        found = depth_of(tmp_path, near_m=1.5)
        assert found.maps.mask.mean() > 0.9 and np.abs(found.maps.range - range_m)[found.maps.mask].max() < 0.1


@pytest.mark.parametrize("fault", ["dark", "shown twice", "exchanged"])
def test_an_image_that_is_not_that_of_its_phase_is_named(tmp_path, fault):
    """Two frequencies of four images: what the wave leaves is many times what neighbours in a row differ by."""
    images, settings = under((40e6, 70e6))
    if fault == "exchanged":
        images[[0, 1]] = images[[1, 0]]
    else:
        images[5] = 0 if fault == "dark" else images[4]
    found = measured(tmp_path, images, settings)
    assert not found.maps.mask.any() and f"images of {40 if fault == 'exchanged' else 70} MHz are no wave" in found.warnings[0]


def test_rows_that_an_image_lost_are_unsure(tmp_path):
    """A sixth of one image is dark: the other three still make a range. Where the dark image would have read little, it is right."""
    images, settings = under((20e6, 50e6))
    images[1].reshape(ROWS, COLS)[60:] = 0
    result = measured(tmp_path, images, settings)
    far = np.abs(result.maps.range - VIEW.distance) > 5 * result.maps.sigma
    assert result.maps.mask[:58].mean() > 0.95 and not (far & result.maps.mask)[60:].any()  # 27 % of these rows before
    assert "no wave over their phases, as where rows" in result.warnings[0]
