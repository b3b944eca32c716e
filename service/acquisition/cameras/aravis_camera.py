"""A machine-vision camera (GenICam: GigE Vision, USB3 Vision) through the library Aravis 0.8, where it is installed.

Aravis is a library of the system (`apt install libaravis-0.8-0`). Its binding for Python is one of the system's Python alone, so the few
functions that are needed are called by ctypes, with the signatures of arvcamera.h and arvbuffer.h.
"""

import ctypes
from contextlib import suppress
from ctypes import POINTER, byref, c_char_p, c_double, c_int, c_size_t, c_uint, c_uint32, c_uint64, c_void_p
from ctypes.util import find_library
from functools import cache
from typing import Any

import cv2
import numpy as np

from service.acquisition.cameras.camera import Camera, NoPictureError, Picture, Setup
from service.errors import RequestError

LIBRARY = "aravis-0.8"
MOSAICS = {"RG": cv2.COLOR_BayerRGGB2RGB, "BG": cv2.COLOR_BayerBGGR2RGB, "GR": cv2.COLOR_BayerGRBG2RGB, "GB": cv2.COLOR_BayerGBRG2RGB}
"""OpenCV's codes for mosaics by the first two colours of their first row, as GenICam names them."""
FORMATS: dict[str, tuple[int, int | None]] = {
    "RGB16": (16, None), **{f"Bayer{row}{bits}": (bits, code) for bits in (16, 12) for row, code in MOSAICS.items()},
    "RGB8": (8, None), "RGB8Packed": (8, None), **{f"Bayer{row}8": (8, code) for row, code in MOSAICS.items()},
    "Mono16": (16, None), "Mono12": (12, None), "Mono8": (8, None)}
"""Pixel formats, the best first: the bits of a reading, and OpenCV's code where it is one of a mosaic."""
AUTOMATIC = ("ExposureAuto", "GainAuto", "BalanceWhiteAuto")
"""Features of GenICam (SFNC) that must be off."""
RECORDED = ("DeviceVendorName", "DeviceModelName", "DeviceSerialNumber", "PixelFormat")
EXPOSURE_PART = 0.02
"""The largest part by which the exposure time that a camera takes may differ from the one that is asked for."""
FULL = 65535


class _Error(ctypes.Structure):
    _fields_ = [("domain", c_uint32), ("code", c_int), ("message", c_char_p)]


class AravisError(Exception):
    """Aravis, or the camera, has refused something; the text is its own."""


