"""capture.json: every frame kind of the contract, and every way to be wrong named by file and field."""

import json

import pytest

from stage.capture.manifest import Manifest, read_manifest, write_manifest
from stage.errors import MOST_FAULTS, ManifestError, StorageError

IDENTITY = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
EXAMPLE = {
    "schema": "relit.capture/1",
    "name": "owl",
    "color_space": "lin_rec709_scene",
    "camera": {
        "projection": "perspective",
        "resolution": [1024, 768],
        "focal_px": [2100.0, 2100.0],
        "principal_px": [512.0, 384.0],
        "distortion": {"model": "brown_conrady", "k": [0, 0, 0], "p": [0, 0]},
        "pixel_size_m": None,
        "world_from_camera": IDENTITY,
    },
    "projector": {"resolution": [1280, 800], "focal_px": [1500, 1500], "principal_px": [640, 400],
                  "distortion": {"model": "brown_conrady", "k": [0, 0, 0], "p": [0, 0]}, "camera_from_projector": IDENTITY},
    "mask": "mask.png",
    "dark": "dark.exr",
    "flat": "flat.exr",
    "saturation": 0.98,
    "frames": [{"image": "000.exr", "exposure_s": 0.01,
                "light": {"type": "distant", "direction": [0, 0, 1], "irradiance": [1, 1, 1]}}],
}
"""The example of CONTRACTS.md with its dots filled in."""

