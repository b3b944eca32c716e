"""The picture of a camera at the rig: the sum of captured one-light images at the levels of the lamps."""

from pathlib import Path

import numpy as np

from kernels import device as devices
from kernels.images import ImagesOnDevice
from service.relight.combine import linear_frames
from service.relight.sheet import display, fit
from service.relight.weights.weighting import light_weights
from service.reporting.progress import Timings
from service.requests.play import TwinRequest
from stage.capture.capture import Capture
from stage.capture.lighting import lights_from_centre
from stage.colour.colour import rgb_matrix
from stage.colour.colour_spaces import linear_space
from stage.errors import listed
from stage.files import replacing
from stage.formats import exr
from stage.formats.images import write_png
from stage.rig.rig import Rig
from stage.stack.brackets import merge_brackets
from stage.stack.ingest import open_stack

FAR_DEGREES = 2.0
"""A lamp that stands farther than this from every captured light is named."""


class TwinPicture:
    """Pictures of a capture under the lamps of a rig; each lamp lights as the captured light does that stands nearest to it."""

    def __init__(self, rig: Rig, request: TwinRequest, timings: Timings) -> None:
        """Read the images of the capture.

        Raises:
            StageError: bad input; names file and field.
        """
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

        Args:
            most_rows: the height to which a higher PNG is reduced; None: it is not.

        Raises:
            StorageError: it cannot be written.
        """
        radiance = self.radiance(levels)
        if path.suffix.lower() == ".exr":
            exr.write(path, {name: radiance[..., c] for c, name in enumerate("RGB")}, color_space=self.space, metadata={})
            return
        radiance = fit(radiance, min(len(radiance), most_rows or len(radiance)), kernel="triangle")
        shown = display(radiance * self._gain, self.space, self._review)
        shown[~radiance.any(axis=-1)] = 0.0  # and not the background of a sheet
        with replacing(path, flush=False) as temporary:
            write_png(temporary, np.round(np.clip(shown, 0, 1) * 255).astype(np.uint8), srgb=True)
