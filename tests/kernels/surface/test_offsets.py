"""Offsets of parts from cast shadows: the march against brute force, and the likelihood against what made the readings."""

import numpy as np
import pytest
import warp as wp

from kernels.errors import ArrayError
from kernels.photometric.shadows.shadow_evidence import LARGEST_ODDS, shadow_odds
from kernels.surface.offsets import GROUPS, choose_offset, march_part, weigh_offsets
from kernels.surface.shadows import Projection, extent_of

SIDE = 40
RISE = 9.0
"""Height of the block before the floor."""
THICK = 3.0
"""Guessed thickness."""


def block(rise=RISE, hole=False):
    """A floor and a block before it, or one with a hole, [rows, cols] heights and parts."""
    part = np.zeros((SIDE, SIDE), np.int32)
    part[14:24, 16:28] = 1
    part[17:21, 19:25] = 0 if hole else 1
    return np.where(part == 1, rise, 0).astype(np.float32), part


def lights(count=24):
    turn = np.arange(count) * 2 * np.pi / count
    slope = np.where(np.arange(count) % 2, 1.0, 0.6)
    toward = np.stack([np.cos(turn), np.sin(turn), slope], axis=1)
    return toward / np.linalg.norm(toward, axis=1, keepdims=True)


def march(height, part, device, perspective=False, far=0.0, thick=THICK, box=None):
    pixels = np.argwhere(part >= 0)
    scale = far if perspective else 1.0
    projection = Projection(perspective, wp.vec2(scale, scale), wp.vec2(SIDE / 2, SIDE / 2))
    box = box or extent_of(np.zeros(part.shape), part == 1).box
    found = march_part(wp.array(pixels.astype(np.int32), dtype=wp.vec2i, device=device),
                       wp.array(lights().astype(np.float32), dtype=wp.vec3, device=device),
                       wp.array(height, dtype=float, device=device), wp.array(part, dtype=wp.int32, device=device),
                       wp.array(np.full_like(height, thick), dtype=float, device=device), 1, box, projection)
    return pixels, found


@pytest.mark.parametrize("perspective", [False, True])
def test_paths_that_pass_by_the_part_are_not_followed(perspective, device):
    """As if the part filled the picture, where gaps and shadows count: to the last bit."""
    height, part = block()
    part[:, 34:], part[:3] = 2, -1
    height = height + 12 * (part == 2) - 60 * perspective  # a wall throws shadows too, and few lines of sight are parallel
    short, long = (march(height.astype(np.float32), part, device, perspective, 60.0, box=box)[1]
                   for box in (None, wp.vec4i(0, 0, SIDE - 1, SIDE - 1)))
    met = long.highest.numpy() > -1e29
    assert 0.02 < met.mean() < 0.5 and 0 < short.hidden.numpy()[~met].sum() < long.hidden.numpy()[~met].sum()
    for one, other in zip(short[:3], long[:3], strict=True):
        np.testing.assert_array_equal(one.numpy(), other.numpy())
    np.testing.assert_array_equal(short.hidden.numpy()[met], long.hidden.numpy()[met])


@pytest.mark.parametrize("hole", [False, True])
@pytest.mark.parametrize("perspective", [False, True])
def test_one_march_tells_the_shadows_at_every_offset(perspective, hole, device):
    """Shadows of a block that stands anywhere before the floor, marched once where it lies, against a march where it was moved to.

    In perspective it moves by growing about the eye. Tolerance: where a gap is within a hundredth of a pixel of the ray, rounding decides.
    """
    far = 400.0
    height, part = block(hole=hole)
    if perspective:
        height = height - far
    found = march(height, part, device, perspective, far)[1]
    open_to = found.opening.numpy().astype(np.float64)
    assert (np.ptp(open_to, axis=2) > 0.5 / (far if perspective else 1)).any() == hole
    assert not found.hidden.numpy().any()  # neither the floor nor the block hides a light from itself
    on = (part.reshape(-1) == 1)[:, None]
    for offset in (-4.0, 3.0, 20.0):
        told = -np.log((far - offset) / far) if perspective else offset
        moved = np.where(part == 1, height * np.exp(-told) if perspective else height + offset, height).astype(np.float32)
        again = march(moved, part, device, perspective, far)[1]
        wide = np.ptp(open_to, axis=2) > 0
        np.testing.assert_array_equal(wide, np.ptp(again.opening.numpy(), axis=2) > 0)
        shift = np.broadcast_to(np.where(on, -told, told), wide.shape)[wide][:, None]
        assert np.abs(open_to[wide] + shift - again.opening.numpy()[wide]).max(initial=0) < (2e-5 if perspective else 1e-3)
        for here, there in zip(found[:3], again[:3], strict=True):
            here, there = here.numpy(), there.numpy()
            met = np.abs(there) < 1e29
            assert np.array_equal(met, np.abs(here) < 1e29)
            expected = here + np.where(on, -told, told)
            assert np.abs(expected - there)[met].max() < (2e-5 if perspective else 1e-3)


