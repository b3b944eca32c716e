"""The light of the frames of a drive: environments and discs, shared out over the lamps as `relit relight` weighs captured images; and a
colour chart that faces the camera, as it looks under the environment and under the lamps.
"""

from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple

import numpy as np

from kernels.relight.model.beyond import share_beyond
from service.drive.judgement import Judgement, environment_samples, far_irradiance, judge, texel_directions
from service.relight.environments import EnvironmentMap, Environments
from service.relight.far_light import FarLight, far_light
from service.relight.lighting import RUN, shared_energy
from service.relight.schedule import ScheduledFrame
from service.reporting.progress import Timings
from service.requests.drive import Beyond, DriveRequest
from stage.rig.chart import ChartReadings
from stage.rig.rig import Rig
from stage.transforms import fibonacci_sphere

BEYOND_ROWS = 64
"""The rows of the map by which light is measured that comes from where no lamp stands."""
PROBES = 4096
"""The number of directions in which lamps are looked for, to tell whether there is such a place."""
FACING = np.array([[0.0, 0.0, 1.0]])
"""The normal of the chart, in the camera frame."""
PATCH, INSET = 24, 6
"""The side of a patch in the picture, and the width of its rim, pixels."""
ASPECT = 1.5
"""The width of the chart over its height in patches, as of a chart of 6 by 4."""


class Light(NamedTuple):
    """The light of all frames, before its exposure."""

    far: list[FarLight]
    energy: np.ndarray  # [frames, lights, 3] that each lamp is to give
    beyond: np.ndarray  # [frames] part of the energy from where no lamp stands
    stops: np.ndarray  # [frames] exposure of each frame by the light keys


def collect_light(scheduled: Sequence[ScheduledFrame], environments: Environments | None, rig: Rig, request: DriveRequest, device: str,
           timings: Timings) -> Light:
    """Return the light of all frames, shared out over the lamps."""
    far: list[FarLight] = []
    energy, beyond = [], []
    for _, group in groupby(scheduled, key=lambda frame: None if frame.environment is None else frame.environment.path):
        members = list(group)
        for begin in range(0, len(members), RUN):
            run = [far_light(frame, environments, rig.color_space) for frame in members[begin : begin + RUN]]
            beyond.append(_beyond(run, rig))
            if request.beyond is Beyond.DROP:
                given = np.concatenate([shared_energy([_within(light, rig)], rig.directions, weighting=request.weights,
                                                      device=device) for light in run])
            else:
                given = shared_energy(run, rig.directions, weighting=request.weights, device=device)
            energy.append(given)
            far += run
            timings.advance(len(far))
    stops = np.array([frame.exposure_stops for frame in scheduled]) - request.exposure
    return Light(far, np.concatenate(energy), np.concatenate(beyond), stops)


def _beyond(run: Sequence[FarLight], rig: Rig) -> np.ndarray:
    """Return the part of the energy of each frame that comes from where no lamp stands."""
    environment = run[0].environment
    found = np.zeros(len(run))
    if not share_beyond(rig.directions, fibonacci_sphere(PROBES)).any():
        return found
    direction, energy = (np.zeros((0, 3)), np.zeros((0, 3))) if environment is None else environment_samples(environment, BEYOND_ROWS)
    for index, light in enumerate(run):
        towards = np.concatenate([direction @ light.rotation.T, *(disc.direction[None] for disc in light.discs)])
        amount = np.concatenate([energy.sum(axis=1) * light.gain, [disc.irradiance.sum() for disc in light.discs]])
        found[index] = share_beyond(rig.directions, towards) @ amount / max(amount.sum(), np.finfo(float).tiny)
    return found


def _within(light: FarLight, rig: Rig) -> FarLight:
    """Return the light of a frame without what comes from where no lamp stands."""
    discs = tuple(disc._replace(irradiance=disc.irradiance * (1 - share_beyond(rig.directions, disc.direction[None])[0]))
                  for disc in light.discs)
    if light.environment is None:
        return light._replace(discs=discs)
    radiance = light.environment.radiance
    rows, columns = radiance.shape[:2]
    kept = np.empty_like(radiance)
    for row, angle in enumerate(np.pi * (np.arange(rows) + 0.5) / rows):
        direction = texel_directions(np.array([angle]), columns)[0]
        kept[row] = radiance[row] * (1 - share_beyond(rig.directions, direction @ light.rotation.T))[:, None]
    return light._replace(environment=EnvironmentMap(kept), discs=discs)


def judge_all(light: Light, level: np.ndarray, rig: Rig, exposure: np.ndarray) -> Judgement:
    """Return the error of all frames, run by run of one environment."""
    found, begin = [], 0
    for _, group in groupby(light.far, key=lambda far: id(far.environment)):
        run = list(group)
        part = slice(begin, begin := begin + len(run))
        found.append(judge(run, level[part], rig, exposure[part]))
    return Judgement(*(np.concatenate(values) for values in zip(*found, strict=True)))


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
