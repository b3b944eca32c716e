import gc
import sys
import tempfile

import numpy as np
import pytest
import warp as wp

from kernels import device as devices
from kernels import packs
from kernels.errors import ArrayError
from kernels.relight.frames.combine import combine


def fetch(band):
    """[3 · light, pixel padded] of a band."""
    values = band.values.numpy()
    return values.reshape(values.shape[0], -1)


@pytest.mark.parametrize("pixels", [0, 1, 31, 32, 33, 64, 4097])
def test_upload_lays_out_every_value(pixels, device):
    rng = np.random.default_rng(pixels)
    values = rng.random((3, 16, pixels)).astype(np.float16)
    bits = rng.integers(0, 256, (2, pixels), dtype=np.uint8)
    band = packs.upload(values, bits, device=device)
    assert (band.pixel_count, band.frame_count, band.packs) == (pixels, 16, -(-pixels // devices.pack_width(device)))
    if pixels:
        np.testing.assert_array_equal(fetch(band)[:, :pixels], values.reshape(48, pixels))
        assert (fetch(band)[:, pixels:] == 0).all()
        np.testing.assert_array_equal(band.saturated.numpy().reshape(2, -1)[:, :pixels], bits)
    assert combine(band, np.zeros((3, 16))).numpy().shape == (3, band.packs * devices.pack_width(device))


@pytest.mark.parametrize("view", [lambda a: a[:, :, 64:128], lambda a: a[:, :, 5:70], lambda a: a[:, 8:16], lambda a: a[::-1],
                                  lambda a: a[:, ::-1], lambda a: a[:, :, ::-1], lambda a: a[:, :, ::2], lambda a: a[:1],
                                  lambda a: np.broadcast_to(a[:, :1], a.shape), lambda a: np.asfortranarray(a)],
                         ids=["band", "odd band", "lights", "channels back", "lights back", "pixels back", "every other",
                              "one channel", "broadcast", "columns first"])
def test_views_are_read_as_numpy_reads_them(view, device):
    values = view(np.random.default_rng(0).random((3, 16, 256)).astype(np.float16))
    band = packs.upload(values, device=device)
    np.testing.assert_array_equal(fetch(band)[:, :values.shape[2]], values.reshape(-1, values.shape[2]))


def test_a_band_of_a_map_is_not_copied_on_the_cpu():
    values = np.zeros((3, 8, 256), dtype=np.float16)
    band = packs.upload(values[:, :, 64:192], device="cpu")
    values[1, 2, 70] = 1
    assert fetch(band)[10, 6] == 1


def test_a_band_keeps_its_memory(device):
    def make():
        return packs.upload(np.full((3, 8, 100_000), 2, dtype=np.float16), device=device)

    bands = [make() for _ in range(3)]
    gc.collect()
    others = [np.zeros((3, 8, 100_000), dtype=np.float16) for _ in range(3)]
    for band in bands:
        assert (fetch(band)[:, :100_000] == 2).all()
    del others


@pytest.mark.skipif(sys.platform == "win32", reason="the file would take 12 or 48 GiB of disk")
@pytest.mark.parametrize("pixels, apart", [((1 << 28) + 640, 0), ((1 << 30) + 640, 1)], ids=["channels", "lights"])
def test_strides_of_more_than_32_bits(pixels, apart, device):
    """A band of a large capture: 8 lights of 268 million pixels are 4 GiB a channel; in a file that is all holes."""
    with tempfile.TemporaryFile() as file:
        stack = np.memmap(file, dtype=np.float16, mode="w+", shape=(3, 8, pixels))
        assert stack.strides[0] > 1 << 32 and stack.strides[apart] >= packs.STRIDE_LIMIT
        for channel in range(3):
            stack[channel, :, 128:192] = channel + 1
        frame = combine(packs.upload(stack[:, :, 128:192], device=device), np.ones((3, 8))).numpy()
        np.testing.assert_array_equal(frame, np.repeat([[8.0], [16.0], [24.0]], 64, axis=1))
        del stack


def nothing(shape, dtype=np.float16):
    """An array of this shape that takes no memory."""
    return np.broadcast_to(np.zeros((), dtype=dtype), shape)


@pytest.mark.parametrize("values, saturated, message", [
    (nothing((3, 8, 4), np.float32), None, r"values are 3-dimensional float32: give \[channel, light"),
    (nothing((8, 4)), None, "values are 2-dimensional float16"),
    (nothing((3, 7, 4)), None, "7 lights: pad the light axis with zeros to a multiple of 8"),
    (nothing((3, 0, 4)), None, "values have 0 lights"),
    (nothing((3, 8, 4)), nothing((1, 5), np.uint8), r"saturated is uint8 \(1, 5\): give uint8 \(1, 4\)"),
    (nothing((3, 8, 4)), nothing((1, 4), bool), r"saturated is bool \(1, 4\)"),
    (nothing((3, 8, packs.MAX_PIXELS + 1)), None, f"pixels: cut them into bands of at most {packs.MAX_PIXELS}"),
])
def test_bad_arrays_are_refused(values, saturated, message, device):
    with pytest.raises(ArrayError, match=message):
        packs.upload(values, saturated, device=device)


def test_as_packs_is_the_same_memory(device):
    width = devices.pack_width(device)
    array = packs.zeros(width + 1, wp.float32, device, rows=3)
    assert array.shape == (3, 2 * width)
    view = packs.as_packs(array, device)
    assert view.shape == (3, 2) and view.ptr == array.ptr
    array.fill_(2.0)
    assert (view.numpy() == 2).all()


def test_as_packs_refuses_what_does_not_divide_or_has_gaps(device):
    width = devices.pack_width(device)
    with pytest.raises(ArrayError, match=f"array has {width + 1} pixels: pad to a multiple of {width}"):
        packs.as_packs(wp.zeros(width + 1, dtype=wp.float32, device=device), device)
    with pytest.raises(ArrayError, match="is a slice with gaps"):
        packs.as_packs(wp.zeros((3, 2 * width), dtype=wp.float32, device=device)[:, :width], device)
