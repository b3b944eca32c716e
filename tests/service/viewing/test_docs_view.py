"""docs/view.md: every key of view.json is described, and every key that is described exists."""

import re
from pathlib import Path

import pytest

from service.depth.depth import depth
from service.requests.captures import ViewRequest
from service.requests.depth import DepthRequest
from service.viewing.view_files import view
from tests.reference.view import View
from tests.scenes.glossy import dome, write_dome, write_maps

ROOT = Path(__file__).parents[3]
TEXT = (ROOT / "docs" / "view.md").read_text(encoding="utf-8")
TABLES = {title: set(re.findall(r"`([a-z_0-9]+)`", " ".join(row.split("|")[1] for row in rows.splitlines())))
          for title, rows in re.findall(r"^\| (key[^|]*) \| \|\n\|---\|---\|\n((?:\|.*\n)+)", TEXT, re.MULTILINE)}
"""The keys in the first column of each table."""


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> list[dict]:
    folder = tmp_path_factory.mktemp("docs")
    surface, rig = dome(), ROOT / "samples" / "rig"
    write_dome(folder / "cap", surface, lights=8)
    write_maps(folder / "maps", surface, regime=surface.mask + 0.0)
    depth(DepthRequest(capture=rig, out=folder / "depth", device="cpu"))
    view(ViewRequest(capture=folder / "cap", maps=folder / "maps", out=folder / "a", device="cpu"))
    view(ViewRequest(capture=rig, maps=folder / "depth", out=folder / "b", device="cpu"))
    return [View(folder / name).facts for name in "ab"]


@pytest.mark.long
@pytest.mark.parametrize(("title", "of"), [
    ("key", lambda facts: [facts]), ("key of `layers[]`", lambda facts: facts["layers"]),
    ("key of `frames[]`", lambda facts: facts["frames"]), ("key of `relight`", lambda facts: [facts["relight"]]),
    ("key of `samples`", lambda facts: [facts["samples"]]), ("key of `points`", lambda facts: [facts["points"]]),
], ids=lambda value: value if isinstance(value, str) else "")
def test_the_tables_have_the_keys_of_the_files(written, title, of):
    keys = {key for facts in written for each in of(facts) if each is not None for key in each}
    assert keys and TABLES[title] == keys


@pytest.mark.long
def test_the_sizes_of_the_format_are_those_of_the_code(written):
    facts = written[0]
    assert facts["relight"]["directions"] == [64, 32] and facts["layers"][0]["levels"][0]["tile"] == 256
    assert {code["name"] for code in facts["samples"]["codes"].values()} == {"saturated", "shadowed", "backlit"}
