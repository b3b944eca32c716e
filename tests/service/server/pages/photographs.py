"""Folders of photographs as a person has them who knows nothing of captures."""

from pathlib import Path

import numpy as np

from stage.capture.capture import Capture
from stage.formats import images
from tests.scenes.captures import write_image
from tests.service.server.pages.conftest import SAMPLES


def write_photographs(folder: Path, *, table: bool = True) -> Path:
    """The photographs of a sample as 16-bit PNG, with or without a table of their lights, and a video of its making."""
    capture = Capture.open(SAMPLES / "lambert")
    pixels = np.stack([images.read_recorded(SAMPLES / "lambert" / frame.image) for frame in capture.manifest.frames])
    for number, image in enumerate(np.moveaxis(pixels / pixels.max(), 1, -1) if pixels.shape[1] == 3 else pixels / pixels.max()):
        write_image(folder / f"photo_{number:02}.png", np.round(image.astype(np.float64) * 60_000).astype(np.uint16))
    if table:
        rows = (" ".join(map(str, frame.light.direction)) for frame in capture.manifest.frames)
        (folder / "light_directions.txt").write_text("\n".join(rows) + "\n")
    (folder / "making_of.mov").write_bytes(bytes(1 << 20))
    return folder
