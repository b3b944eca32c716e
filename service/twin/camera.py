"""The camera of the twin: a picture in a folder for each release, as a tethering program writes it, with noise, and faults on request."""

import re
import threading
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from service.errors import RequestError
from service.requests.play import PictureFault, TwinRequest
from service.twin.listener import Listener
from service.twin.picture import TwinPicture
from stage.colour.colour import convert
from stage.files import replacing
from stage.formats import exr
from stage.formats.images import write_png
from stage.rig.patch import levels_of_universes
from stage.rig.rig import Rig

LATE_S = 2.0
"""The delay of a picture that is late."""
SHIFT_PX = 3
"""The shift of a picture of something that moved."""
BLUR_PX = 2.0
"""The standard deviation of the blur of a picture that is out of focus."""
AMBIENT = 0.2
"""The light that is not the rig's, over that of all lamps at their share of full level."""
OVEREXPOSED = 16.0


class FaultSpan(NamedTuple):
    """The releases at which a fault happens."""

    kind: PictureFault
    first: int
    last: int | None
    """None: no end."""


class TwinCamera:
    """Writes a picture of what the lamps show at each release."""

    def __init__(self, rig: Rig, picture: TwinPicture, listener: Listener, folder: Path, request: TwinRequest) -> None:
        self._rig, self._picture, self._listener, self._folder = rig, picture, listener, folder
        self._gain, self._noise, self._suffix = 2.0**request.exposure, request.noise, f".{request.picture_format}"
        self._spans = fault_spans(request.faults)
        self._random = np.random.default_rng(request.seed)
        self._lock = threading.Lock()
        self._previous: np.ndarray | None = None
        self.released = 0
        """Number of releases."""

    def release(self, exposure_s: float | None) -> None:
        """Write the picture of this moment into the folder; `exposure_s`: the exposure time; None: 1."""
        with self._lock:
            self.released += 1
            faults = {span.kind for span in self._spans if span.first <= self.released <= (span.last or self.released)}
            pixels = self._pixels(faults, exposure_s or 1.0)
            if PictureFault.DOUBLED in faults and self._previous is not None:
                pixels = self._previous
            self._previous = pixels
            path = self._folder / f"IMG_{self.released:04d}{self._suffix}"
        if PictureFault.LATE in faults:
            threading.Timer(LATE_S, self._write, [path, pixels]).start()
        elif PictureFault.DROPPED not in faults:
            self._write(path, pixels)

    def _pixels(self, faults: set[PictureFault], exposure: float) -> np.ndarray:
        """Return the picture, [rows, cols, 3] float32, full scale 1."""
        levels = levels_of_universes(self._rig, dict(self._listener.last.values))
        if PictureFault.DEAD in faults:
            levels = np.zeros_like(levels)
        if PictureFault.WRONG in faults:  # the lamps take each other's places: the next one in the file shines in place of each
            levels = np.roll(levels, len(self._rig.lights[0].primaries))
        pixels = self._picture.radiance(levels)
        if PictureFault.AMBIENT in faults:
            pixels = pixels + AMBIENT * self._picture.radiance(np.full(len(levels), 4 / len(self._rig.lights)))
        if PictureFault.MOVED in faults:
            pixels = np.roll(pixels, SHIFT_PX, axis=1)
        if PictureFault.FOCUS in faults:
            pixels = ndimage.gaussian_filter(pixels, (BLUR_PX, BLUR_PX, 0))
        pixels = pixels * np.float32(self._gain * exposure * (OVEREXPOSED if PictureFault.CLIPPED in faults else 1))
        shot = np.sqrt(np.maximum(pixels, 0) / 4 + 1 / 16)  # shot noise, and a quarter of it in the dark
        return np.clip(pixels + self._noise * shot * self._random.standard_normal(pixels.shape, np.float32), None, 1).astype(np.float32)

    def _write(self, path: Path, pixels: np.ndarray) -> None:
        with replacing(path, flush=False) as temporary:
            if path.suffix == ".exr":
                exr.write(temporary, {name: pixels[..., c] for c, name in enumerate("RGB")}, color_space=self._picture.space, metadata={})
            else:
                encoded = convert(np.maximum(pixels, 0), self._picture.space, "srgb_texture")
                write_png(temporary, np.rint(255 * np.clip(encoded, 0, 1)).astype(np.uint8), srgb=True)


def fault_spans(given: tuple[str, ...]) -> list[FaultSpan]:
    """Return the faults of texts such as dead@17, or ambient@17- from release 17 on.

    Raises:
        RequestError: a text is otherwise.
    """
    found = []
    for text in given:
        match = re.fullmatch(r"(\w+)@(\d+)(-(\d*))?", text)
        if match is None or match[1] not in list(PictureFault):
            raise RequestError(f"--faults {text}: give KIND@RELEASE or KIND@FIRST-LAST, with one of {', '.join(PictureFault)}")
        last = int(match[2]) if match[3] is None else int(match[4]) if match[4] else None
        found.append(FaultSpan(PictureFault(match[1]), int(match[2]), last))
    return found
