"""Folders without a capture.json: what is needed of them is told before it is sent, they are looked at, and imported as was chosen."""

import json
from pathlib import Path
from typing import get_args

import numpy as np
import pytest

from service.requests.base.import_choices import Layout
from service.requests.imports.layouts import LAYOUTS
from stage.errors import ManifestError
from tests.scenes.captures import write_image
from tests.scenes.foreign import LIGHTS, write_four_phases, write_photographs
from tests.service.server.api.job_calls import refused

SETTLED = ("receiving", "ready", "refused")


def listed(folder: Path) -> list[dict]:
    return [{"path": path.relative_to(folder).as_posix(), "length": path.stat().st_size} for path in sorted(folder.rglob("*"))
            if path.is_file()]


def looked_at(server, client, tus, folder: Path, name: str = "dropped") -> dict:
    """The capture of a folder when the service has looked at its files."""
    found, = client.post("/v1/needed-files", json={"files": listed(folder)}).raise_for_status().json()["captures"]
    place = f"/v1/captures/{client.post('/v1/captures', json={'name': name}).raise_for_status().json()['id']}"
    for file in found["files"]:
        tus.send(place, file["name"], (folder / file["path"]).read_bytes())
    assert client.post(f"{place}/guess").raise_for_status().status_code == 202
    return server.wait(client, place, SETTLED)


def imported(server, client, capture: dict, **choices) -> dict:
    place = f"/v1/captures/{capture['id']}"
    assert client.post(f"{place}/import", json=choices).raise_for_status().status_code == 202
    return server.wait(client, place, SETTLED)


def manifest_of(server, capture: dict) -> dict:
    found, = server.data.glob(f"projects/*/captures/{capture['id']}/capture.json")
    return json.loads(found.read_text())


def test_every_layout_that_can_be_chosen_is_imported():
    assert set(get_args(Layout)) == set(LAYOUTS)


def test_what_is_needed_is_told_from_names_and_lengths():
    from stage.importers.needed import needed_files

    photos = {f"p{number}.jpg": 5_000_000 for number in range(9)}
    found, = needed_files({
        **photos, "light_directions.txt": 900, "clip0.mov": 3_200_000_000, "short p0.mov": 9_000_000, ".DS_Store": 6, "notes.pdf": 9,
        "raw/.cache/x.jpg": 3, "log.txt": 80 << 20})
    assert (found.folder, sorted(found.files)) == ("", sorted([*photos, "light_directions.txt"]))
    poses = needed_files({f"{pose}/{step}.png": 9 for pose in ("pose2", "pose1") for step in range(4)} | {"calibration.xml": 8, "x.txt": 1})
    assert [each.folder for each in poses] == ["pose1", "pose2"]
    assert poses[0].files == {**{f"pose1/{step}.png": f"{step}.png" for step in range(4)}, "calibration.xml": "calibration.xml",
                              "x.txt": "x.txt"}
    listed_below, = needed_files({"dome.lp": 90, "jpg/a.jpg": 5, "jpg/b.jpg": 5, "film.mp4": 7})
    assert listed_below.files == {"dome.lp": "dome.lp", "jpg/a.jpg": "jpg/a.jpg", "jpg/b.jpg": "jpg/b.jpg"}
    with pytest.raises(ManifestError, match="holds 20000 folders with images, and 100 are taken"):
        needed_files({f"{number}/a.npy": 5 for number in range(20_000)})
    photos_below = {f"owl/{number:03d}.png": 5 for number in range(5)}
    table_above, = needed_files({"lights.npy": 700, **photos_below})
    assert table_above.files == {**{path: path[4:] for path in photos_below}, "lights.npy": "lights.npy"}
    picture_above, = needed_files({"overview.png": 5, "photos/a.png": 4, "photos/b.png": 4, "photos/c.png": 4})
    assert picture_above.folder == "photos"


@pytest.mark.parametrize(("files", "words"), [
    ([("a.pdf", 1), ("b.doc", 2)], "of these 2 files: looked for photographs with a table"),
    ([("owl.ptm", 9)], "owl.ptm holds coefficients that were fitted"),
    ([("take.mov", 9)], "take.mov is a video"), ([("a.ply", 9), ("b.ply", 9)], "a.ply holds points"),
    ([(f"{side}/{number}.png", 9) for side in ("left", "right") for number in range(5)], "two cameras, left and right"),
    ([("a\n<b>.pdf", 1)], "looked for"), ([("../../lights.csv", 1)], "looked for")])
def test_files_that_fit_nothing_are_told_in_a_sentence(client, files, words):
    refused(client.post("/v1/needed-files", json={"files": [{"path": path, "length": length} for path, length in files]}), 422,
            words)


@pytest.mark.parametrize("name", ["a:b.png", "aux.png", "a\nb.png"])
def test_a_name_that_cannot_be_stored_is_named_before_anything_is_sent(client, name):
    files = [{"path": path, "length": 9} for path in ("1.png", "2.png", "3.png", name)]
    refused(client.post("/v1/needed-files", json={"files": files}), 422, name.replace("\n", "\\n"))


