"""Time of flight through `relit depth`: from raw frames of an independent simulator to depth.exr, held to what is published of it."""

import json

import numpy as np
import pytest

from kernels.status import Status
from service.requests.depth import TofOptions
from stage.capture.camera import Camera
from stage.formats.ply import read_ply
from stage.results.depth_maps import DepthMaps
from stage.stack.fingerprint import digest
from stage.tof.calibration import Temperature, TofCalibration, fit_harmonics, write_calibration
from tests.reference import tof
from tests.scenes.depth import depth_of
from tests.scenes.tof import CAMERA, cw_frames, pulsed_frames, write

ROWS, COLS = 96, 128
VIEW = tof.room(ROWS, COLS)


def run(folder, near_m=None, far_m=None, least_confidence=None, **options):
    result = depth_of(folder, near_m=near_m, far_m=far_m, least_confidence=least_confidence, tof=TofOptions.model_validate(options))
    return result, DepthMaps.read(result.depth_path), json.loads(result.report_path.read_text())


def along(view=VIEW):
    """[rows, cols] depth of a range of one."""
    x, y = Camera.model_validate(CAMERA).plane_coordinates()
    return 1 / np.sqrt(x**2 + y**2 + 1)


def test_noise_free_frames_give_exact_range_depth_and_points(tmp_path):
    settings = tof.even(tof.HZ, 4)
    result, maps, report = run(write(tmp_path / "c", cw_frames(tof.correlations(VIEW, 1e5, settings), settings)))
    assert maps.mask.all()
    assert np.abs(maps.range - VIEW.distance).max() < 5e-5
    assert np.abs(maps.depth - VIEW.distance * along()).max() < 5e-5
    assert np.abs(np.linalg.norm(read_ply(result.points_path).points, axis=1) - VIEW.distance.ravel()).max() < 1e-4
    assert report["found"]["common_range_m"] == pytest.approx(14.9896)


@pytest.mark.parametrize(("part", "median_m", "wrong"), [(1.0, 7.2e-3, 0.002), (0.2, 18.5e-3, 0.024)])
def test_noisy_frames_are_as_good_as_published(part, median_m, wrong, tmp_path):
    settings = tof.even(tof.HZ, 4)
    images = tof.correlations(VIEW, 1e5 * part, settings, ambient=20, seed=5)
    _, maps, report = run(write(tmp_path / "c", cw_frames(images, settings)))
    error = np.where(maps.mask, maps.range - VIEW.distance, np.inf)
    assert np.median(np.abs(error)) <= median_m
    assert np.mean(np.abs(error) > 0.9) <= wrong
    z_error = (maps.depth - VIEW.distance * along())[np.abs(error) < 0.9]
    assert np.sqrt(np.mean((z_error / maps.sigma[np.abs(error) < 0.9]) ** 2)) == pytest.approx(1, abs=0.1)
    assert report["found"]["noise"]["electrons_per_unit"] == pytest.approx(1, rel=0.1)


def test_what_is_unsure_is_kept_and_the_request_says_what_counts(tmp_path):
    """A room with mixed edges under little light: of all pixels, a plain decode has 0.75 within 5 cm, and 0.69 were kept at all."""
    settings, fine = tof.even((50e6, 60e6), 4), tof.room(3 * ROWS, 3 * COLS)
    mean = tof.correlations(fine, 4000, settings, ambient=40).reshape(8, ROWS, 3, COLS, 3).mean(axis=(2, 4))
    random = np.random.default_rng(6)
    folder = write(tmp_path / "c", cw_frames(random.poisson(mean) + random.normal(0, 5, mean.shape), settings))
    truth = np.median(fine.distance.reshape(ROWS, 3, COLS, 3).transpose(0, 2, 1, 3).reshape(ROWS, COLS, 9), axis=-1)
    result, _, report = run(folder)
    maps = DepthMaps.read(result.depth_path, unsure=True)
    _, every, _ = run(folder, least_confidence=0.0)
    unsure = maps.status == Status.UNSURE
    assert unsure.mean() > 0.1 and not maps.mask[unsure].any() and (maps.range[unsure] > 0).all() and (maps.sigma[unsure] > 0).all()
    assert (maps.confidence[unsure] < 2 / 3).all() and (maps.confidence[maps.mask] >= 2 / 3 - 1e-3).all()  # rounded to half
    assert report["found"]["with_neighbours"] > 0.1 * ROWS * COLS
    np.testing.assert_array_equal(every.mask, maps.mask | unsure)
    np.testing.assert_array_equal(every.range, np.where(every.mask, maps.range, 0))
    assert np.mean((np.abs(maps.range - truth) < 0.05) & (maps.range > 0)) > 0.79
    share = (np.abs(maps.range - truth) * maps.depth / np.maximum(maps.range, 1e-9))[maps.mask] / maps.sigma[maps.mask]
    assert 0.6 < np.median(share) < 1.0


