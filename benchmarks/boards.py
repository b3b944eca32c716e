"""Inspection of simulated boards: error of stitching, defects found and false alarms, in units of the σ that the noise of the phase leaves.

`python -m benchmarks.boards` prints the tables of docs/inspection.md; `--picture FILE` writes its picture too.
"""

import argparse
import csv
import shutil
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from service.boards.inspect_board import inspect_board
from service.boards.stitching.grid import blocks_of, robust_sigma
from service.boards.stitching.stitching import blend, stitch
from service.boards.tiles import read_tiles
from service.reporting.progress import Timings
from service.requests.inspect_board import InspectBoardRequest
from stage.errors import BoardError
from tests.scenes.board import PIXEL, SIGMA, Heights, components, domes, scan, write_scan

SIDE, STEP, ACROSS, DOWN = (160, 180), (1.5e-3, 1.3e-3), 3, 2
"""Tiles of 180 x 160 pixels that overlap by 30."""
BOARDS = 10
SIDES = (3, 5, 9)
"""Sides of the planted defects in pixels, each once up and once down."""


class Scene(NamedTuple):
    """A kind of board."""

    name: str
    surface: Callable[[], Heights]
    options: Mapping[str, Any] = MappingProxyType({})


SCENES = (
    Scene("solder domes", lambda: domes(5.5e-3, 3.6e-3, seed=11)),
    Scene("domes, tiles turned by 0.02° and tilted by 0.3°", lambda: domes(5.5e-3, 3.6e-3, seed=12), {"turn": 3.5e-4, "tilt": 5e-3}),
    Scene("domes of one pitch and height", lambda: domes(5.5e-3, 3.6e-3, seed=13, jitter=0.0)),
    Scene("warped by 200 µm, a tenth of the pixels missing", lambda: domes(5.5e-3, 3.6e-3, seed=14, bow=2e-4), {"missing": 0.1}),
    Scene("components with vertical walls, else flat", lambda: components(5e-3, 3.3e-3, seed=15)),
    Scene("a flat board", lambda: lambda x, y: 0 * x),
)


