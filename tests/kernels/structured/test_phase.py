"""Phase shifting and unwrapping: closed form, twins, uncertainty, what cannot be told apart; phases put together and taken apart."""

import numpy as np
import pytest
import warp as wp

from kernels.errors import ArrayError
from kernels.status import Status
from kernels.structured.binary import decode_gray
from kernels.structured.decoded import Decoded, cropped
from kernels.structured.pattern_frames import NoiseModel, saturated_bits, upload
from kernels.structured.phase import decode_phase, join_periods
from kernels.structured.unwrap import unwrap_by_code, unwrap_jointly, unwrap_range
from stage.patterns.base import uniform_patterns
from stage.patterns.binary import binary_patterns
from stage.patterns.codes import collect
from stage.patterns.phase import PhaseCode, phase_patterns
from tests.marks import first_short
from tests.reference import structured as reference
from tests.scenes.patterns import NOISE, frames_of, places, result, view

WIDTH = 1000
FLOAT32_RADIANS = 5e-6
"""Of a phase: readings, weights and the polynomial in float32."""


def wrapped_of(stack, patterns, device, *, noise=NOISE, saturated=None, black=True):
    found = collect(patterns)
    code = next(code for code in found.codes if isinstance(code, PhaseCode))
    return decode_phase(frames_of(stack, device, saturated), code.frames, code.periods_px, code.shifts,
                        black=found.black if black else None, noise=noise)


def decode(stack, patterns, device, extent=WIDTH, **options):
    return result(unwrap_jointly(wrapped_of(stack, patterns, device, **options), extent=extent), stack.shape[-1])


def turn(a, b):
    return np.abs(np.angle(np.exp(1j * (a - b))))


@pytest.mark.parametrize("pixels", [1, 31, 4097])
@pytest.mark.parametrize("steps", [3, 4, 7])
def test_phase_in_closed_form(steps, pixels, device):
    patterns = (*phase_patterns("column", (16.0, 21.5), steps), *uniform_patterns())
    u, albedo = places(pixels, WIDTH), np.random.default_rng(2).uniform(0.2, 1, pixels)
    wrapped = wrapped_of(view(patterns, u, WIDTH, albedo=albedo), patterns, device)
    for row, period in enumerate(wrapped.periods_px):
        assert (wrapped.status.numpy()[row, :pixels] == Status.OK).all()
        phase = wrapped.phase.numpy()[row, :pixels]
        assert (phase >= 0).all() and (phase <= 6.2831860).all()
        assert turn(phase, 2 * np.pi * u / period).max() < FLOAT32_RADIANS
        np.testing.assert_allclose(wrapped.amplitude.numpy()[row, :pixels], albedo / 2, rtol=1e-5)
        np.testing.assert_allclose(wrapped.offset.numpy()[row, :pixels], albedo / 2 + 0.05, rtol=1e-5)


@pytest.mark.parametrize("shifts", [(0, 0.1, 0.35), (0, 0.25, 0.5, 0.5, 0.9), (0.3, 1.1, 1.7, 2.2)])
def test_any_shifts_as_the_twin(shifts, device):
    rng = np.random.default_rng(0)
    u = places(500, WIDTH)
    readings = 0.5 + 0.3 * np.cos(2 * np.pi * (u / 30 - np.array(shifts)[:, None])) + 0.01 * rng.normal(size=(len(shifts), 500))
    wrapped = decode_phase(frames_of(readings, device), range(len(shifts)), [30.0] * len(shifts), shifts, noise=NOISE)
    phase, amplitude, offset = reference.phase(readings, shifts)
    assert turn(wrapped.phase.numpy()[0, :500], phase).max() < 3e-5  # float32 readings, weights up to ten
    np.testing.assert_allclose(wrapped.amplitude.numpy()[0, :500], amplitude, rtol=2e-5)
    np.testing.assert_allclose(wrapped.offset.numpy()[0, :500], offset, rtol=2e-5)


@pytest.mark.parametrize("gain", [0.0, 1e-3])
@pytest.mark.parametrize("steps", [3, 4, 8])
def test_sigma_is_that_of_the_error(steps, gain, device):
    noise = NoiseModel(0.006, gain)
    patterns = phase_patterns("column", (16, 18, 21), steps)
    u = places(20000, WIDTH)
    stack = view(patterns, u, WIDTH, noise=noise)
    wrapped = wrapped_of(stack, patterns, device, noise=noise)
    error = turn(wrapped.phase.numpy()[0, :20000], 2 * np.pi * u / 16)
    assert np.sqrt(((error / wrapped.sigma.numpy()[0, :20000]) ** 2).mean()) == pytest.approx(1, abs=0.05)
    coordinate, sigma, _, status = decode(stack, patterns, device, noise=noise)
    ok = status == Status.OK
    assert ok.mean() > 0.99
    assert np.abs(coordinate - u)[ok].max() < 3  # no wrong wrap
    assert ((coordinate - u)[ok] / sigma[ok]).std() == pytest.approx(1, abs=0.1)


