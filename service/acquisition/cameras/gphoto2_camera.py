"""A camera that is driven over USB by libgphoto2, through the package gphoto2: most cameras with interchangeable lenses."""

import re
from contextlib import suppress
from pathlib import Path
from typing import Any

import gphoto2 as gp
import numpy as np

from service.acquisition.cameras.camera import Camera, NoPictureError, Picture, Setup
from service.errors import RequestError
from stage.files import replacing
from stage.formats import images

RECORDED = ("cameramodel", "serialnumber", "shutterspeed", "f-number", "aperture", "iso", "whitebalance", "imageformat", "imagequality",
            "imagesize", "expprogram", "autoexposuremode", "autoiso", "isoauto", "focusmode")
"""The settings that decide what a picture looks like, under the names that makers give them in libgphoto2."""
MANUAL = "the exposure is automatic ({}): turn the camera to manual, M"
OFF = "the sensitivity is automatic ({}): switch that off on the camera"
BY_HAND = {"expprogram": (("m", "manual"), MANUAL), "autoexposuremode": (("m", "manual"), MANUAL),
           "autoiso": (("off",), OFF), "isoauto": (("off",), OFF)}
"""The settings that make a camera automatic, their values without that, and what to say where it cannot be switched off."""
FORMATS = ("imageformat", "imagequality")
"""The settings of the format of pictures; makers use one or the other."""
NEVER_AUTOMATIC = ("iso", "whitebalance", "shutterspeed")
"""The settings that must not be automatic."""
EXPOSURE_PART = 0.1
"""The largest part by which a camera's exposure time may differ from the one that is asked for: cameras round thirds of a stop."""
REASONS = {
    gp.GP_ERROR_MODEL_NOT_FOUND: "no camera is found: switch it on, and check the cable",
    gp.GP_ERROR_IO_USB_FIND: "no camera is found: switch it on, and check the cable",
    gp.GP_ERROR_IO_USB_CLAIM: "another program uses the camera: end it, or the system's service that mounts cameras",
    gp.GP_ERROR_IO_LOCK: "another program uses the camera: end it",
    gp.GP_ERROR_IO_INIT: "the USB device may not be opened: give your user the right to use it (udev rules of libgphoto2)",
    gp.GP_ERROR_NOT_SUPPORTED: "libgphoto2 does not know how this camera does that",
    gp.GP_ERROR_NO_SPACE: "the card of the camera is full: empty it",
    gp.GP_ERROR_NO_MEMORY: "the card of the camera is full: empty it",  # which cameras that speak PTP say
    gp.GP_ERROR_CAMERA_BUSY: "the camera is busy: wait until it has stored its pictures",
    gp.GP_ERROR_TIMEOUT: "the camera does not answer: check the cable and the battery",
    gp.GP_ERROR_IO: "the camera does not answer: check the cable and the battery",
}


