"""The commands of docs/colour.md, docs/publish.md and docs/blender.md run one after another as they stand, on small stand-ins of what they
name."""

import re
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.scenes.captures import make_scene, write_capture, write_exr
from tests.scenes.chart import CAMERA, reflectances, shoot, table
from tests.service.calibrate.solvers.test_chart_reference import cgats
from tests.service.owl import write_small_owl
from tests.stage.colour.test_configuration import minimal

pytestmark = pytest.mark.long

DOCS = Path(__file__).parents[3] / "docs"
SMALL_SIDE = 8
SQUARE = 60
"""Pixels from patch to patch of the chart before it is put into the picture."""


def shown(page: str) -> list[list[str]]:
    """The words of each command in the blocks of a page."""
    blocks = re.findall(r"```\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)
    return [shlex.split(line, comments=True)[1:] for block in blocks for line in block.splitlines() if line.startswith("relit ")]


def chart_at(corners: np.ndarray) -> np.ndarray:
    """[rows, cols, 3] a ColorChecker whose corner patches have their centres at these pixels, as a camera sees it."""
    card = np.full((5 * SQUARE, 7 * SQUARE, 3), 0.035)
    for index, colour in enumerate(0.5 * reflectances() @ CAMERA.T):
        top, left = (int((place + 0.58) * SQUARE) for place in divmod(index, 6))
        card[top:top + int(0.84 * SQUARE), left:left + int(0.84 * SQUARE)] = colour
    ends = SQUARE * (1 + np.array([[0, 0], [5, 0], [5, 3], [0, 3]], np.float32)) - 0.5
    form = cv2.getPerspectiveTransform(ends, corners.astype(np.float32) - 0.5)
    picture = cv2.warpPerspective(card, form, (800, 600), flags=cv2.INTER_LINEAR, borderValue=(0.2, 0.2, 0.2))
    return np.maximum(picture + 0.002 * np.random.default_rng(1).normal(size=picture.shape), 0)


def test_the_commands_of_colour_run(relit, tmp_path, monkeypatch):
    commands = shown("colour.md")
    [corners] = [np.reshape([float(each) for each in words[words.index("--corners") + 1].split(",")], (4, 2))
                 for words in commands if "--corners" in words]
    write_capture(tmp_path / "capture", make_scene(size=16, lights=5))
    write_exr(tmp_path / "sky.exr", np.ones((8, 16, 3), np.float32))
    text = Path(minimal(tmp_path / "show.ocio")).read_text()
    for name, other in (("Plain", "Film"), ("warm", "shot grade"), ("cold", "neutral")):
        assert text.count(f"name: {name}") == 1
        text = text.replace(f"name: {name}", f"name: {other}")
    (tmp_path / "show.ocio").write_text(text)
    for name in ("CAPTURE", "CHART"):
        shoot(tmp_path / name, [chart_at(corners)])
    (tmp_path / "mine.cgats").write_text(cgats([row["name"].replace(" ", "_") for row in table()], ["LAB_L", "LAB_A", "LAB_B"],
                                               [[float(row[each]) for each in "lab"] for row in table()]))
    monkeypatch.chdir(tmp_path)
    for words in commands:
        assert relit(*words).code == 0, words
    made = {path.name for name in ("frames", "shown", ".", "solved", "CAPTURE") for path in (tmp_path / name).iterdir()}
    assert len(commands) == 9 and {"a.0001.exr", "a.0001.png", "sheet.png", "lights.png", "maps.exr", "chart.png"} <= made


def test_the_commands_of_publish_and_blender_run(relit, tmp_path, monkeypatch):
    write_small_owl(tmp_path / "samples" / "owl", SMALL_SIDE)
    monkeypatch.chdir(tmp_path)
    commands = [*shown("publish.md"), *shown("blender.md")]
    for words in commands:
        assert relit(*words).code == 0, words
    made = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")}
    assert len(commands) == 4
    assert {"owl-page/index.html", "owl-iiif/manifest.json", "owl-planes/info.json", "owl-planes/plane_0.dzi", "relit.zip"} <= made