def test_light_passes_through_a_hole(device):
    """A plate with a hole before a floor: each ray meets the plate where it crosses its plane, or passes through the hole or beside it.

    Tolerance: rays that cross the plane within .8 of a pixel of an edge are not judged, since the march looks at nearest pixels there.
    """
    height, part = block(hole=True)
    pixels, found = march(height, part, device, thick=0.0)
    low, high = (values.numpy() for values in (found.lowest, found.highest))
    opening = found.opening.numpy()
    toward, floor = lights().astype(np.float64), part[tuple(pixels.T)] == 0
    plate = part == 1
    sure, through = 0, 0
    for offset in (-3.0, 0.0, 6.0):
        hidden = (low + offset < 0) & (high + offset > 0) & ~((opening[..., 0] + offset < 0) & (opening[..., 1] + offset > 0))
        along = (RISE + offset) / toward[:, 2]
        col, row = pixels[:, 1, None] + along * toward[:, 0], pixels[:, 0, None] - along * toward[:, 1]
        inside = (row > 1) & (row < SIDE - 2) & (col > 1) & (col < SIDE - 2) & floor[:, None]
        met = [plate[np.clip(np.rint(row + down), 0, SIDE - 1).astype(int), np.clip(np.rint(col + right), 0, SIDE - 1).astype(int)]
               for down in (-0.8, 0, 0.8) for right in (-0.8, 0, 0.8)]
        judged = inside & (np.all(met, axis=0) | ~np.any(met, axis=0))
        np.testing.assert_array_equal(hidden[judged], met[4][judged])
        sure += judged.sum()
        through += (judged & (low + offset < 0) & (high + offset > 0) & ~hidden).sum()
    assert through > 100 and sure > 1000


def test_the_march_refuses_parts_of_another_shape(device):
    height, part = block()
    with pytest.raises(ArrayError, match="one of each for every pixel"):
        march(height[:-1], part, device)


def evidence(true_rise, device, *, errors=0.0, reach=30.0):
    """Readings of a block at another height than it is taken to be, as one of the guessed thickness hides them; a part of them is wrong."""
    height, part = block()
    pixels, found = march(height, part, device)
    truth = march(*block(true_rise), device)[1]
    odds = np.where((truth.highest.numpy() > 0) & (truth.back.numpy() < 0), LARGEST_ODDS, -LARGEST_ODDS)
    rng = np.random.default_rng(0)
    odds = np.where(rng.random(odds.shape) < errors, -odds, odds)
    group = np.arange(24) * GROUPS // 24
    return weigh_offsets(found, odds, part[tuple(pixels.T)] == 1, group, reach=reach, blur=0.7)


@pytest.mark.parametrize("rise", [4.0, 9.0, 18.0])
@pytest.mark.parametrize("errors", [0.0, 0.1])
def test_the_offset_of_a_block_is_found(rise, errors, device):
    """To a pixel, the sampling of a ray; the true offset lies within three of its standard deviations."""
    offset = choose_offset(evidence(rise, device, errors=errors), least_sigma=0.5)
    assert abs(offset.offset - (rise - RISE)) < 1.0
    assert abs(offset.offset - (rise - RISE)) < 3 * offset.sigma and offset.sigma < 2.0
    assert offset.low - 0.5 <= offset.offset <= offset.high + 0.5


def test_readings_without_evidence_leave_the_offset_open(device):
    height, part = block()
    pixels, found = march(height, part, device)
    flat = weigh_offsets(found, np.zeros(found.highest.shape), part[tuple(pixels.T)] == 1, np.arange(24) % GROUPS, reach=30.0,
                         blur=0.7)
    offset = choose_offset(flat, least_sigma=0.5)
    assert (offset.low, offset.high) == (-30.0, 30.0)


