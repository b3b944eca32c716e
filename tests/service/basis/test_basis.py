"""relit basis: what the files hold, what a viewer shows of them, and that the error said is the error measured."""

import json
import re
from pathlib import Path

import numpy as np
import OpenEXR
import OpenImageIO as oiio
import pytest

import service
from stage.formats import exr
from tests.marks import first_short
from tests.reference.colour import srgb
from tests.reference.light_basis import relative_rms, render_ptm, render_rti, truncation
from tests.reference.sampling import lattice
from tests.scenes.captures import edit_frame, edit_manifest, files_in, make_scene, render, write_capture, write_exr

SCENE = make_scene(size=16, lights=9)
LAMBERT = Path(service.__file__).parents[1] / "samples" / "lambert"
HALF_ROUNDING = 2.0**-11
AP1_TO_REC709 = np.array([[1.7050510, -0.6217921, -0.0832589], [-0.1302564, 1.1408047, -0.0105483], [-0.0240033, -0.1289690, 1.1529723]])
"""Of the Academy Color Encoding System (D60 to D65 by Bradford), to seven digits."""


def dome(count: int) -> np.ndarray:
    """[count, 3] unit directions spread over the hemisphere."""
    return lattice(count, np.degrees(np.arccos(0.1)))


def write_dome(folder: Path, directions: np.ndarray, **changes) -> np.ndarray:
    """A capture of the cap under these lights, each of a colour of its own.

    Returns:
        [lights, rows, cols, 3] radiance under white light of irradiance 1.
    """
    irradiance = 1 + 0.1 * np.arange(3 * len(directions)).reshape(-1, 3) % 0.7
    images = render(SCENE.normal, SCENE.albedo, directions, irradiance)
    write_capture(folder, SCENE._replace(directions=directions, irradiance=irradiance, images=images), **changes)
    return images / irradiance[:, None, None]


def facts_of(path: Path) -> dict:
    return json.loads(path.with_name(f"{path.name}.json").read_text())


def said(outcome) -> float:
    """The error that was printed."""
    return float(re.search(r"^error +([\d.e-]+) % RMS", outcome.out, re.MULTILINE)[1]) / 100


def rebuilt(path: Path, mask) -> tuple[dict, np.ndarray]:
    """What is said of a basis, and [lights, pixels, 3] the images by its coefficients."""
    facts, (channels, _) = facts_of(path), exr.read(path)
    layers = np.array([[channels[f"{name}.{c}"][mask] for c in "RGB"] for name in facts["layers"]], dtype=np.float64)
    return facts, np.einsum("ckl,kcp->lpc", np.array(facts["matrix"]), layers)


def sample():
    """Masked images [lights, pixels, 3], directions, irradiance and mask of samples/lambert, read without our code."""
    manifest = json.loads((LAMBERT / "capture.json").read_text())
    mask = oiio.ImageBuf(str(LAMBERT / "mask.png")).get_pixels(oiio.FLOAT)[..., 0] > 0.5
    images = []
    for frame in manifest["frames"]:
        with OpenEXR.File(str(LAMBERT / frame["image"]), separate_channels=True) as file:
            channels = file.channels()
            images.append(np.stack([channels[c].pixels for c in "RGB"], axis=-1)[mask])
    lights = [frame["light"] for frame in manifest["frames"]]
    directions = np.array([light["direction"] for light in lights])
    return (np.array(images, dtype=np.float64), directions / np.linalg.norm(directions, axis=1, keepdims=True),
            np.array([light["irradiance"] for light in lights]), mask)


