"""Right manifests are not accused by what a part of the object alone shows."""

import numpy as np
import pytest

from service.light_estimation.declared_lights import explanation_sentence
from service.light_estimation.explanations import Cause, Sample, better_explanation, fit_manifest
from service.light_estimation.lambertian import FACING, suspects
from stage.transforms import fibonacci_sphere
from tests.marks import first_short
from tests.reference.microfacet import specular, unit

VIEW = np.array([0.0, 0.0, 1.0])


def sample_of(readings, lights):
    """Grey readings [lights, pixels] under lights of irradiance 1."""
    count = len(lights)
    return Sample(np.repeat(readings[..., None], 3, axis=2), readings > 0, lights, np.ones((count, 3)), np.ones(count), "lin_rec709_scene",
                  tuple(f"{number:03d}.exr" for number in range(count)))


@first_short("ball", [60, 100])
@first_short("alpha", [0.16, 0.3])
def test_a_ball_before_a_metal_plane_tells_that_lights_are_right(ball, alpha):
    """Any brightness of each light, and any directions, explain the readings of a metal plane, whose Lambertian normals scatter. The ball
    refutes them."""
    draw = np.random.default_rng(3)
    lights = fibonacci_sphere(60)
    lights = lights[lights[:, 2] > 0.4][:16]
    plane = unit(np.array([0.15, -0.1, 1.0]) + 0.01 * draw.normal(size=(600 - ball, 3)))
    curved = unit(draw.normal(size=(4 * ball, 3)) * [1, 1, 0] + [0, 0, 1])[:ball]
    metal = np.stack([specular(plane, light, VIEW, alpha, 0.9) for light in lights])
    matt = 0.5 / np.pi * np.maximum(lights @ curved.T, 0)
    readings = np.concatenate([metal, matt], axis=1)
    readings *= 1 + 0.01 * draw.normal(size=readings.shape)
    sample = sample_of(readings, lights)
    assert better_explanation(sample, fit_manifest(sample)) is None


@pytest.mark.parametrize("alpha", [0.3, 1.0])
def test_three_planes_tell_no_directions(alpha):
    """Three numbers of each light explain any readings of three planes, as of a box of metal under right lights."""
    lights = fibonacci_sphere(60)
    lights = lights[lights[:, 2] > 0.4]
    faces = unit(np.array([[0.6, 0.1, 1.0], [-0.5, 0.5, 1.0], [-0.1, -0.8, 1.0]]))
    sample = sample_of(np.stack([specular(np.repeat(faces, 200, axis=0), light, VIEW, alpha, 0.9) for light in lights]), lights)
    assert better_explanation(sample, fit_manifest(sample)) is None


@pytest.mark.parametrize("count", [12, 20])
def test_few_lights_of_other_directions_must_leave_more(count):
    """A plate that shines and what stands on it leave 6 % under twelve right lights; here other directions leave 8 %."""
    draw = np.random.default_rng(1)
    lights = fibonacci_sphere(80)
    lights = draw.permutation(lights[lights[:, 2] > 0.4])[:count]
    other = unit(lights + 0.3 * draw.normal(size=lights.shape) * [1, 1, 0.3])
    around = unit(draw.normal(size=(150, 3)) * [0.5, 0.5, 0] + [0, 0, 1])
    readings = np.maximum(other @ np.concatenate([np.tile([0.1, 0.1, 1.0], (450, 1)), around]).T, 0)
    sample = sample_of(readings * (1 + 0.002 * draw.normal(size=readings.shape)), lights)
    found = better_explanation(sample, fit_manifest(sample))
    assert found is None if count < 16 else found.cause is Cause.DIRECTIONS


def test_what_fits_beside_metal_tells_that_axes_are_right():
    """Normals that face away are those of metal, and no sign of exchanged axes, where what fits Lambert's law faces the camera."""
    draw = np.random.default_rng(5)
    lights = fibonacci_sphere(240)
    lights = lights[lights[:, 2] > 0.4]
    matt = np.maximum(lights @ unit(draw.normal(size=(150, 3)) * [0.5, 0.5, 0] + [0, 0, 1]).T, 0)
    away = lights @ unit(np.array([-1.0, 0.0, -0.3]) + 0.1 * draw.normal(size=(450, 3))).T
    metal = np.where(away > 0, away * np.exp(1.2 * draw.normal(size=away.shape)), 0)
    fit = fit_manifest(sample_of(np.concatenate([matt, metal], axis=1), lights))
    assert fit.facing < FACING and fit.towards_camera is None


