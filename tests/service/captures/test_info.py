"""What relit info says of a capture, and which contradictions it finds in its images."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from service.captures.info import inspect
from service.requests.captures import InfoRequest
from stage.capture.capture import Capture
from stage.capture.lighting import check_solvable
from stage.errors import ManifestError
from stage.formats import exr
from tests.reference.colour import srgb
from tests.scenes import near_lights
from tests.scenes.captures import edit_frame, make_scene, manifest_of, write_capture, write_exr, write_image, write_manifest
from tests.scenes.ellipsoid import ellipsoid
from tests.scenes.near_lights import lamps
from tests.service.recording import Recording

SCENE = make_scene(size=16, lights=6)
EXPLAINED = ellipsoid(count=12)
EXPOSURE = 0.25
SCALED = np.maximum(EXPLAINED.images, 0) / EXPLAINED.images.max()


def test_every_fault_is_named(tmp_path):
    write_capture(tmp_path, SCENE)
    for index, value in ((1, np.nan), (2, np.inf)):
        bad = SCENE.images[index].copy()
        bad[3, 3] = value
        write_exr(tmp_path / f"{index:03d}.exr", bad)
    for index in range(2, 6):
        edit_frame(tmp_path, index, light={"type": "off"})
    found = inspect(InfoRequest(capture=tmp_path))
    for fault, words in zip(found.faults, ("001.exr", "002.exr", "a normal needs three or more"), strict=True):
        assert words in fault
    assert dict(found.facts)["frames"] == "2 distant light, 4 off light"
    write_capture(tmp_path, SCENE)
    for index, axis in enumerate("xyxyxy"):
        edit_frame(tmp_path, index, light={"type": "gradient", "axis": axis, "sign": 1})
    assert any("lacks axis z" in fault for fault in inspect(InfoRequest(capture=tmp_path)).faults)


def room(frames: list[dict]) -> dict:
    """The manifest of a time-of-flight capture of 6 × 4 pixels."""
    return {"schema": "relit.capture/1", "name": "room", "frames": frames,
            "camera": {"projection": "perspective", "resolution": [6, 4], "focal_px": [5, 5]}}


def test_near_lights_have_a_distance_and_a_capture_may_be_of_arrays_alone(tmp_path):
    dome = near_lights.dome(size=16)
    facts = dict(inspect(InfoRequest(capture=near_lights.write(tmp_path, dome, lamps(dome, 5, 2.0)))).facts)
    assert facts["near lights"].startswith("5, ") and facts["near lights"].endswith("m from the object's centre")
    np.save(tmp_path / "00.npy", np.ones((4, 6, 32), np.float32))
    write_manifest(tmp_path, room([{"image": "00.npy", "tof": {"type": "pulsed", "bin_s": 1e-9, "start_s": 0.0}}]))
    recording = Recording()
    found = inspect(InfoRequest(capture=tmp_path), recording)
    assert found.faults == [] and recording.faults == [] and dict(found.facts)["frames"] == "1 time of flight"


def correlation_images(folder, values, **manifest):
    """Write a capture of four correlation images, each [rows, cols] float32, as EXR files."""
    frames = []
    for index, plane in enumerate(values):
        exr.write(folder / f"{index}.exr", {"Y": plane}, color_space="data", metadata={})
        frames.append({"image": f"{index}.exr", "tof": {"type": "cw", "modulation_hz": 6e7, "reference_phase_rad": index * np.pi / 2}})
    write_manifest(folder, room(frames) | manifest)
    return folder


def test_correlation_images_have_both_signs(tmp_path):
    phase = np.linspace(1, 2, 24, dtype=np.float32).reshape(4, 6)
    images = [100 * np.cos(phase - index * np.pi / 2).astype(np.float32) for index in range(4)]
    found = inspect(InfoRequest(capture=correlation_images(tmp_path, images, saturation=99.0)))
    facts, values = dict(found.facts), np.stack(images)
    assert found.faults == []
    assert facts["camera"].endswith("depths in metres")
    assert facts["recorded"] == f"{values.min():.4g} to {values.max():.4g}: correlation images have both signs"
    assert facts["saturated"] == f"{(values >= 99).sum()} readings at or above 99" and "brightest" not in facts
    images[2][0, :3] = np.nan  # as the solver takes them
    facts = dict(inspect(InfoRequest(capture=correlation_images(tmp_path, images))).facts)
    assert facts["not finite"] == "3 readings, which count as saturated"
    images[2][:] = np.nan
    (fault,) = inspect(InfoRequest(capture=correlation_images(tmp_path, images))).faults
    assert fault == f"{tmp_path}/2.exr: no reading is finite"


def test_faults_of_time_of_flight_are_named(tmp_path):
    """Arrays too are read."""
    np.save(tmp_path / "00.npy", np.full((4, 6, 32), -1.0, np.float32))
    np.save(tmp_path / "01.npy", np.ones((4, 5, 32), np.float32))
    write_manifest(tmp_path, room([{"image": f"0{index}.npy", "tof": {"type": "pulsed", "bin_s": width, "start_s": 0.0}}
                                   for index, width in enumerate((1e-9, 2e-9))]))
    faults = inspect(InfoRequest(capture=tmp_path)).faults
    for fault, words in zip(faults, ("00.npy: holds counts that are negative", "01.npy: is (4, 5, 32)", "bins of 01.npy"),
                            strict=True):
        assert words in fault


def test_placeholders_are_no_fault(tmp_path):
    """The light that docs/calibration.md recommends for frames before they are measured."""
    write_capture(tmp_path, SCENE)
    text = (Path(__file__).parents[3] / "docs" / "calibration.md").read_text(encoding="utf-8")
    recommended = json.loads(re.search(r"placeholder such as `({.*})`", text)[1])
    for index in range(6):
        edit_frame(tmp_path, index, light=recommended)
    found = inspect(InfoRequest(capture=tmp_path))
    assert found.faults == []
    assert dict(found.facts)["lights"].startswith("6 placeholders: relit calibrate mirror-ball") and "not seen" not in dict(found.facts)
    with pytest.raises(ManifestError, match="all are the placeholder"):
        check_solvable(Capture.open(tmp_path))
    edit_frame(tmp_path, 3, light={"type": "distant", "direction": [0, 1, 1], "irradiance": [1, 1, 1]})
    assert any("lie in one plane" in fault for fault in inspect(InfoRequest(capture=tmp_path)).faults)


def test_a_rig_in_front_says_what_it_cannot_see(tmp_path):
    write_capture(tmp_path, SCENE)
    for index in range(6):
        turn = np.radians(60 * index)
        edit_frame(tmp_path, index, light={"type": "distant", "direction": [np.cos(turn), np.sin(turn), 0.9], "irradiance": [1, 1, 1]})
    said = dict(inspect(InfoRequest(capture=tmp_path)).facts)["not seen"]
    assert "within 48 degrees" in said and "more than 24 degrees" in said  # atan(1 / 0.9), and half of it
    assert "83 % of all directions" in said  # (1 + cos 48°) / 2
    edit_frame(tmp_path, 2, light={"type": "distant", "direction": [0, 1, -0.1], "irradiance": [1, 1, 1]})
    assert "not seen" not in dict(inspect(InfoRequest(capture=tmp_path)).facts)


def test_negative_values_that_are_clipped_are_counted(tmp_path):
    write_capture(tmp_path, SCENE)
    low = SCENE.images[1].copy()
    low[3, 3:6] = -0.2
    write_exr(tmp_path / "001.exr", low)
    (fault,) = inspect(InfoRequest(capture=tmp_path)).faults
    assert fault.endswith("--clip-negative sets such values to 0")
    found = inspect(InfoRequest(capture=tmp_path, clip_negative=True))
    assert found.faults == [] and "3 pixels of 1 image were" in dict(found.facts)["clipped"]


def findings(folder, recorded, **changes):
    """What is found in a capture of these values, [lights, rows, cols, 3] from 0 to 1, in 16 bits."""
    frames = manifest_of(EXPLAINED)["frames"]
    for index, (frame, values) in enumerate(zip(frames, recorded, strict=True)):
        frame |= {"image": f"{index}.png", "exposure_s": EXPOSURE}
        write_image(folder / frame["image"], np.round(values * 65535).astype(np.uint16))
    write_image(folder / "mask.png", (EXPLAINED.mask * 255).astype(np.uint8))
    write_manifest(folder, {**manifest_of(EXPLAINED), "frames": frames, **changes})
    found = inspect(InfoRequest(capture=folder))
    assert found.faults == []
    return found.findings


@pytest.mark.parametrize(("encode", "declared"), [(lambda values: values, "lin_rec709_scene"), (srgb, "srgb_texture"),
                                                  (lambda values: values ** (1 / 2.2), "g22_rec709_scene")])
def test_a_right_manifest_has_no_finding(tmp_path, encode, declared):
    assert findings(tmp_path, encode(SCALED), color_space=declared) == []


@pytest.mark.parametrize("encode", [srgb, pytest.param(lambda values: values ** (1 / 2.2), marks=pytest.mark.long)], ids=["sRGB", "power"])
def test_encoded_images_that_are_declared_linear_are_named(tmp_path, encode):
    """The curves of sRGB and of a power of 2.2 differ by less than these pixels tell."""
    (finding,) = findings(tmp_path, encode(SCALED))
    assert finding.startswith("color_space: the images look display-encoded, but lin_rec709")
    assert finding.endswith(("declare srgb_texture if they are", "declare g22_rec709_scene if they are"))
def test_other_suspicions_are_named_and_the_command_prints_them_and_ends_well(relit, tmp_path):
    (finding,) = findings(tmp_path, SCALED, color_space="srgb_texture")
    assert "the images look linear, but srgb_texture is declared" in finding
    (finding,) = findings(tmp_path, SCALED[::-1])
    assert finding.startswith("frames[].light: the order looks reversed")
    assert "\nfinding      frames[].light: the order looks reversed" in relit("info", tmp_path).well()


def test_a_dark_image_is_taken_off_first(tmp_path):
    """A pedestal that hides the shadows, in the images and in the dark image."""
    write_exr(tmp_path / "dark.exr", np.full((*EXPLAINED.mask.shape, 3), 0.2))
    assert findings(tmp_path, 0.2 + 0.8 * SCALED, dark="dark.exr") == []


@pytest.mark.parametrize("command", ["info", "solve"])
def test_every_image_is_decoded_once(relit, tmp_path, monkeypatch, command):
    write_capture(tmp_path / "capture", SCENE)
    names, recorded = [], Capture.recorded
    monkeypatch.setattr(Capture, "recorded", lambda self, name, **more: names.append(name) or recorded(self, name, **more))
    relit(command, tmp_path / "capture", *(("--out", tmp_path) if command == "solve" else ()))
    assert sorted(names) == [frame.image for frame in Capture.open(tmp_path / "capture").manifest.frames]
