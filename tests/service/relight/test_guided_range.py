"""Guided frames of a range, whose model is computed once, are those that are shaded one by one, and turn as the light does."""

import json

import numpy as np
import pytest

from kernels.relight.directions.direction_grid import direction_grid
from kernels.relight.model.responses import respond
from stage.capture.camera import Camera
from tests.reference.sampling import lattice
from tests.scenes.captures import edit_manifest, rgb, write_exr
from tests.scenes.glossy import PIXEL_M, dome, lat_long, reflect, write_dome, write_maps

pytestmark = pytest.mark.long

SURFACE = dome()
SUN = np.array([0.35, 0.45, 0.82]) / np.linalg.norm([0.35, 0.45, 0.82])
LOW_SUN = np.array([0.9, 0.3, -0.1]) / np.linalg.norm([0.9, 0.3, -0.1])
"""Beyond the captured lights where these are in front."""
ROWS = 48
FRAMES = 6
HALF = 2.0**-10
"""Relative: two roundings to half."""


@pytest.fixture(scope="module", params=["around", "in front", "perspective"])
def scene(request, tmp_path_factory):
    """A capture under lights all around or in front, maps, and an environment with two suns in a sky of two colours. With perspective, the
    images are still those of parallel lines of sight, which a model that is only compared with itself does not mind."""
    folder = tmp_path_factory.mktemp("range")
    write_dome(folder / "cap", SURFACE, directions=lattice(48, 45) if request.param == "in front" else None)
    if request.param == "perspective":
        size = len(SURFACE.mask)
        camera = Camera(projection="perspective", resolution=(size, size), focal_px=(60.0, 60.0), principal_px=(size / 2, size / 2))
        edit_manifest(folder / "cap", camera={"projection": "perspective", "resolution": [size, size], "focal_px": [60, 60],
                                              "principal_px": [size / 2, size / 2]})
        write_maps(folder / "maps", SURFACE, camera, height=(SURFACE.height - 60 * PIXEL_M).astype(np.float32))
    else:
        write_maps(folder / "maps", SURFACE)
    directions, _ = lat_long(ROWS)
    sky = 0.3 + 0.2 * directions[..., 1:2] * [0.5, 0.8, 1.0] + 0.1 * directions[..., :1] * [1.0, 0.2, 0.1]
    for middle, radiance in ((SUN, [60.0, 50.0, 40.0]), (LOW_SUN, [30.0, 10.0, 5.0])):
        sky = np.where((directions @ middle > np.cos(np.radians(4.0)))[..., None], radiance, sky)
    write_exr(folder / "sky.exr", sky)
    write_exr(folder / "rolled.exr", np.roll(sky, -10, axis=1))
    return folder


def relight(relit, folder, out, *options, sky="sky.exr"):
    """The frames by their numbers; options with --frames."""
    relit.done("relight", folder / "cap", "--environment", folder / sky, "--maps", folder / "maps", "--out", out / "f.##.exr",
               *options)
    return {int(path.name[2:4]): rgb(path) for path in out.iterdir()}


def keys(folder, **content):
    (folder / "keys.json").write_text(json.dumps({"schema": "relit.keys/1", **content}))
    return "--keys", folder / "keys.json"


def test_frames_are_those_made_alone(relit, scene, tmp_path):
    """Under a turning and tilting environment, a small disc and a wide one, and a captured image. Alone, a frame takes the environment as
    1024 samples; in a range it is spread over a grid. Each is within a few parts in a thousand of very many samples."""
    disc = {"direction": [0.2, -0.3, 0.9], "irradiance": [1.0, 0.5, 0.2]}
    options = keys(tmp_path, environment=[{"frame": 1, "turn_degrees": 0}, {"frame": FRAMES, "turn_degrees": 100, "axis": [0.3, 0.9, 0.3]}],
                   lights=[{"name": "small", "keys": [{"frame": 1, "angle_degrees": 3, **disc}]},
                           {"name": "wide", "keys": [{"frame": 1, **disc, "angle_degrees": 70, "direction": [-0.6, 0.5, 0.4]}]}],
                   captured=[{"image": "007.exr", "keys": [{"frame": 1, "weight": 0}, {"frame": FRAMES, "weight": 0.4}]}])
    together = relight(relit, scene, tmp_path / "a", "--frames", f"1-{FRAMES}", *options)
    assert len(together) == FRAMES
    for number in (1, 3, FRAMES):
        alone, = relight(relit, scene, tmp_path / str(number), "--frames", str(number), *options).values()
        assert SURFACE.off(together[number], alone) < 0.002
        assert abs(together[number].sum() / alone.sum() - 1) < 0.002
        assert not np.array_equal(together[number], alone)  # they are made in two ways


