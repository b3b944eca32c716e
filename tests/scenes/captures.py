"""Small synthetic captures with a known truth: a Lambertian cap under distant lights, rendered in float64 and written with
OpenEXR and json alone, so that nothing here leans on the code that it judges."""

import json
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import OpenEXR
import OpenImageIO as oiio

SLOPE_DEGREES, TILT_DEGREES = 45.0, 30.0
"""The steepest normal and the flattest light: together below 90 degrees, so that nothing lies in its own shadow."""


class Scene(NamedTuple):
    """What was rendered."""

    normal: np.ndarray  # [rows, cols, 3] float64, unit, camera frame
    albedo: np.ndarray  # [rows, cols, 3] float64
    mask: np.ndarray  # [rows, cols] bool
    directions: np.ndarray  # [lights, 3] float64, unit, from the surface to the light
    irradiance: np.ndarray  # [lights, 3] float64
    images: np.ndarray  # [lights, rows, cols, 3] float64, radiance


def make_scene(size: int = 16, lights: int = 6) -> Scene:
    """A spherical cap in the middle of the image, its albedo changing across it, under lights of different colours."""
    centre = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(centre, -centre)
    limit = np.sin(np.radians(SLOPE_DEGREES))
    mask = x**2 + y**2 < 1 if size > 1 else np.ones((1, 1), dtype=bool)
    nx, ny = np.where(mask, x * limit, 0), np.where(mask, y * limit, 0)
    normal = np.stack([nx, ny, np.sqrt(1 - nx**2 - ny**2)], axis=-1)
    albedo = np.stack([0.5 + 0.3 * x, 0.5 + 0.3 * y, np.full_like(x, 0.4)], axis=-1) * mask[..., None]
    directions, irradiance = ring(lights), 1 + 0.1 * np.arange(3 * lights).reshape(lights, 3) % 0.7
    return Scene(normal, albedo, mask, directions, irradiance, render(normal, albedo, directions, irradiance))


def ring(lights: int) -> np.ndarray:
    """[lights, 3] unit directions: one from the front, the others around it, TILT_DEGREES off."""
    turn = np.linspace(0, 2 * np.pi, max(lights - 1, 1), endpoint=False)
    tilt = np.radians(TILT_DEGREES)
    around = np.stack([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.full_like(turn, np.cos(tilt))], axis=-1)
    return np.concatenate([[[0.0, 0.0, 1.0]], around])[:lights]


def render(normal: np.ndarray, albedo: np.ndarray, directions: np.ndarray, irradiance: np.ndarray) -> np.ndarray:
    """[lights, rows, cols, 3] radiance rho/pi E max(0, n·l), float64."""
    cosine = np.maximum(np.einsum("rcx,lx->lrc", normal, directions), 0)
    return albedo / np.pi * irradiance[:, None, None, :] * cosine[..., None]


def write_exr(path: Path, pixels: np.ndarray, dtype: type[np.floating] = np.float32, **header: Any) -> Path:
    """Write [rows, cols, 3] or [rows, cols] as a scan-line EXR."""
    path.parent.mkdir(parents=True, exist_ok=True)
    planes = {"Y": pixels} if pixels.ndim == 2 else {name: pixels[..., c] for c, name in enumerate("RGBA"[: pixels.shape[2]])}
    attributes = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    OpenEXR.File(attributes, {name: np.ascontiguousarray(plane, dtype=dtype) for name, plane in planes.items()}).write(str(path))
    return path


def rgb(path: Path, layer: str = "") -> np.ndarray:
    """Read [rows, cols, 3] of an EXR file, or of its layer "name."."""
    channels = OpenEXR.File(str(path), separate_channels=True).channels()
    return np.stack([channels[layer + name].pixels.astype(np.float64) for name in "RGB"], axis=-1)


def write_radiance(path: Path, pixels: np.ndarray, *lines: str) -> Path:
    """Write [rows, cols, 3] as a Radiance file of uncompressed RGBE with further lines in its header."""
    path.parent.mkdir(parents=True, exist_ok=True)
    largest = pixels.max(axis=-1)
    exponent = np.where(largest > 0, np.frexp(largest)[1], -128)
    codes = np.concatenate([np.ldexp(pixels, 8 - exponent[..., None]), exponent[..., None] + 128], axis=-1)
    rows, cols = largest.shape
    head = "\n".join(["#?RADIANCE", *lines, "FORMAT=32-bit_rle_rgbe", "", f"-Y {rows} +X {cols}", ""])
    path.write_bytes(head.encode() + np.clip(codes, 0, 255).astype(np.uint8).tobytes())
    return path


def write_image(path: Path, pixels: np.ndarray, **attributes: Any) -> Path:
    """Write [rows, cols] or [rows, cols, channels] with OpenImageIO and its attributes; the array's type is the file's."""
    path.parent.mkdir(parents=True, exist_ok=True)
    values = np.ascontiguousarray(pixels if pixels.ndim == 3 else pixels[..., None])
    rows, cols, channels = values.shape
    spec = oiio.ImageSpec(cols, rows, channels, {"float16": "half", "float32": "float"}.get(values.dtype.name, values.dtype.name))
    if channels in (2, 4):
        spec.alpha_channel = channels - 1
        spec.attribute("oiio:UnassociatedAlpha", 1)  # the values are what they are, not multiplied by alpha
    for name, value in attributes.items():
        spec.attribute(name, value)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec), output.geterror()
    assert output.write_image(values), output.geterror()
    output.close()
    return path