@first_short("periods", [(1024,), (17, 19, 23.5), (1000, 100, 12), (40, 41.7)])
def test_any_set_of_periods_is_the_most_likely_place(periods, device):
    patterns = phase_patterns("column", periods, 4)
    u = places(200, WIDTH)
    stack = view(patterns, u, WIDTH, noise=NoiseModel(0.001, 0))
    wrapped = wrapped_of(stack, patterns, device, noise=NoiseModel(0.001, 0))
    coordinate, _, _, status = result(unwrap_jointly(wrapped, extent=WIDTH), 200)
    place, _ = reference.unwrap(wrapped.phase.numpy()[:, :200].astype(float), wrapped.sigma.numpy()[:, :200].astype(float), periods, WIDTH)
    ok = status == Status.OK
    assert ok.mean() > 0.9
    assert np.abs(coordinate - u)[ok].max() < min(periods) / 4
    assert np.abs(coordinate - place)[ok].max() < 0.03  # the grid of the search, and its model error of zero


def test_ranges():
    assert unwrap_range((16, 18, 21), 5000) == pytest.approx(1008)
    assert unwrap_range((16, 18), 5000) == pytest.approx(144)
    assert unwrap_range((32.0,), 5000) == 32
    assert unwrap_range((32.0,), 32) == np.inf
    assert unwrap_range((1280, 160, 20), 1280) == np.inf


def test_places_that_look_alike_are_undecided_and_the_rest_is_not(device):
    """16, 18 and 21 repeat after 1008: of 1024 columns the first and the last sixteen."""
    patterns = phase_patterns("column", (16, 18, 21), 4)
    u = places(20000, 1024)
    coordinate, _, _, status = decode(view(patterns, u, 1024, noise=NOISE), patterns, device, extent=1024)
    alike = (u < 15.5) | (u > 1008.5)
    assert (status[alike] == Status.UNDECIDED).all()
    rest = (u > 16.5) & (u < 1007.5)
    assert (status[rest] == Status.OK).mean() > 0.999 and np.abs(coordinate - u)[status == Status.OK].max() < 0.5


def test_gray_numbers_the_periods(device):
    patterns = (*binary_patterns(1280, "column", stripe_px=8), *phase_patterns("column", (16,), 4))
    u = places(50000, 1280)
    stack = view(patterns, u, 1280, noise=NoiseModel(0.002, 1e-5), blur=1.0)
    found = collect(patterns)
    gray = found.codes[0]
    coarse = decode_gray(frames_of(stack, device), gray.frames, gray.inverses, white=found.white, black=found.black, extent=1280,
                         stripe_px=8, noise=NOISE)
    numbered = unwrap_by_code(wrapped_of(stack, patterns, device), coarse, stripe_px=8, extent=1280)
    coordinate, sigma, amplitude, status = result(numbered, 50000)
    ok = status == Status.OK
    assert ok.mean() > 0.999 and np.abs(coordinate - u)[ok].max() < 0.2
    assert np.median(np.abs(coordinate - u)[ok]) <= 0.014
    assert (amplitude[ok] > 0.3).all() and (sigma[ok] > 0).all()


def test_several_numbered_periods_are_averaged(device):
    noise = NoiseModel(0.01, 0)
    patterns = (*binary_patterns(1024, "column", stripe_px=4), *phase_patterns("column", (16, 24), 4))
    u = places(20000, 1024)
    stack = view(patterns, u, 1024, noise=noise)
    found = collect(patterns)
    gray = found.codes[0]
    coarse = decode_gray(frames_of(stack, device), gray.frames, gray.inverses, extent=1024, stripe_px=4, noise=noise)
    wrapped = wrapped_of(stack, patterns, device, noise=noise)
    coordinate, sigma, _, status = result(unwrap_by_code(wrapped, coarse, stripe_px=4, extent=1024), 20000)
    ok = status == Status.OK
    assert ((coordinate - u)[ok] / sigma[ok]).std() == pytest.approx(1, abs=0.05)


def test_statuses(device):
    patterns = (*phase_patterns("column", (16, 18, 21), 4), *uniform_patterns())
    u = np.full(6, 300.0)
    stack = view(patterns, u, WIDTH)
    stack[:, 1] = 0.05  # ambient alone
    stack[:12, 2] = 0.4 + 0.001 * (stack[:12, 2] - 0.4)  # lit, and no pattern left
    stack[:4, 3] = view(patterns[:4], u[:1] + 5.0, WIDTH)[:, 0]  # one period sees another place
    stack[:4, 4] = view(patterns[:4], u[:1] + 1.0, WIDTH)[:, 0]  # half way to what the place 126 px away shows
    cut = np.zeros(stack.shape, dtype=bool)
    cut[5, 5] = True
    noise = NoiseModel(0.003, 0)
    *_, status = decode(stack, patterns, device, saturated=saturated_bits(cut), noise=noise)
    names = [Status(s).name for s in status]
    assert names[:3] + names[4:] == ["OK", "SHADOWED", "LOW_MODULATION", "UNDECIDED", "SATURATED"]
    assert names[3] in ("MULTIPATH", "UNDECIDED")  # no wrap fits well, and several fit as badly


