"""A sequence with a part at rest and a ball that crosses it: errors of the steps alone and joined, as a picture, docs/sequences.png.

Black is 0, orange 4 degrees or more; the mean is that of every pixel.

    python -m benchmarks.sequence_picture
"""

import tempfile
from pathlib import Path

import numpy as np

from benchmarks.accuracy import angles_deg
from benchmarks.pictures import heat
from service.relight.sheet import write_sheet
from service.requests.solve import Method, SolveRequest
from service.sequences.run import solve_sequence
from service.sequences.steps import ALONE
from stage.results.maps import MAPS_FILE, SurfaceMaps
from tests.scenes.sequence import write_sequence

TARGET = Path(__file__).parents[1] / "docs" / "sequences.png"
SIZE, NOISE = 120, 0.02
PLACES: list[float | None] = [22.0 + 9 * step for step in range(8)]
SHOWN = (1, 7)
LARGEST = 4.0
"""Error in degrees that is shown as the brightest."""


def main() -> None:
    """Solve the sequence and write the picture."""
    rows = []
    with tempfile.TemporaryDirectory() as work:
        folder = Path(work)
        moments = write_sequence(folder / "in", PLACES, noise=NOISE, size=SIZE)
        solve_sequence(SolveRequest(capture=folder / "in", out=folder / "out", method=Method.ROBUST, device="cpu"))
        for step in SHOWN:
            out = folder / "out" / f"step{step:02d}"
            joined, alone = SurfaceMaps.read(out / MAPS_FILE), SurfaceMaps.read(out / ALONE / MAPS_FILE)
            assert joined.normal is not None and joined.sigma is not None
            row = [(f"step {step + 1}, normals", ((joined.normal + 1) / 2).astype(np.float32))]
            for name, maps in (("alone", alone), ("joined", joined)):
                assert maps.normal is not None
                error = angles_deg(maps.normal, moments[step].normal)
                row.append((f"{name}: {error.mean():.2f}°", heat(error * 10 / LARGEST, maps.mask)))
            sigma = joined.sigma.astype(np.float64)
            row.append((f"sigma of joined: {sigma.mean():.2f}°", heat(sigma * 10 / LARGEST, joined.mask)))
            rows.append(row)
    write_sheet(TARGET, rows)


if __name__ == "__main__":
    main()
