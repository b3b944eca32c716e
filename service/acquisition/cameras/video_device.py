"""A video device (UVC, V4L2), or a video file in its place, through OpenCV."""

import cv2
import numpy as np

from service.acquisition.cameras.camera import Camera, NoPictureError, Picture, Setup
from service.errors import RequestError

STALE_FRAMES = 4
"""The frames that a device keeps in its buffers, which were taken before the lamps changed."""
AUTOMATIC = {"autofocus": cv2.CAP_PROP_AUTOFOCUS, "white balance": cv2.CAP_PROP_AUTO_WB, "exposure": cv2.CAP_PROP_AUTO_EXPOSURE}
"""What a device may set by itself."""
EXPOSED_BY_HAND = {"V4L2": 1.0}
"""The value of the exposure mode that means manual, by OpenCV's name of the system; 0 in all others. Linux has 0 for automatic
(V4L2_CID_EXPOSURE_AUTO)."""
RECORDED = {"width": cv2.CAP_PROP_FRAME_WIDTH, "height": cv2.CAP_PROP_FRAME_HEIGHT, "exposure": cv2.CAP_PROP_EXPOSURE,
            "gain": cv2.CAP_PROP_GAIN, "white_balance": cv2.CAP_PROP_WB_TEMPERATURE, "focus": cv2.CAP_PROP_FOCUS}


class VideoDevice(Camera):
    """Takes the frame of a video that comes next after a release."""

    def __init__(self, detail: str, setup: Setup) -> None:
        self._name, self._setup, self._count = f"--camera video:{detail}", setup, 0
        self._live = detail.isdigit()
        self._video = cv2.VideoCapture(int(detail) if self._live else detail)
        if not self._video.isOpened():
            raise RequestError(f"{self._name}: cannot be opened: check that it is there, or connected, and that no other program uses it")
        if self._live:
            self._fix()

    @property
    def settings(self) -> dict[str, str]:
        """Return the settings that the device tells."""
        found = {name: self._video.get(number) for name, number in RECORDED.items()}
        return {name: f"{value:g}" for name, value in found.items() if value not in (-1.0, 0.0)}

    def take(self, exposure_s: float | None) -> Picture:
        """Take the next frame."""
        if exposure_s is not None:
            raise RequestError(f"exposures_s: {self._name} has exposure times without a unit: set the exposure on the device")
        for _ in range(STALE_FRAMES if self._live else 0):
            self._video.grab()
        there, frame = self._video.read()
        if not there or frame is None:
            raise NoPictureError("the video has no further frame")
        self._count += 1
        return self._setup.written(self._count, np.ascontiguousarray(frame[..., ::-1]), srgb=True)

    def look(self) -> np.ndarray:
        """Return the next frame; a file begins again after its last one."""
        there, frame = self._video.read()
        if not there and not self._live:
            self._video.set(cv2.CAP_PROP_POS_FRAMES, 0)
            there, frame = self._video.read()
        if not there or frame is None:
            raise RequestError(f"{self._name}: gives no frames any more: check that it is connected")
        return np.ascontiguousarray(frame[..., ::-1], np.float32) / 255

    def close(self) -> None:
        """Let go of the device."""
        self._video.release()

    def _fix(self) -> None:
        """Switch automatic modes off, or refuse the device."""
        for name, number in AUTOMATIC.items():
            off = EXPOSED_BY_HAND.get(self._video.getBackendName(), 0.0) if name == "exposure" else 0.0
            if self._video.get(number) in (-1.0, off):  # the device has no such mode, or it is off
                continue
            if not (self._video.set(number, off) and self._video.get(number) == off):
                self.close()
                raise RequestError(f"{self._name}: the {name} is automatic and cannot be switched off")


def open_camera(detail: str, setup: Setup) -> VideoDevice:
    """Return the device of a number, or a video file."""
    if not detail:
        raise RequestError("--camera video: give the number of the device, as in video:0, or a file")
    return VideoDevice(detail, setup)
