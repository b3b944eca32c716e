"""Driven rigs: errors of the irradiance, against sampling an 8-bit panorama at the lamps, and seconds for a turning sky; python -m
benchmarks.drive prints the tables of docs/drive.md."""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy.optimize import nnls

from service.drive.drive import drive
from service.drive.judgement import XYZ
from service.requests.drive import DriveRequest
from stage.colour.colour import rgb_matrix
from stage.transforms import fibonacci_sphere
from tests.scenes.rigs import NORMALS, irradiance, lamps_irradiance, read_levels, rms, sampled, write_rig, write_sky

SKIES = ("sun", "overcast", "patches")
ROWS = 128
FULL = 4.0
"""Irradiance of every primary at full level."""


def chromaticity_rms(given: np.ndarray, wanted: np.ndarray, space: str) -> float:
    """Return the root mean square Δu'v' (CIE 1976) of irradiances [normals, 3]."""
    parts = []
    for light in (given, wanted):
        x, y, z = (light @ rgb_matrix(space, XYZ).T.astype(np.float64)).T
        parts.append(np.stack([4 * x, 9 * y], axis=1) / (x + 15 * y + 3 * z)[:, None])
    return float(np.sqrt(((parts[0] - parts[1]) ** 2).sum(axis=1).mean()))


def accuracy(folder: Path) -> None:
    print("| lamps | sky | irradiance, RMS | least possible | Δu'v', RMS | largest Δu'v' | with 8 bits | 8-bit panorama sampled |")
    print("|---|---|---|---|---|---|---|---|")
    for count in (331, 128, 32):
        directions = fibonacci_sphere(count)
        seen = np.maximum(NORMALS @ directions.T, 0)
        for kind in SKIES:
            radiance = write_sky(folder / "sky.exr", kind, rows=ROWS)
            truth = irradiance(radiance)
            errors = []
            for bits in (16, 8):
                rig = write_rig(folder / "rig.json", directions, irradiance=FULL, bits=bits)
                result = drive(DriveRequest(rig=folder / "rig.json", out=folder / "cues", environment=folder / "sky.exr", device="cpu",
                                            auto_exposure=True))
                given = lamps_irradiance(rig, read_levels(folder / "cues")[0]) / result.exposure
                errors.append(rms(given, truth))
                if bits == 16:
                    chromaticity = chromaticity_rms(given, truth, rig["color_space"]), result.judgement.chromaticity.max()
            best = np.stack([nnls(seen, truth[:, c], maxiter=50000)[0] for c in range(3)], axis=1)
            print(f"| {count} | {kind} | {errors[0]:.2%} | {rms(seen @ best, truth):.2%} | "
                  f"{chromaticity[0]:.4f} | {chromaticity[1]:.4f} | {errors[1]:.2%} | "
                  f"{rms(seen @ sampled(radiance, directions), truth):.1%} |")


def speed(folder: Path, frames: int) -> None:
    write_rig(folder / "rig.json", fibonacci_sphere(331), irradiance=FULL)
    write_sky(folder / "sky.exr", "sun", rows=ROWS)
    request = DriveRequest(rig=folder / "rig.json", out=folder / "cues", environment=folder / "sky.exr", device="cpu",
                           frames=f"1-{frames}", spin_degrees=360)
    drive(request.model_copy(update={"frames": "1"}))
    began = time.perf_counter()
    drive(request)
    print(f"\n{frames} frames, 331 lamps of three primaries, a map of {2 * ROWS} x {ROWS}: {time.perf_counter() - began:.1f} s")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        accuracy(Path(name))
        speed(Path(name), int(sys.argv[1]) if len(sys.argv) > 1 else 240)
