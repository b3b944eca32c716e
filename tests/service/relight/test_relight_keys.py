"""relit relight --keys: animated lights, environment, captured images and exposure, against sums in closed form."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from stage.formats import exr
from tests.scenes.captures import files_in, make_scene, write_capture, write_exr

SCENE = make_scene(size=4, lights=4)
DIRECTIONS = [[0, 0, 1], [1, 0, 0], [0, 1, 0], [-0.48, -0.6, -0.64]]
IRRADIANCE = [[1, 1, 1], [2, 2, 2], [1, 2, 4], [1, 1, 1]]
LEVELS = [1.0, 2.0, 3.0, 4.0]
"""Of the images: each is the same everywhere."""


@pytest.fixture
def cap(tmp_path):
    lights = [{"type": "distant", "direction": d, "irradiance": e} for d, e in zip(DIRECTIONS, IRRADIANCE, strict=True)]
    write_capture(tmp_path / "cap", SCENE, frames=[{"image": f"{i:03d}.exr", "light": light} for i, light in enumerate(lights)])
    for index, level in enumerate(LEVELS):
        write_exr(tmp_path / "cap" / f"{index:03d}.exr", np.full((4, 4, 3), level))
    return tmp_path / "cap"


@pytest.fixture
def animate(relit, tmp_path, cap):
    """Relight frames 1-N by keys: [frames, 3] of the one colour that each frame has."""

    def run(count, keys, *options):
        (tmp_path / "keys.json").write_text(json.dumps({"schema": "relit.keys/1", **keys}))
        relit.done("relight", cap, "--keys", tmp_path / "keys.json", "--out", tmp_path / "f" / "a.#.exr",
                   "--frames", f"1-{count}", *options)
        return np.array([[exr.read(tmp_path / "f" / f"a.{n}.exr")[0][c].astype(float).mean() for c in "RGB"]
                         for n in range(1, count + 1)])

    return run


def light(*keys, **changes):
    return {"lights": [{"name": "key", "keys": list(keys), **changes}]}


@pytest.mark.parametrize("weights", ["kernel", "cells", "smooth"])
def test_a_light_where_a_captured_one_stood_is_that_image(animate, weights):
    keys = light({"frame": 1, "direction": [0, 3, 0], "irradiance": [1, 1, 3], "angle_degrees": 0})
    frames = animate(2, keys, "--weights", weights)
    assert np.allclose(frames, [[3, 1.5, 2.25]] * 2, rtol=1e-3)  # the third image times E / (1, 2, 4); half


def test_a_light_moves_on_the_great_circle_and_its_irradiance_changes_evenly(animate):
    keys = light({"frame": 1, "direction": [0, 0, 1], "irradiance": [0, 0, 0], "angle_degrees": 1},
                 {"frame": 5, "direction": [1, 0, 0], "irradiance": [4, 8, 4], "angle_degrees": 1})
    frames = animate(6, keys)
    # at frames 2 and 4 a quarter of the way from either: the first image, then the second, whose irradiance is 2; a disc of one
    # degree gives 2 / (1 + cos(0.5°)) of its irradiance
    assert np.allclose(frames[[0, 1, 3, 4, 5]], [[0, 0, 0], [1, 2, 1], [3, 6, 3], [4, 8, 4], [4, 8, 4]], rtol=1e-3)


def test_steps_hold_until_the_next_key(animate):
    keys = light({"frame": 2, "direction": [0, 0, 1], "irradiance": [1, 1, 1], "interpolation": "step"},
                 {"frame": 4, "direction": [0, 0, -1], "irradiance": [5, 5, 5]})  # opposite, which a step may be
    assert np.allclose(animate(4, keys, "--weights", "cells")[:, 0], [1, 1, 1, 20], rtol=1e-3)


def test_lights_are_converted_to_the_captures_colour_space(animate):
    keys = light({"frame": 1, "direction": [0, 0, 1], "irradiance": [0.5, 0.5, 1]}, color_space="lin_ap1_scene")
    # AP1 to Rec.709 with the Bradford adaptation, to the five digits that ACES publishes
    expected = np.array([[1.70505, -0.62179, -0.08326], [-0.13026, 1.14080, -0.01055], [-0.02400, -0.12897, 1.15297]]) @ [0.5, 0.5, 1]
    assert np.allclose(animate(1, keys), expected, rtol=1e-3)


def test_captured_images_are_added_as_they_are(animate):
    keys = {"captured": [{"image": "001.exr", "keys": [{"frame": 1, "weight": 1}, {"frame": 3, "weight": 0}]},
                         {"image": "003.exr", "keys": [{"frame": 1, "weight": 0.5}]}]}
    assert np.allclose(animate(3, keys)[:, 1], [4, 3, 2], rtol=1e-3)


def test_an_environment_turned_by_keys_is_one_turned_by_spin(animate, relit, tmp_path, cap):
    sky = write_exr(tmp_path / "sky.exr", np.random.default_rng(2).random((8, 16, 3)))
    keys = {"environment": [{"frame": 1, "turn_degrees": 0}, {"frame": 5, "turn_degrees": 360, "exposure": 4}]}
    turned = animate(4, keys, "--environment", sky)
    relit.done("relight", cap, "--environment", sky, "--out", tmp_path / "s" / "a.#.exr", "--frames", "1-4", "--spin-degrees", "360")
    spun = np.array([[exr.read(tmp_path / "s" / f"a.{n}.exr")[0][c].astype(float).mean() for c in "RGB"] for n in range(1, 5)])
    assert np.allclose(turned, spun * (2.0 ** np.arange(4))[:, None], rtol=1e-3)


def test_an_environment_turned_about_another_axis(animate, tmp_path):
    sky = np.zeros((32, 64, 3))
    sky[15:17, 31:33] = 1  # around +z
    keys = {"environment": [{"frame": 1, "turn_degrees": -90, "axis": [2, 0, 0]}]}  # by the right hand from +z to +y
    frame = animate(1, keys, "--environment", write_exr(tmp_path / "sky.exr", sky), "--weights", "cells")
    energy = 4 * np.sin(np.pi * 15.5 / 32) * (np.pi / 32) * (2 * np.pi / 64)
    assert np.allclose(frame, energy * 3 / np.array([1, 2, 4]), rtol=2e-3)
    metadata = exr.read_header(tmp_path / "f" / "a.1.exr").metadata
    assert metadata["relit:turn_degrees"] == "-90" and metadata["relit:turn_axis"] == "1 0 0"


def test_lights_are_added_to_the_environment_and_exposure_is_of_both(animate, tmp_path):
    sky = write_exr(tmp_path / "sky.exr", np.full((8, 16, 3), 1.0))
    alone = animate(1, {}, "--environment", sky)
    keys = light({"frame": 1, "direction": [0, 0, 1], "irradiance": [3, 3, 3], "angle_degrees": 0})
    both = animate(3, {**keys, "exposure": [{"frame": 1, "stops": 0}, {"frame": 3, "stops": 2}], "frames_per_second": 24},
                   "--environment", sky, "--exposure", "1")
    assert np.allclose(both, (alone + 3) * [[2], [4], [8]], rtol=1e-3)
    assert exr.read_header(tmp_path / "f" / "a.1.exr").metadata["relit:frames_per_second"] == "24"


KEY = {"frame": 1, "direction": [0, 0, 1], "irradiance": [1, 1, 1]}
BAD_KEYS = {
    "not JSON": ("{", "keys.json: is not JSON"),
    "another schema": ({"schema": "relit.keys/2"}, 'keys.json: schema: is "relit.keys/2"'),
    "unknown key": ({"lamps": []}, "keys.json: lamps: is not a known key"),
    "nothing": ({}, "nothing lights the frames: give --environment MAP, or --keys"),
    "no keys": (light(), "keys.json: lights[0].keys: has 0 entries, needs 1 or more"),
    "zero direction": (light({**KEY, "direction": [0, 0, 0]}), "keys.json: lights[0].keys[0].direction: has zero length"),
    "negative light": (light({**KEY, "irradiance": [1, -1, 1]}), "keys.json: lights[0].keys[0].irradiance[1]: is -1"),
    "wide disc": (light({**KEY, "angle_degrees": 181}), "keys.json: lights[0].keys[0].angle_degrees: is 181"),
    "not finite": ('{"schema": "relit.keys/1", "exposure": [{"frame": 1, "stops": NaN}]}', "NaN is not a JSON number"),
    "unordered": (light({**KEY, "frame": 5}, {**KEY, "frame": 5}),
                  "keys.json: lights[0].keys: key 1 is at frame 5, the one"),
    "opposite": (light(KEY, {**KEY, "frame": 2, "direction": [0, 0, -1]}),
                 "keys.json: lights[0].keys: key 1: its direction is opposite"),
    "opposite axes": ({"environment": [{"frame": 1, "axis": [0, 1, 0]}, {"frame": 2, "axis": [0, -1, 0]}]},
                      "keys.json: environment: key 1: its axis is opposite"),
    "display colours": (light(KEY, color_space="srgb_texture"), "keys.json: lights[0].color_space: is srgb_texture"),
    "unknown colours": (light(KEY, color_space="red"), 'keys.json: lights[0].color_space: red is no colour space of'),
    "another image": ({"captured": [{"image": "9.exr", "keys": [{"frame": 1, "weight": 1}]}]}, "keys.json: captured: 9.exr is no image of"),
    "negative weight": ({"captured": [{"image": "001.exr", "keys": [{"frame": 1, "weight": -1}]}]},
                        "keys.json: captured[0].keys[0].weight: is -1"),
    "far too bright": ({"exposure": [{"frame": 1, "stops": 99}]}, "keys.json: exposure[0].stops: is 99"),
    "nothing to turn": ({**light(KEY), "environment": [{"frame": 1}]}, "keys.json turns an environment: give --environment MAP too"),
    "no such interpolation": (light({**KEY, "interpolation": "smooth"}), "keys.json: lights[0].keys[0].interpolation: is \"smooth\""),
}


@pytest.mark.parametrize("fault", BAD_KEYS)
def test_bad_keys(relit, tmp_path, cap, fault):
    content, words = BAD_KEYS[fault]
    text = content if isinstance(content, str) else json.dumps({"schema": "relit.keys/1", **content})
    (tmp_path / "keys.json").write_text(text)
    before = files_in(tmp_path)
    relit("relight", cap, "--keys", tmp_path / "keys.json", "--out", tmp_path / "f" / "a.#.exr").refused(words)
    assert files_in(tmp_path) == before


def test_spin_and_keys_do_not_both_turn(relit, tmp_path, cap):
    (tmp_path / "keys.json").write_text(json.dumps({"schema": "relit.keys/1", "environment": [{"frame": 1, "turn_degrees": 5}]}))
    sky = write_exr(tmp_path / "sky.exr", np.ones((4, 8, 3)))
    relit("relight", cap, "--keys", tmp_path / "keys.json", "--environment", sky, "--spin-degrees", "9",
          "--out", tmp_path / "a.#.exr").refused("both turn the environment: give one")


TEXT = (Path(__file__).parents[3] / "docs" / "relight.md").read_text(encoding="utf-8")


def test_the_example_of_light_keys_runs(relit, tmp_path):
    cap = write_capture(tmp_path / "cap", make_scene(size=4, lights=13))
    sky = write_exr(tmp_path / "sky.exr", np.zeros((8, 16, 3)))
    example = re.search(r"```json\n(.*?)```", TEXT, re.DOTALL)[1]
    (tmp_path / "keys.json").write_text(example)
    arguments = ["relight", cap, "--keys", tmp_path / "keys.json", "--environment", sky, "--frames", "1-24"]
    relit.done(*arguments, "--out", tmp_path / "f" / "a.##.exr")
    without = {key: value for key, value in json.loads(example).items() if key not in ("lights", "exposure")}
    (tmp_path / "keys.json").write_text(json.dumps(without))
    assert relit(*arguments, "--out", tmp_path / "g" / "a.##.exr").code == 0
    levels = [exr.read(tmp_path / "g" / f"a.{n:02d}.exr")[0]["R"].astype(float).max() for n in range(1, 25)]
    assert np.allclose(np.array(levels) / levels[0], [*np.linspace(1, 0, 12), *[0] * 7, *[0.5] * 5], rtol=2e-3, atol=1e-6)
    both = exr.read(tmp_path / "f" / "a.24.exr")[0]["R"].astype(float)
    assert both.max() > 2 * levels[-1]  # the light, and one stop
