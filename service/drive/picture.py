"""The picture of a drive: the environment, what a mirror ball, a matte ball and a chart show under it and under the lamps."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from service.drive.chart_view import ChartView
from service.drive.judgement import far_irradiance, irradiance_of, lamp_irradiance
from service.relight.far_light import FarLight
from service.relight.sheet import BACKGROUND, display, write_sheet
from stage.colour.colour_spaces import Review
from stage.rig.rig import Rig

PICTURE_FILE = "preview.png"
MOST_ROWS = 3
"""The most frames that are shown; of more, evenly spaced ones are."""
ERROR_SCALE = 10.0
"""The factor on the difference of the matte balls."""
SAMPLE_ROWS = 32
"""The rows of the map that lights the matte ball."""
MAP_ROWS = 128
"""The most rows of the map before it is scaled."""
BALL = 112
"""The side of a ball before it is scaled to the height of the sheet, pixels."""
GREY = 0.5
"""The mean of the matte ball under the environment before the display transform."""
LAMP_COSINE = float(np.cos(np.radians(4.0)))
"""Half the width at which lamps are drawn."""


def write_picture(folder: Path, rig: Rig, far: Sequence[FarLight], level: np.ndarray, exposure: np.ndarray, titles: Sequence[str],
                  chart: ChartView | None, review: Review) -> Path:
    """Write the picture into a folder and return its path.

    Args:
        folder: it is there.
        rig: its lamps.
        far: the light of each frame.
        level: [frames, emitters] of `rig.emitters`, 0…1.
        exposure: [frames] factor on the light.
        titles: of the frames.
        chart: what it shows in each frame; None: there is none.
        review: the view through which colours are shown.
    """
    shown = np.linspace(0, len(far), min(MOST_ROWS, len(far)), endpoint=False).astype(int)
    rows = [_row(rig, far[index], level[index], exposure[index], titles[index], None if chart is None else chart.picture(index),
                 review)
            for index in shown]
    path = folder / PICTURE_FILE
    write_sheet(path, rows)
    return path


def _row(rig: Rig, light: FarLight, level: np.ndarray, exposure: float, title: str,
         chart: np.ndarray | None, review: Review) -> list[tuple[str, np.ndarray]]:
    energy = lamp_irradiance(level[None], rig)[0]
    normal, on_ball = _ball()
    wanted = far_irradiance(light, normal, SAMPLE_ROWS) * exposure
    given = irradiance_of(rig.directions, energy, normal)
    scale = GREY / max(float(wanted.mean()), np.finfo(float).tiny)
    reflected = 2 * normal[:, 2:] * normal - np.array([0.0, 0.0, 1.0])
    mirrored = np.zeros((len(normal), 3)) if light.environment is None else _looked_up(light, reflected) * exposure
    lamps = np.zeros((len(normal), 3))
    cosine = reflected @ rig.directions.T
    nearest = cosine.argmax(axis=1)
    seen = cosine.max(axis=1) >= LAMP_COSINE
    lamps[seen] = energy[nearest[seen]] / (2 * np.pi * (1 - LAMP_COSINE))

    def ball(values: np.ndarray) -> np.ndarray:
        picture = np.tile(BACKGROUND, (BALL, BALL, 1))
        picture[on_ball] = display((values * scale)[None].astype(np.float32), rig.color_space, review)[0]
        return picture

    tiles = [("mirror ball: environment", ball(mirrored * np.pi)), ("mirror ball: lamps", ball(lamps * np.pi)),
             ("matte ball: environment", ball(wanted)), ("matte ball: lamps", ball(given)),
             (f"{ERROR_SCALE:.0f} x difference", ball(np.abs(given - wanted) * ERROR_SCALE))]
    if chart is not None:
        tiles.append(("chart: environment, within it lamps", display((chart * scale).astype(np.float32), rig.color_space, review)))
    if light.environment is not None:
        step = -(-len(light.environment.radiance) // MAP_ROWS)
        shown = light.environment.radiance[::step, ::step] * (light.gain * exposure * scale * np.pi)
        tiles.insert(0, ("map", display(shown.astype(np.float32), rig.color_space, review)))
    return [(f"{title}: {tiles[0][0]}", tiles[0][1]), *tiles[1:]]


def _ball() -> tuple[np.ndarray, np.ndarray]:
    """Return the normals [pixels, 3] of a ball seen from +z, and the pixels [BALL, BALL] bool that show it."""
    across = (2 * np.arange(BALL) + 1) / BALL - 1
    x, y = np.meshgrid(across, -across)
    on_ball = x * x + y * y < 1
    return np.stack([x, y, np.sqrt(np.maximum(1 - x * x - y * y, 0))], axis=-1)[on_ball], on_ball


def _looked_up(light: FarLight, towards: np.ndarray) -> np.ndarray:
    """Return the radiance [n, 3] of the turned environment in directions [n, 3]."""
    assert light.environment is not None
    x, y, z = (towards @ light.rotation).T
    rows, columns = light.environment.radiance.shape[:2]
    column = (np.arctan2(x, -z) / (2 * np.pi) % 1 * columns).astype(int) % columns
    row = np.minimum((np.arccos(np.clip(y, -1, 1)) / np.pi * rows).astype(int), rows - 1)
    return light.environment.radiance[row, column].astype(np.float64) * light.gain
