"""Folders that are laid out as others lay them out: photographs with a table of their lights."""

from pathlib import Path

import numpy as np

from tests.scenes.captures import make_scene, write_image

LIGHTS = 9


def write_photographs(folder: Path, size: int = 32, lights: int = LIGHTS) -> Path:
    """16-bit photographs of a cap, photo_0.png …, and lights.txt with the direction of each light."""
    scene = make_scene(size, lights)
    scale = 50_000 / scene.images.max()
    for number, image in enumerate(scene.images):
        write_image(folder / f"photo_{number}.png", np.round(image * scale).astype(np.uint16))
    (folder / "lights.txt").write_text("".join(" ".join(f"{value:.6f}" for value in row) + "\n" for row in scene.directions))
    return folder


def write_four_phases(folder: Path) -> Path:
    """Correlation images at four phases, phase0.npy …, of which nothing tells the frequency."""
    folder.mkdir(parents=True, exist_ok=True)
    rows, cols = np.mgrid[:24, :32]
    for degrees in (0, 90, 180, 270):
        np.save(folder / f"phase{degrees}.npy", 100 + 50 * np.cos(0.05 * cols + 0.02 * rows - np.radians(degrees)))
    return folder
