"""What nobody declared about photon histograms: pile-up, units and ceiling of the counts, tails of the pulse, the camera's own light."""

import json

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr

from service.depth.tof.count_scale import estimate_count_scale
from service.depth.tof.histograms import full_count
from service.requests.depth import TofOptions
from stage.tof.calibration import TofCalibration, write_calibration
from tests.marks import first_short
from tests.reference import tof
from tests.scenes.depth import depth_of
from tests.scenes.tof import far_camera, pulsed_frames, write

ROWS, COLS = 24, 32
VIEW = tof.room(ROWS, COLS)
BIN_S = 1.5e-9
BIN_M = tof.LIGHT * BIN_S / 2


def solve(folder, counts, least_confidence=None, **declared):
    write(folder, pulsed_frames(counts.astype(np.float32), bin_s=BIN_S, **declared), camera=far_camera(*counts.shape[:2]))
    return depth_of(folder, least_confidence=least_confidence)


def ratios(result, view=VIEW):
    """Error over sigma where solved."""
    maps = result.maps
    return np.abs(maps.range - view.distance)[maps.mask] / maps.sigma[maps.mask]


def is_calibrated(part):
    """Medians of 700 errors scatter by 5 %; a sigma that covers what is not known may be larger than the error."""
    assert 0.5 < 1.4826 * np.median(part) < 1.4
    assert np.mean(part > 5) < 0.01


@pytest.mark.long
@pytest.mark.parametrize(("pulses", "background"), [(600, 0.5), (2000, 4.0)])
def test_pile_up_that_is_not_declared_is_found(pulses, background, tmp_path):
    """Taken for Poisson counts, these ranges are wrong by many sigma at confidence 1."""
    counts = tof.histogram(VIEW, 4000, background=background, pulses=pulses, seed=1)
    result = solve(tmp_path / "c", counts)
    assert any("tof.pulses" in sentence for sentence in result.warnings)
    found = json.loads(result.report_path.read_text())["found"]["pile_up"]
    assert found["from"] == "histograms"
    assert found["pulses"] == pytest.approx(pulses, rel=0.15)
    is_calibrated(ratios(result))
    assert result.maps.mask.mean() > 0.85  # the nearest pixels are saturated


@pytest.mark.long
@pytest.mark.parametrize(("background", "second"), [(0.02, (2.0, 0.4)), (0.5, None), (8.0, (2.0, 0.4))])
def test_right_captures_raise_no_alarm(background, second, tmp_path):
    result = solve(tmp_path / "c", tof.histogram(VIEW, 4000, background=background, second=second, seed=2))
    assert result.warnings == ()
    is_calibrated(ratios(result))


@pytest.mark.long
@pytest.mark.parametrize("seed", [2, 3, 5])
def test_few_photons_over_many_bins_show_no_pile_up(seed, tmp_path):
    """Three walls of one metre to four: what pile-up seems to explain scatters by fifteen, and rises with a pulse that is fitted to it."""
    random = np.random.default_rng(seed)
    down, right = (np.mgrid[0:48, 0:64] - np.array([24, 32]).reshape(2, 1, 1) + 0.5) / 57
    depth = np.minimum(np.minimum(4.0, 1.1 / np.maximum(down, 0.01)), 1.4 / np.maximum(right, 0.01))
    range_m = depth * np.sqrt(right**2 + down**2 + 1)
    albedo = np.clip(0.45 + 0.5 * gaussian_filter(random.standard_normal(depth.shape), 3), 0.1, 0.9)
    late = 2e-10 * (np.arange(192) + 0.5) - range_m[..., None] / (tof.LIGHT / 2)
    pulse = np.exp(-0.5 * (late / 3e-10) ** 2) * 2 / (3 * np.sqrt(2 * np.pi))
    counts = random.poisson((300 * albedo / range_m**2)[..., None] * pulse + 0.4)
    write(tmp_path / "c", pulsed_frames(counts.astype(np.float32), bin_s=2e-10), camera=far_camera(*depth.shape))
    assert depth_of(tmp_path / "c").warnings == ()


@pytest.mark.long
@pytest.mark.parametrize("distance", [11.0, 6.0])
def test_an_even_wall_shows_no_pile_up(distance, tmp_path):
    """Thirty or a hundred photons in every pixel: sums that scatter little about one number are no full counters."""
    view = tof.View(np.linspace(distance, distance + 0.3, 48) * np.ones((32, 1)), np.ones((32, 48)), np.ones((32, 48)))
    result = solve(tmp_path / "c", tof.histogram(view, 4000, background=0.02, seed=5))
    assert result.warnings == ()
    is_calibrated(ratios(result, view))