def test_a_lambertian_object_without_shadow_is_three_images(relit, tmp_path):
    write_capture(tmp_path / "cap", SCENE)
    outcome = relit.done("basis", tmp_path / "cap", "--out", tmp_path / "b.exr", "--count", "3")
    assert outcome.out.splitlines()[:2] == [f"basis    {tmp_path}/b.exr", f"facts    {tmp_path}/b.exr.json"]
    assert outcome.out.splitlines()[2].endswith(f"3 coefficients a channel, 9 lights, {SCENE.mask.sum()} pixels")
    assert said(outcome) < HALF_ROUNDING  # in the stack and in the file
    assert files_in(tmp_path) - {f"cap/{name}" for name in files_in(tmp_path / "cap")} == {"b.exr", "b.exr.json"}
    channels, metadata = exr.read(tmp_path / "b.exr")
    facts = facts_of(tmp_path / "b.exr")
    found = rebuilt(tmp_path / "b.exr", SCENE.mask)[1]
    assert np.abs(found - SCENE.images[:, SCENE.mask]).max() < 3 * HALF_ROUNDING * SCENE.images.max()  # three layers in half
    assert not any(channels[f"{name}.{c}"][~SCENE.mask].any() for c in "RGB" for name in facts["layers"])
    assert np.array_equal(channels["mask.Y"] > 0.5, SCENE.mask)
    assert metadata["relit:capture"] == facts["capture"] == "cap" and facts["schema"] == "relit.basis/1" and facts["kind"] == "svd"
    assert facts["resolution"] == [16, 16] and facts["color_space"] == metadata["colorInteropID"] == "lin_rec709_scene"
    assert [light["image"] for light in facts["lights"]] == [f"{i:03d}.exr" for i in range(9)]
    assert np.allclose([light["direction"] for light in facts["lights"]], SCENE.directions, atol=1e-8)
    assert facts["provenance"]["relit:inputs"] == metadata["relit:inputs"]


@first_short("count", [1, 4, 16, 32])
def test_the_error_said_is_the_error_measured(relit, tmp_path, count):
    images, _, _, mask = sample()
    outcome = relit("basis", LAMBERT, "--cache", tmp_path / "cache", "--out", tmp_path / "b.exr", "--count", count)
    facts, found = rebuilt(tmp_path / "b.exr", mask)
    measured = relative_rms(found, images)
    # float32 images against their half stack: 2^-12 of a reading, not correlated with what is left
    assert facts["error"]["relative_rms"] == pytest.approx(measured, rel=1e-3, abs=2.0**-12)
    assert said(outcome) == pytest.approx(facts["error"]["relative_rms"], rel=1e-2)  # three digits are printed
    left = truncation(np.moveaxis(images, 2, 0), count)
    assert np.allclose(facts["error"]["truncation_rgb"], left, rtol=1e-3, atol=2.0**-12)
    assert facts["error"]["truncation"] <= facts["error"]["relative_rms"] + 1e-6 and facts["error"]["pixels"] == mask.sum()


def test_the_error_under_lights_between_the_captured_is_that_of_relit_frames(relit, tmp_path):
    """Measured on lights halfway between neighbours, which share it about equally; the error that is said is of 32 others."""
    images, directions, irradiance, mask = sample()
    errors = []
    outcome = relit("basis", LAMBERT, "--cache", tmp_path / "cache", "--out", tmp_path / "b.exr", "--count", 6)
    facts, found = rebuilt(tmp_path / "b.exr", mask)
    for first, second in enumerate((directions @ directions.T - 2 * np.eye(len(directions))).argmax(axis=1)):
        weights = 0.5 / irradiance[[first, second]]
        whole, shown = (np.einsum("lc,lpc->pc", weights, values[[first, second]]) for values in (images, found))
        errors.append(relative_rms(shown, whole))
    error = facts["error"]["key_lights_relative_rms"]
    assert facts["error"]["key_lights"] == 32
    assert 0.5 < error / np.sqrt(np.mean(np.square(errors))) < 2
    assert f"error    {100 * error:.3g} % RMS of pictures under lights from between" in outcome.out


@pytest.mark.long
@pytest.mark.parametrize(("kind", "name", "count", "most"), [
    # cast shadows and the edge of a ball lit up to 75 degrees are what is lost; figures of this run, rounded up
    ("ptm", "a.ptm", None, 0.12), ("lrgb-ptm", "a.ptm", None, 0.12), ("hsh", "a.rti", 4, 0.125), ("hsh", "a.rti", None, 0.10),
    ("hsh", "a.rti", 16, 0.06)])
