"""Errors of the steps between parts on random layouts, ray cast and solved by `robust`: `python -m benchmarks.part_steps`.

The layouts are those of tests/scenes/parts.py: one or two parts before a body, with 2 % noise, 96 pixels a side. An error is that of the
step from a part to the body, each by its median over all of its true pixels, in parts of the true step between the part and what is seen
around it.
"""

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
from scipy import ndimage

from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve
from stage.results.maps import SurfaceMaps
from tests.scenes.parts import KINDS, Shot, random_layout, write_shot

SIDE = 96


def steps(shot: Shot, folder: Path) -> list[tuple[float, float | None]]:
    """Return the relative error of each step, and its error over σ, None where the report calls it unknown or the parts are joined."""
    solve(SolveRequest(capture=write_shot(folder / "capture", shot), out=folder / "out", method=Method.ROBUST, device="cpu"))
    maps, report = SurfaceMaps.read(folder / "out" / "maps.exr", unsure=True), json.loads((folder / "out" / "report.json").read_text())
    error, body, found = maps.height - shot.z, shot.part == shot.part.max(), []
    for part in range(shot.part.max()):
        mine = shot.part == part
        around = ndimage.binary_dilation(mine, iterations=2) & body
        wrong = float(np.median(error[mine]) - np.median(error[body]))
        label = 0 if maps.part is None else int(np.bincount(maps.part[mine].astype(int)).argmax())
        placed = report["parts"][label - 1] if label > 1 and label <= len(report["parts"]) else {}
        found.append((wrong / float(np.median(shot.z[mine]) - np.median(shot.z[around])),
                      abs(wrong) / placed["sigma"] if "sigma" in placed else None))
    return found


def main() -> None:
    """Print a row for each kind of layout."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, nargs=2, default=(21, 25), help="the first seed, and the one after the last")
    given = parser.parse_args()
    print("| | steps known | median, largest error of these | largest error/σ |\n|---|---|---|---|")
    for kind in KINDS:
        rows = []
        for seed in range(*given.seeds):
            with tempfile.TemporaryDirectory() as folder:
                rows += steps(random_layout(kind, seed).shoot(side=SIDE, seed=seed), Path(folder))
        known = np.array([row for row in rows if row[1] is not None], dtype=float).reshape(-1, 2)
        figures = (f"{100 * np.median(np.abs(known[:, 0])):.1f} %, {100 * np.abs(known[:, 0]).max():.1f} % | {known[:, 1].max():.1f}"
                   if len(known) else "– | –")
        print(f"| {kind} | {len(known)} of {len(rows)} | {figures} |", flush=True)


if __name__ == "__main__":
    main()
