"""relit relight --only: a part of a range is, to the last bit, what a run of the whole range makes."""

import hashlib
import json

import numpy as np
import pytest

from stage.formats import exr
from tests.scenes.captures import files_in, make_scene, write_capture, write_exr
from tests.scenes.glossy import dome, write_dome, write_maps

SCENE = make_scene(size=64, lights=12)
"""Large enough that sums in another order round to another half somewhere."""
PARTS = ("33-40", "5", "9-16", "1-4", "17-32", "6-8")
"""Of 1-40, out of order, some of one frame, some over the border of a chunk of frames."""

COARSE_PITCH_DEGREES = 4.0
"""Eight times coarser than maps are cut: to the last bit the same is asked of fewer samples as well."""


def digests(folder):
    return {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in files_in(folder)}


@pytest.fixture
def compare(relit, tmp_path, monkeypatch):
    """Relight whole and in parts, each from a capture without caches; the frames and what the parts made of them."""
    monkeypatch.setattr("kernels.relight.directions.latlong.SAMPLE_PITCH_DEGREES", COARSE_PITCH_DEGREES)

    def run(capture, frames, parts, *options):
        relit.done("relight", capture, "--frames", frames, "--out", tmp_path / "whole" / "a.##.exr", "--cache", tmp_path / "c1",
                   *options)
        for part in parts:
            before = files_in(tmp_path / "parts")
            relit.done("relight", capture, "--frames", frames, "--only", part, "--out", tmp_path / "parts" / "a.##.exr",
                       "--cache", tmp_path / "c2", *options)
            first, _, last = part.partition("-")
            made = {f"a.{number:02d}.exr" for number in range(int(first), int(last or first) + 1)}
            assert files_in(tmp_path / "parts") - before == made
        return digests(tmp_path / "whole"), digests(tmp_path / "parts")

    return run


def sky(path):
    return write_exr(path, np.random.default_rng(5).random((16, 32, 3)))


@pytest.mark.long
@pytest.mark.parametrize("options", [
    ("--spin-degrees", "360"), ("--spin-degrees", "77", "--weights", "smooth", "--color-space", "lin_ap1_scene", "--aov", "mask"),
], ids=["kernel", "smooth"])
def test_parts_of_a_spin(compare, tmp_path, options):
    write_capture(tmp_path / "cap", SCENE)
    whole, parts = compare(tmp_path / "cap", "1-40", PARTS, "--environment", sky(tmp_path / "sky.exr"), *options)
    assert len(whole) == 40 and parts == whole


@pytest.mark.long
def test_parts_under_keys(compare, tmp_path):
    write_capture(tmp_path / "cap", SCENE)
    (tmp_path / "keys.json").write_text(json.dumps({
        "schema": "relit.keys/1", "frames_per_second": 24,
        "environment": [{"frame": 1, "turn_degrees": 0}, {"frame": 40, "turn_degrees": 90, "exposure": -1}],
        "lights": [{"name": "key", "keys": [{"frame": 3, "direction": [-0.7, 0.5, 0.5], "irradiance": [3, 2, 1]},
                                            {"frame": 30, "direction": [0.7, 0.5, 0.5], "irradiance": [1, 2, 3]}]}],
        "captured": [{"image": "002.exr", "keys": [{"frame": 5, "weight": 0}, {"frame": 20, "weight": 0.5}]}],
        "exposure": [{"frame": 1, "stops": 0}, {"frame": 40, "stops": 1}]}))
    whole, parts = compare(tmp_path / "cap", "1-40", PARTS, "--environment", sky(tmp_path / "sky.exr"), "--keys", tmp_path / "keys.json")
    assert len(whole) == 40 and parts == whole


def test_parts_guided_by_maps(compare, tmp_path):
    surface = dome(size=12)
    write_dome(tmp_path / "cap", surface, lights=12)
    write_maps(tmp_path / "maps", surface)
    whole, parts = compare(tmp_path / "cap", "1-4", ("3", "1-2", "4"), "--environment", sky(tmp_path / "sky.exr"), "--spin-degrees", "90",
                           "--maps", tmp_path / "maps", "--aov", "diffuse,specular")
    assert len(whole) == 4 and parts == whole


@pytest.mark.long
def test_parts_of_a_sequence_of_captures_and_maps(compare, tmp_path):
    for step in (1, 2, 3):
        write_capture(tmp_path / "seq" / f"t{step}", SCENE._replace(images=SCENE.images * step), name=f"t{step}")
        sky_of = np.random.default_rng(step).random((8, 16, 3))
        write_exr(tmp_path / f"sky.{step}.exr", sky_of)
    whole, parts = compare(tmp_path / "seq", "1-3", ("2-3", "1"), "--environment", tmp_path / "sky.#.exr", "--spin-degrees", "30")
    assert len(whole) == 3 and parts == whole


def test_a_part_needs_the_maps_of_its_own_frames_alone(relit, tmp_path):
    write_capture(tmp_path / "cap", SCENE)
    sky(tmp_path / "sky.2.exr")
    arguments = ("relight", tmp_path / "cap", "--environment", tmp_path / "sky.#.exr", "--frames", "1-3", "--out", tmp_path / "a.#.exr")
    assert relit(*arguments, "--only", "2").code == 0
    assert "frame 3 has no map" in relit.refused(*arguments, "--only", "2-3")


@pytest.mark.parametrize(("options", "sentence"), [
    (("--frames", "1-8", "--only", "8-9"), "relit: --only 8-9: lies outside the frames 1-8\n"),
    (("--frames", "5-8", "--only", "4"), "relit: --only 4: lies outside the frames 5-8\n"),
    (("--only", "2"), "relit: --only 2: lies outside the frames 1-1\n"),
    (("--frames", "1-8", "--only", "4-2"), "relit: --only 4-2: runs backwards: give 2-4\n"),
    (("--frames", "1-8", "--only", "two"), "relit: --only two: give a number, or first-last such as 1-24\n"),
    (("--frames", "1-8", "--only", "1-8:2"), "relit: --only 1-8:2: give a number, or first-last such as 1-24\n"),
    (("--frames", "1-8", "--only", "2-4", "--sheet", "s.png"),
     "relit: --sheet s.png shows the whole range, --only 2-4 makes a part of it: give one of them\n"),
])
def test_a_part_that_cannot_be(relit, tmp_path, options, sentence):
    write_capture(tmp_path / "cap", SCENE)
    outcome = relit("relight", tmp_path / "cap", "--environment", sky(tmp_path / "sky.exr"), "--out", tmp_path / "f" / "a.#.exr", *options)
    assert (outcome.code, outcome.out, outcome.err) == (2, "", sentence)
    assert not (tmp_path / "f").exists()


def test_what_is_recorded_does_not_say_how_the_range_was_cut(relit, tmp_path):
    write_capture(tmp_path / "cap", SCENE)
    relit("relight", tmp_path / "cap", "--environment", sky(tmp_path / "sky.exr"), "--frames", "1-8", "--only", "3-4",
          "--out", tmp_path / "a.#.exr", "--report", tmp_path / "r.json")
    options = json.loads(exr.read_header(tmp_path / "a.3.exr").metadata["relit:options"])
    assert options["frames"] == "1-8" and "only" not in options
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["options"]["frames"] == "1-8" and "only" not in report["options"]
    assert report["frames"] == {"made": 2, "skipped": 0, "clipped_pixels": 0, "first": f"{tmp_path}/a.3.exr", "last": f"{tmp_path}/a.4.exr"}
