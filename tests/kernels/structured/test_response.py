"""Waves that a response bends: encode with the response, decode with it; what cannot be told is refused."""

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.structured.micro import decode_micro
from kernels.structured.modulated import decode_modulated
from kernels.structured.pattern_frames import NoiseModel
from kernels.structured.phase import decode_phase, weights
from kernels.structured.response import light_of, wave_error
from kernels.structured.unwrap import unwrap_jointly
from stage.patterns.codes import collect
from stage.patterns.modulated import modulated_patterns
from stage.patterns.phase import micro_patterns, phase_patterns
from tests.marks import first_short
from tests.scenes.patterns import frames_of, places, result

WIDTH, COUNT = 800, 3000
LEVELS = np.linspace(0, 1, 256)
RESPONSES = {"gamma 2.2": LEVELS**2.2, "gamma 0.6": 2 + LEVELS**0.6, "s-shaped": LEVELS**2 * (3 - 2 * LEVELS) + 0.2 * LEVELS}
NOISE = NoiseModel(0.002, 1e-9)


def seen(patterns, u, response, *, noise=NOISE, v=None):
    """[frames, pixels] readings under unknown albedo and ambient light; the response is applied here by a formula of its own."""
    rng = np.random.default_rng(3)
    albedo, ambient = rng.uniform(0.4, 0.9, u.size), rng.uniform(0, 0.1, u.size)
    light = np.stack([np.interp(p.level(u, v, WIDTH), LEVELS, response) for p in patterns])
    light = (light - response[0]) / (response[-1] - response[0])
    return ambient + albedo * light + rng.normal(0, noise.read, light.shape)


@pytest.mark.parametrize("steps", [3, 4, 5])
@pytest.mark.parametrize("name", RESPONSES)
def test_bent_phases_are_put_right(name, steps, device):
    response, u = RESPONSES[name], places(COUNT, WIDTH)
    patterns = phase_patterns("column", (16, 18, 21), steps)
    code = collect(patterns).codes[0]

    def decode(given):
        wrapped = decode_phase(frames_of(seen(patterns, u, response), device), code.frames, code.periods_px, code.shifts, response=given,
                               noise=NOISE)
        return result(unwrap_jointly(wrapped, extent=WIDTH), COUNT)

    coordinate, sigma, amplitude, status = decode(response.tolist())
    ok = status == 1
    assert ok.mean() > 0.99
    assert np.std((coordinate - u)[ok] / sigma[ok]) == pytest.approx(1, abs=0.12)
    albedo = np.random.default_rng(3).uniform(0.4, 0.9, COUNT)
    np.testing.assert_allclose(amplitude[ok], albedo[ok] / 2, rtol=0.05)  # noise of a few readings
    if steps == 3 and name.startswith("gamma"):  # a response that is odd about its middle has no second harmonic
        plain, plain_sigma, _, plain_status = decode(None)
        ok = plain_status == 1
        assert ok.sum() < 100 or np.median(np.abs(plain - u)[ok] / plain_sigma[ok]) > 2


@first_short("name", RESPONSES)
def test_bent_micro_and_modulated_waves(name, device):
    response, u = RESPONSES[name], places(COUNT, WIDTH)
    v = np.random.default_rng(8).uniform(0, 600, COUNT)
    patterns = micro_patterns(WIDTH, "column", periods=6, mean_period_px=24)
    code = collect(patterns).codes[0]
    found = decode_micro(frames_of(seen(patterns, u, response), device), code.frames, code.periods_px, code.shifts, extent=WIDTH,
                         response=response.tolist(), noise=NOISE)
    coordinate, sigma, _, status = result(found, COUNT)
    ok = status == 1
    assert ok.mean() > 0.8 and np.median(np.abs(coordinate - u)[ok] / sigma[ok]) == pytest.approx(0.67, abs=0.12)
    patterns = modulated_patterns("column", 1.1 * WIDTH, steps=4)
    code = collect(patterns).codes[0]
    stack, errors = seen(patterns, u, response, v=v), []
    for given in (None, response.tolist()):
        wrapped = decode_modulated(frames_of(stack, device), code.frames, period_px=code.period_px, response=given, noise=NOISE)
        coordinate, _, _, status = result(unwrap_jointly(wrapped, extent=WIDTH), COUNT)
        errors.append(np.median(np.abs(coordinate - u)[status == 1]))
    assert errors[1] < 1.02 * errors[0]  # four steps hardly err; the carrier's mean is taken for its phase


def test_the_error_of_bent_waves_is_foretold():
    """Closed form: light = x² has the harmonics 1/2 and 1/8, so three steps err by sin(3φ)/4 at most, 0.178 RMS with its own harmonics."""
    own = np.arange(3) / 3
    assert wave_error(LEVELS**2, weights(own, 16.0), own) == pytest.approx(0.178, abs=0.003)
    assert wave_error(LEVELS, weights(own, 16.0), own) < 1e-5
    four = np.arange(4) / 4
    assert wave_error(LEVELS**2, weights(four, 16.0), four) < 1e-4  # no third harmonic


def test_errors_beyond_noise_add_to_sigma(device):
    patterns, u = phase_patterns("column", (32,), 4), places(200, 32)
    code = collect(patterns).codes[0]
    stack = seen(patterns, u, LEVELS)
    args = (frames_of(stack, device), code.frames, code.periods_px, code.shifts)
    plain, more = (decode_phase(*args, wave_errors=errors, noise=NOISE).sigma.numpy()[0, :200] for errors in (None, [0.1]))
    np.testing.assert_allclose(more, np.hypot(plain, 0.1), rtol=1e-4)


def test_a_response_that_hides_the_phase_is_refused(device):
    patterns = phase_patterns("column", (16, 18, 21), 3)
    code = collect(patterns).codes[0]
    frames = frames_of(seen(patterns, places(40, WIDTH), LEVELS), device)
    with pytest.raises(ArrayError, match="two places of a period alike"):
        decode_phase(frames, code.frames, code.periods_px, code.shifts, response=(LEVELS**5).tolist(), noise=NOISE)
    with pytest.raises(ArrayError, match="each above the one before"):
        light_of([0.0, 1.0, 0.5], LEVELS)