@pytest.mark.long
def test_photographs_with_a_table_of_lights_become_a_capture(server, client, tus, tmp_path):
    folder = write_photographs(tmp_path / "photos")
    looked = looked_at(server, client, tus, folder, "owl <b>")
    proposal = looked["facts"]["proposal"]
    assert looked["state"] == "receiving"
    assert proposal["summary"] == f"{LIGHTS} photographs lit from {LIGHTS} directions (lights.txt)"
    assert (proposal["layout"], proposal["missing"], proposal["sure"]) == ("olat", [], True)
    ready = imported(server, client, looked, layout="olat", options={**proposal["options"], "pixel_size_m": 0.001})
    assert (ready["state"], ready["facts"]["frames"], ready["facts"]["resolution"]) == ("ready", LIGHTS, [32, 32])
    manifest = manifest_of(server, ready)
    assert (manifest["name"], manifest["camera"]["pixel_size_m"]) == ("owl <b>", 0.001)
    assert set(proposal["assumed"]) <= set(manifest["assumed"])
    files = {file["path"]: file for file in client.get(f"/v1/captures/{ready['id']}/files").json()["files"]}
    assert set(files) == {"capture.json", "lights.txt", *(f"photo_{number}.png" for number in range(LIGHTS))}
    stored, = server.data.glob(f"projects/*/captures/{ready['id']}")
    assert files["capture.json"]["length"] == (stored / "capture.json").stat().st_size
    refused(client.post(f"/v1/captures/{ready['id']}/guess"), 409, "ready already")


@pytest.mark.long
def test_what_is_missing_is_chosen_and_a_wrong_choice_can_be_mended(server, client, tus, tmp_path):
    looked = looked_at(server, client, tus, write_four_phases(tmp_path / "tof"))
    proposal = looked["facts"]["proposal"]
    assert (proposal["layout"], proposal["missing"], proposal["sure"]) == ("tof", ["frequencies_hz"], False)
    place, chosen = f"/v1/captures/{looked['id']}", proposal["options"]
    refused(client.post(f"{place}/import", json={"layout": "tof", "options": chosen}), 422, "frequencies_hz")
    refused(client.post(f"{place}/import", json={"layout": "tof", "options": {**chosen, "frequencies_hz": ["x"]}}), 422, "frequencies_hz")
    refused(client.post(f"{place}/import", json={"layout": "tof", "options": {**chosen, "frequencies_hz": [6e7], "colour": 1}}), 422,
            "colour")
    chosen = {**chosen, "frequencies_hz": [60e6]}
    wrong = imported(server, client, looked, layout="tof", options={**chosen, "phases_deg": [0, 90, 180]})
    assert wrong["state"] == "refused" and str(server.data) not in wrong["problem"]
    assert wrong["facts"]["proposal"] == proposal
    ready = imported(server, client, looked, layout="tof", options=chosen)
    assert ready["state"] == "ready" and "proposal" not in ready["facts"]


def test_pictures_of_nothing_are_refused_with_what_was_looked_for_and_no_path(server, client, tus, tmp_path):
    for number, side in enumerate((8, 12, 16)):
        write_image(tmp_path / "mixed" / f"{number}.png", np.full((side, side), 90, np.uint8))
    found = looked_at(server, client, tus, tmp_path / "mixed")
    assert found["state"] == "refused" and "looked for: photographs with a table" in found["problem"]
    assert str(server.data) not in found["problem"] and ".import-" not in found["problem"]


@pytest.mark.parametrize(("field", "value"), [("mask", "../../../secret.png"), ("lights", "/etc/passwd"), ("images", "..\\*"),
                                              ("mask", "a/../../b")])
def test_a_choice_that_leads_out_of_the_capture_is_refused(client, capture, field, value):
    answer = client.post(f"{capture}/import", json={
        "layout": "olat", "options": {"axes": "right,up,towards", "sense": "to-light", field: value}})
    refused(answer, 422, f"{field}: leads out of the capture")
    refused(client.post(f"{capture}/import", json={"layout": "lp", "file": "../x.lp"}), 422, "file: leads out")


@pytest.mark.long
@pytest.mark.parametrize("way", ["relightlab", "lp"])
def test_files_that_name_images_of_others_get_none(server, client, tus, tmp_path, way):
    """A project that names the folder of another capture, or an image above its own, as RelightLab and an .lp file may."""
    theirs = looked_at(server, client, tus, write_photographs(tmp_path / "theirs"), "theirs")
    stored, = server.data.glob(f"projects/*/captures/{theirs['id']}")
    ours = tmp_path / "ours"
    ours.mkdir()
    up = "../" * 12
    if way == "relightlab":
        (ours / "p.relight").write_text(json.dumps({"folder": str(stored), "images": [
            {"filename": f"photo_{number}.png", "direction": {"x": 0, "y": 0.1 * number, "z": 1}} for number in range(3)], "dome": {}}))
    else:
        (ours / "p.lp").write_text("1\n" + f"{up}{stored.relative_to('/')}/photo_0.png 0 0 1\n")
    looked = looked_at(server, client, tus, ours, "ours")
    found = looked if looked["state"] == "refused" else imported(
        server, client, looked, layout=way, file=looked["facts"]["proposal"]["file"], options={})
    assert found["state"] == "refused", found
    assert str(stored) not in found["problem"] or way == "lp"  # whoever wrote the .lp file wrote the path
    files = {file["path"] for file in client.get(f"/v1/captures/{looked['id']}/files").json()["files"]}
    own, = server.data.glob(f"projects/*/captures/{looked['id']}")
    assert files == {path.name for path in ours.iterdir()} == {path.name for path in own.iterdir()}


def test_a_registered_capture_is_not_imported(client, dome):
    for answer in (client.post(f"/v1/captures/{dome}/guess"), client.post(f"/v1/captures/{dome}/import", json={"layout": "photos"})):
        refused(answer, 409, "is registered")
