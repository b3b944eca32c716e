"""Rig files, the patch, responses and cues."""

import json

import numpy as np
import pytest

from stage.errors import ManifestError
from stage.rig.cues import Cues, FrameCue, UniverseCue, read_cues, rig_digest, write_cues
from stage.rig.patch import drive_for_light, levels_of_universes, light_at_drive, patch_faults, universe_values
from stage.rig.rig import read_rig, write_rig
from tests.scenes.rigs import write_rig as write_lamps

DIRECTIONS = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]


@pytest.fixture
def content(tmp_path):
    return write_lamps(tmp_path / "rig.json", DIRECTIONS)


def read(tmp_path, content):
    (tmp_path / "rig.json").write_text(json.dumps(content))
    return read_rig(tmp_path / "rig.json")


def test_a_rig_is_written_as_it_was_read(tmp_path, content):
    rig = read(tmp_path, content)
    write_rig(rig, tmp_path / "again.json")
    assert read_rig(tmp_path / "again.json") == rig
    assert np.allclose(rig.directions, DIRECTIONS) and len(rig.emitters) == 9


def test_a_point_lamp_is_seen_from_the_subject(tmp_path, content):
    del content["lights"][1]["direction"]
    content |= {"subject_m": [0, 0, -1]}
    content["lights"][1] |= {"type": "point", "position_m": [0, 2, 1]}
    assert np.allclose(read(tmp_path, content).directions[1], np.array([0, 1, 1]) / np.sqrt(2))


@pytest.mark.parametrize("change, field", [
    ({"name": "L000"}, "lights[1].name"),
    ({"type": "point"}, "lights[1]"),
    ({"type": "point", "direction": None, "position_m": [0, 0, 0]}, "lights[1].position_m"),
    ({"bits": 12}, "lights[1].bits"),
    ({"primaries": []}, "lights[1].primaries"),
    ({"primaries": [{"name": "red", "irradiance": [1, 0, 0], "response": [[0, 0], [0.5, 0.9], [0.7, 0.2], [1, 1]]}]}, "response"),
    ({"primaries": [{"name": "red", "irradiance": [0, 0, 0]}]}, "irradiance"),
    ({"address": {"protocol": "sacn", "universe": 0, "channels": {}}}, "universe"),
    ({"address": {"protocol": "sacn", "universe": 1, "channels": {"amber": 1}}}, "amber"),
    ({"address": {"protocol": "sacn", "universe": 1, "channels": {"red": 513}}}, "channels"),
    ({"address": {"protocol": "manual", "fixed": [{"name": "Dimmer", "channel": 7, "value": 255}]}}, "fixed is for sacn and artnet"),
    ({"colour": 1}, "lights[1].colour"),
])
def test_what_is_wrong_names_the_field(tmp_path, content, change, field):
    content["lights"][1] |= change
    with pytest.raises(ManifestError) as error:
        read(tmp_path, content)
    assert "rig.json" in str(error.value) and field in str(error.value)


def test_a_folder_or_a_picture_in_place_of_a_rig_is_told_what_is_read(tmp_path):
    with pytest.raises(ManifestError, match=r"is a folder: give a JSON file with the schema relit\.rig/1$"):
        read_rig(tmp_path)
    (tmp_path / "sky.exr").write_bytes(b"\x76\x2f\x31\x01\xff")
    with pytest.raises(ManifestError, match=r"sky\.exr: is not UTF-8 text: this program reads JSON with the schema relit\.rig/1$"):
        read_rig(tmp_path / "sky.exr")