class AravisCamera(Camera):
    """One camera, by the name that Aravis gives it."""

    def __init__(self, detail: str, setup: Setup) -> None:
        self._name, self._setup, self._count = f"--camera aravis{':' * bool(detail)}{detail}", setup, 0
        try:
            library = _library()
        except OSError:
            raise RequestError(f"{self._name}: needs the library Aravis, which is not installed: apt install libaravis-0.8-0") from None
        if detail.startswith("Fake"):
            library.arv_enable_interface(b"Fake")
        try:
            self._camera = _call("arv_camera_new", c_void_p, [c_char_p], detail.encode() or None)
        except AravisError as error:
            raise RequestError(f"{self._name}: no camera is found: check the cable, the network and the name ({error})") from error
        try:
            self._fix()
        except AravisError as error:
            self.close()
            raise RequestError(f"{self._name}: {error}") from error
        except BaseException:
            self.close()
            raise

    @property
    def settings(self) -> dict[str, str]:
        """Return the settings that the camera tells; of one that is lost none."""
        found = {}
        with suppress(AravisError):
            found = {name: self._text(name) for name in RECORDED if self._has(name)}
            found["Gain"] = f"{_call('arv_camera_get_gain', c_double, [c_void_p], self._camera):g}"
        time = self.exposure_s
        return found | ({} if time is None else {"ExposureTime": f"{time:g} s"})

    @property
    def exposure_s(self) -> float | None:
        """Return the exposure time of the camera."""
        try:
            return float(_call("arv_camera_get_exposure_time", c_double, [c_void_p], self._camera)) / 1e6
        except AravisError:
            return None

    def take(self, exposure_s: float | None) -> Picture:
        """Take a picture, and write it with 16 bits, in which readings stay proportional to light."""
        pixels = self._frame(exposure_s)
        self._count += 1
        return self._setup.written(self._count, pixels, srgb=False)

    def look(self) -> np.ndarray:
        """Return a picture, encoded for a screen."""
        try:
            return (self._frame(None).astype(np.float32) / FULL) ** np.float32(1 / 2.2)
        except NoPictureError as error:
            raise RequestError(f"{self._name}: {error}") from error

    def close(self) -> None:
        """Let go of the camera."""
        if self._camera:
            _unref(self._camera)
            self._camera = None

    def _fix(self) -> None:
        """Switch automatic modes off, and choose the pixel format with most to tell; or refuse the camera."""
        for feature in AUTOMATIC:
            if self._has(feature) and self._text(feature) != "Off":
                _call("arv_camera_set_string", None, [c_void_p, c_char_p, c_char_p], self._camera, feature.encode(), b"Off")
                if self._text(feature) != "Off":
                    raise RequestError(f"{self._name}: {feature} cannot be switched off")
        count = c_uint()
        names = _call("arv_camera_dup_available_pixel_formats_as_strings", POINTER(c_char_p), [c_void_p, POINTER(c_uint)], self._camera,
                      byref(count))
        offered = [names[index].decode() for index in range(count.value)]
        best = next((name for name in FORMATS if name in offered), None)
        if best is None:
            raise RequestError(f"{self._name}: offers the pixel formats {', '.join(offered)}: one of {', '.join(FORMATS)} is needed")
        _call("arv_camera_set_pixel_format_from_string", None, [c_void_p, c_char_p], self._camera, best.encode())
        self._bits, self._mosaic = FORMATS[best]

    def _frame(self, exposure_s: float | None) -> np.ndarray:
        """Return a picture, [rows, cols, 3] uint16 with all bits used."""
        try:
            if exposure_s is not None:
                _call("arv_camera_set_exposure_time", None, [c_void_p, c_double], self._camera, c_double(1e6 * exposure_s))
                set_to = self.exposure_s or 0.0
                if abs(set_to - exposure_s) > EXPOSURE_PART * exposure_s:
                    raise RequestError(f"exposures_s: {self._name} takes {set_to:g} s for an exposure time of {exposure_s:g} s")
            limit = c_uint64(int(1e6 * (self._setup.timeout_s + (exposure_s or 0.0))))
            buffer = _call("arv_camera_acquisition", c_void_p, [c_void_p, c_uint64], self._camera, limit)
        except AravisError as error:
            raise NoPictureError(str(error)) from error
        if not buffer:
            raise NoPictureError(f"no picture came within {self._setup.timeout_s:g} s")
        try:
            return self._pixels(buffer)
        finally:
            _unref(buffer)

    def _pixels(self, buffer: int) -> np.ndarray:
        library = _library()
        if library.arv_buffer_get_status(buffer) != 0:
            raise NoPictureError("the picture came incomplete: check the network, its packet size and the cable")
        size = c_size_t()
        place = library.arv_buffer_get_data(buffer, byref(size))
        width, height = library.arv_buffer_get_image_width(buffer), library.arv_buffer_get_image_height(buffer)
        kind = np.uint8 if self._bits == 8 else np.uint16
        channels, left = divmod(size.value // np.dtype(kind).itemsize, width * height)
        if channels not in (1, 3) or left:
            raise NoPictureError(f"the picture has {size.value} bytes for {width}x{height} pixels")
        raw = np.frombuffer(ctypes.string_at(place, size.value), dtype=kind).reshape(height, width, channels)
        shown = raw if self._mosaic is None else cv2.cvtColor(np.ascontiguousarray(raw[..., 0]), self._mosaic)
        full = (1 << self._bits) - 1
        return np.ascontiguousarray(np.broadcast_to((shown.astype(np.uint32) * FULL // full).astype(np.uint16), (height, width, 3)))

    def _has(self, feature: str) -> bool:
        return bool(_call("arv_camera_is_feature_available", c_int, [c_void_p, c_char_p], self._camera, feature.encode()))

    def _text(self, feature: str) -> str:
        found = _call("arv_camera_get_string", c_char_p, [c_void_p, c_char_p], self._camera, feature.encode())
        return (found or b"").decode("utf-8", "replace")


@cache
def _library() -> ctypes.CDLL:
    """Return Aravis with the signatures of functions that take no error. Raises OSError if it is not installed."""
    library = ctypes.CDLL(find_library(LIBRARY) or LIBRARY)
    for name in ("arv_buffer_get_status", "arv_buffer_get_image_width", "arv_buffer_get_image_height"):
        getattr(library, name).argtypes = [c_void_p]
    library.arv_buffer_get_data.restype, library.arv_buffer_get_data.argtypes = c_void_p, [c_void_p, POINTER(c_size_t)]
    library.g_object_unref.argtypes = [c_void_p]  # of GObject, which Aravis loads
    return library


def _call(name: str, result: Any, types: list[Any], *arguments: Any) -> Any:
    """Call a function whose last argument takes an error. Raises AravisError with the text of the error."""
    function = getattr(_library(), name)
    function.restype, function.argtypes = result, [*types, POINTER(POINTER(_Error))]
    error = POINTER(_Error)()
    value = function(*arguments, byref(error))
    if error:
        text = error.contents.message.decode("utf-8", "replace")
        raise AravisError(" ".join(text.split()))
    return value


def _unref(thing: int) -> None:
    _library().g_object_unref(thing)


def open_camera(detail: str, setup: Setup) -> AravisCamera:
    """Return the camera of a name, such as that which `arv-tool-0.8` lists, or the first one."""
    return AravisCamera(detail, setup)
