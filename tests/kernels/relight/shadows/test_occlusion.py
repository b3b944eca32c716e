"""A block on a plane and the shadow that geometry gives it."""

import numpy as np
import pytest
import warp as wp

from kernels import device as devices
from kernels.errors import ArrayError
from kernels.relight.model.shading import upload_surface
from kernels.relight.shadows.occlusion import see_lights
from kernels.surface.shadows import MARGIN_PIXELS, MARGIN_SLOPE, Projection
from tests.reference.sampling import lattice

SIDE = 64
BLOCK = slice(20, 44), slice(40, 52)
"""Rows and columns."""
HEIGHT = 10.0
"""In pixels."""
EDGE = 40 - SIDE / 2
"""x of the block's left side, in pixels, from the middle of the picture."""
SAMPLED = 1.6
"""Pixels that the wall is later met than where it stands: its height is reached half a pixel inside, and the way is looked at once a pixel;
a tenth is the rounding."""
ALL = np.arange(SIDE * SIDE)


def block(base=0.0, pixel=1.0):
    height = np.full((SIDE, SIDE), base, np.float32)
    height[BLOCK] += HEIGHT * pixel
    return height


def flat(pixel=1.0):
    return Projection(False, wp.vec2(1 / pixel, 1 / pixel), wp.vec2(SIDE / 2, SIDE / 2))


def pinhole(focal):
    return Projection(True, wp.vec2(focal, focal), wp.vec2(SIDE / 2, SIDE / 2))


def seen(place, pixels, height, projection, device, mask=None):
    """[n, m] bool, and the rest of the last pack."""
    mask = np.ones(height.shape, np.uint8) if mask is None else mask.astype(np.uint8)
    got = see_lights(np.array(place, dtype=float), pixels, wp.array(height, dtype=wp.float32, device=device),
                     wp.array(mask, dtype=wp.uint8, device=device), projection, device=device).numpy()
    assert set(np.unique(got)) <= {0, 255}
    got = got.reshape(len(place), got.shape[1] * got.shape[2]) == 255
    return got[:, : len(pixels)], got[:, len(pixels) :]


def test_a_ball_hides_no_light_from_itself(device):
    """What it hides from pixels behind it is attached shadow, which says nothing of other lights."""
    radius = 0.4 * SIDE
    row, col = np.indices((SIDE, SIDE)) + 0.5 - SIDE / 2
    z = np.sqrt(np.maximum(radius**2 - row**2 - col**2, 0))
    mask = z > 0.1 * radius
    normal = np.stack([col, -row, z], axis=-1)[mask] / radius
    pixels, height, lights = np.flatnonzero(mask), wp.array(z.astype(np.float32), dtype=wp.float32, device=device), lattice(32, 120)
    count = len(pixels)
    surface = upload_surface(normal, np.ones((count, 3)), np.zeros((count, 3)), np.ones((count, 1)), np.tile([0.0, 0.0, 1.0], (count, 1)),
                             np.zeros((count, 3)), device=device)
    args = (np.pad(lights, ((0, 0), (0, 1))), pixels, height, wp.array(mask.astype(np.uint8), dtype=wp.uint8, device=device), flat())
    assert (see_lights(*args, surface=surface, device=device).numpy() == 255).all()
    behind = (lights @ normal.T < -0.1)
    alone = see_lights(*args, device=device).numpy().reshape(len(lights), -1)[:, :count]
    assert behind.mean() > 0.2 and (alone[behind] == 0).mean() > 0.8  # at the rim lines leave the picture at once


def far(*direction):
    return [*(np.array(direction) / np.linalg.norm(direction)), 0.0]