def test_dark_without_a_black_frame(device):
    patterns = phase_patterns("column", (16, 18, 21), 4)
    stack = view(patterns, places(1000, WIDTH), WIDTH, albedo=0, ambient=0, noise=NOISE)
    *_, status = decode(stack, patterns, device)
    assert set(status) <= {Status.SHADOWED}


def test_places_near_the_border_are_inside(device):
    patterns = phase_patterns("column", (16, 18, 21), 4)
    u = np.array([1e-3, 0.01, 899.99, 899.999])
    coordinate, _, _, status = decode(view(patterns, u, 900), patterns, device, extent=900)
    assert (status == Status.OK).all()
    np.testing.assert_allclose(coordinate, u, atol=2e-4)  # float32 near a thousand


def frames(device, count=8):
    return upload(np.zeros((count, 4), dtype=np.float32), device=device)


@pytest.mark.parametrize("call, words", [
    (lambda f: decode_phase(f, [0, 1], [16, 16], [0, 0.5], noise=NOISE), "16 px has shifts of 0, 0.5 turns: give three or more"),
    (lambda f: decode_phase(f, [0, 1, 2], [16, 16, 16], [0, 0.5, 1.0], noise=NOISE), "16 px has shifts of 0, 0.5, 1 turns"),
    (lambda f: decode_phase(f, [0, 1, 1], [16] * 3, [0, 0.3, 0.6], noise=NOISE), "frame 1 is given for two patterns"),
    (lambda f: decode_phase(f, [0, 1, 9], [16] * 3, [0, 0.3, 0.6], noise=NOISE), "frame 9 does not exist"),
    (lambda f: decode_phase(f, [0, 1, 2], [16] * 2, [0, 0.3, 0.6], noise=NOISE), "3 frames, 2 periods, 3 shifts"),
    (lambda f: decode_phase(f, [0, 1, 2], [0] * 3, [0, 0.3, 0.6], noise=NOISE), "a period is 0 px"),
    (lambda f: unwrap_jointly(decode_phase(f, range(6), [16] * 3 + [18] * 3, [0, 0.3, 0.6] * 2, noise=NOISE), extent=1280),
     "16, 18 px repeat after 144 px, the projector has 1280: add a"),
    (lambda f: unwrap_by_code(decode_phase(f, range(3), [16] * 3, [0, 0.3, 0.6], noise=NOISE),
                              decode_gray(f, [3, 4], white=5, black=6, extent=64, stripe_px=17, noise=NOISE), stripe_px=17, extent=64),
     "stripes of 17 px cannot number periods of 16 px: give"),
])
def test_what_cannot_be_decoded_is_one_sentence(call, words, device):
    with pytest.raises(ArrayError, match=words):
        call(frames(device))


EIGHT_BIT = NoiseModel(0.003, 1.0e-4)
"""Noise of an ordinary camera of eight bits whose pixels hold ten thousand electrons, as parts of full scale."""


def test_joined_periods_are_those_decoded_together(device):
    u = np.linspace(3, 60, 45)
    shifts, periods = [i / 4 for i in range(4)] * 2, [16.0] * 4 + [23.0] * 4
    images = np.array([0.5 + 0.4 * np.cos(2 * np.pi * (u / p - s)) for p, s in zip(periods, shifts, strict=True)], np.float32)
    frames = upload(images, device=device)
    together = decode_phase(frames, range(8), periods, shifts, noise=EIGHT_BIT)
    parts = [decode_phase(frames, range(a, a + 4), periods[a:a + 4], shifts[a:a + 4], noise=EIGHT_BIT) for a in (0, 4)]
    joined = join_periods(parts)
    assert joined.periods_px == together.periods_px == (16.0, 23.0)
    for one, other in zip(joined[:5], together[:5], strict=True):
        assert (one.numpy()[:, :45] == other.numpy()[:, :45]).all()
    short = decode_phase(upload(images[:, :9].copy(), device=device), range(4), periods[:4], shifts[:4], noise=EIGHT_BIT)
    with pytest.raises(ArrayError, match="one phase has 45 pixels, another 9"):
        join_periods([parts[0], short])
    with pytest.raises(ArrayError, match="no phase is given"):
        join_periods([])


def test_a_crop_is_the_pixels_asked_for(device):
    values = np.arange(64, dtype=np.float32)
    planes = [wp.array(values + 100 * i, dtype=wp.float32, device=device) for i in range(3)]
    part = cropped(Decoded(*planes, wp.array(values.astype(np.uint8), dtype=wp.uint8, device=device)), 7, 21, device=device)
    for i, array in enumerate(part[:3]):
        assert (array.numpy()[:21] == values[7:28] + 100 * i).all()
    assert (part.status.numpy()[:21] == np.arange(7, 28)).all()
    with pytest.raises(ArrayError, match="pixels 60 to 70 are asked for, there are 64"):
        cropped(Decoded(*planes, planes[0]), 60, 10, device=device)