def manifest_of(scene: Scene, **changes: Any) -> dict[str, Any]:
    """The manifest of a scene as plain data, to be changed by the test; a change to None takes the key away."""
    rows, cols = scene.mask.shape
    data: dict[str, Any] = {
        "schema": "relit.capture/1",
        "name": "cap",
        "camera": {"projection": "orthographic", "resolution": [cols, rows]},
        "mask": "mask.png",
        "frames": [
            {"image": f"{i:03d}.exr", "light": {"type": "distant", "direction": direction, "irradiance": irradiance}}
            for i, (direction, irradiance) in enumerate(zip(scene.directions.tolist(), scene.irradiance.tolist(), strict=True))
        ],
        **changes,
    }
    return {key: value for key, value in data.items() if value is not None}


def write_manifest(folder: Path, data: dict[str, Any]) -> Path:
    """Write capture.json from plain data."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "capture.json"
    path.write_text(json.dumps(data), encoding="utf-8")
    return path


def distant(direction: np.ndarray, irradiance: float | np.ndarray) -> dict[str, Any]:
    """The entry of a distant light from a unit direction [3], of this irradiance in each channel or [3]."""
    return {"type": "distant", "direction": direction.tolist(), "irradiance": np.broadcast_to(irradiance, 3).astype(float).tolist()}


def write_images(folder: Path, images: Iterable[np.ndarray], entries: Iterable[dict[str, Any]], names: str = "{:03d}.exr"
                 ) -> list[dict[str, Any]]:
    """Write images [rows, cols, 3] or grey [rows, cols], and return the frames of the manifest: their entries with their names.
    Files whose names end with .png have 16 bits, of values from 0 to 1."""
    frames = []
    for index, (image, entry) in enumerate(zip(images, entries, strict=True)):
        path = folder / names.format(index)
        if path.suffix == ".png":
            write_image(path, np.rint(np.clip(image, 0, 1) * 65535).astype(np.uint16))
        else:
            write_exr(path, image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2))
        frames.append({"image": path.name, **entry})
    return frames


def write_lit(folder: Path, images: Iterable[np.ndarray], lights: Iterable[dict[str, Any]], *, camera: dict[str, Any],
              mask: np.ndarray | None = None, names: str = "{:03d}.exr", **changes: Any) -> Path:
    """Write a capture of images [rows, cols, 3] or grey [rows, cols], each under the light of its entry; the mask [rows, cols] is bool, or
    coverage in 16 bits.

    Returns:
        The folder.
    """
    frames = write_images(folder, images, ({"light": light} for light in lights), names)
    if mask is not None:
        write_image(folder / "mask.png", np.uint8(mask * 255) if mask.dtype == bool else np.uint16(np.rint(mask * 65535)))
        changes = {"mask": "mask.png", **changes}
    write_manifest(folder, {"schema": "relit.capture/1", "name": "cap", "camera": camera, "frames": frames, **changes})
    return folder


def write_capture(folder: Path, scene: Scene | None = None, *, dtype: type[np.floating] = np.float32, **changes: Any) -> Path:
    """Write images, mask and manifest.

    Returns:
        The folder.
    """
    scene = scene or make_scene()
    for index, image in enumerate(scene.images):
        write_exr(folder / f"{index:03d}.exr", image, dtype)
    write_image(folder / "mask.png", (scene.mask * 255).astype(np.uint8))
    write_manifest(folder, manifest_of(scene, **changes))
    return folder


def edit_manifest(folder: Path, **changes: Any) -> None:
    """Set keys of a written capture.json; a function is given what is there, and None takes a key away."""
    data = json.loads((folder / "capture.json").read_text())
    data |= {key: value(data[key]) if callable(value) else value for key, value in changes.items()}
    write_manifest(folder, {key: value for key, value in data.items() if value is not None})


def edit_frame(folder: Path, index: int, **changes: Any) -> None:
    """Set keys of one frame of a written capture.json."""
    data = json.loads((folder / "capture.json").read_text())
    data["frames"][index] = {key: value for key, value in {**data["frames"][index], **changes}.items() if value is not None}
    write_manifest(folder, data)


def files_in(folder: Path) -> set[str]:
    """Every file under a folder, hidden ones too, relative to it."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()} if folder.exists() else set()


@contextmanager
def nothing_written(folder: Path, words: str, *errors: type[Exception]) -> Iterator[None]:
    """Expect one of the errors with one sentence that has these words, and the files of the folder as they were."""
    import pytest

    before = files_in(folder)
    with pytest.raises(errors, match=words) as caught:
        yield
    assert "\n" not in str(caught.value) and files_in(folder) == before


def angles_degrees(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angle between unit vectors along the last axis, without the loss of arccos near 0."""
    a, b = a.astype(np.float64), b.astype(np.float64)
    return np.degrees(2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1)))


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values.astype(np.float64) ** 2)))
