"""relit publish --as iiif: what IIIF's own validators find.

That of the Image API runs its tests of level 0 against a server of files. That of the Presentation API is in no registry: iiif-prezi3 has
models of its schema, and the schema, schema/iiif_3_0.json of IIIF/presentation-validator, is read where RELIT_TEST_IIIF_SCHEMA names the
file. What the models do not ask and the validator does is asked here, in words of our own.
"""

import json
import os

import iiif_prezi3
import jsonschema
import numpy as np
import pytest

from tests.reference.colour import srgb_to_linear
from tests.scenes.captures import make_scene, write_capture
from tests.service.publish.published import served

LEVEL_0 = {"format_jpg", "id_basic", "id_squares", "info_json", "size_nofull"}
SQUARE = 100
"""Pixels of a square of the validator's image, which is 10 x 10 squares of known colours."""
NOTES = [{"body": "a place", "target": "#xywh=10,20,30,40"},
         {"body": "a point", "target": {"selector": {"type": "PointSelector", "x": 3, "y": 4.5}}}]


@pytest.mark.long
def test_the_image_validator_finds_nothing(relit, tmp_path):
    """Its squares are what a capture shows."""
    pytest.importorskip("magic", reason="the validator needs libmagic", exc_type=ImportError)
    from iiif_validator.validator import ImageAPI, TestSuite, ValidationInfo

    known = ValidationInfo()
    colours = np.array(known.colorInfo).swapaxes(0, 1) / 255  # they are in columns
    linear = srgb_to_linear(colours)
    scene = make_scene(size=10 * SQUARE, lights=3)
    white = np.ones_like(scene.irradiance)
    squares = linear.repeat(SQUARE, axis=0).repeat(SQUARE, axis=1)
    write_capture(tmp_path / "squares", scene._replace(mask=np.ones_like(scene.mask), irradiance=white, images=np.stack(3 * [squares])))
    with served(tmp_path) as url:
        where = url.removeprefix("http://").strip("/")
        relit.done("publish", tmp_path / "squares", "--to", tmp_path / "out", "--as", "iiif", "--url", f"http://{where}/out",
                   "--photographs", "1")
        suite = TestSuite(known)
        assert {name for name, test in suite.list_tests("3.0").items() if test["level"] == 0} == LEVEL_0
        for name in sorted(LEVEL_0):
            outcome = suite.run_test(name, ImageAPI("photograph_0", where, "out", version="3.0", debug=False))
            assert outcome.exception is None and outcome.tests, f"{name}: {outcome.exception}"


@pytest.fixture
def manifest(relit, tmp_path):
    """A manifest that has all that manifests of Relit can hold."""
    write_capture(tmp_path / "cap", make_scene(size=64, lights=5), camera={
        "projection": "orthographic", "resolution": [64, 64], "pixel_size_m": 1e-4})
    relit.done("solve", tmp_path / "cap", "--out", tmp_path / "maps", "--method", "lambert")
    (tmp_path / "notes.json").write_text(json.dumps(NOTES))
    relit.done("publish", tmp_path / "cap", "--to", tmp_path / "out", "--as", "iiif", "--url", "https://museum.org/cap",
               "--maps", tmp_path / "maps", "--annotations", tmp_path / "notes.json", "--attribution", "A museum",
               "--rights", "https://creativecommons.org/licenses/by/4.0/")
    return json.loads((tmp_path / "out" / "manifest.json").read_text())


def test_the_models_of_presentation_find_nothing(manifest):
    read = iiif_prezi3.Manifest.model_validate(manifest)
    assert [len(canvas.items[0].items[0].body.items) for canvas in read.items] == [9, 2]
    assert len(read.items[0].annotations[0].items) == 2
    identifiers = [each["id"] for canvas in manifest["items"] for each in (
        canvas, *(page for name in ("items", "annotations") for page in canvas[name]),
        *(note for name in ("items", "annotations") for page in canvas[name] for note in page["items"]))]
    assert len({manifest["id"], *identifiers}) == 1 + len(identifiers)
    points = [note["target"]["selector"] for canvas in manifest["items"] for note in canvas["annotations"][0]["items"]
              if "selector" in note["target"]]
    assert len(points) == 2 and all(type(each[axis]) is int and each[axis] > 0 for each in points for axis in "xy")
    schema = jsonschema.Draft202012Validator(iiif_prezi3.Manifest.model_json_schema())
    assert [error.message for error in schema.iter_errors(manifest)] == []
    for fault in ({"items": [{"type": "Canvas"}]}, {"label": "of no language"}, {"type": "Collection"}, {"id": 3}):
        assert list(schema.iter_errors(manifest | fault))


@pytest.mark.skipif("RELIT_TEST_IIIF_SCHEMA" not in os.environ, reason="RELIT_TEST_IIIF_SCHEMA names no file")
def test_the_schema_of_the_presentation_validator_finds_nothing(manifest):
    with open(os.environ["RELIT_TEST_IIIF_SCHEMA"]) as file:
        schema = jsonschema.Draft7Validator(json.load(file))
    assert [error.message for error in schema.iter_errors(manifest)] == []
    canvas = manifest["items"][0]
    for fault in ({"rights": "https://creativecommons.org/licenses/by/4.0/"}, {"more": 1}, {"items": [canvas | {"width": 0}]},
                  {"items": [canvas | {"annotations": [{"id": "https://museum.org/page"}]}]}):
        assert list(schema.iter_errors(manifest | fault))
