"""relit publish --as iiif: static files that answer what IIIF asks for, and a manifest that names them."""

import json

import numpy as np
import pytest

from service import __version__
from service.publish.publish import publish
from service.requests.publish import PublishRequest
from service.requests.solve import SolveRequest
from service.solve.solve import solve
from stage.colour.configuration import current
from tests.reference.colour import srgb
from tests.scenes.captures import make_scene, write_capture
from tests.service.publish.published import image

pytestmark = pytest.mark.long  # the fixture takes ten seconds

URL = "https://museum.org/cap"
SIZE = 1100
"""More than what is there whole."""
PIXEL_M = 25e-6
NOTES = {"type": "AnnotationPage", "items": [
    {"type": "Annotation", "body": {"type": "TextualBody", "value": "a crack"},
     "target": {"selector": {"type": "FragmentSelector", "value": "xywh=10.5,20,29.25,39.5"}}},
    {"type": "Annotation", "body": "a point", "target": {"selector": {"type": "PointSelector", "x": 0.25, "y": 299.6}}},
    {"type": "Annotation", "body": {"value": "a corner"}, "target": "https://elsewhere/canvas#xywh=0,0,5,5"}]}


@pytest.fixture(scope="module")
def scene():
    return make_scene(size=SIZE, lights=5)


@pytest.fixture(scope="module")
def published(scene, tmp_path_factory):
    """A cap with maps and notes, published."""
    folder = tmp_path_factory.mktemp("published")
    camera = {"projection": "orthographic", "resolution": [SIZE, SIZE], "pixel_size_m": PIXEL_M}
    write_capture(folder / "cap", scene, camera=camera)
    solve(SolveRequest(capture=folder / "cap", out=folder / "maps", method="lambert", device="cpu"))
    (folder / "notes.json").write_text(json.dumps(NOTES))
    publish(PublishRequest(capture=folder / "cap", out=folder / "out", kind="iiif", url=f"{URL}/", maps=folder / "maps", photographs=2,
                           annotations=folder / "notes.json", rights="https://creativecommons.org/licenses/by/4.0/",
                           attribution="A museum", title="Cap"))
    return folder / "out"


