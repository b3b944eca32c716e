"""Captures and frames in the colour spaces of an OpenColorIO configuration, through the commands."""

import json

import numpy as np
import OpenImageIO as oiio
import PyOpenColorIO
import pytest

from service.captures.check_process import check_in_process
from service.errors import RequestError
from service.requests.answers import JobView
from service.requests.jobs import RelightJob
from stage.colour.colour import linearise, rgb_matrix
from stage.colour.colour_spaces import linear_space
from stage.colour.configuration import used
from stage.colour.location import STUDIO, VARIABLE
from stage.formats import exr
from tests.marks import first_short
from tests.reference.colour import ACES_TO_ACESCG, ACES_TO_REC709, AWG4_TO_ACES, logc4_to_linear
from tests.scenes.captures import edit_frame, edit_manifest, make_scene, rgb, write_capture, write_image
from tests.service.captures.test_check_process import Told
from tests.stage.colour.test_configuration import minimal

SCENE = make_scene(size=12, lights=5)
KEYS = {"schema": "relit.keys/1", "captured": [{"image": "000.png", "keys": [{"frame": 1, "weight": 2}]}]}


@pytest.fixture
def logged(tmp_path):
    """A capture of 16-bit images in LogC4, and what they record as fractions [lights, rows, cols, 3]."""
    folder = write_capture(tmp_path / "cap", SCENE, color_space="ARRI LogC4", mask=None)
    codes = np.rint(np.random.default_rng(5).uniform(0.15, 0.6, SCENE.images.shape) * 65535).astype(np.uint16)
    for index, image in enumerate(codes):
        write_image(folder / f"{index:03d}.png", image)
        edit_frame(folder, index, image=f"{index:03d}.png")
    (tmp_path / "keys.json").write_text(json.dumps(KEYS))
    return folder, codes / 65535


def relight(relit, tmp_path, *options, space="lin_ap1_scene"):
    return relit.done("relight", tmp_path / "cap", "--keys", tmp_path / "keys.json", "--out", tmp_path / "f" / "a.#.exr", "--matte", "none",
                      "--color-space", space, *options)


def test_logc4_in_and_acescg_out(relit, logged, tmp_path):
    folder, fractions = logged
    told = relight(relit, tmp_path, "--ocio", STUDIO, "--report", tmp_path / "r.json", "--sheet", tmp_path / "s.png", "--view",
                   "Un-tone-mapped", space="ACEScg").out
    expected = 2 * logc4_to_linear(fractions[0]) @ (ACES_TO_ACESCG @ AWG4_TO_ACES).T
    # halves of the stack and of the frame: 2 × 2^-11
    assert np.allclose(rgb(tmp_path / "f" / "a.1.exr"), expected, rtol=1e-3, atol=1e-3 * expected.max()), told
    _, metadata = exr.read(tmp_path / "f" / "a.1.exr")
    label = json.loads((tmp_path / "r.json").read_text())["versions"]["OpenColorIO configuration"]
    assert label.startswith(f"{STUDIO} OpenColorIO ") and metadata["relit:ocio"] == label
    cache_id = PyOpenColorIO.Config.CreateFromFile(STUDIO).getCacheID()
    assert metadata["relit:ocio_cache_id"] == cache_id == json.loads((tmp_path / "r.json").read_text())["versions"]["OpenColorIO cache id"]
    assert metadata["colorInteropID"] == "lin_ap1_scene"
    shown = relit.done("info", folder, "--ocio", STUDIO).out
    assert "ARRI LogC4, worked on in ocio:lin_awg4_scene" in shown and f"{label}, cache id {cache_id}" in shown


@first_short(("place", "space"), [
    (STUDIO, "ARRI LogC4"), (STUDIO, "S-Log3 S-Gamut3.Cine"), ("ocio://cg-config-latest", "ACEScct"), ("minimal", "house gamma")])
def test_frames_are_what_openimageio_makes_of_the_images(relit, logged, tmp_path, place, space):
    """In one piece from the codes to ACEScg, by each configuration; and solved without the halves of files, within 1e-5 of the value.

    The configuration for computer graphics has no LogC4: the log that it has is ACEScct. The minimal one has no ACEScg: its processor
    leads to its space of ACES2065-1, and the matrix of the standard on.
    """
    folder, fractions = logged
    place = minimal(tmp_path / "house.ocio") if place == "minimal" else place
    edit_manifest(folder, color_space=space)
    target = "house aces" if "house" in space else "ACEScg"
    pixels = oiio.ImageBuf(np.array(fractions[0], np.float32))
    processed = oiio.ImageBufAlgo.colorconvert(pixels, space, target, colorconfig=str(place)).get_pixels(oiio.FLOAT).astype(float)
    if target == "house aces":
        processed = processed @ ACES_TO_ACESCG.T
    with used(place):
        worked = linearise(fractions[0].astype(np.float32), space)
        made = worked @ rgb_matrix(linear_space(space), "ACEScg" if target == "ACEScg" else "lin_ap1_scene").T
    assert np.allclose(made, processed, rtol=1e-5, atol=1e-5 * processed.max())
    acescg = "ACEScg" if target == "ACEScg" else "lin_ap1_scene"
    relight(relit, tmp_path, "--ocio", place, space=acescg)
    # halves of the stack and of the frame: 2 × 2^-11
    assert np.allclose(rgb(tmp_path / "f" / "a.1.exr"), 2 * processed, rtol=1e-3, atol=1e-3 * processed.max())
    shown = relit.done("info", folder, "--ocio", place).out
    assert f"{space}, worked on in " in shown and ("house.ocio sha256:" if "house" in space else f"{place} OpenColorIO ") in shown


