"""Binary, Gray and XOR codes: encode, look at, decode; doubtful bits; bad input."""

import numpy as np
import pytest

from kernels.errors import ArrayError
from kernels.status import Status
from kernels.structured.binary import decode_binary, decode_gray, decode_xor
from kernels.structured.pattern_frames import NoiseModel, saturated_bits, upload
from stage.patterns.binary import binary_patterns, xor_patterns
from stage.patterns.codes import collect
from tests.reference import structured as reference
from tests.scenes.patterns import NOISE, frames_of, places, result, view

WIDTH = 1280
DECODERS = {"binary": decode_binary, "gray": decode_gray, "xor": decode_xor}


def patterns_of(code, *, references=True, **options):
    if code == "xor":
        patterns = xor_patterns(WIDTH, "column", **options)
        return patterns if references else patterns[:-2]  # white and black come last
    return binary_patterns(WIDTH, "column", code=code, references=references, **options)


def decode(stack, patterns, device, *, saturated=None, noise=NOISE, extent=WIDTH):
    found = collect(patterns)
    code = found.codes[0]
    options = {"base_bit": code.base_bit} if code.name == "xor" else {}
    decoded = DECODERS[code.name](frames_of(stack, device, saturated), code.frames, code.inverses, white=found.white, black=found.black,
                                  extent=extent, stripe_px=code.stripe_px, noise=noise, **options)
    return result(decoded, stack.shape[-1])


@pytest.mark.long
@pytest.mark.parametrize("pixels", [31, 4097])
@pytest.mark.parametrize("code, options", [("binary", {}), ("gray", {}), ("gray", {"stripe_px": 3}), ("gray", {"inverses": False}),
                                           ("gray", {"references": False}), ("xor", {}), ("xor", {"base_bit": 1}),
                                           ("xor", {"base_bit": 4, "inverses": False})])
def test_every_place_is_in_its_stripe(code, options, pixels, device):
    patterns = patterns_of(code, **options)
    u, albedo = places(pixels, WIDTH), np.random.default_rng(2).uniform(0.2, 1, pixels)
    coordinate, sigma, amplitude, status = decode(view(patterns, u, WIDTH, albedo=albedo), patterns, device)
    stripe = options.get("stripe_px", 1)
    assert (status == Status.OK).all()
    start = np.floor(u / stripe) * stripe
    np.testing.assert_allclose(coordinate, (start + np.minimum(start + stripe, WIDTH)) / 2, atol=1e-4)  # float32 at a thousand
    np.testing.assert_allclose(sigma, (np.minimum(start + stripe, WIDTH) - start) / np.sqrt(12), rtol=1e-4)
    np.testing.assert_allclose(amplitude, albedo / 2, rtol=1e-5)


def test_lecture_example(device):
    """Stripe 5 of 7 is 101: lit by the coarsest and the finest of three images."""
    frames = np.array([[1, 1], [0, 1], [1, 1], [1, 1], [0, 0]], dtype=np.float32)[:, :1]  # bits 0, 1, 2, white, black
    coordinate, *_ = decode_binary(upload(frames, device=device), [0, 1, 2], white=3, black=4, extent=8, noise=NOISE)
    assert coordinate.numpy()[0] == 5.5


@pytest.mark.long
@pytest.mark.parametrize("code", ["binary", "gray", "xor"])
@pytest.mark.parametrize("options", [{}, {"inverses": False}, {"references": False}])
def test_values_are_those_of_the_twin_on_noisy_mixtures(code, options, device):
    patterns = patterns_of(code, **options)
    u, noise = places(600, WIDTH), NoiseModel(0.01, 1e-3)
    albedo = np.random.default_rng(4).uniform(0.02, 1, 600)
    stack = view(patterns, u, WIDTH, albedo=albedo, noise=noise, blur=0.8).astype(np.float32)
    coordinate, sigma, _, status = decode(stack, patterns, device, noise=noise)
    found = collect(patterns)
    stripe = found.codes[0]
    pick = [None if n is None else stack[n].astype(float) for n in (found.white, found.black)]
    inverse = None if stripe.inverses is None else stack[list(stripe.inverses)].astype(float)
    least, most, width, expected = reference.stripes(
        stack[list(stripe.frames)].astype(float), inverse, *pick, noise.read, noise.gain, code=code)
    expected[(expected == "OK") & (least >= WIDTH)] = "OUT_OF_RANGE"
    names = np.array([Status(s).name for s in status])
    assert (names != expected).mean() < 0.005  # float32 at a threshold
    both = (names == "OK") & (expected == "OK")
    assert both.sum() > 100
    np.testing.assert_allclose(coordinate[both], ((least + np.minimum(most + 1, WIDTH)) / 2)[both], atol=1e-3)
    np.testing.assert_allclose(sigma[both], (width / np.sqrt(12))[both], rtol=1e-4)
    kept = np.isin(status, [Status.OK, Status.UNDECIDED, Status.MULTIPATH])
    assert (coordinate[~kept] == 0).all() and (sigma[~kept] == 0).all() and (sigma[kept] > 0).all()


