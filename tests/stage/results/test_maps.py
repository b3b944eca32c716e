"""maps.exr: what is written comes back, and what was not estimated is not there."""

import json

import numpy as np
import OpenEXR
import pytest

from stage.capture.camera import Camera, Distortion
from stage.capture.capture import Capture
from stage.errors import ImageError, ResultError
from stage.formats import exr
from stage.results.light_basis import facts_path, layer_types, numbers, write_facts, write_layers
from stage.results.maps import ALBEDO_SCALE, JOINED, LAYERS, SurfaceMaps, capture_as_solved
from tests.scenes.captures import files_in, make_scene, write_capture

ROWS, COLS = 5, 7
RNG = np.random.default_rng(13)
MASK = RNG.random((ROWS, COLS)) > 0.4
CAMERA = Camera(projection="perspective", resolution=(COLS, ROWS), focal_px=(9.0, 10.0), surface_z_m=-0.5,
                distortion=Distortion(model="brown_conrady", k=(0.1, 0, 0)))


def make_maps(**changes) -> SurfaceMaps:
    three, one = (lambda: RNG.random((ROWS, COLS, 3)).astype(np.float32)), (lambda: RNG.random((ROWS, COLS)).astype(np.float32))
    layers = {"normal": three(), "diffuse_albedo": three(), "diffuse_albedo_sigma": three(), "specular": three(), "roughness": one(),
              "height": one() - 1,
              "confidence": one(), "specular_normal": three(), "regime": one(), "sigma": one(),
              "abundance": one(), "height_sigma": one(), "first_specular": three(), "first_roughness": one(), "second_specular": three(),
              "second_roughness": one(), "part": np.ones(MASK.shape, np.uint8),
              "status": MASK.astype(np.uint8)}
    return SurfaceMaps(**{"camera": CAMERA, "mask": MASK, "provenance": {"relit:capture": "owl"}, **layers, **changes})


def test_every_layer_comes_back_in_the_type_it_is_stored_as(tmp_path):
    maps = make_maps(color_space="lin_ap1_scene")
    maps.write(tmp_path / "maps.exr")
    back = SurfaceMaps.read(tmp_path / "maps.exr")
    assert (back.camera, back.color_space, back.provenance) == (CAMERA, "lin_ap1_scene", {"relit:capture": "owl"})
    assert back.mask.dtype == bool and np.array_equal(back.mask, MASK)
    for name, layer in maps.layers().items():
        if name != "mask":
            stored = layer.astype(LAYERS[name][1]).astype(np.float32)
            assert np.array_equal(getattr(back, name)[MASK], stored[MASK]), name
            assert not getattr(back, name)[~MASK].any(), name


def test_the_channels_are_those_of_the_contract(tmp_path):
    make_maps().write(tmp_path / "maps.exr")
    with OpenEXR.File(str(tmp_path / "maps.exr"), separate_channels=True) as file:
        types = {name: channel.pixels.dtype.name for name, channel in file.channels().items()}
        header = dict(file.header())
    colours = ("diffuse_albedo", "diffuse_albedo_sigma", "specular", "first_specular", "second_specular")
    half = [f"{layer}.{c}" for layer in colours for c in "RGB"]
    half += [f"{layer}.Y" for layer in ("roughness", "abundance", "first_roughness", "second_roughness", "regime", "part", "sigma",
                                        "confidence", "status", "mask")]
    floats = [f"{layer}.{c}" for layer in ("normal", "specular_normal") for c in "XYZ"] + ["height.Z", "height_sigma.Z"]
    assert types == {**dict.fromkeys(half, "float16"), **dict.fromkeys(floats, "float32")}
    assert header["colorInteropID"] == "lin_rec709_scene" and "chromaticities" in header and "relit:camera" in header


def test_nothing_is_left_outside_the_mask_not_even_nan(tmp_path):
    normal = np.full((ROWS, COLS, 3), np.nan, np.float32)
    normal[MASK] = (0, 0, 1)
    make_maps(normal=normal).write(tmp_path / "maps.exr")
    channels, _ = exr.read(tmp_path / "maps.exr")
    for name, plane in channels.items():
        assert not plane[~MASK].any(), name
        assert np.isfinite(plane).all()


