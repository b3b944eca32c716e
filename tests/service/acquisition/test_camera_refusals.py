"""What cameras and boards that are not as they should be make Relit say, by stand-ins for packages, libraries and devices."""

import os
import re
import shutil
import tty
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import ClassVar

import cv2
import numpy as np
import pytest

from service.acquisition.acquire import acquire, refuse_to_ask
from service.acquisition.cameras import aravis_camera
from service.acquisition.cameras.aravis_camera import AravisError
from service.acquisition.cameras.camera import Setup, open_camera
from service.errors import RequestError
from tests.scenes.dng import write_dng
from tests.service.acquisition.test_acquire import LAMPS, Stage, by_hand, check, request, write_rig


@pytest.fixture
def setup(tmp_path):
    """What a camera is told when it is opened."""
    return Setup(tmp_path / "spool", 1.0, (), None)


class Reflex:
    """Stands in for gphoto2.Camera: its settings with their choices, and the error with which it does not open."""

    ports: tuple[tuple[str, str], ...] = (("Reflex", "usb:001,004"),)
    error: int | None = None
    fixed = False
    values: ClassVar[dict[str, str]] = {}
    choices: ClassVar[dict[str, list[str]]] = {}
    package: ModuleType

    @classmethod
    def autodetect(cls):
        return SimpleNamespace(count=lambda: len(cls.ports), get_name=lambda index: cls.ports[index][0],
                               get_value=lambda index: cls.ports[index][1])

    def init(self) -> None:
        if self.error is not None:
            raise self.package.GPhoto2Error(self.error)

    def exit(self) -> None:
        """Do nothing."""

    def get_single_config(self, name: str):
        if name not in self.values:
            raise self.package.GPhoto2Error(self.package.GP_ERROR_BAD_PARAMETERS)
        choices = self.choices.get(name, [])
        return SimpleNamespace(get_value=lambda: self.values[name], count_choices=lambda: len(choices), get_choice=choices.__getitem__,
                               set_value=lambda value: self.fixed or self.values.__setitem__(name, value))

    def set_single_config(self, name: str, widget: object) -> None:
        """Do nothing: the value is set already."""


@pytest.fixture
def reflex(monkeypatch):
    """A stand-in for the class of cameras of the package gphoto2, to be changed by the test."""
    package = pytest.importorskip("gphoto2")
    found = type("Camera", (Reflex,), {"values": {}, "choices": {}, "package": package})
    monkeypatch.setattr(package, "Camera", found)
    return found


@pytest.mark.parametrize(("error", "words"), [
    ("GP_ERROR_MODEL_NOT_FOUND", "no camera is found: switch it on, and check the cable"),
    ("GP_ERROR_IO_USB_CLAIM", "another program uses the camera: end it"),
    ("GP_ERROR_IO_LOCK", "another program uses the camera: end it"),
    ("GP_ERROR_NO_MEMORY", "the card of the camera is full: empty it"),
    ("GP_ERROR_IO_INIT", "the USB device may not be opened: give your user the right to use it"),
    ("GP_ERROR_CAMERA_BUSY", "the camera is busy: wait until it has stored its pictures"),
    ("GP_ERROR_IO", "the camera does not answer: check the cable and the battery")])
def test_a_camera_at_usb_that_does_not_open(setup, reflex, error, words):
    reflex.error = getattr(reflex.package, error)
    with pytest.raises(RequestError, match=f"^--camera gphoto2: {words}") as refused:
        open_camera("gphoto2", setup)
    assert "\n" not in str(refused.value)


def test_of_several_cameras_one_must_be_named(setup, reflex):
    reflex.ports = (("Reflex", "usb:001,004"), ("Other", "usb:001,007"))
    with pytest.raises(RequestError, match=r"usb:001,004 \(Reflex\) or gphoto2:usb:001,007 \(Other\)$"):
        open_camera("gphoto2", setup)


