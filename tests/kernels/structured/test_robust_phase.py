"""Micro and modulated phase shifting: closed form, uncertainty, and light between surfaces."""

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.status import Status
from kernels.structured.micro import decode_micro
from kernels.structured.modulated import decode_modulated
from kernels.structured.pattern_frames import NoiseModel, saturated_bits, upload
from kernels.structured.phase import decode_phase
from kernels.structured.unwrap import unwrap_jointly
from stage.patterns.codes import collect
from stage.patterns.modulated import modulated_patterns
from stage.patterns.phase import micro_patterns, phase_patterns
from tests.scenes.patterns import NOISE, frames_of, places, result, view

WIDTH = 1280
MICRO = micro_patterns(WIDTH, "column", periods=6, mean_period_px=24)
MODULATED = modulated_patterns("column", 1.1 * WIDTH)  # so that the two borders do not look alike


def micro(stack, device, *, noise=NOISE, saturated=None):
    code = collect(MICRO).codes[0]
    decoded = decode_micro(frames_of(stack, device, saturated), code.frames, code.periods_px, code.shifts, extent=WIDTH, noise=noise)
    return result(decoded, stack.shape[-1])


def modulated(stack, device, *, noise=NOISE, saturated=None):
    code = collect(MODULATED).codes[0]
    wrapped = decode_modulated(frames_of(stack, device, saturated), code.frames, period_px=code.period_px, noise=noise)
    return result(unwrap_jointly(wrapped, extent=WIDTH), stack.shape[-1])


def long_phase(stack, patterns, device, *, noise=NOISE):
    code = collect(patterns).codes[0]
    wrapped = decode_phase(frames_of(stack, device), code.frames, code.periods_px, code.shifts, noise=noise)
    return result(unwrap_jointly(wrapped, extent=WIDTH), stack.shape[-1])


@pytest.mark.parametrize("pixels", [1, 33, 4097])
def test_closed_form(pixels, device):
    u, albedo = places(pixels, WIDTH), np.random.default_rng(2).uniform(0.2, 1, pixels)
    v = np.random.default_rng(3).uniform(0, 800, pixels)
    coordinate, _, amplitude, status = micro(view(MICRO, u, WIDTH, albedo=albedo), device)
    assert (status == Status.OK).mean() > 0.99
    ok = status == Status.OK
    np.testing.assert_allclose(coordinate[ok], u[ok], atol=1e-3)  # float32 at a thousand
    np.testing.assert_allclose(amplitude[ok], albedo[ok] / 2, rtol=1e-3)
    coordinate, _, amplitude, status = modulated(view(MODULATED, u, WIDTH, albedo=albedo, v=v), device)
    assert (status == Status.OK).all()
    np.testing.assert_allclose(coordinate, u, atol=2e-3)
    np.testing.assert_allclose(amplitude, albedo / 4, rtol=1e-4)


@pytest.mark.parametrize("gain", [0.0, 1e-3])
def test_sigma_is_that_of_the_error(gain, device):
    noise, u = NoiseModel(0.004, gain), places(20000, WIDTH)
    v = np.random.default_rng(3).uniform(0, 800, 20000)
    for decode, patterns in ((micro, MICRO), (modulated, MODULATED)):
        coordinate, sigma, _, status = decode(view(patterns, u, WIDTH, noise=noise, v=v), device, noise=noise)
        ok = status == Status.OK
        assert ok.mean() > 0.9
        z = (coordinate - u)[ok] / sigma[ok]
        assert z[np.abs(z) < 8].std() == pytest.approx(1, abs=0.1) and (np.abs(z) > 8).mean() < 1e-3


def test_robust_codes_at_least_halve_the_error_of_a_long_period(device):
    """A quarter of the light comes over another surface; fine patterns arrive there as an even grey."""
    u = places(20000, WIDTH)
    v = np.random.default_rng(3).uniform(0, 800, 20000)
    noise = NoiseModel(0.001, 1e-5)
    plain = phase_patterns("column", (1.1 * WIDTH,), 12)
    coordinate, _, _, status = long_phase(view(plain, u, WIDTH, noise=noise, bounce=0.25), plain, device, noise=noise)
    error = np.median(np.abs(coordinate - u)[status == Status.OK])
    for decode, patterns in ((micro, MICRO), (modulated, MODULATED)):
        coordinate, _, _, status = decode(view(patterns, u, WIDTH, noise=noise, bounce=0.25, v=v), device, noise=noise)
        ok = status == Status.OK
        assert ok.mean() > 0.95
        assert np.median(np.abs(coordinate - u)[ok]) < 0.1 * error


def test_statuses(device):
    for decode, patterns in ((micro, MICRO), (modulated, MODULATED)):
        stack = view(patterns, np.full(3, 300.0), WIDTH, v=np.full(3, 100.0))
        stack[:, 1] = 0.05
        cut = np.zeros(stack.shape, dtype=bool)
        cut[-1, 2] = True
        *_, status = decode(stack, device, saturated=saturated_bits(cut))
        assert status[0] == Status.OK and status[1] in (Status.SHADOWED, Status.LOW_MODULATION) and status[2] == Status.SATURATED


@pytest.mark.parametrize("call, words", [
    (lambda f: decode_micro(f, [0, 1, 2], [16, 17, 18], [0, 0, 0], extent=100, noise=NOISE), "no period has three shifts"),
    (lambda f: decode_micro(f, [0, 1, 2], [16] * 3, [0, 0.3, 0.6], extent=100, noise=NOISE), "all frames have the period 16 px"),
    (lambda f: decode_micro(f, [0, 1, 2, 3], [16] * 3 + [18], [0, 0.3, 0.6, 0], extent=1000, noise=NOISE), "px apart alike"),
    (lambda f: decode_modulated(f, [[0, 1, 2], [3, 4, 5]], period_px=100, noise=NOISE), "three or more for each of three or more"),
    (lambda f: decode_modulated(f, [[0, 1, 2], [3, 4, 5], [6, 7, 7]], period_px=100, noise=NOISE), "frame 7 is given"),
    (lambda f: decode_modulated(f, [[0, 1, 2], [3, 4, 5], [6, 7, 8]], period_px=0, noise=NOISE), "the period is 0 px"),
])
def test_what_cannot_be_decoded_is_one_sentence(call, words, device):
    with pytest.raises(ArrayError, match=words):
        call(upload(np.zeros((9, 4), dtype=np.float32), device=device))
