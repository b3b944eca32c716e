"""Measured readings of single pixels, and what the maps say that they should be: a plot of each pixel by light.

The model is Relit's BRDF under the lights of the capture, with the shadows that the solved surface casts, and without light that the object
throws on itself: what `relit shade` and guided frames are made with (service.relight.surface_model).
"""

from typing import Any, NamedTuple

import numpy as np

from kernels.device import to_numpy
from kernels.relight.model.shading import shade
from kernels.relight.model.sources import NEVER, Sources
from service.relight.surface_model import ModelBatch, SurfaceModel
from service.reporting.progress import Timings
from service.reporting.provenance import other_inputs
from service.viewing.block_file import BlockFile
from service.viewing.reduction import row_bands, step_within
from service.viewing.result_layers import ResultLayers
from stage.capture.point_lights import DistantLights, PlacedLights
from stage.results.maps import LOBES, SurfaceMaps
from stage.stack.stack import Stack
from stage.stack.stack_file import TOP_EXPONENT

MOST_BYTES = 64_000_000
"""Most bytes of all samples; of larger images every second, third … pixel is taken in both directions."""
MEASURED_BYTES, MODEL_BYTES, USED_BYTES = 6, 6, 1
"""Bytes of one pixel under one light."""
SATURATED, HIDDEN, BACKLIT = 1, 2, 4
FLAGS = {SATURATED: ("saturated", "The reading saturates, or alignment lost it: the solve did not use it."),
         HIDDEN: ("shadowed", "The solved surface hides the light from this pixel."),
         BACKLIT: ("backlit", "The light comes from behind the surface.")}
"""Bits of `used`, their names and meanings."""
MODEL_LAYERS = ("normal", "diffuse_albedo", "height", "part", "abundance", *(name for lobe in LOBES for name in lobe))