@pytest.mark.parametrize(("name", "value", "words"), [
    ("expprogram", "A", "the exposure is automatic (expprogram is A): turn the camera to manual, M"),
    ("iso", "Auto", "iso is Auto: set it to a fixed value on the camera"),
    ("whitebalance", "Automatic", "whitebalance is Automatic: set it to a fixed value on the camera")])
def test_a_camera_at_usb_in_an_automatic_mode_is_refused(setup, reflex, name, value, words):
    reflex.values = {"expprogram": "M", "iso": "100", name: value}
    with pytest.raises(RequestError) as refused:
        open_camera("gphoto2", setup)
    assert str(refused.value) == f"--camera gphoto2: {words}"


def test_an_exposure_mode_that_can_be_set_is_set(setup, reflex):
    reflex.values, reflex.choices = {"expprogram": "A", "iso": "100"}, {"expprogram": ["A", "M"]}
    assert open_camera("gphoto2", setup).settings == {"iso": "100", "expprogram": "M"}


def test_automatic_sensitivity_is_switched_off_or_the_camera_is_refused(setup, reflex):
    reflex.values, reflex.choices = {"iso": "100", "autoiso": "On"}, {"autoiso": ["On", "Off"]}
    assert open_camera("gphoto2", setup).settings == {"iso": "100", "autoiso": "Off"}
    reflex.values["autoiso"], reflex.fixed = "On", True
    with pytest.raises(RequestError, match=r"^--camera gphoto2: .* automatic \(autoiso is On\)"):
        open_camera("gphoto2", setup)


@pytest.mark.parametrize(("name", "before", "choices", "after"), [
    ("imageformat", "Large Fine JPEG", ["Large Fine JPEG", "RAW + Large Fine JPEG", "cRAW", "RAW"], "RAW"),
    ("imagequality", "NEF+Fine", ["JPEG Fine", "NEF (Raw)", "NEF+Fine"], "NEF (Raw)"),
    ("imagequality", "Fine", ["Fine", "Standard"], "Fine")])
def test_raw_files_are_taken_where_a_camera_offers_them(setup, reflex, name, before, choices, after):
    reflex.values, reflex.choices = {name: before}, {name: choices}
    assert open_camera("gphoto2", setup._replace(jpeg=True)).settings == {name: before}
    assert open_camera("gphoto2", setup).settings == {name: after}
    reflex.values, reflex.fixed = {name: before}, True
    if after != before:
        with pytest.raises(RequestError, match=re.escape(f"{name} is {before} and does not become {after}: set it on the camera, or give")):
            open_camera("gphoto2", setup)


def test_a_raw_file_over_the_cable_is_read_as_light(setup, reflex, tmp_path, monkeypatch):
    pytest.importorskip("rawpy")
    write_dng(tmp_path / "sensor.dng", np.full((40, 60), 7756, np.uint16), black=(512,) * 4, white=15000)
    file = reflex.package.CameraFile()
    file.set_data_and_size((tmp_path / "sensor.dng").read_bytes())
    monkeypatch.setattr(reflex, "capture", lambda self, kind: SimpleNamespace(folder="/", name="DSC_0001.DNG"), raising=False)
    monkeypatch.setattr(reflex, "file_get", lambda self, *place: file, raising=False)
    picture = open_camera("gphoto2", setup).take(None)
    assert picture.pixels.shape == (40, 60, 3) and np.allclose(picture.pixels, 0.5, atol=1e-3)  # (7756 - 512) / (15000 - 512)


def test_a_preview_over_the_cable_is_a_picture(setup, reflex):
    file = reflex.package.CameraFile()
    file.set_data_and_size(cv2.imencode(".jpg", np.full((24, 32, 3), (50, 100, 200), np.uint8))[1].tobytes())
    reflex.capture_preview = lambda self: file
    pixels = open_camera("gphoto2", setup).look()
    assert pixels.shape == (24, 32, 3) and pixels.dtype == np.float32
    assert 255 * pixels.mean(axis=(0, 1)) == pytest.approx([200, 100, 50], abs=4)  # JPEG; OpenCV's order is blue first


