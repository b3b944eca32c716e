"""The preview of a solve: captured, normals, albedo, roughness, height and relit frames, in one image."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from service.light.sheet import BACKGROUND, display, read_frame, write_sheet
from stage.colour import convert
from stage.maps import SurfaceMaps

EXPOSURE_PERCENTILE = 99.0
"""This percentile of the object's luminance becomes EXPOSURE_TARGET before the display transform."""
EXPOSURE_TARGET = 0.8


def write_preview(path: Path, maps: SurfaceMaps, captured: np.ndarray, frames: Sequence[Path]) -> None:
    """Write the preview of a solve.

    Args:
        path: the PNG.
        maps: solved maps.
        captured: [rows, cols, 3] scene-linear, one captured image.
        frames: relit EXR frames; two rows of them, evenly chosen, are shown.

    Raises:
        StorageError: the image cannot be written.
    """
    mask = maps.mask
    top = [("captured, one light", display(captured * _exposure(captured[None], mask), maps.color_space))]
    if maps.normal is not None:
        top.append(("normals", np.where(mask[..., None], 0.5 + 0.5 * maps.normal, BACKGROUND)))
    if maps.diffuse_albedo is not None:
        albedo = convert(np.clip(maps.diffuse_albedo, 0, 1).astype(np.float32), maps.color_space, "srgb_rec709_scene")
        top.append(("diffuse albedo", np.where(mask[..., None], albedo, BACKGROUND)))
    if maps.roughness is not None:
        grey = np.repeat(maps.roughness.astype(np.float32)[..., None], 3, axis=-1)
        top.append(("roughness", np.where(mask[..., None], grey, BACKGROUND)))
    if maps.height is not None:
        top.append(("height", _relief(maps.height, mask)))
    count = min(2 * len(top), len(frames))
    shown = [frames[i] for i in np.linspace(0, len(frames), count, endpoint=False).astype(int)]
    relit = np.stack([read_frame(frame)[0] for frame in shown])
    together = (relit * _exposure(relit, mask)).reshape(-1, *relit.shape[2:])  # the transform is made once for all
    bottom = [(f"relit, {frame.stem}", pixels)
              for frame, pixels in zip(shown, display(together, maps.color_space).reshape(relit.shape), strict=True)]
    write_sheet(path, [row for row in (top, bottom[: len(top)], bottom[len(top) :]) if row])


def _exposure(images: np.ndarray, mask: np.ndarray) -> float:
    level = float(np.percentile(images[:, mask].mean(axis=-1), EXPOSURE_PERCENTILE))
    return EXPOSURE_TARGET / level if level > 0 else 1.0


def _relief(height: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the height as grey, bright where it is near the camera."""
    low, high = np.percentile(height[mask], [0.5, 99.5])
    grey = np.clip((height - low) / max(high - low, 1e-12), 0, 1)
    return np.where(mask[..., None], np.repeat((0.12 + 0.83 * grey)[..., None], 3, axis=-1), BACKGROUND)
