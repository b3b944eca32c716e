"""Import of images of two cameras that look at one scene at the same moments, with an OpenCV calibration of the pair."""

import os
import re
from pathlib import Path
from typing import Any

import numpy as np

from stage.colour.colour_spaces import ColorSpaceName
from stage.errors import ManifestError
from stage.formats import images
from stage.importers.layout import Imported, assumed_encoding, color_space_of, image_names, image_resolution, write_capture
from stage.importers.patterns import camera_and_projector


def import_pair(left: Path, right: Path, destination: Path | None, *, calibration: Path, extrinsics: Path | None = None,
                unit_m: float = 1.0, color_space: ColorSpaceName | None = None) -> Imported:
    """Write a capture.json of stereo frames.

    Args:
        left: the folder of the images of the first camera, at whose pixels depths are found, or one image.
        right: the same of the second camera; its images belong to those of the first in natural order.
        destination: the folder of the capture; None: the one that holds both.
        calibration: the matrices and distortions of both cameras, and R and T of stereoCalibrate with the first camera first.
        extrinsics: R and T where they are in a file of their own.
        unit_m: the metres in one unit of T.
        color_space: that of the images; None: by their depth.
    """
    if left.resolve() == right.resolve():
        raise ManifestError(f"{right}: is named as the left and as the right camera: name the images of each")
    shown = [_images(side) for side in (left, right)]
    if len(shown[0]) != len(shown[1]):
        raise ManifestError(f"{right}: has {len(shown[1])} images and {left} {len(shown[0])}: each moment needs one of either camera")
    _check_numbers(*shown)
    folder = Path(os.path.commonpath([path.parent for path in (shown[0][0], shown[1][0])]))
    if destination is None and folder not in (left.resolve().parent, left.resolve()):
        raise ManifestError(f"{left}: does not lie beside {right}: name a folder for the capture")
    names = [[path.relative_to(folder).as_posix() for path in side] for side in shown]
    first, second = (image_resolution(side[0]) for side in shown)
    rig = camera_and_projector(calibration, first, second, unit_m, second="second camera", extrinsics=extrinsics)
    pose = np.array(rig["projector"].pop("camera_from_projector"))
    name = right.stem if right.is_file() else right.resolve().name
    space = color_space or color_space_of(shown[0][0])
    data: dict[str, Any] = {
        "name": folder.name, "color_space": space, "assumed": assumed_encoding(space, color_space),
        "camera": rig["camera"],
        "other_cameras": [{"name": name or "right", **rig["projector"], "camera_from_other": pose.tolist()}],
        "frames": [{"image": one, "stereo": {"images": [other]}} for one, other in zip(*names, strict=True)]}
    x, y, z = pose[:3, 3]
    return Imported(write_capture(data, calibration, destination or folder, folder=folder), (
        ("frames", f"{len(names[0])} pairs in their order, {names[0][0]} with {names[1][0]} first"),
        ("second", f"{np.linalg.norm(pose[:3, 3]):.4g} m from the first camera: {x:.4g} right, {y:.4g} up, {z:.4g} back"),
    ))


def _check_numbers(left: list[Path], right: list[Path]) -> None:
    """Refuse pairs whose numbers differ where most numbers are in both folders: another image lacks in either."""
    numbers = [[int((re.findall(r"\d+", path.stem) or ["0"])[-1]) for path in side] for side in (left, right)]
    away = [one - other for one, other in zip(*numbers, strict=True)]
    if len(set(away)) > 1 and 2 * len(set(numbers[0]) & set(numbers[1])) > len(left):
        odd = next(index for index, each in enumerate(away) if each)
        raise ManifestError(f"{left[odd]}: would be paired with {right[odd].name}, whose number is another, as where an image lacks: leave "
                            "the images without a partner out of both folders")


def _images(source: Path) -> list[Path]:
    """Return the images of a folder in natural order, or the image that is named."""
    if source.is_file() and source.suffix.lower() in images.SUFFIXES:
        return [source.resolve()]
    found = [source.resolve() / name for name in image_names(source)]
    if not found:
        raise ManifestError(f"{source}: holds no images")
    return found