def test_depths_that_are_all_unsure_are_written_and_the_command_says_so(relit, tmp_path):
    settings = tof.even(tof.HZ, 4)
    folder = write(tmp_path / "c", cw_frames(tof.correlations(VIEW, 1e5, settings, ambient=20, seed=5), settings))
    outcome = relit("depth", folder, "--out", tmp_path / "out", "--max-sigma", "1e-6")
    assert outcome.code == 1 and "warning  no depth is sure enough to count as solved" in outcome.out
    assert "without --max-sigma, --least-confidence 0 counts" in outcome.out
    maps = DepthMaps.read(tmp_path / "out" / "depth.exr", unsure=True)
    assert not maps.mask.any() and maps.estimated.mean() > 0.9
    assert np.median(np.abs(maps.range - VIEW.distance)[maps.estimated]) < 0.01  # the first row of the figures above
    assert len(read_ply(tmp_path / "out" / "points.ply").points) == 0


def test_no_vote_leaves_dark_pixels_alone(tmp_path):
    settings = tof.even(tof.HZ, 4)
    folder = write(tmp_path / "c", cw_frames(tof.correlations(VIEW, 1500, settings, ambient=40, seed=2), settings))
    assert run(folder)[2]["found"]["with_neighbours"] > 0
    _, maps, report = run(folder, vote=False)
    assert report["found"]["with_neighbours"] == 0 and (maps.range[maps.status == Status.LOW_MODULATION] == 0).all()


def test_two_returns_keep_a_range_whose_deviation_covers_the_disagreement(tmp_path):
    settings, near = tof.even(tof.HZ, 4), tof.View(np.clip(VIEW.distance, 0.5, 6), VIEW.albedo, VIEW.cosine)
    images = tof.correlations(near, 1e5, settings, seed=1, second=(1.3, 0.3))
    images[:, :, :30] = tof.correlations(near, 1e5, settings, seed=1)[:, :, :30]
    result, _, report = run(write(tmp_path / "c", cw_frames(images, settings)))
    maps = DepthMaps.read(result.depth_path, unsure=True)
    found = maps.status == Status.MULTIPATH
    assert found.mean() > 0.3 and (maps.range[found] > 0).all() and not maps.mask[found].any()
    error = (np.abs(maps.range - near.distance) * along())[found & (np.abs(maps.range - near.distance) < 0.9)]
    sigma = maps.sigma[found & (np.abs(maps.range - near.distance) < 0.9)]
    assert np.median(error / sigma) < 3  # both returns pull one way; with noise alone it is above 20
    assert any("disagree by" in warning and "frames[].tof" in warning for warning in report["warnings"])


def test_three_phases_and_images_in_other_units(tmp_path):
    settings = tof.even((16e6, 80e6, 120e6), 3)
    images = 1e-4 * tof.correlations(VIEW, 1e5, settings, seed=1)
    _, maps, _ = run(write(tmp_path / "c", cw_frames(images, settings)))
    error = (maps.range - VIEW.distance)[maps.mask]
    assert maps.mask.mean() > 0.98 and np.median(np.abs(error)) < 5e-3


