"""The files of a sample capture: images, mask, truth layers and manifest, each written through a temporary name."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np


class Truth(NamedTuple):
    """Ground truth at the pixels of an orthographic camera."""

    normal: np.ndarray  # [H, W, 3] float32, unit, camera frame
    diffuse_albedo: np.ndarray  # [H, W, 3] float32, linear
    f0: np.ndarray  # [H, W] float32
    roughness: np.ndarray  # [H, W] float32
    height: np.ndarray  # [H, W] float32, metres, camera-frame z
    mask: np.ndarray  # [H, W] bool, fully covered pixels


def round_mantissa(image: np.ndarray, bits: int) -> np.ndarray:  # -> half, same shape
    """Round half floats to `bits` explicit mantissa bits (10 keeps them as they are): smaller ZIP and PIZ files."""
    drop = 10 - bits
    raw = np.ascontiguousarray(image, dtype=np.float16).view(np.uint16).astype(np.uint32)
    if drop:
        raw = ((raw + (1 << (drop - 1))) >> drop) << drop
    return raw.astype(np.uint16).view(np.float16)


def write_exr(path: Path, channels: dict[str, np.ndarray], *, note: str) -> None:
    """Write the layers of one scanline EXR."""
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "comments": note}
    temporary = path.with_name(f".{path.name}.part")
    OpenEXR.File(header, {k: np.ascontiguousarray(v) for k, v in channels.items()}).write(str(temporary))
    os.replace(temporary, path)


def write_rgb(path: Path, image: np.ndarray, *, note: str) -> None:
    """Write one RGB EXR [H, W, 3] in its own type, half or float, ZIP at its highest level.

    OpenImageIO, because OpenEXR's Python has no say over the level; it is worth 2 % of a capture.
    """
    import OpenImageIO as oiio

    temporary = path.with_name(f".part.{path.name}")
    spec = oiio.ImageSpec(image.shape[1], image.shape[0], 3, "half" if image.dtype == np.float16 else "float")
    spec.attribute("compression", "zip:9")
    spec.attribute("ImageDescription", note)
    spec.attribute("DateTime", "")  # or the date of the run would be written, and no two runs would be alike
    out = oiio.ImageOutput.create(str(temporary))
    if not (out.open(str(temporary), spec) and out.write_image(np.ascontiguousarray(image)) and out.close()):
        raise OSError(f"cannot write {path}: {out.geterror()}")
    os.replace(temporary, path)


def write_mask(path: Path, mask: np.ndarray) -> None:
    """Write an 8-bit grey PNG, 255 where `mask` [H, W] bool is true."""
    import OpenImageIO as oiio

    temporary = path.with_name(f".part.{path.name}")
    out = oiio.ImageOutput.create(str(temporary))
    out.open(str(temporary), oiio.ImageSpec(mask.shape[1], mask.shape[0], 1, "uint8"))
    out.write_image(np.where(mask, 255, 0).astype(np.uint8)[..., None])
    out.close()
    os.replace(temporary, path)


def _lines(value) -> str:
    """Return the JSON text of a value, with a line for each object of a list."""
    if isinstance(value, list) and value and isinstance(value[0], dict):
        return "[\n" + ",\n".join(f"  {json.dumps(v)}" for v in value) + "\n ]"
    return json.dumps(value)


def write_json(path: Path, value: dict) -> None:
    """Write JSON through a temporary name."""
    temporary = path.with_name(f".{path.name}.part")
    text = ",\n".join(f" {json.dumps(k)}: {_lines(v)}" for k, v in value.items())
    temporary.write_text(f"{{\n{text}\n}}\n")
    os.replace(temporary, path)


def truth_layers(truth: Truth, *, specular: bool, dtype: type = np.float16) -> dict[str, np.ndarray]:
    """Return the channels of truth.exr as `dtype`, but height as float32 (half would quantise it to 0.03 mm)."""
    layers = {f"normal.{axis}": truth.normal[..., i].astype(dtype) for i, axis in enumerate("XYZ")}
    layers |= {f"diffuse_albedo.{c}": truth.diffuse_albedo[..., i].astype(dtype) for i, c in enumerate("RGB")}
    if specular:
        layers |= {f"specular.{c}": truth.f0.astype(dtype) for c in "RGB"}
        layers["roughness.Y"] = truth.roughness.astype(dtype)
    return layers | {"height.Z": truth.height.astype(np.float32), "mask.Y": truth.mask.astype(dtype)}


def manifest(*, name: str, truth: Truth, pixel_size_m: float, directions: np.ndarray, irradiance: np.ndarray) -> dict:
    """Return the capture.json of an orthographic capture with one light a frame, whose images are 000.exr and so on."""
    height, width = truth.mask.shape
    return {
        "schema": "relit.capture/1",
        "name": name,
        "color_space": "lin_rec709_scene",
        "camera": {
            "projection": "orthographic",
            "resolution": [width, height],
            "pixel_size_m": pixel_size_m,
            "surface_z_m": round(float(truth.height[truth.mask].mean(dtype=np.float64)), 8),
            "world_from_camera": np.eye(4, dtype=int).tolist(),
        },
        "mask": "mask.png",
        "frames": [
            {
                "image": f"{i:03d}.exr",
                "light": {
                    "type": "distant",
                    "direction": [round(float(x), 8) for x in direction],
                    "irradiance": [round(float(x), 6) for x in e],
                },
            }
            for i, (direction, e) in enumerate(zip(directions, irradiance, strict=True))
        ],
    }