DISTANT = {"type": "distant", "direction": [0, 0, 1], "irradiance": [1, 1, 1]}
KINDS = [
    ("light", DISTANT),
    ("light", {"type": "point", "position_m": [0, 0, 1], "intensity": [1, 1, 1]}),
    ("light", {"type": "point", "position_m": [0, 0, 1], "intensity": [1, 1, 1], "axis": [0, 0, -1], "anisotropy": 1.5}),
    ("light", {"type": "extended", "directions": [[0, 0, 1], [0, 1, 0]], "radiance": [[1, 1, 1], [0, 0, 0]],
               "solid_angle": [0.1, 0.2]}),
    *[("light", {"type": "gradient", "axis": axis, "sign": sign, "polarization": polarization})
      for axis, sign, polarization in (("x", 1, "none"), ("y", -1, "parallel"), ("z", 1, "cross"), ("full", 1, "none"))],
    ("light", {"type": "environment", "image": "probe.exr"}),
    ("light", {"type": "off"}),
    ("light", {"type": "full"}),
    *[("pattern", {"code": code, "axis": axis, "bit": 3, "bits": 4, "stripe_px": 1, "inverse": inverse})
      for code, axis, inverse in (("binary", "column", False), ("gray", "row", True))],
    ("pattern", {"code": "kary", "axis": "column", "base": 3, "digit": 1, "digits": 2, "stripe_px": 1, "reflected": False,
                 "levels": [0, 0.5, 1]}),
    ("pattern", {"code": "kary", "axis": "row", "base": 3, "digit": 0, "digits": 2, "reflected": True,
                 "colors": [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}),
    ("pattern", {"code": "ramp", "axis": "column", "direction": "up"}),
    ("pattern", {"code": "ramp", "axis": "row", "direction": "down"}),
    ("pattern", {"code": "phase", "axis": "column", "period_px": 16.5, "step": 3, "steps": 4}),
    ("pattern", {"code": "black"}),
    ("pattern", {"code": "white"}),
    ("laser", {"type": "ray", "origin_m": [0.1, 0, 0], "direction": [0, 0, -1]}),
    ("laser", {"type": "plane", "point_m": [0.1, 0, 0], "normal": [1, 0, 0]}),
    ("tof", {"type": "cw", "modulation_hz": 30e6, "reference_phase_rad": 1.5707}),
    ("tof", {"type": "pulsed", "bin_s": 9e-11, "start_s": -1e-9, "pulses": 1000, "first_photon_only": True}),
    ("tof", {"type": "pulsed", "bin_s": 9e-11, "start_s": 0}),
]
KIND_NAMES = [f"{key}-{value.get('type', value.get('code'))}-{i}" for i, (key, value) in enumerate(KINDS)]


def with_frames(*frames, **changes):
    return {**EXAMPLE, "frames": list(frames), **changes}


def sentence(tmp_path, data) -> str:
    """What read_manifest says about a bad manifest, without the path in front of it."""
    path = tmp_path / "capture.json"
    path.write_text(data if isinstance(data, str) else json.dumps(data), encoding="utf-8")
    with pytest.raises(ManifestError) as caught:
        read_manifest(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert text.count(str(path)) == 1
    assert "\n" not in text
    return text.removeprefix(f"{path}: ")


def test_the_contract_example_is_read(tmp_path):
    (tmp_path / "capture.json").write_text(json.dumps(EXAMPLE))
    manifest = read_manifest(tmp_path / "capture.json")
    assert (manifest.name, manifest.saturation, manifest.frames[0].exposure_s) == ("owl", 0.98, 0.01)
    assert manifest.camera.resolution == (1024, 768)
    assert manifest.frames[0].light.direction == (0, 0, 1)


@pytest.mark.parametrize(("key", "value"), KINDS, ids=KIND_NAMES)
def test_every_frame_kind_keeps_what_it_says(key, value):
    frame = Manifest.model_validate(with_frames({"image": "a.exr", key: value}, dark=None)).frames[0]
    kept = json.loads(getattr(frame, key).model_dump_json())
    assert {name: kept[name] for name in value} == value
    # the rest are keys left out, at their defaults
    assert all(v in (None, False, 1, "none") for name, v in kept.items() if name not in value)


@pytest.mark.parametrize(("key", "value"), KINDS, ids=KIND_NAMES)
def test_an_unknown_key_is_named_in_every_frame_kind(tmp_path, key, value):
    assert sentence(tmp_path, with_frames({"image": "a.exr", "exposure_s": 1, key: {**value, "colour": 1}})) \
        == f"frames[0].{key}.colour: is not a known key"


@pytest.mark.parametrize("key", ["direction", "irradiance", "type"])
def test_a_missing_key_is_named(tmp_path, key):
    light = {name: value for name, value in DISTANT.items() if name != key}
    said = sentence(tmp_path, with_frames({"image": "a.exr", "light": light}))
    assert said == ("frames[0].light: lacks the key type" if key == "type" else f"frames[0].light.{key}: is missing")


@pytest.mark.parametrize(("change", "said"), [
    ({"colour_space": "x"}, "colour_space: is not a known key"),
    ({"camera": {**EXAMPLE["camera"], "fov": 3}}, "camera.fov: is not a known key"),
    ({"camera": {**EXAMPLE["camera"], "distortion": {"model": "brown_conrady", "k4": 3}}},
     "camera.distortion.k4: is not a known key"),
    ({"projector": {**EXAMPLE["projector"], "fov": 3}}, "projector.fov: is not a known key"),
    ({"name": None}, "name: is null: input should be a valid string"),
    ({"name": ""}, 'name: is blank'),
    ({"name": " "}, "name: is blank"),
    ({"saturation": 0}, "saturation: is 0: input should be greater than 0"),
    ({"saturation": "high"}, 'saturation: is "high": input should be a valid number'),
    ({"camera": {**EXAMPLE["camera"], "resolution": [1024]}}, "camera.resolution[1]: is missing"),
    ({"camera": {**EXAMPLE["camera"], "resolution": [1024, -1]}},
     "camera.resolution[1]: is -1: input should be greater than or"),
    ({"camera": {**EXAMPLE["camera"], "focal_px": None}}, "camera: focal_px is missing: a perspective camera needs it"),
    ({"camera": {**EXAMPLE["camera"], "world_from_camera": [[2, 0, 0, 0], *IDENTITY[1:]]}},
     "camera.world_from_camera: is not a rotation and a"),
    ({"projector": {**EXAMPLE["projector"], "camera_from_projector": [[-1, 0, 0, 0], *IDENTITY[1:]]}},
     "projector.camera_from_projector: mirrors (its rotation has"),
    ({"camera": 3}, "camera: is 3: must be an object"),
    ({"projector": 3}, "projector: is 3: must be an object"),
    ({"projector": {"resolution": [9, 9], "gamma": 2}}, "projector.gamma: is not a known key"),
    ({"projector": {"resolution": [9, 9], "focal_px": [9, 9]}}, "projector.camera_from_projector: is missing"),
    ({"projector": {"resolution": [9, 9], "response": [0, 2, 1]}}, "projector: response must rise: each value above the one"),
    ({"camera": {**EXAMPLE["camera"], "resolution": [1, 2, 3]}}, "camera.resolution: has 3 entries, must have 2"),
    ({"mask": ""}, "mask: is blank"),
    ({"frames": []}, "frames: has 0 entries, needs 1 or more"),
    ({"frames": {}}, "frames: is {}: must be a list"),
])
def test_wrong_values_are_named(tmp_path, change, said):
    assert sentence(tmp_path, {**EXAMPLE, **change}).startswith(said)


@pytest.mark.parametrize(("frame", "said"), [
    ({"image": "b.exr"}, "frames[1]: has nothing that lit it: give exactly one of"),
    ({"image": "b.exr", "light": DISTANT, "pattern": {"code": "white"}},
     "frames[1]: has light and pattern: give exactly one of light"),
    ({"image": "b.exr", "light": {**DISTANT, "direction": [0, 0, 0]}},
     "frames[1].light.direction: has zero length: give a direction"),
    ({"image": "b.exr", "light": {**DISTANT, "direction": [0, 0]}}, "frames[1].light.direction[2]: is missing"),
    ({"image": "b.exr", "light": {**DISTANT, "direction": [0, "up", 0]}},
     'frames[1].light.direction[1]: is "up": input should be'),
    ({"image": "b.exr", "light": {**DISTANT, "irradiance": [1, -1, 1]}},
     "frames[1].light.irradiance[1]: is -1: input should be"),
    ({"image": "b.exr", "light": {"type": "spot"}},
     'frames[1].light: type is "spot", must be one of \'distant\', '),
    ({"image": "b.exr", "pattern": {"code": "gray", "axis": "column", "bit": 8, "bits": 8}},
     "frames[1].pattern: bit 8 does not exist in 8 bits (0 to 7)"),
    ({"image": "b.exr", "tof": {"type": "cw", "modulation_hz": 0, "reference_phase_rad": 0}},
     "frames[1].tof.modulation_hz: is 0: input should be greater"),
    ({"image": "a.exr", "light": DISTANT}, "frames[1].image: a.exr is already the image of frames[0]"),
    ({"image": "./a.exr", "light": DISTANT}, "frames[1].image: ./a.exr is already the image of frames[0]"),
    ({"light": DISTANT}, "frames[1].image: is missing"),
    ({"image": "b.exr", "exposure_s": 0.1, "light": DISTANT},
     "frames[0].exposure_s: is missing: give it for every frame or"),
    ("b.exr", 'frames[1]: is "b.exr": must be an object'),
])
def test_wrong_frames_are_named(tmp_path, frame, said):
    assert sentence(tmp_path, with_frames({"image": "a.exr", "light": DISTANT}, frame)).startswith(said)


def faults(tmp_path, data) -> list[str]:
    """What read_manifest says about each fault, without the path in front of it."""
    path = tmp_path / "capture.json"
    path.write_text(json.dumps(data), encoding="utf-8")
    with pytest.raises(ManifestError) as caught:
        read_manifest(path)
    assert str(caught.value) == "; ".join(caught.value.args)
    assert all(fault.startswith(f"{path}: ") for fault in caught.value.args)
    return [fault.removeprefix(f"{path}: ") for fault in caught.value.args]


def test_all_faults_are_named_at_once(tmp_path):
    """Those of the frames too, and those between frames, although other fields are wrong."""
    frames = [{"image": "a.exr", "exposure_s": 1, "light": DISTANT}, {"image": "b.exr", "light": {**DISTANT, "colour": 1, "irradiance": 3}},
              {"image": "a.exr", "exposure_s": 0, "laser": {"type": "ray"}}, 3, {"image": "c.exr", "exposure_s": 1}]
    assert [fault[:60] for fault in faults(tmp_path, with_frames(*frames, name=" ", colour="x", saturation=-1))] == [
        "name: is blank",
        "saturation: is -1: input should be greater than 0",
        "frames[1].light.irradiance: is 3: must be a list",
        "frames[1].light.colour: is not a known key",
        "colour: is not a known key",
        "frames[2].exposure_s: is 0: input should be greater than 0",
        "frames[2].laser.origin_m: is missing",
        "frames[2].laser.direction: is missing",
        "frames[3]: is 3: must be an object",
        "frames[4]: has nothing that lit it: give exactly one of ligh",
        "frames[2].image: a.exr is already the image of frames[0]",
        "frames[1].exposure_s: is missing: give it for every frame or",
    ]


def test_the_list_of_faults_is_bounded(tmp_path):
    found = faults(tmp_path, with_frames(*[{"image": f"{i}.exr", "light": {"type": "distant"}} for i in range(5000)]))
    assert found == [f"frames[{i}].light.{key}: is missing" for i in range(MOST_FAULTS // 2) for key in ("direction", "irradiance")] + [
        "has further faults: mend these first"]


@pytest.mark.parametrize(("text", "said"), [
    ("", "is not JSON: Expecting value at line 1, column 1"),
    ('{"schema": "relit.capture/1",\n "name": }', "is not JSON: Expecting value at line 2, column 10"),
    ("[]", "must hold one JSON object"),
    ("3", "must hold one JSON object"),
    ('{"name": "owl"}', "schema: is missing: this program reads relit.capture/1"),
    ('{"schema": "relit.capture/2"}', 'schema: is "relit.capture/2", this program reads'),
    ('{"schema": "relit.capture/1", "name": "a", "name": "b"}', "key name is given twice in one object"),
    ('{"schema": "relit.capture/1", "saturation": NaN}', "NaN is not a JSON number"),
    ('{"schema": "relit.capture/1", "saturation": -Infinity}', "-Infinity is not a JSON number"),
    ("[" * 100_000, "is nested too deeply"),
])
def test_what_is_not_a_manifest_is_named(tmp_path, text, said):
    assert sentence(tmp_path, text).startswith(said)


def test_an_overflowing_number_is_not_finite(tmp_path):
    text = json.dumps({**EXAMPLE, "saturation": 0.5}).replace("0.5", "1e999")
    assert sentence(tmp_path, text) == "saturation: is Infinity: input should be a finite number"


def test_other_encodings(tmp_path):
    path = tmp_path / "capture.json"
    path.write_bytes(b'{"schema": "relit.capture/1", "name": "\xff"}')
    with pytest.raises(ManifestError, match="is not UTF-8 text"):
        read_manifest(path)
    path.write_bytes(b"\xef\xbb\xbf" + json.dumps(EXAMPLE).encode())  # a byte order mark, as Windows editors write it
    assert read_manifest(path).name == "owl"


def test_a_missing_manifest_is_a_storage_error(tmp_path):
    with pytest.raises(StorageError, match="no such file or directory"):
        read_manifest(tmp_path / "capture.json")


def test_written_manifests_read_back_the_same(tmp_path):
    timed = with_frames(*[{"image": f"{i:02d}.exr", "exposure_s": 0.01, key: value} for i, (key, value) in enumerate(KINDS)])
    manifest = Manifest.model_validate(timed)
    write_manifest(manifest, tmp_path / "capture.json")
    assert read_manifest(tmp_path / "capture.json") == manifest


def test_a_written_manifest_always_says_schema_name_and_colour_space(tmp_path):
    bare = {key: EXAMPLE[key] for key in ("schema", "name", "frames")}
    manifest = Manifest.model_validate({**bare, "camera": {"projection": "orthographic", "resolution": [2, 2]}})
    write_manifest(manifest, tmp_path / "capture.json")
    written = json.loads((tmp_path / "capture.json").read_text())
    assert list(written) == ["schema", "name", "color_space", "camera", "frames"]
    assert written["color_space"] == "lin_rec709_scene"
    assert written["camera"] == {"projection": "orthographic", "resolution": [2, 2]}
