"""Horizons against lights that are marched to, and against the shadow that geometry gives a block."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from kernels.errors import ArrayError
from kernels.relight.shadows.horizon import AZIMUTHS, Azimuths, azimuths_of, find_horizons, height_field, see_above
from kernels.relight.shadows.occlusion import see_lights
from kernels.surface.shadows import Projection
from tests.kernels.relight.surfaces import facing, upload
from tests.reference.shading import Pixels

SIDE = 72
FOCAL = 160.0


def bumps(seed=0):
    """Smooth hills of up to 20 pixels, on a round mask."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:SIDE, :SIDE]
    height = sum(rng.uniform(4, 16) * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / rng.uniform(30, 120))
                 for cx, cy in rng.uniform(10, SIDE - 10, (9, 2)))
    return height.astype(np.float32), (x - SIDE / 2) ** 2 + (y - SIDE / 2) ** 2 < 33**2


def seen(directions, height, mask, projection, device, *, azimuths=None):
    """By horizons and by marching, [n, m] bool each, of pixels that face every light."""
    pixels = np.flatnonzero(mask)
    rows, cols = np.divmod(pixels, SIDE)
    z = height.reshape(-1)[pixels]
    far = -z if projection.perspective else np.ones(len(pixels))
    points = np.stack([(cols + 0.5 - SIDE / 2) / projection.scale[0] * far, (SIDE / 2 - rows - 0.5) / projection.scale[1] * far, z], axis=1)
    sight = points[:, :2] / points[:, 2:] if projection.perspective else np.zeros((1, 2))
    flat = facing(len(pixels))._asdict() | {"position": points.astype(np.float32)}
    surface = upload(Pixels(**flat), device)
    field = height_field(height, mask, projection, device)
    horizons = find_horizons(azimuths_of(directions, sight) if azimuths is None else azimuths, pixels, surface, field)
    got = see_above(directions, surface, horizons).numpy().reshape(len(directions), -1)[:, : len(pixels)]
    marched = see_lights(np.concatenate([directions, np.zeros((len(directions), 1))], axis=1), pixels,
                         wp.array(np.where(mask, height, 0), dtype=wp.float32, device=device),
                         wp.array(mask.astype(np.uint8), dtype=wp.uint8, device=device), projection, device=device)
    return got == 255, marched.numpy().reshape(len(directions), -1)[:, : len(pixels)] == 255


def at(azimuth, elevation):
    return np.stack([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], axis=-1)


FLAT = Projection(False, wp.vec2(1.0, 1.0), wp.vec2(SIDE / 2, SIDE / 2))
PINHOLE = Projection(True, wp.vec2(FOCAL, FOCAL), wp.vec2(SIDE / 2, SIDE / 2))
STEPS = 2 * np.pi / AZIMUTHS


@pytest.mark.parametrize("seed", [0, 1])
def test_in_its_directions_it_is_the_march(seed, device):
    """Half rounding of the horizon alone, which no pixel of these comes near; where the march is all light, so are horizons."""
    height, mask = bumps(seed)
    directions = at(np.array([7, 91, 200, 333]) * STEPS, np.array([0.5, 0.3, 0.7, 0.15]))
    got, marched = seen(directions, height, mask, FLAT, device)
    assert (~marched).mean(axis=1).min() > 0.01
    assert (got != marched).mean() < 1e-3


@pytest.mark.parametrize("projection", [FLAT, PINHOLE], ids=["orthographic", "perspective"])
def test_between_them_shadows_move_little(projection, device):
    """Edges of shadows lie within half a step, a pixel at most here, of where they are: a few pixels in a hundred."""
    height, mask = bumps(2)
    if projection.perspective:
        height = height / FOCAL - 1.2
    directions = at(np.array([0.113, 1.71, 3.99, 5.5]), np.array([0.4, 0.6, 0.25, 0.5]))
    got, marched = seen(directions, height, mask, projection, device)
    assert (~marched).mean(axis=1).min() > 0.01
    assert (got != marched).mean(axis=1).max() < 0.02
    assert abs(got.mean() - marched.mean()) < 0.003  # either way alike


def test_light_along_the_line_of_sight_is_seen(device):
    height, mask = bumps(3)
    got, _ = seen(np.array([[0, 0, 1.0], at(0.3, 1.565)]), height, mask, FLAT, device)
    assert got.all()


def test_a_wall_hides_what_is_lower_than_it(device):
    """A wall 10 pixels high: from 12 pixels before it, light below a slope of 10/12 is hidden, to the margins of the march."""
    height = np.zeros((SIDE, SIDE), np.float32)
    height[:, 40:] = 10
    mask = np.ones(height.shape, dtype=bool)
    slopes = np.array([0.5, 0.7, 0.95, 1.2])
    got, _ = seen(at(np.zeros(4), np.arctan(slopes)), height, mask, FLAT, device)
    assert got.reshape(4, SIDE, SIDE)[:, SIDE // 2, 28].tolist() == [False, False, True, True]
    assert got.reshape(4, SIDE, SIDE)[:, SIDE // 2, 45:68].all()


def test_more_lights_do_not_change_what_is_seen_of_one(device):
    """Horizons are told apart over a wider range of slopes then; shadows move less than between directions."""
    height, mask = bumps(4)
    few = at(np.array([2.113]), np.array([0.4]))
    many = at(np.full(20, 2.113), np.linspace(0.05, 1.3, 20))
    alone, _ = seen(few, height, mask, FLAT, device)
    among, _ = seen(few, height, mask, FLAT, device, azimuths=azimuths_of(many, np.zeros((1, 2))))
    assert (alone != among).mean() < 0.01


@pytest.mark.long
@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 1000), spread=st.floats(0, 0.4), lights=st.integers(1, 6))
def test_azimuths_hold_every_light_as_every_pixel_sees_it(seed, spread, lights):
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=(lights, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    sight = rng.uniform(-spread, spread, (50, 2))
    found = azimuths_of(direction, sight)
    assert (np.diff(found.index) > 0).all() and (found.low < found.high).all()
    row = {index: place for place, index in enumerate(found.index)}
    flat = direction[:, None, :2] - direction[:, None, 2:] * sight
    slope = direction[:, 2:] / np.linalg.norm(flat, axis=2)
    place = np.floor(np.arctan2(flat[..., 1], flat[..., 0]) / STEPS).astype(int)
    for towards, rise in zip(place.reshape(-1), slope.reshape(-1), strict=True):
        for index in (towards % AZIMUTHS, (towards + 1) % AZIMUTHS):
            assert found.low[row[index]] < min(rise, 9e3) and found.high[row[index]] > min(rise, 9e3)


def test_horizons_of_other_pixels_are_refused(device):
    height, mask = bumps()
    field = height_field(height, mask, FLAT, device)
    surface, other = upload(facing(100), device), upload(facing(300), device)
    horizons = find_horizons(Azimuths(np.arange(2), np.zeros(2), np.ones(2)), np.flatnonzero(mask)[:100], surface, field)
    with pytest.raises(ArrayError, match="give the same pixels"):
        see_above(np.array([[0.9, 0.01, 0.3]]), other, horizons)
