"""Census, costs, paths and choice against a twin with loops, and refinement against a known shift."""

import numpy as np
import pytest

from kernels.stereo.choice import choose
from kernels.stereo.cost import BITS, CHANCE, REACH_X, REACH_Y, SCALE, Labels, census, matching_cost
from kernels.stereo.paths import DIRECTIONS, LARGE_STEP, SMALL_STEP, gather
from kernels.stereo.probe import probe
from kernels.stereo.refine import refine
from tests.reference import stereo as reference


def texture(rows, cols, seed=0, *, frames=1):
    """[frames, rows, cols] float32 of noise with a grain of about two pixels."""
    noise = np.random.default_rng(seed).normal(size=(frames, rows + 4, cols + 4))
    smooth = sum(noise[:, i:i + rows, j:j + cols] * np.exp(-((i - 2) ** 2 + (j - 2) ** 2) / 2) for i in range(5) for j in range(5))
    return (0.5 + 0.05 * smooth).astype(np.float32)


def shifted(seed, shift, rows=40, cols=90):
    """Left and right images of sums of waves, the right one moved left by `shift` pixels: exact between pixels too."""
    rng = np.random.default_rng(seed)
    wave, phase = rng.uniform(-1.4, 1.4, (60, 2)), rng.uniform(0, 2 * np.pi, 60)
    y, x = np.mgrid[:rows, :cols].astype(float)
    left, right = (0.5 + 0.04 * sum(np.cos(k[0] * at + k[1] * y + p) for k, p in zip(wave, phase, strict=True)) for at in (x, x + shift))
    return left[None].astype(np.float32), right[None].astype(np.float32)


def volume_of(left, right, seen, labels, device):
    volume = matching_cost(left, right, seen, labels, device=device)
    return volume, volume.numpy().reshape(*left.shape[1:], -1)


def disparities(labels, device):
    return [labels.highest - k for k in range(labels.count(device))]


def test_census_against_the_twin(device):
    image = texture(13, 45)
    bits = census(image, before=3, device=device).numpy()[0, :, 3:48]
    ours = (bits[..., None] >> np.arange(BITS - 1, -1, -1, dtype=np.uint64)) & np.uint64(1)
    assert np.array_equal(ours.astype(bool), reference.census_bits(image[0].astype(float), REACH_X, REACH_Y))


@pytest.mark.parametrize("frames", [1, 3])
@pytest.mark.parametrize("right_cols", [40, 47, 33])
def test_costs_against_the_twin(device, frames, right_cols):
    left, right = texture(9, 40, frames=frames), texture(9, right_cols, 1, frames=frames)
    seen = np.random.default_rng(2).random((9, right_cols)) > 0.1
    labels = Labels.covering(-12, 19, device)
    _, ours = volume_of(left, right, seen, labels, device)
    twin = reference.costs(left.astype(float), right.astype(float), seen, disparities(labels, device), REACH_X, REACH_Y, CHANCE / SCALE)
    assert np.abs(ours - SCALE * twin).max() <= 0.5 + 1e-3  # rounded to whole units


def test_paths_against_the_twin(device):
    left, right = texture(14, 21), texture(14, 21, 3)
    labels = Labels.covering(-3, 27, device)
    volume, costs = volume_of(left, right, np.ones((14, 21), bool), labels, device)
    twin = reference.path_sums(costs.astype(float), DIRECTIONS, SMALL_STEP, LARGE_STEP)
    assert np.array_equal(gather(volume).numpy().reshape(costs.shape), twin)


def test_choice_finds_a_step_and_what_it_hides(device):
    background = texture(40, 140, 4)[0]
    left, right = background[:, 20:120].copy(), background[:, 24:124].copy()  # disparity 4
    front = texture(40, 30, 5)[0]
    left[:, 50:80], right[:, 38:68] = front, front  # disparity 12: eight columns left of it are hidden from the right camera
    labels = Labels.covering(0, 31, device)
    volume, costs = volume_of(left[None], right[None], np.ones(right.shape, bool), labels, device)
    sums = gather(volume)
    choice = choose(volume, sums, labels, right_columns=right.shape[1])
    found = labels.highest - choice.label.numpy()
    total = sums.numpy().reshape(costs.shape)
    assert np.array_equal(choice.label.numpy(), total.argmin(axis=-1))
    agree = choice.disagreement.numpy() <= 1
    assert (found[6:-6, 55:75] == 12).all() and (found[6:-6, 10:38] == 4).all() and agree[6:-6, 55:75].all()
    assert agree[6:-6, 43:49].mean() < 0.1  # hidden
    lead = choice.lead.numpy()
    assert lead[6:-6, 58:72].min() > 0.3 and lead[6:-6, 10:36].min() > 0.3