def test_the_specular_layer_is_that_of_a_frame_alone(relit, scene, tmp_path):
    relight(relit, scene, tmp_path / "a", "--frames", f"1-{FRAMES}", "--aov", "diffuse,specular")
    relight(relit, scene, tmp_path / "b", "--frames", "1", "--aov", "diffuse,specular")
    together, alone = (rgb(tmp_path / out / "f.01.exr", "specular.") for out in "ab")
    assert SURFACE.off(together, alone) < 0.002 and alone[SURFACE.mask].min() > 0


def test_a_whole_turn_is_no_turn(relit, scene, tmp_path):
    """To the rounding of its sine and cosine, and half."""
    options = keys(tmp_path, environment=[{"frame": 1, "turn_degrees": 0}, {"frame": FRAMES, "turn_degrees": 360}])
    frames = relight(relit, scene, tmp_path / "a", "--frames", f"1-{FRAMES}", *options)
    np.testing.assert_allclose(frames[FRAMES], frames[1], rtol=HALF, atol=1e-5)
    assert SURFACE.off(frames[3], frames[1]) > 0.1


def test_a_turn_is_a_picture_that_is_moved(relit, scene, tmp_path):
    """By 10 of 96 columns, two frames of five. The moved map is cut into other samples, which fall elsewhere on the grid."""
    spin = "--frames", "1-8", "--spin-degrees", "150"
    spun = relight(relit, scene, tmp_path / "a", *spin)
    moved = relight(relit, scene, tmp_path / "b", *spin, sky="rolled.exr")
    for number in (1, 2, 6):
        assert SURFACE.off(moved[number], spun[number + 2]) < 0.0005
        assert SURFACE.off(moved[number], spun[number]) > 0.1


def test_it_is_as_near_to_the_truth_as_a_frame_alone(relit, scene, tmp_path):
    """The pictures are those of an orthographic camera. With a perspective camera, both ways are equally far from the truth."""
    directions, solid_angle = lat_long(ROWS)
    sky = rgb(scene / "sky.exr")
    truth = np.zeros((*SURFACE.mask.shape, 3))
    for row in range(ROWS):
        truth += np.einsum("rctk,tk->rck", reflect(SURFACE.normal[:, :, None], directions[row]), sky[row] * solid_angle[row])
    together = relight(relit, scene, tmp_path / "a", "--frames", f"1-{FRAMES}")
    alone = relight(relit, scene, tmp_path / "b", "--frames", "1")
    assert SURFACE.off(together[1], truth) < 1.02 * SURFACE.off(alone[1], truth)


def test_pixels_are_lit_alike_in_whatever_portions(relit, scene, tmp_path, monkeypatch):
    """Batches of 128 pixels in portions of 32: to half and the order of float32 sums."""
    whole = relight(relit, scene, tmp_path / "a", "--frames", f"1-{FRAMES}")
    monkeypatch.setattr("service.relight.surface_model.BATCH_PIXELS", 128)
    monkeypatch.setattr("service.relight.model_range.RESPONSE_BYTES", 1)
    parts = relight(relit, scene, tmp_path / "b", "--frames", f"1-{FRAMES}")
    for number in (1, FRAMES):
        np.testing.assert_allclose(parts[number], whole[number], rtol=2 * HALF, atol=1e-5)


def test_directions_behind_all_pixels_of_a_portion_are_left_out(relit, scene, tmp_path, monkeypatch):
    """With them, the frames are the same to half and the order of float32 sums."""
    asked = []

    def counted(surface, sources, visible, responses):
        asked.append(len(sources.place))
        respond(surface, sources, visible, responses)

    monkeypatch.setattr("service.relight.model_range.RESPONSE_BYTES", 1)
    monkeypatch.setattr("service.relight.model_range.respond", counted)
    frames = relight(relit, scene, tmp_path / "a", "--frames", f"1-{FRAMES}")
    whole = len(direction_grid().direction)
    assert max(asked) < 0.9 * whole
    asked.clear()
    monkeypatch.setattr("kernels.relight.directions.facing.ROUNDING", 2.0)
    every = relight(relit, scene, tmp_path / "b", "--frames", f"1-{FRAMES}")
    assert max(asked) == whole
    for number in (1, FRAMES):
        np.testing.assert_allclose(frames[number], every[number], rtol=2 * HALF, atol=1e-5)


def test_small_lights_of_few_frames_at_a_time_light_alike(relit, scene, tmp_path, monkeypatch):
    """The horizons of a perspective camera and of lights far apart differ where they are interpolated, at the edges of few shadows."""
    together = relight(relit, scene, tmp_path / "a", "--frames", f"1-{FRAMES}", "--spin-degrees", "20")
    monkeypatch.setattr("service.relight.model_range.HORIZON_FRAMES", 2)
    apart = relight(relit, scene, tmp_path / "b", "--frames", f"1-{FRAMES}", "--spin-degrees", "20")
    for number in together:
        assert SURFACE.off(apart[number], together[number]) < 0.002
