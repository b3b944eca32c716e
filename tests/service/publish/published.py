"""Published files read again, as the programs for which they are made read them, without our code."""

import json
import math
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np


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