@pytest.mark.long
def test_filters_run_when_they_are_named(tmp_path):
    settings = tof.even(tof.HZ, 4)
    fine = tof.room(4 * ROWS, 4 * COLS)
    mixed = tof.correlations(fine, 2e4, settings).reshape(12, ROWS, 4, COLS, 4).mean(axis=(2, 4))
    random = np.random.default_rng(0)
    folder = write(tmp_path / "c", cw_frames(random.poisson(mixed) + random.normal(0, 5, mixed.shape), settings))
    truth = fine.distance.reshape(ROWS, 4, COLS, 4)
    between = (truth.max(axis=(1, 3)) - truth.min(axis=(1, 3))) > 0.5
    plain, flying, both = (run(folder, filters=names)[1] for names in ("", "flying", "flying,bilateral"))
    assert not np.any(plain.status == Status.FLYING)
    assert np.any(flying.status == Status.FLYING)
    assert np.mean((flying.status == Status.FLYING)[~between]) < 2e-3
    same = flying.mask
    np.testing.assert_array_equal(flying.range[same], plain.range[same])  # nothing is smoothed
    flat = same & ~between
    middle = truth.mean(axis=(1, 3))
    assert np.median(np.abs(both.range - middle)[flat]) < 0.6 * np.median(np.abs(plain.range - middle)[flat])


def test_calibration_takes_wiggling_offset_and_drift_out(tmp_path):
    settings, waves = tof.even(tof.HZ, 4), {3: 0.08, 5: -0.02}
    sweep = tof.View(np.linspace(0.5, 9.0, 600)[None], np.full((1, 600), 0.8), np.ones((1, 600)))
    tables = []
    for hz in tof.HZ:
        images = tof.correlations(sweep, 1e6, tof.even((hz,), 4), harmonics=waves)
        _, _, phase = tof.phases(images, np.arange(4) * np.pi / 2)
        tables.append(fit_harmonics(phase, sweep.distance[0], hz))
    calibration = TofCalibration(electrons_per_unit=1, read_noise_electrons=5, harmonics=tuple(tables), offset_m=0.03,
                                 temperature=Temperature(reference_c=25, metres_per_c=1e-3))
    write_calibration(calibration, tmp_path / "camera.json")
    folder = write(tmp_path / "c", cw_frames(tof.correlations(VIEW, 1e5, settings, harmonics=waves), settings))
    _, raw, _ = run(folder)
    _, maps, report = run(folder, calibration=tmp_path / "camera.json", temperature_c=35.0)
    options = json.loads(maps.provenance["relit:options"])
    assert options["tof_calibration"] == digest(tmp_path / "camera.json") and "calibration" not in options["tof"]  # no path of this machine
    assert report["options"]["tof"]["calibration"] == str(tmp_path / "camera.json")
    expected = VIEW.distance - 0.03 - 0.01
    assert np.abs(maps.range - expected)[maps.mask].max() < 1e-3 and maps.mask.mean() > 0.99
    assert np.abs(raw.range - VIEW.distance)[raw.mask].max() > 3e-3 or raw.mask.mean() < 0.99
    assert report["found"]["wiggling"] == list(tof.HZ)


