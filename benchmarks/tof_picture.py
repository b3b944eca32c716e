"""Time of flight as one picture, docs/tof.png: depth, error, confidence and wraps, with and without vote and filters; and histograms.

    python -m benchmarks.tof_picture
"""

import tempfile
from pathlib import Path

import numpy as np

from benchmarks.pictures import heat
from kernels.status import Status, refuse_unsure
from service.depth.tof.tof import solve_tof
from service.relight.sheet import write_sheet
from service.reporting.progress import Timings
from service.requests.depth import TofOptions
from stage.capture.camera import Camera
from stage.capture.capture import Capture
from stage.tof.light_time import SPEED_OF_LIGHT
from stage.tof.simulate import (
    CorrelationCamera,
    HistogramCamera,
    TofScene,
    correlation_images,
    histograms,
    write_correlations,
    write_histograms,
)
from tests.reference.tof import room

TARGET = Path(__file__).parents[1] / "docs" / "tof.png"
ROWS, COLS, FARTHEST_M, ERROR_M = 96, 128, 12.0, 0.05
STATUS_COLOURS = {Status.OK: (0.12, 0.3, 0.5), Status.LOW_MODULATION: (0, 0, 0), Status.FLYING: (1, 0.3, 0.1),
                  Status.MULTIPATH: (0.9, 0.8, 0.1), Status.UNSURE: (0.7, 0.2, 0.8)}


def main() -> None:
    """Simulate a room with mixed edges, weakly lit, solve it several ways and write the picture."""
    view = room(ROWS, COLS)
    scene = TofScene(range_m=view.distance, albedo=view.albedo, cosine=view.cosine)
    fine = room(4 * ROWS, 4 * COLS)
    camera = Camera(projection="perspective", resolution=(COLS, ROWS), focal_px=(110, 110))
    random = np.random.default_rng(0)
    sensor = CorrelationCamera(modulation_hz=(50e6, 60e6), signal_electrons=1.2e4, ambient_electrons=60)
    mixed = correlation_images(TofScene(range_m=fine.distance, albedo=fine.albedo, cosine=fine.cosine), sensor)
    mean = mixed.reshape(len(mixed), ROWS, 4, COLS, 4).mean(axis=(2, 4))  # a pixel sees both sides of an edge
    images = random.poisson(mean) + random.normal(0, sensor.read_noise_electrons, mean.shape)
    middle = np.median(fine.distance.reshape(ROWS, 4, COLS, 4), axis=(1, 3))
    counter = HistogramCamera(pulses=2000)
    everything = np.ones((ROWS, COLS), dtype=bool)

    def shown(values: np.ndarray, full: float) -> np.ndarray:
        return heat(10 * values / full, everything)

    def solve(folder: str, **options: object) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        solved = solve_tof(Capture.open(folder), TofOptions.model_validate(options), device="cpu", timings=Timings())
        assert solved.range_m is not None and solved.confidence is not None
        refuse_unsure(solved.status, solved.sigma, solved.confidence, max_sigma=None, least_confidence=solved.least_confidence)
        return solved.range_m, solved.confidence, solved.status, solved.solved

    rows = []
    with tempfile.TemporaryDirectory() as first, tempfile.TemporaryDirectory() as second:
        write_correlations(first, "room", images, camera, sensor)
        write_histograms(second, "room", histograms(scene, counter, random), camera, counter)
        for title, folder, options in (("cw, each pixel alone", first, {"vote": False}), ("cw, with the vote", first, {}),
                                       ("cw, vote, flying, bilateral", first, {"filters": "flying,bilateral"}), ("pulsed", second, {})):
            range_m, confidence, status, ok = solve(folder, **options)
            error = np.where(ok, np.abs(range_m - (middle if folder is first else view.distance)), 0)
            codes = np.zeros((ROWS, COLS, 3))
            for code, colour in STATUS_COLOURS.items():
                codes[status == code] = colour
            wraps = np.where(ok, np.floor(range_m / (SPEED_OF_LIGHT / 2 / 60e6)), 0)
            rows.append([(title, shown(range_m, FARTHEST_M)), (f"error, 0 to {1000 * ERROR_M:.0f} mm", shown(error, ERROR_M)),
                         ("confidence", np.repeat(confidence[..., None], 3, axis=-1)),
                         ("wraps of 60 MHz" if folder is first else "range in steps of 2.5 m", shown(wraps, 5)), ("status", codes)])
    write_sheet(TARGET, rows, height=3 * ROWS // 2)


if __name__ == "__main__":
    main()