@pytest.mark.parametrize(("first", "factor"), [(12, 0.5), (18, 1.5), (12, 0.8)])
@first_short("gloss", [0.0, 0.3])
def test_an_exposure_that_changes_is_named_with_its_image(first, factor, gloss):
    """Readings of a matt and a glossy ball, of 1 % noise, whose images are brighter or darker from one on."""
    readings, lights = ball(gloss)
    readings[first:] *= factor
    sample = sample_of(readings, lights)
    found = better_explanation(sample, fit_manifest(sample))
    assert found.cause is Cause.STEP and found.step.first == first
    assert abs(found.step.factor / factor - 1) < 0.03  # noise makes .005, gloss the rest
    assert f"from {first:03d}.exr on, all images look {found.step.factor:.2g} times as bright" in explanation_sentence(found, sample)


@first_short("change", [np.ones(24), np.exp(0.2 * np.random.default_rng(4).normal(size=24)), np.linspace(0.7, 1.3, 24),
                        np.where(np.arange(24) == 20, 0.4, 1.0)])
def test_lights_that_differ_are_no_step(change):
    """Equal lights, single ones, lamps that fade, and one that is dim."""
    readings, lights = ball(0.1)
    sample = sample_of(readings * change[:, None], lights)
    found = better_explanation(sample, fit_manifest(sample))
    assert found is None or found.cause is not Cause.STEP


@pytest.mark.parametrize(("matt", "alpha"), [(0.15, 0.36), (0.3, 0.25)])
def test_rings_of_a_dome_before_glossy_planes_are_no_step(matt, alpha):
    """A gear of satin under three rings of lights, one after another: each of its planes shines under other lights, which looks like a step
    of brightness that leaves the readings further off."""
    rings = [np.radians([[up, turn + 360 * number / count] for number in range(count)])
             for up, count, turn in ((25, 12, 0), (45, 8, 10), (68, 4, 30))]
    up, around = np.concatenate(rings).T
    lights = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=1)
    planes = np.repeat([[0.5, -0.43, 0.75], [0.0, 0.87, 0.5], [-0.87, -0.25, 0.43]], [430, 85, 85], axis=0)
    draw = np.random.default_rng(2)
    normal = unit(planes + 0.01 * draw.normal(size=planes.shape))
    shine = np.stack([specular(normal, light, VIEW, alpha, 0.05) for light in lights])
    readings = (shine + matt / np.pi * np.maximum(lights @ normal.T, 0)) * (1 + 0.005 * draw.normal(size=shine.shape))
    sample = sample_of(readings, lights)
    assert better_explanation(sample, fit_manifest(sample)) is None


def test_a_step_among_lights_that_all_differ_is_not_all_of_it():
    """Lamps from the middle of the table on are weaker, and all are the weaker the lower they stand, which the step leaves."""
    readings, lights = ball(0.0)
    sample = sample_of(readings * (np.where(np.arange(24) < 12, 1.0, 0.6) * np.exp(2 * lights[:, 2]))[:, None], lights)
    assert better_explanation(sample, fit_manifest(sample)).cause is Cause.IRRADIANCE


@pytest.mark.parametrize(("first", "by", "words"), [
    (9, 1, "one light ahead of the manifest, as where a picture was lost"),
    (14, -1, "one light behind the manifest, as where a picture was taken twice"), (24, 1, None)])