@pytest.mark.long
def test_histograms_pile_up_and_returns(tmp_path):
    view, camera = tof.room(ROWS // 2, COLS // 2), {**CAMERA, "resolution": [COLS // 2, ROWS // 2], "focal_px": [55.0, 55.0]}
    counts = tof.histogram(view, 4000, pulses=3000, background=0.05, seed=2)
    _, maps, report = run(write(tmp_path / "p", pulsed_frames(counts, pulses=3000, first_photon_only=True), camera=camera))
    assert np.median(np.abs(maps.range - view.distance)[maps.mask]) < 0.020
    assert maps.mask.mean() > 0.7
    assert report["found"]["pulse"]["sigma_s"] == pytest.approx(1.2e-9, rel=0.05)
    near = tof.View(np.clip(view.distance, 0.5, 7), view.albedo, view.cosine)
    two = write(tmp_path / "q", pulsed_frames(tof.histogram(near, 200000, seed=1, second=(2.0, 0.6))), camera=camera)
    write_calibration(TofCalibration(pulse_sigma_s=1.2e-9), tmp_path / "pulse.json")
    for which, behind, known in (("first", 0.0, {}), ("last", 2.0, {"calibration": tmp_path / "pulse.json"})):
        _, maps, _ = run(two, which=which, **known)
        assert np.median(np.abs(maps.range - near.distance - behind)[maps.mask]) < 0.02


def test_an_orthographic_camera_has_depth_equal_to_range(tmp_path):
    settings = tof.even((20e6,), 4)
    view = tof.View(np.full((4, 6), 3.0), np.ones((4, 6)), np.ones((4, 6)))
    camera = {"projection": "orthographic", "resolution": [6, 4], "pixel_size_m": 0.01}
    result, maps, _ = run(write(tmp_path / "c", cw_frames(tof.correlations(view, 1e5, settings), settings), camera=camera))
    np.testing.assert_allclose(maps.depth, 3.0, atol=5e-5)
    points = read_ply(result.points_path).points
    assert np.ptp(points[:, 0]) == pytest.approx(0.05, rel=1e-5) and np.abs(points[:, 2] + 3).max() < 5e-5
    assert not any("pixel_size_m" in sentence for sentence in result.warnings)


def test_pixels_without_a_size_are_said_and_make_no_asset(tmp_path, relit):
    """The depth is right without it, but a surface would be metres deep and pixels wide."""
    settings = tof.even((20e6,), 4)
    view = tof.View(np.full((4, 6), 3.0), np.ones((4, 6)), np.ones((4, 6)))
    frames = cw_frames(tof.correlations(view, 1e5, settings), settings)
    result, maps, _ = run(write(tmp_path / "c", frames, camera={"projection": "orthographic", "resolution": [6, 4]}))
    np.testing.assert_allclose(maps.depth, 3.0, atol=5e-5)
    assert "camera.pixel_size_m is missing: x and y of points.ply are in pixels, and its z in metres" in result.warnings
    relit("export", result.depth_path.parent, "--out", tmp_path / "a.usdz").refused("depth.exr: camera.pixel_size_m is missing")


def test_no_depth_lies_behind_the_camera(tmp_path):
    """An offset of the calibration makes the nearest ranges negative."""
    settings = tof.even((20e6,), 4)
    view = tof.View(np.linspace(0.02, 0.4, ROWS * COLS).reshape(ROWS, COLS), np.ones((ROWS, COLS)), np.ones((ROWS, COLS)))
    file = tmp_path / "camera.json"
    write_calibration(TofCalibration(offset_m=0.1), file)
    result, maps, _ = run(write(tmp_path / "c", cw_frames(tof.correlations(view, 1e5, settings), settings)), calibration=file)
    behind = view.distance < 0.1 - 1e-4
    assert behind.sum() > 1000 and (maps.status[behind] == Status.OUT_OF_RANGE).all() and not maps.mask[behind].any()
    assert maps.mask[view.distance > 0.1 + 1e-4].all() and (read_ply(result.points_path).points[:, 2] < 0).all()


def test_pixels_in_trouble_have_a_status(tmp_path):
    settings = tof.even(tof.HZ, 4)
    images = tof.correlations(VIEW, 1e5, settings, ambient=300, seed=1)
    images[:, 10:12] = 2e6
    images[:, 20:22] = 300 + np.random.default_rng(0).normal(0, 18, images[:, 20:22].shape)
    _, maps, report = run(write(tmp_path / "c", cw_frames(images, settings), saturation=2e6))
    assert report["warnings"] == []
    assert (maps.status[10:12] == Status.SATURATED).all()
    assert np.mean(maps.status[20:22] == Status.LOW_MODULATION) > 0.99
    assert report["pixels"]["saturated"] == 2 * COLS


@pytest.mark.parametrize(("hz", "phases", "far", "message"), [
    ((20e6,), 2, None, "20 MHz has 2 different reference phases"),
    ((20e6, 30e6), 4, 20.0, "repeat after 14.99 m, 20 m were asked for"),
])
def test_bad_frames_are_one_sentence(hz, phases, far, message, tmp_path):
    settings = tof.even(hz, phases)
    folder = write(tmp_path / "c", cw_frames(tof.correlations(VIEW, 1e5, settings), settings))
    with pytest.raises(ValueError) as caught:
        run(folder, far_m=far)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_a_span_outside_the_histogram_is_refused(tmp_path):
    folder = write(tmp_path / "p", pulsed_frames(tof.histogram(VIEW, 4000)))
    with pytest.raises(ValueError, match=r"to 30 m lie outside the histogram, which covers 0 to 14.39 m"):
        run(folder, near_m=20.0, far_m=30.0)