def test_the_patch_says_which_lamps_cannot_be_driven(tmp_path, content):
    assert list(patch_faults(read(tmp_path, content))) == []
    del content["lights"][0]["address"]
    del content["lights"][1]["address"]["channels"]["blue"]
    content["lights"][2]["address"]["channels"]["red"] = content["lights"][1]["address"]["channels"]["green"]
    faults = list(patch_faults(read(tmp_path, content)))
    assert [fault.split(":")[0] for fault in faults] == ["lights[0].address", "lights[1].address.channels",
                                                         "lights[2].address.channels.red"]
    content["lights"][2] |= {"bits": 16}
    content["lights"][2]["address"]["channels"] = {"red": 510, "green": 511, "blue": 512}
    assert any("beyond 512" in fault for fault in patch_faults(read(tmp_path, content)))


@pytest.mark.parametrize("bits", [8, 16])
def test_levels_return_from_their_dmx_values(tmp_path, bits):
    write_lamps(tmp_path / "rig.json", np.random.default_rng(0).normal(size=(100, 3)), bits=bits)
    rig = read_rig(tmp_path / "rig.json")
    steps = np.random.default_rng(1).integers(0, 2**bits, (2, 300))
    universes = universe_values(rig, steps)
    assert [universe.number for universe in universes] == list(range(1, 2 + bits // 8 * 300 // 513))
    for frame in range(2):
        received = {(universe.protocol, universe.number): values[frame] for universe, values in universes.items()}
        assert levels_of_universes(rig, received) == pytest.approx(steps[frame] / (2**bits - 1))
    assert levels_of_universes(rig, {}).max() == 0


def test_fixed_channels_are_sent_and_a_lamp_without_them_is_dark(tmp_path, content):
    """A master dimmer that two lamps share, and a shutter that a lamp has where another has a colour."""
    dimmer, shutter = {"name": "Dimmer", "channel": 500, "value": 255}, {"name": "Shutter", "channel": 501, "value": 40}
    content["lights"][0]["address"]["fixed"] = [dimmer]
    content["lights"][1]["address"]["fixed"] = [dimmer, shutter]
    rig = read(tmp_path, content)
    assert list(patch_faults(rig)) == []
    (universe, (values,)), = universe_values(rig, np.full((1, 9), 255)).items()
    assert values[[499, 500]].tolist() == [255, 40] and values.sum() == 9 * 255 + 295
    received = {universe[:2]: values}
    assert levels_of_universes(rig, received).tolist() == [1] * 9
    values[500] = 41
    assert levels_of_universes(rig, received).tolist() == [1] * 3 + [0] * 3 + [1] * 3
    for change, words in ({"value": 254}, "already Dimmer at 255"), ({"channel": 1}, "is already red of L000"):
        content["lights"][1]["address"]["fixed"] = [dimmer | change]
        assert [words in fault for fault in patch_faults(read(tmp_path, content))] == [True]


def test_a_response_is_undone(tmp_path, content):
    content["lights"][0]["primaries"][0]["response"] = [[0, 0], [0.1, 0], [0.5, 0.2], [1, 1]]
    primary = read(tmp_path, content).lights[0].primaries[0]
    light = np.linspace(0, 1, 11)
    assert light_at_drive(drive_for_light(light, primary), primary) == pytest.approx(light)
    assert drive_for_light(np.array([0.1, 0.2]), primary) == pytest.approx([0.3, 0.5])


def test_cues_are_those_of_their_rig(tmp_path, content):
    rig = read(tmp_path, content)
    cue = UniverseCue(protocol="sacn", universe=1, values=(7,) * 512)
    cues = Cues(schema="relit.cues/1", rig="r", rig_digest=rig_digest(rig), frames_per_second=24, emitters=(("L000", "red"),),
                frames=(FrameCue(frame=3, levels=(0.5,), dmx=(cue,)),))
    write_cues(cues, tmp_path / "cues.json")
    assert read_cues(tmp_path, rig) == cues
    content["lights"][0]["bits"] = 16
    content["lights"][0]["address"]["channels"] = {"red": 101, "green": 103, "blue": 105}
    with pytest.raises(ManifestError, match="rig_digest"):
        read_cues(tmp_path, read(tmp_path, content))