def test_a_picture_that_was_lost_or_taken_twice_is_named_with_its_place(first, by, words):
    """A glossy ball, of 1 % noise: from one image on, each shows the light after that of its row of the table, or the one before it."""
    readings, lights = ball(0.05)
    image = np.arange(24) + by * (np.arange(24) >= first)
    sample = sample_of(readings[image[image < 24]], lights[: (image < 24).sum()])
    found = better_explanation(sample, fit_manifest(sample))
    if words is None:
        assert found is None
    else:
        assert found.cause is Cause.SHIFTED and found.late == (first, by)
        assert f"frames[].light: from {first:03d}.exr on, the images look {words}" in explanation_sentence(found, sample)


@pytest.mark.parametrize("table", [False, True])
def test_lights_or_images_in_the_order_of_their_numbers_as_text_are_named(table):
    """1, 10, 11 … 2, 20 …, as programs sort names whose numbers have no leading zeros."""
    readings, lights = ball(0.05)
    text = np.array(sorted(range(24), key=lambda number: str(number + 1)))
    sample = sample_of(readings if table else readings[text], lights[text] if table else lights)
    found = better_explanation(sample, fit_manifest(sample))
    assert found.cause is Cause.TEXT and "by their numbers as text" in explanation_sentence(found, sample)


@pytest.mark.parametrize(("cause", "words"), [(Cause.BALL_NORMALS, "normals of a mirror ball"),
                                              (Cause.ELEVATION, "elevations look exchanged")])
def test_a_table_of_other_vectors_is_named(cause, words):
    """A glossy ball under lights whose table holds the bisector of each and the viewer, or 90° less its elevation."""
    readings, lights = ball(0.05)
    across = np.hypot(lights[:, 0], lights[:, 1])[:, None]
    table = unit(lights + VIEW) if cause is Cause.BALL_NORMALS else np.hstack([lights[:, :2] / across * lights[:, 2:], across])
    sample = sample_of(readings, table)
    found = better_explanation(sample, fit_manifest(sample))
    assert found.cause is cause and words in explanation_sentence(found, sample)


@pytest.mark.parametrize(("count", "room", "window"), [(8, 0.3, 0.5), (8, 0.15, 0.0), (24, 0.3, 0.8)])
def test_light_of_the_room_is_told_by_what_lamps_do_not_reach(count, room, window):
    """A glossy ball under 8 to 24 lights, in a room that gives a part of a lamp's light, from above more than from below. Rough sheen,
    which takes up a constant as well, is dark under lamps behind it, and light that bounces differs from lamp to lamp."""
    readings, lights = ball(0.05, count)
    draw = np.random.default_rng(6)
    normal, albedo = _surface(draw)
    around = albedo / np.pi * (0.5 + 0.5 * window * normal[:, 1])
    sample = sample_of(readings + room * around, lights)
    found = better_explanation(sample, fit_manifest(sample))
    assert found.cause is Cause.STEADY and "add an image with all lamps off" in explanation_sentence(found, sample)
    turned = np.degrees(np.arccos(np.clip((found.normal * normal.T).sum(axis=0), -1, 1)))
    assert np.median(turned) < 1.5  # noise of one per cent and the highlight
    bounced = 0.2 * albedo * readings.mean(axis=1, keepdims=True) * np.maximum(lights @ unit(np.array([1.0, 0.0, 0.3])), 0)[:, None]
    sheen = 0.1 * albedo * np.maximum(lights @ normal.T, 0) ** 0.3
    for other in (readings, readings + bounced, readings + sheen):
        sample = sample_of(other, lights)
        found = better_explanation(sample, fit_manifest(sample))
        assert found is None or found.cause is not Cause.STEADY


def _surface(draw):
    """Normals [600, 3] of a ball seen from the front, and their albedo."""
    normal = unit(draw.normal(size=(2400, 3)) * [1, 1, 0] * draw.uniform(0, 1, (2400, 1)) + [0, 0, 0.7])[:600]
    return normal, draw.uniform(0.2, 0.7, 600)


def ball(gloss, count=24):
    """Readings of a ball of an albedo that varies, under lights in an order that follows no direction."""
    draw = np.random.default_rng(6)
    normal, albedo = _surface(draw)
    lights = fibonacci_sphere(80)
    lights = draw.permutation(lights[lights[:, 2] > 0.4][:24])[:count]
    matt = albedo / np.pi * np.maximum(lights @ normal.T, 0)
    readings = matt + gloss * np.stack([specular(normal, light, VIEW, 0.3, 0.2) for light in lights])
    return readings * (1 + 0.01 * draw.normal(size=readings.shape)), lights