@pytest.mark.parametrize("absent", [name for name in LAYERS if name != "mask"])
def test_a_layer_that_was_not_estimated_is_absent_not_zero(tmp_path, absent):
    make_maps(**{absent: None}).write(tmp_path / "maps.exr")
    channels, _ = exr.read(tmp_path / "maps.exr")
    assert {name.split(".")[0] for name in channels} == set(LAYERS) - {absent}
    assert getattr(SurfaceMaps.read(tmp_path / "maps.exr"), absent) is None


def test_layers_that_are_not_wanted_are_left_out(tmp_path):
    make_maps().write(tmp_path / "maps.exr")
    whole, some = SurfaceMaps.read(tmp_path / "maps.exr"), SurfaceMaps.read(tmp_path / "maps.exr", layers=("normal", "part"))
    assert set(some.layers()) == {"normal", "part", "mask"} and some.part is not None and some.part.dtype == np.uint8
    assert np.array_equal(some.normal, whole.normal) and np.array_equal(some.mask, whole.mask)


def test_every_lobe_is_changed_and_nothing_else():
    maps = make_maps(second_specular=None)
    changed = maps.with_lobes(lambda specular, roughness: (2 * specular, roughness + 1))
    for name, layer in maps.layers().items():
        expected = 2 * layer if name in ("specular", "first_specular") else layer + 1 if name in ("roughness", "first_roughness") else layer
        assert np.array_equal(getattr(changed, name), expected), name


def test_what_is_unsure_is_kept_outside_the_mask(tmp_path):
    unsure = ~MASK & (RNG.random((ROWS, COLS)) > 0.5)
    status = np.where(MASK, 1, np.where(unsure, 15, 6)).astype(np.uint8)
    maps = make_maps(estimated=MASK | unsure, status=status)
    maps.write(tmp_path / "maps.exr")
    back = SurfaceMaps.read(tmp_path / "maps.exr", unsure=True)
    assert np.array_equal(back.mask, MASK) and np.array_equal(back.status, status) and np.array_equal(back.estimated, MASK | unsure)
    assert np.array_equal(back.normal[unsure], maps.normal[unsure]) and not back.normal[~MASK & ~unsure].any()
    plain = SurfaceMaps.read(tmp_path / "maps.exr")
    assert not plain.normal[~MASK].any() and not plain.sigma[~MASK].any() and np.array_equal(plain.status, status)


def write(path, channels, **metadata):
    exr.write(path, channels, color_space="lin_rec709_scene", metadata=metadata)
    return path


def test_what_is_not_a_maps_file_or_only_a_part_of_one_is_named(tmp_path):
    make_maps().write(tmp_path / "maps.exr")
    (tmp_path / "maps.exr").write_bytes((tmp_path / "maps.exr").read_bytes()[:-10])
    with pytest.raises(ImageError, match=r"maps\.exr: is truncated"):
        SurfaceMaps.read(tmp_path / "maps.exr")
    assert files_in(tmp_path) == {"maps.exr"}
    plane = np.ones((ROWS, COLS), np.float32)
    camera = {"relit:camera": CAMERA.model_dump_json()}
    with pytest.raises(ResultError, match=r"a\.exr: carries no relit:camera attribute"):
        SurfaceMaps.read(write(tmp_path / "a.exr", {"Y": plane}))
    with pytest.raises(ResultError, match=r"b\.exr: layer normal lacks channel normal\.Y"):
        SurfaceMaps.read(write(tmp_path / "b.exr", {"normal.X": plane, "normal.Z": plane, "mask.Y": plane}, **camera))
    with pytest.raises(ResultError, match=r"c\.exr: has no layer mask\.Y"):
        SurfaceMaps.read(write(tmp_path / "c.exr", {"height.Z": plane}, **camera))
    with pytest.raises(ResultError, match=r"d\.exr: is 3x5, its camera 7x5"):
        SurfaceMaps.read(write(tmp_path / "d.exr", {"mask.Y": plane[:, :3].copy()}, **camera))
    for name, text in (("e", "{"), ("f", "{}"), ("g", '{"projection": "fisheye"}')):
        with pytest.raises(ResultError, match=rf"{name}\.exr: its relit:camera attribute is not a camera"):
            SurfaceMaps.read(write(tmp_path / f"{name}.exr", {"mask.Y": plane}, **{"relit:camera": text}))


