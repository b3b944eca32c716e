"""The camera of the twin: a picture in a folder for each release, as a tethering program writes it, with noise, and faults on request; or
one picture that is always that of this moment, which libgphoto2's virtual camera takes."""

import re
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from kernels import device as devices
from kernels.images import ImagesOnDevice
from service.errors import RequestError
from service.relight.combine import linear_frames
from service.relight.sheet import display, fit
from service.relight.weights.weighting import light_weights
from service.reporting.progress import Timings
from service.reporting.provenance import colour_configuration
from service.requests.play import PictureFault, PictureFormat, TwinRequest
from service.twin.listener import Listener
from stage.capture.capture import Capture
from stage.capture.lighting import lights_from_centre
from stage.colour.colour import convert, rgb_matrix
from stage.colour.colour_spaces import linear_space
from stage.errors import listed, storage
from stage.files import replacing
from stage.formats import exr
from stage.formats.images import write_jpeg, write_png
from stage.rig.patch import levels_of_universes
from stage.rig.rig import Rig
from stage.stack.brackets import merge_brackets
from stage.stack.ingest import open_stack

FAR_DEGREES = 2.0
"""A lamp that stands farther than this from every captured light is named."""
LATE_S = 2.0
"""The delay of a picture that is late."""
SHIFT_PX = 3
"""The shift of a picture of something that moved."""
BLUR_PX = 2.0
"""The standard deviation of the blur of a picture that is out of focus."""
AMBIENT = 0.2
"""The light that is not the rig's, over that of all lamps at their share of full level."""
OVEREXPOSED = 16.0
NOT_ON_A_CARD = (PictureFault.DROPPED, PictureFault.LATE)
"""Faults of releases, of which the card sees none."""
CARD_FILE = "TWIN.JPG"
CARD_QUALITY = 98
CARD_POLL_S = 0.5
"""The longest time after which a card whose twin has ended is not written any more."""
CARD_HEADER_BYTES = 4096
"""The room for tables of a JPEG, beside three bytes for each pixel."""


class TwinPicture:
    """Pictures of a capture under the lamps of a rig; each lamp lights as the captured light does that stands nearest to it."""

    def __init__(self, rig: Rig, request: TwinRequest, timings: Timings) -> None:
        """Read the images of the capture. Raises StageError for bad input; it names file and field."""
        timings.stage("open", 1)
        device = devices.resolve(request.device)
        capture = Capture.open(request.capture, request.pixels)
        lights = lights_from_centre(capture)
        timings.stage("ingest", len(capture.sources()))
        stack = merge_brackets(open_stack(capture, cache=request.cache, progress=lambda done, _: timings.advance(done)),
                               capture.sources(), lights)
        self._images = ImagesOnDevice(stack, device)
        self._size = capture.camera.height, capture.camera.width
        self.space = linear_space(capture.manifest.color_space)
        self._gain, self._review = np.float32(2.0**request.exposure), request.review
        self._captured = lights.irradiance
        lamps = np.array([index for index, _ in rig.emitters])
        cosine = rig.directions @ lights.direction.T
        self._light = cosine.argmax(axis=1)[lamps]  # [emitters] the captured light that stands nearest
        self._irradiance = np.array([primary.irradiance for _, primary in rig.emitters]) @ rgb_matrix(rig.color_space, self.space).T
        degrees = np.degrees(np.arccos(np.clip(cosine.max(axis=1), -1, 1)))
        self.warnings = listed((f"the lamp {rig.lights[index].name} stands {degrees[index]:.3g}° from the nearest captured light, whose "
                                "image stands for it" for index in np.flatnonzero(degrees > FAR_DEGREES)), "further lamps stand so far too")

    def radiance(self, levels: np.ndarray) -> np.ndarray:
        """Return the picture at levels [emitters], [rows, cols, 3] float32, in the scene-linear space of the capture."""
        energy = np.zeros((1, *self._captured.shape))
        np.add.at(energy[0], self._light, levels[:, None] * self._irradiance)
        weights = light_weights(energy, self._captured, self._images.stack.scale)
        frame = linear_frames(self._images, weights, None)[0]
        return np.ascontiguousarray(frame.T).reshape(*self._size, 3)

    def write(self, path: Path, levels: np.ndarray, *, most_rows: int | None = None) -> None:
        """Write the picture at levels as .exr, scene-linear, or .png, as it is displayed.
        `most_rows`: the height to which a higher PNG is reduced; None: it is not. Raises StorageError if it cannot be written."""
        radiance = self.radiance(levels)
        if path.suffix.lower() == ".exr":
            exr.write(path, {name: radiance[..., c] for c, name in enumerate("RGB")}, color_space=self.space,
                      metadata=colour_configuration())
            return
        radiance = fit(radiance, min(len(radiance), most_rows or len(radiance)), kernel="triangle")
        shown = display(radiance * self._gain, self.space, self._review)
        shown[~radiance.any(axis=-1)] = 0.0  # and not the background of a sheet
        with replacing(path, flush=False) as temporary:
            write_png(temporary, np.round(np.clip(shown, 0, 1) * 255).astype(np.uint8), srgb=True, texts=colour_configuration())