def test_a_repeating_texture_has_no_lead(device):
    period = 8
    one = texture(48, period, 6)[0]
    left = np.tile(one, 12)[None]
    labels = Labels.covering(0, 31, device)
    volume, _ = volume_of(left, np.roll(left, -3, axis=2), np.ones(left.shape[1:], bool), labels, device)
    choice = choose(volume, gather(volume), labels, right_columns=left.shape[2])
    assert np.abs(choice.lead.numpy()[:, 40:-8]).max() < 0.01


@pytest.mark.parametrize("shift", [3.0, 3.25, 3.5, 3.9])
def test_refinement_finds_a_shift_between_pixels(device, shift):
    left, right = shifted(7, shift)
    start = np.full(left.shape[1:], shift + 0.4, np.float32)  # the minimum of the path costs lies within half a pixel
    fine = refine(left, (1.7 * right + 0.2).astype(np.float32), start, device=device)
    found, sigma = fine.disparity.numpy(), fine.sigma.numpy()
    inner = np.s_[6:-6, 16:-8]
    assert (sigma[inner] > 0).all()
    # bicubic interpolation of waves of down to 4.5 pixels errs by 0.032 a quarter between pixels; the gain and the offset cost nothing
    assert np.abs(found[inner] - shift).max() < 0.04 and fine.misfit.numpy()[inner].max() < 0.06


def test_refinement_finds_slopes(device):
    rows, cols = 40, 90
    rng = np.random.default_rng(8)
    wave, phase = rng.uniform(-1.0, 1.0, (60, 2)), rng.uniform(0, 2 * np.pi, 60)
    y, x = np.mgrid[:rows, :cols].astype(float)
    along, down = 0.12, -0.06

    def image(at):
        return (0.5 + 0.04 * sum(np.cos(k[0] * at + k[1] * y + p) for k, p in zip(wave, phase, strict=True)))[None].astype(np.float32)

    # x' = x - (6 + a x + b y), so that x = (x' + 6 + b y) / (1 - a)
    left, right = image(x), image((x + 6 + down * y) / (1 - along))
    truth = 6 + along * x + down * y
    fine = refine(left, right, np.round(truth).astype(np.float32), device=device)
    inner = np.s_[8:-8, 26:-12]
    assert np.abs(fine.disparity.numpy()[inner] - truth[inner]).max() < 0.03
    assert np.abs(fine.slope_x.numpy()[inner] - along).max() < 0.03 and np.abs(fine.slope_y.numpy()[inner] - down).max() < 0.03


def test_refinement_leaves_unknown_pixels_and_narrow_support(device):
    left, right = shifted(9, 2.0)
    start = np.full(left.shape[1:], np.nan, np.float32)
    start[20, 40] = 2.0  # alone in its window
    fine = refine(left, right, start, device=device)
    assert not fine.sigma.numpy().any() and not fine.disparity.numpy().any()


@pytest.mark.parametrize("shift", [-9, 14])
def test_probe_finds_disparities_of_either_sign(device, shift):
    wide = texture(64, 160, 10)[0]
    left, right = wide[None, :, 30:120], wide[None, :, 30 + shift:120 + shift]
    labels = Labels.covering(-89, 89, device)
    found = probe(left, right, np.ones(right.shape[1:], bool), labels, step=8, device=device)
    unique = found.lead.numpy() > 0.2
    # one place whose match lies outside the right image may find another
    assert unique.mean() > 0.6 and (labels.highest - found.label.numpy()[unique] == shift).sum() >= unique.sum() - 1


@pytest.mark.parametrize("period", [30, 32])
def test_probe_finds_a_rival_in_any_lane_and_of_equals_the_smaller_label(device, period):
    """A period of 32 has its rivals in the same lane of a pack, one of 30 in a lower one."""
    image = np.tile(texture(64, period, 11)[0], 5)[None]
    labels = Labels.covering(-80, 80, device)
    found = probe(image, image, np.ones(image.shape[1:], bool), labels, step=8, device=device)
    across = 8 * np.arange(image.shape[2] // 8) + 4
    largest = (across // period * period)  # disparity of the leftmost equal place
    sure = (across - largest >= 8) & (across - largest < period - 8) & (np.abs(largest) <= 80)
    assert sure.sum() >= 4
    assert (labels.highest - found.label.numpy()[2:-2, sure] == largest[sure]).all() and (found.lead.numpy()[2:-2, sure] == 0).all()


def test_choice_takes_the_smaller_of_equal_labels(device):
    image = np.tile(texture(30, 30, 12)[0], 5)[None]
    labels = Labels.covering(0, 63, device)
    volume, costs = volume_of(image, image, np.ones(image.shape[1:], bool), labels, device)
    sums = gather(volume)
    choice = choose(volume, sums, labels, right_columns=image.shape[2])
    assert np.array_equal(choice.label.numpy(), sums.numpy().reshape(costs.shape).argmin(axis=-1))
