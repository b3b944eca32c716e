"""Live relighting: coefficients that give back the captured images, weights of `relit relight`, and the error that is said."""

import numpy as np
import pytest

from service.relight.relight import relight
from service.requests.captures import ViewRequest
from service.requests.relight import RelightRequest
from service.viewing import relighting
from service.viewing.view_files import view
from stage.formats import exr
from tests.marks import first_short
from tests.reference.colour import srgb
from tests.reference.relight import texel_directions, texel_solid_angles
from tests.reference.view import View
from tests.scenes.captures import edit_frame, make_scene, write_capture, write_exr
from tests.scenes.glossy import dome, reflect, sphere_directions, write_dome

SURFACE = dome()
LIGHTS = 48
COLS, ROWS = 64, 32


def show(folder, **options) -> View:
    view(ViewRequest(capture=folder / "cap", out=folder / "out", device="cpu", **options))
    return View(folder / "out")


def captured(directions: np.ndarray) -> np.ndarray:
    """[lights, rows, cols, 3] the images of the dome."""
    return np.stack([reflect(SURFACE.normal, direction) * 2.0 * SURFACE.mask[..., None] for direction in directions])


def rebuilt(found: View) -> np.ndarray:
    """[lights, rows, cols, 3] the images by their coefficients."""
    return np.stack([found.drawn(coefficients) for coefficients in found.captured()])


def relative(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(((a - b) ** 2).sum() / (b**2).sum()))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("relight")
    write_dome(folder / "cap", SURFACE, lights=LIGHTS)
    return folder


@pytest.fixture(scope="module")
def full(folder) -> View:
    """With as many coefficient images as lights, so that only the table of directions differs from `relit relight`."""
    return show(folder, terms=LIGHTS)


def inside(found: View) -> np.ndarray:
    """[rows, cols] bool, pixels that the object covers wholly."""
    facts = found.facts["relight"]
    return found.block(facts["matte"], "u1", facts["rows"], facts["cols"]) == 255


@pytest.mark.long
@pytest.mark.parametrize("terms", [3, 8, LIGHTS])
def test_a_captured_image_comes_back_with_the_error_that_is_said(folder, terms):
    found = show(folder, terms=terms)
    facts = found.facts["relight"]
    assert facts["terms"] <= terms and (facts["rows"], facts["cols"], facts["step"]) == (24, 24, 1)
    whole = inside(found)
    assert whole[SURFACE.mask].mean() > 0.6
    error = relative(rebuilt(found)[:, whole], captured(sphere_directions(LIGHTS))[:, whole])
    assert error == pytest.approx(facts["relative_rms"], rel=0.25)  # said of all pixels, border included
    assert terms < LIGHTS or error < 8e-3  # 0.5 % of pictures that count alike, however dark


def test_a_captured_light_is_a_light_from_its_direction(full):
    """At a captured light all energy goes to it; a pixel of the grid lies up to 4 degrees off, a fifth of the lights' distance."""
    directions = sphere_directions(LIGHTS)
    grid, table = texel_directions(ROWS, COLS), full.weights()
    images, whole = captured(directions) / 2.0, inside(full)
    for light in np.flatnonzero(directions[:, 2] > 0.6):  # the others light little of what the camera sees
        row, col = np.unravel_index((grid @ directions[light]).argmax(), (ROWS, COLS))
        errors = [relative(full.lit(table[row, col])[whole], images[other][whole]) for other in np.flatnonzero(directions[:, 2] > 0.6)]
        assert np.flatnonzero(directions[:, 2] > 0.6)[np.argmin(errors)] == light and min(errors) < 0.15


@first_short("sky", ["even", "lamp", "halves"])
def test_an_environment_through_the_table_is_that_of_relight(folder, full, sky):
    """The weights of `relit relight` may not be negative, in whole for an environment and here for each direction of the grid, so that sums
    differ by some per cent of the picture; under light from all around by nearly nothing, as both keep the energy."""
    direction = texel_directions(ROWS, COLS)
    lit = {"even": np.ones((ROWS, COLS)), "lamp": np.exp(30 * (direction @ [0.48, 0.6, 0.64] - 1)),
           "halves": 0.2 + 1.0 * (direction[..., 0] > 0)}[sky]
    radiance = lit[..., None] * np.array([1.0, 0.7, 0.4])
    write_exr(folder / "sky.exr", radiance)
    relight(RelightRequest(capture=folder / "cap", environment=folder / "sky.exr", out=str(folder / "f.#.exr"), device="cpu",
                           overwrite=True))
    channels, _ = exr.read(folder / "f.1.exr")
    wanted = np.stack([channels[c].astype(np.float64) for c in "RGB"], axis=-1)
    energy = radiance * texel_solid_angles(ROWS, COLS)[..., None]
    frame = full.lit(np.einsum("rqc,rqlc->lc", energy, full.weights()))
    assert relative(frame, wanted) < {"even": 0.005, "lamp": 0.04, "halves": 0.03}[sky]
    assert frame.sum() == pytest.approx(wanted.sum(), rel=0.02)


@pytest.mark.long
def test_the_energy_of_every_direction_is_kept(tmp_path):
    """White surfaces that face every light alike: whatever the direction, the weights of the lights add up to one."""
    directions = sphere_directions(20)
    scene = make_scene(size=8)
    images = np.ones((20, 8, 8, 3)) * 0.5
    write_capture(tmp_path / "cap", scene._replace(directions=directions, irradiance=np.full((20, 3), 2.0), images=images,
                                                   mask=np.ones((8, 8), dtype=bool)))
    found = show(tmp_path)
    assert found.facts["relight"]["terms"] == 1
    captured = found.basis()[0, :, 3, 3] * found.captured()[:, 0, 0]  # [lights, 3] of a pixel
    np.testing.assert_allclose(np.einsum("rqlc,lc->rqc", found.weights(), captured), 0.25, rtol=2e-3)  # half rounding of the one image