def test_a_viewer_shows_what_was_said(relit, tmp_path, kind, name, count, most):
    images, directions, irradiance, mask = sample()
    options = [] if count is None else ["--count", count]
    outcome = relit.done("basis", LAMBERT, "--cache", tmp_path / "cache", "--out", tmp_path / name, "--kind", kind, *options)
    facts, data = facts_of(tmp_path / name), (tmp_path / name).read_bytes()
    lit = images / irradiance[:, None]
    assert facts["exposure"] == pytest.approx(1 / np.quantile(lit, 0.999), rel=1e-3)  # half rounding of that value
    shown = (render_rti if kind == "hsh" else render_ptm)(data, directions)
    measured = relative_rms(shown[:, mask], srgb(lit * facts["exposure"]))
    assert facts["error"]["relative_rms"] == pytest.approx(measured, rel=1e-4)  # display values in half, 1e-4 of white, not correlated
    assert said(outcome) == pytest.approx(measured, rel=1e-2) and measured < most
    assert facts["error"]["fit_relative_rms"] <= facts["error"]["relative_rms"] < 1.01 * facts["error"]["fit_relative_rms"]
    assert shown[:, ~mask].max() < 1e-6  # black, but for scale and bias in float
    assert facts["kind"] == kind and facts["lights_left_out"] == [] and len(facts["lights"]) == 32
    assert re.search(r"of what is shown, \d+\.\d of 255: ", outcome.out)


@pytest.mark.parametrize(("name", "kind"), [("b.exr", "svd"), ("b.ptm", "ptm"), ("b.rti", "hsh"),
                                             pytest.param("b.PTM", "ptm", marks=pytest.mark.long)])
def test_the_suffix_says_the_kind_and_two_runs_are_one_file(relit, tmp_path, name, kind):
    write_dome(tmp_path / "cap", dome(20))
    before = files_in(tmp_path / "cap")
    for folder in ("one", "two"):
        relit("basis", tmp_path / "cap", "--cache", tmp_path / "cache", "--out", tmp_path / folder / name).well()
    assert files_in(tmp_path / "cap") == before
    facts = facts_of(tmp_path / "one" / name)
    assert (facts["kind"], facts["count"]) == (kind, {"svd": 16, "ptm": 6, "hsh": 9}[kind])
    for file in (name, f"{name}.json"):
        assert (tmp_path / "one" / file).read_bytes() == (tmp_path / "two" / file).read_bytes()
    (tmp_path / "file").write_text("x")
    refused = relit("basis", tmp_path / "cap", "--out", tmp_path / "file" / name)
    refused.refused(f"relit: cannot write {tmp_path}/file/{name}: ")
    write_dome(tmp_path / "few", dome(17))
    relit("basis", tmp_path / "few", "--out", tmp_path / "few.out" / name).well()
    assert facts_of(tmp_path / "few.out" / name)["count"] == {"svd": 16, "ptm": 6, "hsh": 4}[kind]


def test_lights_behind_the_object_are_left_out_and_counted(relit, tmp_path):
    behind = dome(30)
    behind[::3, 2] *= -1
    images = write_dome(tmp_path / "cap", behind)
    outcome = relit("basis", tmp_path / "cap", "--out", tmp_path / "b.ptm")
    assert "20 lights" in outcome.out and "lights   10 are not in front of the object and are left out" in outcome.out
    facts, front = facts_of(tmp_path / "b.ptm"), behind[:, 2] > 0
    assert facts["lights_left_out"] == [f"{i:03d}.exr" for i in range(0, 30, 3)]
    shown = render_ptm((tmp_path / "b.ptm").read_bytes(), behind[front])[:, SCENE.mask]
    measured = relative_rms(shown, srgb(images[front][:, SCENE.mask] * facts["exposure"]))
    assert facts["error"]["relative_rms"] == pytest.approx(measured, rel=1e-3)
    relit("basis", tmp_path / "cap", "--out", tmp_path / "b.exr")
    assert len(facts_of(tmp_path / "b.exr")["lights"]) == 30  # a sum of images wants them all


