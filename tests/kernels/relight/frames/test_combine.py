import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from kernels import device as devices
from kernels import packs
from kernels.errors import ArrayError
from kernels.packs import pack_type
from kernels.relight.frames import combine as combining
from tests.kernels.scenes import colours, shade, store
from tests.reference.relight import weighted_sum
from tests.reference.sampling import lattice

PIXEL_COUNTS = [1, 31, 33, 4097]
FRAMES = [1, 3, 7, 33]
MANY = 120_001
"""Pixels of hundreds of chunks, the last of which is not full."""


def captured(lights, pixels, seed=0):
    rng = np.random.default_rng(seed)
    return store(rng.gamma(1.0, 1.0, (3, lights, pixels)))


def drawn(shape, seed=1):
    return np.random.default_rng(seed).normal(0, 1, shape).astype(np.float32)


def close(got, stack, weights):
    """Each sum over L lights in float32 is off by at most L · 2⁻²⁴ of the sum of its absolute terms."""
    bound = weights.shape[-1] * 2.0**-24 * weighted_sum(np.abs(stack), np.abs(weights))
    return (np.abs(got - weighted_sum(stack, weights)) <= bound).all()


@pytest.mark.parametrize("pixels", PIXEL_COUNTS)
@pytest.mark.parametrize("lights", [1, 8, 41])
def test_one_frame_is_the_weighted_sum(lights, pixels, device):
    stack = captured(lights, pixels)
    weights = drawn((3, stack.shape[1]))
    frame = combining.combine(packs.upload(stack, device=device), weights).numpy()
    assert close(frame[:, :pixels], stack, weights)
    assert (frame[:, pixels:] == 0).all()


@pytest.mark.parametrize("frames", FRAMES)
@pytest.mark.parametrize("pixels", [1, 33, 1000])
def test_a_batch_is_its_frames(pixels, frames, device):
    stack = captured(21, pixels)
    weights = drawn((frames, 3, 24))
    got = combining.combine_batch(packs.upload(stack, device=device), weights).numpy()
    assert got.shape[:2] == (frames, 3)
    for f in range(frames):
        assert close(got[f, :, :pixels], stack, weights[f])


def test_a_frame_is_the_same_to_the_last_bit_whichever_others_are_made(device):
    stack, weights = captured(21, 1000), drawn((19, 3, 24))
    band = packs.upload(stack, device=device)
    whole = combining.combine_batch(band, weights).numpy()
    for kept in ([3], [18, 0], list(range(5, 17))):
        assert np.array_equal(combining.combine_batch(band, weights[kept]).numpy(), whole[kept])


@pytest.mark.long
def test_a_batch_of_many_chunks(device):
    stack = captured(40, MANY)
    weights = drawn((2, 3, 40))
    band = packs.upload(stack, device=device)
    got = combining.combine_batch(band, weights).numpy()
    for f in range(2):
        assert close(got[f, :, :MANY], stack, weights[f])
        single = combining.combine(band, weights[f]).numpy()
        assert close(single[:, :MANY], stack, weights[f])


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("frames", FRAMES)
def test_rows_are_summed_as_images_are(frames, channels, device):
    """Float32 rows; and a frame is the same to the last bit if the others are none."""
    rows = np.random.default_rng(2).normal(size=(channels, 50, 96)).astype(np.float32)
    weights = drawn((frames, channels, 50))
    packed = wp.array(rows.reshape(channels * 50, -1, devices.pack_width(device)), dtype=pack_type(devices.pack_width(device), wp.float32),
                      device=device)
    got = combining.combine_rows(packed, weights).numpy()
    assert got.shape == (frames, channels, 96)
    for f in range(frames):
        assert close(got[f], rows, weights[f])
    alone = np.zeros_like(weights)
    alone[frames // 2] = weights[frames // 2]
    assert np.array_equal(combining.combine_rows(packed, alone).numpy()[frames // 2], got[frames // 2])
    with pytest.raises(ArrayError, match="expected"):
        combining.combine_rows(packed, weights[:, :, :-1])


@settings(max_examples=15, deadline=None)
@given(chosen=st.permutations(range(20)), powers=st.lists(st.floats(0.0, 4.0), min_size=5, max_size=5))
def test_superposition(chosen, powers):
    """Five lights on at once look as the weighted sum of their images does."""
    normal, albedo, direction, irradiance = lattice(100, 80), colours(100), lattice(20, 90), colours(20, seed=2)
    alone = shade(normal, albedo, direction, irradiance)
    lit = np.zeros(20)
    lit[list(chosen[:5])] = powers
    together = np.einsum("clp,l->cp", alone, lit)
    weights = np.zeros((3, 24), dtype=np.float32)
    weights[:, :20] = lit
    frame = combining.combine(packs.upload(store(alone), device="cpu"), weights).numpy()[:, :100]
    # half rounding of each stored image, its step below the normal range, and float32 weights and sums
    assert (np.abs(frame - together) <= 2.0**-11 * 1.001 * together + lit.sum() * 2.0**-25 + 1e-30).all()


def test_no_frame_is_no_frame(device):
    band = packs.upload(captured(8, 40), device=device)
    assert combining.combine_batch(band, np.zeros((0, 3, 8), dtype=np.float32)).shape[0] == 0


@pytest.mark.parametrize("weights, message", [
    (np.zeros((3, 16)), r"weights are \(3, 16\), expected \(3, 8\): one for each"),
    (np.zeros((1, 8)), r"weights are \(1, 8\), expected \(3, 8\)"),
    (np.where(np.arange(24).reshape(3, 8) < 2, np.nan, 1), "weights hold 2 values that are not finite"),
    (np.where(np.arange(24).reshape(3, 8) < 1, np.inf, 1), "weights hold 1 values that are not finite"),
])
def test_bad_weights_are_refused(weights, message, device):
    band = packs.upload(captured(8, 4), device=device)
    with pytest.raises(ArrayError, match=message):
        combining.combine(band, weights)
    frames = np.stack([np.zeros_like(weights), weights])
    with pytest.raises(ArrayError, match=message.replace(r"\(", r"\(2, ") if "expected" in message else message):
        combining.combine_batch(band, frames)


def test_a_band_without_colour_is_refused(device):
    band = packs.upload(np.zeros((1, 8, 4), dtype=np.float16), device=device)
    for call in (lambda: combining.combine(band, np.zeros((3, 8))), lambda: combining.combine_batch(band, np.zeros((1, 3, 8)))):
        with pytest.raises(ArrayError, match="the band has 1 channels, expected 3"):
            call()