class Gphoto2Camera(Camera):
    """One camera at a USB port."""

    def __init__(self, detail: str, setup: Setup) -> None:
        self._setup, self._name = setup, f"--camera gphoto2{':' * bool(detail)}{detail}"
        self._last = ""
        try:
            found = gp.Camera.autodetect()
            ports = [(found.get_name(index), found.get_value(index)) for index in range(found.count())]
            if not detail and len(ports) > 1:
                raise RequestError(f"{self._name}: there are several cameras: name one, " + " or ".join(
                    f"gphoto2:{port} ({model})" for model, port in ports))
            self._camera = gp.Camera()
            if detail:
                known = gp.PortInfoList()
                known.load()
                self._camera.set_port_info(known[known.lookup_path(detail)])
            self._camera.init()
        except gp.GPhoto2Error as error:
            raise self._refused(error) from error
        try:
            self._fix()
        except BaseException:
            self.close()
            raise

    @property
    def settings(self) -> dict[str, str]:
        """Return the settings that the camera tells."""
        return {name: value for name in RECORDED if (value := self._value(name)) is not None}

    @property
    def exposure_s(self) -> float | None:
        """Return the exposure time that the camera tells; None for bulb."""
        told = self._value("shutterspeed")
        return None if told is None else seconds_of(told)

    @property
    def exposures_s(self) -> tuple[float, ...]:
        """Return the exposure times that the camera offers."""
        return tuple(self._times().values())

    def take(self, exposure_s: float | None) -> Picture:
        """Release the camera, and fetch the picture."""
        if exposure_s is not None:
            self._expose(exposure_s)
        try:
            place = self._camera.capture(gp.GP_CAPTURE_IMAGE)
            file = self._camera.file_get(place.folder, place.name, gp.GP_FILE_TYPE_NORMAL)
            path = self._setup.spool / place.name
            with replacing(path, flush=False) as temporary:
                file.save(str(temporary))
        except gp.GPhoto2Error as error:
            if error.code in (gp.GP_ERROR_TIMEOUT, gp.GP_ERROR):  # no picture was made, as when the focus is not found
                raise NoPictureError(f"the camera made no picture: {error.string.lower()}") from error
            raise self._refused(error) from error
        self._last = Path(place.name).stem
        return Picture(path, images.read_pixels(path))

    def look(self) -> np.ndarray:
        """Return a picture of the camera's live view."""
        path = self._setup.spool / "look.jpg"
        try:
            with replacing(path, flush=False) as temporary:
                self._camera.capture_preview().save(str(temporary))
        except gp.GPhoto2Error as error:
            raise self._refused(error) from error
        return images.read_pixels(path).astype(np.float32)

    def unasked(self) -> list[Path]:
        """Return the pictures that the camera has made by itself; the second file of a picture, raw and JPEG, is none."""
        found = []
        with suppress(gp.GPhoto2Error):
            while True:
                kind, data = self._camera.wait_for_event(1)
                if kind == gp.GP_EVENT_TIMEOUT:
                    break
                if kind == gp.GP_EVENT_FILE_ADDED and Path(data.name).stem != self._last:
                    path = self._setup.spool / data.name
                    with replacing(path, flush=False) as temporary:
                        self._camera.file_get(data.folder, data.name, gp.GP_FILE_TYPE_NORMAL).save(str(temporary))
                    found.append(path)
        return found

    def close(self) -> None:
        """Let go of the camera."""
        with suppress(gp.GPhoto2Error):
            self._camera.exit()

    def _fix(self) -> None:
        """Switch automatic modes off and raw files on, or refuse the camera."""
        for name, (values, words) in BY_HAND.items():
            value = self._value(name)
            if value is not None and value.lower() not in values and not self._set(name, values):
                raise RequestError(f"{self._name}: {words.format(f'{name} is {value}')}")
        for name in NEVER_AUTOMATIC:
            value = self._value(name)
            if value is not None and "auto" in value.lower():
                raise RequestError(f"{self._name}: {name} is {value}: set it to a fixed value on the camera")
        for name in () if self._setup.jpeg else FORMATS:
            value, raw = self._value(name), [choice for choice in self._choices(name) if is_raw(choice)]
            if raw and value not in raw and not self._set(name, (raw[0].lower(),)):
                raise RequestError(f"{self._name}: {name} is {value} and does not become {raw[0]}: set it on the camera, or give --jpeg")

    def _value(self, name: str) -> str | None:
        try:
            return str(self._camera.get_single_config(name).get_value())
        except gp.GPhoto2Error:
            return None

    def _choices(self, name: str) -> list[str]:
        try:
            widget = self._camera.get_single_config(name)
            return [widget.get_choice(index) for index in range(widget.count_choices())]
        except gp.GPhoto2Error:
            return []

    def _set(self, name: str, values: tuple[str, ...]) -> bool:
        """Set a setting to the first of its choices that is one of some values, and return whether the camera has taken it."""
        choice = next((choice for choice in self._choices(name) if choice.lower() in values), None)
        if choice is None:
            return False
        try:
            widget: Any = self._camera.get_single_config(name)
            widget.set_value(choice)
            self._camera.set_single_config(name, widget)
        except gp.GPhoto2Error:
            return False
        return self._value(name) == choice

    def _times(self) -> dict[str, float]:
        return {choice: seconds for choice in self._choices("shutterspeed") if (seconds := seconds_of(choice)) is not None}

    def _expose(self, exposure_s: float) -> None:
        times = self._times()
        nearest = min(times, key=lambda choice: abs(np.log(times[choice] / exposure_s)), default=None)
        if nearest is None or abs(times[nearest] / exposure_s - 1) > EXPOSURE_PART:
            raise RequestError(f"exposures_s: {self._name} has no exposure time of {exposure_s:g} s" +
                               ("" if nearest is None else f": the nearest is {nearest}"))
        if self._value("shutterspeed") != nearest and not self._set("shutterspeed", (nearest.lower(),)):
            raise RequestError(f"exposures_s: {self._name} does not take the exposure time {nearest}")

    def _refused(self, error: gp.GPhoto2Error) -> RequestError:
        return RequestError(f"{self._name}: {REASONS.get(error.code, error.string.lower())}")


def is_raw(format_name: str) -> bool:
    """Return whether a format, as makers name it in libgphoto2, is raw of full size without a JPEG beside it: RAW, NEF (Raw)."""
    return re.fullmatch(r"(?:uncompressed |lossless compressed |lossless )?raw|nef \(raw\)", format_name.lower()) is not None


def seconds_of(text: str) -> float | None:
    """Return the seconds of an exposure time as cameras write it: 1/60, 0.0100s, 30, 2.5; None for bulb and the like."""
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)(?:/(\d+(?:\.\d+)?))?\s*(?:s|\")?\s*", text)
    if match is None or float(match[1]) == 0 or (match[2] is not None and float(match[2]) == 0):
        return None
    return float(match[1]) / float(match[2] or 1)


def open_camera(detail: str, setup: Setup) -> Gphoto2Camera:
    """Return the camera at a port such as usb:001,004, or the only one."""
    return Gphoto2Camera(detail, setup)
