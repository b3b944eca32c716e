"""What an asset can bring along: captures that are all lights, and frames of a known colour and coverage."""

import json

import numpy as np

from stage.capture.capture import Capture
from stage.formats import exr
from tests.scenes.captures import write_image, write_manifest

COVERAGE = np.array([0.0, 0.25, 1.0])
"""Coverage of the columns of a frame, which repeats."""


def capture_of(folder, camera, lights, **changes):
    """A capture whose frames have these lights and black images."""
    for index in range(len(lights)):
        write_image(folder / f"{index:03d}.png", np.zeros((camera.height, camera.width, 3), np.uint8))
    frames = [{"image": f"{index:03d}.png", "light": light} for index, light in enumerate(lights)]
    write_manifest(folder, {"schema": "relit.capture/1", "name": "lights", "camera": json.loads(camera.model_dump_json(exclude_none=True)),
                            "frames": frames, **changes})
    return Capture.open(folder)


def write_frames(folder, numbers, camera, *, space="lin_rec709_scene", opaque=False):
    """Frames whose colour before it is multiplied by the coverage is (number / 4, 0.5, 2)."""
    coverage = np.broadcast_to(np.resize(COVERAGE, camera.width), (camera.height, camera.width)).astype(np.float16)
    coverage = np.ones_like(coverage) if opaque else coverage
    folder.mkdir(parents=True, exist_ok=True)
    for number in numbers:
        channels = {name: (coverage * value).astype(np.float16) for name, value in zip("RGB", (number / 4, 0.5, 2.0), strict=True)}
        exr.write(folder / f"frame.{number:04d}.exr", {**channels, "A": coverage, "depth.Z": coverage}, color_space=space, metadata={})
    return folder / "frame.####.exr"