def halved(pixels: np.ndarray) -> np.ndarray:
    return pixels.reshape(SIZE // 2, 2, SIZE // 2, 2, -1).mean(axis=(1, 3))


def file_of(folder, address):
    """The file that a plain server gives for an address."""
    assert address.startswith(f"{URL}/")
    return folder / address.removeprefix(f"{URL}/")


def test_the_manifest_names_pictures_that_are_there(published):
    manifest = json.loads((published / "manifest.json").read_text())
    assert manifest["id"] == f"{URL}/manifest.json" and manifest["label"] == {"none": ["Cap"]}
    assert manifest["rights"] == "http://creativecommons.org/licenses/by/4.0/"
    assert manifest["requiredStatement"]["value"] == {"none": ["A museum"]}
    facts = {entry["label"]["en"][0]: entry["value"]["none"][0] for entry in manifest["metadata"]}
    assert facts == {"Capture": "cap", "Lights": "5", "Version": __version__, "Inputs": facts["Inputs"],
                     "Colour configuration": current().label, "OpenColorIO cache id": current().cache_id}
    identifiers, labels = [manifest["id"]], []
    for canvas in manifest["items"]:
        [size] = canvas["service"]
        assert (size["physicalScale"], size["physicalUnits"]) == (1000 * PIXEL_M, "mm")
        [painting] = canvas["items"][0]["items"]
        assert (canvas["width"], canvas["height"], painting["target"]) == (SIZE, SIZE, canvas["id"])
        identifiers += [canvas["id"], canvas["items"][0]["id"], painting["id"]]
        assert painting["body"]["type"] == "Choice"
        for body in painting["body"]["items"]:
            labels.append(body["label"]["en"][0])
            identifiers.append(body["id"])
            assert image(file_of(published, body["id"])).shape == (body["height"], body["width"], 3) == (SIZE // 2, SIZE // 2, 3)
            assert json.loads((file_of(published, body["service"][0]["id"]) / "info.json").read_text())["id"] == body["service"][0]["id"]
        thumbnail = canvas["thumbnail"][0]
        assert image(file_of(published, thumbnail["id"])).shape[:2] == (thumbnail["height"], thumbnail["width"])
    assert len(set(identifiers)) == len(identifiers)
    assert labels[-2:] == ["normals", "albedo"] and sum(label.startswith("photograph") for label in labels) == 2 and len(labels) == 8
    assert not any(label.startswith("raking") for label in labels)  # all lights of the ring are within 30 degrees of the camera


def test_notes_are_on_each_canvas(published):
    """In whole pixels: IIIF's validator takes points from 1 on, Media Fragments take no others for rectangles."""
    manifest = json.loads((published / "manifest.json").read_text())
    for canvas in manifest["items"]:
        [page] = canvas["annotations"]
        crack, point, corner = page["items"]
        assert crack["body"]["value"] == "a crack" and crack["target"] == f"{canvas['id']}#xywh=10,20,30,40"
        assert point["target"]["selector"] == {"type": "PointSelector", "x": 1, "y": 300}
        assert corner["target"] == f"{canvas['id']}#xywh=0,0,5,5"


def test_every_tile_that_a_viewer_asks_for_is_there(published):
    """A viewer computes the addresses of tiles as section 5.6 of the Image API tells."""
    for folder in (published / "relit_0", published / "albedo"):
        info = json.loads((folder / "info.json").read_text())
        assert info["profile"] == "level0" and (info["width"], info["height"]) == (SIZE, SIZE)
        whole = np.zeros((SIZE, SIZE, 3), np.uint8)
        [tiles] = info["tiles"]
        for factor in tiles["scaleFactors"]:
            step = tiles["width"] * factor
            for y in range(0, SIZE, step):
                for x in range(0, SIZE, step):
                    width, height = min(step, SIZE - x), min(step, SIZE - y)
                    size = -(-width // factor), -(-height // factor)
                    tile = image(folder / f"{x},{y},{width},{height}" / f"{size[0]},{size[1]}" / "0" / "default.jpg")
                    assert tile.shape[:2] == size[::-1]
                    if factor == 1:
                        whole[y:y + height, x:x + width] = tile
        for size in info["sizes"]:
            small = image(folder / "full" / f"{size['width']},{size['height']}" / "0" / "default.jpg")
            assert small.shape[:2] == (size["height"], size["width"])
        largest = image(folder / "full" / "max" / "0" / "default.jpg").astype(float)
        assert largest.shape[:2] == (info["maxHeight"], info["maxWidth"]) == (SIZE // 2, SIZE // 2)
        assert np.abs(largest - halved(whole)).mean() < 1  # JPEG files of the same pixels


def test_pictures_are_what_they_say(published, scene):
    white = scene.images / scene.irradiance[:, None, None]
    exposure = np.quantile(white[:, scene.mask], 0.999)
    manifest = json.loads((published / "manifest.json").read_text())
    bodies = {body["label"]["en"][0]: file_of(published, body["id"])
              for canvas in manifest["items"] for body in canvas["items"][0]["items"][0]["body"]["items"]}
    photographs = [path for label, path in bodies.items() if label.startswith("photograph")]
    for light, path in zip((0, 4), photographs, strict=True):  # two of five are the first and the last
        got = image(path) / 255
        truth = halved(srgb(np.clip(white[light] / exposure, 0, 1)) * scene.mask[..., None])
        assert np.sqrt(np.mean(np.square(got - truth))) < 2 / 255  # JPEG
    inside = halved(scene.mask)[..., 0] == 1
    normals, truth = image(bodies["normals"])[inside] / 127.5 - 1, halved(scene.normal)[inside]
    off = np.degrees(np.arccos(np.clip((normals * truth).sum(axis=-1) / np.linalg.norm(normals, axis=-1), -1, 1)))
    assert np.median(off) < 1  # a level of 255 is .45 degrees
    albedo = image(bodies["albedo"])[inside] / 255
    assert np.abs(albedo - halved(srgb(scene.albedo))[inside]).mean() < 2 / 255
