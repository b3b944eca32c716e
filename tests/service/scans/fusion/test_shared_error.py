"""What scans err as a whole, beside noise that is declared wrongly, on planes whose errors are known."""

import numpy as np
import pytest

from service.requests.register import Misplaced
from service.scans.fusion.misplaced import Readings, Sample
from service.scans.fusion.shared_error import shared_sigma
from tests.scenes.register import fuse_scans
from tests.scenes.statue import turntable, write_scans

PIXEL_M, SIGMA_M = 1e-3, 2e-4


def planes(random: np.random.Generator, shared_m: float, stated: float, count: int = 4) -> tuple[list[Sample], list[Readings]]:
    """Samples of planes at z = 0 with noise SIGMA_M, stated as `stated` times that, and waves of 200 mm whose variance is shared_m²."""
    waves = [(random.uniform(-5, 5, (8, 2)) * 2 * np.pi, random.uniform(0, 2 * np.pi, 8)) for _ in range(count)]

    def error(number: int, places: np.ndarray) -> np.ndarray:
        turns, phases = waves[number]
        return shared_m * np.sqrt(2 / 8) * np.cos(places @ turns.T + phases).sum(axis=1) + SIGMA_M * random.standard_normal(len(places))

    samples = []
    for number in range(count):
        places = random.random((2000, 2))
        points = np.column_stack([places, error(number, places)])
        samples.append(Sample(points, np.tile([0.0, 0.0, 1.0], (2000, 1)), np.full(2000, (stated * SIGMA_M)**2)))
    whole = np.concatenate([sample.points for sample in samples])
    readings = []
    for number in range(count):
        at = np.flatnonzero(np.arange(len(whole)) // 2000 != number)
        distance = whole[at, 2] - error(number, whole[at, :2])
        distance[::50] += 0.02  # another surface
        readings.append(Readings(at, distance.astype(np.float32), np.full(len(at), stated * SIGMA_M * np.sqrt(2), np.float32)))
    return samples, readings


@pytest.mark.parametrize("stated", [1.0, 0.5])
@pytest.mark.parametrize("shared_m", [0.0, 2e-4, 6e-4])
def test_noise_does_not_count_and_what_a_place_has_in_common_does(shared_m, stated):
    samples, readings = planes(np.random.default_rng(0), shared_m, stated)
    found = shared_sigma(samples, readings, [0, 1, 2, 3], PIXEL_M)
    # the mean of 24 000 products of noise 2 σ² scatters by .013 σ², and eight waves a scan differ from their variance by a quarter
    assert found == pytest.approx(shared_m, rel=0.25, abs=0.2 * SIGMA_M)


def test_scans_with_too_little_in_common_tell_nothing():
    samples, readings = planes(np.random.default_rng(1), 6e-4, 1.0)
    few = [Readings(each.at[:40], each.distance[:40], each.expected[:40]) for each in readings]
    assert shared_sigma(samples, few, [0, 1, 2, 3], PIXEL_M) is None
    assert shared_sigma(samples, readings, [2], PIXEL_M) is None


def test_points_as_dense_as_pixels_tell_too():
    """The search goes on beyond the nearest points: here 40 lie within four pixels of each point, and none of them counts."""
    samples, readings = planes(np.random.default_rng(2), 6e-4, 1.0)
    found = shared_sigma(samples, readings, [0, 1, 2, 3], 2e-2)
    # of waves of 200 mm and more a quarter of the variance is alike at 80 mm, so that half of the error shows; eight waves vary
    assert found == pytest.approx(3e-4, rel=0.5)


def test_what_is_not_known_is_null_and_said(tmp_path):
    """Two sides of a statue that are opposite have nothing in common."""
    file = write_scans(tmp_path, turntable(2, (48, 64), range_m=2.0))
    result = fuse_scans(file, tmp_path / "out", misplaced=Misplaced.KEEP)
    assert result.facts["shared_sigma_m"] is None
    assert any("too little in common to tell what each errs as a whole" in warning for warning in result.warnings)
