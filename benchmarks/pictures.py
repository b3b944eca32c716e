"""Error maps of the glossy test objects as one picture, docs/errors.png: captured, true normals, and the errors of the methods.

    python -m benchmarks.pictures DIR      DIR holds glossy and glossy_metal of samples/make_glossy.py
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.accuracy import angles_deg, read_truth
from service.relight.sheet import write_sheet
from service.requests.solve import Method, SolveRequest
from service.solve.solve import solve
from stage.capture.capture import Capture
from stage.formats import exr

TARGET = Path(__file__).parents[1] / "docs" / "errors.png"
FULL_SCALE_DEG = 10.0
FRAME = "012.exr"
HEAT = np.array([[0.02, 0.02, 0.06], [0.1, 0.25, 0.65], [0.15, 0.7, 0.6], [0.95, 0.85, 0.25], [0.95, 0.3, 0.15]])
"""The colours of 0, 2.5, 5, 7.5 and 10 degrees."""


def heat(error: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return the colours of angles in degrees, black outside the mask."""
    at = np.clip(error / FULL_SCALE_DEG, 0, 1) * (len(HEAT) - 1)
    colours = np.stack([np.interp(at, np.arange(len(HEAT)), channel) for channel in HEAT.T], axis=-1)
    return np.where(mask[..., None], colours, 0)


def main() -> None:
    """Solve both objects with every method and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    rows = []
    for name, title in (("glossy", "dielectric"), ("glossy_metal", "metal")):
        capture, truth = Capture.open(folder / name), read_truth(folder / name / "truth.exr")
        mask = capture.mask()
        channels, _ = exr.read(folder / name / FRAME)
        captured = np.stack([channels[c] for c in "RGB"], axis=-1).astype(np.float64)
        shown = np.clip(captured / np.percentile(captured[mask], 99), 0, 1) ** (1 / 2.2)
        row = [(title, shown), ("true normals", np.where(mask[..., None], 0.5 + 0.5 * truth["normal"], 0))]
        for method in (Method.LAMBERT, Method.ROBUST, Method.SVBRDF):
            with tempfile.TemporaryDirectory() as out:
                maps = solve(SolveRequest(capture=folder / name, out=Path(out), method=method, cache=Path(out))).maps
            assert maps.normal is not None
            error = angles_deg(maps.normal, truth["normal"])
            row.append((f"{method}: mean {error[mask].mean():.2f}°, 0 to {FULL_SCALE_DEG:g}°", heat(error, mask)))
        rows.append(row)
    write_sheet(TARGET, rows)


if __name__ == "__main__":
    main()