@first_short(("declared", "said"), [(0.5, "2 times"), (0.25, "4 times"), (1.0, None), (2.0, "0.5 times")])
def test_a_pulse_declared_of_another_length_is_named_and_held_by_sigma(declared, said, tmp_path):
    """As two returns beside each other, a longer pulse moves 37 to 45 % of the ranges by more than five sigma."""
    write_calibration(TofCalibration(pulse_sigma_s=declared * 1.2e-9), tmp_path / "pulse.json")
    write(tmp_path / "c", pulsed_frames(tof.histogram(VIEW, 4000, seed=3).astype(np.float32), bin_s=BIN_S), camera=far_camera(ROWS, COLS))
    result = depth_of(tmp_path / "c", tof=TofOptions(calibration=tmp_path / "pulse.json"))
    assert [said in sentence for sentence in result.warnings if "brightest returns" in sentence] == ([True] if said else [])
    assert np.mean(ratios(result) > 5) < 0.01  # as in is_calibrated


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """Counts of photons, and what is found from them."""
    counts = tof.histogram(VIEW, 1500, background=2.0, seed=3)
    return counts, solve(tmp_path_factory.mktemp("plain"), counts)


@pytest.mark.long
@pytest.mark.parametrize("factor", [10.0, 0.02])
def test_counts_in_other_units_have_the_same_sigma(plain, factor, tmp_path):
    counts, plain = plain
    scaled = solve(tmp_path / "scaled", factor * counts)
    assert plain.warnings == ()
    assert any("tof.count_scale" in sentence for sentence in scaled.warnings)
    both = plain.maps.mask & scaled.maps.mask
    assert (plain.maps.mask ^ scaled.maps.mask).mean() < 0.02
    np.testing.assert_allclose(scaled.maps.range[both], plain.maps.range[both], atol=1e-2)
    np.testing.assert_allclose(scaled.maps.sigma[both], plain.maps.sigma[both], rtol=0.05)  # the estimate of the scale
    declared = solve(tmp_path / "declared", factor * counts, count_scale=factor)
    assert declared.warnings == ()


@pytest.mark.long
def test_smoothed_histograms_are_told(tmp_path):
    counts = tof.histogram(VIEW, 1500, background=3.0, seed=4)
    smooth = 0.5 * counts + 0.25 * np.roll(counts, 1, axis=2) + 0.25 * np.roll(counts, -1, axis=2)
    result = solve(tmp_path / "c", smooth)
    assert any("neighbouring bins vary together" in sentence for sentence in result.warnings)
    is_calibrated(ratios(result))


@pytest.mark.long
def test_nothing_that_a_plain_decode_finds_is_refused(tmp_path):
    """A matched filter with a parabola has .81 of all pixels within 10 cm here at a fifth of the light; significance alone kept .65."""
    view = tof.room(72, 96)
    counts = tof.histogram(view, 800, background=0.5, seed=11)
    everything, default = solve(tmp_path / "all", counts, 0.0), solve(tmp_path / "default", counts)
    near = np.abs(everything.maps.range - view.distance) < 0.1
    assert (near & everything.maps.mask).mean() > 0.81
    assert everything.maps.mask.mean() > 0.95  # the others show nothing
    assert default.maps.mask.mean() > 0.8
    wrong = np.abs(default.maps.range - view.distance)[default.maps.mask] > 0.6
    assert wrong.mean() < 2e-3
    unsure = default.maps.status == 15
    assert unsure.any() and (default.maps.range[unsure] > 0).mean() > 0.99
    is_calibrated(ratios(default, view))


@pytest.mark.long
def test_empty_walls_do_not_appear(tmp_path):
    """Half of the image has a return, the other half background alone: one pixel in some hundreds of it may count as solved."""
    counts = np.random.default_rng(5).poisson(0.5, (72, 96, 64)).astype(float)
    counts[:, :48] = tof.histogram(tof.View(*(array[:, :48] for array in tof.room(72, 96))), 4000, seed=5)
    result = solve(tmp_path / "c", counts)
    assert result.maps.mask[:, 52:].mean() < 5e-3
    assert result.maps.mask[:, :48].mean() > 0.99


@pytest.mark.long
def test_a_tail_that_is_not_declared_is_found(tmp_path):
    """Gaussian: 6 cm late, 10 sigma and more. Time 0 is that of the highest power, and sigma covers that it may be elsewhere."""
    edges = np.arange(65)
    late = np.linspace(0, 12, 400)
    weight = np.exp(-late / 1.5) / np.exp(-late / 1.5).sum()
    times = VIEW.distance[..., None] / BIN_M
    spread = sum(w * np.diff(ndtr((edges - times - delay) / 0.8)) for delay, w in zip(late, weight, strict=True))
    mean = 0.5 + tof.signal(VIEW, 8000)[..., None] * (0.4 * np.diff(ndtr((edges - times) / 0.8)) + 0.6 * spread)
    result = solve(tmp_path / "c", np.random.default_rng(6).poisson(mean))
    assert any("has a tail" in sentence for sentence in result.warnings)
    assert json.loads(result.report_path.read_text())["found"]["pulse"]["tail_s"] == pytest.approx(1.5 * BIN_S, rel=0.3)
    part = ratios(result)
    assert np.median(part) < 1.4 and np.mean(part > 5) < 0.01
    error = (result.maps.range - VIEW.distance)[result.maps.mask]
    assert np.median(np.abs(error - np.median(error))) < 0.03