def test_a_viewer_is_given_rec709_with_up_up_and_right_right(relit, tmp_path):
    images = write_dome(tmp_path / "cap", dome(25), color_space="lin_ap1_scene")
    relit("basis", tmp_path / "cap", "--out", tmp_path / "b.rti")
    facts = facts_of(tmp_path / "b.rti")
    seen = images @ AP1_TO_REC709.T
    assert facts["exposure"] == pytest.approx(1 / np.quantile(seen[:, SCENE.mask], 0.999), rel=1e-3)
    shown = render_rti((tmp_path / "b.rti").read_bytes(), dome(25))[:, SCENE.mask]
    assert relative_rms(shown, srgb(seen[:, SCENE.mask] * facts["exposure"])) == pytest.approx(
        facts["error"]["relative_rms"], rel=1e-3)
    write_dome(tmp_path / "cap", dome(40))
    lights = np.array([[0, 0.6, 0.8], [0, -0.6, 0.8], [0.6, 0, 0.8], [-0.6, 0, 0.8]])
    for name, show in (("b.ptm", render_ptm), ("b.rti", render_rti)):
        relit("basis", tmp_path / "cap", "--out", tmp_path / name)
        shown = show((tmp_path / name).read_bytes(), lights)[..., 1]
        assert shown[0, 1, 8] > shown[1, 1, 8] and shown[1, 14, 8] > shown[0, 14, 8]
        assert shown[2, 8, 14] > shown[3, 8, 14] and shown[3, 8, 1] > shown[2, 8, 1]


def test_near_lights_are_taken_as_distant_and_said(relit, tmp_path):
    directions = dome(12)
    frames = [{"image": f"{i:03d}.exr", "light": {"type": "point", "position_m": (2 * d).tolist(), "intensity": [4, 4, 4]}}
              for i, d in enumerate(directions)]
    write_dome(tmp_path / "cap", directions, frames=frames,
               camera={"projection": "orthographic", "resolution": [16, 16], "pixel_size_m": 0.001})
    outcome = relit("basis", tmp_path / "cap", "--out", tmp_path / "b.ptm")
    assert "lights   12 near lights are taken as distant" in outcome.out
    assert "12 near lights" in facts_of(tmp_path / "b.ptm")["provenance"]["relit:lights"]
    assert np.allclose(facts_of(tmp_path / "b.ptm")["lights"][3]["direction"], directions[3], atol=1e-6)


def unlit(cap: Path) -> None:
    for index in range(9):
        write_exr(cap / f"{index:03d}.exr", np.zeros((16, 16, 3)))


def patterns(cap: Path) -> None:
    edit_manifest(cap, frames=[{"image": f"{i:03d}.exr", "pattern": {"code": "gray", "axis": "column", "bit": i, "bits": 4}}
                               for i in range(4)])


def from_behind(cap: Path) -> None:
    for index in range(4):
        edit_frame(cap, index, light={"type": "distant", "direction": [0.1 * index, 0, -1], "irradiance": [1, 1, 1]})


def on_a_ring(cap: Path) -> None:
    for index, turn in enumerate(np.linspace(0, 6, 9)):
        light = {"type": "distant", "direction": [0.6 * np.cos(turn), 0.6 * np.sin(turn), 0.8], "irradiance": [1, 1, 1]}
        edit_frame(cap, index, light=light)


def nothing(cap: Path) -> None:
    pass


BAD = {
    "more coefficients than lights": (nothing, "b.exr", ["--count", "10"], "--count 10: ", "capture.json has 9 lights: give 1 to 9"),
    "no coefficients": (nothing, "b.exr", ["--count", "0"], "count: is 0", "greater than or equal to 1"),
    "a suffix of no kind": (nothing, "b.png", [], "b.png: end the name in .exr", ""),
    "no suffix": (nothing, "b", [], "b: end the name in .exr", ""),
    "the suffix of another kind": (nothing, "b.exr", ["--kind", "hsh"], "b.exr: end the name in .rti for --kind hsh", ""),
    "a kind that is none": (nothing, "b.exr", ["--kind", "rbf"], "'rbf' is not one of 'svd', 'ptm', 'lrgb-ptm', 'hsh'", ""),
    "another count for a PTM": (nothing, "b.ptm", ["--count", "9"], "--count 9: a polynomial texture map has six coefficients", ""),
    "another count for harmonics": (nothing, "b.rti", ["--count", "5"], "--count 5: hemispherical harmonics have 4, 9 or 16", ""),
    "too few lights": (nothing, "b.rti", ["--count", "16"], "capture.json: frames: 9 are lit from in front of the object",
                       "16 coefficients of hsh need 16 or more"),
    "lights behind": (from_behind, "b.ptm", [], "frames: 5 are lit from in front of the object (z > 0; 4",
                      "6 coefficients of ptm need 6 or more"),
    "lights on a ring": (on_a_ring, "b.ptm", [], "capture.json: frames[].light.direction: 9 lights do not", ""),
    "a light without blue": (lambda cap: edit_frame(cap, 3, light={"type": "distant", "direction": [0, 0, 1], "irradiance": [1, 1, 0]}),
                             "b.ptm", [], "light.irradiance of 003.exr: is 0 in channel B", ""),
    "a gradient": (lambda cap: edit_frame(cap, 2, light={"type": "gradient", "axis": "x", "sign": 1}),
                   "b.ptm", [], "capture.json: frames[2].light: is gradient: this needs", ""),
    "patterns": (patterns, "b.exr", [], "capture.json: frames: none is lit by a distant light", ""),
    "a black object": (unlit, "b.ptm", [], "capture.json: frames: the object is black under every light", ""),
    "an image of the capture": (nothing, "../cap/003.exr", [], "003.exr is an input: choose another folder or name", ""),
    "a missing file": (lambda cap: (cap / "002.exr").unlink(), "b.exr", [], "frames[2].image: 002.exr is not in the folder", ""),
}