@pytest.mark.long
def test_light_from_beyond_the_captured_lights_is_flagged(tmp_path):
    front = sphere_directions(120)
    front = front[front[:, 2] > 0.5]
    write_dome(tmp_path / "cap", SURFACE, directions=front)
    found = show(tmp_path)
    facts = found.facts["relight"]
    beyond = found.block(facts["beyond"], "u1", ROWS, COLS)
    nearest = np.degrees(np.arccos(np.clip(texel_directions(ROWS, COLS) @ front.T, -1, 1))).min(axis=-1)
    assert 10 < facts["beyond_degrees"] < 90
    assert (beyond[nearest >= facts["beyond_degrees"]] == 255).all() and (beyond[nearest <= facts["beyond_degrees"] / 2] == 0).all()
    between = (nearest > facts["beyond_degrees"] / 2 + 0.1) & (nearest < facts["beyond_degrees"] - 0.1)
    assert ((beyond[between] > 0) & (beyond[between] < 255)).all() and between.any()


@pytest.mark.long
def test_large_images_are_reduced_by_whole_factors_and_others_are_the_same_again(folder, full, monkeypatch):
    """A pixel is then the mean of its block."""
    assert show(folder, terms=LIGHTS).bytes == full.bytes
    monkeypatch.setattr(relighting, "MOST_VALUES", LIGHTS * 100)
    found = show(folder, terms=LIGHTS)
    facts = found.facts["relight"]
    assert [facts[name] for name in ("rows", "cols", "step")] == [8, 8, 3]
    mean = rebuilt(full).reshape(LIGHTS, 8, 3, 8, 3, 3).mean(axis=(2, 4))
    assert relative(rebuilt(found), mean) < 0.012  # terms left out of both, 0.5 % of pictures that count alike
    assert np.array_equal(found.weights(), full.weights())


@pytest.fixture(scope="module")
def shadowed(tmp_path_factory) -> tuple[View, np.ndarray]:
    """Shadows that cross the object with the light, so that a whole image has as many independent parts as there are lights."""
    folder = tmp_path_factory.mktemp("shadowed")
    directions = sphere_directions(96)
    directions = directions[directions[:, 2] > 0.1]
    row, col = np.indices((48, 48)) / 48 - 0.5
    images = np.stack([0.05 + (np.hypot(col - 0.4 * d[0], row + 0.4 * d[1]) > 0.15) * max(d[2], 0) for d in directions])
    scene = make_scene(size=48)
    write_capture(folder / "cap", scene._replace(directions=directions, irradiance=np.full((len(directions), 3), 2.0),
                                                 images=images[..., None].repeat(3, axis=3), mask=np.ones((48, 48), dtype=bool)))
    return show(folder, terms=5), images


@pytest.mark.long
def test_the_basis_of_tiles_loses_less_than_the_best_of_the_whole_image_and_says_its_error(shadowed):
    found, images = shadowed
    singular = np.linalg.svd(images.reshape(len(images), -1), compute_uv=False)
    best = np.sqrt((singular[5:] ** 2).sum() / (singular**2).sum())
    assert found.facts["relight"]["terms"] == 5
    assert found.facts["relight"]["relative_rms"] < 0.4 * best
    held = found.facts["relight"]["held_out"]  # under other key lights than those here, whose errors are of the same size
    grid, levels = texel_directions(ROWS, COLS), []
    for row, col in np.argwhere(grid[..., 2] > 0.3)[::23]:
        weights = found.weights()[row, col]
        truth, shown = np.einsum("lrq,lc->rqc", images, weights), found.lit(weights)
        white = np.quantile(truth.max(axis=2), 0.99)
        levels.append(255 * np.abs(srgb(truth / white) - srgb(shown / white)).mean())
    assert held["key_lights"] == 32 and held["mean_levels"] > 0.1
    assert 0.5 < np.mean(levels) / held["mean_levels"] < 2
    assert max(levels) < 1.5 * held["largest_levels"]


@first_short("factor", [1, 1e-9, 1e7])
def test_no_more_images_than_the_error_needs_at_any_scale_of_radiance(tmp_path, factor):
    """Lambert's dome without shadows is a sum of three images, which fit into half values."""
    scene = make_scene(size=16, lights=9)
    scene = scene._replace(images=scene.images * factor)
    write_capture(tmp_path / "cap", scene)
    found = show(tmp_path)
    assert found.facts["relight"]["terms"] == 3 and found.facts["relight"]["relative_rms"] < 1e-3
    assert found.facts["relight"]["held_out"]["largest_levels"] < 0.1  # half rounding
    assert relative(rebuilt(found)[:, inside(found)], scene.images[:, inside(found)]) < 2e-3


@pytest.mark.parametrize(("lights", "words"), [(3, ""), (6, "irradiance of light 2 is 0 in channel R")], ids=["too few", "without red"])
def test_lights_that_cannot_be_relit_leave_the_rest_of_the_view(tmp_path, lights, words):
    """Said as `relit relight` says it."""
    write_capture(tmp_path / "cap", make_scene(lights=lights))
    if words:
        edit_frame(tmp_path / "cap", 2, light={"type": "distant", "direction": [0, 0.5, 1], "irradiance": [0, 1, 1]})
    found = show(tmp_path)
    assert found.facts["relight"] is None and len(found.facts["frames"]) == lights
    assert any(words in finding for finding in found.facts["findings"])