class PixelGrid(NamedTuple):
    """Every so many pixels of an image."""

    rows: int
    cols: int
    step: int

    @property
    def pixels(self) -> int:
        """Return the number of pixels of the grid."""
        return self.rows * self.cols

    def places(self, pixels: np.ndarray, width: int) -> np.ndarray:
        """Return the places in the grid of pixels [n], row-major positions in an image of a width."""
        row, col = np.divmod(pixels, width)
        return np.asarray(row // self.step * self.cols + col // self.step)


def write_samples(stack: Stack, shape: tuple[int, int], found: ResultLayers, lights: DistantLights | PlacedLights | None, file: BlockFile,
                  *, doubts: list[str], device: str, timings: Timings) -> dict[str, Any]:
    """Write the samples of a solve, and return what view.json says of them.
    `lights`: that the maps were solved with; None: they are of a kind that the model does not have, and there is no model. `doubts`: gets a
    sentence where nothing tells whether the maps were solved from these images."""
    if (doubt := other_inputs(found.provenance, stack.key, found.path)) is not None:
        doubts.append(doubt)
    count, (rows, cols) = stack.light_count, shape
    step = step_within(rows * cols, max(1, MOST_BYTES // (count * (MEASURED_BYTES + MODEL_BYTES + USED_BYTES))))
    grid = PixelGrid(-(-rows // step), -(-cols // step), step)
    scale = 2.0 ** max(0, int(np.ceil(np.log2(stack.scale.max()))) + TOP_EXPONENT - 15)
    measured, used = file.reserve(grid.pixels * count * MEASURED_BYTES), file.reserve(grid.pixels * count * USED_BYTES)
    flags = np.zeros((grid.pixels, count), dtype=np.uint8)
    _write_measured(stack, shape, grid, scale, file, measured, flags, timings)
    model = None if lights is None else _surface(found, grid, device)
    offset = None
    if model is not None and lights is not None:
        offset = file.reserve(grid.pixels * count * MODEL_BYTES)
        _write_model(model, lights, grid, scale, file, offset, flags, timings)
    file.write_at(used, flags)
    return {"rows": grid.rows, "cols": grid.cols, "step": step, "lights": count, "scale": scale, "measured": measured, "model": offset,
            "used": used, "codes": {str(bit): {"name": name, "meaning": meaning} for bit, (name, meaning) in FLAGS.items()}}


def _write_measured(stack: Stack, shape: tuple[int, int], grid: PixelGrid, scale: float, file: BlockFile, offset: int, flags: np.ndarray,
                    timings: Timings) -> None:
    """Write the readings of every pixel of the grid, and set which of them saturate."""
    count, cols = stack.light_count, shape[1]
    bands = list(row_bands(stack, shape, grid.step, 0))
    timings.stage("readings", len(bands))
    factor = (stack.scale[:count] / np.float32(scale))[:, None]
    for done, band in enumerate(bands, start=1):
        row, col = np.arange(band.rows.start, band.rows.stop, grid.step), np.arange(0, cols, grid.step)
        place = (row[:, None] * cols + col).reshape(-1) - band.start
        stored = stack.band(band.start, band.stop)
        values = np.empty((len(place), count, 3), dtype=np.float16)
        for channel in range(3):
            values[:, :, channel] = (stored[channel, :count][:, place].astype(np.float32) * factor).T
        bits = np.unpackbits(stack.saturated(band.start, band.stop)[:, place], axis=0, bitorder="little")[:count]
        pixels = slice(band.reduced.start * grid.cols, band.reduced.stop * grid.cols)
        flags[pixels] |= bits.T * np.uint8(SATURATED)
        file.write_at(offset + pixels.start * count * MEASURED_BYTES, values)
        timings.advance(done)


def _surface(found: ResultLayers, grid: PixelGrid, device: str) -> SurfaceModel | None:
    """Return the surface at the pixels of the grid; None where the maps lack what a model needs, or none of the pixels is estimated."""
    names = found.names()
    chosen = np.zeros(found.estimated.shape, dtype=bool)
    chosen[:: grid.step, :: grid.step] = found.estimated[:: grid.step, :: grid.step]
    if not {"normal", "diffuse_albedo", "height"} <= set(names) or not chosen.any():
        return None
    layers: dict[str, Any] = {}
    found.forget()
    for name in MODEL_LAYERS:  # half values stay half: SurfaceMaps.read would take twice the memory
        if name in names:
            values = found.take(name)
            layers[name] = values[0] if len(values) == 1 else np.ascontiguousarray(np.moveaxis(values, 0, -1))
    if "part" in layers:
        layers["part"] = layers["part"].astype(np.uint8)
    found.forget()
    return SurfaceModel(SurfaceMaps(camera=found.camera, mask=found.estimated, **layers), found.path, device, chosen=chosen)


def _write_model(model: SurfaceModel, lights: DistantLights | PlacedLights, grid: PixelGrid, scale: float, file: BlockFile, offset: int,
                 flags: np.ndarray, timings: Timings) -> None:
    """Write what the model says of the grid, and set which lights it does not see."""
    sources = light_sources(lights)
    width = model.maps.mask.shape[1]
    timings.stage("model", len(model.pixels))
    for batch in model.batches():
        values, hidden = _lit(model, batch, sources, scale)
        places = grid.places(batch.pixels, width)
        flags[places] |= hidden
        for run in np.split(np.arange(len(places)), np.flatnonzero(np.diff(places) != 1) + 1):
            file.write_at(offset + int(places[run[0]]) * sources.count * MODEL_BYTES, values[run])
        timings.advance(batch.part.stop)


def _lit(model: SurfaceModel, batch: ModelBatch, sources: Sources, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Return [n, lights, 3] half radiance of a batch under each light, over the scale, and [n, lights] uint8 flags."""
    count, pixels = sources.count, len(batch.pixels)
    visible = model.see(sources.place, batch)
    values = np.empty((pixels, count, 3), dtype=np.float16)
    for light in range(count):
        one = Sources(*(plane[light : light + 1] for plane in sources))
        lit = to_numpy(shade(batch.surface, one, visible))[:, :pixels]
        values[:, light] = np.minimum((lit[:3] + lit[3:]) / scale, np.finfo(np.float16).max).T
    seen = to_numpy(visible).reshape(count, -1)[:, :pixels].T != 0
    assert model.maps.normal is not None
    normal, point = model.maps.normal.reshape(-1, 3)[batch.pixels], model.places(batch.pixels)
    place, is_near = sources.place[:, :3], sources.place[:, 3]
    facing = normal @ place.T - is_near * np.einsum("nx,nx->n", normal, point)[:, None]
    return values, np.where(seen, 0, HIDDEN).astype(np.uint8) | np.where(facing > 0, 0, BACKLIT).astype(np.uint8)


def light_sources(lights: DistantLights | PlacedLights) -> Sources:
    """Return the lights of a capture as samples of light, each hidden by the row of visibility that has its number."""
    count = len(lights.direction)
    far = np.concatenate([lights.direction, np.zeros((count, 1))], axis=1)
    place, strength, axis = (lights.place, lights.strength, lights.lobe) if isinstance(lights, PlacedLights) else (
        far, lights.irradiance, np.zeros((count, 4)))
    occluder = np.full((count, 3), NEVER, dtype=np.int32)
    occluder[:, 0] = np.arange(count)
    return Sources(place.astype(np.float32), strength.astype(np.float32), axis.astype(np.float32), occluder,
                   np.tile(np.array([1, 0, 0], dtype=np.float32), (count, 1)))