@pytest.mark.parametrize("code", ["gray", "binary"])
def test_pixels_at_edges_are_decoded(code, device):
    """Pixels whose footprint lies half on either side: of a binary code several bits change there, all at once."""
    u, patterns = np.arange(1, 512, dtype=float), patterns_of(code)
    coordinate, _, _, status = decode(view(patterns, u, WIDTH, noise=NOISE, blur=1.0), patterns, device)
    assert (status == Status.OK).mean() > 0.99
    assert np.abs(coordinate - u)[status == Status.OK].max() <= 0.501


def test_bits_too_fine_to_be_seen_are_no_carry(device):
    """A camera that blurs stripes of one and two pixels away: places are off by up to two stripes, and sigma says so."""
    u, patterns = places(4000, WIDTH), patterns_of("binary")
    coordinate, sigma, _, status = decode(view(patterns, u, WIDTH, noise=NOISE, blur=4.0), patterns, device)
    solved = status == Status.OK
    assert 0.02 < solved.mean() < 0.9
    assert np.percentile(np.abs(coordinate - u)[solved] / sigma[solved], 99) < 3  # a block's own deviations reach 1.7


@pytest.mark.parametrize("options", [{}, {"inverses": False}], ids=["inverses", "white and black"])
@pytest.mark.parametrize("code", ["binary", "gray", "xor"])
def test_weak_light_is_refused_or_within_sigma(code, options, device):
    """White is 2 to 25 deviations of a reading above black, edges are blurred: faint bits may be noise as well as a carry."""
    patterns, u = patterns_of(code, stripe_px=4, **options), places(20000, WIDTH)
    stack = view(patterns, u, WIDTH, albedo=np.random.default_rng(5).uniform(0.02, 0.25, len(u)), noise=NoiseModel(0.01, 0.0), blur=1.0)
    coordinate, sigma, _, status = decode(stack, patterns, device, noise=NoiseModel(0.01, 0.0))
    solved = status == Status.OK
    assert solved.mean() > 0.3
    # none; a bit that is three deviations off, one in 740, is one of nine: a percent. A carry of all bits made 1.6 % and 20 % wrong
    assert (np.abs(coordinate - u)[solved] > 5 * sigma[solved]).mean() < 0.01


def test_sigma_is_that_of_the_error(device):
    patterns = patterns_of("gray", stripe_px=4)
    u = places(20000, WIDTH)
    coordinate, sigma, _, status = decode(view(patterns, u, WIDTH, noise=NOISE), patterns, device)
    assert (status == Status.OK).all()
    assert (coordinate - u).std() == pytest.approx(sigma.mean(), rel=0.1)


@pytest.mark.parametrize("code", ["gray", "xor"])
def test_dark_pixels_are_shadowed(code, device):
    patterns = patterns_of(code)
    stack = view(patterns, places(1000, WIDTH), WIDTH, albedo=0.0, noise=NOISE)
    *_, status = decode(stack, patterns, device)
    assert (status == Status.SHADOWED).mean() > 0.99  # five deviations of one difference, or of the largest of many


def test_saturation_counts_in_frames_that_decide_bits(device):
    patterns = patterns_of("gray")
    stack = view(patterns, places(40, WIDTH), WIDTH)
    cut = np.zeros(stack.shape, dtype=bool)
    cut[3, 5] = True  # a bit
    cut[-2, 7] = True  # white: only says how large the contrast is
    *_, status = decode(stack, patterns, device, saturated=saturated_bits(cut))
    assert status[5] == Status.SATURATED and (np.delete(status, 5) == Status.OK).all()


def test_codes_beyond_the_projector_are_out_of_range(device):
    patterns = binary_patterns(1024, "column")
    u = places(500, 1024)
    *_, status = decode(view(patterns, u, 1024), patterns, device, extent=600)
    np.testing.assert_array_equal(status == Status.OUT_OF_RANGE, u >= 600)