def coin(roughness, dielectric, count=40):
    """Readings of a coin with relief of some degrees, glossy or of metal, under frontal lights, and these."""
    draw = np.random.default_rng(2)
    lights = fibonacci_sphere(4 * count)
    lights = lights[lights[:, 2] > 0.5][:count]
    normal = unit(draw.normal(size=(600, 3)) * [0.06, 0.06, 0] + [0, 0, 1])
    readings = np.stack([specular(normal, light, VIEW, roughness, 0.04 if dielectric else 0.6) for light in lights])
    readings += dielectric * 0.1 / np.pi * np.maximum(lights @ normal.T, 0)
    return readings * (1 + 0.005 * draw.normal(size=readings.shape)), lights


@pytest.mark.long
@pytest.mark.parametrize("roughness", [0.3, 0.5])
@pytest.mark.parametrize("dielectric", [True, False])
def test_a_coin_whose_highlight_is_smooth_over_the_lights_is_accused_of_nothing(roughness, dielectric):
    readings, lights = coin(roughness, dielectric)
    sample = sample_of(readings, lights)
    fit = fit_manifest(sample)
    assert better_explanation(sample, fit) is None
    assert suspects(readings, lights, fit.normal) == []
    mixed = sample_of(readings, np.random.default_rng(1).permutation(lights))
    assert better_explanation(mixed, fit_manifest(mixed)) is not None
    uneven = sample_of(readings * np.exp(0.3 * np.random.default_rng(1).normal(size=len(lights)))[:, None], lights)
    assert not dielectric or better_explanation(uneven, fit_manifest(uneven)) is not None  # bare metal hides it


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_a_highlight_of_a_wall_is_no_wrong_light_and_one_light_of_another_strength_is(factor):
    """A glossy wall behind a matt ball: the ball contradicts that the light in whose mirror the wall lies is another."""
    draw = np.random.default_rng(3)
    lights = fibonacci_sphere(60)
    lights = lights[lights[:, 2] > 0.45][:16]
    wall, around = unit(np.tile([0.1, 0.1, 1.0], (400, 1))), unit(draw.normal(size=(200, 3)) * [0.5, 0.5, 0] + [0, 0, 1])
    readings = np.maximum(lights @ np.concatenate([wall, around]).T, 0)
    readings[:, :400] += np.stack([specular(wall, light, VIEW, 0.3, 0.2) for light in lights])
    normal = np.concatenate([wall, around]).T
    assert suspects(readings, lights, normal) == []
    readings[5] *= factor
    assert [found.light for found in suspects(readings, lights, normal)] == [5]


@pytest.mark.parametrize(("farthest_deg", "told"), [(33, "a broad highlight lies over the object"), (60, None)])
def test_gloss_of_a_relief_under_frontal_lights_is_not_called_an_encoding(farthest_deg, told):
    """A tablet of varnish in images that are encoded as declared: its highlight falls off as shading does that is decoded once too often.
    Lights from farther aside, of which the highlight shows little, contradict that."""
    draw = np.random.default_rng(2)
    lights = fibonacci_sphere(400)
    lights = lights[lights[:, 2] > np.cos(np.radians(farthest_deg))]
    lights = lights[np.linspace(0, len(lights) - 1, 8).round().astype(int)]
    tablet = unit(np.array([0, 0, 1.0]) + 0.04 * draw.normal(size=(600, 3)))
    gloss = np.stack([specular(tablet, light, VIEW, 0.25, 0.04) for light in lights])
    readings = draw.uniform(0.1, 0.6, 600) / np.pi * np.maximum(lights @ tablet.T, 0) + gloss
    sample = sample_of(readings / readings.max(), lights)._replace(color_space="srgb_texture")
    found = better_explanation(sample, fit_manifest(sample))
    assert (found is None) == (told is None) and (told is None or told in explanation_sentence(found, sample))
