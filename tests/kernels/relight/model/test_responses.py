"""Responses to directions against their twin, and frames as sums of them against the model shaded with each sample."""

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.relight.frames import combine
from kernels.relight.model import sources
from kernels.relight.model.responses import empty_responses, respond, shown_gloss
from kernels.relight.model.shading import shade_frames, upload_sources
from tests.kernels.relight.lights import scattered
from tests.kernels.relight.surfaces import FLOAT, LOBE, captured, pack_bytes, radiance, scattered_pixels, upload
from tests.kernels.scenes import colours
from tests.reference import shading as reference
from tests.reference.sampling import lattice

LIGHTS = lattice(12, 170)
IRRADIANCE = 2 * colours(12, seed=1)


def hidden_samples(count, rows, seed=0):
    """Far samples of unit energy between three rows of visibility each."""
    rng = np.random.default_rng(seed)
    return sources.far(scattered(count, seed), np.ones((count, 3)))._replace(
        occluder=rng.integers(-1, rows, (count, 3)).astype(np.int32), share=rng.dirichlet(np.ones(3), count).astype(np.float32))


def responses(pixels, given, visible, device):
    """[n, P] and [3, n, P] of respond, and what it filled."""
    surface = upload(pixels, device)
    found = empty_responses(given.count, surface.packs, device)
    respond(surface, upload_sources(given, device), pack_bytes(visible, device), found)
    count = len(pixels.normal)
    return (found.matt.numpy().reshape(given.count, -1)[:, :count],
            found.gloss.numpy().reshape(3, given.count, -1)[:, :, :count], found)


@pytest.mark.parametrize("count", [1, 45, 64])
def test_they_are_the_twin(count, device):
    pixels, given = scattered_pixels(count, seed=count), hidden_samples(30, 5, count)
    visible = np.random.default_rng(count).integers(0, 256, (5, count)).astype(np.uint8)
    matt, gloss, _ = responses(pixels, given, visible, device)
    for n in range(given.count):
        lit = reference.visibility(given.occluder[n], given.share[n], visible, count)
        diffuse, shine = reference.response(pixels.double(), given.place[n, :3].astype(float))
        np.testing.assert_allclose(pixels.albedo.T * matt[n], (diffuse * lit[:, None]).T, rtol=32 * FLOAT, atol=8 * FLOAT)
        np.testing.assert_allclose(gloss[:, n], (shine * lit[:, None]).T, rtol=LOBE, atol=8 * FLOAT)
    assert matt.max() > 0.1 and gloss.max() > 0.01


def test_memory_has_room_for_fewer_directions_and_pixels(device):
    """The same to the last bit, and in the memory that was there."""
    pixels, given, visible = scattered_pixels(40, seed=4), hidden_samples(9, 5, 4), np.full((5, 40), 255, np.uint8)
    matt, gloss, _ = responses(pixels, given, visible, device)
    chosen = np.array([0, 3, 8])
    surface = upload(pixels, device)
    memory = empty_responses(given.count, surface.packs + 3, device)
    room = memory.room(len(chosen), surface.packs)
    respond(surface, upload_sources(given.taken(chosen), device), pack_bytes(visible, device), room)
    np.testing.assert_array_equal(room.matt.numpy().reshape(3, -1)[:, :40], matt[chosen])
    np.testing.assert_array_equal(room.gloss.numpy().reshape(3, 3, -1)[:, :, :40], gloss[:, chosen])
    assert room.matt.ptr == memory.matt.ptr and room.gloss.ptr == memory.gloss.ptr


def test_gloss_is_as_bright_as_the_images_show_it(device):
    pixels = scattered_pixels(50, seed=2)
    own = sources.own_rows(sources.far(LIGHTS, IRRADIANCE))
    parts = reference.parts(pixels, LIGHTS)
    readings = parts.sum(axis=0) * np.random.default_rng(3).uniform(0.5, 1.6, 50)
    images, held = captured(pixels, readings, LIGHTS, IRRADIANCE, device)
    _, _, found = responses(pixels, own, np.full((len(LIGHTS), 50), 255, np.uint8), device)
    got = shown_gloss(images, found)
    ratio = reference.shown(held, parts)
    assert ratio.min() < 0.8 and ratio.max() == 1.25
    got = got.numpy().reshape(3, len(LIGHTS), -1)[:, :, :50]
    np.testing.assert_allclose(got, (ratio * parts[1]).swapaxes(0, 1), rtol=3 * LOBE, atol=8 * FLOAT)


def test_a_frame_is_the_sum_of_its_samples(device):
    """The same samples by responses and weights, by their own frame, and shaded: to the float32 rounding of their sum."""
    pixels, given = scattered_pixels(70, seed=4), hidden_samples(40, 6, 5)
    visible = np.random.default_rng(6).integers(0, 256, (6, 70)).astype(np.uint8)
    energy = np.random.default_rng(7).gamma(1.0, 1.0, (3, 40, 3)).astype(np.float32)
    _, _, found = responses(pixels, given, visible, device)
    matt = combine.combine_rows(found.matt, np.ascontiguousarray(energy.swapaxes(1, 2)).reshape(9, 1, 40)).numpy().reshape(3, 3, -1)
    gloss = combine.combine_rows(found.gloss, np.ascontiguousarray(energy.swapaxes(1, 2))).numpy()
    frames = [given._replace(energy=each) for each in energy]
    several = shade_frames(upload(pixels, device), upload_sources(sources.join(frames), device, [40] * 3),
                           pack_bytes(visible, device)).numpy()
    for frame, each in enumerate(frames):
        whole = radiance(pixels, each, device, visible)
        np.testing.assert_allclose(pixels.albedo.T * matt[frame, :, :70], whole[:3], rtol=60 * FLOAT, atol=1e-6)
        np.testing.assert_allclose(gloss[frame, :, :70], whole[3:], rtol=60 * FLOAT, atol=1e-6)
        np.testing.assert_allclose(several[frame, :, :70], whole, rtol=60 * FLOAT, atol=1e-6)


def test_frames_may_have_no_samples(device):
    pixels, given = scattered_pixels(40), hidden_samples(7, 2)
    frames = upload_sources(given, device, [0, 7, 0])
    got = shade_frames(upload(pixels, device), frames, pack_bytes(np.full((2, 40), 255, np.uint8), device)).numpy()
    assert (got[[0, 2]] == 0).all() and got[1].max() > 0


def test_near_samples_are_refused(device):
    near = sources.point(np.array([0, 0, 2.0]), np.ones(3))
    with pytest.raises(ArrayError, match="samples are 1, 1 of them near, for frames of 1: give the far"):
        upload_sources(near, device, [1])
    with pytest.raises(ArrayError, match="samples are 7, 0 of them near, for frames of 6"):
        upload_sources(hidden_samples(7, 2), device, [2, 4])
