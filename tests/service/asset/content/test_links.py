"""Which pixels lie on one surface, and heights that stand off it are put back."""

import dataclasses

import numpy as np
import pytest
from scipy import ndimage

from service.asset.content.links import ISLAND_PIXELS, Links, joined, surface_links, touched, without_islands
from service.asset.content.mesh import height_mesh
from service.asset.content.repair import repair_heights
from service.errors import AssetError
from stage.capture.camera import Camera
from stage.results.maps import SurfaceMaps
from tests.scenes.surfaces import make_sheet

SIZE = 64
ORTHOGRAPHIC = Camera(projection="orthographic", resolution=(SIZE, SIZE), pixel_size_m=0.01)
PERSPECTIVE = Camera(projection="perspective", resolution=(SIZE, SIZE), focal_px=(200.0, 200.0), surface_z_m=-2.0)
cameras = pytest.mark.parametrize("camera", [ORTHOGRAPHIC, PERSPECTIVE], ids=["orthographic", "perspective"])
REPAIRED_ORTHOGRAPHIC = Camera(projection="orthographic", resolution=(80, 60), pixel_size_m=0.002)
REPAIRED_PERSPECTIVE = Camera(projection="perspective", resolution=(80, 60), focal_px=(150.0, 160.0), surface_z_m=-0.4)
repaired_cameras = pytest.mark.parametrize("camera", [REPAIRED_ORTHOGRAPHIC, REPAIRED_PERSPECTIVE], ids=["orthographic", "perspective"])


def ball_before_a_wall(camera: Camera, gap_px: float) -> tuple[SurfaceMaps, np.ndarray]:
    """A ball of 20 pixels' radius whose limb stands gap_px before a tilted wall, and where the ball is; ray cast, no layer `part`."""
    x, y = camera.plane_coordinates()
    distance, pixel = (0.0, 0.01) if camera.projection == "orthographic" else (-2.0, 0.01)
    radius = 20 * pixel
    wall = np.array([0.3, -0.2, 1]) / np.linalg.norm([0.3, -0.2, 1])
    if camera.projection == "orthographic":
        z_ball = np.sqrt(np.maximum(radius**2 - x**2 - y**2, 0))
        hit = x**2 + y**2 < radius**2
        z_wall = -gap_px * pixel - radius * 0.5 - (wall[0] * x + wall[1] * y) / wall[2]
    else:
        ray = np.stack([x, y, np.full_like(x, -1)], axis=-1)
        centre = np.array([0, 0, distance])
        b, a, c = ray @ centre, (ray**2).sum(-1), centre @ centre - radius**2
        hit = b**2 > a * c
        z_ball = -(b - np.sqrt(np.maximum(b**2 - a * c, 0))) / a
        z_wall = -((wall @ np.array([0, 0, distance - gap_px * pixel - radius * 0.5])) / (ray @ wall))
    z = np.where(hit, z_ball, z_wall)
    points = camera.points(z).astype(np.float64)
    normal = np.where(hit[..., None], (points - [0, 0, distance]) / radius, wall)
    return SurfaceMaps(camera=camera, mask=np.ones(hit.shape, bool), height=z.astype(np.float32), normal=normal.astype(np.float32)), hit


def missing(links: Links) -> list[np.ndarray]:
    return [~links.right, ~links.down]


def edges(region: np.ndarray) -> list[np.ndarray]:
    return [region[:, 1:] != region[:, :-1], region[1:] != region[:-1]]


@cameras
@pytest.mark.parametrize("gap_px", [20, 40])
def test_breaks_are_found_without_a_part_layer(camera, gap_px):
    maps, ball = ball_before_a_wall(camera, gap_px)
    grazing = maps.normal[..., 2] < np.cos(np.radians(85))  # single pixels on the very limb, whose normals support any step
    links = surface_links(maps, maps.mask & ~grazing)
    assert grazing.sum() < 12
    for found, true, inside in zip(missing(links), edges(ball), missing(surface_links(flat(maps), maps.mask & ~grazing)), strict=True):
        np.testing.assert_array_equal(found, true | inside)


def flat(maps: SurfaceMaps) -> SurfaceMaps:
    """The maps with one height and one normal everywhere: what is not linked there is not in the mask."""
    return dataclasses.replace(maps, height=np.full_like(maps.height, -1), normal=np.broadcast_to(np.float32([0, 0, 1]), maps.normal.shape))