class FaultSpan(NamedTuple):
    """The releases at which a fault happens, of a card the times when other lamps are lit."""

    kind: PictureFault
    first: int
    last: int | None
    """None: no end."""


class TwinCamera:
    """Writes pictures of what the lamps show."""

    def __init__(self, rig: Rig, picture: TwinPicture, listener: Listener, folder: Path, request: TwinRequest) -> None:
        self._rig, self._picture, self._listener, self._folder = rig, picture, listener, folder
        self._gain, self._noise, self._suffix = 2.0**request.exposure, request.noise, f".{request.picture_format}"
        self.card = request.picture_format is PictureFormat.CARD
        """Whether there is one picture, which is always that of this moment, and none is released."""
        self.on_card = -1
        """The number of the frame that the card shows."""
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
            faults = self._faults(self.released)
            pixels = self._pixels(levels_of_universes(self._rig, dict(self._listener.last.values)), faults, exposure_s or 1.0)
            if PictureFault.DOUBLED in faults and self._previous is not None:
                pixels = self._previous
            self._previous = pixels
            path = self._folder / f"IMG_{self.released:04d}{self._suffix}"
        if PictureFault.LATE in faults:
            threading.Timer(LATE_S, self._write, [path, pixels]).start()
        elif PictureFault.DROPPED not in faults:
            self._write(path, pixels)

    def keep_card(self, stop: threading.Event) -> None:
        """Write the picture of this moment over the one on the card at each frame that comes, until an event, as a JPEG of one size.

        A fault happens as long as the lamps shine that are the ones of its number, counted from the first that are lit. A picture that
        will come again has the same noise as long as it is there.

        The virtual camera looks at the size of its card's file when it is opened, and reads so many bytes at each release; what follows
        the end of a JPEG is ignored. Raises StorageError if it cannot be written."""
        path, lit, levels = self._folder / CARD_FILE, 0, np.zeros(0)
        while not stop.is_set():
            frame = self._listener.last
            stays = frame.number == self.on_card
            if not stays:
                before, levels = levels, levels_of_universes(self._rig, dict(frame.values))
                same = np.array_equal(levels, before)
                lit += bool(levels.any()) and not same
                faults = self._faults(lit) if levels.any() else set()
                stays = PictureFault.DOUBLED in (faults | self._faults(lit + 1) if same else faults)
            if not stays:
                pixels = self._pixels(levels, faults, 1.0)
                with storage("write", path), tempfile.TemporaryDirectory(prefix="relit-twin-") as folder:
                    picture = Path(folder) / CARD_FILE
                    write_jpeg(picture, self._codes(pixels), CARD_QUALITY, subsampled=False)
                    with replacing(path, flush=False) as temporary:
                        temporary.write_bytes(picture.read_bytes().ljust(pixels.size + CARD_HEADER_BYTES, b"\0"))
            self.on_card = frame.number
            self._listener.wait(frame.number + 1, time.monotonic() + CARD_POLL_S)

    def _faults(self, number: int) -> set[PictureFault]:
        return {span.kind for span in self._spans if span.first <= number <= (span.last or number)}

    def _pixels(self, levels: np.ndarray, faults: set[PictureFault], exposure: float) -> np.ndarray:
        """Return the picture at levels [emitters], [rows, cols, 3] float32, full scale 1."""
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
                write_png(temporary, self._codes(pixels), srgb=True)

    def _codes(self, pixels: np.ndarray) -> np.ndarray:
        """Return a picture as a camera encodes it, [rows, cols, 3] uint8."""
        encoded = convert(np.maximum(pixels, 0), self._picture.space, "srgb_texture")
        return np.asarray(np.rint(255 * np.clip(encoded, 0, 1)).astype(np.uint8))


@contextmanager
def card_kept(camera: TwinCamera | None) -> Iterator[None]:
    """Keep the picture on the card of a camera, if it has one, from a thread until the block ends; it is there when the block begins."""
    if camera is None or not camera.card:
        yield
        return
    stop = threading.Event()
    with ThreadPoolExecutor(1, thread_name_prefix="relit-card") as pool:
        keeping = pool.submit(camera.keep_card, stop)
        try:
            while camera.on_card < 0 and not keeping.done():
                time.sleep(CARD_POLL_S / 100)
            yield
        finally:
            stop.set()
    keeping.result()


def fault_spans(given: tuple[str, ...]) -> list[FaultSpan]:
    """Return the faults of texts such as dead@17, or ambient@17- from release 17 on. Raises RequestError if a text is otherwise."""
    found = []
    for text in given:
        match = re.fullmatch(r"(\w+)@(\d+)(-(\d*))?", text)
        if match is None or match[1] not in list(PictureFault):
            raise RequestError(f"--faults {text}: give KIND@RELEASE or KIND@FIRST-LAST, with one of {', '.join(PictureFault)}")
        last = int(match[2]) if match[3] is None else int(match[4]) if match[4] else None
        found.append(FaultSpan(PictureFault(match[1]), int(match[2]), last))
    return found
