"""The shipped owl, whole or made small, and its truth."""

import json
import shutil
from pathlib import Path
from typing import NamedTuple

import numpy as np

import service
from stage.formats import exr, images
from stage.results.maps import SurfaceMaps
from tests.scenes.captures import angles_degrees, write_exr, write_image, write_manifest

OWL = Path(service.__file__).parents[1] / "samples" / "owl"


class Errors(NamedTuple):
    """Solved maps against the truth, over the pixels of the mask."""

    solved: float
    """Part of the mask that has a result."""
    normal: np.ndarray
    """[n] degrees."""
    albedo: np.ndarray
    """[n, 3] relative."""
    roughness: np.ndarray
    """[n] absolute."""
    height: float
    """RMS as a part of the relief."""


def block_mean(values: np.ndarray, side: int) -> np.ndarray:
    """[rows, cols, …] → the mean of each block of side × side pixels."""
    rows, cols = values.shape[:2]
    return values.reshape(rows // side, side, cols // side, side, *values.shape[2:]).mean(axis=(1, 3))


def write_small_owl(folder: Path, side: int, *, every: int = 1) -> Path:
    """The owl as a sensor sees it whose pixels have `side` times the width: images are averaged over blocks; of `every` so many the first
    is taken."""
    manifest = json.loads((OWL / "capture.json").read_text())
    camera = manifest["camera"]
    camera["resolution"] = [pixels // side for pixels in camera["resolution"]]
    camera["pixel_size_m"] *= side
    manifest["frames"] = manifest["frames"][::every]
    for frame in manifest["frames"]:
        write_exr(folder / frame["image"], block_mean(images.read_pixels(OWL / frame["image"]).astype(np.float32), side))
    write_image(folder / "mask.png", np.where(_inside(side), 255, 0).astype(np.uint8))
    write_manifest(folder, manifest)
    shutil.copy(OWL / "environment.exr", folder)
    return folder


def owl_errors(maps: SurfaceMaps, side: int = 1) -> Errors:
    """Errors of the maps of an owl that was made small by `side`; its truth is the mean over the same blocks."""
    channels, _ = exr.read(OWL / "truth.exr")

    def truth(layer: str, suffixes: str) -> np.ndarray:
        return block_mean(np.stack([channels[f"{layer}.{suffix}"] for suffix in suffixes], axis=-1).astype(np.float64), side)

    inside = _inside(side)
    kept = inside & maps.mask
    normal = truth("normal", "XYZ")[kept]
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    height = truth("height", "Z")[kept][:, 0]
    off = maps.height[kept] - height
    return Errors(
        solved=kept.sum() / inside.sum(),
        normal=angles_degrees(maps.normal[kept], normal),
        albedo=np.abs(maps.diffuse_albedo[kept] / truth("diffuse_albedo", "RGB")[kept] - 1),
        roughness=np.abs(maps.roughness[kept] - truth("roughness", "Y")[kept][:, 0]),
        height=float(np.std(off) / np.ptp(height)),
    )


def _inside(side: int) -> np.ndarray:
    """Blocks that are wholly object."""
    return block_mean((images.read_pixels(OWL / "mask.png")[..., 0] > 0.5).astype(np.float64), side) == 1
