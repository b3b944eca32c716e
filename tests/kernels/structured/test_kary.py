"""k-ary codes in grey levels and colours: encode, look at, decode; crosstalk; mixtures; bad input."""

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.status import Status
from kernels.structured.kary import decode_kary, expected_levels
from kernels.structured.pattern_frames import NoiseModel, saturated_bits, upload
from stage.patterns.codes import collect
from stage.patterns.kary import kary_patterns, palette
from tests.reference import structured as reference
from tests.scenes.patterns import NOISE, frames_of, places, result, view

WIDTH = 1280
CROSSTALK = np.array([[0.8, 0.25, 0.02], [0.15, 0.9, 0.2], [0.05, 0.3, 0.7]])


def decode(stack, patterns, device, *, crosstalk=None, noise=NOISE, saturated=None, extent=WIDTH):
    found = collect(patterns)
    code = found.codes[0]
    decoded = decode_kary(frames_of(stack, device, saturated), code.frames, white=found.white, black=found.black,
                          levels=expected_levels(np.array(code.levels if code.colors is None else code.colors), crosstalk),
                          reflected=code.reflected, extent=extent, stripe_px=code.stripe_px, noise=noise)
    return result(decoded, stack.shape[-1])


@pytest.mark.long
@pytest.mark.parametrize("pixels", [33, 4097])
@pytest.mark.parametrize("base, options", [(2, {}), (3, {}), (3, {"reflected": False}), (4, {"stripe_px": 2}), (5, {}),
                                           (3, {"levels": (0.9, 0.1, 0.5)}), (3, {"colors": palette(3)}), (6, {"colors": palette(6)}),
                                           (8, {"colors": palette(8), "reflected": False})])
def test_every_place_is_in_its_stripe(base, options, pixels, device):
    patterns = kary_patterns(WIDTH, "column", base=base, **options)
    u = places(pixels, WIDTH)
    colour = "colors" in options
    albedo = np.random.default_rng(2).uniform(0.2, 1, (pixels, 3) if colour else pixels)
    stack = view(patterns, u, WIDTH, albedo=albedo, crosstalk=CROSSTALK if colour else None)
    coordinate, sigma, amplitude, status = decode(stack, patterns, device, crosstalk=CROSSTALK if colour else None)
    stripe = options.get("stripe_px", 1)
    assert (status == Status.OK).all()
    np.testing.assert_allclose(coordinate, (np.floor(u / stripe) + 0.5) * stripe, atol=1e-4)  # float32 at a thousand
    np.testing.assert_allclose(sigma, stripe / np.sqrt(12), rtol=1e-4)
    expected = (albedo * CROSSTALK.sum(axis=1)).mean(axis=1) / 2 if colour else albedo / 2
    np.testing.assert_allclose(amplitude, expected, rtol=1e-4)


@pytest.mark.parametrize("colour", [False, True])
@pytest.mark.parametrize("reflected", [False, True])
def test_digits_are_those_of_the_twin_on_noise(colour, reflected, device):
    patterns = kary_patterns(243, "column", base=3, reflected=reflected, colors=palette(3) if colour else None)
    u, noise = places(800, 243), NoiseModel(0.01, 1e-3)
    stack = view(patterns, u, 243, noise=noise, blur=0.3, crosstalk=CROSSTALK if colour else None)
    coordinate, sigma, _, status = decode(stack, patterns, device, extent=243, noise=noise, crosstalk=CROSSTALK if colour else None)
    shaped = stack if colour else stack[:, None]
    found = collect(patterns)
    code = found.codes[0]
    expected = expected_levels(np.array(code.colors if colour else code.levels), CROSSTALK if colour else None)
    digits = reference.kary_digits(shaped[list(code.frames)], shaped[found.white], shaped[found.black], expected)
    number = reference.kary_number(digits, 3, reflected)
    certain = (status == Status.OK) & (sigma < 0.3)
    assert certain.mean() > 0.6
    np.testing.assert_allclose(coordinate[certain], number[certain] + 0.5, atol=1e-4)


@pytest.mark.parametrize("options", [{}, {"reflected": False}, {"reflected": False, "colors": palette(3)}])
def test_edges_are_right(options, device):
    """A pixel half on either side mixes two levels in one digit of a reflected code, and in all that a carry turns in a plain one."""
    u = np.arange(1, 700, dtype=float)
    patterns = kary_patterns(WIDTH, "column", base=3, **options)
    coordinate, _, _, status = decode(view(patterns, u, WIDTH, blur=1.0, noise=NOISE), patterns, device)
    assert ((status == Status.OK) & (np.abs(coordinate - u) <= 1)).mean() > 0.98