def test_layers_are_named_masked_and_of_their_type(tmp_path):
    rng, mask = np.random.default_rng(0), np.array([[True, False, True], [True, True, False]])
    layers = [rng.normal(size=(3, 2, 3)).astype(np.float16), rng.normal(size=(3, 2, 3)).astype(np.float32)]
    layers[1][:, ~mask] = np.nan
    write_layers(tmp_path / "b.exr", layers, mask, color_space="lin_ap1_scene", metadata={"relit:capture": "owl"},
                 progress=lambda rows: None)
    channels, metadata = exr.read(tmp_path / "b.exr")
    assert set(channels) == {f"basis.{k:03d}.{c}" for k in (0, 1) for c in "RGB"} | {"mask.Y"}
    for k, layer in enumerate(layers):
        for c, name in enumerate("RGB"):
            plane = channels[f"basis.{k:03d}.{name}"]
            assert plane.dtype == layer.dtype
            assert np.array_equal(plane[mask], layer[c][mask]) and not plane[~mask].any()
    assert np.array_equal(channels["mask.Y"], mask)
    assert metadata["colorInteropID"] == "lin_ap1_scene" and metadata["relit:capture"] == "owl"


@pytest.mark.parametrize(("rms", "largest", "wanted"), [
    ([1.0, 1.0, 1.0], 100.0, np.float16), ([1.0, 1.0, 1.0], 65505.0, np.float32), ([1e-5, 1e-4, 1e-5], 1.0, np.float32),
    ([0.0, 2.0**-11, 0.0], 1.0, np.float16)])
def test_a_layer_is_half_where_half_holds_it(rms, largest, wanted):
    assert layer_types(np.array([rms]), largest) == [wanted]


def test_facts_lie_beside_and_hold_floats_as_they_are(tmp_path):
    values = np.random.default_rng(1).normal(size=(2, 3)).astype(np.float32)
    path = write_facts(tmp_path / "b.ptm", {"kind": "ptm", "matrix": numbers(values), "one": numbers(values[0, 0])})
    assert path == facts_path(tmp_path / "b.ptm") == tmp_path / "b.ptm.json"
    facts = json.loads(path.read_text())
    assert facts["schema"] == "relit.basis/1" and facts["kind"] == "ptm"
    assert np.array_equal(np.array(facts["matrix"], dtype=np.float32), values) and np.float32(facts["one"]) == values[0, 0]
    assert files_in(tmp_path) == {"b.ptm.json"}


def test_a_capture_is_at_the_distance_that_a_depth_has_placed(tmp_path):
    capture, path = Capture.open(write_capture(tmp_path / "cap", make_scene(size=4, lights=3))), tmp_path / "maps.exr"
    for provenance, placed in (({}, None), ({JOINED: "{}"}, -0.5)):
        make_maps(provenance=provenance).write(path)
        assert capture_as_solved(capture, path).camera.surface_z_m == placed


@pytest.mark.parametrize("scale", ["0", "-2", "nan", "two"])
def test_a_scale_that_none_can_be_is_refused(tmp_path, scale):
    capture = Capture.open(write_capture(tmp_path / "cap", make_scene(size=4, lights=3)))
    make_maps(provenance={ALBEDO_SCALE: scale}).write(tmp_path / "maps.exr")
    with pytest.raises(ResultError, match=f"{ALBEDO_SCALE} is {scale}"):
        capture_as_solved(capture, tmp_path / "maps.exr")
