"""Published files read again, as the programs for which they are made read them, without our code."""

import json
from pathlib import Path

import cv2
import numpy as np


def image(path: Path) -> np.ndarray:
    """[rows, cols, 3] uint8 RGB."""
    found = cv2.imread(str(path))
    assert found is not None, path
    return found[..., ::-1]


def shown(folder: Path, directions: np.ndarray) -> np.ndarray:
    """[n, rows, cols, 3] what OpenLIME's shader (ShaderRTI, type rbf, colour space mrgb) sums up under lights, from the whole planes."""
    info = json.loads((folder / "info.json").read_text())
    assert (info["type"], info["colorspace"]) == ("rbf", "mrgb")
    lights, planes = np.reshape(info["lights"], (-1, 3)), info["nplanes"]
    [material] = info["materials"]
    basis = np.reshape(info["basis"], (planes + 1, len(lights), 3)).astype(float)
    added, mixed = basis[0] / 255, (basis[1:] - 127) / np.array(material["range"])[:, None, None]
    texels = np.concatenate([image(folder / f"plane_{number}.jpg") for number in range(planes // 3)], axis=-1) / 255
    values = (texels - material["bias"]) * material["scale"]
    found = []
    for direction in directions:
        weights = np.exp(-np.square(lights - direction).sum(axis=1) / info["sigma"] ** 2)
        weights /= weights.sum()
        weights[weights <= 0.001] = 0
        weights /= weights.sum()
        found.append(np.clip(values @ np.einsum("plc,l->pc", mixed, weights) + weights @ added, 0, 1))
    return np.array(found)


def tiles_joined(folder: Path, width: int, height: int, side: int = 256) -> np.ndarray:
    """[rows, cols, 3] the tiles of one level of a Deep Zoom image, side by side."""
    joined = np.zeros((height, width, 3), np.uint8)
    for row in range(-(-height // side)):
        for column in range(-(-width // side)):
            tile = image(folder / f"{column}_{row}.jpg")
            joined[row * side:row * side + len(tile), column * side:column * side + tile.shape[1]] = tile
            assert len(tile) == min(side, height - row * side) and tile.shape[1] == min(side, width - column * side)
    return joined
