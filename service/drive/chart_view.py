"""A colour chart that faces the camera, as it looks under the environment and under the lamps."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from service.drive.judgement import far_irradiance
from service.relight.far_light import FarLight
from stage.rig.chart import ChartReadings
from stage.rig.rig import Rig

FACING = np.array([[0.0, 0.0, 1.0]])
"""The normal of the chart, in the camera frame."""
PATCH, INSET = 24, 6
"""The side of a patch in the picture, and the width of its rim, pixels."""
ASPECT = 1.5
"""The width of the chart over its height in patches, as of a chart of 6 by 4."""


class ChartView(NamedTuple):
    """Readings of the patches, over those of the brightest one under white light of irradiance 1, float64."""

    wanted: np.ndarray  # [frames, patches, 3] under the environment
    given: np.ndarray  # [frames, patches, 3] under the lamps

    @property
    def rms(self) -> np.ndarray:
        """Return [frames] the root mean square difference of the patches, over that of the readings under the environment."""
        scale = np.maximum(np.sqrt((self.wanted**2).mean(axis=(1, 2))), np.finfo(float).tiny)
        return np.asarray(np.sqrt(((self.given - self.wanted) ** 2).mean(axis=(1, 2))) / scale)

    def picture(self, frame: int) -> np.ndarray:
        """Return scene-linear values [rows, cols, 3]: the patches under the environment, and within each the same under the lamps."""
        count = self.wanted.shape[1]
        across = int(np.ceil(np.sqrt(count * ASPECT)))
        sheet = np.zeros((-(-count // across) * PATCH, across * PATCH, 3))
        for patch in range(count):
            row, column = (PATCH * place for place in divmod(patch, across))
            sheet[row : row + PATCH, column : column + PATCH] = self.wanted[frame, patch]
            sheet[row + INSET : row + PATCH - INSET, column + INSET : column + PATCH - INSET] = self.given[frame, patch]
        return sheet


def view_chart(
    chart: ChartReadings,  # its readings under each primary at full level and normal incidence, and under white light
    rig: Rig, far: Sequence[FarLight],
    level: np.ndarray,  # [frames, emitters] of `rig.emitters`, 0…1
    exposure: np.ndarray,  # [frames] factor on the light
) -> ChartView:
    """Return how a chart looks in each frame."""
    readings = np.concatenate([chart.of(lamp) for lamp in rig.lights])  # [emitters, patches, 3]
    facing = np.maximum(rig.directions[[lamp for lamp, _ in rig.emitters]] @ FACING[0], 0)
    irradiance = np.concatenate([far_irradiance(light, FACING) for light in far]) * exposure[:, None]
    white = chart.target[chart.target.sum(axis=1).argmax()]
    return ChartView(irradiance[:, None] * chart.target / white, np.einsum("fe,ejk->fjk", level * facing, readings) / white)
