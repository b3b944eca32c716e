"""Half values of the stack: how many bits of an image they keep, and their scale."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from stage.stack.correction import CodedRadiance, Radiance
from stage.stack.stack_file import half_planes


def stored(radiance):
    """The half values of an image as the stack holds them, [rows, cols, 3], and their scale."""
    planes, scale = half_planes(radiance)
    shape = (radiance.codes if isinstance(radiance, CodedRadiance) else radiance.pixels).shape
    return np.stack(list(planes), axis=-1).reshape(shape), scale


NORMAL_HALVES = st.floats(0, 2.0**15, exclude_max=True, width=16)


@settings(max_examples=25, deadline=None)
@given(hnp.arrays(np.float16, (4, 4, 3), elements=NORMAL_HALVES))
def test_half_images_below_2_to_the_15_keep_every_bit(image):
    half, scale = stored(Radiance(image.astype(np.float32), None))
    assert np.array_equal(half.astype(np.float64) * scale, image.astype(np.float64))


@settings(max_examples=25, deadline=None)
@given(hnp.arrays(np.float32, (3, 3, 3), elements=st.floats(-(2.0**100), 2.0**100, width=32)))
def test_floats_keep_eleven_bits_and_their_sign(image):
    half, scale = stored(Radiance(image, None))
    back = half.astype(np.float64) * scale
    assert np.isfinite(back).all()
    peak = np.abs(image).max()
    # half rounding for all within 2^28 of the peak; below that the step no longer shrinks
    assert np.allclose(back, image, rtol=2**-11, atol=float(peak) * 2**-38)


@settings(max_examples=25, deadline=None)
@given(hnp.arrays(np.float16, (4, 4, 3), elements=st.floats(-65504, 65504, width=16)), st.sampled_from([1.0, 0.01, 3.0]))
def test_half_values_looked_up_by_their_bits_are_those_of_the_floats(image, factor):
    every = np.arange(1 << 16, dtype=np.uint16).view(np.float16).astype(np.float32)
    values = np.where(np.isfinite(every), every, 0) * np.float32(factor)
    half, scale = stored(CodedRadiance(image.view(np.uint16), values, None))
    wanted, wanted_scale = stored(Radiance(image.astype(np.float32) * np.float32(factor), None))
    assert scale == wanted_scale
    assert np.array_equal(half, wanted)


def test_a_black_frame_is_zero_with_scale_one():
    half, scale = stored(Radiance(np.zeros((2, 2, 3), np.float32), None))
    assert not half.any() and scale == 1.0
