"""Raw time-of-flight frames as files."""

import json

import numpy as np
import pytest

from stage.capture.capture import Capture
from stage.errors import ImageError, ManifestError
from stage.tof.raw_frames import is_pulsed, read_correlations, read_histograms
from tests.scenes.captures import write_exr

ROWS, COLS = 3, 4
CAMERA = {"projection": "perspective", "resolution": [COLS, ROWS], "focal_px": [5, 5]}


def cw(hz=20e6, delta=0.0):
    return {"type": "cw", "modulation_hz": hz, "reference_phase_rad": delta}


def pulsed(**more):
    return {"type": "pulsed", "bin_s": 1e-9, "start_s": 0.0, **more}


def capture(folder, frames, **more):
    (folder / "capture.json").write_text(json.dumps({"schema": "relit.capture/1", "name": "t", "camera": CAMERA, "frames": frames, **more}))
    return Capture.open(folder)


def save(folder, name, values):
    np.save(folder / name, values)
    return name


def test_correlations_come_from_arrays_and_images(tmp_path):
    values = np.arange(12.0).reshape(ROWS, COLS) + 0.5
    write_exr(tmp_path / "b.exr", values)
    found = capture(tmp_path, [{"image": save(tmp_path, "a.npy", values), "tof": cw()}, {"image": "b.exr", "tof": cw(delta=1.0)}])
    assert not is_pulsed(found)
    frames = read_correlations(found)
    np.testing.assert_allclose(frames.images, np.stack([values.ravel()] * 2))
    assert list(frames.reference_phase_rad) == [0, 1]
    assert list(frames.scale) == [1, 1]


def test_unequal_exposures_become_scales(tmp_path):
    zero = np.zeros((ROWS, COLS))
    frames = [{"image": save(tmp_path, f"{n}.npy", zero), "exposure_s": s, "tof": cw(delta=n)} for n, s in enumerate((1.0, 3.0))]
    np.testing.assert_allclose(read_correlations(capture(tmp_path, frames)).scale, [2, 2 / 3])


def test_histograms_of_several_frames_are_added(tmp_path):
    counts = np.ones((ROWS, COLS, 8), np.uint16)
    frames = [{"image": save(tmp_path, f"{n}.npy", counts), "tof": pulsed(pulses=100, first_photon_only=True)} for n in range(2)]
    found = read_histograms(capture(tmp_path, frames))
    assert found.counts.shape == (ROWS * COLS, 8) and (found.counts == 2).all()
    assert found.pulses == 200 and found.first_photon_only


@pytest.mark.parametrize(("values", "message"), [
    (np.ones((COLS, ROWS)), "is (4, 3), the camera's image is (3, 4)"),
    (np.ones((ROWS, COLS), complex), "not an array of real numbers"),
    (np.array([{"a": 1}], dtype=object), "not an array of real numbers"),
])
def test_arrays_that_are_no_correlation_are_refused(values, message, tmp_path):
    found = capture(tmp_path, [{"image": save(tmp_path, "a.npy", values), "tof": cw()}])
    with pytest.raises(ImageError) as caught:
        read_correlations(found)
    assert message in str(caught.value) and "a.npy" in str(caught.value)


def test_a_truncated_array_is_refused(tmp_path):
    found = capture(tmp_path, [{"image": save(tmp_path, "a.npy", np.ones((ROWS, COLS))), "tof": cw()}])
    whole = (tmp_path / "a.npy").read_bytes()
    (tmp_path / "a.npy").write_bytes(whole[:-9])
    with pytest.raises(ImageError, match=r"not a whole \.npy"):
        read_correlations(found)


@pytest.mark.parametrize(("values", "message"), [
    (np.ones((ROWS, COLS)), "(rows, cols, bins)"),
    (np.ones((ROWS, COLS, 2)), "has 2 bins"),
    (-np.ones((ROWS, COLS, 8)), "negative or not finite"),
    (np.zeros((ROWS, COLS, 8)), "every histogram is empty"),
])
def test_arrays_that_are_no_histogram_are_refused(values, message, tmp_path):
    found = capture(tmp_path, [{"image": save(tmp_path, "a.npy", values), "tof": pulsed()}])
    with pytest.raises(ImageError) as caught:
        read_histograms(found)
    assert message in str(caught.value)


def test_manifests_that_do_not_fit_together_are_refused(tmp_path):
    counts, plane = np.ones((ROWS, COLS, 8)), np.ones((ROWS, COLS))
    save(tmp_path, "a.npy", counts), save(tmp_path, "b.npy", counts), save(tmp_path, "c.npy", plane)
    mixed = capture(tmp_path, [{"image": "a.npy", "tof": pulsed()}, {"image": "c.npy", "tof": cw()}])
    with pytest.raises(ManifestError, match="cw and pulsed"):
        is_pulsed(mixed)
    with pytest.raises(ManifestError, match=r"bins of b\.npy are others"):
        read_histograms(capture(tmp_path, [{"image": "a.npy", "tof": pulsed()}, {"image": "b.npy", "tof": pulsed(start_s=1e-9)}]))
    with pytest.raises(ManifestError, match="pulses: is missing"):
        read_histograms(capture(tmp_path, [{"image": "a.npy", "tof": pulsed(first_photon_only=True)}]))
