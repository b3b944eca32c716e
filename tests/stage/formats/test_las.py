"""LAS files of scans, read back by laspy."""

import json

import laspy
import numpy as np
import pytest

from stage.errors import ResultError, StorageError
from stage.formats.las import write_las

N = 500


def cloud(seed=0, size=(40.0, 6.0, 25.0), centre=(0.0, 0.0, 0.0)):
    random = np.random.default_rng(seed)
    return np.array(centre) + (random.random((N, 3)) - 0.5) * size


def write(path, points, intensity=None, time_s=None, shot=None, range_m=None, **more):
    count = len(points)
    intensity = np.ones(count) if intensity is None else intensity
    time_s = np.arange(count, dtype=float) if time_s is None else time_s
    shot = np.arange(count) if shot is None else shot
    return write_las(points, intensity, time_s, shot, np.ones(count) if range_m is None else range_m, path, **more), laspy.read(path)


@pytest.mark.parametrize(("points", "scale_m"), [
    (cloud(), 1e-4),
    (cloud(centre=(5.1e5, 120.0, 5.4e6)), 1e-4),  # map coordinates, of which float32 would leave half a metre
    (cloud(size=(1e6, 10, 10)), 1e-3),  # 32 bits of tenths of a millimetre reach 215 km to each side
])
def test_places_are_kept_to_the_scale(points, scale_m, tmp_path):
    scales, las = write(tmp_path / "a.las", points)
    assert scales.scale_m == pytest.approx(scale_m)
    assert las.header.version == laspy.header.Version(1, 4) and las.header.point_count == N
    np.testing.assert_allclose(las.header.scales, scales.scale_m)
    np.testing.assert_allclose(las.header.offsets, scales.offset_m)
    np.testing.assert_allclose(las.xyz, points, atol=0.5 * scales.scale_m + 1e-9 * np.abs(points).max())  # half a step, and float64
    np.testing.assert_allclose(las.header.mins, points.min(axis=0), atol=scales.scale_m)


def test_whole_intensities_are_kept_and_others_scaled(tmp_path):
    whole = np.arange(N) * 100.0
    scales, las = write(tmp_path / "a.las", cloud(), intensity=whole)
    assert scales.intensity_scale == 1
    np.testing.assert_array_equal(las.intensity, whole)
    parts = np.linspace(-0.1, 0.9, N)
    scales, las = write(tmp_path / "b.las", cloud(), intensity=parts, provenance={"relit:capture": "yard"})
    np.testing.assert_allclose(las.intensity * scales.intensity_scale, np.maximum(parts, 0), atol=0.5 * scales.intensity_scale * 1.001)
    notes = json.loads(las.vlrs.get_by_id("relit", (1,))[0].record_data)
    assert notes == {"intensity_scale": scales.intensity_scale, "relit:capture": "yard"}


def test_times_and_returns_are_those_of_the_shots(tmp_path):
    shot = np.array([0, 1, 1, 2, 1])
    range_m = np.array([5.0, 7.0, 3.0, 2.0, 4.0])
    time_s = 0.25 * shot + 1e5
    _, las = write(tmp_path / "a.las", cloud()[:5], shot=shot, range_m=range_m, time_s=time_s)
    np.testing.assert_array_equal(las.gps_time, time_s)
    assert list(las.return_number) == [1, 3, 1, 1, 2]
    assert list(las.number_of_returns) == [1, 3, 3, 1, 3]


def test_a_shot_of_many_returns_counts_to_fifteen(tmp_path):
    _, las = write(tmp_path / "a.las", cloud()[:20], shot=np.zeros(20, dtype=int), range_m=np.arange(20.0))
    assert las.return_number.max() == 15 and set(las.number_of_returns) == {15}


def test_equal_scans_make_equal_files_and_a_failed_one_leaves_nothing(tmp_path):
    for name in ("a.las", "b.las"):
        write(tmp_path / name, cloud())
    assert (tmp_path / "a.las").read_bytes() == (tmp_path / "b.las").read_bytes()
    (tmp_path / "full").touch()
    with pytest.raises(StorageError):
        write(tmp_path / "full" / "c.las", cloud())
    with pytest.raises(ResultError, match="no point"):
        write(tmp_path / "d.las", np.empty((0, 3)))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.las", "b.las", "full"]