def bounced(patterns, device):
    """Part of wrong results and of refused pixels where a facing surface adds light."""
    u = places(20000, WIDTH)
    stack = view(patterns, u, WIDTH, noise=NOISE, bounce=1.2)
    coordinate, _, _, status = decode(stack, patterns, device)
    ok = status == Status.OK
    return (np.abs(coordinate[ok] - u[ok]) > 1.5).mean(), 1 - ok.mean()


def test_xor_is_right_where_light_between_surfaces_misleads_gray(device):
    wrong, _ = bounced(patterns_of("gray"), device)
    for base_bit in (0, 1):
        still_wrong, refused = bounced(patterns_of("xor", base_bit=base_bit), device)
        assert wrong > 0.02 and still_wrong == 0 and refused < 0.01


FRAMES = np.zeros((8, 4), dtype=np.float32)


@pytest.mark.parametrize("call, words", [
    (lambda f: decode_gray(f, [0, 1], white=2, black=3, extent=8, noise=NOISE), "2 bits of 1 px stripes number 4 px, the projector has 8"),
    (lambda f: decode_gray(f, [0, 0, 1], white=2, black=3, extent=8, noise=NOISE), "frame 0 is given for two patterns"),
    (lambda f: decode_gray(f, [0, 1, 8], white=2, black=3, extent=8, noise=NOISE), "frame 8 does not exist"),
    (lambda f: decode_gray(f, [0, 1, 2], extent=8, noise=NOISE), "neither inverses nor white and black"),
    (lambda f: decode_gray(f, [0, 1, 2], [3, 4], extent=8, noise=NOISE), "3 bits and 2 inverses"),
    (lambda f: decode_gray(f, [0, 1, 2], [3, 4, 5], extent=8, noise=NoiseModel(0, 0)), "the noise is read 0"),
    (lambda f: decode_gray(f, [0, 1, 2], [3, 4, 5], extent=8, stripe_px=0, noise=NOISE), "a stripe 0"),
    (lambda f: decode_xor(f, [0, 1, 2], [3, 4, 5], base_bit=3, extent=8, noise=NOISE), "base bit 3 does not exist"),
])
def test_what_cannot_be_decoded_is_one_sentence(call, words, device):
    with pytest.raises(ArrayError, match=words):
        call(upload(FRAMES, device=device))


@pytest.mark.parametrize("values, saturated, words", [
    (FRAMES.astype(float), None, "values are float64"), (FRAMES[0], None, r"values are float32 \(4,\)"),
    (FRAMES[:, :0], None, "give"), (FRAMES, np.zeros((8, 4), dtype=np.uint8), r"give uint8 \(1, 4\)"),
])
def test_what_cannot_be_uploaded_is_one_sentence(values, saturated, words, device):
    with pytest.raises(ArrayError, match=words):
        upload(values, saturated, device=device)


def test_colour_frames_are_refused(device):
    frames = upload(np.zeros((8, 3, 4), dtype=np.float32), device=device)
    with pytest.raises(ArrayError, match="the frames have 3 channels, this decoder takes 1"):
        decode_gray(frames, [0, 1, 2], [3, 4, 5], extent=8, noise=NOISE)


def test_light_of_other_ways_is_no_place(device):
    """Fog: the stripes of many places at once, wide ones clear and narrow ones faint, and hardly any direct light."""
    patterns = patterns_of("gray")
    u, rng = 200 + places(2000, WIDTH - 200), np.random.default_rng(9)
    shifts = 30 * rng.standard_normal(256)
    fog = np.stack([np.mean([p.level(np.clip(u - 60 + s, 0, WIDTH - 1), None, WIDTH) for s in shifts], axis=0) for p in patterns])
    direct = view(patterns, u, WIDTH, albedo=0.05, ambient=0.0)
    stack = direct + 0.6 * fog + 0.05
    stack = stack + 0.002 * rng.standard_normal(stack.shape)
    coordinate, sigma, _, status = decode(stack, patterns, device, noise=NoiseModel(0.002, 1e-9))
    ok = status == Status.OK
    assert (ok & (np.abs(coordinate - u) > 5 * sigma)).mean() < 0.02 and (status == Status.MULTIPATH).mean() > 0.5
    assert (sigma[status == Status.MULTIPATH] > 0).all()