@pytest.mark.parametrize("fault", BAD)
def test_bad_input_is_one_sentence_and_leaves_nothing(relit, tmp_path, fault):
    spoil, name, options, words, more = BAD[fault]
    cap, out = tmp_path / "cap", tmp_path / "out"
    write_capture(cap, SCENE)
    spoil(cap)
    before = files_in(cap)
    assert more in relit("basis", cap, "--cache", tmp_path / "cache", "--out", out / name, *options).refused(words)
    assert not out.exists() and files_in(cap) == before


def test_values_beyond_half_are_kept_in_float_and_one_light_and_one_pixel_are_enough(relit, tmp_path):
    write_capture(tmp_path / "cap", SCENE)
    for index, image in enumerate(SCENE.images):
        write_exr(tmp_path / "cap" / f"{index:03d}.exr", 1e6 * image)
    outcome = relit("basis", tmp_path / "cap", "--out", tmp_path / "b.exr", "--count", "3")
    channels, _ = exr.read(tmp_path / "b.exr")
    assert channels["basis.000.R"].dtype == np.float32 and channels["basis.000.R"].max() > 65504 and said(outcome) < HALF_ROUNDING
    scene = make_scene(size=1, lights=1)
    write_capture(tmp_path / "one", scene)
    assert "1 coefficients a channel, 1 lights, 1 pixels" in relit("basis", tmp_path / "one", "--out", tmp_path / "b.exr").well()
    channels, _ = exr.read(tmp_path / "b.exr")
    weight = np.array(facts_of(tmp_path / "b.exr")["matrix"])[:, 0, 0]
    assert np.allclose([channels[f"basis.000.{c}"][0, 0] for c in "RGB"] * weight, scene.images[0, 0, 0], rtol=2 * HALF_ROUNDING)
    write_exr(tmp_path / "one" / "000.exr", np.zeros((1, 1, 3)))  # a black capture is still a sum of black images
    outcome = relit("basis", tmp_path / "one", "--out", tmp_path / "b.exr")
    assert outcome.code == 0 and said(outcome) == 0


def test_clipped_readings_are_said(relit, tmp_path):
    directions = dome(12)
    images = write_dome(tmp_path / "cap", directions)
    outs = [("basis", tmp_path / "cap", "--out", tmp_path / "b.exr"), ("basis", tmp_path / "cap", "--out", tmp_path / "b.ptm"),
            ("publish", tmp_path / "cap", "--to", tmp_path / "planes", "--as", "openlime")]
    edit_manifest(tmp_path / "cap", saturation=9 * float(images.max()))
    assert not any("from readings that are" in relit(*words).out for words in outs)
    edit_manifest(tmp_path / "cap", saturation=0.6 * float(images.max()))
    assert all("from readings that are clipped in every frame of their light" in relit(*words).out for words in outs)
    assert "clipped" in facts_of(tmp_path / "b.exr")["warnings"][0] and "clipped" in facts_of(tmp_path / "b.ptm")["warnings"][0]