def test_a_configuration_is_part_of_what_frames_and_caches_are_known_by(relit, logged, tmp_path, monkeypatch):
    """The same name in a configuration with another curve: neither the stack nor the frame is taken again."""
    folder, _ = logged
    edit_manifest(folder, color_space="house gamma")
    minimal(tmp_path / "one.ocio")
    (tmp_path / "two.ocio").write_text((tmp_path / "one.ocio").read_text().replace("2.5", "2.0"))
    frames = []
    for name in ("one.ocio", "two.ocio", "two.ocio"):
        monkeypatch.setenv(VARIABLE, str(tmp_path / name))
        out = relight(relit, tmp_path).out
        frames.append(rgb(tmp_path / "f" / "a.1.exr"))
    assert not np.allclose(frames[0], frames[1], rtol=0.1) and np.array_equal(frames[1], frames[2]) and "skipped  1 of 1" in out


@pytest.mark.parametrize(("options", "words"), [
    (("--ocio", "no.ocio"), "no.ocio: no such OpenColorIO configuration"),
    (("--color-space", "ACESgc", "--ocio", STUDIO), "--color-space: ACESgc is no colour space of the OpenColorIO configuration"),
    (("--color-space", "ACEScct", "--ocio", STUDIO), "--color-space: is ACEScct: give a scene-linear colour space"),
    (("--view", "Nice", "--sheet", "s.png", "--ocio", STUDIO), "--view: Nice is no view of"),
    (("--view", "Un-tone-mapped", "--ocio", STUDIO), "give --sheet or --display too"),
    ((), f"color_space: ARRI LogC4 is no colour space of the OpenColorIO configuration ocio://default: {STUDIO} has ARRI LogC4"),
])
def test_what_is_wrong_is_one_sentence(relit, logged, tmp_path, options, words):
    told = relit.refused("relight", tmp_path / "cap", "--keys", tmp_path / "keys.json", "--out", tmp_path / "f" / "a.#.exr", *options)
    assert words in told and not (tmp_path / "f").exists()


def test_the_process_that_checks_uploads_has_the_configuration_of_the_service(logged, monkeypatch):
    monkeypatch.setenv(VARIABLE, STUDIO)
    facts = check_in_process(logged[0], environment=False, root=None, max_pixels=10**6, progress=Told())
    assert facts["color_space"] == "ARRI LogC4"
    monkeypatch.delenv(VARIABLE)
    with pytest.raises(RequestError, match="color_space: ARRI LogC4 is no colour space of"):
        check_in_process(logged[0], environment=False, root=None, max_pixels=10**6, progress=Told())


def test_a_client_reads_a_job_in_a_space_that_its_own_configuration_lacks(monkeypatch):
    asked = {"kind": "relight", "capture": f"cap_{'0' * 20}", "environment": f"env_{'0' * 20}",
             "options": {"color_space": "Linear ARRI Wide Gamut 4", "frames": "1-3"}}
    view = {"id": f"job_{'0' * 20}", "state": "queued", "attempt": 1, "revision": 1, "priority": 50, "created_at": 0, "started_at": None,
            "finished_at": None, "progress": None, "error": None}
    monkeypatch.setenv(VARIABLE, STUDIO)
    request = RelightJob.model_validate(asked).model_dump(mode="json", by_alias=True)
    monkeypatch.delenv(VARIABLE)
    text = json.dumps({**view, "request": request})
    assert JobView.model_validate_json(text).request.options.color_space == request["options"]["color_space"]
    with pytest.raises(ValueError, match=r"is no colour space of .* ocio://default"):
        RelightJob.model_validate(asked)  # a request is checked as ever


def test_a_view_has_the_matrix_of_a_space_that_the_pages_do_not_know(relit, logged, tmp_path):
    relit("view", logged[0], "--out", tmp_path / "view", "--ocio", STUDIO)
    view = json.loads((tmp_path / "view" / "view.json").read_text())
    assert view["color_space"] == "ocio:lin_awg4_scene"
    assert np.allclose(np.reshape(view["to_rec709"], (3, 3)), ACES_TO_REC709 @ AWG4_TO_ACES, atol=1e-4)  # CAT02 and Bradford meet at ACES