def dark_left(see):
    """Dark pixels of the middle row, left of the block; they must reach up to it."""
    row = ~see.reshape(SIDE, SIDE)[SIDE // 2, : BLOCK[1].start]
    length = int(row.sum())
    assert length == 0 or row[-length + 1 if length > 1 else -1 : -1].all()
    return length


def bounds(length):
    """Least and most dark pixels of a shadow whose length is a function of the place of the wall and its height, in pixels."""
    margin = MARGIN_PIXELS + MARGIN_SLOPE * length(EDGE, HEIGHT)
    return length(EDGE + SAMPLED, HEIGHT - margin), length(EDGE, HEIGHT) + 0.6


@pytest.mark.parametrize("tangent", [0.4, 0.7, 1.5])
@pytest.mark.parametrize("pixel", [1.0, 0.001])
def test_far_light_throws_a_shadow_of_its_slope(tangent, pixel, device):
    """h / tan e of the floor, in rows of the block only, and none on the other side or on top."""
    see, _ = seen([far(1, 0, tangent), far(-1, 0, tangent)], ALL, block(pixel=pixel), flat(pixel), device)
    least, most = bounds(lambda edge, top: EDGE - edge + top / tangent)
    assert least <= dark_left(see[0]) <= most
    dark = ~see.reshape(2, SIDE, SIDE)
    for picture in dark:
        assert not picture[BLOCK].any()
        assert not picture[: BLOCK[0].start - 1].any() and not picture[BLOCK[0].stop + 1 :].any()
    assert not dark[0, :, BLOCK[1].stop :].any() and not dark[1, :, : BLOCK[1].start].any() and dark[1].any()


@pytest.mark.parametrize("x, over", [(12.0, 5.0), (12.0, 15.0), (30.0, 25.0), (70.0, 70.0)])
@pytest.mark.parametrize("pixel", [1.0, 0.001])
def test_near_light_throws_a_shadow_from_its_place(x, over, pixel, device):
    """From x over z across the block's upper edge down to the floor: as far again beyond the edge as h / (z - h) of the way to it."""
    z = HEIGHT + over
    see, _ = seen([[x * pixel, 0, z * pixel, 1.0]], ALL, block(pixel=pixel), flat(pixel), device)
    least, most = bounds(lambda edge, top: EDGE - edge + (x - edge) * top / (z - top))
    assert least <= dark_left(see[0]) <= most
    assert not (~see.reshape(SIDE, SIDE))[BLOCK].any()


@pytest.mark.parametrize("focal", [30.0, 300.0])
@pytest.mark.parametrize("tangent", [0.5, 1.0])
def test_perspective(focal, tangent, device):
    """A floor at a depth at which a pixel is a unit wide there; the block's upper edge is nearer and so farther out, and its shadow begins
    where the ray from it meets the floor."""
    depth = focal
    see, _ = seen([far(1, 0, tangent)], ALL, block(base=-depth), pinhole(focal), device)
    # the wall is seen in the picture's column, on a ray that leans
    least, most = bounds(lambda edge, top: EDGE - (edge / focal * (depth - top) - top / tangent))
    assert least <= dark_left(see[0]) <= most


def test_perspective_near_light(device):
    focal = depth = 120.0
    x, over = 14.0, 10.0
    see, _ = seen([[x, 0, -depth + HEIGHT + over, 1.0]], ALL, block(base=-depth),
                  pinhole(focal), device)

    def length(edge, top):
        leaning = edge / focal * (depth - top)
        return EDGE - (leaning - (x - leaning) * top / (HEIGHT + over - top))

    least, most = bounds(length)
    assert least <= dark_left(see[0]) <= most


@pytest.mark.parametrize("perspective", [False, True])
def test_a_mirrored_scene_has_a_mirrored_shadow(perspective, device):
    """Left for right and top for bottom: pixels look from their centres. But for rounding where way and surface just meet."""
    base = -60.0 if perspective else 0.0
    projection = pinhole(60) if perspective else flat()
    height = block(base=base)
    height[8:14, 10:50] += 6
    places = np.random.default_rng(0).uniform([-25, -25, base + 8, 1], [25, 25, base + 20, 1], (40, 4))
    expected = seen(places, ALL, height, projection, device)[0].reshape(-1, SIDE, SIDE)
    for axis, mirror in ((2, [-1, 1, 1, 1]), (1, [1, -1, 1, 1])):
        got, _ = seen(places * mirror, ALL, np.flip(height, axis - 1).copy(), projection, device)
        assert (np.flip(got.reshape(-1, SIDE, SIDE), axis) != expected).sum() <= 4
    assert 0.02 < np.mean(~expected) < 0.5


@pytest.mark.parametrize("perspective", [False, True])
def test_a_light_before_the_block_is_seen_from_all_of_the_floor_before_it(perspective, device):
    """Low and in line with the block: light from as low behind it is hidden."""
    base = -200.0 if perspective else 0.0
    projection = pinhole(200) if perspective else flat()
    place = [[EDGE - 3.0, 0, base + 1.0, 1.0], [EDGE + 30.0, 0, base + 1.0, 1.0]]
    see, _ = seen(place, ALL, block(base=base), projection, device)
    floor = see.reshape(2, SIDE, SIDE)[:, SIDE // 2 - 2 : SIDE // 2 + 2, : BLOCK[1].start - 5]
    assert floor[0].all() and not floor[1].any()


def test_the_rest_of_the_block_is_behind_its_own_wall(device):
    """A light beside the block, lower than its top: the floor on the other side does not see it, nor the top but at its rim."""
    see, _ = seen([[EDGE - 6.0, 0, 4.0, 1.0]], ALL, block(), flat(), device)
    beyond = see.reshape(SIDE, SIDE)[SIDE // 2, BLOCK[1].stop + 1 : BLOCK[1].stop + 8]
    assert not beyond.any()


def test_light_along_the_line_of_sight_is_always_seen(device):
    assert seen([far(0, 0, 1)], ALL, block(), flat(), device)[0].all()


def test_what_is_not_surface_hides_nothing(device):
    mask = np.ones((SIDE, SIDE), bool)
    mask[BLOCK] = False
    assert seen([far(1, 0, 0.7)], ALL, block(), flat(), device, mask)[0].all()


def test_rows_are_lights_and_columns_pixels_in_the_order_given(device):
    lights = [far(1, 0, 0.5), far(-1, 0.3, 0.7), [3.0, 10.0, 20.0, 1.0], far(0, 1, 0.5), [EDGE - 3.0, 0, 1.0, 1.0]]
    whole, _ = seen(lights, ALL, block(), flat(), device)
    some = np.random.default_rng(0).permutation(ALL)[:101]
    got, _ = seen(lights[::-1], some, block(), flat(), device)
    np.testing.assert_array_equal(got, whole[::-1, some])
    assert got.any(axis=1).all() and not got.all()


@pytest.mark.parametrize("count", [1, 33])
def test_the_last_pack_is_filled_with_the_last_pixel(count, device):
    lights = [far(1, 0, 0.5), far(-1, 0, 0.5)]
    last = 32 * SIDE + 36  # in the first light's shadow
    got, rest = seen(lights, np.append(ALL[: count - 1], last), block(), flat(), device)
    assert rest.shape[1] == -count % devices.pack_width(device)
    assert rest.shape[1] and not rest[0].any() and rest[1].all() and not got[0, -1]


def test_no_light_has_no_rows(device):
    got, _ = seen(np.zeros((0, 4)), ALL[:40], block(), flat(), device)
    assert got.shape == (0, 40)


@pytest.mark.parametrize("pixels", [[], [-1, 3], [0, SIDE * SIDE]])
def test_positions_outside_the_picture_are_refused(pixels, device):
    with pytest.raises(ArrayError, match="pixels must be positions from 0 to 4095, one or more"):
        seen([far(1, 0, 1)], np.array(pixels, dtype=int), block(), flat(), device)


def test_what_lies_within_the_thickness_of_a_part_hides_light(device):
    """Lines to a lamp that stands level run 5 pixels behind the front of a plate: a plate of 4 pixels lets them pass, one of 6 does not,
    and neither does one of which nothing is known but that it is the wall's own part."""
    height, part = block(), np.ones((SIDE, SIDE), np.uint8)
    part[BLOCK] = 2
    place = [[1000.0, 0.0, HEIGHT - 5, 1.0]]
    pixels = SIDE // 2 * SIDE + np.arange(36, 39)  # left of the plate, where the wall is raised so that lines are level
    height[:, :39] = HEIGHT - 5
    args = (wp.array(height, dtype=wp.float32, device=device), wp.array(part, dtype=wp.uint8, device=device), flat())
    for thickness, hidden in ((4.0, False), (6.0, True), (None, False)):
        given = None if thickness is None else wp.array(np.full(height.shape, thickness), dtype=wp.float32, device=device)
        got = devices.to_numpy(see_lights(np.array(place), pixels, *args, thickness=given, device=device)).reshape(1, -1)[:, :3]
        assert (got == (0 if hidden else 255)).all(), thickness
    alone = seen(place, pixels, height, flat(), device)[0]
    assert not alone.any()
