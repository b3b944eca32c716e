"""docs/manifest.md: up to date, complete, and every example is a manifest that the reader takes."""

import json
import re
from importlib.resources import files

import pytest

from docs.tools.colour_table import colour_table
from docs.tools.manifest_examples import EXAMPLES
from docs.tools.manifest_page import PAGE, fields_of, page
from stage.capture.light import DistantLight
from stage.capture.manifest import Frame, Manifest, read_manifest
from stage.capture.projector import UncalibratedProjector

BASE = EXAMPLES[Manifest][0]
KEYS = {name: key for key, hint in (("light", "Light"), ("pattern", "Pattern"), ("laser", "Laser")) for name in
        (model.__name__ for model in EXAMPLES) if name.startswith(hint) or name.endswith(hint)}
PLACES = {"Manifest": (), "Camera": ("camera",), "Distortion": ("camera", "distortion"), "Projector": ("projector",),
          "UncalibratedProjector": ("projector",), "Frame": ("frames", 0), **{name: ("frames", 0, key) for name, key in KEYS.items()},
          "ContinuousWave": ("frames", 0, "tof"), "Pulsed": ("frames", 0, "tof"), "StereoImages": ("frames", 0, "stereo"),
          "OtherCamera": ("other_cameras", 0)}
"""Where in a manifest each model lies."""
SHOWN = [(model.__name__, number) for model, examples in EXAMPLES.items() for number in range(len(examples))]


def manifest_with(place, value):
    """The example of a manifest with a value at a place."""
    if not place:
        return value
    stereo = place in (("other_cameras", 0), ("frames", 0, "stereo")) or (place == ("frames", 0) and "stereo" in value)
    data = json.loads(json.dumps(EXAMPLES[Manifest][-1] if stereo else BASE))
    if place == ("camera", "distortion"):
        data["camera"] = {"projection": "perspective", "resolution": [8, 6], "focal_px": [9, 9]}
    inside = data
    for part in place[:-1]:
        inside = inside[part]
    if place[:2] == ("frames", 0) and len(place) == 3:
        inside.pop("light", None)
    inside[place[-1]] = value
    return data


def test_the_page_is_up_to_date():
    assert PAGE.read_text(encoding="utf-8") == page(), "python -m docs.tools.manifest_page writes it"


def test_every_model_of_a_manifest_is_on_the_page():
    """By the JSON schema of pydantic, which knows nothing of the page."""
    schema = Manifest.model_json_schema()
    models = {"Manifest": schema, **schema["$defs"]}
    assert models.keys() == {model.__name__ for model in EXAMPLES} == PLACES.keys()
    text = page()
    for name, model in models.items():
        sections = [part for part in text.split("\n#") if (model["description"].split("\n")[0] + "\n") in part]
        assert len(sections) == 1, name
        rows = re.findall(r"^\| `(\w+)` \| (.+?) \| (.+?) \| (.+?) \| (`.+`|below) \|$", sections[0], re.MULTILINE)
        assert {key for key, *_ in rows} == model["properties"].keys(), name
        for key, value, default, meaning, _ in rows:
            assert (default == "required") == (key in model.get("required", ())), (name, key)
            assert len(value) > 3 and meaning.endswith("."), (name, key)
            for bound, words in (("exclusiveMinimum", "above"), ("minimum", "or more"), ("maximum", "or less")):
                assert bound not in model["properties"][key] or words in value, (name, key)


@pytest.mark.parametrize("model", EXAMPLES, ids=lambda model: model.__name__)
def test_the_examples_have_every_field(model):
    shown = {key for example in EXAMPLES[model] for key in example}
    assert shown == {key for key, *_ in fields_of(model)}


@pytest.mark.parametrize(("name", "number"), SHOWN)
def test_every_example_is_read(tmp_path, name, number):
    example = next(examples for model, examples in EXAMPLES.items() if model.__name__ == name)[number]
    path = tmp_path / "capture.json"
    path.write_text(json.dumps(manifest_with(PLACES[name], example)), encoding="utf-8")
    found = read_manifest(path)
    for part in PLACES[name]:
        found = found[part] if isinstance(part, int) else getattr(found, part)
    assert type(found).__name__ == name


def test_words_of_values():
    text = page()
    for row in ("| `direction` | x, y, z of any length above 0, which is made 1 | required |",
                "| `position_m` | 3 numbers, metres | required |",
                "| `radiance` | a list of 1 or more; each: red, green, blue, each 0 or more | required |",
                "| `stripe_px` | number, above 0, pixels | `1` |", "| `exposure_s` | number, above 0, seconds | optional |"):
        assert row in text
    assert "None" not in text and Frame in EXAMPLES and DistantLight in EXAMPLES and UncalibratedProjector in EXAMPLES


def test_the_module_of_the_pages_is_the_newest():
    assert (files("service.server.pages") / "static" / "view" / "colour_table.js").read_text() == colour_table(), "run make colour-table"
