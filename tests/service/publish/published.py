"""Published files read again, as the programs for which they are made read them, without our code."""

import json
import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np

from tests.reference.colour import srgb
from tests.scenes.captures import make_scene, render, rgb, write_capture

SIZE = 300
"""Rows and columns of the dome: more than a tile, and no power of two."""


class Files(SimpleHTTPRequestHandler):
    """Serves files, and counts their bytes."""

    sent = 0

    def copyfile(self, source, outputfile):
        content = source.read()
        Files.sent += len(content)
        outputfile.write(content)

    def log_message(self, *_):
        pass


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address of a plain server of the files in a folder, while it runs."""
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Files, directory=folder)) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()


def spiral(count):
    """[count, 3] directions of lights, evenly over the hemisphere down to 17 degrees above its edge."""
    z = np.linspace(1, 0.3, count)
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    return np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], axis=1)


def dome(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Write a capture of a cap under 32 white lights over the hemisphere.

    Returns:
        Directions of the lights [32, 3], and of_components of its pictures.
    """
    scene, lights = make_scene(size=SIZE), spiral(32)
    white = np.ones_like(lights)
    scene = scene._replace(directions=lights, irradiance=white, images=render(scene.normal, scene.albedo, lights, white))
    write_capture(folder, scene)
    return lights, of_components(scene.images, scene.mask)


def sample(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the directions [n, 3] of the lights in front of the object of a shipped sample, and of_components of its pictures."""
    manifest = json.loads((folder / "capture.json").read_text())
    frames = [frame for frame in manifest["frames"] if frame["light"]["direction"][2] > 0]
    lights = np.array([frame["light"]["direction"] for frame in frames])
    images = np.array([rgb(folder / frame["image"]) / frame["light"]["irradiance"] for frame in frames])
    return lights, of_components(images, image(folder / manifest["mask"])[..., 0] > 127)


def of_components(images: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """[n, rows, cols, 3] what 27 components have of pictures in linear Rec.709, before bytes and JPEG files."""
    inside = images[:, mask]
    values = srgb(np.clip(inside / np.quantile(inside, 0.999), 0, 1)).swapaxes(1, 2).reshape(3 * len(images), -1)
    best = np.linalg.eigh(values @ values.T).eigenvectors[:, -27:]
    pictures = np.zeros(images.shape)
    pictures[:, mask] = np.clip(best @ (best.T @ values), 0, 1).reshape(len(images), 3, -1).swapaxes(1, 2)
    return pictures


def levels_rms(found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """[n] how far pictures [n, rows, cols, 3] are from others, root mean square, in steps of an 8-bit display."""
    return 255 * np.sqrt(np.mean(np.square(found - wanted), axis=(1, 2, 3)))


def image(path: Path) -> np.ndarray:
    """[rows, cols, 3] uint8 RGB."""
    found = cv2.imread(str(path))
    assert found is not None, path
    return found[..., ::-1]


def bilinear(direction, side: int) -> dict[int, float]:
    """The places of a grid that OpenLIME's class BLN takes for a light, with their weights."""
    x, y, _ = np.asarray(direction) / np.abs(direction).sum()
    across, down = ((part + 1) / 2 * (side - 1) for part in (x + y, y - x))
    column, row = (min(side - 2, max(0, int(place))) for place in (across, down))
    right, below = across - column, down - row
    return {column + row * side: (1 - right) * (1 - below), column + 1 + row * side: right * (1 - below),
            column + (row + 1) * side: (1 - right) * below, column + 1 + (row + 1) * side: right * below}


def shown(folder: Path, directions: np.ndarray, *, tiles: bool = False) -> np.ndarray:
    """[n, rows, cols, 3] what OpenLIME's shader (ShaderRTI, type bilinear, colour space mrgb) sums up under lights, in sRGB, from the whole
    planes, or from the finest tiles of the layout deepzoom."""
    info = json.loads((folder / "info.json").read_text())
    assert (info["type"], info["colorspace"], info["colorprofile"]) == ("bilinear", "mrgb", "sRGB")
    side, planes = info["resolution"], info["nplanes"]
    [material] = info["materials"]
    basis = np.reshape(info["basis"], (planes + 1, side**2, 3)).astype(float)
    added, mixed = basis[0] / 255, (basis[1:] - 127) / np.array(material["range"])[:, None, None]
    images = [finest(folder / f"plane_{number}.dzi") if tiles else image(folder / f"plane_{number}.jpg") for number in range(planes // 3)]
    values = (np.concatenate(images, axis=-1) / 255 - material["bias"]) * material["scale"]
    found = []
    for direction in directions:
        places = bilinear(direction, side)
        weights, at = np.array(list(places.values())), list(places)
        found.append(np.clip(values @ np.einsum("plc,l->pc", mixed[:, at], weights) + weights @ added[at], 0, 1))
    return np.array(found)


def finest(dzi: Path) -> np.ndarray:
    """[rows, cols, 3] the level that OpenLIME's class LayoutTiles takes for the whole size, of as many as it counts from one tile up."""
    [description] = ElementTree.parse(dzi).getroot()
    width, height = int(description.get("Width")), int(description.get("Height"))
    levels = math.ceil(math.log(max(width, height) / 256) / math.log(2)) + 1
    return tiles_joined(dzi.with_name(f"{dzi.stem}_files") / str(levels - 1), width, height)


def tiles_joined(folder: Path, width: int, height: int, side: int = 256) -> np.ndarray:
    """[rows, cols, 3] the tiles of one level of a Deep Zoom image, side by side."""
    joined = np.zeros((height, width, 3), np.uint8)
    for row in range(-(-height // side)):
        for column in range(-(-width // side)):
            tile = image(folder / f"{column}_{row}.jpg")
            joined[row * side:row * side + len(tile), column * side:column * side + tile.shape[1]] = tile
            assert len(tile) == min(side, height - row * side) and tile.shape[1] == min(side, width - column * side)
    return joined
