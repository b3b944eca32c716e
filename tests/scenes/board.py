"""Synthetic boards with a known truth: a height function over the board, seen tile by tile, with noise in units of the phase noise."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import OpenEXR

PIXEL = 1e-5
SIGMA = 1e-6
"""Standard deviation of a height, which the noise of the phase leaves: 1 µm."""

Heights = Callable[[np.ndarray, np.ndarray], np.ndarray]


class View(NamedTuple):
    """One tile: where it is, where the stage says that it is, and what it measured."""

    true: np.ndarray  # [6] x, y, rotation in radians, offset, slopes
    told: tuple[float, float]
    height: np.ndarray  # [rows, cols] metres, NaN where missing


def domes(width: float, height: float, *, seed: int = 0, pitch: float = 3e-4, jitter: float = 0.5, bow: float = 0.0) -> Heights:
    """Solder domes on a flat board with random sizes and places; `jitter` 0 makes them periodic and alike."""
    rng = np.random.default_rng(seed)
    xs, ys = (np.arange(-length / 2 + pitch / 2, length / 2, pitch) for length in (width, height))
    px, py = (values.ravel() for values in np.meshgrid(xs, ys))
    px, py = px + jitter * pitch / 2 * rng.uniform(-1, 1, px.size), py + jitter * pitch / 2 * rng.uniform(-1, 1, px.size)
    radius = 0.3 * pitch * (1 + 0.5 * jitter * rng.uniform(-1, 1, px.size))
    tall = 6e-5 * (1 + jitter * rng.uniform(-0.5, 0.5, px.size))

    def at(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        flat = np.zeros(x.shape)
        for k in range(px.size):
            near = (np.abs(x - px[k]) < radius[k]) & (np.abs(y - py[k]) < radius[k])
            if near.any():
                square = ((x[near] - px[k]) ** 2 + (y[near] - py[k]) ** 2) / radius[k] ** 2
                flat[near] = np.maximum(flat[near], tall[k] * np.clip(1 - square, 0, None))
        return flat + bow * ((x / width) ** 2 + 0.5 * (y / height) ** 2 - 0.3 * x * y / (width * height))

    return at


def look(surface: Heights, *, side: tuple[int, int], told: tuple[float, float], true: np.ndarray, rng: np.random.Generator,
         sigma: float = SIGMA, missing: float = 0.0, pixel: float = PIXEL) -> View:
    """A tile of side = (rows, cols) pixels whose centre the stage believes at `told`, and which lies at told + true."""
    rows, cols = side
    u, v = (np.arange(cols) + 0.5 - cols / 2) * pixel, (rows / 2 - np.arange(rows) - 0.5) * pixel
    x, y = np.meshgrid(u, v)
    dx, dy, turn, offset, slope_x, slope_y = true
    bx, by = told[0] + dx + np.cos(turn) * x - np.sin(turn) * y, told[1] + dy + np.sin(turn) * x + np.cos(turn) * y
    height = surface(bx, by) + offset + slope_x * x + slope_y * y + sigma * rng.standard_normal(x.shape)
    height[rng.random(x.shape) < missing] = np.nan
    return View(np.asarray(true), told, height)


def scan(surface: Heights, *, across: int, down: int, side: tuple[int, int], step: tuple[float, float], seed: int = 1,
         stage: float = 1.5 * PIXEL, turn: float = 0.0, tilt: float = 5e-4, offset: float = 2e-5, **options: Any) -> list[View]:
    """Tiles of a board row by row, `step` metres apart, with random errors of the stage."""
    rng = np.random.default_rng(seed)
    views = []
    for j in range(down):
        for i in range(across):
            told = ((i - (across - 1) / 2) * step[0], ((down - 1) / 2 - j) * step[1])
            true = np.array([*stage * rng.standard_normal(2), turn * rng.standard_normal(), offset * rng.standard_normal(),
                             *tilt * rng.standard_normal(2)])
            views.append(look(surface, side=side, told=told, true=true, rng=rng, **options))
    return views


def write_depth(path: Path, height: np.ndarray, *, pixel: float = PIXEL, sigma: float = SIGMA, distance: float = 0.1) -> None:
    """depth.exr of an orthographic camera that looks along -z from z = distance; written from the contract with OpenEXR alone."""
    path.parent.mkdir(parents=True, exist_ok=True)
    mask = np.isfinite(height)
    camera = {"projection": "orthographic", "resolution": [height.shape[1], height.shape[0]], "pixel_size_m": pixel}
    channels = {"depth.Z": np.where(mask, distance - height, 0).astype(np.float32), "mask.Y": mask.astype(np.float16),
                "sigma.Z": np.where(mask, sigma, 0).astype(np.float32)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "relit:camera": json.dumps(camera),
              "relit:capture": path.parent.name, "relit:inputs": "simulated"}
    OpenEXR.File(header, channels).write(str(path))


def write_scan(folder: Path, views: list[View], *, sigma: float = SIGMA, pixel: float = PIXEL, **changes: Any) -> Path:
    """A folder with board.json and one depth result for each tile."""
    tiles = []
    for number, view in enumerate(views):
        write_depth(folder / f"tile_{number:02d}" / "depth.exr", view.height, sigma=sigma, pixel=pixel)
        tiles.append({"path": f"tile_{number:02d}", "position_m": list(view.told)})
    (folder / "board.json").write_text(json.dumps({"schema": "relit.board-scan/1", "name": "board", "tiles": tiles, **changes}))
    return folder


def components(width: float, height: float, *, seed: int = 0, count: int = 14, tall: float = 3e-4) -> Heights:
    """Boxes with vertical walls, turned at random, on a flat board with a thin trace; between them there is no relief."""
    rng = np.random.default_rng(seed)
    boxes = [(rng.uniform(-width / 2, width / 2), rng.uniform(-height / 2, height / 2), rng.uniform(1e-4, 3e-4), rng.uniform(5e-5, 2e-4),
              rng.uniform(0, np.pi), tall * rng.uniform(0.3, 1)) for _ in range(count)]

    def at(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        out = 1e-5 * (np.abs(y - 0.2 * x) < 4e-5)
        for px, py, half_x, half_y, turn, top in boxes:
            u = np.cos(turn) * (x - px) + np.sin(turn) * (y - py)
            v = np.cos(turn) * (y - py) - np.sin(turn) * (x - px)
            out = np.where((np.abs(u) < half_x) & (np.abs(v) < half_y), top, out)
        return out

    return at
