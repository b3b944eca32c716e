"""docs/chart.png: what relit calibrate chart finds in a rendered chart under tungsten light, whose green patch glares.

`make screenshots` draws it.
"""

import shutil
import tempfile
from pathlib import Path

import numpy as np

from service.calibrate.chart import calibrate_chart
from service.requests.chart import ChartRequest
from tests.scenes.chart import CAMERA, Pose, picture, reflectances, shoot

TUNGSTEN = (1.3, 1.0, 0.45)
"""What the camera reads of white."""
GREEN = (slice(236, 262), slice(236, 268))
"""Rows and columns of part of the green patch."""


def main() -> None:
    """Calibrate the chart in a temporary folder, and keep the picture."""
    pixels = picture(0.5 * np.array(TUNGSTEN) * (reflectances() @ CAMERA.T), Pose(15, -11, 3, 10, -8, 700)).pixels
    pixels[GREEN] += 0.1
    with tempfile.TemporaryDirectory() as name:
        folder = shoot(Path(name), [pixels])
        calibrate_chart(ChartRequest(capture=folder))
        shutil.copyfile(folder / "chart.png", Path(__file__).parents[1] / "chart.png")


if __name__ == "__main__":
    main()
