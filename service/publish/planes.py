"""Planes as OpenLIME and RelightLab read them: info.json, and images of three planes each, whole and as Deep Zoom tiles.

A plane is scale · (value of the image, 0…1 − bias). Outside the object it is 0. The levels of tiles begin with 0, the whole image in one
tile, because OpenLIME counts them so for the layout `deepzoom`; other readers of Deep Zoom count from an image of one pixel.

Source: the relight format of the Visual Computing Lab, ISTI-CNR, as OpenLIME's ShaderRTI and LayoutTiles read it; Microsoft, Deep Zoom File
    Format Overview.
"""

import json
from pathlib import Path

import numpy as np

from kernels.device import to_numpy
from kernels.relight.frames.combine import combine_batch
from service.basis.capture import BasisCapture, Display, stack_bands
from service.publish.components import Components, components_of
from service.publish.pyramid import TILE, Pyramid, TilePath, halvings
from service.publish.strips import Strips
from service.reporting.progress import Timings
from stage.files import write_text
from stage.formats.rti import dequantize, quantization_of_range, quantize
from stage.results.light_basis import numbers

INFO_FILE = "info.json"
DEEP_ZOOM = ('<?xml version="1.0" encoding="UTF-8"?>\n<Image xmlns="http://schemas.microsoft.com/deepzoom/2008" Format="jpg" Overlap="0" '
             'TileSize="{tile}"><Size Width="{width}" Height="{height}"/></Image>\n')
RESERVE = 1.05
"""How far the range of a plane goes beyond that of the sampled pixels."""
FINER_IMAGES = 5
"""Number of images, the first, whose planes count more in pictures than those of the others, and are kept at a higher quality."""


def write_planes(folder: Path, source: BasisCapture, display: Display, sample: np.ndarray, device: str, timings: Timings, *, quality: int,
                 whole: bool) -> float:
    """Write planes and info.json, `whole` images beside their tiles; the planes are the components of stored_sample.

    Returns:
        The root mean square difference of pictures under the captured lights from those, in steps of an 8-bit display, before JPEG.
    """
    timings.stage("components", 1)
    shown = display.of_sample(sample)
    found = components_of(shown, source.lights.direction[display.front])
    fit = found.fit
    planes = np.einsum("plc,cln->pn", fit, shown, optimize=True)
    quantization = quantization_of_range(RESERVE * planes.min(axis=1), RESERVE * planes.max(axis=1))
    rebuilt = np.einsum("plc,pn->cln", found.basis, dequantize(quantize(planes, quantization), quantization), optimize=True)
    loss = float(255 * np.sqrt(np.mean(np.square(np.clip(rebuilt, 0, 1) - shown))))
    del shown, rebuilt
    weights = np.zeros((len(fit), 3, source.stack.shape[1]), np.float32)
    weights[:, :, display.front] = fit.swapaxes(1, 2)
    camera = source.capture.camera
    images, levels = len(fit) // 3, 1 + halvings(camera.width, camera.height, TILE)
    pyramids = [Pyramid(camera.width, camera.height, _tile(folder, image, levels), levels=levels, quality=_quality_of(image, quality),
                        whole=folder / f"plane_{image}.jpg" if whole else None) for image in range(images)]
    bytes_per_pixel = 6 * source.stack.shape[1] + 20 * len(fit)  # display values, and planes in their stages
    with Strips(camera.height, camera.width, pyramids, quantization.zero.astype(np.uint8).reshape(-1, 3)) as strips:
        for each in stack_bands(source, device, bytes_per_pixel, timings, "tiles"):
            fitted = to_numpy(combine_batch(display.shown(each.band), weights)).sum(axis=1)
            stored = quantize(np.where(each.inside, fitted, 0), quantization)[:, :each.span.stop - each.span.start]
            strips.put(each.span.start, stored.reshape(images, 3, -1).swapaxes(1, 2))
    timings.stage("write", 1)
    material = {"scale": numbers(255 * quantization.step), "bias": numbers(quantization.zero / 255), "range": numbers(found.ranges)}
    info = _info(source, found) | {"quality": quality, "materials": [material]}
    write_text(folder / INFO_FILE, json.dumps(info, separators=(",", ":")) + "\n")
    for image in range(images):
        write_text(folder / f"plane_{image}.dzi", DEEP_ZOOM.format(tile=TILE, width=camera.width, height=camera.height))
    return loss


def _info(source: BasisCapture, found: Components) -> dict[str, object]:
    camera = source.capture.camera
    black = np.zeros_like(found.stored[:1])  # what is added to all planes
    size = {} if camera.pixel_size_m is None else {"pixelSizeInMM": numbers(1000 * camera.pixel_size_m)}
    return {"type": "bilinear", "resolution": found.side, "colorspace": "mrgb", "colorprofile": "sRGB",
            "nplanes": len(found.stored), "format": "jpg", "width": camera.width, "height": camera.height, **size,
            "lights": numbers(found.directions.ravel()),
            "basis": np.concatenate([black, found.stored]).ravel().tolist()}


def _quality_of(image: int, quality: int) -> int:
    """Return the quality of an image: 100 for the first, and `quality` after the finer ones."""
    return 100 - round((100 - quality) * min(1.0, image / FINER_IMAGES))


def _tile(folder: Path, image: int, levels: int) -> TilePath:
    """Return the paths of the tiles of an image; the last level is the whole size."""
    return lambda halving, column, row: folder / f"plane_{image}_files" / str(levels - 1 - halving) / f"{column}_{row}.jpg"