@cameras
def test_a_limb_stays_whole_although_its_normals_are_wrong_by_degrees(camera):
    maps, ball = ball_before_a_wall(camera, 40)
    rng = np.random.default_rng(0)
    normal = maps.normal + rng.normal(size=maps.normal.shape) * np.radians(4)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    links = surface_links(dataclasses.replace(maps, normal=normal.astype(np.float32), mask=ball), ball)
    assert links.right.sum() == (ball[:, 1:] & ball[:, :-1]).sum()
    assert links.down.sum() == (ball[1:] & ball[:-1]).sum()


def test_a_groove_is_a_surface_and_a_step_is_a_break():
    x, _ = ORTHOGRAPHIC.plane_coordinates()
    depth = 4.0 * np.abs(np.abs(x / 0.01) - 16)  # two grooves with walls of 76 degrees
    slope = 4.0 * np.sign(np.abs(x) - 0.16) * np.sign(x)
    normal = np.stack([-slope, np.zeros_like(x), np.ones_like(x)], axis=-1) / np.sqrt(1 + slope**2)[..., None]
    groove = SurfaceMaps(camera=ORTHOGRAPHIC, mask=np.ones(x.shape, bool), height=(depth * 0.01).astype(np.float32),
                         normal=normal.astype(np.float32))
    assert all(link.all() for link in surface_links(groove, groove.mask))
    flat = np.zeros_like(groove.normal)
    flat[..., 2] = 1
    step = dataclasses.replace(groove, height=np.where(x > 0, 0.02, 0).astype(np.float32), normal=flat)
    links = surface_links(step, step.mask)
    assert links.down.all() and np.flatnonzero(~links.right.all(axis=0)).tolist() == [SIZE // 2 - 1]


@cameras
def test_without_normals_steps_of_more_than_80_degrees_break(camera):
    maps, ball = ball_before_a_wall(camera, 40)
    maps = dataclasses.replace(maps, normal=None, mask=~ball)
    wall = surface_links(maps, maps.mask)
    assert wall.right.sum() == (~ball[:, 1:] & ~ball[:, :-1]).sum()
    both = surface_links(dataclasses.replace(maps, mask=np.ones_like(ball)), np.ones_like(ball))
    assert not (both.right & edges(ball)[0]).any() and not (both.down & edges(ball)[1]).any()


def test_parts_are_never_linked():
    part = np.ones((SIZE, SIZE), np.uint8)
    part[20:40, 30:] = 2
    maps = SurfaceMaps(camera=ORTHOGRAPHIC, mask=part > 0, height=np.zeros((SIZE, SIZE), np.float32), part=part)
    for found, true in zip(missing(surface_links(maps, maps.mask)), edges(part), strict=True):
        np.testing.assert_array_equal(found, true)


@pytest.mark.parametrize("share", [0.3, 0.55, 0.62, 0.9])
def test_islands_are_those_of_scipy(share):
    mask = np.random.default_rng(2).random((83, 61)) < share
    links = Links(mask[:, 1:] & mask[:, :-1], mask[1:] & mask[:-1])
    label, _ = ndimage.label(mask)
    size = np.bincount(label.ravel())
    size[0] = 0
    large = (size >= min(ISLAND_PIXELS, size.max()))[label]
    kept = without_islands(links)
    np.testing.assert_array_equal(touched(kept), large & touched(links))
    np.testing.assert_array_equal(kept.right, links.right & large[:, 1:])


def test_joined_follows_long_chains():
    order = np.random.default_rng(3).permutation(2000)
    first, second = order[:-1], order[1:]
    cut = np.arange(1999) % 500 != 499
    label = joined(2000, first[cut], second[cut])
    assert len(np.unique(label)) == 4
    assert all(len(np.unique(label[order[start:start + 500]])) == 1 for start in range(0, 2000, 500))


def plane(camera: Camera, tilt=(0.5, -0.8, 1.0)) -> SurfaceMaps:
    """A tilted plane, in two parts of which the right one stands 30 pixels before the left."""
    n = np.asarray(tilt) / np.linalg.norm(tilt)
    x, y = camera.plane_coordinates()
    part = np.where(np.arange(80) < 50, 1, 2) * np.ones((60, 1), int)
    if camera.projection == "orthographic":
        z = -(n[0] * x + n[1] * y) / n[2] + 0.06 * (part == 2)
    else:
        z = (n[2] * -0.4) / (n[2] - n[0] * x - n[1] * y) * np.where(part == 2, 0.8, 1)
    return SurfaceMaps(camera=camera, mask=np.ones(part.shape, bool), height=z.astype(np.float32), part=part.astype(np.uint8),
                       normal=np.broadcast_to(n.astype(np.float32), (*part.shape, 3)))


def spiked(maps: SurfaceMaps, count: int, seed: int = 0) -> tuple[SurfaceMaps, np.ndarray]:
    """The maps with single pixels moved by 5 to 50 pixels along the line of sight, and where."""
    rng = np.random.default_rng(seed)
    where = np.zeros(maps.mask.shape, bool)
    where.reshape(-1)[rng.choice(where.size, count, replace=False)] = True
    pixel = 0.002 if maps.camera.projection == "orthographic" else 0.4 / 150
    moved = rng.uniform(5, 50, where.shape) * rng.choice([-1, 1], where.shape) * pixel
    return dataclasses.replace(maps, height=np.where(where, maps.height + moved, maps.height).astype(np.float32)), where


@repaired_cameras
def test_spikes_are_put_back_along_the_normals(camera):
    maps = plane(camera)
    bad, where = spiked(maps, 60)
    bad.height[30:32, 20:23] -= 0.05  # a spike of six pixels
    where[30:32, 20:23] = True
    repaired = repair_heights(bad)
    assert repaired.spikes == where.sum()
    assert f"{where.sum()} pixels stood off" in repaired.warnings[0]
    np.testing.assert_array_equal(repaired.maps.height[~where], maps.height[~where])  # nothing else is touched, to the bit
    # relief is linear on a plane for an orthographic camera; ln of depth bends by (slope / 150)² a pixel, over three pixels
    np.testing.assert_allclose(repaired.maps.height, maps.height, atol=2e-8 if camera.projection == "orthographic" else 2e-4)
    assert height_mesh(repaired.maps).centred == maps.mask.sum()


def test_a_few_spikes_are_no_warning():
    maps = plane(REPAIRED_ORTHOGRAPHIC)
    repaired = repair_heights(spiked(maps, 3)[0])
    assert (repaired.spikes, repaired.warnings) == (3, ())


@repaired_cameras
def test_a_height_of_another_surface_is_refused(camera):
    with pytest.raises(AssetError, match=r"more than 5% of the pixels.*--method svbrdf"):
        repair_heights(spiked(plane(camera), 600)[0])


def test_islands_are_told():
    mask = np.zeros((40, 40), bool)
    mask[:20] = True
    mask[24::4, ::4] = True
    maps = make_sheet(mask, normal=np.broadcast_to(np.float32([0, 0, 1]), (40, 40, 3)))
    repaired = repair_heights(maps)
    assert repaired.maps is maps
    (warning,) = repaired.warnings
    assert warning.startswith(f"geometry: {4 * 10} pixels are left out") and "fewer than 8 pixels" in warning


@repaired_cameras
@pytest.mark.parametrize("noise_degrees", [0, 4])
def test_steep_surfaces_are_left_alone(camera, noise_degrees):
    """A plane of 72 degrees with a break, and a sphere to its limb, with normals that are wrong by some degrees."""
    steep = plane(camera, (2.5, 1.5, 1.0)) if camera.projection == "orthographic" else plane(camera)
    x, y = REPAIRED_ORTHOGRAPHIC.plane_coordinates()
    r2 = (x**2 + y**2) / 0.055**2
    normal = np.stack([x / 0.055, y / 0.055, np.sqrt(np.maximum(1 - r2, 0))], axis=-1)
    height = (0.055 * normal[..., 2]).astype(np.float32)
    ball = SurfaceMaps(camera=REPAIRED_ORTHOGRAPHIC, mask=r2 < 1, normal=normal.astype(np.float32), height=height)
    for maps in (steep, ball):
        wrong = maps.normal + np.random.default_rng(1).normal(size=maps.normal.shape) * np.radians(noise_degrees)
        wrong /= np.linalg.norm(wrong, axis=-1, keepdims=True)
        repaired = repair_heights(dataclasses.replace(maps, normal=wrong.astype(np.float32)))
        assert (repaired.spikes, repaired.warnings) == (0, ())


def test_without_normals_nothing_is_judged():
    maps = dataclasses.replace(plane(REPAIRED_ORTHOGRAPHIC), normal=None)
    assert repair_heights(spiked(maps, 30)[0]).spikes == 0
    with pytest.raises(AssetError, match="no height layer"):
        repair_heights(dataclasses.replace(maps, height=None))
