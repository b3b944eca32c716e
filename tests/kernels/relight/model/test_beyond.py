"""Light from beyond the captured lights: how far it is, and how far the captured lights confirm a model there."""

import numpy as np
import pytest

from kernels.relight.model.beyond import LONGEST_REACH, compare_beyond, followed, inward_pairs, reach, share_beyond, spacing, trusted
from tests.kernels.relight.lights import AXES, icosahedron, scattered
from tests.kernels.relight.surfaces import LOBE, captured, facing, scattered_pixels
from tests.kernels.scenes import colours
from tests.reference import shading as reference
from tests.reference.sampling import lattice

LIGHTS = lattice(24, 45)
IRRADIANCE = 3 * colours(24, seed=4)
PAIRS = inward_pairs(LIGHTS)


def test_lights_are_apart_as_the_corners_of_an_icosahedron_are():
    """arccos(1 / √5); a light that is given twice counts once."""
    assert spacing(icosahedron()) == pytest.approx(np.arccos(1 / np.sqrt(5)))
    assert spacing(np.repeat(icosahedron(), 2, axis=0)) == pytest.approx(np.arccos(1 / np.sqrt(5)))
    assert spacing(AXES) == pytest.approx(np.pi / 2) and reach(AXES) == reach(AXES[:1]) == LONGEST_REACH


def test_light_is_beyond_from_one_to_two_spacings_of_the_nearest_light():
    apart = reach(LIGHTS)
    edge = LIGHTS[np.argmin(LIGHTS[:, 2])]
    away = np.cross(np.cross(edge, [0, 0, 1]), edge)  # along the great circle from +z through the outermost light, outwards
    away = -away / np.linalg.norm(away)
    for angle, expected in ((0, 0), (0.9, 0), (1.5, 0.5), (1.9, 0.9), (2.2, 1)):
        sample = np.cos(angle * apart) * edge + np.sin(angle * apart) * away
        assert (LIGHTS @ sample).argmax() == np.argmin(LIGHTS[:, 2])
        assert share_beyond(LIGHTS, sample[None])[0] == pytest.approx(expected, abs=1e-6)


def test_between_lights_all_around_nothing_is_beyond():
    for direction in (lattice(48, 180), icosahedron(), lattice(96, 180)):
        assert share_beyond(direction, scattered(4000, 1)).max() < 0.35


def test_lights_are_predicted_from_farther_inside():
    middle = LIGHTS.sum(axis=0)
    assert len(PAIRS) == len(LIGHTS) - 1
    assert (LIGHTS[PAIRS[:, 1]] @ middle > LIGHTS[PAIRS[:, 0]] @ middle).all()
    angle = np.arccos((LIGHTS[PAIRS[:, 0]] * LIGHTS[PAIRS[:, 1]]).sum(axis=1))
    assert np.abs(np.median(angle) / (2 * reach(LIGHTS)) - 1) < 0.1


def test_gains_are_added_and_losses_are_shares():
    change, picture, model = np.float32([[1, -1, -2, -1, -1]]), np.float32([[5, 5, 5, 5, -1]]), np.float32([[2, 2, 2, 0, 2]])
    np.testing.assert_array_equal(followed(change, picture, model), np.float32([[1, -2.5, -5, 0, 0]]))


def test_losses_are_trusted_as_at_the_median_pixel_at_least():
    change, trust = np.float32([[1, 1, 1], [-1, -1, -1]]), np.float32([0.2, 0.6, 1])
    np.testing.assert_array_equal(trusted(change, trust, 0.6), np.float32([[0.2, 0.6, 1], [-0.6, -0.6, -1]]))


def sums(pixels, readings, device, *, clipped=None):
    images, held = captured(pixels, readings, LIGHTS, IRRADIANCE, device, clipped=clipped)
    got = compare_beyond(images, PAIRS)
    return got.numpy()[:, : len(pixels.normal)], held


def twin(held, model, counts=1.0):
    """Σ missing · told and Σ told² in float64."""
    missing = held[PAIRS[:, 0]] - held[PAIRS[:, 1]]
    before, after = model[PAIRS[:, 1]], model[PAIRS[:, 0]]
    change = after - before
    loss = change * np.maximum(held[PAIRS[:, 1]], 0) / np.where(before > 0, before, 1)
    told = np.where(change < 0, loss, change) * counts
    return (missing * told).sum(axis=(0, 1)), (told**2).sum(axis=(0, 1))


@pytest.mark.parametrize("count", [1, 45])
@pytest.mark.parametrize("some", [False, True])
def test_sums_are_the_twins_and_leave_clipped_pairs_out(count, some, device):
    """Tolerance: the lobes in float32, which count as often as their differences are smaller than they are."""
    pixels = scattered_pixels(count, seed=count)
    model = reference.readings(pixels, LIGHTS)
    clipped = np.random.default_rng(1).random((len(LIGHTS), count)) < 0.2 if some else None
    got, held = sums(pixels, 0.1 + 0.7 * model, device, clipped=clipped)
    counts = 1.0 if clipped is None else ~(clipped[PAIRS[:, 0]] | clipped[PAIRS[:, 1]])[:, None]
    for ours, theirs in zip(got, twin(held, model, counts), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=50 * LOBE, atol=50 * LOBE * np.abs(theirs).max())


def test_a_model_that_is_twice_as_bright_tells_the_same_shares(device):
    """Surfaces that face the middle of the lights lose light outwards, so that β is one but for half rounding."""
    pixels = facing(40, normal=LIGHTS.mean(axis=0) / np.linalg.norm(LIGHTS.mean(axis=0)))
    (top, bottom), _ = sums(pixels, 0.5 * reference.readings(pixels, LIGHTS), device)
    np.testing.assert_allclose(top / bottom, 1, atol=0.01)
