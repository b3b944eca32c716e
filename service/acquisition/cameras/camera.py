"""The interface that every camera has, and how one is named on the command line."""

import shlex
from abc import ABC, abstractmethod
from importlib import import_module
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np

from service.errors import RequestError
from service.requests.acquire import AcquireRequest
from stage.files import replacing
from stage.formats import images

KINDS = {"watch": "watched_folder", "gphoto2": "gphoto2_camera", "video": "video_device", "aravis": "aravis_camera"}
"""The module of each kind of camera, KIND or KIND:DETAIL. A new one is a module with a function `open_camera(detail, setup)`, and an entry
here."""
SPOOL = ".spool"
"""The folder, in that of the capture, of files that are not of the capture yet."""
LIVE = ("gphoto2", "video", "aravis")
"""The kinds of cameras that show what they see before a picture is taken."""


class NoPictureError(Exception):
    """No picture came in time."""


class Picture(NamedTuple):
    """A picture that a camera took."""

    path: Path
    """The file, which stays where it is."""
    pixels: np.ndarray
    """[rows, cols, 3] float32 or float16, the recorded values: integers as fractions of full scale."""


class Setup(NamedTuple):
    """The settings that a camera is opened with."""

    spool: Path
    """A folder for the files of cameras that do not write them into one themselves."""
    timeout_s: float
    """The longest time from the release to the whole file, beside the exposure."""
    trigger: tuple[str, ...]
    """The program that releases a camera whose folder is watched, with its arguments; empty: a person or another program does."""
    known: frozenset[str] | None
    """The names of files of a watched folder that were there before the capture began, or belong to its pictures; None: all that are
    there."""
    jpeg: bool = False
    """Whether a camera that offers raw files is left at the format that it has."""

    @classmethod
    def of(cls, request: AcquireRequest, known: frozenset[str] | None) -> Self:
        """Return what the options of a capture say."""
        return cls(request.out / SPOOL, request.timeout, tuple(shlex.split(request.trigger or "")), known, request.jpeg)

    def written(self, number: int, pixels: np.ndarray, *, srgb: bool) -> Picture:
        """Write pixels [rows, cols, 3] of a camera that has no files as one of the spool, and return them as they are read from it."""
        path = self.spool / f"frame_{number:06d}.png"
        with replacing(path, flush=False) as temporary:
            images.write_png(temporary, pixels, srgb=srgb)
        return Picture(path, images.read_pixels(path))


class Camera(ABC):
    """A camera that takes one picture after another; all its settings stay as they are but the exposure time."""

    @property
    def settings(self) -> dict[str, str]:
        """Return the settings that decide what a picture looks like, by name; those that cannot be read are left out."""
        return {}

    @property
    def exposure_s(self) -> float | None:
        """Return the exposure time; None where the camera does not tell it or cannot be set to another."""
        return None

    @property
    def exposures_s(self) -> tuple[float, ...]:
        """Return the exposure times to which the camera can be set; none where it has any, or does not tell them."""
        return ()

    def present(self) -> list[str]:
        """Return the names of the files that are known: those that were there when the camera was opened, or were told then."""
        return []

    @abstractmethod
    def take(self, exposure_s: float | None) -> Picture:
        """Take a picture and wait for it.
        `exposure_s`: the exposure time; None: the one that the camera has. Raises NoPictureError if no picture came in time. Raises
        RequestError if the camera does not answer, or cannot be set to the exposure."""

    @abstractmethod
    def look(self) -> np.ndarray:
        """Return what the camera sees now, [rows, cols, 3] float32, 0 to 1, encoded for a screen.
        Raises RequestError if it has no live view, or does not answer."""

    def unasked(self) -> list[Path]:
        """Return the pictures that came without being asked for since the last one, as late ones do; they are not told again."""
        return []

    def close(self) -> None:  # noqa: B027 - a folder has nothing to let go of
        """Let go of the camera."""


def open_camera(given: str, setup: Setup) -> Camera:
    """Return the camera that a text names, such as watch:/mnt/tether/*.jpg.
    Raises RequestError if there is no such kind of camera, a package or the camera is missing, or it is in an automatic mode."""
    kind, _, detail = given.partition(":")
    if kind not in KINDS:
        raise RequestError(f"--camera {given}: there is no kind of camera {kind}: give one of {', '.join(KINDS)}")
    try:
        adapter = import_module(f"service.acquisition.cameras.{KINDS[kind]}")
    except ModuleNotFoundError as error:
        raise RequestError(f"--camera {given}: needs the package {error.name}, which is not installed: pip install 'relit[set]'") from error
    camera: Camera = adapter.open_camera(detail, setup)
    return camera