def planted(surface: Heights, seed: int) -> tuple[Heights, list[tuple[float, float, int]]]:
    """A surface with a square of each size up and one down by 5 σ, and their middles and sides."""
    rng = np.random.default_rng(seed)
    places = [(x, y) for y in (-8e-4, 0.0, 8e-4) for x in (-1.6e-3, -0.8e-3, 0.0, 0.8e-3, 1.6e-3)]
    chosen = rng.permutation(len(places))[: 2 * len(SIDES)]
    squares = [(places[k][0] + rng.uniform(-1, 1) * 1e-4, places[k][1] + rng.uniform(-1, 1) * 1e-4, side)
               for k, side in zip(chosen, SIDES * 2, strict=True)]

    def at(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        out = surface(x, y)
        for number, (px, py, side) in enumerate(squares):
            inside = (np.abs(x - px) < side / 2 * PIXEL) & (np.abs(y - py) < side / 2 * PIXEL)
            out = out + (5 * SIGMA if number < len(SIDES) else -5 * SIGMA) * inside
        return out

    return at, squares


def inspected(surface: Heights, folder: Path, seed: int, scene: Scene, golden: Path | None) -> list[dict[str, str]]:
    """Measure a board, inspect it and return the lines of its table."""
    shutil.rmtree(folder, ignore_errors=True)
    views = scan(surface, across=ACROSS, down=DOWN, side=SIDE, step=STEP, seed=seed, **scene.options)
    write_scan(folder, views, stage_sigma_m=2 * PIXEL)
    inspect_board(InspectBoardRequest(board=folder, golden=golden, out=folder / "out", device="cpu"))
    if golden is None:
        return []
    with open(folder / "out" / "findings.csv", newline="") as table:
        return list(csv.DictReader(table))


def stitching(scene: Scene) -> str:
    """One line of the table of stitching errors: against the truth, less place, rotation and plane of the whole board."""

    surface = scene.surface()
    with tempfile.TemporaryDirectory() as name:
        views = scan(surface, across=ACROSS, down=DOWN, side=SIDE, step=STEP, seed=3, **scene.options)
        tiles = read_tiles(write_scan(Path(name), views), device=None, cache=None, progress=Timings()).tiles
    stitched = stitch(tiles, shift_sigma_m=2 * PIXEL)
    heights = blend(tiles, stitched, stitched.grid)
    told, true, own = np.array([view.told for view in views]), np.array([view.true for view in views]), stitched.motions.values
    spin = np.stack([-told[:, 1], told[:, 0]], axis=1)
    turn = float(np.median(own[:, 2] / stitched.length_m - true[:, 2]))
    apart = own[:, :2] + own[:, 2:3] / stitched.length_m * spin - true[:, :2] - turn * spin
    dx, dy = np.median(apart, axis=0)
    x, y = heights.grid.coordinates(*np.mgrid[: heights.grid.rows, : heights.grid.cols])
    error = heights.height - surface(x - dx + turn * y, y - dy - turn * x)
    there = np.isfinite(error)
    basis = np.stack([np.ones(int(there.sum())), x[there], y[there]], axis=1)
    error[there] -= basis @ np.linalg.lstsq(basis, error[there], rcond=None)[0]
    means = blocks_of(error).mean(axis=(2, 3))
    means = means[np.isfinite(means)]
    shift = float(np.sqrt(np.mean(np.square(apart - np.median(apart, axis=0))))) / PIXEL
    return (f"| {scene.name} | {robust_sigma(error[there]) / SIGMA:.2f} | {robust_sigma(means) / SIGMA:.2f} | "
            f"{np.percentile(np.abs(means), 99) / SIGMA:.2f} | {shift:.3f} |")


def detection(scene: Scene, boards: int, keep: Path | None) -> str:
    """One line of the table of defects: those found by side, and the false alarms on boards with and without defects."""
    surface = scene.surface()
    found, alarms, beside, refused = dict.fromkeys(SIDES, 0), 0, 0, 0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        inspected(surface, folder / "golden", 1, scene, None)
        golden = folder / "golden" / "out"
        for number in range(boards):
            try:
                rows = inspected(surface, folder / "good", 100 + number, scene, golden)
                faulty, squares = planted(surface, number)
                defects = [row for row in inspected(faulty, folder / "bad", 200 + number, scene, golden) if row["kind"] == "defect"]
            except BoardError:
                refused += 1
                continue
            alarms += any(row["kind"] == "defect" for row in rows)
            places = np.array([[float(row["x_m"]), float(row["y_m"])] for row in defects]).reshape(-1, 2)
            own = np.zeros(len(places), dtype=bool)
            for x, y, side in squares:
                near = np.hypot(*(places - (x, y)).T) < (side / 2 + 6) * PIXEL
                found[side] += bool(near.any())
                own |= near
            beside += int((~own).sum())
            if keep is not None and number == 0:
                shutil.copy(folder / "bad" / "out" / "inspection.png", keep)
    judged = boards - refused
    cells = " | ".join(f"{found[side]} of {2 * judged}" for side in SIDES)
    return f"| {scene.name} | {cells} | {alarms} of {judged} | {beside} | {refused} of {boards} |"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--boards", type=int, default=BOARDS)
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    print("| board | pixel / σ | mean of 16 x 16 / σ | its 99th percentile / σ | shift of tiles, px |\n|---|---|---|---|---|")
    for scene in SCENES:
        print(stitching(scene), flush=True)
    heads = " | ".join(f"{side} x {side} px" for side in SIDES)
    print(f"\n| board | {heads} | good boards with an alarm | alarms beside defects | refused |\n|---|{'---|' * len(SIDES)}---|---|---|")
    for number, scene in enumerate(SCENES):
        print(detection(scene, arguments.boards, arguments.picture if number == 0 else None), flush=True)


if __name__ == "__main__":
    main()