def test_contradicting_lights_leave_the_offset_open(device):
    """Half of the lights show the block 5 pixels nearer, the other half 5 pixels farther: no offset between is ruled out."""
    near, far = evidence(RISE + 5, device), evidence(RISE - 5, device)
    mixed = near._replace(gain=np.where(np.arange(GROUPS)[:, None] % 2 == 0, near.gain, far.gain))
    offset = choose_offset(mixed, least_sigma=0.5)
    assert offset.low < -4 and offset.high > 4 and offset.sigma > 2


@pytest.mark.parametrize("telling", [1, 2])
def test_groups_of_unequal_evidence_confirm_each_other_and_one_alone_confirms_nothing(telling, device):
    """Most of the evidence in two groups of lights, as where a body lies on one side of a part. It agrees, and was taken for contradiction.

    Where a group has all of the evidence the step stays open, but it is told that shadows fall across.
    """
    share = np.where(np.arange(GROUPS) < telling, 1.0, 0.05 * (telling - 1))[:, None]
    found = evidence(18.0, device)
    offset = choose_offset(found._replace(gain=found.gain * share, expected=found.expected * share), least_sigma=0.5)
    assert offset.agreed_high - offset.agreed_low < 4.0  # pixels
    assert (offset.high - offset.low < 4.0) == (telling == 2)


def test_gaps_are_neither_too_large_nor_too_small_in_the_mean(device):
    """Rays from a floor under a steep plane, against the plane itself; the nearest pixels alone were wrong by 0.5 of a pixel in the mean.

    Tolerance: a fifth of a pixel, because rays that cross less than three pixels of the plane miss what lies between these and its outline.
    """
    part = np.zeros((SIDE, SIDE), np.int32)
    part[10:30, 10:30] = 1
    row, col = np.indices(part.shape)
    pixels, found = march(np.where(part == 1, 20 + 0.9 * row + 0.4 * col, 0).astype(np.float32), part, device, thick=0.0)
    along, errors = np.arange(0.0, 60.0, 0.02), []
    for light, way in enumerate(lights() / np.hypot(*lights()[:, :2].T)[:, None]):
        for at in np.flatnonzero((part == 0)[tuple(pixels.T)])[::17]:
            r, c = pixels[at][0] - along * way[1], pixels[at][1] + along * way[0]
            on = (np.abs(r - 19.5) < 10) & (np.abs(c - 19.5) < 10)
            if on.sum() * 0.02 > 5:
                gap = (20 + 0.9 * r + 0.4 * c - along * way[2])[on]
                errors.append((found.highest.numpy()[at, light] - gap.max(), found.lowest.numpy()[at, light] - gap.min()))
    assert np.abs(np.mean(errors, axis=0)).max() < 0.2


def test_odds_speak_only_where_a_lit_reading_would_be_bright(device):
    """Dark where light is expected: shadow. Dark on a metal whose highlight is elsewhere, or away from the light: nothing.

    Brighter than the material explains is no shadow; whether it is lit, such a reading does not say.
    """
    toward = np.array([[0.0, 0.0, 1.0], [0.8, 0.0, 0.6], [1.0, 0.0, 0.0]])
    one = np.ones((4, 1))
    normal, view = one * [[0.0, 0.0, 1.0]], one * [[0.0, 0.0, 1.0]]
    paint, metal = [0.6, 0.04, 0.5], [0.0, 0.8, 0.3]
    material = np.array([paint, paint, paint, metal])
    lit = 0.6 / np.pi * np.array([1.0, 0.6, 0.0])
    readings = np.array([[0.005, 0.005, 0.0], lit, 3 * lit, [0.9, 0.0, 0.0]])
    odds = shadow_odds(readings, toward, normal, view, material, device=device)
    assert (odds[0, :2] > 1).all() and (odds[1, :2] < -1).all() and (odds[2, :2] <= 0).all()
    assert (odds[:, 2] == 0).all() and odds[3, 1] == 0
    with pytest.raises(ArrayError, match="one direction per light"):
        shadow_odds(readings[:, :2], toward, normal, view, material, device=device)
