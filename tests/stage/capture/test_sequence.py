"""sequence.json: steps, rates and times; folders without it; and steps that are not of one camera."""

import json

import pytest

from stage.capture.sequence import check_alike, is_sequence, read_sequence, write_sequence
from stage.errors import ManifestError
from tests.scenes.captures import edit_manifest, make_scene, write_capture

SCENE = make_scene(size=4, lights=3)


@pytest.fixture
def folder(tmp_path):
    for name in ("b10", "a", "b9"):
        write_capture(tmp_path / name, SCENE)
    (tmp_path / "notes").mkdir()
    return tmp_path


def write(folder, **content):
    (folder / "sequence.json").write_text(json.dumps({"schema": "relit.sequence/1", **content}))


def test_folders_are_steps_in_order_of_name(folder):
    assert is_sequence(folder) and not is_sequence(folder / "a") and not is_sequence(folder / "notes")
    found = read_sequence(folder, frames_per_second=10)
    assert [(step.name, step.time_s) for step in found.steps] == [("a", 0.0), ("b9", 0.1), ("b10", 0.2)]
    assert (found.frames_per_second, found.timed) == (10, False) and len(check_alike(found)) == 3


def test_a_file_says_rate_times_and_order(folder):
    write(folder, frames_per_second=30, steps=[{"path": "c", "time_s": 0.5}, {"path": "a", "time_s": 2}])
    for path in (folder, folder / "sequence.json"):
        assert is_sequence(path)
        found = read_sequence(path)
        assert [(step.name, step.time_s) for step in found.steps] == [("c", 0.5), ("a", 2.0)] and found.timed
    write(folder, frames_per_second=30, steps=[{"path": "c"}, {"path": "a"}])
    assert read_sequence(folder).steps[1].time_s == pytest.approx(1 / 30)


def test_what_is_written_is_read(folder):
    found = read_sequence(folder)
    write_sequence(found, folder / "sequence.json")
    assert read_sequence(folder).steps == found.steps


@pytest.mark.parametrize(("steps", "words"), [
    ([], "steps: has 0 entries"),
    ([{"path": "a", "time_s": 1}, {"path": "b"}], r"steps\[1\].time_s: is missing"),
    ([{"path": "a", "time_s": 1}, {"path": "b", "time_s": 1}], r"steps\[1\].time_s: is 1, the step before has 1"),
    ([{"path": "a"}, {"path": "x/a"}], r"steps\[1\].path: ends in a as that of steps\[0\]"),
    ([{"path": "a", "speed": 1}], "speed"),
    ([{"path": ".."}], r"steps\[0\].path: is ..: name the folder"),
    ([{"path": "."}], r"steps\[0\].path: is .: name the folder"),
    ([{"path": "a"}, {"path": "notes"}], "notes: holds no capture.json"),
])
def test_faults_of_the_file_are_named(folder, steps, words):
    write(folder, steps=steps)
    with pytest.raises(ManifestError, match=words):
        check_alike(read_sequence(folder))


def test_a_rate_beside_that_of_the_file_is_refused(folder):
    write(folder, frames_per_second=30, steps=[{"path": "a"}])
    with pytest.raises(ManifestError, match="frames_per_second: is 30, --frame-rate 25"):
        read_sequence(folder, frames_per_second=25)


@pytest.mark.parametrize(("changes", "words"), [
    ({"camera": {"projection": "orthographic", "resolution": [5, 4]}}, "camera.resolution: is 5x4, that of a 4x4"),
    ({"camera": {"projection": "orthographic", "resolution": [4, 4], "pixel_size_m": 0.1}},
     "camera.pixel_size_m: is 0.1, that of a missing"),
    ({"color_space": "lin_ap1_scene"}, "color_space: is lin_ap1_scene, that of a lin_rec709_scene"),
    ({"irradiance_scale": "relative"}, "irradiance_scale: is relative, that of a absolute"),
])
def test_steps_that_differ_are_named(folder, changes, words):
    edit_manifest(folder / "b9", **changes)
    with pytest.raises(ManifestError, match=rf"b9/capture.json: {words}"):
        check_alike(read_sequence(folder))
