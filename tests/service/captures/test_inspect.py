"""relit info: the facts of a capture, and every fault of it at once."""

import numpy as np

from service.captures.inspect import inspect
from tests.scenes import near_lights
from tests.scenes.captures import edit_frame, make_scene, write_capture, write_exr, write_image, write_manifest
from tests.scenes.near_lights import lamps
from tests.service.recording import Recording

SCENE = make_scene(size=16, lights=6)


def test_facts_of_a_good_capture(tmp_path):
    write_capture(tmp_path, SCENE, saturation=0.9)
    recording = Recording()
    found = inspect(tmp_path, recording)
    facts = dict(found.facts)
    assert found.faults == [] and recording.faults == []
    assert facts["frames"] == "6 distant light" and facts["camera"].startswith("orthographic, 16x16")
    assert facts["mask"] == f"{SCENE.mask.sum()} of 256 pixels" and facts["given"] == "mask, saturation"
    assert float(facts["brightest"].split()[0]) == float(f"{SCENE.images.max():.4g}")
    saturated = int((SCENE.images >= 0.9).any(axis=-1).sum())
    assert facts["saturated"] == f"{saturated} readings at or above 0.9"
    assert facts["lights"].startswith("6 distant, up to ") and facts["lights"].endswith("0 behind the object")


def test_every_fault_is_named(tmp_path):
    write_capture(tmp_path, SCENE)
    for index, value in ((1, np.nan), (2, np.inf)):
        bad = SCENE.images[index].copy()
        bad[3, 3] = value
        write_exr(tmp_path / f"{index:03d}.exr", bad)
    for index in range(2, 6):
        edit_frame(tmp_path, index, light={"type": "off"})
    found = inspect(tmp_path)
    for fault, words in zip(found.faults, ("001.exr", "002.exr", "a normal needs three or more"), strict=True):
        assert words in fault
    assert dict(found.facts)["frames"] == "2 distant light, 4 off light"


def test_lights_that_cannot_be_solved_are_a_fault(tmp_path):
    write_capture(tmp_path, SCENE)
    for index in range(2, 6):
        edit_frame(tmp_path, index, light={"type": "off"})
    (fault,) = inspect(tmp_path).faults
    assert "a normal needs three or more" in fault


def test_near_lights_have_a_distance(tmp_path):
    dome = near_lights.dome(size=16)
    facts = dict(inspect(near_lights.write(tmp_path, dome, lamps(dome, 5, 2.0))).facts)
    assert facts["near lights"].startswith("5, ") and facts["near lights"].endswith("m from the object's centre")


def test_a_capture_of_arrays_alone_has_no_frames_to_decode(tmp_path):
    np.save(tmp_path / "00.npy", np.ones((4, 6, 32), np.float32))
    write_manifest(tmp_path, {"schema": "relit.capture/1", "name": "room", "frames": [
        {"image": "00.npy", "tof": {"type": "pulsed", "bin_s": 1e-9, "start_s": 0.0}}],
        "camera": {"projection": "perspective", "resolution": [6, 4], "focal_px": [5, 5]}})
    recording = Recording()
    found = inspect(tmp_path, recording)
    assert found.faults == [] and recording.faults == [] and dict(found.facts)["frames"] == "1 time of flight"


def test_gradient_frames_that_lack_an_axis_are_a_fault(tmp_path):
    write_capture(tmp_path, SCENE)
    for index, axis in enumerate("xyxyxy"):
        edit_frame(tmp_path, index, light={"type": "gradient", "axis": axis, "sign": 1})
    assert any("lacks axis z" in fault for fault in inspect(tmp_path).faults)


def test_an_empty_mask_is_a_fault(tmp_path):
    write_capture(tmp_path, SCENE)
    write_image(tmp_path / "mask.png", np.zeros((16, 16), np.uint8))
    (fault,) = inspect(tmp_path).faults
    assert "mask" in fault