def test_light_of_the_camera_itself_is_no_surface(tmp_path):
    far = tof.View(VIEW.distance + 1.0, VIEW.albedo, VIEW.cosine)
    counts = tof.histogram(far, 9000, seed=7)
    counts[..., 0:3] += np.random.default_rng(8).poisson([2000, 5000, 1500], (ROWS, COLS, 3))
    result = solve(tmp_path / "c", counts)
    assert any("same pulse" in sentence for sentence in result.warnings)
    is_calibrated(ratios(result, far))
    assert result.maps.mask.mean() > 0.9


@pytest.mark.long
def test_rows_that_disagree_in_turn_are_unsure(tmp_path):
    """Every second row of the left half was recorded five bins late."""
    counts = tof.histogram(VIEW, 9000, seed=9)
    counts[1::2, :16] = np.roll(counts, 5, axis=2)[1::2, :16]
    result = solve(tmp_path / "c", counts)
    assert any("every second row" in sentence for sentence in result.warnings)
    assert result.maps.mask[2:-2, 1:15].mean() < 0.1
    assert result.maps.mask[:, 17:].mean() > 0.95


RANDOM = np.random.default_rng(4)
PLACES = RANDOM.uniform(12, 50, (700, 1))
PULSES = np.exp(-0.5 * ((np.arange(64) - PLACES) / 1.5) ** 2)
COUNTS = RANDOM.poisson(260 * RANDOM.uniform(0.1, 1.5, (700, 1)) * PULSES + 2).astype(np.float32)


@pytest.mark.parametrize("counts", [COUNTS, COUNTS / COUNTS.max(axis=1, keepdims=True), np.minimum(COUNTS, 12)],
                         ids=["photons", "each over its largest", "few"])
def test_photons_show_no_ceiling(counts):
    assert full_count(counts) is None


@pytest.mark.parametrize("ceiling", [255, 150])
def test_a_ceiling_is_found(ceiling):
    assert full_count(np.minimum(COUNTS, ceiling)) == ceiling


@pytest.mark.long
def test_a_bin_that_the_timer_fills_in_every_pixel_is_no_surface(tmp_path):
    counts = tof.histogram(VIEW, 3000, background=0.5, seed=5)
    counts[..., 40] += np.random.default_rng(2).poisson(80, counts.shape[:2])
    result = solve(tmp_path, counts)
    assert any("same pulse" in sentence for sentence in result.warnings)
    is_calibrated(ratios(result))
    assert result.maps.mask.mean() > 0.9


@pytest.mark.long
@pytest.mark.parametrize(("sigma_s", "photons"), [(0.15e-9, 1000), (0.3e-9, 20000)])
def test_a_pulse_much_narrower_than_a_bin_is_no_tail(sigma_s, photons, tmp_path):
    """It shows only where a return lies at the border of a bin: 23 % of the ranges were beyond 5 σ."""
    result = solve(tmp_path / "c", tof.histogram(VIEW, photons, background=0.5, sigma_s=sigma_s, seed=2))
    assert result.warnings == ()
    part = ratios(result)
    assert 1.4826 * np.median(part) < 1.4 and np.mean(part > 5) < 0.01


@pytest.mark.long
@pytest.mark.parametrize("length_s", [1.5e-9, 4e-9])
def test_a_pulse_with_a_flat_top_is_one_return_at_its_middle(length_s, tmp_path):
    """As of a laser that is on for some nanoseconds; two peaks explained it, the stronger one half a pulse aside (26 % beyond 5 σ)."""
    mean = np.zeros((ROWS, COLS, 64))
    shifts = tof.LIGHT / 2 * length_s * (np.arange(40) / 40 - 0.4875)
    for shift in shifts:
        moved = VIEW.distance + shift
        mean += tof.histogram(VIEW._replace(distance=moved, albedo=VIEW.albedo * (moved / VIEW.distance) ** 2), 4000, sigma_s=0.1e-9) / 40
    result = solve(tmp_path / "c", np.random.default_rng(1).poisson(mean))
    is_calibrated(ratios(result))
    assert json.loads(result.report_path.read_text())["found"]["pulse"]["flat_s"] == pytest.approx(length_s, rel=0.1)


@pytest.mark.long
def test_surfaces_beyond_the_period_of_the_laser_are_said(tmp_path):
    """A wall to 11.6 m under a period of 9 m: a fifth of it lies 9 m too near, at confidence 1 otherwise."""
    counts = tof.histogram(tof.room(48, 64), 4000, background=0.05, bins=80, seed=3)
    result = solve(tmp_path / "c", counts[..., :40] + counts[..., 40:])
    assert any("where the histogram begins again" in sentence for sentence in result.warnings) and not result.maps.mask.any()


def test_the_feet_of_pulses_in_the_dark_are_photons():
    """Without background lone counts are of pulses, of few and of many photons: 57 units were said to be one."""
    counts = tof.histogram(VIEW, 50000, background=0, sigma_s=0.3e-9, seed=2).reshape(-1, 64)
    assert estimate_count_scale(counts).units == 1 and estimate_count_scale(7 * counts).units == 7