class Machine:
    """Stands in for the library Aravis: features with their values, of which some cannot be set, and whether the camera is lost."""

    def __init__(self) -> None:
        self.values = {"ExposureAuto": "Off", "GainAuto": "Off", "DeviceModelName": "M", "DeviceSerialNumber": "7", "PixelFormat": "Mono8"}
        self.fixed: tuple[str, ...] = ()
        self.lost = False

    def call(self, name: str, result: object, types: object, camera: object, *arguments):
        if self.lost:
            raise AravisError("Timeout while reading a register")
        feature = arguments[0].decode() if arguments and isinstance(arguments[0], bytes) else ""
        if name == "arv_camera_set_string" and feature not in self.fixed:
            self.values[feature] = arguments[1].decode()
        if name == "arv_camera_dup_available_pixel_formats_as_strings":
            arguments[0]._obj.value = 1
            return [b"Mono8"]
        return {"arv_camera_new": 1, "arv_camera_is_feature_available": feature in self.values, "arv_camera_get_gain": 2.0,
                "arv_camera_get_string": self.values.get(feature, "").encode(), "arv_camera_get_exposure_time": 1e4}.get(name)


@pytest.fixture
def machine(monkeypatch):
    """The stand-in for the library Aravis, to be changed by the test."""
    found = Machine()
    monkeypatch.setattr(aravis_camera, "_library", lambda: SimpleNamespace(g_object_unref=lambda thing: None))
    monkeypatch.setattr(aravis_camera, "_call", found.call)
    return found


def test_automatic_modes_of_a_machine_vision_camera_are_switched_off_or_it_is_refused(setup, machine):
    machine.values["GainAuto"] = "Continuous"
    camera = open_camera("aravis:M", setup)
    assert machine.values["GainAuto"] == "Off"
    assert camera.settings == {"DeviceModelName": "M", "DeviceSerialNumber": "7", "PixelFormat": "Mono8", "Gain": "2",
                               "ExposureTime": "0.01 s"}
    machine.values["ExposureAuto"], machine.fixed = "Continuous", ("ExposureAuto",)
    with pytest.raises(RequestError, match=r"^--camera aravis:M: ExposureAuto cannot be switched off$"):
        open_camera("aravis:M", setup)


def test_a_machine_vision_camera_that_is_lost_tells_no_settings_and_the_cause_is_told(tmp_path, setup, machine, monkeypatch):
    """The settings are asked for at the end of each capture, also of one that the camera's loss has ended."""
    camera = open_camera("aravis:M", setup)
    machine.lost = True
    assert camera.settings == {} and camera.exposure_s is None
    stage = Stage(tmp_path / "watch")
    machine.lost = False

    def lost(camera, exposure):
        machine.lost = True
        raise RequestError("the camera is gone")
    monkeypatch.setattr(aravis_camera.AravisCamera, "take", lost)
    with pytest.raises(RequestError, match=r"^the camera is gone$"):
        acquire(request(tmp_path, stage, write_rig(tmp_path / "rig.json", stage, "manual"), camera="aravis:M"), lambda what: None)


@pytest.mark.parametrize(("system", "automatic", "manual"), [("V4L2", 3.0, 1.0), ("V4L2", 0.0, 1.0), ("DSHOW", 1.0, 0.0)])
def test_automatic_modes_of_a_video_device_are_switched_off_or_it_is_refused(setup, monkeypatch, system, automatic, manual):
    values = {cv2.CAP_PROP_AUTOFOCUS: 1.0, cv2.CAP_PROP_AUTO_WB: 1.0, cv2.CAP_PROP_AUTO_EXPOSURE: automatic}
    fixed = set()

    class Device:
        def __init__(self, number: int) -> None:
            assert number == 0

        def isOpened(self) -> bool:
            return True

        def getBackendName(self) -> str:
            return system

        def get(self, number: int) -> float:
            return values.get(number, -1.0)

        def set(self, number: int, value: float) -> bool:
            if number not in fixed:
                values[number] = value
            return number not in fixed

        def release(self) -> None:
            """Do nothing."""

    monkeypatch.setattr(cv2, "VideoCapture", Device)
    open_camera("video:0", setup)
    assert list(values.values()) == [0.0, 0.0, manual]
    for number, word in ((cv2.CAP_PROP_AUTO_WB, "white balance"), (cv2.CAP_PROP_AUTO_EXPOSURE, "exposure")):
        before, values[number], fixed = values[number], automatic if word == "exposure" else 1.0, {number}
        with pytest.raises(RequestError, match=f"^--camera video:0: the {word} is automatic and cannot be switched off$"):
            open_camera("video:0", setup)
        values[number] = before