@pytest.mark.parametrize("base", [3, 4, 5])
def test_mixtures_at_carries_are_not_silently_wrong(base, device):
    """Uneven mixtures of two stripes spell numbers far away; with five levels, noise lets two in a thousand through."""
    patterns = kary_patterns(WIDTH, "column", base=base, reflected=False)
    u = np.repeat(np.arange(1, 700, dtype=float), 9) + np.tile(np.linspace(-0.45, 0.45, 9), 699)
    coordinate, sigma, _, status = decode(view(patterns, u, WIDTH, blur=0.9, noise=NOISE), patterns, device)
    ok = status == Status.OK
    assert ok.mean() > 0.95
    assert (np.abs(coordinate - u)[ok] > 5 * sigma[ok]).mean() < 3e-3


def test_levels_between_digits_are_doubted(device):
    """Readings that all lie a third of the way between levels are not of this code: they are not taken for the nearest digits."""
    patterns = kary_patterns(WIDTH, "column", base=3)
    rng = np.random.default_rng(5)
    stack = 0.05 + 0.7 * rng.choice([0.17, 0.33, 0.67, 0.83], size=(len(patterns), 2000))
    stack[-2], stack[-1] = 0.75, 0.05
    *_, status = decode(stack, patterns, device)
    assert (status == Status.OK).mean() < 0.05


def test_crosstalk_that_is_not_said_is_refused_or_wrong(device):
    patterns = kary_patterns(WIDTH, "column", base=8, colors=palette(8))
    u = places(3000, WIDTH)
    heavy = np.array([[0.6, 0.5, 0.1], [0.3, 0.8, 0.4], [0.1, 0.5, 0.6]])
    stack = view(patterns, u, WIDTH, crosstalk=heavy, noise=NOISE)
    coordinate, _, _, status = decode(stack, patterns, device, crosstalk=heavy)
    assert ((status == Status.OK) & (np.abs(coordinate - u) <= 0.51)).mean() > 0.99
    *_, ignored = decode(stack, patterns, device)
    assert (ignored == Status.OK).mean() < 0.5


def test_statuses(device):
    patterns = kary_patterns(WIDTH, "column", base=3)
    u = np.full(4, 300.3)
    stack = view(patterns, u, WIDTH)
    stack[:, 1] = 0.05
    stack[:3, 2] = 0.05 + 0.7 * 0.25  # half way between two levels, in three digits
    cut = np.zeros(stack.shape, dtype=bool)
    cut[-1, 3] = True
    *_, status = decode(stack, patterns, device, saturated=saturated_bits(cut))
    assert [Status(s).name for s in status] == ["OK", "SHADOWED", "UNDECIDED", "SATURATED"]
    *_, status = decode(view(patterns, u, WIDTH), patterns, device, extent=300)
    assert (status == Status.OUT_OF_RANGE).all()


LEVELS = np.array([0, 0.5, 1])


@pytest.mark.parametrize("call, words", [
    (lambda f: decode_kary(f, [0, 1], white=2, black=3, levels=LEVELS, reflected=True, extent=27, noise=NOISE),
     "2 digits in base 3 number 9 px of stripes of 1 px, the"),
    (lambda f: decode_kary(f, [0, 1, 1], white=2, black=3, levels=LEVELS, reflected=True, extent=27, noise=NOISE), "frame 1 is given"),
    (lambda f: decode_kary(f, [0, 1], white=2, black=3, levels=np.eye(3), reflected=True, extent=9, noise=NOISE),
     "the frames have 1 channels, this decoder takes 3"),
    (lambda f: decode_kary(f, [0, 1], white=2, black=3, levels=LEVELS[:1], reflected=True, extent=9, noise=NOISE), r"levels are \(1,\)"),
    (lambda f: decode_kary(f, [0, 1], white=2, black=3, levels=LEVELS * 0, reflected=True, extent=9, noise=NOISE),
     "digit values 0 and 1 look the same"),
    (lambda f: expected_levels(LEVELS, np.eye(3)), "crosstalk is"),
])
def test_what_cannot_be_decoded_is_one_sentence(call, words, device):
    with pytest.raises(ArrayError, match=words):
        call(upload(np.zeros((5, 4), dtype=np.float32), device=device))
