"""relit depth on translucent things, whose light runs below the surface: σ holds what that makes and a sentence names it.

Neither appears on matt things that are textured, dark or out of focus. The light runs by other laws than the one that chose the factors.
"""

import numpy as np
import pytest

from stage.patterns.binary import binary_patterns
from stage.patterns.phase import micro_patterns, phase_patterns
from tests.scenes.depth import depth_of
from tests.scenes.projected import Ball, Light, Rig, Wall, World, trace, write_capture

pytestmark = pytest.mark.long
RIG = Rig(camera=(120, 90), camera_focal=156.0, projector=(192, 144), projector_focal=252.0)
SHAPES = (Wall((0, 0, -1.4), (0.3, -0.2, 1), 0.6, texture=0.4), Ball((-0.1, 0.05, -1.1), 0.16, 0.7, texture=0.6))
PATTERNS = {"waves": phase_patterns("column", (16, 18, 21), 4),
            "wave and Gray": (*phase_patterns("column", (16,), 4), *binary_patterns(RIG.projector[0], "column", stripe_px=8)),
            "wave and binary": (*phase_patterns("column", (16,), 4),
                                *binary_patterns(RIG.projector[0], "column", code="binary", stripe_px=8)),
            "micro": micro_patterns(RIG.projector[0], "column")}
WORDS = "below the surface"


@pytest.fixture(scope="module")
def light():
    """The light of the scene, which every capture of it shares."""
    return trace(World(shapes=SHAPES, rig=RIG))


def solve(folder, seen, patterns, **world):
    """Return the error over σ of the solved pixels, and whether the sentence is said."""
    world = World(shapes=SHAPES, rig=RIG, **world)
    write_capture(folder, world, patterns, light=seen)
    found = depth_of(folder, read_noise=world.read_noise, photon_gain=1 / world.electrons)
    maps, known = found.maps, found.maps.mask & np.isfinite(seen.depth)
    return np.abs(maps.depth - seen.depth)[known] / maps.sigma[known], any(WORDS in text for text in found.warnings)


@pytest.mark.parametrize("name", PATTERNS)
@pytest.mark.parametrize(("scattered", "scatter_px", "flights"), [(0.5, 4.0, 2), (0.3, 8.0, 3), (0.7, 2.0, 2), (0.3, 5.0, 1)])
def test_light_below_the_surface_is_in_sigma_and_said(tmp_path, light, name, scattered, scatter_px, flights):
    off, said = solve(tmp_path, light, PATTERNS[name], scattered=scattered, scatter_px=scatter_px, flights=flights)
    # 0.67 where σ is right; without what the lag tells it is 6 to 9, and above 1.4 a result claims more than it knows
    assert said and np.median(off) < 1.4 and (off > 5).mean() < 0.01


@pytest.mark.parametrize(("name", "world"), [("waves", {"blur_px": 1.5}), *(
    (name, world) for name in PATTERNS for world in ({}, {"blur_px": 2.0}, {"light": 0.3}, {"read_noise": 0.006, "electrons": 2500.0}))])
def test_matt_things_have_neither(tmp_path, light, name, world):
    off, said = solve(tmp_path, light, PATTERNS[name], **world)
    assert not said and 0.4 < np.median(off) < 1.1


TILT = 1.0
"""Angle in radians between the axis of the camera and the normal of either wall: the walls make 66°."""
FOLD = Rig(camera=(90, 64), camera_focal=120.0, projector=(192, 144), projector_focal=252.0)
"""It looks into the crease between the two walls."""


def fold(albedo: float) -> Light:
    """Return the light of two matt walls, each of which sends much of what it reflects to the other: the first bounce, by patches."""
    rig, across, toward = FOLD, np.sin(TILT), np.cos(TILT)
    seen = trace(World(shapes=[Wall((0, 0, -1.3), (side * across, 0, toward), albedo) for side in (1, -1)], rig=rig))
    width, height = rig.camera
    row, col = np.divmod(np.arange(width * height), width)
    ray = np.stack([(col + 0.5 - width / 2) / rig.camera_focal, -(row + 0.5 - height / 2) / rig.camera_focal, -np.ones(len(row))], axis=1)
    point = ray * seen.depth.reshape(-1, 1)
    normal = np.where(point[:, :1] < 0, 1, -1) * np.array([across, 0, 0]) + np.array([0, 0, toward])
    light, u, v = (np.bincount(seen.pixel, seen.weight * each, len(row)) for each in (1, seen.u, seen.v))
    patch = np.flatnonzero((row % 4 == 2) & (col % 3 == 1) & (light > 0))
    facing = -(ray * normal).sum(axis=1) / np.linalg.norm(ray, axis=1)
    area = 12 * (seen.depth.ravel() / rig.camera_focal) ** 2 / (facing / np.linalg.norm(ray, axis=1))
    way = point[None, patch] - point[:, None]
    square = (way**2).sum(axis=2)
    cosines = np.maximum((way * normal[:, None]).sum(axis=2), 0) * np.maximum(-(way * normal[patch]).sum(axis=2), 0)
    weight = albedo / np.pi * light[patch] * area[patch] * cosines / np.maximum(square, 1e-9) / np.maximum(square, area[patch])
    pixel, of = np.nonzero(weight > 1e-5)
    place = patch[of]
    return seen._replace(pixel=np.concatenate([seen.pixel, pixel]), u=np.concatenate([seen.u, (u / np.maximum(light, 1e-9))[place]]),
                         v=np.concatenate([seen.v, (v / np.maximum(light, 1e-9))[place]]),
                         weight=np.concatenate([seen.weight, weight[pixel, of]]))


def test_much_of_the_light_that_bounces_in_a_fold_is_in_sigma(tmp_path):
    seen, world = fold(0.8), World(shapes=(), rig=FOLD, read_noise=0.001, electrons=60000.0, bits=16)
    write_capture(tmp_path, world, PATTERNS["waves"], light=seen)
    maps = depth_of(tmp_path, read_noise=world.read_noise, photon_gain=1 / world.electrons).maps
    off = np.abs(maps.depth - seen.depth)[maps.mask] / maps.sigma[maps.mask]
    # 0.015; without what the lags of single places tell it is 0.064
    assert maps.mask.mean() > 0.95 and (off > 5).mean() < 0.03