def test_what_is_not_there_is_named_as_it_was_given_and_leaves_no_folder(tmp_path, setup):
    for camera, words in (("video:Lost.mp4", "Lost.mp4: cannot be opened"), ("gphoto2", "camera gphoto2: ")):
        with pytest.raises(RequestError, match=words):
            open_camera(camera, setup)
    assert not setup.spool.exists()
    stage = Stage(tmp_path / "watch")
    rig = write_rig(tmp_path / "rig.json", stage, "serial", {"serial": {"port": "/dev/ttyLost", "on": "on {index}\n", "off": "off\n"}})
    with pytest.raises(RequestError, match="/dev/ttyLost: cannot be opened: no such file or directory: check"):
        acquire(request(tmp_path, stage, rig), refuse_to_ask)


def test_a_trigger_that_fails_without_a_word_says_its_exit_code(tmp_path):
    (tmp_path / "watch").mkdir()
    with pytest.raises(RequestError, match=r"^--trigger false: failed: exit code 1$"):
        open_camera(f"watch:{tmp_path / 'watch'}", Setup(tmp_path / "spool", 1.0, ("false",), None)).take(None)


def test_a_serial_board_that_never_answers(tmp_path):
    host, board = os.openpty()
    tty.setraw(board)
    stage = Stage(tmp_path / "watch")
    serial = {"port": os.ttyname(board), "on": "on {index}\n", "off": "off\n", "acknowledge": "^ok", "ready_s": 0, "timeout_s": 0.1}
    rig = write_rig(tmp_path / "rig.json", stage, "serial", {"serial": serial})
    with pytest.raises(RequestError, match=r"no answer to 'off' within 0.1 s: .* controllers.serial.baud$"):
        acquire(request(tmp_path, stage, rig), refuse_to_ask)
    os.close(host)
    os.close(board)


def test_a_camera_at_usb_that_is_lost_while_it_takes_pictures_goes_on_when_it_is_there_again(tmp_path, reflex):
    """Its cable is pulled at the fourth release; then the same command takes what is missing, and one picture for comparison."""
    stage, package = Stage(tmp_path / "watch"), reflex.package

    def capture(camera, kind):
        if stage.released == 3 and reflex.error is None:
            reflex.error = package.GP_ERROR_IO
        if reflex.error is not None:
            raise package.GPhoto2Error(reflex.error)
        stage.release()
        return SimpleNamespace(folder=str(stage.folder), name=f"IMG_{stage.released:04d}.exr")

    def silence(camera, wait_ms):
        return package.GP_EVENT_TIMEOUT, None
    reflex.capture, reflex.wait_for_event = capture, silence
    reflex.file_get = lambda camera, folder, name, kind: SimpleNamespace(save=lambda path: shutil.copyfile(Path(folder) / name, path))
    rig, ask = by_hand(tmp_path, stage)
    given = request(tmp_path, stage, rig, camera="gphoto2")
    with pytest.raises(RequestError, match="the camera does not answer: check the cable"):
        acquire(given, ask)
    with pytest.raises(RequestError, match="the camera does not answer: check the cable"):
        acquire(given, ask)
    reflex.error, reflex.capture = None, lambda camera, kind: (stage.release(), SimpleNamespace(
        folder=str(stage.folder), name=f"IMG_{stage.released:04d}.exr"))[1]
    result = acquire(given, ask)
    assert (result.taken, result.there, result.faults) == (LAMPS + 1 - 3, LAMPS + 1, ())
    assert stage.released == LAMPS + 1 + 1
    check(tmp_path / "capture", stage)
