"""Intensity ratio, and direct and global light."""

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.status import Status
from kernels.structured.pattern_frames import NoiseModel, saturated_bits, upload
from kernels.structured.ramp import decode_ramp
from stage.patterns.ramp import ramp_patterns
from tests.scenes.patterns import NOISE, frames_of, places, result, view

WIDTH = 1280
PATTERNS = ramp_patterns("column")
UP, DOWN, WHITE, BLACK = range(4)


@pytest.mark.parametrize("pixels", [1, 31, 4097])
@pytest.mark.parametrize("given", [{"up": UP, "down": DOWN}, {"up": UP, "white": WHITE}, {"down": DOWN, "white": WHITE}])
def test_ratio_in_closed_form(given, pixels, device):
    u, albedo = places(pixels, WIDTH), np.random.default_rng(2).uniform(0.2, 1, pixels)
    stack = view(PATTERNS, u, WIDTH, albedo=albedo)
    decoded = decode_ramp(frames_of(stack, device), **given, black=BLACK, extent=WIDTH, noise=NOISE)
    coordinate, _, amplitude, status = result(decoded, pixels)
    assert (status == Status.OK).all()
    np.testing.assert_allclose(coordinate, u, atol=2e-3)  # float32 ratios of a width of a thousand
    np.testing.assert_allclose(amplitude, albedo / 2, rtol=1e-5)


@pytest.mark.parametrize("given", [{"up": UP, "down": DOWN}, {"up": UP, "white": WHITE}, {"down": DOWN, "white": WHITE}])
@pytest.mark.parametrize("gain", [0.0, 1e-3])
def test_sigma_is_that_of_the_error(given, gain, device):
    noise = NoiseModel(0.004, gain)
    u = places(30000, WIDTH)
    stack = view(PATTERNS, u, WIDTH, noise=noise)
    coordinate, sigma, _, status = result(decode_ramp(frames_of(stack, device), **given, black=BLACK, extent=WIDTH, noise=noise), 30000)
    ok = status == Status.OK
    assert ok.mean() > 0.999
    assert ((coordinate - u)[ok] / sigma[ok]).std() == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize("given", [{"up": UP, "down": DOWN}, {"up": UP, "white": WHITE}, {"down": DOWN, "white": WHITE}])
def test_a_bent_response_is_undone(given, device):
    u = places(3000, WIDTH)
    response = np.linspace(0, 1, 257) ** 2.2
    x = u / WIDTH
    stack = np.stack([0.05 + 0.7 * np.interp(level, np.linspace(0, 1, 257), response) for level in (x, 1 - x, x * 0 + 1, x * 0)])
    frames = frames_of(stack, device)
    coordinate, *_ = result(decode_ramp(frames, **given, black=BLACK, extent=WIDTH, response=response, noise=NOISE), 3000)
    bright = x if "up" in given else 1 - x
    assert np.abs(coordinate - u)[bright > 0.03].max() < 0.1  # float32 where the light is weak
    straight, *_ = result(decode_ramp(frames, **given, black=BLACK, extent=WIDTH, noise=NOISE), 3000)
    assert np.median(np.abs(straight - u)) > 20


def test_statuses(device):
    stack = view(PATTERNS, np.full(4, 300.0), WIDTH)
    stack[:, 1] = 0.05
    stack[UP, 2] = 0.01  # darker than ambient: no place is
    stack[DOWN, 2] = 0.7
    cut = np.zeros(stack.shape, dtype=bool)
    cut[DOWN, 3] = True
    decoded = decode_ramp(frames_of(stack, device, saturated_bits(cut)), up=UP, down=DOWN, black=BLACK, extent=WIDTH, noise=NOISE)
    assert [Status(s).name for s in result(decoded, 4)[3]] == ["OK", "SHADOWED", "OUT_OF_RANGE", "SATURATED"]


@pytest.mark.parametrize("options, words", [
    ({"up": 0}, "a frame is missing"), ({}, "a frame is missing"), ({"up": 0, "down": 0}, "frame 0 is given for two patterns"),
    ({"up": 0, "down": 1, "response": np.array([0, 0.5, 0.5, 1])}, "each above the one before"),
    ({"up": 0, "down": 1, "extent": 0}, "the projector has 0 px"),
])
def test_what_cannot_be_decoded_is_one_sentence(options, words, device):
    with pytest.raises(ArrayError, match=words):
        decode_ramp(upload(np.zeros((4, 4), dtype=np.float32), device=device), **{"extent": 8, "noise": NOISE, **options})
