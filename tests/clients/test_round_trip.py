"""A metal ball before a painted one: true maps, opened as they are imported, and compared with the path tracer.

Validators pass an asset whose metals are black; a picture does not.
"""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.clients.by_hand import write_by_hand
from benchmarks.clients.comparison import Comparison, compare
from benchmarks.clients.render import Client, Environment, render, trace
from stage.camera import Camera
from tests.clients.programs import require
from tests.clients.scenes import DIELECTRIC_F0, PAINT, STEEL, ball_arrays, ball_maps, uneven

pytestmark = pytest.mark.long

CAMERA = Camera(projection="orthographic", resolution=(64, 64), pixel_size_m=0.2 / 64)
LIGHT = Environment(uneven())
MOST_ERROR = {Client.BLENDER: 0.30, Client.MITSUBA: 0.30, Client.THREE: 0.45}
"""Relative RMSE. The mesh ends at the centres of the outermost pixels and has no back; three.js has no shadows."""


@pytest.fixture(scope="module")
def maps():
    return ball_maps(CAMERA, (PAINT, STEEL))


@pytest.fixture(scope="module")
def truth():
    require(Client.MITSUBA)
    return trace(ball_arrays((PAINT, STEEL)), CAMERA, LIGHT, samples=256)[..., :3]


def figures(client, asset, truth, maps) -> Comparison:
    picture = render(client, asset, CAMERA, LIGHT, samples=64)
    return compare(picture, truth, maps[0].mask, maps[1])


def test_maps_written_by_hand_come_near_the_path_tracer(client, maps, truth, tmp_path):
    found = figures(client, write_by_hand(maps[0], tmp_path, "hand", metal=maps[1]), truth, maps)
    assert 0.9 < found.metal < 1.1
    assert 0.9 < found.dielectric < 1.1
    assert 0.9 < found.scale < 1.1, "one irradiance gives one radiance everywhere"
    assert found.rmse < MOST_ERROR[client]


def test_a_black_metal_is_seen(maps, truth, tmp_path):
    """What the specular workflow gave: F0 is lost, and what is left is the reflection of a dielectric."""
    black = replace(maps[0], specular=np.full_like(maps[0].specular, DIELECTRIC_F0))
    found = figures(Client.MITSUBA, write_by_hand(black, tmp_path, "black", metal=np.zeros_like(maps[1])), truth, maps)
    assert found.metal < 0.5
