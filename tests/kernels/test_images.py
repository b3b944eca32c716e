"""Images on a device are those of the stack, whether its memory holds all of them or a few blocks, and whoever asks for them."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import warp as wp

from kernels import device as devices
from kernels import images
from kernels.device import to_numpy
from kernels.images import ImagesOnDevice, Staging
from kernels.packs import as_pixels

CHANNELS, LIGHTS, PIXELS, BLOCK = 3, 16, 15 * 64, 2 * 64
RNG = np.random.default_rng(39)


class Noise:
    """A stack of noise in eight blocks, the last of which is narrower."""

    shape = (CHANNELS, LIGHTS, PIXELS)

    def __init__(self):
        self.values = RNG.normal(size=self.shape).astype(np.float16)
        self.bits = RNG.integers(0, 256, (LIGHTS // 8, PIXELS), np.uint8)
        self.reads = 0

    def bands(self, bytes_per_pixel=0):
        return [(start, min(start + BLOCK, PIXELS)) for start in range(0, PIXELS, BLOCK)]

    def band(self, start, stop):
        self.reads += 1
        return self.values[:, :, start:stop]

    def saturated(self, start, stop):
        return self.bits[:, start:stop]

    def pick(self, pixels):
        return self.values[..., pixels], self.bits[:, pixels]

    def is_in(self, band, places, pixels):
        """Whether a band has the images of these pixels at these places."""
        values, bits = (to_numpy(as_pixels(each))[:, places] for each in (band.values, band.saturated))
        return np.array_equal(values, self.values.reshape(-1, PIXELS)[:, pixels]) and np.array_equal(bits, self.bits[:, pixels])


@pytest.fixture(params=["all", "some"])
def held(request, device, monkeypatch):
    """The device's memory holds all blocks, or LEAST_BLOCKS of them."""
    if request.param == "some":
        monkeypatch.setattr(devices, "free_bytes", lambda device: 0)
    return request.param


def test_images_are_those_of_the_stack(device, held):
    stack = Noise()
    found = ImagesOnDevice(stack, device)
    for _ in range(2):
        for start, stop in found.spans(0):
            assert stack.is_in(found.band(start, stop), slice(stop - start), slice(start, stop))
    for pixels in (np.array([131, 7, 950, 130]), np.array([959]), np.arange(100, 300)[::-1], RNG.permutation(PIXELS)[:201]):
        assert stack.is_in(found.pick(pixels), slice(len(pixels)), pixels)
    near = np.sort(RNG.permutation(300)[:77]) + 120
    assert stack.is_in(*found.around(near), near)
    assert stack.is_in(found.band(64, 320), slice(256), slice(64, 320))
    if device != "cpu" and held == "all":
        assert stack.reads == len(stack.bands())


def test_several_threads_have_what_they_asked_for(device, held):
    stack = Noise()
    found = ImagesOnDevice(stack, device)
    wanted = [np.arange(first, first + 150) for first in RNG.integers(0, PIXELS - 150, 60)]
    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(lambda pixels: stack.is_in(found.pick(pixels), slice(150), pixels), wanted))


def test_rows_go_through_both_buffers_in_turn(device, monkeypatch):
    if device == "cpu":
        pytest.skip("nothing is uploaded to the CPU")
    monkeypatch.setattr(images, "STAGED_BYTES", 3 * 64 * 4)
    rows = RNG.normal(size=(20, 100)).astype(np.float32)[:, 20:84]
    target = wp.empty(rows.shape, dtype=wp.float32, device=device)
    stream = wp.get_stream(device)
    stream.wait_event(Staging(device).upload(rows, target, stream.record_event()))
    assert np.array_equal(target.numpy(), rows)


def test_the_next_block_is_read_ahead(device):
    if device == "cpu":
        pytest.skip("the CPU reads the stack's file")
    stack = Noise()
    found = ImagesOnDevice(stack, device)
    found.band(*stack.bands()[0])
    found.finish()
    assert stack.reads == 2
    assert images.LEAST_BLOCKS >= 2 * devices.CUDA_PIECES
